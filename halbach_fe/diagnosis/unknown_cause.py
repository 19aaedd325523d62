"""Detect a smooth field, or a smooth error of the sensors, that the identified effects leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from halbach_fe.diagnosis.model_selection import (
    DETECTION_LOG_ODDS,
    EFFECT_PRIOR_ODDS,
    INDISTINGUISHABLE_LOG_EVIDENCE,
    log_bayes_factors,
    log_evidence,
    prior_log_odds,
    with_candidates,
)
from halbach_fe.diagnosis.result import IdentifiedEffect, UnknownCause
from halbach_fe.diagnosis.search import Search
from halbach_fe.diagnosis.smooth_discrepancy import (
    SmoothTerms,
    harmonic_fields,
    judge_smooth_terms,
    sensor_errors,
)
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.instrument import probe_points


def find_unknown_cause(search: Search, update: InferenceResult,
                       identified: Sequence[IdentifiedEffect]) -> UnknownCause | None:
    """Compare smooth discrepancies with the identified effects, and beside them.

    Both kinds of smooth discrepancy, a field and an error of the sensors, are compared twice:
    beside the identified effects, which shows what these leave unexplained, and in place of them,
    which shows whether several effects merely add up to one unknown cause.

    Returns
    -------
    UnknownCause or None
        None if the identified effects leave nothing smooth and are the better explanation.
    """
    rows = np.flatnonzero(~update.held_out)
    noise, observation = update.errors.subset(rows), update.observation
    points = probe_points(update.study.instrument, observation.map_points)
    scale = float(np.median(update.errors.sd))
    # the search that selected the effects may have had other places, and so other columns
    numbers = [search.hypotheses.index(effect.hypothesis) for effect in identified]
    own = [search.candidates[number] for number in numbers]
    columns = [column for candidate in own for column in candidate.columns]
    renumbered = [
        replace(candidate, columns=tuple(columns.index(column) for column in candidate.columns))
        for candidate in own]
    kinds: dict[Literal["field", "instrument", "either"], SmoothTerms] = {
        "field": harmonic_fields(points), "instrument": sensor_errors(points)}
    beside, instead = [], []
    for kind, terms in kinds.items():
        readings = observation.read(scale * terms.fields)
        smooth = noise.whiten(np.ascontiguousarray(readings[:, rows].T))
        both = search.marginal.evidence(
            np.hstack([search.columns[:, columns], smooth]), search.residual)
        added = range(len(columns), both.information.shape[0])
        rest = judge_smooth_terms(with_candidates(both, renumbered).only(added), terms.fineness)
        in_place = judge_smooth_terms(both.only(added), terms.fineness)
        beside.append((rest.log_bayes_factor, kind, rest))
        instead.append((in_place.log_bayes_factor, kind, in_place))
    beside.sort(key=lambda explanation: -explanation[0])
    instead.sort(key=lambda explanation: -explanation[0])
    prior_log_odds_unknown = float(np.log(EFFECT_PRIOR_ODDS))
    remains = beside[0][0] + prior_log_odds_unknown >= DETECTION_LOG_ODDS
    # each of several effects that merely add up to the discrepancy costs its own prior odds
    odds = log_evidence(both, renumbered) + prior_log_odds(search.candidates)[numbers].sum()
    advantage = instead[0][0] + prior_log_odds_unknown - odds if own else -np.inf
    alone = bool(advantage > INDISTINGUISHABLE_LOG_EVIDENCE)
    ambiguous = bool(
        len(own) > 1 and abs(advantage) <= INDISTINGUISHABLE_LOG_EVIDENCE and not remains)
    if not (remains or alone or ambiguous):
        return None
    (factor, kind, best), (second, *_) = instead if alone or ambiguous else beside
    size = scale * np.linalg.norm(np.tensordot(best.mean, kinds[kind].fields, 1), axis=1)
    source = None
    if kind == "field":
        others = [] if alone or ambiguous else own
        factors = log_bayes_factors(with_candidates(search.evidence, others), search.candidates)
        dipoles = [number for number, hypothesis in enumerate(search.hypotheses)
                   if hypothesis.effect.name == "ferromagnetic_object"]
        if dipoles:
            source = search.hypotheses[max(dipoles, key=lambda k: factors[k])].place.at_m
    return UnknownCause(
        "either" if factor - second < INDISTINGUISHABLE_LOG_EVIDENCE else kind, factor,
        alone or not own, ambiguous, float(size.max()),
        tuple(points[int(np.argmax(size))].tolist()), source)
