"""Poses of maps that magpylib computed: found from nothing, with blocks and probe in error."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.core.numbers import EMPTY_CELL
from halbach_fe.geometry.array_layout import blocks_table
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference import pose_fit
from halbach_fe.inference.infer import infer
from halbach_fe.inference.pose_fit import PoseFit
from halbach_fe.inference.pose_result import OpenKey, ProbePrior
from halbach_fe.inference.pose_search import _after_no_pose, coarse_poses, right_angles
from halbach_fe.inference.registration import (
    UNDECIDED_LOG_EVIDENCE,
    _of_known_probe,
    axes_of_map,
    least_turned_first,
    odds,
    register,
    turn_from_axes,
)
from halbach_fe.measurement.doubted_terms import Term
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.probe_law import NAMES
from halbach_fe.report.registration_page import (
    AT_REST,
    NOT_AT_REST,
    UNDECIDED,
    answer,
    is_symmetric_to,
    magnet_on_stage,
    place_table,
    pose_table,
    probe_table,
    registration_summary,
    sentences,
    stated_odds,
)
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement_keys import Instrument, InstrumentSd
from halbach_fe.study.reader import parse_study, read_study
from tests.diagnosis import campaign as cuboids
from tests.support.short_dipole import GRID, NOISE_T, TEXT, measured, polarization_of, truth


@pytest.mark.filterwarnings("ignore:.*about the z axis. The blocks lie")
def test_a_magnet_beside_the_z_axis_is_found(magnet, generator, tmp_path):
    """The search went along the z axis, where such a magnet has a weak field, and its answer was
    that the map is of another magnet. Its middle on the stage was that of the study's origin.
    """
    away = np.array([0.3, -0.1, 0.2])
    table = blocks_table(magnet)
    table |= {name: [value + more for value in table[name]]
              for name, more in zip(("x_m", "y_m", "z_m"), away, strict=True)}
    beside = build_magnet(magnet.study.with_(array={"free_blocks": table}))
    data = measured(truth(generator), generator, Rotation.identity(), -GRID.mean(axis=0))
    found = register(beside, data, Session.open(tmp_path))[0]
    assert found.explains
    assert found.middle_m == pytest.approx(away, abs=4 * float(np.linalg.norm(
        found.translation_sd_m)))
    assert magnet_on_stage(found)[0] == pytest.approx(
        GRID.mean(axis=0), abs=4 * float(np.linalg.norm(found.translation_sd_m)))


@pytest.fixture(scope="module")
def magnet():
    return build_magnet(parse_study(tomllib.loads(TEXT)))


@pytest.mark.parametrize("number", [0, 5, 17])
def test_a_pose_is_found_from_nothing(magnet, generator, tmp_path, number):
    turn = Rotation.from_rotvec([0.02, -0.03, 0.04]) * Rotation.from_matrix(right_angles()[number])
    middle = np.array([0.0008, -0.0005, 0.012])
    shift = middle - turn.apply(GRID.mean(axis=0))
    if np.abs(GRID @ turn.as_matrix().T + shift)[:, :2].max() > 0.018:
        # the long side lies across the bore: the map would be inside blocks
        with pytest.raises(MeasurementError, match=r"unexplained.*halbach-fe check"):
            register(magnet, field_map(GRID, np.ones_like(GRID)), Session.open(tmp_path))
        return
    # the origin of the stage is half a metre away
    data = measured(truth(generator), generator, turn, shift)
    moved = field_map(GRID + np.array([0.3, -0.2, 0.4]), data["B_T"].values)
    found = register(magnet, moved, Session.open(tmp_path))
    # rotations by half a turn about the field's axis are symmetric
    angle, best = min([((Rotation.from_rotvec(each.instrument.rotation_rad) * turn.inv()
                        ).magnitude(), each)
                       for each in found], key=lambda found: found[0])
    assert best.at_rest
    assert angle < 4 * float(np.linalg.norm(best.rotation_sd_rad))
    assert best.middle_m == pytest.approx(
        middle, abs=4 * float(np.linalg.norm(best.translation_sd_m)))
    assert np.linalg.norm(best.translation_sd_m) < 2e-4
    off = (magnet_on_stage(best)[0] - ([0.3, -0.2, 0.4] - turn.inv().apply(shift)))
    sd = magnet_on_stage(best)[1]
    assert (np.abs(off) < 4 * sd).all()
    # the turns move it too, by a lever of a centimetre
    assert (sd < 2 * np.linalg.norm(best.translation_sd_m)).all()
    origin = shift - turn.apply([0.3, -0.2, 0.4])
    # the origin is half a metre from the map, so that a turn moves it too
    assert best.instrument.translation_m == pytest.approx(origin, abs=1e-3)
    assert odds(found)[[each is best for each in found]] > 0.01  # among equals
    # readings that were held out are as near as their noise
    assert np.nanmax(best.held_out_rms_T) < 1.3 * NOISE_T
    assert np.nanmin(best.held_out_nominal_rms_T) > 5 * NOISE_T


def test_equal_poses_are_reported_together(magnet, generator, tmp_path):
    data = measured(truth(generator, 0.0), generator, Rotation.identity(),
                    np.array([0.0, 0.0, -0.045]))
    found = register(magnet, data, Session.open(tmp_path))
    assert len(found) > 1  # half a turn about y changes nothing of an ideal dipole
    probabilities = odds(found)
    assert probabilities.sum() == pytest.approx(1.0)
    assert np.sort(probabilities)[-2] > 0.02
    rows = place_table(found)
    assert [row["pose"] for row in rows] == [str(number + 1) for number in range(len(found))]
    # the middle of the grid along z, and its standard deviation
    value, sd = rows[0]["z in mm"].split("\u00a0±\u00a0")
    assert float(value) == pytest.approx(1e3 * found[0].middle_m[2], abs=float(sd))
    assert float(sd) == pytest.approx(1e3 * found[0].translation_sd_m[2], rel=0.06)  # 2 digits
    best, other = found[:2]
    assert is_symmetric_to(best, other)
    # that they fit alike is pretended here: noise tells the two fits of this map apart
    twin = replace(other, log_evidence=best.log_evidence, rms_T=best.rms_T,
                   nominal_rms_T=best.nominal_rms_T)
    said = answer([best, twin])
    assert said.trust.startswith(AT_REST)
    assert "1 other pose predicts the same readings" in said.trust
    # negative controls: one block is stronger, the other pose is elsewhere, another fit is better
    uneven = replace(best, study=parse_study(tomllib.loads(
        TEXT + "\n[[array.exceptions]]\nring = 1\nslot = 2\nremanence_T = 1.25\n")))
    assert not is_symmetric_to(uneven, other)
    assert "predicts the same" not in answer([uneven, twin]).trust
    assert "fits these readings equally well" in answer([uneven, twin]).trust
    moved = replace(other, middle_m=other.middle_m + np.array([0, 0, 0.01]))
    assert not is_symmetric_to(best, moved)
    # what ends fits of equal poses up to 1 apart tells nothing of them, but much of other poses
    nearly = replace(twin, log_evidence=best.log_evidence - 1)
    assert answer([best, nearly]).trust.startswith(AT_REST)
    assert "1 other pose predicts the same readings" in answer([best, nearly]).trust
    assert stated_odds([best, nearly]) == pytest.approx([0.5, 0.5])
    assert stated_odds([uneven, nearly]) == pytest.approx(odds([uneven, nearly]))
    for evidence in (-1, 1):
        undecided = replace(twin, log_evidence=best.log_evidence + evidence)
        trust = answer([uneven, undecided]).trust
        assert trust.startswith(UNDECIDED)
        assert "1 other pose cannot be ruled out" in trust
        assert ("turned least" in trust) == (evidence > 0)
    worse = replace(twin, log_evidence=best.log_evidence - 1.1 * UNDECIDED_LOG_EVIDENCE)
    assert answer([uneven, worse]).trust.startswith(AT_REST)
    # of poses that were not fitted nobody knows whether they are as likely
    assert [row["odds"] for row in pose_table([best, twin])] == ["50 %", "50 %"]
    lone = [replace(best, left_out=3)]
    assert [row["odds"] for row in pose_table(lone)] == [EMPTY_CELL]
    assert "Of the 4 poses that the search found, 1 was fitted" in answer(lone).trust
    assert "that the search found" not in answer([best, twin]).trust
    # and a fit that has not come to rest is not to be used, nor has it odds
    restless = answer([replace(uneven, at_rest=False), nearly])
    assert "so that the odds of poses mean little" in restless.trust
    assert restless.trust.startswith(NOT_AT_REST)
    assert "register" in restless.command


def test_a_map_that_lies_as_assumed_changes_no_study(magnet, generator, tmp_path):
    """Within its error bars; controls: it is displaced by ten of them, or a sensor reads more, and
    the study does not say so.
    """
    data = measured(truth(generator, 0.0), generator, Rotation.identity(), np.zeros(3))
    best = register(magnet, data, Session.open(tmp_path))[0]
    own = best.instrument
    assert not answer([best]).changes_study
    for changes in ({"translation_m": tuple(own.translation_m + 10 * best.translation_sd_m)},
                    {"gain": (10 * best.probe.gain, 0.0, 0.0)},
                    {"field_axes": ("y", "x", "z")}):
        again = replace(best, instrument=own.with_(**changes))
        assert answer([again]).changes_study
        # a study that states that already is confirmed
        assert not answer([again], assumed=again.instrument).changes_study
    # what contradicts the overlap with another map is said, with what else is doubted
    apart = (Term("along_z", "m", 3e-4, 5e-5),)
    for doubted in ((), (Term("gain of Bx", "", 0.05, 0.003),)):
        trust = answer([replace(best, apart=apart, doubts=doubted)], name="fringe").trust
        assert trust.startswith("No.")
        assert trust.count("wants map fringe 0.300\u00a0±\u00a00.050\u00a0mm along z") == 1
        assert ("gain of Bx by" in trust) == bool(doubted)
    # a map that lies where the study says but is not explained is for the study to explain
    unexplained = replace(best, chi2=50.0)
    assert "diagnose STUDY" in answer([unexplained]).command
    far = own.with_(translation_m=(0.0, 0.0, 0.02))
    assert "diagnose DIR/study.registered.toml" in answer([unexplained], assumed=far).command


SAG_M, NEIGHBOUR_M = 1e-4, 0.08


@pytest.mark.parametrize(("keys", "amplitudes"), [
    (f'[[uncertain]]\nname = "sag"\nsd = {SAG_M}\nchange = {{"instrument.arm_sag_m" = 1.0}}', 1),
    (f"[[external.neighbours]]\nz_m = {NEIGHBOUR_M}", 0)])
def test_what_the_study_leaves_open_beside_its_blocks_is_in_the_bars(
    magnet, generator, tmp_path, keys, amplitudes
):
    """The arm sags by the standard deviation that is stated, or the blocks of a neighbour deviate
    by that of the prior, of which magpylib knows. Control: none of it is open, and the pose is off
    by many of its error bars: one stands on the sag, or on the nominal neighbour.
    """
    study = parse_study(tomllib.loads(f"{TEXT}\n{keys}"))
    middle = np.array([0.0, 0.0, 0.045])
    places = GRID - middle
    places[:, 1] -= amplitudes * SAG_M * (GRID[:, 2] / GRID[:, 2].max())**2
    field = truth(generator).getB(places)
    if not amplitudes:
        field += truth(generator).getB(places - [0.0, 0.0, NEIGHBOUR_M])
    data = field_map(GRID, field + NOISE_T * generator.standard_normal(field.shape))

    def distances(of):
        best = register(of, data, Session.open(tmp_path))[0]
        return best, np.abs(np.concatenate([
            (best.middle_m - GRID.mean(axis=0) + middle) / best.translation_sd_m,
            turn_from_axes(best.instrument) / best.rotation_sd_rad]))

    best, off = distances(build_magnet(study))
    assert best.at_rest
    assert best.chi2 < 1.2  # of 1200 readings: 1 +- 0.04
    assert off.max() < 4
    known = build_magnet(study.with_(uncertain=())) if amplitudes else magnet
    best, off = distances(known)
    assert off.max() > 20


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_signs_that_are_all_reversed(magnet, generator, tmp_path, sign):
    """They look like half a turn, which reverses this magnet's field. Control: the right signs."""
    data = measured(truth(generator, 0.0), generator, Rotation.identity(), np.zeros(3))
    data["B_T"] *= sign
    trust = answer(register(magnet, data, Session.open(tmp_path))).trust
    assert trust.startswith(AT_REST)
    assert ("whose readings all have the other sign" in trust) is (sign < 0)


def test_sensors_that_a_map_does_not_have_are_not_in_its_table(magnet, generator, tmp_path):
    data = measured(truth(generator, 0.0), generator, Rotation.identity(), np.zeros(3))
    best = register(magnet, data, Session.open(tmp_path))[0]
    assert {row["of the probe"] for row in probe_table(best)} >= {"gain of Bx", "gain of By"}
    alone = replace(best, rms_T=np.array([1e-5, np.nan, np.nan]))
    assert not any(name in row["of the probe"] for row in probe_table(alone)
                   for name in ("of By", "of Bz", "the By", "the Bz", "By sees", "Bz sees"))


@pytest.mark.parametrize("scale", [0.2, 1.0])
def test_what_a_map_tells_together_only_is_said_once(magnet, generator, tmp_path, scale):
    """In the middle the field is nearly uniform along x: of the sensors across it, how they see
    each other is told by its small rest. Control: the whole bore tells them apart. Bars of either
    map hold.
    """
    points = scale * (GRID - GRID.mean(axis=0))
    mixing = np.eye(3)
    mixing[0, 2], mixing[2, 0] = 0.02, -0.01
    field = truth(generator).getB(points) @ mixing.T
    data = field_map(points, field + NOISE_T * generator.standard_normal(field.shape))
    found = register(magnet, data, Session.open(tmp_path))
    best, pair = found[0], "turn of the Bx sensor towards z and turn of the Bz sensor towards x"
    said = " ".join(sentences(found))
    assert said.count(pair) == (scale < 1)
    summary = registration_summary(found)["poses"][0]
    assert bool(summary["trade_offs"]) == (scale < 1)
    sd = np.sqrt(np.diag(best.covariance))
    for name, right in (("crosstalk_xz", 0.02), ("crosstalk_zx", -0.01)):
        number = NAMES.index(name)
        assert best.instrument.crosstalk[name[-2:]] == pytest.approx(right, abs=4 * sd[number])
    # of the table, too, each bar is its own
    bars = {row["of the probe"]: float(re.search(r"±\s*([\d.]+)", row["value"])[1])
            for row in probe_table(best)}
    assert bars["Bx sees Bz"] == pytest.approx(1e3 * sd[NAMES.index("crosstalk_xz")], rel=0.06)
    assert bars["Bz sees Bx"] == pytest.approx(1e3 * sd[NAMES.index("crosstalk_zx")], rel=0.06)


def test_a_map_in_mm_is_refused_before_the_search(magnet, generator, tmp_path):
    in_mm = field_map(1e3 * GRID, generator.standard_normal(GRID.shape))
    with pytest.raises(MeasurementError, match=r"Are they in millimetres\? Then set instrument"):
        register(magnet, in_mm, Session.open(tmp_path))


def test_a_mirrored_magnet_is_refused(magnet, generator, tmp_path):
    """A dipole whose field turns by 30 degrees along z is not its mirror image.

    Straight dipoles are.
    """
    turned = build_magnet(parse_study(tomllib.loads(TEXT.replace("rings = 2\n", "") + """
[[array.ring]]
[[array.ring]]
first_block_angle_deg = 30
first_magnetization_angle_deg = 30
""")))
    shift = np.array([0.001, 0.0, -0.045])
    straight, helical = truth(generator), truth(generator, twist_deg=30.0)
    mirror = np.array([1.0, 1.0, -1.0])

    def poses(study_magnet, field):
        read = field + NOISE_T * generator.standard_normal(field.shape)
        return coarse_poses(study_magnet, GRID, read, np.ones_like(GRID, bool))

    def mirrored(source):
        return -source.getB((GRID + shift) * mirror) * mirror

    assert poses(turned, helical.getB(GRID + shift))
    assert poses(magnet, mirrored(straight))
    with pytest.raises(MeasurementError, match="mirror image"):
        poses(turned, mirrored(helical))


def test_open_keys_and_probe(magnet, generator, tmp_path):
    """A magnet 1 % longer than drawn, and a probe that is rolled and skewed."""
    mixing = np.eye(3) + np.array([[0, -0.02, 0], [0.02, 0, 0.004], [0, 0, 0]])
    data = measured(truth(generator, 0.002, 1.01), generator, Rotation.from_rotvec([0, 0, 0.0]),
                    np.array([0.0, 0.0, -0.04]), mixing)
    tight = magnet.with_(prior__magnitude_sd=0.003, prior__direction_sd_deg=0.6)
    best = register(tight, data, Session.open(tmp_path), open_keys=[
        OpenKey("array.ring_length_m", 5e-4)])[0]
    value, sd = best.open_keys["array.ring_length_m"]
    assert value == pytest.approx(0.0303, abs=max(4 * sd, 2e-5))
    assert sd < 2e-4
    crosstalk = best.instrument.crosstalk
    assert crosstalk["yz"] + crosstalk["zy"] == pytest.approx(0.004, abs=1.5e-3)
    shown = {row["of the probe"]: row["value"] for row in probe_table(best)}
    assert len(shown) == 21  # six of crosstalk; gain, offset and three places of each sensor
    closed = register(tight, data, Session.open(tmp_path))[0]
    assert closed.log_evidence < best.log_evidence - 5  # control: without the key it fits worse
    with pytest.raises(StudyError, match=r"array\.ring_length"):
        register(tight, data, Session.open(tmp_path), open_keys=[OpenKey("array.ring_length", 1.0)])


@pytest.mark.parametrize(("keys", "said"), [
    ([OpenKey("instrument.length_unit_m", 0.1)], "on which the readings depend.*without effect"),
    ([OpenKey("mesh.block_size_m", 1e-3)], "on which the readings depend.*without effect"),
    ([OpenKey("prior.magnitude_sd", 1e-3)], "on which the readings depend.*without effect"),
    ([OpenKey("array.ring_length_m", 1e-4)] * 2, "open once"),
    ([OpenKey("array.remanence", 0.02)],
     r"the key of a number; instead received `remanence`, which is none. Did you mean `remanence_T`"
     ),
    ([OpenKey("array.rings", 1.0)], r"array\.rings=1 of --fit .*A whole number cannot be fitted"),
    ([OpenKey("array.remanence_T", 100.0)], r"array\.remanence_T=100 of --fit .* smaller"),
])
def test_open_keys_that_cannot_be_fitted(magnet, generator, tmp_path, keys, said):
    data = measured(truth(generator), generator, Rotation.identity(), np.array([0.0, 0.0, -0.045]))
    steps = []
    with pytest.raises(StudyError, match=said):
        register(magnet, data, Session.open(tmp_path), open_keys=keys, most=1, say=steps.append)
    assert bool(steps) == ("depend" in said)  # all others are refused before the search


def test_an_update_after_a_registration_is_no_surer_than_it_may_be(magnet, generator, tmp_path):
    """Blocks, pose and probe are in error as their priors say; the truth is magpylib's.

    chi² per magnetization, with all correlations, is 1 with a standard deviation of 0.2.
    """
    source = truth(generator)
    mixing = np.eye(3) + np.diag(3e-3 * generator.standard_normal(3)) + 0.01 * (
        1 - np.eye(3)) * generator.standard_normal((3, 3))
    data = measured(source, generator, Rotation.from_rotvec([0.01, -0.005, 0.02]),
                    np.array([1e-3, -5e-4, -0.045]), mixing)
    magnetizations = np.ravel([polarization_of(each) for each in source.sources]) / MU_0
    best = min(register(magnet, data, Session.open(tmp_path)),  # the magnet turned over is alike
               key=lambda each: np.linalg.norm(each.instrument.rotation_rad))
    # the probe is that before the map, the pose is found
    assert best.study.instrument.gain == Instrument().gain != best.instrument.gain
    assert best.study.instrument.translation_m == best.instrument.translation_m
    assert best.study.instrument_sd.gain == ProbePrior.gain

    def chi2(study):
        posterior = infer(magnet.with_study(study), data, Session.open(tmp_path)).posterior
        off = magnetizations - posterior.mean
        return float(off @ np.linalg.solve(posterior.covariance, off)) / len(off)

    assert chi2(best.study) < 1.8
    # negative control: pose and probe are taken for exact
    assert chi2(best.study.with_(instrument=best.instrument, instrument_sd=InstrumentSd())) > 20


def test_what_is_open_after_a_registration():
    """Ten of its error bars, within what such a table may say; a pose that is stated stays."""
    prior_sd, sd = np.repeat([0.04, 0.1], 3), np.array([2e-4, 1e-4, 0.03, 1e-3, 3e-3, 1e-4])
    probe = ProbePrior(gain=0.01)
    opened = probe.opened(InstrumentSd(drift_T=1e-4), sd, prior_sd, total=False)
    # the place along z is not determined: it is as open as what is
    assert opened == InstrumentSd(
        translation_m=2e-3, rotation_rad=0.03, crosstalk=0.03, gain=0.01, offset_T=1e-3,
        sensor_position_m=1e-4, drift_T=1e-4)
    stated = InstrumentSd(translation_m=5e-3, rotation_rad=0.04)
    assert probe.opened(stated, sd, prior_sd, total=True) == stated.with_(
        gain=0.01, offset_T=1e-3)
    # what is stated is known about another place: that of the map itself needs ten of its bars
    near = probe.opened(InstrumentSd(translation_m=1e-4), sd, prior_sd, total=False)
    assert near.translation_m == 2e-3
    narrow = probe.opened(InstrumentSd(), 1e-3 * sd, prior_sd, total=False)
    assert (narrow.translation_m, narrow.rotation_rad) == (1e-3, 0.01)
    wide = probe.opened(InstrumentSd(), 30 * sd, 1e3 * prior_sd, total=False)
    assert (wide.translation_m, wide.rotation_rad) == (0.01, 0.1)


def test_every_pose_has_its_own_derivatives(magnet, generator, tmp_path):
    """Equal poses of an ideal dipole find the same length, whichever is fitted first."""
    data = measured(truth(generator, 0.0, 1.01), generator, Rotation.identity(),
                    np.array([0.0, 0.0, -0.04]))
    found = register(magnet.with_(prior__magnitude_sd=1e-3), data, Session.open(tmp_path),
                     open_keys=[OpenKey("array.ring_length_m", 5e-4)])
    assert len(found) > 1
    for each in found:
        value, sd = each.open_keys["array.ring_length_m"]
        assert value == pytest.approx(0.0303, abs=max(4 * sd, 2e-5))
        assert each.at_rest


def test_a_large_map_is_fitted_by_a_few_readings_first(magnet, generator, tmp_path, monkeypatch):
    """All readings decide: the pose is that of a fit of all of them from the start."""
    side = np.linspace(-0.004, 0.004, 9)
    points = np.array([(x, y, z) for x in side for y in side
                       for z in np.linspace(-0.02, 0.02, 11)])
    turn, middle = Rotation.from_rotvec([0.02, -0.03, 0.04]), np.array([8e-4, -5e-4, 0.012])
    blocks = truth(generator)
    field = turn.inv().apply(blocks.getB(turn.apply(points) + middle))
    data = field_map(points, field + NOISE_T * generator.standard_normal(field.shape))
    counts, rest = [], PoseFit._come_to_rest
    left, largest = [], pose_fit.largest_directions

    def of_largest(columns, least):
        found = largest(columns, least)
        left.append(np.linalg.norm(columns - (columns @ found) @ found.T, 2))
        return found

    def counted(self, *arguments):
        counts.append(len(self.points))
        return rest(self, *arguments)

    monkeypatch.setattr(PoseFit, "_come_to_rest", counted)
    monkeypatch.setattr(pose_fit, "largest_directions", of_largest)
    found = register(magnet, data, Session.open(tmp_path), most=1)[0]
    assert counts[0] < len(points) / 2
    assert counts[1] == len(points)
    monkeypatch.setattr(PoseFit, "_few", None)
    whole = register(magnet, data, Session.open(tmp_path), most=1)[0]
    assert (np.abs(found.middle_m - whole.middle_m) < 0.1 * whole.translation_sd_m).all()
    # both end when chi-squared of 2700 decreases by less than a thousandth
    assert found.log_evidence == pytest.approx(whole.log_evidence, abs=1.0)
    assert found.translation_sd_m == pytest.approx(whole.translation_sd_m, rel=0.02)
    assert (np.abs(found.middle_m - middle) < 4 * found.translation_sd_m).all()
    # combinations of blocks that all readings together show are not left out: a tenth of the noise
    # of each, which was, are 5 noises of these
    assert max(left) < 0.2 * NOISE_T


def test_readings_that_the_study_excludes_are_not_fitted(magnet, generator, tmp_path):
    """A spike of 0.1 T, and a noise that the map states, not the study."""
    data = measured(truth(generator), generator, Rotation.identity(), np.array([0.0, 0.0, -0.045]))
    data["B_T"][24] += 0.1  # on a line that is not held out
    spoiled = register(magnet, data, Session.open(tmp_path))[0]
    excluding = magnet.with_(inference=magnet.study.inference.with_(excluded_readings=[25]))
    found = register(excluding, data, Session.open(tmp_path))[0]
    assert np.nanmax(found.rms_T) < 1.3 * NOISE_T < np.nanmax(spoiled.rms_T)
    data["sigma_T"] = data["B_T"].copy(data=np.full_like(data["B_T"].values, 2 * NOISE_T))
    noisier = register(excluding.with_(noise=None), data, Session.open(tmp_path))[0]
    # twice the noise makes error bars up to twice as wide; the prior of blocks holds the rest
    assert (noisier.translation_sd_m > found.translation_sd_m).all()
    del data["sigma_T"]
    with pytest.raises(StudyError, match="noise"):
        register(excluding.with_(noise=None), data, Session.open(tmp_path))


def test_the_command_writes_a_study_that_infers(generator, tmp_path, capsys):
    (tmp_path / "study.toml").write_text(TEXT)
    data = measured(truth(generator), generator, Rotation.from_rotvec([0.01, 0.0, 0.02]),
                    np.array([0.0005, 0.0, -0.045]))
    write_map(data, tmp_path / "map.csv")
    arguments = [str(tmp_path / "study.toml"), "--measurements", str(tmp_path / "map.csv")]
    assert main(["register", *arguments, "-o", str(tmp_path / "out")]) == 0
    assert "middle of the map lies at" in capsys.readouterr().err
    page = (tmp_path / "out" / "registration.html").read_text()
    assert "Where does the map lie" in page
    for name in ("z in mm", "about z in mrad"):  # rows of a table of few poses
        assert re.search(f"<th[^>]*>{name}</th>", page)
    summary = json.loads((tmp_path / "out" / "registration.json").read_text())
    assert sum(pose["odds"] for pose in summary["poses"]) == pytest.approx(1.0)
    registered = read_study(tmp_path / "out" / "study.registered.toml")
    assert np.abs(registered.instrument.translation_m).max() > 0.03
    assert main(["infer", str(tmp_path / "out" / "study.registered.toml"), *arguments[1:],
                 "-o", str(tmp_path / "inferred"), "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)["scores"]
    held_out = next(score for score in scores if score["part"] == "held out")
    assert 0.5 < held_out["chi2_posterior"] < 2.0
    with pytest.raises(SystemExit, match="2"):
        main(["register", *arguments, "-o", str(tmp_path / "x"), "--fit", "array.rings"])
    for options in (["--fit", "array.remanence_T=0.02", "--fit", "array.remanence_T=0.01"],
                    ["--alternative", "array.remanence_T=0.02,array.remanence_T=0.01"]):
        with pytest.raises(SystemExit, match="2"):
            main(["register", *arguments, "-o", str(tmp_path / "x"), *options])


def test_turn_from_axes_is_what_remains_beside_right_angles():
    small = np.array([1e-3, -2e-3, 5e-4])
    for axes in ("xyz", "zxy", "yzx"):  # turns by 120 degrees have rotation vectors of odd numbers
        frame = np.eye(3)[:, ["xyz".index(axis) for axis in axes]]
        turned = Rotation.from_rotvec(small) * Rotation.from_matrix(frame)
        instrument = Instrument(rotation_rad=tuple(turned.as_rotvec()))
        assert list(axes_of_map(instrument).values()) == list(axes)
        np.testing.assert_allclose(turn_from_axes(instrument), small, atol=1e-12)
    half = Rotation.from_rotvec(small) * Rotation.from_rotvec([np.pi, 0, 0])
    np.testing.assert_allclose(turn_from_axes(Instrument(
        rotation_rad=tuple(half.as_rotvec()))), small, atol=1e-12)


def test_of_equal_poses_the_least_turned_one_is_first():
    def pose(log_evidence, turn):
        return SimpleNamespace(log_evidence=log_evidence, instrument=Instrument(
            rotation_rad=tuple(Rotation.from_euler("x", turn, degrees=True).as_rotvec())))

    half, straight = pose(-7.0, 180), pose(-7.0 - UNDECIDED_LOG_EVIDENCE / 2, 1)
    worse, near = pose(-7.0 - 1.1 * UNDECIDED_LOG_EVIDENCE, 0), pose(-9.0, 0.5)
    assert least_turned_first([worse, half, straight]) == [straight, half, worse]
    # negative controls: what the readings tell apart stays in the order of its probability, and of
    # two poses in the same axes the likelier one is first
    assert least_turned_first([half, worse]) == [half, worse]
    assert least_turned_first([near, half, straight]) == [straight, half, near]


@pytest.mark.parametrize(("components", "total", "said"), [
    (3, False, "halbach-fe check"), (1, False, "Name its column B_T"), (1, True, "places in the")])
def test_what_to_do_with_a_map_that_no_pose_explains(components, total, said):
    """`check` needs several components, and only one alone can have a wrong name; |B| has none."""
    advice = _after_no_pose(components, total)
    assert said in advice
    assert "another magnet" in advice


def test_a_probe_that_another_map_has_found_keeps_what_changes_from_map_to_map():
    first = SimpleNamespace(total=False, probe=ProbePrior(1e-3, 2e-4, 1e-5, 2e-5))
    stated = InstrumentSd(offset_T=5e-3)
    assert _of_known_probe(first, stated) == ProbePrior(1e-3, 2e-4, 5e-3, 2e-5)
    of_magnitude = SimpleNamespace(total=True, probe=ProbePrior(0.0, 2e-4, 1e-5, 0.0))
    found = _of_known_probe(of_magnitude, InstrumentSd())
    assert found == ProbePrior(gain=2e-4)  # no term without any freedom


def test_trial_poses_may_lie_in_the_winding_of_a_coil(generator, tmp_path):
    """Around the magnet, where no reading is: the search asked for the field there, and ended."""
    study = cuboids.STUDY.with_(external={"coils": [
        {"kind": "round", "radius_m": 0.03, "section_m": [0.05, 0.05], "centre_m": [0, 0, 0.25],
         "current_A": 10.0}]})
    own = build_magnet(cuboids.STUDY)
    nominal = np.array([np.array(one.easy_axis) * one.remanence for one in own.blocks])
    shown = cuboids.field(cuboids.STUDY, nominal, cuboids.CIRCLES)
    data = field_map(cuboids.CIRCLES, shown + cuboids.NOISE_T * generator.standard_normal(
        shown.shape))
    (found, *_) = register(build_magnet(study), data, Session.open(tmp_path))
    assert np.isfinite(found.middle_m).all()


def test_a_map_beside_neighbouring_magnets_is_found(generator, tmp_path):
    """The search left out what the study says of them, and refused the map. The second neighbour
    is reversed, so that the map lies nowhere else; the blocks are magpylib's.
    """
    study = cuboids.STUDY.with_(external={"neighbours": [
        {"z_m": 0.25}, {"z_m": -0.25, "factor": -1.0}]})
    own, turn = build_magnet(cuboids.STUDY), Rotation.from_euler("x", 180, degrees=True)
    nominal = np.array([np.array(one.easy_axis) * one.remanence for one in own.blocks])
    shift = np.array([0.0, 0.0, 0.03])
    places = turn.apply(cuboids.CIRCLES) + shift
    shown = turn.inv().apply(sum(
        factor * cuboids.field(cuboids.STUDY, nominal, places - [0.0, 0.0, z])
        for z, factor in ((0.0, 1.0), (0.25, 1.0), (-0.25, -1.0))))
    data = field_map(cuboids.CIRCLES, shown + cuboids.NOISE_T * generator.standard_normal(
        shown.shape))
    (found,) = register(build_magnet(study), data, Session.open(tmp_path))
    assert found.explains
    assert found.middle_m == pytest.approx(shift, abs=3e-4)
    with pytest.raises(MeasurementError, match="one that some pose of the magnet explains"):
        register(own, data, Session.open(tmp_path))  # negative control
