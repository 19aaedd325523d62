"""Select the missing effects, and find those that the readings cannot distinguish.

A candidate is an effect at one place (a block or a seam, for example), with one or more amplitudes.
The prior probability of an effect is shared by its candidates, so that an effect which may be in
any of hundreds of blocks has no advantage.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Evidence

DETECTION_LOG_ODDS = 5.0
"""Log posterior odds above which an effect is selected."""

INDISTINGUISHABLE_LOG_EVIDENCE = 3.0
"""Difference in log evidence below which the readings do not distinguish two explanations."""

WIDE_PRIOR_SD = 5.0
"""Standard deviation of the wide prior, in units of the usual one. Both have probability 1/2. With
the usual prior alone, one effect that is much larger than usual would be divided between two
similar effects."""

WIDE_PRIOR_FROM = float(np.sqrt(np.log(WIDE_PRIOR_SD) * 2 / (1 - WIDE_PRIOR_SD**-2)))
"""Amplitude above which the wide prior is the more probable one: 1.83 usual standard deviations."""

EFFECT_PRIOR_ODDS = 1 / 50
"""Prior odds that an effect is missing."""

MAX_EFFECTS = 6
"""Largest number of effects that are selected. Among so many, some take the place of a cause
outside the catalogue."""


@dataclass(frozen=True)
class Candidate:
    """An effect at one place.

    Attributes
    ----------
    effect : str
    place : str
        Name of the block, seam or point; empty for effects that have only one place.
    columns : tuple of int
        The candidate's columns of the evidence.
    is_binary : bool
        Whether the amplitude of the first column is exactly 1 if the effect is present, as of a
        missing block.
    unique : bool
        Whether the effect can be present at one place at most.
    places : int or None
        Number of places of the effect, which share its prior probability; None if all of them are
        candidates.
    """

    effect: str
    place: str
    columns: tuple[int, ...]
    is_binary: bool = False
    unique: bool = False
    places: int | None = None

    @property
    def free(self) -> tuple[int, ...]:
        """Columns whose amplitudes are fitted."""
        return self.columns[1:] if self.is_binary else self.columns

    @property
    def name(self) -> str:
        """Effect and place."""
        return f"{self.effect} {self.place}".strip()


@dataclass(frozen=True)
class SelectedEffect:
    """A candidate that is missing from the model, and its alternatives.

    Attributes
    ----------
    candidate : Candidate
    log_bayes_factor : float
        Log Bayes factor of the model with the candidate over that without it. The other selected
        effects are in both.
    log_odds : float
        Log posterior odds: the log Bayes factor plus the log prior odds of the effect at this
        place.
    alternatives : tuple of (Candidate, float)
        Candidates that explain the readings equally well in place of this one, with their log Bayes
        factors.
    """

    candidate: Candidate
    log_bayes_factor: float
    log_odds: float
    alternatives: tuple[tuple[Candidate, float], ...]

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that the readings cannot distinguish, the likeliest first."""
        return tuple(dict.fromkeys(
            (self.candidate.effect, *(other.effect for other, _ in self.alternatives))))


def prior_log_odds(candidates: Sequence[Candidate]) -> Floats:
    """Return the log prior odds (candidates,) of each candidate."""
    names = [candidate.effect for candidate in candidates]
    counts = {name: names.count(name) for name in set(names)}
    return np.array([np.log(EFFECT_PRIOR_ODDS / (candidate.places or counts[candidate.effect]))
                     for candidate in candidates])


def log_bayes_factors(evidence: Evidence, candidates: Sequence[Candidate]) -> Floats:
    """Return the log Bayes factor (candidates,) of each candidate over no effect."""
    factors = np.empty(len(candidates))
    free = [number for number, candidate in enumerate(candidates) if not candidate.is_binary]
    columns = [candidates[number].columns for number in free]
    wide = evidence.widened(range(len(evidence.prior)), WIDE_PRIOR_SD)
    factors[free] = np.logaddexp(evidence.log_evidences(columns), wide.log_evidences(columns)
                               ) - np.log(2)
    for number, candidate in enumerate(candidates):
        if candidate.is_binary:
            factors[number] = log_evidence(evidence, [candidate])
    return factors


def with_wide_priors(evidence: Evidence, candidates: Sequence[Candidate]) -> Evidence:
    """Return the evidence with the wide prior for those of the given candidates that are large.

    All given candidates are in the model together.
    """
    free = [column for candidate in candidates for column in candidate.free]
    sizes = dict(zip(free, evidence.widened(free, WIDE_PRIOR_SD).fit(free).mean**2, strict=True))
    large = [column for candidate in candidates for column in candidate.free
             if np.mean([sizes[other] for other in candidate.free]) > WIDE_PRIOR_FROM**2]
    return evidence.widened(large, WIDE_PRIOR_SD)


def with_candidates(evidence: Evidence, candidates: Sequence[Candidate]) -> Evidence:
    """Return the evidence with candidates in the model and their amplitudes integrated out."""
    for candidate in candidates:
        if candidate.is_binary:
            evidence = evidence.shifted(candidate.columns[0])
    return with_wide_priors(evidence, candidates).given(
        [column for candidate in candidates for column in candidate.free])


def log_evidence(evidence: Evidence, candidates: Sequence[Candidate]) -> float:
    """Return the log evidence of several candidates together, over that of no effect."""
    total = 0.0
    for candidate in candidates:
        if candidate.is_binary:
            column = candidate.columns[0]
            own = evidence.part(np.array([column]))[0, 0]
            total += float(evidence.score[column] - own / 2)
            evidence = evidence.shifted(column)
        total -= np.log(2) * bool(candidate.free)
    return total + with_wide_priors(evidence, candidates).fit(
        [column for candidate in candidates for column in candidate.free]).log_evidence


def select_effects(
    evidence: Evidence, candidates: Sequence[Candidate], max_effects: int = MAX_EFFECTS,
    excluded: Collection[int] = (),
) -> list[SelectedEffect]:
    """Select missing effects one at a time, and drop those that later ones make needless.

    Parameters
    ----------
    evidence : Evidence
    candidates : sequence of Candidate
    max_effects : int
        Largest number of effects.
    excluded : collection of int
        Numbers of candidates that cannot be selected, because their amplitudes are impossible.
    """
    prior = prior_log_odds(candidates)
    chosen: list[int] = []
    while candidates and len(chosen) < max_effects:
        conditional = with_candidates(evidence, [candidates[number] for number in chosen])
        odds = log_bayes_factors(conditional, candidates) + prior
        odds[[*chosen, *excluded]] = -np.inf
        taken = {candidates[number].effect for number in chosen if candidates[number].unique}
        odds[[number for number, candidate in enumerate(candidates)
              if candidate.effect in taken]] = -np.inf
        best = int(np.argmax(odds))
        if odds[best] < DETECTION_LOG_ODDS:
            break
        before = len(chosen)
        chosen = _at_best_places(evidence, candidates, [*chosen, best], excluded)
        best = chosen[-1]
        chosen = _without_needless(evidence, candidates, chosen, prior)
        if best not in chosen or len(chosen) <= before - 1:
            break  # else the same candidates would be added and dropped for ever
    return [selected_effect(evidence, candidates, chosen, number, prior, excluded)
            for number in chosen]


def _at_best_places(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: list[int],
    excluded: Collection[int],
) -> list[int]:
    """Move unique effects to their best places, given the other chosen candidates."""
    chosen = list(chosen)
    for index, number in enumerate(chosen):
        if candidates[number].unique:
            others = [candidates[k] for k in chosen if k != number]
            places = [k for k, candidate in enumerate(candidates)
                      if candidate.effect == candidates[number].effect and k not in excluded]
            factors = log_bayes_factors(with_candidates(evidence, others),
                                        [candidates[k] for k in places])
            chosen[index] = places[int(np.argmax(factors))]
    return chosen


def _without_needless(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: list[int], prior: Floats
) -> list[int]:
    """Drop candidates whose odds given the others are too small, the smallest first."""
    while len(chosen) > 1:
        odds = [float(log_bayes_factors(
            with_candidates(evidence, [candidates[k] for k in chosen if k != number]),
                            [candidates[number]])[0]) + prior[number] for number in chosen]
        worst = int(np.argmin(odds))
        if odds[worst] >= DETECTION_LOG_ODDS:
            break
        chosen = chosen[:worst] + chosen[worst + 1:]
    return chosen


def selected_effect(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: Sequence[int], number: int,
    prior: Floats, excluded: Collection[int],
) -> SelectedEffect:
    """Return one chosen candidate with its odds and alternatives."""
    others = [candidates[k] for k in chosen if k != number]
    conditional = with_candidates(evidence, others)
    factors = log_bayes_factors(conditional, candidates)
    odds = factors + prior
    alternatives = [k for k in np.argsort(-odds)
                    if k != number and k not in chosen and k not in excluded
                    and odds[k] > odds[number] - INDISTINGUISHABLE_LOG_EVIDENCE]
    return SelectedEffect(candidates[number], float(factors[number]), float(odds[number]), tuple(
        (candidates[k], float(factors[k])) for k in alternatives))


def probabilities(evidence: Evidence, candidates: Sequence[Candidate]) -> dict[str, float]:
    """Return the posterior probability of each effect, and of ``none``.

    The probabilities hold on the assumption that at most one effect is missing.
    """
    log_odds = log_bayes_factors(evidence, candidates) + prior_log_odds(candidates)
    top = max(0.0, float(log_odds.max(initial=0.0)))
    weights = np.exp(log_odds - top)
    total = float(np.exp(-top) + weights.sum())
    found = {"none": float(np.exp(-top)) / total}
    for candidate, weight in zip(candidates, weights, strict=True):
        found[candidate.effect] = found.get(candidate.effect, 0.0) + float(weight) / total
    return found


def best_factors(
    evidence: Evidence, candidates: Sequence[Candidate], others: Sequence[Sequence[str]] = ()
) -> dict[str, float]:
    """Return the largest log Bayes factor of each effect at any place.

    It is over the model without effects or, if ``others`` is given, over the model with one
    candidate of each of these groups of names: the candidate that is best by itself.
    """
    single_factors = log_bayes_factors(evidence, candidates)
    beside = [max((k for k, candidate in enumerate(candidates) if candidate.effect in names),
                  key=lambda k: single_factors[k]) for names in others]
    factors = log_bayes_factors(with_candidates(evidence, [candidates[k] for k in beside]),
                                candidates)
    found: dict[str, float] = {}
    for candidate, factor in zip(candidates, factors, strict=True):
        found[candidate.effect] = max(found.get(candidate.effect, -np.inf), float(factor))
    return found
