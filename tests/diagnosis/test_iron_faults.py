"""Faults of iron of any shape in maps by NGSolve, from the map to the name."""

from __future__ import annotations

import re

import numpy as np
import pytest

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.geo.iron_mesh import Sizes
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.study.iron_keys import IronRing
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.hidden_effects import EFFECTS
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.conftest import DIPOLE, changed

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
def test_a_plate_in_another_place_is_named(higher_m, session, monkeypatch):
    """Among what resembles it; in its place, which is the control, nothing is named.

    Elements of iron are twice as large as usual, and as the bars say: the noise is 0.5 mT.
    """
    pytest.importorskip("ngsolve")
    fine = Sizes.of
    monkeypatch.setattr(Sizes, "of", lambda mesh, coarseness=1.0: fine(mesh, 2.0 * coarseness))
    seen = simulate_campaign(study_of(0.035 + higher_m), 3, elements=Elements(0.006))
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


def test_blocks_beside_a_tube_that_saturates(session):
    """Found as linear iron the tube was 20 mm thick and 4.5 mm farther out, beside a "Yes"."""
    pytest.importorskip("ngsolve")
    study = parse_study(changed(
        DIPOLE, array__blocks_per_ring=8, array__recoil_permeability=1.0, mesh__block_size_m=0.04,
        noise={"regions": [{"name": "all", "sigma_T": 2e-5}]}, observation__positions={
            "kind": "circles", "radius_m": [0.05, 0.085], "angles": 48}))
    inner, outer = study.array.outer_radius_m + np.array([0.004, 0.008])
    seen = simulate_campaign(study, 1, hide=[(EFFECTS["iron_ring"], (inner, outer, 1400.0, 2.05))])
    some = [one for one in catalogue() if one.name in (
        "iron_ring", "gain_x", "temperature_gradient")]
    found = diagnose(study, seen.readings, session, effects=some)
    (named,) = found.identified
    assert named.hypothesis.effect.name == "iron_ring"
    assert re.search(r"radii of [\d.]+ and [\d.]+ mm, farther out by \S+ ± \S+ mm; thicker by",
                     answer(found).said)
    off = np.subtract(named.place.at_m, (inner, outer))
    _, farther, thicker, *_ = named.sd
    assert abs(off[0]) < 3 * farther
    assert abs(off[1]) < 3 * np.hypot(farther, thicker)

    def chi2_of_blocks(study):
        result = infer(build_magnet(study), seen.readings, session, linearized_only=True)
        count = len(result.magnet.parameter_names)
        true = {(body.ring, body.slot): body.magnetization[:2] for body in seen.magnet.bodies}
        away = result.posterior.mean[:count] - np.concatenate(
            [true[block.ring, block.slot] for block in result.magnet.blocks])
        return away @ np.linalg.solve(result.posterior.covariance[:count, :count], away) / count

    assert chi2_of_blocks(found.study) < 2
    linear = IronRing(inner_radius_m=inner, outer_radius_m=outer, relative_permeability=1400.0)
    # negative control: without the saturation, in the right place
    assert chi2_of_blocks(study.with_(iron_ring=linear)) > 4
