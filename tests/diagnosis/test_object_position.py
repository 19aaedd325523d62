"""The position of a magnetized object, by magpylib, is refined beyond the grid of places."""

from __future__ import annotations

from types import SimpleNamespace

import magpylib
import numpy as np
import pytest

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis, Place
from halbach_fe.diagnosis.effects.surroundings import FerromagneticObjectEffect
from halbach_fe.diagnosis.linearization import Linearization
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.summary import diagnosis_summary
from halbach_fe.measurement.field_map import field_map, points_of
from halbach_fe.solver.exact_block_field import dipole_field
from tests.diagnosis.campaign import CIRCLES, STUDY, measured

POSITION_M = np.array([0.043, 0.171, 0.148])
"""Between the places of the grid."""
MOMENT_A_M2 = np.array([6.0, -15.0, 12.0])
RADIUS_M = 0.01


def sphere(points):
    """B (n, 3) in T of a magnetized sphere, which is that of a dipole outside."""
    magnet = magpylib.magnet.Sphere(
        diameter=2 * RADIUS_M, position=POSITION_M,
        magnetization=MOMENT_A_M2 / (4 / 3 * np.pi * RADIUS_M**3))
    return magnet.getB(points)


@pytest.mark.parametrize("there", [True, False])
def test_the_position_is_that_of_the_sphere(session, generator, there):
    data = measured(STUDY, generator)
    if there:
        data = field_map(points_of(data), np.add(data["B_T"].values, sphere(CIRCLES)))
    effects = [one for one in catalogue() if one.name in (
        "background", "ferromagnetic_object", "gain_x", "neighbour_magnet")]
    found = diagnose(STUDY, data, session, effects=effects)
    if not there:  # negative control
        assert found.identified == ()
        return
    (named,) = found.identified
    assert named.hypothesis.effect.name == "ferromagnetic_object"
    assert found.converged
    (values, sd) = named.reported
    true = np.concatenate([MOMENT_A_M2, POSITION_M])
    assert np.abs(values - true) / sd == pytest.approx(np.zeros(6), abs=4.0)
    distance = np.linalg.norm(values[3:] - POSITION_M)
    places = np.array([place.at_m for place in named.hypothesis.effect.places(STUDY)])
    nearest = np.linalg.norm(places - POSITION_M, axis=1).min()
    assert distance < 0.2 * nearest
    assert found.after.prior_conflict < found.after.conflict_limit
    dipole = found.study.external.dipoles[-1]
    assert dipole.position_m == pytest.approx(values[3:])
    entry = diagnosis_summary(found)["effects"][0]
    assert entry["place"] == named.place.name
    assert entry["parameters"][3]["value"] == pytest.approx(values[3])


def test_no_object_is_where_the_probe_was():
    """A map along the axis passes through places of the grid; the control is a point's field."""
    effect = FerromagneticObjectEffect()
    place = next(one for one in effect.places(STUDY) if one.at_m[:2] == (0.0, 0.0))
    points = np.array(place.at_m) + [[0.0, 0.0, z] for z in (-0.01, 0.0, 0.01)]
    nominal = NominalFields(STUDY, points, np.zeros(3), np.zeros_like)
    with np.errstate(invalid="ignore"):
        assert not np.isfinite(dipole_field(points[1], np.ones(3), points)).all()
    shown = [effect.signature(nominal, place), effect.derivative(nominal, place, [1.0, 2.0, 3.0])]
    for found in shown:
        assert np.isfinite(found).all()
        assert not found[:3, 1].any()
        assert found[:3, [0, 2]].all(axis=1).any()


def test_derivatives_by_the_position():
    effect = FerromagneticObjectEffect()
    nominal = NominalFields(STUDY, CIRCLES[:20], np.zeros(20), lambda _: np.zeros((20, 3)))
    place, values = Place(at_m=(0.2, 0.0, 0.1)), np.array([1.0, 0.5, -2.0, 0.01, -0.02, 0.005])

    def shown(amounts):
        (dipole,) = effect.apply(STUDY, place, amounts.tolist()).external.dipoles
        return magpylib.misc.Dipole(
            moment=dipole.moment_A_m2, position=dipole.position_m).getB(nominal.points)

    found = effect.derivative(nominal, place, values.tolist())
    for number, step in enumerate((1e-3,) * 3 + (1e-5,) * 3):
        moved = step * np.eye(6)[number]
        change = (shown(values + moved) - shown(values - moved)) / (2 * step)
        assert np.abs(found[number] - change).max() < 1e-3 * np.abs(change).max()
        assert np.abs(found[number] + change).max() > np.abs(change).max()


def test_what_an_object_contributes_is_its_field():
    """Also where the refinements have moved it far: without moments it is absent."""
    effect, points = FerromagneticObjectEffect(), CIRCLES[:20]
    nominal = NominalFields(STUDY, points, np.zeros(20), lambda _: np.zeros((20, 3)))
    place, values = Place(at_m=(0.2, 0.0, 0.1)), np.array([1.0, 0.5, -2.0, 0.05, -0.04, 0.03])
    slopes = effect.derivative(nominal, place, values.tolist())
    point = SimpleNamespace(
        training=SimpleNamespace(shown=lambda fields: fields.reshape(6, -1).T.copy()),
        scene=SimpleNamespace(derivative=lambda *_: slopes))
    present = SimpleNamespace(hypothesis=Hypothesis(effect, place), values=values)
    signature, amounts = Linearization.of_identified(point, present)
    own = dipole_field(values[3:] + place.at_m, values[:3], points).ravel()
    np.testing.assert_allclose(signature @ amounts, own, rtol=1e-9, atol=1e-12)
    unchanged = slopes.reshape(6, -1).T
    assert np.abs(unchanged @ amounts - own).max() > 0.2 * np.abs(own).max()  # the control
    assert np.array_equal(signature[:, 3:], unchanged[:, 3:])


@pytest.mark.parametrize("at_m", [(0.25, 0.0, 0.1), (0.0, 0.0, 0.3495)])
def test_iron_answers_to_an_object_in_the_model(at_m):
    """By a stand-in for the solver with which it doubles its field; the second one has the iron
    within a step, and moves to the other side.
    """
    effect, points, values = FerromagneticObjectEffect(), CIRCLES[:20], [1.0, 0.5, -2.0]
    beside = STUDY.with_(external={}, iron={"relative_permeability": 30.0, "bodies": [
        {"kind": "box", "size_m": [0.1] * 3, "centre_m": [0.0, 0.0, 0.4 + 1e-5]}]})
    place, zero = Place(at_m=at_m), [0.0] * 3

    def solve(study):
        return 2 * sum(dipole_field(np.array(one.position_m), np.array(one.moment_A_m2), points)
                       for one in study.external.dipoles)

    alone = effect.derivative(NominalFields(beside, points, np.zeros(20), solve), place,
                              values + zero)
    there = NominalFields(effect.apply(beside, place, values), points, np.zeros(20), solve)
    found = effect.derivative(there, place, values + zero)
    for each, twice in zip(found, 2 * alone, strict=True):  # one-sided differences of 0.5 mm
        assert np.abs(each - twice).max() < 0.02 * np.abs(twice).max()
