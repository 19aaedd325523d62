"""Answers that a good chi-squared alone does not make right: terms far from what was known before.

Truth is by magpylib: an MRI dipole of cubes, and a quadrupole of sectors.
"""

from __future__ import annotations

import json
import tomllib
from contextlib import nullcontext
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.api import diagnose, multipoles
from halbach_fe.cli import main
from halbach_fe.core.errors import HalbachWarning, MeasurementError
from halbach_fe.core.progress import Pace
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.pose_result import ProbePrior
from halbach_fe.inference.pose_search import coarse_poses
from halbach_fe.inference.posterior_files import read_posterior, write_inference
from halbach_fe.inference.registration import (
    axes_of_map,
    nearest_right_angles,
    register,
    turn_from_axes,
)
from halbach_fe.magnets import to_magpylib
from halbach_fe.measurement.doubted_terms import (
    ALL_AXES,
    ALL_BLOCKS,
    Term,
    doubted_from,
    doubts,
    doubts_in_words,
    factor_in_words,
    known_factor,
    likeness_of,
    trade_offs,
    trade_offs_in_words,
    words_of,
)
from halbach_fe.measurement.field_map import (
    directed,
    field_map,
    is_undirected,
    points_of,
    read_map,
    undirected,
    write_map,
)
from halbach_fe.measurement.map_check import check_map
from halbach_fe.measurement.probe_law import NAMES, in_si_and_magnet_axes
from halbach_fe.report.diagnosis_answer import answer as diagnosis_answer
from halbach_fe.report.inference_answer import answer as inference_answer
from halbach_fe.report.multipoles_page import answer as multipoles_answer
from halbach_fe.report.registration_page import (
    AT_REST,
    DOUBTED,
    USE_ANY,
    answer,
    pose_table,
    registration_summary,
    rivals,
)
from halbach_fe.solver.session import Session
from halbach_fe.study.measurement_keys import Instrument, InstrumentSd
from halbach_fe.study.reader import parse_study
from tests.support import cube_dipole
from tests.support.cube_dipole import GRID, TEXT, component, noisier

QUADRUPOLE = """
name = "quadrupole"
[array]
multipole_order = 2
rings = 1
blocks_per_ring = 8
inner_radius_m = 0.02
outer_radius_m = 0.04
ring_length_m = 0.03
remanence_T = 1.3
recoil_permeability = 1.0
[array.block]
shape = "sector"
[mesh]
block_size_m = 0.01
[observation]
quantity = "flux_density"
[observation.positions]
kind = "circles"
radius_m = 0.01
angles = 8
[[noise.regions]]
name = "bore"
sigma_T = 2e-4
[prior]
magnitude_sd = 0.01
direction_sd_deg = 0.6
common_mode_sd = 0.01
"""


@pytest.fixture(scope="module")
def magnet():
    return build_magnet(parse_study(tomllib.loads(TEXT)))


def quadrupole_field(points, sizes=(1.3,) * 8):
    """A ring of eight sectors by magpylib, of these remanences in T."""
    return magpylib.Collection(*(magpylib.magnet.CylinderSegment(
        dimension=(0.02, 0.04, 0.03, 45.0 * slot - 22.5, 45.0 * slot + 22.5),
        polarization=size * np.array([np.cos(angle), np.sin(angle), 0.0]))
        for slot, size, angle in zip(range(8), sizes, np.radians(135.0 * np.arange(8)),
                                     strict=True))).getB(points)


def quadrupole_map(generator, factor, spread=0.01, turn_rad=0.0):
    """The ring with blocks 1 % off, turned about z, read with a factor."""
    sizes = 1.3 * (1 + spread * generator.standard_normal(8))
    points = np.stack(np.meshgrid(0.004 * np.arange(-2, 3), 0.004 * np.arange(-2, 3),
                                  0.006 * np.arange(-3, 4), indexing="ij"), -1).reshape(-1, 3)
    turn = Rotation.from_rotvec([0, 0, turn_rad])
    field = factor * turn.apply(quadrupole_field(turn.inv().apply(points), sizes))
    return field_map(points, field + 2e-4 * generator.standard_normal(field.shape))


def test_the_law_doubts_one_of_500_fits(generator):
    """Whatever the number of terms. Control: priors that are half as wide are doubted often."""
    for count in (1, 30, 1000):
        draws = generator.standard_normal((4000, count))
        rate = float((np.abs(draws).max(axis=1) > doubted_from(count)).mean())
        # 8 of 4000 are expected; 20 or more have a probability of 3e-4
        assert rate < 20 / 4000
        assert (2 * np.abs(draws).max(axis=1) > doubted_from(count)).mean() > 0.05
    near, far = Term("gain of Bx", "", 0.009, 0.003), Term("offset of Bz", "T", -0.02, 1e-3)
    assert doubts([near, far]) == (far,)
    assert doubts([near, replace(far, value=3e-3)]) == ()
    # the same term among more of them has to be farther away
    some = Term("gain of Bx", "", 0.0126, 0.003)  # 4.2 standard deviations
    assert doubts([some], 29) == (some,)
    assert doubts([some], 2000) == ()
    assert doubts([replace(far, prior_sd=0.0)]) == ()  # not free
    said = doubts_in_words([far])
    assert said.startswith("To agree with the readings, these")  # it may stand alone
    assert "offset of Bz by \u221220\u00a0mT, where ±\u00a01\u00a0mT was known before" in said
    assert "(20 standard deviations)" in said
    assert doubts_in_words([]) == ""


def test_every_term_has_words():
    assert [words_of(name) for name in NAMES[:7]] == [
        ("place along x", "m"), ("place along y", "m"), ("place along z", "m"),
        ("turn about x", "rad"), ("turn about y", "rad"), ("turn about z", "rad"),
        ("turn of the Bx sensor towards y", "rad")]
    assert words_of("fringe.gain_z") == ("gain of Bz (fringe)", "")
    assert words_of("fringe.stage_shift_x_m") == ("place along x of the stage (fringe)", "m")
    assert words_of("sensor_x_z_m") == ("place of the Bx sensor along z", "m")
    assert words_of("drift_y_T") == ("drift of By", "T")
    assert len({words_of(name)[0] for name in NAMES}) == len(NAMES)


def test_terms_that_readings_hardly_tell_one_by_one():
    """Readings of the sum of two terms, and of the third; controls: they tell the two apart, or so
    well that it does not matter, or hardly anything of their sum.
    """
    names, prior_sd = ("a", "b", "c"), np.array([0.1, 0.03, 0.03])

    def told(*rows):
        design = np.array([row for row, _ in rows]) / np.array([sd for _, sd in rows])[:, None]
        return trade_offs(names, np.linalg.inv(design.T @ design + np.diag(prior_sd**-2)), prior_sd)

    together, third = ((1, 1, 0), 1e-3), ((0, 0, 1), 1e-3)
    weakly = ((1, 0, 0), 1e-2)
    assert told(together, third, weakly) == (("a", "b"),)
    assert told(together, third, ((1, 0, 0), 1e-3)) == ()
    assert told(((1, 1, 0), 1e-5), third, ((1, 0, 0), 1e-3)) == ()
    assert told(((1, 1, 0), 5e-2), third) == ()
    # of three of which the sum is told, no two are like each other
    assert told(((1, 1, 1), 1e-3), ((1, 0, 0), 1e-2), ((0, 1, 0), 1e-2), ((0, 0, 1), 1e-2)) == (
        ("a", "b", "c"),)
    said = trade_offs_in_words((("a", "b"), ("c", "d", "e")))
    assert "hardly tells apart a and b; or c, d and e:" in said
    assert trade_offs_in_words(()) == ""


@pytest.mark.parametrize(("factor", "said"), [
    (0.5, "half"), (2.0, "twice"), (-1.0, "opposite"), (1e-3, "taken for mT"),
    (1e-4, "taken for G"), (10.0, "numbers in G were taken for mT")])
def test_a_factor_is_named(factor, said):
    assert said in known_factor(0.98 * factor)
    assert said in factor_in_words(0.98 * factor)
    assert "unit" in factor_in_words(0.7)
    assert known_factor(0.7) == ""
    assert factor_in_words(1.03) == ""  # blocks of another batch


def test_a_map_of_half_the_field_is_no_map_of_the_magnet(magnet, generator, tmp_path):
    """Control: the map itself."""
    good = register(magnet, cube_dipole.read_map(generator), Session.open(tmp_path / "good"))
    assert good[0].doubts == ()
    assert good[0].factor == pytest.approx(1.0, abs=0.02)
    assert answer(good).trust.startswith(AT_REST)
    # so much noise that chi-squared alone says yes
    noisy = build_magnet(parse_study(tomllib.loads(noisier(2e-3))))
    half = register(noisy, cube_dipole.read_map(generator, 0.5, 2e-3), Session.open(tmp_path / "h"))
    assert half[0].explains
    assert half[0].factor == pytest.approx(0.5, abs=0.02)
    said = answer(half)
    assert not said.sound
    assert said.trust.startswith(DOUBTED)
    assert "known before" in said.trust
    assert "times the field expected of the magnet (half)" in said.trust
    assert "unit, the sign and the factor" in said.step
    # the control: where readings are not like the field, no factor is spoken of
    unlike = answer([replace(half[0], likeness=0.1), *half[1:]])
    assert "times the field" not in unlike.trust
    assert "not like the field expected of the magnet" in unlike.trust
    assert "factor" not in unlike.step
    # a probe that is none, in a pose that explains nothing, is nothing to diagnose with
    nothing = replace(half[0], likeness=0.1, chi2=34.0)
    assert answer([nothing]).command.startswith("halbach-fe diagnose STUDY")
    assert answer([replace(nothing, doubts=())]).command.startswith(
        "halbach-fe diagnose DIR/study.registered.toml")  # the control
    assert half[0].likeness > 0.9  # 0.98 by the noise
    assert USE_ANY not in said.trust
    summary = registration_summary(half)["poses"][0]
    assert not summary["sound"]
    assert all(one["prior_sds_away"] > 4 for one in summary["doubts"])
    # a study that says that of the probe's gain little is known does not doubt it
    known = noisy.with_(instrument_sd=InstrumentSd(gain=0.1))
    wide = register(known, cube_dipole.read_map(generator, 0.9, 2e-3), Session.open(tmp_path / "w"))
    assert wide[0].doubts == ()
    assert ProbePrior.of(InstrumentSd()) == ProbePrior()


def test_half_a_field_weakens_the_blocks(generator, tmp_path):
    """Of a quadrupole whose blocks may differ together; infer says it too. Control: the map."""
    magnet = build_magnet(parse_study(tomllib.loads(QUADRUPOLE)))
    tight = ProbePrior(gain=1e-5)
    found = register(magnet, quadrupole_map(generator, 0.5), Session.open(tmp_path), tight)
    weaker = next(one for one in found[0].doubts if one.name.startswith("strength of all"))
    assert weaker.value == pytest.approx(-0.5, abs=0.05)
    assert weaker.distance > 20
    assert "% weaker than was known before" in answer(found).trust
    assert answer(found).trust.startswith("No")
    result = infer(magnet, quadrupole_map(generator, 0.5), Session.open(tmp_path / "i"))
    trust = inference_answer(result).trust
    assert "% weaker than was known before" in trust
    assert "(half)" in trust
    assert trust.startswith("No")
    right = infer(magnet, quadrupole_map(generator, 1.0), Session.open(tmp_path / "j"))
    assert right.doubts == ()
    assert "ordered" not in inference_answer(right).trust
    assert "(half)" in result.common_factor
    assert right.common_factor == ""
    # so does diagnose beside a smaller radius, though one sensor's gain is all that is looked for
    of_half, of_all = (diagnosis_answer(diagnose(
        magnet, quadrupole_map(generator, factor), Session.open(tmp_path / f"d{factor}"),
        effects=["gain_x"])) for factor in (0.5, 1.0))
    assert "Or, as well: the readings are" in of_half.said
    assert "times the field expected of the magnet (half)" in of_half.said
    assert "unit, the sign and the factor" in of_half.step
    assert not of_half.sound
    assert "times the field" not in of_all.said


def asks_for_mm(asked):
    """A context in which places far from the magnet are warned of, or nothing is."""
    return pytest.warns(HalbachWarning, match="in mm?") if asked else nullcontext()


def test_readings_that_no_factor_makes_those_of_the_magnet(generator, tmp_path):
    """Places in mm that are taken for m, and exchanged components: a factor would mislead.
    Controls: half the field, and a map that is right but for noise ten times as large as stated.
    """
    magnet = build_magnet(parse_study(tomllib.loads(QUADRUPOLE)))
    good = quadrupole_map(generator, 1.0)
    in_mm = field_map(1e3 * points_of(good), good["B_T"].values)
    turned = field_map(points_of(good), good["B_T"].values[:, [1, 2, 0]])
    noisy = field_map(points_of(good), good["B_T"].values
                      + 2e-3 * generator.standard_normal((len(points_of(good)), 3)))
    half = quadrupole_map(generator, 0.5)
    for data, unlike in ((in_mm, True), (turned, True), (half, False), (noisy, False)):
        with asks_for_mm(data is in_mm):
            said = infer(magnet, data, Session.open(tmp_path)).disagreement
        assert "cannot all be right" in said
        assert ("not like the field" in said) == unlike
        assert ("times the field" in said) == (data is half)


def test_a_held_out_map_that_is_unlike_the_magnet(generator, tmp_path):
    """A map in mm that is held out; the map that updates is right. Control: a held-out map of 3 %
    more, which a factor of a unit does not explain.
    """
    magnet = build_magnet(parse_study(tomllib.loads(QUADRUPOLE)))
    good, other = quadrupole_map(generator, 1.0), quadrupole_map(generator, 1.0)
    places = points_of(other) + np.array([1e-4, 0, 0])
    for data, unlike in ((field_map(1e3 * places, other["B_T"].values), True),
                         (field_map(places, 1.03 * other["B_T"].values), False)):
        with asks_for_mm(unlike):
            said = infer(magnet, good, Session.open(tmp_path),
                         validation_map=data).held_out_conflict
        assert "of the held-out map are farther" in said
        assert ("not like the field" in said) == unlike


def test_likeness_is_a_cosine():
    assert likeness_of(np.array([1.0, 2.0]), np.array([-2.0, -4.0])) == pytest.approx(-1.0)
    assert likeness_of(np.array([1.0, 0.0]), np.array([0.0, 1.0])) == 0.0
    assert likeness_of(np.zeros(2), np.ones(2)) == 1.0
    assert "not like" in factor_in_words(1.0, 0.1)
    assert factor_in_words(1.0, 0.9) == ""


def test_terms_that_infer_finds_are_judged_too(generator, tmp_path):
    """A gain of 40 % where 1 % is stated. Control: 1 %."""
    text = QUADRUPOLE + "\n[instrument_sd]\ngain = 0.01\n"
    magnet = build_magnet(parse_study(tomllib.loads(text)))
    off = infer(magnet, quadrupole_map(generator, 1.4), Session.open(tmp_path))
    named = [one.name for one in off.doubts]
    assert any(name.startswith("gain of B") for name in named)
    assert "gain of B" in off.disagreement
    assert infer(magnet, quadrupole_map(generator, 1.01), Session.open(tmp_path / "c")).doubts == ()


@pytest.mark.parametrize(("factor", "turn", "also", "doubted"), [
    (1.02, 0.0, "", [ALL_BLOCKS]), (1.0, 0.01, "", [f"{ALL_AXES} about z"]),
    (1.0, 0.0, "", []), (1.02, 0.0, "\n[instrument_sd]\ngain = 0.02\n", []),
    (1.02, 0.0, "common_mode_sd = 0.02", []),
    (1.0, 0.01, "\n[instrument_sd]\nrotation_rad = 0.05\n", [])])
def test_what_all_blocks_share_is_compared_with_the_prior_of_their_mean(
        factor, turn, also, doubted, generator, tmp_path):
    """A map times 1.02 moves no block by more than three of its standard deviations, but their
    mean, which is known to 1 %/sqrt(8), by 5. A map turned by 10 mrad about z turns all
    magnetizations of the quadrupole back by twice as much: so does a turn of the ring. Controls:
    the map itself, and studies that state how far instrument or batch may be off.
    """
    text = QUADRUPOLE.replace("common_mode_sd = 0.01", also)
    magnet = build_magnet(parse_study(tomllib.loads(text)))
    result = infer(magnet, quadrupole_map(generator, factor, 0.002, turn), Session.open(tmp_path))
    said = inference_answer(result)
    assert [one.name for one in result.shared_doubts] == doubted
    assert said.trust.startswith("Only with care" if doubted else "Yes")
    if doubted:
        term = result.shared_doubts[0]
        expected = factor - 1 if factor != 1 else -2 * turn
        assert term.value == pytest.approx(expected, rel=0.2)
        assert term.distance > 4.5
        assert ("gain of the instrument" in said.trust) == (factor != 1)
        assert f"[instrument_sd] {'rotation_rad' if turn else 'gain'}" in said.trust


@pytest.mark.parametrize(("weak", "sigma_T", "held"), [
    (0.12, 1e-3, True),
    (0.015, 1e-3, False),  # 1.5 standard deviations of its prior
    (0.12, 2e-6, False)])  # the readings alone say where it is
def test_a_block_that_its_prior_holds_back_is_named(
    generator, tmp_path, capsys, weak, sigma_T, held
):
    """One block is weaker than a prior of 1 % allows, and the readings know it to 0.5 % only."""
    magnet = build_magnet(parse_study(tomllib.loads(QUADRUPOLE)))
    source = to_magpylib(magnet)
    source[2].polarization = (1 - weak) * source[2].polarization
    points = 0.6 * GRID
    result = infer(magnet, field_map(points, source.getB(points) + sigma_T * (
        generator.standard_normal(points.shape)), sigma_T), Session.open(tmp_path))
    block = np.linalg.norm(result.posterior.mean[6:9]) / np.linalg.norm(
        magnet.nominal_magnetization[6:9])
    said = inference_answer(result)
    assert [one.name for one in result.held_back][:1] == ["block r01s03"] * held
    if held:
        assert not said.sound
        assert block > 1 - weak + 0.005  # it is held back indeed
        assert said.trust.startswith("Only in part. Block")
        assert "r01s03" in said.trust
        assert "halbach-fe diagnose" in said.command
    else:
        assert block == pytest.approx(1 - weak, abs=0.01)
        assert "Only in part" not in said.trust
    write_inference(result, tmp_path)
    for known in (result, read_posterior(magnet, tmp_path / "posterior.h5")):
        found = multipoles(magnet, Session.open(tmp_path), posterior=known)
        later = multipoles_answer(found.tables, None, found.disagreement)
        assert later.sound == (not held)
        assert later.trust.startswith("Only in part. Block" if held else "Yes: the update agrees")
    (tmp_path / "study.toml").write_text(QUADRUPOLE)
    assert main(["field", str(tmp_path / "study.toml"), "--from-m", "0", "0", "-0.05", "--to-m",
                 "0", "0", "0.05", "--posterior", str(tmp_path / "posterior.h5"),
                 "-o", str(tmp_path / "field")]) == 0
    assert ("Only in part. Block" in capsys.readouterr().err) == held


def test_a_component_that_was_named_wrong_is_doubted(magnet, generator, tmp_path):
    """Bx under the name of Bz. Control: under its own name."""
    data = cube_dipole.read_map(generator)
    wrong = register(magnet, component(data, "x", "z"), Session.open(tmp_path / "w"), most=2)
    said = answer(wrong)
    assert wrong[0].doubts
    assert not said.sound
    assert said.trust.startswith("No")
    assert "times the field" not in said.trust  # that of another component elsewhere
    assert "--component unknown" in said.step
    # a better chi-squared would not make it right
    pretended = [replace(each, chi2=1.0, at_rest=True) for each in wrong]
    assert answer(pretended).trust.startswith(DOUBTED)
    assert "turn" in answer(pretended).trust or "offset" in answer(pretended).trust
    # what explains nothing has no odds, nor have the poses that a symmetry makes equal
    assert {row["odds"] for row in pose_table(wrong)} == {"–"}
    assert all(pose["odds"] is None for pose in registration_summary(wrong)["poses"])
    assert "none has odds" in said.trust
    assert "probability" not in said.trust
    for each in wrong:  # axes of a rotation
        assert len({axis[-1] for axis in axes_of_map(each.instrument).values()}) == 3
    right = register(magnet, component(data, "x", "x"), Session.open(tmp_path / "r"), most=2)
    assert right[0].doubts == ()
    assert answer(right).sound


def test_equal_poses_that_explain_nothing_are_equal(magnet, generator, tmp_path):
    """However far apart the evidence of their fits is; control: a pose elsewhere is not."""
    found = register(magnet, cube_dipole.read_map(generator), Session.open(tmp_path))
    best, other = found[:2]
    worse = replace(other, chi2=34.0, log_evidence=best.log_evidence - 350)
    unexplained = [replace(best, chi2=34.0), worse]
    assert rivals(unexplained) == [worse]
    assert "1 other pose predicts the same readings" in answer(unexplained).trust
    assert USE_ANY not in answer(unexplained).trust
    elsewhere = replace(worse, middle_m=other.middle_m + np.array([0, 0, 0.05]))
    assert rivals([unexplained[0], elsewhere]) == []
    assert rivals([best, replace(worse, chi2=1.0)]) == []  # evidence decides where it holds


def test_the_axes_of_a_map_are_those_of_a_rotation(generator):
    """Also where two columns are nearest to the same axis."""
    twisted = Rotation.from_rotvec([0.0, -0.757, 0.0]) * Rotation.from_rotvec([0.5, 0.5, 0.6])
    drawn = Rotation.random(200, random_state=generator.integers(2**31))
    for turn in (twisted, *drawn):
        instrument = Instrument(rotation_rad=tuple(turn.as_rotvec()))
        axes = axes_of_map(instrument)
        assert sorted(axis[-1] for axis in axes.values()) == ["x", "y", "z"]
        assert np.linalg.det(nearest_right_angles(instrument)) == pytest.approx(1.0)
        rest = Rotation.from_rotvec(turn_from_axes(instrument))
        # 62.8 degrees is the farthest from all rotations of a cube (MacKenzie's problem)
        assert rest.magnitude() < np.radians(62.9)


def test_a_component_that_nobody_named_is_found(magnet, generator, tmp_path, capsys):
    data = cube_dipole.read_map(generator)
    rows = np.column_stack([1e3 * GRID, 1e3 * data["B_T"].values[:, 2]])
    (tmp_path / "gauss.txt").write_text("x[mm] y[mm] z[mm] B0[mT]\n" + "\n".join(
        " ".join(f"{value:.6f}" for value in row) for row in rows))
    (tmp_path / "study.toml").write_text(TEXT)
    assert main(["import-map", str(tmp_path / "gauss.txt"), "-o", str(tmp_path / "no.csv")]) == 4
    assert "--component unknown" in capsys.readouterr().err
    assert main(["import-map", str(tmp_path / "gauss.txt"), "--component", "unknown",
                 "-o", str(tmp_path / "map.csv")]) == 0
    assert (tmp_path / "map.csv").read_text().splitlines()[-1].count(",") == 3
    assert is_undirected(read_map(tmp_path / "map.csv"))
    arguments = [str(tmp_path / "study.toml"), "--measurements", str(tmp_path / "map.csv")]
    # no other command takes it for any component
    assert main(["infer", *arguments, "-o", str(tmp_path / "no")]) != 0
    assert "halbach-fe register of this map alone" in capsys.readouterr().err
    out = tmp_path / "out"
    assert main(["register", *arguments, "--most", "2", "-o", str(out)]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "The map is of Bz, with a probability of more than 99.9" in said
    assert "registered_map.csv" in said
    poses = json.loads((out / "registration.json").read_text())["poses"]
    assert poses[0]["component"] == "z"
    assert sum(pose["odds"] for pose in poses) == pytest.approx(1.0)
    found = read_map(out / "registered_map.csv")
    assert not is_undirected(found)
    assert np.isnan(found["B_T"].values[:, :2]).all()
    assert main(["infer", str(out / "study.registered.toml"), "--measurements",
                 str(out / "registered_map.csv"), "-o", str(tmp_path / "inferred")]) == 0


def test_files_keep_that_a_component_is_unknown(tmp_path):
    data = undirected(component(cube_dipole.read_map(np.random.default_rng(1)), "x", "z"))
    data["sigma_T"] = data["B_T"].copy(data=np.full_like(data["B_T"].values, 1e-4))
    for name in ("map.csv", "map.h5"):
        write_map(data, tmp_path / name)
        again = read_map(tmp_path / name)
        assert is_undirected(again)
        np.testing.assert_array_equal(again["B_T"].values, data["B_T"].values)
        named = directed(again, "y")
        np.testing.assert_array_equal(named["B_T"].values[:, 1], data["B_T"].values[:, 2])
        np.testing.assert_array_equal(named["sigma_T"].values[:, 1], 1e-4)
        assert np.isnan(named["B_T"].values[:, [0, 2]]).all()
        for refusing in (check_map, lambda one: in_si_and_magnet_axes(Instrument(), one)):
            with pytest.raises(MeasurementError, match="register of this map alone"):
                refusing(again)
    with pytest.raises(MeasurementError, match="B_T"):
        write_map(data, tmp_path / "map.vtu")
    (tmp_path / "both.csv").write_text("x_m,y_m,z_m,B_T,Bx_T\n0,0,0,1e-3,1e-3\n")
    with pytest.raises(MeasurementError, match="not both"):
        read_map(tmp_path / "both.csv")
    # a comment does not make a component unknown that the header names
    (tmp_path / "named.csv").write_text("# direction: unknown\nx_m,y_m,z_m,Bx_T\n0,0,0,1e-3\n")
    assert not is_undirected(read_map(tmp_path / "named.csv"))


def test_the_search_says_what_is_left(magnet):
    """Control: a search that takes no time says nothing."""
    data = cube_dipole.read_map(np.random.default_rng(2))
    training = np.ones_like(GRID, bool)
    now, slow, quick = [0.0], [], []

    def clock():
        now[0] += 6.0
        return now[0]

    coarse_poses(magnet, GRID, data["B_T"].values, training, pace=Pace(slow.append, clock=clock))
    assert any("rotations by right angles compared: " in line and " of 24, about" in line
               and "left" in line for line in slow)
    coarse_poses(magnet, GRID, data["B_T"].values, training,
                 pace=Pace(quick.append, clock=lambda: 0.0))
    assert quick == []
