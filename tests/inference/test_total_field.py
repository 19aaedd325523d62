"""Maps of |B| alone: truth by magpylib, updates by its length, and what |B| cannot tell."""

from __future__ import annotations

import copy
import functools
import re
from types import SimpleNamespace

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.campaign_readings import read_campaign
from halbach_fe.inference.infer import infer
from halbach_fe.inference.pose_fit import PoseFit
from halbach_fe.inference.posterior_files import write_inference
from halbach_fe.inference.registration import register
from halbach_fe.measurement.campaign_maps import maps_of
from halbach_fe.measurement.field_map import field_map, points_of, total_field_map
from halbach_fe.report.inference_answer import answer
from halbach_fe.report.registration_page import sentences
from halbach_fe.response.block_variation import Deviations
from halbach_fe.response.response_matrix import StoredMatrix
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study
from tests.inference.test_infer import iron_campaign
from tests.support.cuboids import DOCUMENT
from tests.support.pages import page, write_result

NOISE_T = 1e-5
AXIS = np.linspace(-0.05, 0.05, 6) + 1e-3
POINTS = np.stack(np.meshgrid(AXIS, AXIS, np.linspace(-0.1, 0.1, 9), indexing="ij"),
                  axis=-1).reshape(-1, 3)


def study_of(order=1, **changes):
    """Two rings of 12 cuboids, a dipole or a quadrupole, of which every fourth z is held out."""
    document = copy.deepcopy(DOCUMENT)
    document["array"] |= {"rings": 2, "multipole_order": order}
    document["inference"] = {"held_out": {"every": 4}}
    document["noise"] = {"regions": [{"name": "all", "sigma_T": NOISE_T}]}
    return parse_study(document | changes)


def cuboids(study, polarizations):
    """The blocks of `study_of` in magpylib, with polarizations (24, 3) in T."""
    found = []
    for block, polarization in zip(build_magnet(study).blocks, polarizations, strict=True):
        angle = np.radians(position_angle_deg(study.array, block.slot))
        turn = Rotation.from_euler("z", angle)
        found.append(magpylib.magnet.Cuboid(
            dimension=(0.05, 0.04, 0.06), orientation=turn,
            position=(0.125 * np.cos(angle), 0.125 * np.sin(angle),
                      (block.z_min + block.z_max) / 2),
            polarization=turn.inv().apply(polarization)))
    return magpylib.Collection(*found)


@functools.cache
def truth(order, seed):
    """Blocks that are 1 % off: magpylib's collection, and M (72,) in A/m."""
    study = study_of(order)
    generator = np.random.default_rng(seed)
    polarizations = np.array([
        block.remanence * (np.array(block.easy_axis) + 0.01 * generator.standard_normal(3))
        for block in build_magnet(study).blocks])
    return cuboids(study, polarizations), polarizations.ravel() / MU_0


def total_map(order, seed, generator, points=POINTS, gain=0.0, offset_T=0.0):
    """A map of |B| with noise, by a probe with a gain and an offset."""
    size = np.linalg.norm(truth(order, seed)[0].getB(points), axis=1)
    return total_field_map(points, (1 + gain) * size + offset_T
                           + NOISE_T * generator.standard_normal(len(points)))


@pytest.mark.parametrize("order", [1, 2])
def test_blocks_are_learnt_from_the_magnitude(order, generator, session):
    """Truth by magpylib. Error bars of blocks, predictions and the field at other points hold."""
    magnet = build_magnet(study_of(order))
    update = infer(magnet, total_map(order, 1, generator), session)
    true = truth(order, 1)
    off = update.posterior.mean - true[1]
    # chi² of 72 values has a standard deviation of 0.17 each; 4 sigma
    assert off @ np.linalg.solve(update.posterior.covariance, off) / 72 == pytest.approx(1, abs=0.7)
    training, held_out = update.scores
    assert training.rms_error_prior_T > 30 * training.rms_error_posterior_T
    assert held_out.chi2_posterior == pytest.approx(1.0, abs=0.7)  # 72 readings: sd 0.17
    assert held_out.coverage95_posterior > 0.85  # of 72: 0.95 +- 0.026
    assert not update.disagreement
    assert set(update.observation.labels) == {"|B|"}
    size = np.linalg.norm(true[0].getB(update.observation.positions), axis=1)
    read = np.abs(update.prediction_posterior.mean - size)
    assert read.max() < 5 * NOISE_T
    places = generator.uniform(-0.05, 0.05, (40, 3))
    columns = Deviations.of(magnet).columns(places)
    error = columns @ update.posterior.mean - true[0].getB(places).ravel()
    # few combinations are open, so that all errors go together: up to 3 of their bars
    assert np.sqrt(np.mean((error / update.posterior.sd_of(columns))**2)) < 3
    assert "All readings are |B|" in answer(update).trust
    said = re.search(r"\|B\| at \(.*?\) mm is ([0-9.]+)", answer(update).said)
    # what lies across the nominal field adds to |B| in second order
    assert float(said[1]) == pytest.approx(1e3 * size.max(), rel=1e-3)
    assert "strongest component" not in answer(update).said


def test_an_uncertain_gain_of_the_magnitude_is_an_open_gain(generator, session):
    """Stated as [instrument_sd] or as [[uncertain]]. Control: a gain that is exact."""
    data = total_map(2, 1, generator, gain=0.01)
    uncertain = {"name": "gain", "sd": 0.01, "change": {
        f"instrument.gain[{axis}]": 1.0 for axis in (1, 2, 3)}}
    opened, stated, exact = (
        infer(build_magnet(study_of(2, **keys)), data, session.within(name)).posterior
        for name, keys in (("open", {"instrument_sd": {"gain": 0.01}}),
                           ("stated", {"uncertain": [uncertain]}), ("exact", {})))
    count = len(exact.mean)
    off = np.abs(stated.mean[:count] - opened.mean[:count]) / opened.sd[:count]
    assert off.max() < 0.3  # at the middle of a change of 1 % it is linear to that
    assert (np.abs(exact.mean - opened.mean[:count]) / exact.sd).max() > 3
    np.testing.assert_allclose(stated.sd[:count], opened.sd[:count], rtol=0.05)


def test_the_nominal_direction_does_not_suffice(generator, session):
    """Negative control: lengths along the nominal field are off |B| by up to 9 µT, those along the
    updated one by less than 0.5 µT.
    """
    magnet, data = build_magnet(study_of(2)), total_map(2, 1, generator)
    field = truth(2, 1)[0].getB(POINTS).ravel()
    size = np.linalg.norm(field.reshape(-1, 3), axis=1)
    first = read_campaign(magnet, maps_of(magnet.study, data)).observation.operator
    update = infer(magnet, data, session).observation.operator
    assert np.abs(first @ field - size).max() > 0.5 * NOISE_T
    assert np.abs(update @ field - size).max() < 0.05 * NOISE_T


def test_a_map_of_one_component_named_the_magnitude_is_found_out(generator, session):
    """Negative control: |Bx| of a dipole's fringe is no |B|."""
    field = np.abs(truth(1, 1)[0].getB(POINTS)[:, 1])
    with pytest.warns(HalbachWarning, match=r"directions of \|B\| .* not come to rest"):
        update = infer(build_magnet(study_of(1)), total_field_map(POINTS, field), session)
    assert update.disagreement


def test_gain_and_offset_of_the_probe_are_single_numbers(generator, session):
    """A gain of 0.3 % and an offset of 20 µT are found; they are no three numbers each."""
    study = study_of(2, instrument_sd={"gain": 0.01, "offset_T": 1e-4})
    update = infer(build_magnet(study), total_map(2, 1, generator, gain=3e-3, offset_T=2e-5),
                   session)
    assert update.terms.names == ("map.gain", "map.offset_T")
    off = (update.terms.change - [3e-3, 2e-5]) / update.terms.sd
    assert np.abs(off).max() < 3.5
    assert update.terms.at_rest
    assert len(set(update.study.instrument.gain)) == 1
    assert not update.disagreement


def test_a_turned_sensor_reads_the_same_and_a_moved_one_does_not(generator, session):
    """The pose turns and moves the points; |B| at them has no direction."""
    turn = Rotation.from_rotvec([0.0, 0.0, 0.02])
    places = turn.apply(POINTS) + np.array([2e-4, 0.0, -3e-4])
    size = np.linalg.norm(truth(2, 1)[0].getB(places), axis=1)
    data = total_field_map(POINTS, size + NOISE_T * generator.standard_normal(len(size)))
    study = study_of(2, instrument_sd={"translation_m": 1e-3, "rotation_rad": 0.02})
    update = infer(build_magnet(study), data, session)
    found = update.study.instrument
    shift, sd = dict(zip(update.terms.names, update.terms.change, strict=True)), dict(
        zip(update.terms.names, update.terms.sd, strict=True))
    middle = (POINTS.max(axis=0) + POINTS.min(axis=0)) / 2
    expected = turn.apply(middle) + np.array([2e-4, 0.0, -3e-4]) - middle
    for number, axis in enumerate("xyz"):
        name = f"map.translation_{axis}_m"
        assert abs(shift[name] - expected[number]) < 4 * sd[name]
    assert abs(found.rotation_rad[2] - 0.02) < 4 * sd["map.rotation_z_rad"]
    assert update.prior_conflict < update.conflict_limit


def test_a_field_that_vanishes_is_said(generator, session):
    """On the axis of a quadrupole |B| is below what is left unknown across it."""
    points = np.column_stack([np.zeros((9, 2)), np.linspace(-0.08, 0.08, 9)])
    few = np.vstack([points, [[0.03, 0.01, 0.0]]])
    with pytest.warns(HalbachWarning, match=r"across the field bends 9 of 10 readings"):
        infer(build_magnet(study_of(2, inference={})), total_map(2, 1, generator, few), session)


@pytest.mark.parametrize(("key", "value", "words"), [
    ("gain", [0.01, 0.0, 0.0], "three equal entries"), ("crosstalk", {"xy": 0.01}, "no axes"),
    ("sensor_position_m", [[0.0, 0.001, 0.0], [0, 0, 0], [0, 0, 0]], "one sensor")])
def test_a_probe_of_components_is_refused(key, value, words, generator, session):
    study = study_of(1, instrument={key: value})
    with pytest.raises(MeasurementError, match=words):
        infer(build_magnet(study), total_map(1, 1, generator), session)


def test_what_needs_components_says_so(generator, session):
    data = total_map(1, 1, generator)
    fourier = study_of(1, observation={
        "quantity": "fourier_coefficients", "harmonics": 3, "positions": {
            "kind": "circles", "radius_m": 0.05, "angles": 12}}, inference={})
    with pytest.raises(MeasurementError, match=r"a map of \|B\| alone"):
        infer(build_magnet(fourier), data, session)


def test_the_pages_of_an_update_by_the_magnitude(generator, session, tmp_path):
    """Page, table of predictions and view are written, and say |B|."""
    update = infer(build_magnet(study_of(2)), total_map(2, 1, generator), session)
    write_inference(update, tmp_path)
    write_result(update, tmp_path)
    assert "|B|" in page(tmp_path / "report.html")
    table = (tmp_path / "prediction.csv").read_text().splitlines()
    assert len(table) == 1 + len(POINTS)
    assert {row.split(",")[0] for row in table[1:]} == {"|B|"}


def test_a_matrix_on_the_disk_gives_the_same(generator, session, tmp_path, monkeypatch):
    """The response of |B| is projected in parts if it does not fit into memory."""
    magnet, data = build_magnet(study_of(2)), total_map(2, 1, generator)
    whole = infer(magnet, data, session)
    monkeypatch.setattr("halbach_fe.response.response_matrix.LOADED_BYTES", 1000)
    other = infer(magnet, data, Session.open(tmp_path / "on-disk"))
    assert isinstance(other.response.matrix, StoredMatrix)
    np.testing.assert_allclose(other.posterior.mean, whole.posterior.mean, rtol=1e-9)


def test_positions_make_noise_by_the_gradient_of_the_magnitude(generator, session):
    """Against differences of |B| of the true magnet by magpylib."""
    study = study_of(2, noise={"regions": [{"name": "all", "sigma_T": NOISE_T}],
                               "position_sd_m": 1e-4})
    update = infer(build_magnet(study), total_map(2, 1, generator), session)
    step = 1e-5 * np.eye(3)
    size = [np.linalg.norm(truth(2, 1)[0].getB(POINTS + each), axis=1)
            for each in (*step, *-step)]
    gradient = (np.array(size[:3]) - size[3:]) / 2e-5
    expected = np.hypot(NOISE_T, 1e-4 * np.linalg.norm(gradient, axis=0))
    # the gradient of the updated magnet in vacuum is that of the true one to a part in 1e3
    np.testing.assert_allclose(update.noise.sd, expected, rtol=0.01)


def test_permeable_blocks_and_iron(dipole, generator, session):
    """In 2D with iron, where the direction is that of the solved field; truth in closed form."""
    study, data, true = iron_campaign(dipole, generator)
    components = np.nan_to_num(data["B_T"].values)
    total = total_field_map(points_of(data), np.linalg.norm(components, axis=1))
    # in a plane |B| stays as it is if all magnetizations turn by the same angle
    with pytest.warns(HalbachWarning, match=r"across the field bends 120 of 120 readings"):
        update = infer(build_magnet(study), total, session)
    score = (update.posterior.mean - true) / update.posterior.sd
    # 32 values: the rms of a standard normal is 1 +- 0.13; 4 sigma
    assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.5)
    assert not update.disagreement
    after, before = (np.abs(each.mean - true) for each in (update.posterior, update.prior))
    assert np.median(after) < 0.7 * np.median(before)


def test_components_and_magnitude_update_together(generator, session):
    """Two maps of one campaign, in which each has its own probe."""
    maps = [{"name": "hall", "file": "hall.csv"}, {"name": "nmr", "file": "nmr.csv"}]
    magnet = build_magnet(study_of(2, maps=maps))
    near = POINTS[np.hypot(POINTS[:, 0], POINTS[:, 1]) < 0.04]
    field = truth(2, 1)[0].getB(near)
    hall = field_map(near, field + NOISE_T * generator.standard_normal(field.shape))
    update = infer(magnet, {"hall": hall, "nmr": total_map(2, 1, generator)}, session)
    assert not update.disagreement
    off = update.posterior.mean - truth(2, 1)[1]
    assert off @ np.linalg.solve(update.posterior.covariance, off) / 72 == pytest.approx(1, abs=0.7)
    shared = study_of(2, maps=[one | {"probe": "same"} for one in maps])
    with pytest.raises(StudyError, match=r"one map is of \|B\|"):
        infer(build_magnet(shared), {"hall": hall, "nmr": total_map(2, 1, generator)}, session)


def test_a_map_of_the_magnitude_is_registered(generator, session):
    """Pose, gain and offset by |B| alone, from no first guess; the sign stays open, and is said.

    A quarter turn puts the field along y of the map, and all of it is compared with the readings.
    """
    turn = Rotation.from_rotvec([0.01, -0.02, 0.015]) * Rotation.from_euler("z", np.pi / 2)
    shift = np.array([1e-3, -2e-3, 5e-3])
    places = turn.apply(POINTS) + shift
    size = 1.002 * np.linalg.norm(truth(1, 1)[0].getB(places), axis=1) + 3e-4
    data = total_field_map(POINTS, size + NOISE_T * generator.standard_normal(len(size)))
    found = register(build_magnet(study_of(1)), data, session, most=1)
    best = found[0]
    assert best.explains
    assert best.factor == pytest.approx(1.002, abs=0.01)  # blocks have 1 % less or more together
    assert best.likeness > 0.9999
    middle = turn.apply((POINTS.max(axis=0) + POINTS.min(axis=0)) / 2) + shift
    own = Rotation.from_rotvec(best.instrument.rotation_rad)
    # half turns leave |B| of the nominal dipole as it is
    half = min((Rotation.from_rotvec(np.pi * axis) for axis in np.vstack([np.eye(3), np.zeros(3)])),
               key=lambda each: (own * (each * turn).inv()).magnitude())
    assert np.abs((best.middle_m - half.apply(middle)) / best.translation_sd_m).max() < 4
    left = (own * (half * turn).inv()).as_rotvec()
    assert np.abs(left / best.rotation_sd_rad).max() < 4
    gain, offset = best.instrument.gain, best.instrument.offset_T
    assert len(set(gain)) == len(set(offset)) == 1
    assert abs(gain[0] - 2e-3) < 4 * best.probe.gain
    assert abs(offset[0] - 3e-4) < 4 * best.probe.offset_T
    assert not best.instrument.crosstalk or not any(best.instrument.crosstalk.values())
    assert "if the field is reversed everywhere" in sentences(found)[0]


@pytest.mark.parametrize(("total", "said"), [(True, "gain of |B|"), (False, "gain of Bx")])
def test_a_doubted_probe_of_the_magnitude_has_no_axis(total, said):
    named = PoseFit._named.func(SimpleNamespace(total=total, open=()))
    assert next(words for words, _ in named if words.startswith("gain")) == said


def test_a_map_of_another_magnet_is_not_explained(generator, session):
    """Negative control: |B| of a quadrupole in a dipole."""
    data = total_map(2, 1, generator, POINTS[::4])
    try:
        found = register(build_magnet(study_of(1, inference={})), data, session, most=1)
    except MeasurementError as error:
        assert "of its field unexplained" in str(error)
    else:
        assert not found[0].explains
