"""From a disagreement to its name: which effects a study lacks, and the study that has them.

First what spoils all else is put right: a map that was misread, and single readings that are off.
Where the solver's own error explains the misfit, that is all there is to say.
Then effects are searched with their signatures, linear and cheap; those found go into the study in
full and are solved for again, which moves the point of linearization, until nothing changes: a
Gauss-Newton method whose model is the real one. In every round all effects compete anew, the found
ones with their signatures at that point. Positions that shake are noise, with which all is judged
once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect, Place
from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.diagnosis.gross_errors import GrossError, find_gross_errors
from halbach_fe.diagnosis.loo_residuals import ResidualGroup, loo_residuals, residual_groups
from halbach_fe.diagnosis.model_selection import (
    Candidate,
    SelectedEffect,
    probabilities,
)
from halbach_fe.diagnosis.outliers import Outlier, excluding, outliers_of
from halbach_fe.diagnosis.position_noise import (
    estimate_position_noise,
    has_settled,
    with_position_noise,
)
from halbach_fe.diagnosis.result import Diagnosis, Hypothesis, IdentifiedEffect
from halbach_fe.diagnosis.search import (
    NominalSolver,
    Say,
    Search,
    Signatures,
    apply_effects,
    identify_effects,
    memoized_solver,
    score_hypotheses,
)
from halbach_fe.diagnosis.solver_error import SolverErrorExplanation, explain_by_solver_error
from halbach_fe.diagnosis.unknown_cause import find_unknown_cause
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.instrument import map_time
from halbach_fe.solver.session import Session
from halbach_fe.study.model import Study

MOST_ROUNDS = 8
SETTLED = 0.2
"""Of an amplitude's standard deviation: less between rounds is no change."""

ON_AXIS_M = 1e-6
"""Distance from the axis below which a point has no angle."""


def diagnose(
    study: Study, data: xr.Dataset, session: Session, blocks: BlockTable | None = None,
    effects: Sequence[Effect] | None = None, unseen: xr.Dataset | None = None,
    say: Say = lambda text: None, solver: NominalSolver | None = None,
) -> Diagnosis:
    """Find which effects a study lacks to explain a map.

    Parameters
    ----------
    effects : sequence of Effect, optional
        To choose from; default the whole catalogue.
    unseen : Dataset, optional
        Another map, which is only predicted.
    solver : callable, optional
        Of nominal magnets, see `memoized_solver`; default one of its own.
    """
    effects = catalogue() if effects is None else effects
    gross, read, start = _read_right(study, data, blocks, effects)
    for one in gross:
        say(f"gross error: {one.reading.text}")
    if blocks is not None and read.array.rings != study.array.rings:
        nowhere = np.zeros_like(blocks.ring)  # which ring is which is not known then
        blocks = replace(blocks, ring=nowhere, slot=nowhere)
    signatures: Signatures = {}
    solver = solver or memoized_solver(replace(_room(session, "signatures"), progress=None))
    times = np.concatenate([map_time(one) for one in (data, unseen) if one is not None])
    first: tuple[InferenceResult, Search] | None = None
    named, vibration, at_rest = start, None, True
    outliers: tuple[Outlier, ...] = ()
    numerical: SolverErrorExplanation | None = None

    def updated(name: str) -> InferenceResult:
        changed = with_position_noise(apply_effects(read, named), vibration)
        return infer(build_magnet(changed), data, _room(session, name), blocks,
                     unseen=unseen)

    for number in range(MOST_ROUNDS):
        say(f"round {number + 1}: the model with "
            f"{', '.join(one.found.candidate.name for one in named) or 'nothing added'}")
        update = updated(f"round-{number + 1}")
        if number == 0:
            outliers = outliers_of(update)
        if number == 0 and outliers:
            say(f"outliers: {len(outliers)}; without them")
            read = excluding(read, outliers)
            update = updated("without-outliers")
        known = (first[0] if first else update).prior.mean
        search = score_hypotheses(read, start, update, known, times, solver, effects, named,
                                  signatures,
                      session.progress or (lambda done, total: None))
        first = first or (update, search)
        numerical = None if named else explain_by_solver_error(update)
        if numerical:
            say("the solver's own error explains the misfit")
            break
        shaken = estimate_position_noise(update, search.marginal, search.columns, search.training,
                                         vibration)
        if not has_settled(vibration, shaken):
            say(f"vibration: {1e3 * shaken.sd_m if shaken else 0:.2g} mm; with it in the noise")
            vibration = shaken
            signatures.clear()  # whitened by the noise that it was
            continue
        found = identify_effects(read, search, update.observation.map_points)
        at_rest = _settled(named, found)
        if at_rest:
            break
        named = found
    assert first is not None
    rest = None if numerical else find_unknown_cause(search, update, named)
    if rest is not None and rest.alone:
        named, vibration, (update, search) = start, None, first
    return Diagnosis(
        read=read, before=first[0], after=update, named=named, unknown=rest,
        probabilities=probabilities(first[1].evidence, first[1].candidates),
        evidence=first[1].evidence, candidates=first[1].candidates,
        groups_before=_groups(first[0], first[1].marginal, first[1].training),
        groups_after=_groups(update, search.marginal, search.training),
        left_out_before=loo_residuals(first[1].marginal, first[1].training),
        left_out_after=loo_residuals(search.marginal, search.training), rounds=number + 1,
        gross=gross, outliers=outliers, vibration=vibration, numerical=numerical,
        at_rest=at_rest)


def _read_right(
    study: Study, data: xr.Dataset, blocks: BlockTable | None, effects: Sequence[Effect]
) -> tuple[tuple[GrossError, ...], Study, tuple[IdentifiedEffect, ...]]:
    """Gross errors and the study that reads the map right; of points that were elsewhere by what an
    effect of the catalogue can be, that effect, with which a search is to start.
    """
    found = find_gross_errors(study, data, blocks)
    known = {effect.name: effect for effect in effects}
    start: tuple[IdentifiedEffect, ...] = ()
    if found and found[-1].start and found[-1].start.keys() <= known.keys():
        start = tuple(
            IdentifiedEffect(Hypothesis(known[name], Place()), np.array(values),
                             np.zeros(len(values)),
                  SelectedEffect(Candidate(name, "", ()), 0.0, 0.0, ()))
            for name, values in found[-1].start.items())
        found = found[:-1]
    for one in found:
        study = one.apply(study)
    return found, study, start


def _settled(old: Sequence[IdentifiedEffect], new: Sequence[IdentifiedEffect]) -> bool:
    """Tell whether a round changed nothing."""
    before = {one.hypothesis: one for one in old}
    return before.keys() == {one.hypothesis for one in new} and all(
        _alike(before[one.hypothesis], one) for one in new)


def _alike(one: IdentifiedEffect, other: IdentifiedEffect) -> bool:
    """Tell whether amplitudes are the same; of what is there or not the strength does not count."""
    if len(one.values) != len(other.values):
        return False
    close = np.abs(one.values - other.values) <= SETTLED * other.sd
    return bool(close[one.hypothesis.effect.discrete:].all())


def _groups(update: InferenceResult, marginal: Marginal, residual: Floats) -> list[ResidualGroup]:
    """Disagreement by z window, angle, radius, component."""
    chosen = ~update.held_out
    x, y, z = update.observation.positions[chosen].T
    angle, radius = np.degrees(np.arctan2(y, x)) % 360, np.hypot(x, y)
    edges = np.linspace(z.min(), z.max() + 1e-9, 13)
    window = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, 11)
    members = {
        "z": [f"{edges[k]:.3f} ... {edges[k + 1]:.3f} m" for k in window],
        "angle": [f"{30 * int(one // 30)} ... {30 * int(one // 30) + 30} deg"
                  if distance > ON_AXIS_M else "on the axis"
                  for one, distance in zip(angle, radius, strict=True)],
        "radius": [f"{one:.4f} m" for one in radius],
        "label": [label for label, keep in zip(update.observation.labels, chosen, strict=True)
                  if keep]}
    used = {kind: names for kind, names in members.items() if 1 < len(set(names)) <= 40}
    return residual_groups(marginal, residual, used)


def _room(session: Session, name: str) -> Session:
    return replace(session, folder=session.folder / name)
