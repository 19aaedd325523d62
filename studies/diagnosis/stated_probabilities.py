"""Whether what was stated with a probability happens as often.

The expected calibration error (M. P. Naeini et al., AAAI (2015) 2901; C. Guo et al.,
arXiv:1706.04599) is the mean distance between the stated probability and the frequency, over bins
of the stated probability, weighted with the number of statements. Even probabilities that are right
have an error above 0, because the frequency of few statements scatters. `error_if_calibrated`
returns the limit that their error exceeds in 5 % of the cases only.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from halbach_fe.core.arrays import Bools, Floats


@dataclass(frozen=True)
class Bin:
    """Statements whose probabilities are similar."""

    stated: float
    """Mean of the stated probabilities."""
    happened: float
    """Fraction of the statements that were true."""
    statements: int


def frequencies(
    stated: Floats, happened: Bools, edges: Sequence[float]
) -> tuple[Bin, ...]:
    """Return how often statements were true, for bins of their probability.

    Parameters
    ----------
    stated : ndarray, shape (n,)
        Stated probabilities.
    happened : ndarray of bool, shape (n,)
        Whether each statement was true.
    edges : sequence of float
        Limits of the bins, ascending; a bin contains its lower limit. Empty bins, and statements
        outside the limits, are left out.
    """
    found = []
    for low, high in itertools.pairwise(edges):
        some = (stated >= low) & (stated < high)
        if some.any():
            found.append(Bin(float(stated[some].mean()), float(happened[some].mean()),
                             int(some.sum())))
    return tuple(found)


def expected_calibration_error(bins: Sequence[Bin]) -> float:
    """Return the mean distance of stated probability and frequency, NaN of no statements."""
    count = sum(one.statements for one in bins)
    distance = sum(one.statements * abs(one.stated - one.happened) for one in bins)
    return distance / count if count else float("nan")


def error_if_calibrated(
    stated: Floats, edges: Sequence[float], generator: np.random.Generator
) -> float:
    """Return the 95 % quantile of the error if statements were true with their probabilities.

    Statements count as independent.
    """
    place = np.digitize(stated, edges)
    counted = (place > 0) & (place < len(edges))
    if not counted.any():
        return float("nan")
    stated, place = stated[counted], place[counted]
    member = place[:, None] == np.arange(1, len(edges))  # (statements, bins)
    repeats = 1000  # number of simulated outcomes. The 95 % limit then scatters by some 3 %.
    outcomes = generator.random((repeats, len(stated))) < stated
    errors = np.abs((stated - outcomes) @ member).sum(axis=1) / len(stated)
    return float(np.quantile(errors, 0.95))
