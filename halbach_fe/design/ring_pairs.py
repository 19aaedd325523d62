"""The best change of two rings at once, compiled by numba."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.compiled import compiled


@compiled
def best_pair(
    rest: Floats, total: Floats, table: Floats, options: Ints, weights: Floats, is_rms: bool,
    least_field: float, most_mass: float, misses: float, tiny: float, ppm: float,
) -> tuple[float, int, int, int, int]:
    """Return the least value of designs with two changes, and the places and options of both.

    The value is that of `halbach_fe.design.ring_search.Task.value`, of which the other arguments
    are parts. ``rest`` (p, n + 2) are the sums without each place, ``total`` (n + 2,) that with
    all, and ``options`` (p, k) those that are tried in every place. A sum over points ends as soon
    as it is too large for the best.
    """
    points = table.shape[2] - 2
    base = np.empty(table.shape[2])
    best, first, one, second, other = inf, -1, -1, -1, -1
    for a in range(len(rest)):
        for b in range(a + 1, len(rest)):
            for i in options[a]:
                for n in range(points + 2):
                    base[n] = rest[a, n] + rest[b, n] - total[n] + table[a, i, n]
                for j in options[b]:
                    row = table[b, j]
                    mean, mass = base[points] + row[points], base[points + 1] + row[points + 1]
                    missing = max(1 - mean / max(least_field, tiny), 0.0) + max(
                        mass / most_mass - 1, 0.0)
                    if missing > 0:
                        value = misses * (1 + missing)
                    else:
                        scale = ppm / max(mean, tiny)
                        limit = best / scale
                        if is_rms:
                            spread, limit = 0.0, limit * limit
                            for n in range(points):
                                off = base[n] + row[n] - mean
                                spread += weights[n] * off * off
                                if spread > limit:
                                    break
                            value = scale * sqrt(spread)
                        else:
                            least, most = inf, -inf
                            for n in range(points):
                                field = base[n] + row[n]
                                least, most = min(least, field), max(most, field)
                                if most - least > limit:
                                    break
                            value = scale * (most - least)
                    if value < best:
                        best, first, one, second, other = value, a, i, b, j
    return best, first, one, second, other
