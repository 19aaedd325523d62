"""What named effects leave unexplained: a smooth field, or an error of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from halbach_fe.diagnosis.model_selection import (
    ALIKE,
    EFFECT_ODDS,
    FOUND,
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
                       named: Sequence[IdentifiedEffect]) -> UnknownCause | None:
    """Judge what named effects leave: a smooth field, or a smooth error of the sensors."""
    rows = np.flatnonzero(~update.held_out)
    noise, observation = update.errors.part(rows), update.observation
    points = probe_points(update.study.instrument, observation.map_points)
    scale = float(np.median(update.errors.sd))
    # columns of this search: other places may have been looked at in the one that found them
    numbers = [search.hypotheses.index(one.hypothesis) for one in named]
    mine = [search.candidates[number] for number in numbers]
    held = [column for one in mine for column in one.columns]
    own = [replace(one, columns=tuple(held.index(column) for column in one.columns))
           for one in mine]
    kinds: dict[Literal["field", "instrument", "either"], SmoothTerms] = {
        "field": harmonic_fields(points), "instrument": sensor_errors(points)}
    beside, instead = [], []
    for kind, terms in kinds.items():
        readings = observation.read(scale * terms.fields)
        smooth = noise.whiten(np.ascontiguousarray(readings[:, rows].T))
        both = search.marginal.evidence(
            np.hstack([search.columns[:, held], smooth]), search.residual)
        added = range(len(held), both.information.shape[0])
        rest = judge_smooth_terms(with_candidates(both, own).only(added), terms.fineness)
        only = judge_smooth_terms(both.only(added), terms.fineness)
        beside.append((rest.log_bayes_factor, kind, rest))
        instead.append((only.log_bayes_factor, kind, only))
    beside.sort(key=lambda one: -one[0])
    instead.sort(key=lambda one: -one[0])
    outside = float(np.log(EFFECT_ODDS))
    remains = beside[0][0] + outside >= FOUND
    # several effects that happen to add up to one thing pay for each of them
    odds = log_evidence(both, own) + prior_log_odds(search.candidates)[numbers].sum()
    ahead = instead[0][0] + outside - odds if mine else -np.inf
    alone = bool(ahead > ALIKE)
    as_well = bool(len(mine) > 1 and abs(ahead) <= ALIKE and not remains)
    if not (remains or alone or as_well):
        return None
    (factor, kind, best), (second, *_) = instead if alone or as_well else beside
    size = scale * np.linalg.norm(np.tensordot(best.mean, kinds[kind].fields, 1), axis=1)
    source = None
    if kind == "field":
        others = [] if alone or as_well else mine
        factors = log_bayes_factors(with_candidates(search.evidence, others), search.candidates)
        dipoles = [number for number, one in enumerate(search.hypotheses)
                   if one.effect.name == "ferromagnetic_object"]
        if dipoles:
            source = search.hypotheses[max(dipoles, key=lambda k: factors[k])].place.at_m
    return UnknownCause("either" if factor - second < ALIKE else kind, factor,
                   alone or not mine, as_well, float(size.max()),
                   tuple(points[int(np.argmax(size))].tolist()), source)
