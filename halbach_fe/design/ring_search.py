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

Radii between those of the catalogue are found by a sequence of linear programs (`moved_radii`). For
small moves of the rings the field at every point is linear in them. The moves within a trust region
that make the difference of the largest and the least field smallest, with a mean field as large as
asked, solve a linear program. It is taken if the field itself gets better, with a larger region
next time; otherwise the region shrinks to a quarter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, pi, sin, sqrt
from typing import Literal

import numpy as np
from scipy.optimize import linprog

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.threads import compiled
from halbach_fe.design.ring_catalogue import (
    Catalogue,
    Option,
    RingOfBlocks,
    fields_with_images,
    largest_number,
    reach,
)
from halbach_fe.response.homogeneity import PPM

MISSES = 1e9
"""Value in ppm of designs that miss what is asked, above that of every other one."""

TINY_T = 1e-12
"""Mean field below which there is none."""


@dataclass(frozen=True)
class Task:
    """Designs, and what is asked of them."""

    table: Floats
    """Of option o in place p: the component of B along the main field in T at the points that
    decide, its mean over the volume in T, and the mass in kg. Shape (p, o, n + 2)."""
    offset: Floats
    """The same of what every design has besides. Shape (n + 2,)."""
    weights: Floats
    """Of the points in means over the volume. Shape (n,)."""
    objective: Literal["peak_to_peak", "rms"]
    """``peak_to_peak`` or ``rms``."""
    least_field_T: float
    most_mass_kg: float
    """0 and inf where they do not matter."""

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
    """A design that a search has found."""

    chosen: Ints
    """Number of the option in each place. Shape (p,)."""
    ppm: float
    """Its deviation, or more than `MISSES`."""


def search(
    task: Task, start: Ints, restarts: int, generator: np.random.Generator, enough: float = 0.0
) -> Found:
    """Return the best design that a local search finds from a design (p,) and its changes.

    It ends after a number of random changes, or with a value of at most ``enough`` in ppm.
    """
    best = _descend(task, start, np.inf)
    places, options = task.table.shape[:2]
    counts = (2, 3, 4)  # numbers of places that are changed at random
    for _ in range(restarts if options > 1 else 0):
        if best.ppm <= enough:
            break
        changed = best.chosen.copy()
        some = generator.choice(places, min(int(generator.choice(counts)), places), replace=False)
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
    promising = 4.0  # factor to the best value below which pairs are tried
    least_gain = 1e-9  # smallest relative gain of a change: of smaller ones, rounding decides
    while True:
        rest = total - task.table[np.arange(len(chosen)), chosen]
        single = task.value(rest[:, None] + task.table)
        place, option = np.unravel_index(int(np.argmin(single)), single.shape)
        new = {int(place): int(option)}
        least = float(single[place, option])
        if least >= value * (1 - least_gain) and value < promising * best:
            least, new = _best_pair(task, rest, total, single)
        if least >= value * (1 - least_gain):
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
    paired = 10  # number of rings of each place, the best by themselves, that are tried in pairs
    options = np.argsort(single, axis=1)[:, :paired]
    value, first, one, second, other = best_pair(
        rest, total, task.table, options, task.weights, task.objective == "rms",
        task.least_field_T, task.most_mass_kg, MISSES, TINY_T, PPM)
    return value, {first: one, second: other} if first >= 0 else {}


@compiled
def best_pair(
    rest: Floats, total: Floats, table: Floats, options: Ints, weights: Floats, is_rms: bool,
    least_field: float, most_mass: float, misses: float, tiny: float, ppm: float,
) -> tuple[float, int, int, int, int]:
    """Return the least value of designs with two changes, and the places and options of both.

    The value is that of `Task.value`, of which the other arguments
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


def moved_radii(
    catalogue: Catalogue, rings: tuple[Option, ...], reaction: Floats, task: Task
) -> tuple[Option, ...]:
    """Return a design whose radii are moved so that its field is more homogeneous.

    Parameters
    ----------
    reaction : ndarray, shape (k,), in T
        Field of permeable blocks, which stays as it is.
    task : Task
        What is asked.
    """
    places = [(place, layer) for place, option in enumerate(rings)
              for layer, ring in enumerate(option) if ring]
    low, high = (np.array(each) for each in zip(*(
        _limits(catalogue, layer, _ring(rings, place, layer)) for place, layer in places),
        strict=True))
    radii = np.array([_ring(rings, place, layer).radius_m for place, layer in places])
    total = _totals(catalogue, rings, places, radii, reaction)
    # first and last size of the trust region; no workshop places a block better than the last
    largest_m, smallest_m = 2e-3, 1e-6
    value, size = float(task.value(total)), largest_m
    tie = _groups(catalogue, places)
    most_programs = 60  # largest number of programs. Each that helps is followed by a larger step.
    for _ in range(most_programs):
        if size < smallest_m:
            break
        slopes = _slopes(catalogue, rings, places, radii) @ tie
        moves = tie @ _program(task, total, slopes, tie, np.maximum(low - radii, -size),
                               np.minimum(high - radii, size),
                               _gaps(catalogue, _with_radii(rings, places, radii), places))
        tried = _totals(catalogue, rings, places, radii + moves, reaction)
        now = float(task.value(tried))
        if now < value:
            radii, total, value, size = radii + moves, tried, now, min(2 * size, largest_m)
        else:
            size /= 4
    return _with_radii(rings, places, radii)


def _ring(rings: Sequence[Option], place: int, layer: int) -> RingOfBlocks:
    """Return the ring in a layer of a place that is not empty."""
    ring = rings[place][layer]
    assert ring is not None
    return ring


def _limits(catalogue: Catalogue, layer: int, ring: RingOfBlocks) -> tuple[float, float]:
    """Return the least and the largest radius in m of a ring with as many blocks."""
    settings, array = catalogue.design.layer[layer], catalogue.study.array.of_ring(1)
    least = min(settings.radii_m)
    if array.block.shape == "cuboid" and largest_number(
            array, least, ring.size_m, settings.gap_m) < ring.blocks:
        if array.block.orientation == "magnetization":
            room = (sqrt(2) * ring.size_m + settings.gap_m) / (2 * sin(pi / ring.blocks))
        else:
            room = (ring.size_m + settings.gap_m) / (2 * np.tan(pi / ring.blocks)) + ring.size_m / 2
        least = min(float(room), ring.radius_m)  # a catalogue may be closer than it need be
    return least, max(settings.radii_m)


def _groups(catalogue: Catalogue, places: Sequence[tuple[int, int]]) -> Floats:
    """Return the matrix (rings, moves) from independent moves to those of all rings."""
    if not catalogue.design.layers_together:
        return np.eye(len(places))
    numbers = sorted({place for place, _ in places})
    return np.array([[float(place == number) for number in numbers] for place, _ in places])


def _with_radii(
    rings: Sequence[Option], places: Sequence[tuple[int, int]], radii: Floats
) -> tuple[Option, ...]:
    """Return the rings with other radii in m."""
    decimals = 7  # decimals of radii in m: finer than any workshop
    new = dict(zip(places, radii.round(decimals).tolist(), strict=True))
    return tuple(tuple(ring and replace(ring, radius_m=new[place, layer])
                       for layer, ring in enumerate(option)) for place, option in enumerate(rings))


def _ring_total(catalogue: Catalogue, ring: RingOfBlocks, place: int) -> Floats:
    """Return the field (n,) in T where it decides and its mean, of a ring and its image."""
    sample = catalogue.sample
    field, = fields_with_images(catalogue.study, ring, catalogue.z_m[place:place + 1],
                                sample.points) @ sample.direction
    return np.append(field[catalogue.decide], sample.weights @ field)


def _totals(
    catalogue: Catalogue, rings: Sequence[Option], places: Sequence[tuple[int, int]],
    radii: Floats, reaction: Floats,
) -> Floats:
    """Return the sums (n + 2,) of a design with other radii, see `Task.table`."""
    weights = catalogue.sample.weights
    moved = _with_radii(rings, places, radii)
    total = np.append(reaction[catalogue.decide], weights @ reaction) + np.sum([
        _ring_total(catalogue, _ring(moved, place, layer), place) for place, layer in places],
        axis=0)
    return np.append(total, catalogue.mass_of(moved))


def _slopes(
    catalogue: Catalogue, rings: Sequence[Option], places: Sequence[tuple[int, int]],
    radii: Floats,
) -> Floats:
    """Return the derivatives (n + 1, rings) in T/m of field and mean by each radius."""
    found = []
    # step of the derivatives by a radius: that of a field which falls as 1/r^3 is exact to 1e-7
    step_m = 1e-5
    for (place, layer), radius in zip(places, radii.tolist(), strict=True):
        ring = _ring(rings, place, layer)
        above, below = (_ring_total(catalogue, replace(ring, radius_m=radius + step), place)
                        for step in (step_m, -step_m))
        found.append((above - below) / (2 * step_m))
    return np.array(found).T


def _gaps(
    catalogue: Catalogue, rings: Sequence[Option], places: Sequence[tuple[int, int]]
) -> list[tuple[int, int, float]]:
    """Return pairs of neighbouring rings at one place, and by how much in m they may approach."""
    ranges = [reach(catalogue.study, _ring(rings, *place)) for place in places]
    return [(number, number + 1, max(outer[0] - inner[1], 0.0))
            for number, (inner, outer) in enumerate(pairwise(ranges))
            if places[number][0] == places[number + 1][0]]


def _program(
    task: Task, total: Floats, slopes: Floats, tie: Floats, low: Floats, high: Floats,
    apart: Sequence[tuple[int, int, float]],
) -> Floats:
    """Return the moves (moves,) in m that a linear program finds.

    Its unknowns are the moves, the least and the largest field, in parts of the mean field.
    """
    field, mean = total[:-2] / total[-2], total[-2]
    by_field, by_mean = slopes[:-1] / mean, slopes[-1]
    one, zero = np.ones((len(field), 1)), np.zeros((len(field), 1))
    rows = [np.hstack([by_field, zero, -one]), np.hstack([-by_field, one, zero]),
            np.append(-by_mean, [0.0, 0.0])[None]]
    limits = [-field, field, [max(mean - task.least_field_T, 0.0)]]
    for inner, outer, gap in apart:
        rows.append(np.append(tie[inner] - tie[outer], [0.0, 0.0])[None])
        limits.append([gap])
    bounds = [(low[mine].max(), high[mine].min()) for mine in (tie.T > 0)]
    aim = np.append(np.zeros(len(bounds)), [-1.0, 1.0])
    found = linprog(aim, np.vstack(rows), np.concatenate(limits),
                    bounds=[*bounds, (None, None), (None, None)])
    return np.asarray(found.x[:-2]) if found.success else np.zeros(len(bounds))
