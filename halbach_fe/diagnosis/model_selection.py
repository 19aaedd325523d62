"""Select the missing effects, and find those that the readings cannot distinguish.

A candidate is an effect at one place (a block or a seam, for example), with one or more amplitudes.
The prior probability of an effect is shared by its candidates, so that an effect which may be in
any of hundreds of blocks has no advantage.

The amplitudes of one candidate are free in parts: a mapper may be displaced along z alone, with x
and y exactly 0. All parts of a candidate are equally probable before the readings are known. Its
evidence is the mean over them; in a model of several effects each has its likeliest part. What a
candidate shares with other effects, such as the common shift of all rings beside a gap, does not
give it its name: it must be likelier than that alone, by `DETERMINED_LOG_EVIDENCE`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Evidence

DETECTION_LOG_ODDS = 5.0
"""Log posterior odds above which an effect is selected."""

INDISTINGUISHABLE_LOG_EVIDENCE = 3.0
"""Difference in log evidence below which the readings do not distinguish two explanations."""

DETERMINED_LOG_EVIDENCE = INDISTINGUISHABLE_LOG_EVIDENCE
"""Log evidence that the amplitudes which give an effect its name add to that of its other
amplitudes alone, from which they count as determined: 20 to 1."""

PINNED_SD = 1e-6
"""Standard deviation, in units of the usual prior, of amplitudes that are 0: so small that rounding
is all that is left of them, and large enough for matrices that can be inverted."""

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
    parts : tuple of tuple of int
        Amplitudes that may be free together while the others are 0, as positions in ``columns``.
        It is empty if all are free.
    shared : tuple of int
        Amplitudes that do not give the effect its name, as positions in ``columns``.
    relative_odds : float
        Prior odds of the effect, relative to others.
    """

    effect: str
    place: str
    columns: tuple[int, ...]
    is_binary: bool = False
    unique: bool = False
    places: int | None = None
    parts: tuple[tuple[int, ...], ...] = ()
    shared: tuple[int, ...] = ()
    relative_odds: float = 1.0

    @property
    def free(self) -> tuple[int, ...]:
        """Columns whose amplitudes are fitted."""
        return self.columns[1:] if self.is_binary else self.columns

    @property
    def free_in_parts(self) -> list[tuple[int, ...]]:
        """Columns whose amplitudes are fitted, in every part."""
        return [tuple(self.columns[k] for k in part) for part in self.parts] or [self.free]

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
    return np.array([np.log(EFFECT_PRIOR_ODDS * candidate.relative_odds
                            / (candidate.places or counts[candidate.effect]))
                     for candidate in candidates])


def log_bayes_factors(evidence: Evidence, candidates: Sequence[Candidate]) -> Floats:
    """Return the log Bayes factor (candidates,) of each candidate over no effect.

    It is over what the candidate shares with other effects where that explains the readings about
    as well.
    """
    factors = np.empty(len(candidates))
    free = [number for number, candidate in enumerate(candidates) if not candidate.is_binary]
    if free:
        parts = [candidates[number].free_in_parts for number in free]
        counts = np.array([len(one) for one in parts])
        every = _of_groups(evidence, [part for one in parts for part in one])
        factors[free] = np.logaddexp.reduceat(every, np.cumsum(counts) - counts) - np.log(counts)
    partly = [number for number in free if candidates[number].shared]
    own = factors[partly] - _of_groups(evidence, [tuple(
        candidates[number].columns[k] for k in candidates[number].shared) for number in partly])
    factors[partly] = np.where(own < DETERMINED_LOG_EVIDENCE,
                               np.minimum(own, factors[partly]), factors[partly])
    for number, candidate in enumerate(candidates):
        if candidate.is_binary:
            factors[number] = log_evidence(evidence, [candidate])
    return factors


def _of_groups(evidence: Evidence, groups: Sequence[tuple[int, ...]]) -> Floats:
    """Return the log evidence (groups,) of columns, whose prior is the usual or the wide one."""
    wide = evidence.widened(range(len(evidence.prior)), WIDE_PRIOR_SD)
    return np.logaddexp(evidence.log_evidences(groups), wide.log_evidences(groups)) - np.log(2)


def with_wide_priors(evidence: Evidence, candidates: Sequence[Candidate]) -> Evidence:
    """Return the evidence with the likeliest priors of the amplitudes of the given candidates.

    They are the wide prior for candidates that are large, and 0 for amplitudes outside the
    likeliest part of a candidate. All given candidates are in the model together.
    """
    free = [column for candidate in candidates for column in candidate.free]
    if not free:
        return evidence
    own = evidence.only(free)
    ends = np.cumsum([len(candidate.free) for candidate in candidates])
    spans = [slice(end - len(candidate.free), end)
             for end, candidate in zip(ends, candidates, strict=True)]
    pinned = np.zeros(len(free), bool)
    widths = _likeliest_widths(own, spans, pinned)
    for candidate, span in zip(candidates, spans, strict=True):
        if len(candidate.parts) > 1:
            pinned[span] = _needless(own.widened(range(len(free)), widths), widths, span,
                                     candidate)
            widths = _likeliest_widths(own, spans, pinned)
    return evidence.widened(free, widths)


def _likeliest_widths(
    evidence: Evidence, spans: Sequence[slice], pinned: NDArray[np.bool_]
) -> Floats:
    """Return the standard deviations (k,) of the likeliest prior of every column, by candidates."""
    every = range(len(pinned))
    sizes = evidence.widened(every, np.where(pinned, PINNED_SD, WIDE_PRIOR_SD)).fit(every).mean**2
    widths = np.where(pinned, PINNED_SD, 1.0)
    for span in spans:
        free = np.arange(span.start, span.stop)[~pinned[span]]
        if len(free) and np.mean(sizes[free]) > WIDE_PRIOR_FROM**2:
            widths[free] = WIDE_PRIOR_SD
    return widths


def _needless(
    evidence: Evidence, widths: Floats, span: slice, candidate: Candidate
) -> NDArray[np.bool_]:
    """Return which amplitudes of a candidate are 0 in its likeliest part.

    The evidence of a part relative to that of all amplitudes is the posterior density of 0 over the
    prior one (J. M. Dickey, Annals of Mathematical Statistics 42, 204, 1971).
    """
    fit = evidence.fit(range(len(widths)))
    size = span.stop - span.start
    best, least = -np.inf, np.zeros(size, bool)
    for part in candidate.parts:
        left_out = np.ones(size, bool)
        left_out[list(part)] = False
        index = span.start + np.flatnonzero(left_out)
        own = fit.covariance[np.ix_(index, index)]
        gain = float(np.log(widths[index]).sum() - np.linalg.slogdet(own)[1] / 2
                     - fit.mean[index] @ np.linalg.solve(own, fit.mean[index]) / 2)
        if gain > best:
            best, least = gain, left_out
    return least


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
        total -= np.log(2) * bool(candidate.free) + np.log(max(1, len(candidate.parts)))
    return total + with_wide_priors(evidence, candidates).fit(
        [column for candidate in candidates for column in candidate.free]).log_evidence


def odds_beside(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: Sequence[int], prior: Floats,
    excluded: Collection[int] = (),
) -> Floats:
    """Return the log posterior odds (candidates,) of each candidate beside chosen ones.

    They are -inf of these, of excluded ones, and at other places of chosen effects that are unique.
    """
    beside = [candidates[number] for number in chosen]
    odds = log_bayes_factors(with_candidates(evidence, beside), candidates) + prior
    taken = {candidate.effect for candidate in beside if candidate.unique}
    odds[[number for number, candidate in enumerate(candidates)
          if number in chosen or number in excluded or candidate.effect in taken]] = -np.inf
    return odds


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
    seen: set[frozenset[int]] = set()
    while candidates and len(chosen) < max_effects:
        odds = odds_beside(evidence, candidates, chosen, prior, excluded)
        best = int(np.argmax(odds))
        if odds[best] < DETECTION_LOG_ODDS:
            break
        before = len(chosen)
        chosen = _at_best_places(evidence, candidates, [*chosen, best], excluded)
        chosen = _exchanged(evidence, candidates, chosen, prior, excluded)
        best = chosen[-1]
        chosen = without_needless(evidence, candidates, chosen, prior, fewest=1)
        if best not in chosen or len(chosen) <= before - 1 or frozenset(chosen) in seen:
            break  # else the same candidates would be added and dropped for ever
        seen.add(frozenset(chosen))
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


def _exchanged(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: list[int], prior: Floats,
    excluded: Collection[int],
) -> list[int]:
    """Put likelier candidates in place of chosen ones, given the other chosen ones.

    What came first had to explain what others explain now: a block that was displaced as far as a
    turned map looked like it may be a weak one.
    """
    chosen = list(chosen)
    for index, number in enumerate(chosen):
        odds = odds_beside(evidence, candidates, [k for k in chosen if k != number], prior,
                           excluded)
        best = int(np.argmax(odds))
        if odds[best] > odds[number] + INDISTINGUISHABLE_LOG_EVIDENCE:
            chosen[index] = best
    return chosen


def without_needless(
    evidence: Evidence, candidates: Sequence[Candidate], chosen: Sequence[int], prior: Floats,
    fewest: int = 0, by_scatter: bool = False,
) -> list[int]:
    """Drop candidates whose odds given the others are too small, the smallest first.

    ``fewest`` remain in any case. With ``by_scatter`` the noise counts as large as they leave it.
    """
    kept = list(chosen)
    while len(kept) > fewest:
        judged = tempered(evidence, [candidates[k] for k in kept]) if by_scatter else evidence
        odds = [float(log_bayes_factors(
            with_candidates(judged, [candidates[k] for k in kept if k != number]),
            [candidates[number]])[0]) + prior[number] for number in kept]
        worst = int(np.argmin(odds))
        if odds[worst] >= DETECTION_LOG_ODDS:
            break
        del kept[worst]
    return kept


def tempered(evidence: Evidence, candidates: Sequence[Candidate]) -> Evidence:
    """Return the evidence by the scatter that candidates leave beside terms of any shape.

    What terms of a limited fineness leave is no longer noise of the stated size.
    """
    left = with_candidates(evidence, candidates)
    return evidence.tempered(max(1.0, left.chi2 / left.readings))


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


def probabilities(
    evidence: Evidence, candidates: Sequence[Candidate], unknown: float = -np.inf
) -> dict[str, float]:
    """Return the posterior probability of each effect, of ``none``, and of ``unknown``.

    The probabilities hold on the assumption that at most one effect is missing. The log odds of an
    unlisted cause over nothing are given if one was found in place of all effects.
    """
    log_odds = np.concatenate([
        [0.0, unknown], log_bayes_factors(evidence, candidates) + prior_log_odds(candidates)])
    weights = np.exp(log_odds - log_odds.max())
    found: dict[str, float] = {}
    for name, weight in zip(("none", "unknown", *(each.effect for each in candidates)),
                            (weights / weights.sum()).tolist(), strict=True):
        found[name] = found.get(name, 0.0) + weight
    if unknown == -np.inf:
        del found["unknown"]
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
