"""Select the missing effects by their odds, and find those that readings cannot distinguish.

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
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Bools, Floats, slices
from halbach_fe.diagnosis.marginal_evidence import Evidence, Marginal

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
    """An effect at one place."""

    effect: str
    place: str
    """Name of the block, seam or point; empty for effects that have only one place."""
    columns: tuple[int, ...]
    """The candidate's columns of the evidence."""
    is_binary: bool = False
    """Whether the amplitude of the first column is exactly 1 if the effect is present, as of a
    missing block."""
    unique: bool = False
    """Whether the effect can be present at one place at most."""
    places: int | None = None
    """Number of places of the effect, which share its prior probability; None if all of them are
    candidates."""
    parts: tuple[tuple[int, ...], ...] = ()
    """Amplitudes that may be free together while the others are 0, as positions in ``columns``. It
    is empty if all are free."""
    shared: tuple[int, ...] = ()
    """Amplitudes that do not give the effect its name, as positions in ``columns``."""
    relative_odds: float = 1.0
    """Prior odds of the effect, relative to others."""

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
    """A candidate that is missing from the model, and its alternatives."""

    candidate: Candidate
    log_bayes_factor: float
    """Log Bayes factor of the model with the candidate over that without it. The other selected
    effects are in both."""
    log_odds: float
    """Log posterior odds: the log Bayes factor plus the log prior odds of the effect at this
    place."""
    alternatives: tuple[tuple[Candidate, float], ...]
    """Candidates that explain the readings equally well in place of this one, with their log Bayes
    factors."""

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
    evidence: Evidence, spans: Sequence[slice], pinned: Bools
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
) -> Bools:
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
    evidence: Evidence, candidates: Sequence[Candidate], excluded: Collection[int] = (),
) -> list[SelectedEffect]:
    """Select missing effects one at a time, and drop those that later ones make needless.

    ``excluded``: numbers of candidates that cannot be selected, because their amplitudes are
    impossible.
    """
    prior = prior_log_odds(candidates)
    chosen: list[int] = []
    seen: set[frozenset[int]] = set()
    while candidates and len(chosen) < MAX_EFFECTS:
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
    turned map looked like it may be a weak one. What is about as likely as a chosen one may make
    others likelier beside it: those of the exchanges that are likeliest together are returned.
    """
    def likelier(chosen: Sequence[int]) -> tuple[int, ...]:
        chosen = list(chosen)
        for index, number in enumerate(chosen):
            odds = odds_beside(evidence, candidates, [k for k in chosen if k != number], prior,
                               excluded)
            best = int(np.argmax(odds))
            if odds[best] > odds[number] + INDISTINGUISHABLE_LOG_EVIDENCE:
                chosen[index] = best
        return tuple(chosen)

    first = likelier(chosen)
    if len(first) < 2:
        return list(first)
    found = {first}
    for index, number in enumerate(first):
        before, after = first[:index], first[index + 1:]
        odds = odds_beside(evidence, candidates, [*before, *after], prior, excluded)
        odds[number], least = -np.inf, odds[number] - INDISTINGUISHABLE_LOG_EVIDENCE
        rival = int(np.argmax(odds))
        if odds[rival] > least:
            found.add(likelier([*before, rival, *after]))
    return list(max(sorted(found), key=lambda numbers: log_evidence(
        evidence, [candidates[number] for number in numbers]) + prior[list(numbers)].sum()))


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


# --- hypotheses that are hopeless by themselves --------------------------------------------------
#
# Hundreds of blocks, each of which may be displaced, turned, missing ..., make thousands of
# signatures. A matrix of the products of all of them takes longer than everything else in a round.
# One by one they are cheap.

MOST_COLUMNS = 1500
"""Largest number of signatures that are compared with each other: their products take a tenth of
a second for each thousand readings."""

AT_ONCE = 30
"""Number of hypotheses that are judged by themselves at a time. Their products with each other are
computed needlessly, but few calls of the linear algebra are faster than many."""

FEW_PLACES = 100
"""Effects of at most so many places are never left out."""

NOTICEABLE_CHI2 = 9.0
"""Part of chi-squared that a signature must account for if others like it are to be computed: three
standard deviations of its amplitude."""

NEAR = 0.3
"""An effect with a rough signature is solved for if it explains at least this share of the part of
chi-squared that a likely effect explains in its place. A rough signature that correlates by 0.7
with the exact one, beside the blocks, explains half of what that does; of the FASER dipole in its
tube the correlations are 0.98 for iron that saturates and 0.96 for the permeability across."""


@dataclass(frozen=True)
class Compared:
    """Candidates that are compared with each other."""

    numbers: tuple[int, ...]
    """Of these candidates among all, in order."""
    columns: Floats
    """Their whitened signatures. Shape (rows, k)."""
    absorbed: Floats
    """`Marginal.absorbed` of these and of the residual. Shape (m, k + 1)."""
    evidence: Evidence


def most_likely(
    candidates: Sequence[Candidate], columns: Sequence[Floats], marginal: Marginal,
    residual: Floats, in_model: Collection[int]
) -> Compared:
    """Return the candidates that are compared with each other.

    These are all candidates, unless they have more than `MOST_COLUMNS` signatures. Then those in
    the model and those of effects of a few places are compared with the others whose evidence is
    largest beside the model. An effect that another one hides is found in a later round, when that
    one is in the model.

    Parameters
    ----------
    columns : sequence of ndarray, shape (rows, k)
        Whitened signatures of every candidate.
    residual : ndarray, shape (rows,)
        Whitened residual to which the signatures are fitted.
    in_model : collection of int
        Numbers of candidates that are in the model, and must be compared.
    """
    width = np.array([part.shape[1] for part in columns], int)
    ends = np.cumsum(width)
    own = [np.arange(end - size, end) for end, size in zip(ends, width, strict=True)]
    # by column in memory, as columns are chosen below
    stacked = np.vstack([*(part.T for part in columns), residual]).T
    absorbed = marginal.absorbed(stacked)

    def compared(numbers: Sequence[int]) -> Compared:
        index = np.concatenate([np.zeros(0, int), *(own[number] for number in numbers)])
        chosen, taken = stacked[:, index], absorbed[:, np.append(index, width.sum())]
        return Compared(tuple(numbers), chosen, taken,
                        marginal.evidence(chosen, residual, taken))

    if width.sum() <= MOST_COLUMNS:
        return compared(range(len(candidates)))
    factors = np.empty(len(candidates))
    model = sorted(in_model)
    for some in (list(range(part.start, part.stop)) for part in slices(len(candidates), AT_ONCE)):
        numbered = renumbered([candidates[number] for number in (*model, *some)])
        beside = with_candidates(compared([*model, *some]).evidence, numbered[:len(model)])
        factors[some] = log_bayes_factors(beside, numbered[len(model):])
    names = [candidate.effect for candidate in candidates]
    places = {name: names.count(name) for name in dict.fromkeys(names)}
    chosen = {number for number, name in enumerate(names)
              if number in in_model or places[name] <= FEW_PLACES}
    left = MOST_COLUMNS - sum(width[number] for number in chosen)
    for number in np.argsort(-factors).tolist():
        if number not in chosen and width[number] <= left:
            chosen.add(number)
            left -= width[number]
    return compared(sorted(chosen))


def near_the_likeliest(
    evidence: Evidence, candidates: Sequence[Candidate], rough: Collection[int]
) -> list[int]:
    """Return the numbers of candidates with rough signatures that come near to the likeliest ones.

    They explain a part of chi-squared that is not chance beside the likeliest effects, or in place
    of one of these at least `NEAR` of what it explains.
    """
    if not rough:
        return []
    likeliest = [candidates.index(one.candidate) for one in select_effects(evidence, candidates)]
    near = set(likeliest) & set(rough)
    for missing in (None, *likeliest):
        beside = with_candidates(evidence, [candidates[k] for k in likeliest if k != missing])
        least = NOTICEABLE_CHI2 if missing is None else max(
            NOTICEABLE_CHI2, NEAR * beside.explained(candidates[missing].columns))
        near |= {k for k in rough if beside.explained(candidates[k].columns) > least}
    return sorted(near)


def renumbered(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return candidates whose columns are numbered one after the other."""
    ends = np.cumsum([len(candidate.columns) for candidate in candidates]).tolist()
    return [replace(candidate, columns=tuple(range(end - len(candidate.columns), end)))
            for candidate, end in zip(candidates, ends, strict=True)]


def is_noticeable(
    signature: Floats, fixed: Floats, marginal: Marginal, residual: Floats
) -> bool:
    """Tell whether a whitened signature (rows, k) accounts for a part of chi-squared that is not
    chance, beside those (rows, f) of what is in the model.
    """
    count = fixed.shape[1]
    beside = marginal.evidence(np.hstack([fixed, signature]), residual).given(range(count))
    return beside.explained(range(count, count + signature.shape[1])) > NOTICEABLE_CHI2
