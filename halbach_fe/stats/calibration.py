"""Calibration: whether posteriors have the right width, and probabilities are as stated.

`ranks` and `uniformity` are simulation-based calibration. If true parameters are drawn from the
prior and readings are simulated from them, the rank of the true value among independent draws from
the posterior is uniformly distributed, whatever the model (S. Talts et al., arXiv:1804.06788). If
the posterior is too narrow, or a chain has not moved, the lowest and highest ranks are too
frequent.

The expected calibration error (M. P. Naeini et al., AAAI (2015) 2901; C. Guo et al.,
arXiv:1706.04599) is the mean distance between the stated probability and the frequency, over bins
of the stated probability, weighted with the number of statements. Even probabilities that are right
have an error above 0, because the frequency of few statements scatters. `error_if_calibrated`
returns the limit that their error exceeds in 5 % of the cases only.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.stats.gaussian import Gaussian

Simulator = Callable[[Floats, np.random.Generator], Floats]
"""Maps true parameters (m,) to readings (n,), with their noise. The field should be that of another
model than the one that is tested."""

Sampler = Callable[[Floats, np.random.Generator], Floats]
"""Maps readings (n,) to nearly independent draws (draws, m) from the posterior."""

BINS = 10
"""Number of bins of the histogram of the ranks."""


def ranks(
    prior: Gaussian, simulate: Simulator, sampler: Sampler, repeats: int,
    generator: np.random.Generator,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Ints, int]:
    """Simulate ``repeats`` inferences and rank the true parameters among posterior draws.

    Parameters
    ----------
    prior : Gaussian
        Distribution of the true parameters (m,).
    simulate : callable
        Measures the truth, see `Simulator`.
    sampler : callable
        The inference under test, see `Sampler`.
    repeats : int
        Number of simulated inferences.
    generator : numpy.random.Generator
    progress : callable
        Called with the number of completed inferences and with ``repeats``.

    Returns
    -------
    ranks : ndarray of int, shape (repeats, m)
        Number of draws below the true value.
    draws : int
        Number of draws of each posterior.
    """
    found = []
    draws = np.empty((0, 0))
    for number in range(repeats):
        truth = prior.sample(1, generator)[0]
        draws = sampler(simulate(truth, generator), generator)
        found.append((draws < truth).sum(axis=0))
        progress(number + 1, repeats)
    return np.array(found), len(draws)


def uniformity(found: Ints, draws: int) -> tuple[Floats, float]:
    """Test that ranks are uniformly distributed.

    Parameters
    ----------
    found : ndarray of int, shape (repeats, m)
        Ranks, from `ranks`.
    draws : int
        Number of draws of each posterior.

    Returns
    -------
    values : ndarray, shape (m,)
        p-value of each parameter, by a chi-squared test over `BINS` bins.
    combined : float
        p-value of all parameters together: the smallest p-value with Bonferroni's correction,
        which is valid even if the ranks of different parameters are correlated.
    """
    edges = np.linspace(0, draws + 1, BINS + 1)
    expected = np.diff(np.ceil(edges)) / (draws + 1) * len(found)
    values = np.array([stats.chisquare(np.histogram(column, np.ceil(edges) - 0.5)[0], expected)
                       .pvalue for column in found.T])
    return values, float(min(1.0, values.min() * len(values)))


@dataclass(frozen=True)
class Bin:
    """Statements whose probabilities are similar.

    Attributes
    ----------
    stated : float
        Mean of the stated probabilities.
    happened : float
        Fraction of the statements that were true.
    statements : int
    """

    stated: float
    happened: float
    statements: int


def frequencies(
    stated: Floats, happened: NDArray[np.bool_], edges: Sequence[float]
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
    stated: Floats, edges: Sequence[float], generator: np.random.Generator, quantile: float = 0.95
) -> float:
    """Return a quantile of the error if every statement were true with its stated probability.

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
    return float(np.quantile(errors, quantile))
