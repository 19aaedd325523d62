"""Simulation-based calibration, which shows whether posteriors are as sure as they may be.

With a truth drawn from the prior and readings from the truth, the rank of the truth among
independent draws of the posterior is uniform, whatever the model (S. Talts et al.,
arXiv:1804.06788). A posterior that is too sure, or a chain that has not moved, piles ranks up at
the ends.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import stats

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.noise import NoiseCovariance

Sampler = Callable[[Floats, np.random.Generator], Floats]
"""Readings (n,) to draws of the posterior (draws, m), nearly independent."""

BINS = 10


def ranks(
    prior: Gaussian, model: Callable[[Floats], Floats], noise: NoiseCovariance, sampler: Sampler,
    repeats: int, generator: np.random.Generator,
    say: Callable[[int], None] = lambda number: None,
) -> tuple[Ints, int]:
    """Ranks (repeats, m) of the truth among draws, and the number of draws."""
    found = []
    draws = np.empty((0, 0))
    for number in range(repeats):
        truth = prior.sample(1, generator)[0]
        readings = model(truth) + noise.sample(generator)
        draws = sampler(readings, generator)
        found.append((draws < truth).sum(axis=0))
        say(number + 1)
    return np.array(found), len(draws)


def uniformity(found: Ints, draws: int) -> tuple[Floats, float]:
    """p-values (m,) that the ranks of each parameter are uniform, by chi-squared over `BINS` bins,
    and one for all of them.

    Parameters are correlated in the posterior, but their ranks hardly are; Bonferroni's correction
    for the smallest p-value holds in any case.
    """
    edges = np.linspace(0, draws + 1, BINS + 1)
    expected = np.diff(np.ceil(edges)) / (draws + 1) * len(found)
    values = np.array([stats.chisquare(np.histogram(column, np.ceil(edges) - 0.5)[0], expected)
                       .pvalue for column in found.T])
    return values, float(min(1.0, values.min() * len(values)))
