"""Faults of iron of any shape in maps by NGSolve, from the map to the name."""

from __future__ import annotations

import pytest

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.simulate import simulate_campaign

NOISE_T = 5e-4


def study_of(height_m: float = 0.035):
    """A cube below a plate of iron, and readings between them."""
    cube = {"name": ["cube"], "shape": ["cuboid"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.0],
            **{f"size_{axis}_m": [0.02] for axis in "xyz"}, "remanence_x_T": [0.0],
            "remanence_y_T": [0.0], "remanence_z_T": [1.3]}
    return parse_study({
        "name": "cube-and-plate", "dimension": 3, "array": {"free_blocks": cube},
        "iron": {"relative_permeability": 50.0, "bodies": [
            {"kind": "box", "size_m": [0.03, 0.03, 0.01], "centre_m": [0.0, 0.0, height_m]}]},
        "mesh": {"block_size_m": 0.01, "growth": 2.5},
        "observation": {"quantity": "flux_density", "positions": {
            "kind": "circles", "radius_m": 0.008, "angles": 8, "z_min_m": 0.015, "z_max_m": 0.024,
            "count": 4}},
        "noise": {"regions": [{"name": "gap", "sigma_T": NOISE_T}]},
        "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 1.0}})


@pytest.mark.parametrize("higher_m", [0.0, 1e-3])
def test_a_plate_in_another_place_is_named(higher_m, session):
    """Among what resembles it; in its place, which is the control, nothing is named."""
    pytest.importorskip("ngsolve")
    seen = simulate_campaign(study_of(0.035 + higher_m), 3, elements=Elements(0.004))
    some = [one for one in catalogue() if one.name in (
        "iron_displaced", "iron_permeability", "background", "gain_z", "z_scale", "length")]
    found = diagnose(study_of(), seen.readings, session, blocks=seen.blocks, effects=some)
    assert found.unknown is None
    if not higher_m:
        assert found.identified == ()
        return
    (named,) = found.identified
    assert named.hypothesis.effect.name == "iron_displaced"
    assert named.values[2] == pytest.approx(higher_m, abs=3 * named.sd[2])
    assert named.sd[2] < higher_m / 3
