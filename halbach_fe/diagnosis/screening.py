"""Leave hypotheses out of the comparison that are hopeless by themselves.

Thousands of blocks, each of which may be displaced, turned, missing ..., make tens of thousands of
signatures. All of them together would need a matrix of their products. One by one they are cheap.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.diagnosis.model_selection import Candidate, log_bayes_factors

MOST_COLUMNS = 6000
"""Largest number of signatures that are compared with each other: their products take 0.3 GB."""

AT_ONCE = 1000
"""Number of hypotheses that are judged by themselves at a time."""

FEW_PLACES = 100
"""Effects of at most so many places are never left out."""


def most_likely(
    candidates: Sequence[Candidate], columns: Sequence[Floats], marginal: Marginal,
    residual: Floats, in_model: Collection[int]
) -> list[int]:
    """Return the numbers of the candidates that are compared with each other, in order.

    These are all candidates, unless they have more than `MOST_COLUMNS` signatures. Then those in
    the model and those of effects of a few places are compared with the others whose evidence is
    largest by themselves. An effect that another one hides is found in a later round, when that one
    is in the model.

    Parameters
    ----------
    candidates : sequence of Candidate
    columns : sequence of ndarray, shape (rows, k)
        Whitened signatures of every candidate.
    marginal : Marginal
    residual : ndarray, shape (rows,)
        Whitened residual to which the signatures are fitted.
    in_model : collection of int
        Numbers of candidates that must be compared.
    """
    width = np.array([part.shape[1] for part in columns])
    if width.sum() <= MOST_COLUMNS:
        return list(range(len(candidates)))
    factors = np.empty(len(candidates))
    for first in range(0, len(candidates), AT_ONCE):
        some = range(first, min(first + AT_ONCE, len(candidates)))
        ends = np.cumsum(width[some])
        alone = [replace(candidates[number], columns=tuple(range(end - width[number], end)))
                 for number, end in zip(some, ends.tolist(), strict=True)]
        factors[some] = log_bayes_factors(
            marginal.evidence(np.hstack([columns[number] for number in some]), residual), alone)
    names = [candidate.effect for candidate in candidates]
    places = {name: names.count(name) for name in dict.fromkeys(names)}
    chosen = {number for number, name in enumerate(names)
              if number in in_model or places[name] <= FEW_PLACES}
    left = MOST_COLUMNS - sum(width[number] for number in chosen)
    for number in np.argsort(-factors).tolist():
        if number not in chosen and width[number] <= left:
            chosen.add(number)
            left -= width[number]
    return sorted(chosen)
