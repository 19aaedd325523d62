"""The comparison of all effects at one point of linearization."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachError
from halbach_fe.diagnosis.effects.base import Effect, Place
from halbach_fe.diagnosis.evidence import Evidence, Marginal
from halbach_fe.diagnosis.model_selection import (
    Candidate,
    SelectedEffect,
    select_effects,
    tailored,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.result import Hypothesis, IdentifiedEffect
from halbach_fe.diagnosis.smooth_discrepancy import (
    harmonic_fields,
    of_size,
)
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.instrument import probe_points
from halbach_fe.solver.field import solve_nominal
from halbach_fe.solver.session import Progress, Session
from halbach_fe.study.model import FIELD_KEYS, Study

Say = Callable[[str], None]
NominalSolver = Callable[[Study, Floats], Floats]
Signatures = dict[tuple[str, Place], Floats]
"""Whitened training readings (rows, k) per unit of each parameter, by effect and place."""


@dataclass(frozen=True)
class Search:
    """All effects compared at one point of linearization.

    ``columns`` are the whitened signatures (rows, k), ``residual`` (rows,) what they explain;
    ``training`` is the whitened residual of the training readings from the prior mean, with named
    effects in the model.
    """

    hypotheses: tuple[Hypothesis, ...]
    candidates: tuple[Candidate, ...]
    evidence: Evidence
    columns: Floats
    residual: Floats
    marginal: Marginal
    training: Floats


def apply_effects(study: Study, named: Sequence[IdentifiedEffect]) -> Study:
    """The study with effects in full."""
    for one in named:
        study = one.hypothesis.effect.apply(study, one.hypothesis.place, one.values.tolist())
    return study


def score_hypotheses(
    read: Study, start: Sequence[IdentifiedEffect], update: InferenceResult, known: Floats,
    times: Floats,
    solver: NominalSolver, effects: Sequence[Effect], named: Sequence[IdentifiedEffect],
    signatures: Signatures,
    progress: Progress = lambda done, total: None,
) -> Search:
    """Compare all effects at the point where some are in the model already.

    The residual is that of the study ``read`` without them: what they do is added back, by their
    signatures at this point. Other effects keep the ``signatures`` that they had first, with those
    in the model with which the search ``start``s. ``known`` are the magnetizations (parameters,) in
    A/m that the prior expects without any effects.
    """
    rows = np.flatnonzero(~update.held_out)
    noise = update.errors.part(rows)

    def whitened(readings: Floats) -> Floats:
        """All readings (..., readings) to training ones (rows, ...)."""
        return noise.whiten(np.ascontiguousarray(readings[..., rows].T))

    response = noise.whiten(update.response.matrix[rows])
    marginal = Marginal.of(np.hstack([response @ update.prior.root,
                                      whitened(_solver_error(update))]))
    training = whitened(update.readings - update.response.offset
                        - update.response.matrix @ update.prior.mean)
    residual = training
    study = apply_effects(read, start)

    def scene_of(other: Study) -> NominalFields:
        points = probe_points(other.instrument, update.observation.map_points)
        return NominalFields(other, points, times, lambda one: solver(one, points),
                     known=known.reshape(-1, other.dimension))

    scene, bare = scene_of(update.study), scene_of(study)
    there = {(one.hypothesis.effect.name, one.hypothesis.place): one for one in named}
    kept = marginal.remove(response)
    information, score = response.T @ kept, kept.T @ training
    worth_a_look = [Hypothesis(effect, place) for effect in effects if effect.places(study)
                    for place in dict.fromkeys((
                        *effect.shortlist(update.study, update.prior.mean, information, score),
                        *(place for name, place in (*signatures, *there) if name == effect.name)))]
    candidates: list[Candidate] = []
    columns: list[Floats] = []
    width = 0
    for number, hypothesis in enumerate(worth_a_look):
        progress(number, len(worth_a_look))
        effect, place = hypothesis.effect, hypothesis.place
        key = effect.name, place
        present = there.get(key)
        if present is None:
            seen = signatures.get(key)
            if seen is None:
                seen = signatures[key] = whitened(update.observation.read(
                    effect.signature(bare, place)))
        elif effect.discrete:
            others = apply_effects(read, [one for one in named if one is not present])
            amounts = np.pad(present.values,
                             (0, len(amplitude_scale(effect)) - len(present.values)))
            amounts[0] = 1.0
            seen = whitened(update.observation.read(_whole(
                present.hypothesis, amounts, scene_of(others))))
            residual = residual + seen @ amounts
        else:
            seen = whitened(update.observation.read(effect.signature(scene, place)))
            residual = residual + seen @ present.values
        columns.append(seen * amplitude_scale(effect)[:seen.shape[1]])
        candidates.append(Candidate(
            effect.name, place.name, tuple(range(width, width + seen.shape[1])),
            effect.certain or seen.shape[1] > len(effect.parameters), effect.only))
        width += seen.shape[1]
    stacked = np.hstack(columns)
    return Search(tuple(worth_a_look), tuple(candidates), marginal.evidence(stacked, residual),
                  stacked, residual, marginal, training)


def _solver_error(update: InferenceResult) -> Floats:
    """Readings (k, n) of smooth fields as large as the solver's error, which no noise is; it is
    part of what is integrated out with the blocks.
    """
    size = float(np.sqrt(np.mean(update.response.error**2)))
    points = probe_points(update.study.instrument, update.observation.map_points)
    fields = of_size(harmonic_fields(points), size) if size else np.zeros((1, *points.shape))
    return update.observation.read(fields)


def _whole(hypothesis: Hypothesis, amounts: Floats, scene: NominalFields) -> Floats:
    """Signatures (k, n, 3) of an effect that is there as a whole, in a scene without it: what it
    does at these amounts, less what its refinements do of that, and these.
    """
    effect, place, values = hypothesis.effect, hypothesis.place, amounts.tolist()
    if not effect.refinements:
        return effect.signature(scene, place)
    refined = effect.refine(scene, place, values)
    there = scene.solve(effect.apply(scene.study, place, values)) - scene.solved
    return np.concatenate([(there - np.tensordot(amounts[1:], refined, 1))[None], refined])


def memoized_solver(session: Session) -> NominalSolver:
    """Solve for the fields (n, 3) in T of nominal magnets at points (n, 3) in m, each once."""
    known: dict[tuple[str, bytes], Floats] = {}

    def solve(study: Study, points: Floats) -> Floats:
        key = study.model_dump_json(include=FIELD_KEYS), points.tobytes()
        if key not in known:
            known[key] = solve_nominal(build_magnet(study), points, session)
        return known[key]
    return solve


def identify_effects(read: Study, search: Search, points: Floats) -> tuple[IdentifiedEffect, ...]:
    """What is missing, of what can be: no gap is negative, and the points (n, 3) in m of the map
    are in air.
    """
    barred: set[int] = set()
    while True:
        found = _amplitudes(
            search, select_effects(search.evidence, search.candidates, barred=barred))
        bad = next((number for number in range(len(found))
                    if not _possible(read, found[:number + 1], points)), None)
        if bad is None:
            return found
        barred.add(search.candidates.index(found[bad].found.candidate))


def _possible(study: Study, named: Sequence[IdentifiedEffect], points: Floats) -> bool:
    """Tell whether a study can have effects of their amplitudes."""
    if any(value < parameter.least for one in named
           for value, parameter in zip(one.values, one.parameters, strict=True)):
        return False
    try:
        changed = Study.model_validate(apply_effects(study, named).model_dump())
        inside = build_magnet(changed).contains(probe_points(changed.instrument, points))
    except (ValidationError, HalbachError):
        return False
    return not inside.any()


def _amplitudes(search: Search, found: Sequence[SelectedEffect]) -> tuple[IdentifiedEffect, ...]:
    """Amplitudes of found effects, all together."""
    evidence = search.evidence
    for one in found:
        if one.candidate.certain:
            evidence = evidence.shifted(one.candidate.columns[0])
    fit = tailored(evidence, [one.candidate for one in found]).fit(
        [column for one in found for column in one.candidate.free])
    deviation = np.sqrt(np.diag(fit.covariance))
    named, first = [], 0
    for one in found:
        hypothesis = search.hypotheses[search.candidates.index(one.candidate)]
        free, fixed = len(one.candidate.free), int(one.candidate.certain)
        scale = amplitude_scale(hypothesis.effect)[fixed:fixed + free]
        part = slice(first, first + free)
        named.append(IdentifiedEffect(
            hypothesis, np.concatenate([np.ones(fixed), scale * fit.mean[part]]),
            np.concatenate([np.zeros(fixed), scale * deviation[part]]), one))
        first += free
    return tuple(named)


def amplitude_scale(effect: Effect) -> Floats:
    """Prior standard deviations of all amplitudes, refinements too."""
    return np.array([parameter.sd for parameter in (*effect.parameters, *effect.refinements)])
