"""Stored field maps, recomputed; and the proof that a changed model would be noticed."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import read_map
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.study.reader import parse_study
from tests.conftest import changed
from tests.regression.cases import CASES, FOLDER, difference, points_of_case, tolerance

CHANGES = (
    {"array__remanence_T": 1.06 * 1.03}, {"array__recoil_permeability": 1.15},
    {"array__first_magnetization_angle_deg": 183.0}, {"array__inner_radius_m": 0.108},
    {"array__multipole_order": 2}, {"array__block": {"shape": "sector", "angular_gap_deg": 1.0}})
TRIED = {"dipole_3d_direct": (), "dipole_3d_reaction": CHANGES[1:5]}
"""Of the changes. Those of the direct field are told by the reaction, gaps, slow in 3D, by
sections, and a remanence, to which both are proportional, without another solve."""


def stored(name):
    return read_map(FOLDER / f"{name}.h5")["B_T"].values


@pytest.mark.parametrize("name", CASES)
def test_map_is_unchanged(name, session):
    study = CASES[name]
    found = solve_nominal(build_magnet(study), points_of_case(study), session)
    assert difference(found, stored(name)) < tolerance(study)


@pytest.mark.parametrize(("name", "change"), [
    (name, change) for name in CASES for change in TRIED.get(name, CHANGES)])
def test_a_perturbed_model_fails(name, change, session):
    document = CASES[name].model_dump(exclude_none=True)
    study = parse_study(changed(document, **change))
    found = solve_nominal(build_magnet(study), points_of_case(study), session)
    assert difference(found, stored(name)) > tolerance(study)


@pytest.mark.parametrize("name", TRIED)
def test_another_remanence_fails(name):
    """With linear iron the field is proportional to it."""
    assert difference(1.03 * stored(name), stored(name)) > tolerance(CASES[name])


@pytest.mark.parametrize("name", [name for name in CASES if name != "dipole_3d_direct"])
def test_forgotten_iron_fails(name, session):
    """In 3D the direct field is not exact enough to show it; its reaction is."""
    study = CASES[name].with_(iron_ring=None)
    found = solve_nominal(build_magnet(study), points_of_case(study), session)
    assert difference(found, stored(name)) > tolerance(study)


@pytest.mark.parametrize("permeability", [100.0, 1000.0])
def test_linear_iron_in_place_of_the_curve_fails(permeability, session):
    document = CASES["dipole_2d_saturated"].model_dump(exclude_none=True)
    document["iron_ring"] = {"inner_radius_m": 0.19, "outer_radius_m": 0.192,
                             "relative_permeability": permeability}
    study = parse_study(document)
    found = solve_nominal(build_magnet(study), points_of_case(study), session)
    assert difference(found, stored("dipole_2d_saturated")) > tolerance(study)


def test_the_comparison_itself_can_fail():
    field = stored("dipole_3d_reaction")
    assert difference(field, field) == 0
    assert difference(-field, field) > 1
    assert difference(field[:, [1, 0, 2]], field) > 0.5
    assert difference(np.where(field == field.max(), np.nan, field), field) == np.inf
    assert difference(field[:-1], field) == np.inf
