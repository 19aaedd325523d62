"""Losses by a knee, hidden by magpylib in cells of its own, and named with their parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effect_comparison import with_short_steps
from halbach_fe.diagnosis.effect_selection import Candidate, SelectedEffect
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis, Parameter
from halbach_fe.diagnosis.effects.material import COERCIVITIES, STATED, KneeEffect, _mean_losses
from halbach_fe.diagnosis.linearization import NominalSolver
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.diagnosis.summary import diagnosis_summary
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.magpylib_field import vacuum_field
from halbach_fe.synthetic.reaction import _cells, lost_field, with_knee_losses
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import circle
from tests.diagnosis.campaign import DOCUMENT, NOISE_T, drawn, field

STUDY = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | {
    "blocks_per_ring": 8, "rings": 1, "block": {"shape": "cuboid", "width_m": 0.08}}})
POINTS = np.vstack([circle(radius, 12, z, 0.1) for radius in (0.05, 0.07)
                    for z in np.linspace(-0.15, 0.15, 9)])
COERCIVITY_T, SQUARENESS = 0.7, 0.85
OTHERS = ("gain_x", "corners_demagnetized", "magnetization_gradient", "temperature")
MATERIAL = {"intrinsic_coercivity_A_per_m": 1e6, "remanence_coefficient_per_K": -1e-3,
            "coercivity_coefficient_per_K": -6e-3, "temperature_C": 60.0}


def test_a_knee_is_named_with_its_parameters(session, generator):
    polarizations = drawn(STUDY, generator)
    true = with_knee_losses(magnet_of(STUDY).with_magnetizations(polarizations / MU_0),
                            COERCIVITY_T, SQUARENESS)
    mean = sum(cell.part * cell.body.shape.volume * cell.body.shape.share(cell.u, cell.v)
               for cell in true.losses) / sum(body.shape.volume for body in true.bodies)
    assert 0.01 < mean < 0.05  # far more at the edges
    assert max(cell.part for cell in true.losses) > 0.1
    whole = field(STUDY, polarizations, POINTS)
    noise = NOISE_T * generator.standard_normal(whole.shape)
    some = [effect for effect in catalogue() if effect.name in ("knee", *OTHERS)]
    solver = NominalSolver(session)
    found = diagnose(STUDY, field_map(POINTS, whole + lost_field(true.losses, POINTS) + noise),
                     session, effects=some, solver=solver)
    (knee,) = found.identified
    assert knee.hypothesis.effect.name == "knee"
    (_, coercivity, squareness), (_, *sd) = knee.reported
    # the cells of both programs differ, which the error bars of the solver state
    assert abs(MU_0 * coercivity - COERCIVITY_T) < 2.5 * MU_0 * sd[0]
    assert abs(squareness - SQUARENESS) < 2.5 * sd[1]
    # 0.051 were measured, with the error that cells share
    assert MU_0 * sd[0] < 0.06 * COERCIVITY_T
    assert found.converged
    assert found.after.prior_conflict < found.after.conflict_limit < found.before.prior_conflict
    assert found.study.demagnetization.irreversible
    assert f"coercivity {coercivity / 1e3:.0f}"[:14] in " ".join(answer(found).sentences)
    assert diagnosis_summary(found)["effects"][0]["parameters"][1]["value"] == coercivity

    # negative control: the same blocks have lost nothing
    clean = diagnose(STUDY, field_map(POINTS, whole + noise), session, effects=some, solver=solver)
    assert clean.identified == ()

    # the cheap estimate leaves out coercivities that the readings rule out: all of them here
    tried = [candidate.place for candidate in found.candidates if candidate.effect == "knee"]
    assert 0 < len(tried) < len(COERCIVITIES)
    assert "knee" not in {candidate.effect for candidate in clean.candidates}


def test_a_block_upside_down_loses_what_one_of_the_opposite_axis_does():
    """By the cheap estimate that says which coercivities are tried."""
    knee = KneeEffect()
    found, (x, y, _) = [], build_magnet(STUDY).blocks[1].easy_axis
    opposite = float(np.degrees(np.arctan2(-y, -x)))
    for exception in ({"magnetization_factor": -1.0}, {"magnetization_angle_deg": opposite}):
        study = STUDY.with_(array__exceptions=[{"slot": 2, **exception}])
        materials = [knee.apply(study, place, [1.0]).demagnetization
                     for place in knee.places(study)]
        found.append(_mean_losses(study, materials))
    np.testing.assert_allclose(found[0], found[1], atol=1e-12)
    assert np.abs(found[0][0, 3:6]).max() > 0.1  # of this very block, in T


def test_where_it_is_looked_for():
    knee = KneeEffect()
    assert len(knee.places(STUDY)) == len(COERCIVITIES)
    assert "near" in knee.places(STUDY)[0].name
    stated = STUDY.with_(demagnetization=MATERIAL)
    places = [place.at_m[0] for place in knee.places(stated)]
    assert len(places) == len(STATED)
    assert 1e6 * (1 - 6e-3 * 40) in [pytest.approx(place) for place in places]
    for study in (STUDY.with_(demagnetization=MATERIAL | {"irreversible": True}),
                  STUDY.with_(solver__route="edge_elements")):
        assert knee.places(study) == []


@pytest.mark.parametrize("study", [STUDY, STUDY.with_(demagnetization=MATERIAL)])
def test_the_study_gets_what_is_reported(study):
    knee = KneeEffect()
    place = knee.places(study)[3]
    values = np.array([1.0, 0.2, -0.7])
    (_, coercivity, squareness), (_, *sd) = knee.reported(place, values, np.array([0, 0.1, 0.3]))
    law = knee.apply(study, place, values.tolist()).demagnetization
    hot = 1 + law.coercivity_coefficient_per_K * (
        law.temperature_C - law.reference_temperature_C)
    assert law.intrinsic_coercivity_A_per_m * hot == pytest.approx(coercivity)
    assert law.squareness == pytest.approx(squareness)
    for number, (step, deviation) in enumerate(zip((0.1, 0.3), sd, strict=True), start=1):
        moved = knee.reported(place, values + 1e-6 * np.eye(3)[number], values)[0]
        slope = (moved - knee.reported(place, values, values)[0])[number] / 1e-6
        assert deviation == pytest.approx(step * slope, rel=1e-3)
    for extreme in (-50.0, 50.0):  # no step leads out of what a study may have
        assert 0.3 <= knee.apply(study, place, [1.0, 0.0, extreme]).demagnetization.squareness <= (
            0.99)


def test_steps_do_not_run_away():
    knee = KneeEffect()
    before = IdentifiedEffect(
        Hypothesis(knee, knee.places(STUDY)[0]), np.array([1.0, 0.1, 0.0]), np.ones(3),
        SelectedEffect(Candidate("knee", "", (0,)), 9.0, 5.0, ()))
    wild = replace(before, values=np.array([1.0, -3.0, 0.2]))
    (limited,) = with_short_steps([wild], [before])
    assert limited.values == pytest.approx([1.0, 0.1 - 0.05, 0.2])
    (first,) = with_short_steps([wild], [])
    assert first.values == pytest.approx([1.0, -0.05, 0.2])
    assert Parameter("usual", "1", 1.0).longest_step == np.inf


@pytest.mark.parametrize("shape", [
    {"shape": "sector"}, {"shape": "cuboid", "width_m": 0.08}, {"shape": "trapezoid"}])
def test_the_cells_fill_their_blocks(shape):
    """Of all remanence lost, what remains is no field: the cells are the whole block."""
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | {
        "blocks_per_ring": 8, "rings": 1, "block": shape}})
    bodies = magnet_of(study).bodies[:2]
    cells = [cell for body in bodies for cell in _cells(body, 3)]
    assert len(cells) == 2 * 27
    whole = vacuum_field(bodies, POINTS[:9])
    lost = lost_field([cell.lost(1.0) for cell in cells], POINTS[:9])
    assert lost == pytest.approx(-whole, abs=1e-6 * np.abs(whole).max())
    assert all(body.holds(np.array([cell.middle for cell in cells[27 * number:27 * number + 27]])
                          ).all() for number, body in enumerate(bodies))
