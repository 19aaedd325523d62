"""Which further measurement tells effects apart that one map cannot."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.diagnosis.discriminating_measurements import (
    SEPARATING_GAIN,
    ScanFields,
    _effect_of,
    _readings,
    candidate_measurements,
    distance,
    owner_of,
    present_scan,
    separations,
)
from halbach_fe.diagnosis.effect_selection import Candidate, SelectedEffect
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis, Place
from halbach_fe.diagnosis.marginal_evidence import Marginal
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.result import Diagnosis, IdentifiedEffect
from halbach_fe.geometry.blocks import rotation_about_z
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.result import InstrumentTerms
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.probe_law import NAMES, nonlinear_part, sensor_model
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.session import Session
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed, circle

EFFECTS = {effect.name: effect for effect in catalogue()}
SIGMA = 5e-5
OUTSIDE = {"external": {"background_T": [0.0, 0.0, 0.0]}, "uncertain": [
    {"name": "outside", "sd": 1e-3, "change": {"external.background_T[2]": 1.0}}]}
MORE = {"": {}, "variations": {"prior": {
    "common_mode_sd": 0.001, "variation_sd": 0.02, "variation_length_m": 0.04}},
    "outside": OUTSIDE}
"""What a study has as parameters besides magnetizations."""
POINTS = np.vstack([circle(0.06, 8, z) for z in np.linspace(-0.2, 0.2, 11)])


@pytest.fixture(scope="module")
def session(getdp, tmp_path_factory):
    return Session(getdp, tmp_path_factory.mktemp("next"), jobs=2)


@pytest.fixture(scope="module")
def inferred(session):
    """Update a short dipole in vacuum with its nominal map; once for each set of components."""
    @functools.cache
    def make(components, more=""):
        study = parse_study(changed(
            DIPOLE, dimension=3, array__rings=2, array__ring_length_m=0.08,
            array__recoil_permeability=1.0, observation__components=list(components),
            noise={"regions": [{"name": "all", "sigma_T": SIGMA}]}, **{
                "prior": {"common_mode_sd": 0.001}} | MORE[more]))
        data = field_map(POINTS, field_of(build_magnet(study).blocks, POINTS))
        return infer(build_magnet(study), data,
                     replace(session, folder=session.folder / f"{components}{more}")), data
    return make


@pytest.fixture
def case(inferred):
    """Make a diagnosis in which a named effect has rivals; the map has no say in it."""
    def make(named, values, *rivals, components="xyz", place="", more=""):
        update, data = inferred(components, more)
        effect = EFFECTS[named]
        at = next(one for one in effect.places(update.study) if one.name == place)
        found = SelectedEffect(Candidate(named, place, (0,), effect.is_binary), 20.0, 16.0, tuple(
            (Candidate(*(rival if isinstance(rival, tuple) else (rival, "")), (1,)), 19.0)
            for rival in rivals))
        one = IdentifiedEffect(Hypothesis(effect, at), np.array(values), np.array(values) / 10,
                               found)
        return Diagnosis(
            corrected_study=update.study, before=update, after=update, study=update.study,
            identified=(one,),
            unknown=None,
            probabilities={}, evidence=None, candidates=(), groups_before=[], groups_after=[],
            loo_residuals_before=np.zeros(0),
            loo_residuals_after=np.zeros(0), rounds=1), data
    return make


@pytest.mark.parametrize("more", ["variations", "outside"])
def test_magnets_with_other_parameters(case, session, more):
    """Variations inside blocks, and an uncertain field outside, which ended in an error. The latter
    stays where it is if the magnet turns: an offset of By, which it hides, is none of the magnet.
    """
    diagnosis, data = case("offset_y", [2e-4], "background", more=more)
    (found,) = separations(diagnosis, data, session)
    assert found.recommended.name == "probe_rolled"
    assert found.gains["magnet_turned"] < SEPARATING_GAIN


@pytest.mark.parametrize(("named", "values", "rival", "components", "best", "also", "useless"), [
    # an offset turns with its sensor, a field does not
    ("offset_y", [2e-4], "background", "xyz", "probe_rolled", ["probe_reversed"],
     ["magnet_turned", "nmr_point", "known_temperature"]),
    ("offset_z", [2e-4], "background", "xyz", "probe_reversed", [], ["probe_rolled"]),
    # NMR sees a field along the main one
    ("background", [2e-4, 0, 0], "offset_x", "xyz", "probe_rolled", ["nmr_point"], []),
    # a sensor reads what it reads, the magnet is another one when it is warm
    ("gain_x", [9e-3], "temperature", "x", "nmr_point", ["known_temperature"],
     ["probe_rolled", "probe_reversed", "magnet_turned"]),
    ("temperature", [9.0], "gain_x", "x", "nmr_point", ["known_temperature"], ["probe_rolled"]),
    # the product of two components keeps its sign when both turn, a component does not
    ("planar_hall_z", [1e-1], "misalignment_zy", "xyz", "probe_rolled", [], ["nmr_point"])])
def test_known_twins_are_told_apart(
    case, session, named, values, rival, components, best, also, useless
):
    diagnosis, data = case(named, values, rival, components=components)
    (found,) = separations(diagnosis, data, session)
    assert (found.identified.effect.name, found.rival.effect.name) == (named, rival)
    assert found.recommended is not None
    assert found.recommended.name == best
    assert all(found.gains[name] > SEPARATING_GAIN for name in [best, *also])
    assert all(abs(found.gains[name]) < 1 for name in useless)


def test_nothing_tells_an_effect_from_itself(case, session, monkeypatch):
    """Negative control."""
    monkeypatch.setitem(EFFECTS, "offset_by_another_name", replace(
        EFFECTS["offset_y"], name="offset_by_another_name"))
    diagnosis, data = case("offset_y", [2e-4], "offset_by_another_name")
    (found,) = separations(diagnosis, data, session, tuple(EFFECTS.values()))
    assert found.recommended is None
    # a second map halves the variance, and so doubles what the prior of the rival costs
    assert max(map(abs, found.gains.values())) < 1


def test_what_is_open_of_an_instrument_explains_an_effect_of_it(case, session):
    """A gain that is known to 10 % takes up one of 0.9 %; control: an open offset does not."""
    diagnosis, data = case("gain_x", [9e-3], "temperature", components="x")
    for term, sd, is_told in (("gain_x", 0.1, False), ("offset_y_T", 0.1, True)):
        terms = InstrumentTerms((f"map.{term}",), np.zeros(1), np.ones(1), np.array([sd]), True, ())
        (found,) = separations(replace(diagnosis, before=replace(
            diagnosis.before, terms=terms)), data, session)
        assert (found.recommended is not None) == is_told


def test_every_term_of_an_instrument_is_an_effect():
    total = ("gain", "offset_T", "drift_T")
    for term in (*NAMES, *total, "stage_shift_y_m"):
        name, number = _effect_of(term)
        effect = EFFECTS[name]
        assert number < len(effect.parameters)
        unit = effect.parameters[number].unit
        assert "crosstalk" in term or term.endswith(f"_{unit}") == (unit != "1")
    assert _effect_of("sensor_x_z_m") == ("sensor_position_x", 2)


def test_small_effects_are_not_worth_it(case, session):
    diagnosis, data = case("offset_y", [1e-7], "background")
    (found,) = separations(diagnosis, data, session)
    assert found.recommended is None


def test_every_rival_has_a_row(case, session):
    diagnosis, data = case("offset_y", [2e-4], "background", ("block_missing", "r01s03"),
                           ("block_missing", "r01s04"), "misalignment_yx")
    found = separations(diagnosis, data, session)
    assert [one.rival.effect.name for one in found] == [
        "background", "block_missing", "misalignment_yx"]
    assert found[1].rival.place == Place(1, 3)
    (one,) = diagnosis.identified
    lonely = replace(one, selection=replace(one.selection, alternatives=()))
    assert separations(replace(diagnosis, identified=(lonely,)), data, session) == []


def test_the_same_effect_elsewhere_is_no_rival(case, session):
    diagnosis, data = case("block_missing", [1.0], ("block_missing", "r01s04"), place="r01s03")
    assert separations(diagnosis, data, session) == []


def test_distance_is_that_of_normal_distributions(generator):
    blocks, rivals = generator.standard_normal((20, 4)), generator.standard_normal((20, 2))
    signature = generator.standard_normal(20)
    covariance = np.eye(20) + blocks @ blocks.T + rivals @ rivals.T
    assert distance(Marginal.of(blocks), signature, rivals) == pytest.approx(
        signature @ np.linalg.solve(covariance, signature) / 2)
    # what the rival can do costs at most its prior
    assert distance(Marginal.of(blocks), rivals[:, 0], rivals) <= 0.5
    assert distance(Marginal.of(blocks), blocks[:, 0], rivals) <= 0.5


def test_a_thinned_map_knows_as_much(case, monkeypatch):
    diagnosis, data = case("offset_y", [2e-4], "background")
    whole = present_scan(diagnosis, data)
    monkeypatch.setattr("halbach_fe.diagnosis.discriminating_measurements.MAX_READINGS", 60)
    thin = present_scan(diagnosis, data)
    assert len(whole.noise) == 264
    assert 45 <= len(thin.noise) <= 75
    assert len(thin.points) == len(thin.noise) / 3
    information = [np.sum(1 / one.noise.sd**2) for one in (whole, thin)]
    assert information[1] == pytest.approx(information[0])
    assert len(np.unique(np.round(np.arctan2(*thin.points[:, 1::-1].T), 6))) == 8  # all angles


def test_options_fit_the_study(case):
    diagnosis, data = case("offset_y", [2e-4], "background")
    found = {one.name: one.scan for one in candidate_measurements(diagnosis, data)}
    radius = np.hypot(*found["second_radius"].points[:, :2].T)
    assert radius == pytest.approx(0.8 * 0.104)
    assert np.abs(found["far_field"].points[:, 2]).min() > 0.08  # the magnet's end
    array = diagnosis.before.study.array.with_(remanence_T=0.01)
    weak = replace(diagnosis.before, magnet=diagnosis.before.magnet.with_(array=array))
    names = {one.name for one in candidate_measurements(replace(diagnosis, before=weak), data)}
    assert set(found) - names == {"nmr_point"}  # too weak for it
    away = diagnosis.before.magnet.with_(array__rings=1, array__ring=[
        {"ring_length_m": 0.16, "z_m": 0.5}])
    found = {one.name: one.scan for one in candidate_measurements(
        replace(diagnosis, before=replace(diagnosis.before, magnet=away)), data)}
    np.testing.assert_allclose(found["nmr_point"].points, [[0.0, 0.0, 0.5]])
    beyond = np.abs(found["far_field"].points[:, 2] - 0.5) - 0.08
    assert 0 < beyond.min() < 0.2 * beyond.max() + 1e-9


def test_no_reading_is_proposed_in_iron(case):
    """A box in the bore, where the circles of the control pass."""
    diagnosis, data = case("offset_y", [2e-4], "background")
    magnet = build_magnet(diagnosis.before.study.with_(iron={
        "relative_permeability": 100.0, "bodies": [
            {"kind": "box", "size_m": [0.02, 0.02, 0.3], "centre_m": [0.083, 0.0, 0.0]}]}))
    counts = []
    for before in (diagnosis.before, replace(diagnosis.before, magnet=magnet)):
        points = {one.name: one.scan.points for one in candidate_measurements(
            replace(diagnosis, before=before), data)}["second_radius"]
        counts.append(len(points))
        assert magnet.contains(points).any() == (before is diagnosis.before)
    assert 0 < counts[1] < counts[0]


OWNERS = {"offset_x": "sensors", "sensor_position_y": "sensors", "drift": "sensors",
          "mapper_translation": "mapper", "z_scale": "mapper", "arm_sag": "mapper",
          "background": "surroundings", "neighbour_magnet": "surroundings",
          "temperature": "magnet", "block_turned": "magnet", "length": "magnet"}


@pytest.mark.parametrize("name", OWNERS)
def test_effects_belong_to_what_they_change(name):
    effect = EFFECTS[name]
    assert owner_of(Hypothesis(effect, effect.places(STUDY)[0]), STUDY) == OWNERS[name]


STUDY = parse_study(changed(
    DIPOLE, dimension=3, array__rings=2, array__ring_length_m=0.08, array__recoil_permeability=1.0))
STILL = np.zeros(len(POINTS))
SAME = {("offset_z", "z"), ("offset_x", "x"), ("misalignment_xy", "z"),
        ("quadratic_nonlinearity_x", "x"), *((name, axis) for axis in "xz" for name in (
            "gain_y", "planar_hall_z", "cubic_nonlinearity_y"))}
"""What a sensor does as well when the probe is turned about an axis."""


@pytest.mark.parametrize(("axis", "turn"), [("z", np.diag([-1.0, -1, 1])),
                                            ("x", np.diag([1.0, -1, -1]))])
@pytest.mark.parametrize("name", [
    "offset_x", "offset_z", "gain_y", "misalignment_zx", "misalignment_xy", "planar_hall_z",
    "quadratic_nonlinearity_x", "cubic_nonlinearity_y", "sensor_position_y", "drift"])
def test_a_turned_probe_sees_a_turned_world(name, axis, turn):
    """Signatures against the full law of the instrument, of which every reading is taken in the
    axes of the probe and turned back into the mapper's.
    """
    time, effect = np.linspace(0, 1, len(POINTS)), EFFECTS[name]

    def shown(instrument):
        # the sensors' offsets from the middle of the probe
        used = sensor_model(instrument, np.zeros((len(POINTS), 3)))
        sensors = np.repeat(POINTS, len(used.points) // len(POINTS), axis=0)
        world = field_of(build_magnet(STUDY).blocks, sensors + used.points @ turn.T) @ turn
        linear = (used.operator @ world.ravel()).reshape(-1, 3)
        return (linear + nonlinear_part(instrument, linear, time)) @ turn.T

    values = 0.05 * np.array([parameter.sd for parameter in effect.parameters])
    change = shown(effect.apply(STUDY, Place(), values.tolist()).instrument) - shown(Instrument())
    scene = NominalFields(STUDY, POINTS, time, lambda other: POINTS)
    seen = ScanFields(STUDY, POINTS, time, scene.solve, scene, slice(None), np.eye(3), turn)
    found = np.tensordot(values, effect.signature(seen, Place()), 1) @ turn.T
    size = np.abs(change).max()
    assert np.abs(found - change).max() < 1e-2 * size  # what is not linear
    straight = np.tensordot(values, effect.signature(scene, Place()), 1)
    assert (np.abs(straight - change).max() < 1e-2 * size) == ((name, axis) in SAME)


@pytest.mark.parametrize("name", ["block_turned", "block_displaced", "ring_shifted"])
def test_a_turned_magnet_takes_its_effects_along(case, session, name):
    diagnosis, data = case("offset_y", [2e-4], "background")
    turn, effect = rotation_about_z(np.pi / 2), EFFECTS[name]
    turned = parse_study(changed(
        STUDY.model_dump(), array__first_block_angle_deg=180.0,
        array__first_magnetization_angle_deg=270.0))
    there = NominalFields(turned, POINTS, STILL, lambda other: POINTS)
    place = effect.places(STUDY)[-1]
    expected = effect.signature(there, place)
    if name == "ring_shifted":  # along x and y, which turn with the magnet
        expected = np.stack([expected[1], -expected[0]])
    scan = replace(present_scan(diagnosis, data), magnet_rotation=turn)
    (one,) = _readings(diagnosis, [scan], session)
    found = one._signature(Hypothesis(effect, place))
    size = np.abs(expected).max()
    assert np.abs(found - expected).max() < 1e-3 * size  # gradients are differences
    straight = effect.signature(NominalFields(STUDY, POINTS, STILL, lambda other: POINTS), place)
    assert np.abs(straight - expected).max() > 0.1 * size  # negative control
    assert one.mapper.field == pytest.approx(there.field, abs=1e-12)
    assert np.abs(one.mapper.gradient - there.gradient).max() < 1e-3 * np.abs(there.gradient).max()
