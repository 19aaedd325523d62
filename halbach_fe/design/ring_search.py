"""Searching for rings whose field in a region is homogeneous.

The field of every possible ring in every place is computed once, so that a design is judged by a
sum of rows of a table. The search is local and repeated: from a design it makes the best change of
one place until none helps, then of two places at once; then it changes a few places at random and
starts again from there, keeping what is better (iterated local search, see H. R. Lourenco,
O. C. Martin and T. Stutzle, Handbook of Metaheuristics (2003) 320). What is asked besides, least
field and largest mass, comes first: of two designs that miss it, the one that misses it by less is
better.

Deviations are those of the component along the main field, which is linear in the rings and
differs from |B| by the square of the components across it. Its extremes lie on the surface of the
region, as it is a harmonic function there. Permeable blocks are taken as they are in vacuum while
the search runs; then their reaction in the design that was found is added to every design, and the
search goes on from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.response.homogeneity import PPM

PAIRED = 10
"""Number of rings of each place, the best by themselves, that are tried in pairs."""

CHANGED = (2, 3, 4)
"""Numbers of places that are changed at random."""

PROMISING = 4.0
"""Factor to the best value below which pairs are tried."""

MISSES = 1e9
"""Value in ppm of designs that miss what is asked, above that of every other one."""

TINY_T = 1e-12
"""Mean field below which there is none."""

LEAST_GAIN = 1e-9
"""Smallest relative gain of a change: of smaller ones, rounding decides."""


@dataclass(frozen=True)
class Task:
    """Designs, and what is asked of them.

    Attributes
    ----------
    table : ndarray, shape (p, o, n + 2)
        Of option o in place p: the component of B along the main field in T at the points that
        decide, its mean over the volume in T, and the mass in kg.
    offset : ndarray, shape (n + 2,)
        The same of what every design has besides.
    weights : ndarray, shape (n,)
        Of the points in means over the volume.
    objective : str
        ``peak_to_peak`` or ``rms``.
    least_field_T, most_mass_kg : float
        0 and inf where they do not matter.
    """

    table: Floats
    offset: Floats
    weights: Floats
    objective: Literal["peak_to_peak", "rms"]
    least_field_T: float
    most_mass_kg: float

    def value(self, total: Floats) -> Floats:
        """Return the deviations (...) in ppm of designs (..., n + 2), and more if they miss."""
        field, mean, mass = total[..., :-2], total[..., -2], total[..., -1]
        if self.objective == "rms":
            deviation = np.sqrt((field - mean[..., None])**2 @ self.weights)
        else:
            deviation = field.max(axis=-1) - field.min(axis=-1)
        missing = (np.maximum(1 - mean / max(self.least_field_T, TINY_T), 0)
                   + np.maximum(mass / self.most_mass_kg - 1, 0))
        return np.asarray(np.where(missing > 0, MISSES * (1 + missing),
                                   PPM * deviation / np.maximum(mean, TINY_T)))

    def total(self, chosen: Ints) -> Floats:
        """Return the sums (n + 2,) of a design (p,)."""
        return np.asarray(self.offset + self.table[np.arange(len(chosen)), chosen].sum(axis=0))


@dataclass(frozen=True)
class Found:
    """A design that a search has found.

    Attributes
    ----------
    chosen : ndarray, shape (p,)
        Number of the option in each place.
    ppm : float
        Its deviation, or more than `MISSES`.
    """

    chosen: Ints
    ppm: float


def search(
    task: Task, start: Ints, restarts: int, generator: np.random.Generator, enough: float = 0.0
) -> Found:
    """Return the best design that a local search finds from a design (p,) and its changes.

    It ends after a number of random changes, or with a value of at most ``enough`` in ppm.
    """
    best = _descend(task, start, np.inf)
    places, options = task.table.shape[:2]
    for _ in range(restarts if options > 1 else 0):
        if best.ppm <= enough:
            break
        changed = best.chosen.copy()
        some = generator.choice(places, min(int(generator.choice(CHANGED)), places), replace=False)
        changed[some] = generator.integers(options, size=len(some))
        found = _descend(task, changed, best.ppm)
        if found.ppm < best.ppm:
            best = found
    return best


def _descend(task: Task, start: Ints, best: float) -> Found:
    """Change one place at a time, then two, until none helps.

    ``best`` is the value of the best design so far: pairs are tried where it is not far.
    """
    chosen, total = start.copy(), task.total(start)
    value = float(task.value(total))
    while True:
        rest = total - task.table[np.arange(len(chosen)), chosen]
        single = task.value(rest[:, None] + task.table)
        place, option = np.unravel_index(int(np.argmin(single)), single.shape)
        new = {int(place): int(option)}
        least = float(single[place, option])
        if least >= value * (1 - LEAST_GAIN) and value < PROMISING * best:
            least, new = _best_pair(task, rest, total, single)
        if least >= value * (1 - LEAST_GAIN):
            return Found(chosen, value)
        chosen[list(new)] = list(new.values())
        total, value = task.total(chosen), least


def _best_pair(
    task: Task, rest: Floats, total: Floats, single: Floats
) -> tuple[float, dict[int, int]]:
    """Return the least value by changes of two places, and the changes.

    ``rest`` (p, n + 2) are the sums without each place, ``single`` (p, o) the values of designs
    with one change.
    """
    from halbach_fe.design.ring_pairs import best_pair  # imports numba

    options = np.argsort(single, axis=1)[:, :PAIRED]
    value, first, one, second, other = best_pair(
        rest, total, task.table, options, task.weights, task.objective == "rms",
        task.least_field_T, task.most_mass_kg, MISSES, TINY_T, PPM)
    return value, {first: one, second: other} if first >= 0 else {}
