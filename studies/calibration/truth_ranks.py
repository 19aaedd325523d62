"""Simulation-based calibration: whether posteriors have the right width.

If true parameters are drawn from the prior and readings are simulated from them, the rank of the
true value among independent draws from the posterior is uniformly distributed, whatever the model
(S. Talts et al., arXiv:1804.06788). If the posterior is too narrow, or a chain has not moved, the
lowest and highest ranks are too frequent.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import stats

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.progress import Progress, quiet
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
    progress: Progress = quiet,
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
