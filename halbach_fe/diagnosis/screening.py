"""Leave hypotheses out of the comparison that are hopeless by themselves.

Hundreds of blocks, each of which may be displaced, turned, missing ..., make thousands of
signatures. A matrix of the products of all of them takes longer than everything else in a round.
One by one they are cheap.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Evidence, Marginal
from halbach_fe.diagnosis.model_selection import (
    Candidate,
    log_bayes_factors,
    select_effects,
    with_candidates,
)

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
    """Candidates that are compared with each other.

    Attributes
    ----------
    numbers : tuple of int
        Of these candidates among all, in order.
    columns : ndarray, shape (rows, k)
        Their whitened signatures.
    absorbed : ndarray, shape (m, k + 1)
        `Marginal.absorbed` of these and of the residual.
    evidence : Evidence
    """

    numbers: tuple[int, ...]
    columns: Floats
    absorbed: Floats
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
    candidates : sequence of Candidate
    columns : sequence of ndarray, shape (rows, k)
        Whitened signatures of every candidate.
    marginal : Marginal
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
    for first in range(0, len(candidates), AT_ONCE):
        some = list(range(first, min(first + AT_ONCE, len(candidates))))
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
            NOTICEABLE_CHI2, NEAR * _explained(beside, candidates[missing]))
        near |= {k for k in rough if _explained(beside, candidates[k]) > least}
    return sorted(near)


def _explained(evidence: Evidence, candidate: Candidate) -> float:
    """Return the part of chi-squared that a candidate accounts for, at any amplitudes."""
    own = np.array(candidate.columns)
    score = evidence.score[own]
    return float(score @ np.linalg.lstsq(evidence.part(own), score)[0])


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
    free = np.arange(fixed.shape[1], fixed.shape[1] + signature.shape[1])
    beside = marginal.evidence(np.hstack([fixed, signature]), residual).given(
        range(fixed.shape[1]))
    score = beside.score[free]
    return bool(score @ np.linalg.lstsq(beside.part(free), score)[0] > NOTICEABLE_CHI2)
