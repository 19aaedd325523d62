"""How often what is suspected is there, of small effects that are drawn from the stated priors.

Effects have the prior odds that the diagnosis states, and amplitudes from its priors, so that its
probabilities should be true. Half of the cases have an effect, to see many suspicions; each kind of
case is weighted by its prior probability. The field is magpylib's. The magnet is that of
`benchmarks.unknown`, and the catalogue is that of the effects that are drawn. Cases in which
nothing is named are judged at the first linearization, which is exact for such small effects. An
effect that is named may be large, and what its linearization leaves looks like another one: there
the whole diagnosis tells what is suspected, with the named effect in the model.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import xarray as xr

from benchmarks.note import Note
from benchmarks.unknown import FOLDER
from halbach_fe.cli import common
from halbach_fe.core.errors import CheckFailedError
from halbach_fe.core.files import write_text
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effect_comparison import Search, identify_effects, score_hypotheses
from halbach_fe.diagnosis.effect_selection import (
    EFFECT_PRIOR_ODDS,
    WIDE_PRIOR_SD,
    log_bayes_factors,
    prior_log_odds,
    with_candidates,
)
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect
from halbach_fe.diagnosis.linearization import Linearization, NominalSolver
from halbach_fe.diagnosis.result import IdentifiedEffect, Suspicion
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.diagnosis.verdict import SUSPECTED, Further, families_of, judge, suspicions
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.result import InferenceResult
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.session import Session
from halbach_fe.synthetic.hidden_effects import EFFECTS
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.support.unlisted import STUDY

CASES = 3000
NAMES = (
    "arm_sag", "gain_x", "gain_y", "gain_z", "mapper_roll", "mapper_tilt_x", "mapper_tilt_y",
    "misalignment_xy", "misalignment_xz", "misalignment_yx", "misalignment_yz", "misalignment_zx",
    "misalignment_zy", "offset_x", "offset_y", "offset_z", "radius_scale", "z_scale")
"""Effects with one amplitude, which is the same number in the catalogue and in the simulation."""

ODDS = len(NAMES) * EFFECT_PRIOR_ODDS
"""Prior odds that one of them is there."""


def simulated(seed: int) -> tuple[xr.Dataset, str]:
    """Return a map, and the name of its effect; empty if it has none."""
    generator = np.random.default_rng([seed, 1])
    if generator.random() < 0.5:
        return simulate_campaign(STUDY, seed).readings, ""
    name = str(generator.choice(NAMES))
    usual = next(effect for effect in catalogue() if effect.name == name).parameters[0].sd
    wide = WIDE_PRIOR_SD if generator.random() < 0.5 else 1.0
    amplitude = float(usual * wide * generator.standard_normal())
    return simulate_campaign(STUDY, seed, hide=[(EFFECTS[name], (amplitude,))]).readings, name


def with_readings(search: Search, update: InferenceResult, data: xr.Dataset) -> Search:
    """Return the comparison of the same hypotheses for other readings at the same points."""
    rows = np.flatnonzero(~update.held_out)
    readings = update.observation.read(data["B_T"].values)
    left = readings - update.response.offset - update.response.matrix @ update.prior.mean
    residual = update.errors.subset(rows).whiten(left[rows])
    absorbed = search.marginal.absorbed(np.column_stack([search.columns, residual]))
    return replace(search, residual=residual, training=residual, absorbed=absorbed,
                   evidence=search.marginal.evidence(search.columns, residual, absorbed))


def probability_at_most(search: Search, named: Sequence[IdentifiedEffect]) -> float:
    """Return the probability that one more effect is missing, if nothing of any shape competes.

    Competition only lowers it, so that cases in which it is small need not be judged.
    """
    chosen = [effect.selection.candidate for effect in named]
    odds = log_bayes_factors(with_candidates(search.evidence, chosen), search.candidates)
    odds = np.exp(odds + prior_log_odds(search.candidates))
    total = sum(weight for candidate, weight in zip(search.candidates, odds.tolist(), strict=True)
                if candidate not in chosen)
    return float(total / (1 + total))


def run_cases(count: int, path: Path = FOLDER / "suspicions.json") -> list[dict[str, Any]]:
    """Judge the cases that are not there yet, and return the results of all."""
    found: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    if len(found) >= count:
        return found[:count]
    with TemporaryDirectory(prefix="halbach-fe-") as folder:
        session = Session(find_getdp(None), Path(folder))
        data, _ = simulated(0)
        update = infer(build_magnet(STUDY), data, session, None)
        effects = [effect for effect in catalogue() if effect.name in NAMES]
        base = _scored(update, data, effects, session)
        _check_other_readings(base, update, effects, session)
        flexible = families_of(base, update)
        for seed in range(len(found), count):
            data, name = simulated(seed)
            search = with_readings(base, update, data)
            named = identify_effects(STUDY, search)
            suspected: list[list[Any]] = []
            if probability_at_most(search, named) >= SUSPECTED:
                judgement = judge(search, update, named, flexible)
                suspected = _listed(suspicions(
                    judgement, Further.of(judgement), STUDY, search))
            if named and suspected:
                whole = diagnose(STUDY, data, replace(session, folder=session.folder / str(seed)),
                                 effects=effects)
                named, suspected = whole.identified, _listed(whole.suspected)
            found.append({
                "seed": seed, "hidden": name, "suspected": suspected,
                "named": [effect.selection.candidate.effect for effect in named]})
            write_text(path, json.dumps(found) + "\n")
    return found


def _scored(
    update: InferenceResult, data: xr.Dataset, effects: Sequence[Effect], session: Session
) -> Search:
    return score_hypotheses(Linearization(
        STUDY, (), update, update.prior.mean, Campaign.of(STUDY, data), NominalSolver(session)),
        effects)


def _check_other_readings(
    base: Search, update: InferenceResult, effects: Sequence[Effect], session: Session
) -> None:
    """Check that the comparison for other readings is that of a search of its own.

    One that kept what the first readings had absorbed suspected nothing in 3 000 maps.
    """
    data, _ = simulated(1)
    own = infer(build_magnet(STUDY), data, session, None)
    expected = _scored(own, data, effects, session)
    found = with_readings(base, update, data)
    for name in ("residual", "training", "absorbed"):
        if not np.allclose(getattr(found, name), getattr(expected, name), atol=1e-8):
            raise CheckFailedError(f"`{name}` of a search is not that of its readings.")


def _listed(found: Sequence[Suspicion]) -> list[list[Any]]:
    """Return the effects and the probability of each suspicion."""
    return [[list(one.effects), one.probability] for one in found]


def reliability(found: list[dict[str, Any]]) -> dict[str, float]:
    """Return how often suspicions are true, with its error, and what they stated."""
    stated, there, weight = [], [], []
    for one in found:
        for names, probability in one["suspected"]:
            stated.append(probability)
            there.append(one["hidden"] in names and one["hidden"] not in one["named"])
            weight.append(ODDS if one["hidden"] else 1.0)
    share = np.array(weight) / np.sum(weight)
    true = float(share @ np.array(there, float))
    return {"true": true, "stated": float(share @ np.array(stated)),
            "error": float(np.sqrt(np.sum(share**2 * (np.array(there, float) - true)**2))),
            "suspicions": len(stated)}


def run(note: Note) -> None:
    """Note the reliability of suspicions."""
    found = run_cases(CASES)
    rates = reliability(found)
    note("diagnosis.suspicion_reliability", rates["true"], "ratio",
         f"stated {rates['stated']:.2f}, standard error {rates['error']:.2f}; "
         f"{rates['suspicions']:.0f} suspicions in {len(found)} maps")
    common.say(str(rates))


if __name__ == "__main__":
    run(lambda name, value, unit, against: common.say(f"{name} = {value:.3g} {unit} ({against})"))
