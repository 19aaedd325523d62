"""Compare all effects of a catalogue at one point of linearization."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachError
from halbach_fe.diagnosis.effects.base import Effect, Place
from halbach_fe.diagnosis.evidence import Evidence, Marginal, with_fewer_columns
from halbach_fe.diagnosis.model_selection import (
    Candidate,
    SelectedEffect,
    select_effects,
    with_wide_priors,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.result import Hypothesis, IdentifiedEffect
from halbach_fe.diagnosis.screening import most_likely
from halbach_fe.diagnosis.smooth_discrepancy import fields_of_rms, harmonic_fields
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.instrument import probe_points
from halbach_fe.solver.formulation_choice import iron_change, solve_nominal
from halbach_fe.solver.session import Progress, Session
from halbach_fe.study.model import FIELD_KEYS, Study

Say = Callable[[str], None]
"""A callable that reports progress; its argument is a line of text."""
Signatures = dict[tuple[str, Place], Floats]
"""Whitened signatures by effect name and place: training readings (rows, k) per unit of each of the
effect's k parameters."""


@dataclass(frozen=True)
class NominalSolver:
    """Solves for the fields of nominal magnets, each of them once, and keeps signatures."""

    session: Session
    _solved: dict[tuple[str, str, bytes], Any] = field(default_factory=dict, repr=False)
    _signatures: dict[tuple[str, bytes], Signatures] = field(default_factory=dict, repr=False)

    def signatures(
        self, study: Study, update: InferenceResult, prior_mean: Floats, times: Floats
    ) -> Signatures:
        """Return the store of signatures for a study and its map.

        They depend on everything but the readings: the places and times of the map, its noise, and
        what is known of the blocks.
        """
        parts = (update.observation.map_points, times, update.errors.sd, prior_mean,
                 update.held_out.astype(float))
        key = study.model_dump_json(), b"".join(np.ascontiguousarray(part).tobytes()
                                                for part in parts)
        return self._signatures.setdefault(key, {})

    def field(self, study: Study, points: Floats) -> Floats:
        """Return `solve_nominal` of the magnet of a study at points (n, 3) in m."""
        found: Floats = self._once("field", solve_nominal, study, points)
        return found

    def iron_change(self, study: Study, points: Floats) -> Floats | None:
        """Return `iron_change` of the magnet of a study at points (n, 3) in m."""
        found: Floats | None = self._once("iron", iron_change, study, points)
        return found

    def _once(
        self, name: str, solve: Callable[[Magnet, Floats, Session], Any], study: Study,
        points: Floats
    ) -> Any:
        key = name, study.model_dump_json(include=FIELD_KEYS), points.tobytes()
        if key not in self._solved:
            self._solved[key] = solve(build_magnet(study), points, self.session)
        return self._solved[key]


@dataclass(frozen=True)
class Search:
    """The comparison of all hypotheses at one point of linearization.

    Attributes
    ----------
    hypotheses : tuple of Hypothesis
    candidates : tuple of Candidate
        The same hypotheses, with the numbers of their columns.
    evidence : Evidence
        Evidence of all columns.
    columns : ndarray, shape (rows, k)
        Whitened signatures of all hypotheses, per prior standard deviation of their amplitudes.
    residual : ndarray, shape (rows,)
        Whitened residual of the training readings from the prior mean of the study without the
        identified effects; the columns are fitted to it.
    marginal : Marginal
        The readings with blocks and solver error integrated out.
    training : ndarray, shape (rows,)
        Whitened residual of the training readings with the identified effects in the model.
    nominal : NominalFields
        Of the study from which the search started.
    """

    hypotheses: tuple[Hypothesis, ...]
    candidates: tuple[Candidate, ...]
    evidence: Evidence
    columns: Floats
    residual: Floats
    marginal: Marginal
    training: Floats
    nominal: NominalFields


def apply_effects(study: Study, identified: Sequence[IdentifiedEffect]) -> Study:
    """Return the study with identified effects applied at their amplitudes."""
    for effect in identified:
        hypothesis = effect.hypothesis
        study = hypothesis.effect.apply(study, hypothesis.place, effect.values.tolist())
    return study


def score_hypotheses(
    corrected: Study, start: Sequence[IdentifiedEffect], update: InferenceResult,
    prior_mean: Floats, times: Floats, solver: NominalSolver, effects: Sequence[Effect],
    identified: Sequence[IdentifiedEffect], signatures: Signatures,
    progress: Progress = lambda done, total: None,
) -> Search:
    """Compare all effects at a point where some effects are in the model already.

    The residual is that of the corrected study without the identified effects: their contribution
    is added back to the residual of the current model by their signatures at this point.

    Parameters
    ----------
    corrected : Study
        The study corrected for gross errors and outliers, without any effects.
    start : sequence of IdentifiedEffect
        Effects from which the search started. The signatures of all effects outside the model are
        computed for the study with these.
    update : InferenceResult
        The inference with the identified effects in the model.
    prior_mean : ndarray, shape (parameters,), in A/m
        Prior mean of the magnetizations of the study without effects.
    times : ndarray, shape (n,)
        Time of each point of the map, from 0 at the first to 1 at the last.
    solver : NominalSolver
    effects : sequence of Effect
    identified : sequence of IdentifiedEffect
        The effects in the model of ``update``.
    signatures : dict
        Signatures of effects outside the model. Missing entries are computed and stored, so that
        later rounds reuse them.
    progress : callable, optional
        Called with the numbers of finished and of all hypotheses.
    """
    whitened, response, marginal, training = marginal_of(update)
    residual = training
    study = apply_effects(corrected, start)

    def nominal_fields_of(other: Study) -> NominalFields:
        points = probe_points(other.instrument, update.observation.map_points)
        return NominalFields(other, points, times, lambda changed: solver.field(changed, points),
                             solve_iron=lambda changed: solver.iron_change(changed, points),
                             measured_magnetizations=update.by_block(prior_mean))

    nominal, nominal_start = nominal_fields_of(update.study), nominal_fields_of(study)
    known = solver.signatures(study, update, prior_mean, times)
    in_model = {(effect.hypothesis.effect.name, effect.hypothesis.place): effect
                for effect in identified}
    kept = marginal.remove(response)
    uniform = slice(0, update.magnet.dimension * len(update.magnet.blocks))
    information = response[:, uniform].T @ kept[:, uniform]
    score = kept[:, uniform].T @ training
    shortlisted = [Hypothesis(effect, place) for effect in effects if effect.places(study)
                    for place in dict.fromkeys((
                        *effect.shortlist(update.study, update.prior.mean[uniform], information,
                                          score),
                        *(place for name, place in (*signatures, *in_model)
                          if name == effect.name)))]
    candidates: list[Candidate] = []
    columns: list[Floats] = []
    for number, hypothesis in enumerate(shortlisted):
        progress(number, len(shortlisted))
        effect, place = hypothesis.effect, hypothesis.place
        key = effect.name, place
        present = in_model.get(key)
        if present is None:
            signature = signatures.get(key)
            if signature is None:
                if key not in known:
                    known[key] = whitened(update.observation.read(
                        effect.signature(nominal_start, place)))
                signature = signatures[key] = known[key]
        elif effect.applied_in_full:
            others = apply_effects(
                corrected, [other for other in identified if other is not present])
            amounts = np.pad(present.values,
                             (0, len(amplitude_scale(effect)) - len(present.values)))
            amounts[0] = 1.0
            signature = whitened(update.observation.read(_discrete_signature(
                present.hypothesis, amounts, nominal_fields_of(others))))
            residual = residual + signature @ amounts
        else:
            signature = whitened(update.observation.read(effect.signature(nominal, place)))
            residual = residual + signature @ present.values
        columns.append(signature * amplitude_scale(effect)[:signature.shape[1]])
        candidates.append(Candidate(
            effect.name, place.name, tuple(range(signature.shape[1])),
            effect.is_binary or signature.shape[1] > len(effect.parameters), effect.unique))
    chosen = most_likely(candidates, columns, marginal, residual, {
        number for number, hypothesis in enumerate(shortlisted)
        if (hypothesis.effect.name, hypothesis.place) in in_model})
    ends = np.cumsum([columns[number].shape[1] for number in chosen]).tolist()
    compared = [replace(candidates[number], columns=tuple(range(
        end - columns[number].shape[1], end))) for number, end in zip(chosen, ends, strict=True)]
    stacked = np.hstack([columns[number] for number in chosen])
    return Search(tuple(shortlisted[number] for number in chosen), tuple(compared),
                  marginal.evidence(stacked, residual), stacked, residual, marginal, training,
                  nominal_start)


def marginal_of(
    update: InferenceResult
) -> tuple[Callable[[Floats], Floats], Floats, Marginal, Floats]:
    """Return the training readings of an inference with blocks and solver error integrated out.

    Returns
    -------
    whitened : callable
        Takes all readings (..., readings) in T and returns the whitened training readings
        (rows, ...).
    response : ndarray, shape (rows, parameters)
        Whitened response of the training readings to the magnetizations.
    marginal : Marginal
    residual : ndarray, shape (rows,)
        Whitened residual of the training readings from the prior mean.
    """
    rows = np.flatnonzero(~update.held_out)
    noise = update.errors.subset(rows)

    def whitened(readings: Floats) -> Floats:
        return noise.whiten(np.ascontiguousarray(readings[..., rows].T))

    response = noise.whiten(update.response.matrix[rows])
    marginal = Marginal.of(with_fewer_columns(np.hstack([
        response @ update.prior.root, whitened(_solver_error(update))])))
    residual = whitened(update.readings - update.response.offset
                        - update.response.matrix @ update.prior.mean)
    return whitened, response, marginal, residual


def _solver_error(update: InferenceResult) -> Floats:
    """Return readings (k, n) in T of smooth fields as large as the solver's error.

    The solver's error is smooth, unlike noise. These fields are integrated out with the blocks, so
    that no effect is identified for a misfit that the solver's error can explain.
    """
    size = float(np.sqrt(np.mean(update.response.error**2)))
    points = probe_points(update.study.instrument, update.observation.map_points)
    fields = fields_of_rms(harmonic_fields(points), size) if size else np.zeros((1, *points.shape))
    return update.observation.read(fields)


def _discrete_signature(hypothesis: Hypothesis, amounts: Floats, nominal: NominalFields) -> Floats:
    """Return the signatures (k, n, 3) in T of an effect that is applied in full.

    Such an effect is not linear in its first amplitude, which is 1 if it is present. The first
    signature is the finite difference between the fields with and without the effect at the given
    amounts, less the contribution of its refinements to this difference. The linear signatures of
    the refinements follow it. Effects without refinements have their ordinary signature.

    Parameters
    ----------
    hypothesis : Hypothesis
    amounts : ndarray, shape (k,)
        Amplitudes of the parameters and refinements.
    nominal : NominalFields
        Fields of the study without the effect.
    """
    effect, place, values = hypothesis.effect, hypothesis.place, amounts.tolist()
    if not effect.refinements:
        return effect.signature(nominal, place)
    refined = effect.refine(nominal, place, values)
    changed = nominal.solve(effect.apply(nominal.study, place, values))
    change = changed - nominal.finite_element_field
    return np.concatenate([(change - np.tensordot(amounts[1:], refined, 1))[None], refined])


def identify_effects(
    corrected: Study, search: Search, points: Floats
) -> tuple[IdentifiedEffect, ...]:
    """Select the missing effects and fit their amplitudes, without impossible ones.

    An effect is impossible if an amplitude is below its parameter's minimum (a negative gap, for
    example), if no valid study has it, or if it puts points of the map inside material. Such a
    candidate is excluded and the selection repeated.

    Parameters
    ----------
    corrected : Study
        The study corrected for gross errors and outliers.
    search : Search
    points : ndarray, shape (n, 3), in m
        Points of the map.
    """
    excluded: set[int] = set()
    while True:
        found = amplitudes(
            search, select_effects(search.evidence, search.candidates, excluded=excluded))
        impossible = next((number for number in range(len(found))
                    if not possible(corrected, found[:number + 1], points)), None)
        if impossible is None:
            return found
        excluded.add(search.candidates.index(found[impossible].selection.candidate))


def possible(study: Study, identified: Sequence[IdentifiedEffect], points: Floats) -> bool:
    """Tell whether a valid study can have effects of these amplitudes, with the map's points in
    air.
    """
    if any(value < parameter.minimum for effect in identified
           for value, parameter in zip(effect.values, effect.parameters, strict=True)):
        return False
    try:
        changed = apply_effects(study, identified)
        inside = build_magnet(changed).contains(probe_points(changed.instrument, points))
    except HalbachError:
        return False
    return not inside.any()


def amplitudes(search: Search, selected: Sequence[SelectedEffect]) -> tuple[IdentifiedEffect, ...]:
    """Fit the amplitudes of all selected effects jointly."""
    evidence = search.evidence
    for selection in selected:
        if selection.candidate.is_binary:
            evidence = evidence.shifted(selection.candidate.columns[0])
    fit = with_wide_priors(evidence, [selection.candidate for selection in selected]).fit(
        [column for selection in selected for column in selection.candidate.free])
    deviation = np.sqrt(np.diag(fit.covariance))
    identified, first = [], 0
    for selection in selected:
        hypothesis = search.hypotheses[search.candidates.index(selection.candidate)]
        free, fixed = len(selection.candidate.free), int(selection.candidate.is_binary)
        scale = amplitude_scale(hypothesis.effect)[fixed:fixed + free]
        part = slice(first, first + free)
        identified.append(IdentifiedEffect(
            hypothesis, np.concatenate([np.ones(fixed), scale * fit.mean[part]]),
            np.concatenate([np.zeros(fixed), scale * deviation[part]]), selection))
        first += free
    return tuple(identified)


def amplitude_scale(effect: Effect) -> Floats:
    """Return the prior standard deviations of an effect's parameters and refinements."""
    return np.array([parameter.sd for parameter in (*effect.parameters, *effect.refinements)])
