"""Which effects are missing: their probabilities, and those that the readings cannot tell apart.

A candidate is an effect at one place (a block, a seam), with one or more amplitudes. An effect's
prior probability is shared by its candidates, so that the search among hundreds of blocks pays for
itself.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Evidence

FOUND = 5.0
"""Log of the posterior odds, of an effect being missing, from which it is called found."""

ALIKE = 3.0
"""Log evidence by which candidates must differ to be told apart."""

WIDE = 5.0
"""Standard deviations that an amplitude has with probability 1/2, in place of 1: what is much
larger than usual is one large effect, not two that share it."""

WIDE_FROM = float(np.sqrt(np.log(WIDE) * 2 / (1 - WIDE**-2)))
"""Amplitude from which the wide prior is the likelier one, 1.83."""

EFFECT_ODDS = 1 / 50
"""Prior odds of each effect being there."""

MOST = 6
"""Effects that are looked for: of so many at once, some stand for something else."""


@dataclass(frozen=True)
class Candidate:
    """An effect at one place.

    Attributes
    ----------
    effect : str
    place : str
        Which block or seam; empty where there is but one.
    columns : tuple of int
        Of the evidence.
    certain : bool
        Whether the amplitude of the first is 1 if it is there, as of a missing block.
    only : bool
        Whether its effect is in one place at most.
    """

    effect: str
    place: str
    columns: tuple[int, ...]
    certain: bool = False
    only: bool = False

    @property
    def free(self) -> tuple[int, ...]:
        """Columns whose amplitudes are not known."""
        return self.columns[1:] if self.certain else self.columns

    @property
    def name(self) -> str:
        """Effect and place."""
        return f"{self.effect} {self.place}".strip()


@dataclass(frozen=True)
class SelectedEffect:
    """A candidate that is missing from the model, and those that would do as well.

    Attributes
    ----------
    candidate : Candidate
    log_bayes_factor : float
        Of the readings, with it over without it, the other found ones being there.
    log_odds : float
        The same, with the prior odds of its effect at its place.
    alternatives : tuple of (Candidate, float)
        Others that explain the readings as well, with their log Bayes factors.
    """

    candidate: Candidate
    log_bayes_factor: float
    log_odds: float
    alternatives: tuple[tuple[Candidate, float], ...]

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of effects that the readings cannot tell apart, the likeliest first."""
        return tuple(dict.fromkeys(
            (self.candidate.effect, *(other.effect for other, _ in self.alternatives))))


def prior_log_odds(candidates: Sequence[Candidate]) -> Floats:
    """Log prior odds (candidates,) of each being there."""
    names = [candidate.effect for candidate in candidates]
    counts = {name: names.count(name) for name in set(names)}
    return np.array([np.log(EFFECT_ODDS / counts[name]) for name in names])


def log_bayes_factors(evidence: Evidence, candidates: Sequence[Candidate]) -> Floats:
    """Log Bayes factor (candidates,) of each candidate over none."""
    found = np.empty(len(candidates))
    free = [number for number, one in enumerate(candidates) if not one.certain]
    columns = [candidates[number].columns for number in free]
    wide = evidence.widened(range(len(evidence.prior)), WIDE)
    found[free] = np.logaddexp(evidence.log_evidences(columns), wide.log_evidences(columns)
                               ) - np.log(2)
    for number, one in enumerate(candidates):
        if one.certain:
            found[number] = log_evidence(evidence, [one])
    return found


def tailored(evidence: Evidence, candidates: Sequence[Candidate]) -> Evidence:
    """The evidence with a wide prior for those of some candidates, all there, that are large."""
    free = [column for one in candidates for column in one.free]
    sizes = dict(zip(free, evidence.widened(free, WIDE).fit(free).mean**2, strict=True))
    large = [column for one in candidates for column in one.free
             if np.mean([sizes[other] for other in one.free]) > WIDE_FROM**2]
    return evidence.widened(large, WIDE)


def with_candidates(evidence: Evidence, candidates: Sequence[Candidate]) -> Evidence:
    """The evidence with some candidates in the model, their amplitudes integrated out."""
    for one in candidates:
        if one.certain:
            evidence = evidence.shifted(one.columns[0])
    return tailored(evidence, candidates).given(
        [column for one in candidates for column in one.free])


def log_evidence(evidence: Evidence, candidates: Sequence[Candidate]) -> float:
    """Log evidence of some candidates together, over that of none."""
    total = 0.0
    for one in candidates:
        if one.certain:
            column = one.columns[0]
            total += float(evidence.score[column] - evidence.information[column, column] / 2)
            evidence = evidence.shifted(column)
        total -= np.log(2) * bool(one.free)
    return total + tailored(evidence, candidates).fit(
        [column for one in candidates for column in one.free]).log_evidence


def select_effects(
    evidence: Evidence, candidates: Sequence[Candidate], most: int = MOST,
    barred: Collection[int] = (),
) -> list[SelectedEffect]:
    """Find missing effects one after the other; drop those that later ones make needless.

    ``most`` is how many effects are looked for, ``barred`` are numbers of candidates that cannot
    be, as their amplitudes are impossible.
    """
    prior = prior_log_odds(candidates)
    chosen: list[int] = []
    while len(chosen) < most:
        now = with_candidates(evidence, [candidates[number] for number in chosen])
        odds = log_bayes_factors(now, candidates) + prior
        odds[[*chosen, *barred]] = -np.inf
        taken = {candidates[number].effect for number in chosen if candidates[number].only}
        odds[[number for number, one in enumerate(candidates) if one.effect in taken]] = -np.inf
        best = int(np.argmax(odds))
        if odds[best] < FOUND:
            break
        before = len(chosen)
        chosen = _at_best_places(evidence, candidates, [*chosen, best], barred)
        best = chosen[-1]
        chosen = _needed(evidence, candidates, chosen, prior)
        if best not in chosen or len(chosen) <= before - 1:
            break  # adding and dropping would go on for ever
    return [_found(evidence, candidates, chosen, number, prior, barred) for number in chosen]


def _at_best_places(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: list[int],
    barred: Collection[int],
) -> list[int]:
    """Move what is in one place only to where it is best, the others being there."""
    chosen = list(chosen)
    for index, number in enumerate(chosen):
        if candidates[number].only:
            others = [candidates[k] for k in chosen if k != number]
            places = [k for k, one in enumerate(candidates)
                      if one.effect == candidates[number].effect and k not in barred]
            factors = log_bayes_factors(with_candidates(evidence, others),
                                        [candidates[k] for k in places])
            chosen[index] = places[int(np.argmax(factors))]
    return chosen


def _needed(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: list[int], prior: Floats
) -> list[int]:
    """Drop, the least needed first, what the others make needless."""
    while len(chosen) > 1:
        odds = [float(log_bayes_factors(
            with_candidates(evidence, [candidates[k] for k in chosen if k != one]),
                            [candidates[one]])[0]) + prior[one] for one in chosen]
        worst = int(np.argmin(odds))
        if odds[worst] >= FOUND:
            break
        chosen = chosen[:worst] + chosen[worst + 1:]
    return chosen


def _found(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: Sequence[int], number: int,
    prior: Floats, barred: Collection[int],
) -> SelectedEffect:
    """One found candidate, and what would do in its place."""
    others = [candidates[k] for k in chosen if k != number]
    now = with_candidates(evidence, others)
    factors = log_bayes_factors(now, candidates)
    odds = factors + prior
    alike = [k for k in np.argsort(-odds) if k != number and k not in chosen and k not in barred
             and odds[k] > odds[number] - ALIKE]
    return SelectedEffect(candidates[number], float(factors[number]), float(odds[number]),
                 tuple((candidates[k], float(factors[k])) for k in alike))


def probabilities(evidence: Evidence, candidates: Sequence[Candidate]) -> dict[str, float]:
    """Posterior probability of each effect, and of ``none``, if at most one is missing."""
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
    """Largest log Bayes factor of each effect at any place, over nothing, or beside others: of each
    group of names the one candidate that is best by itself.
    """
    alone = log_bayes_factors(evidence, candidates)
    beside = [max((k for k, one in enumerate(candidates) if one.effect in names),
                  key=lambda k: alone[k]) for names in others]
    factors = log_bayes_factors(with_candidates(evidence, [candidates[k] for k in beside]),
                                candidates)
    found: dict[str, float] = {}
    for candidate, factor in zip(candidates, factors, strict=True):
        found[candidate.effect] = max(found.get(candidate.effect, -np.inf), float(factor))
    return found
