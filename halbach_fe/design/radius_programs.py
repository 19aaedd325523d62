"""Radii between those of a catalogue, by a sequence of linear programs.

For small moves of the rings the field at every point is linear in them. The moves within a trust
region that make the difference of the largest and the least field smallest, with a mean field as
large as asked, solve a linear program. It is taken if the field itself gets better, with a larger
region next time; otherwise the region shrinks to a quarter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import pi, sin, sqrt

import numpy as np
from scipy.optimize import linprog

from halbach_fe.core.arrays import Floats
from halbach_fe.design.ring_catalogue import (
    Catalogue,
    Option,
    RingOfBlocks,
    fields_with_images,
    largest_number,
    reach,
)
from halbach_fe.design.ring_search import Task

STEP_M = 1e-5
"""Step of the derivatives by a radius: that of a field which falls as 1/r^3 is exact to 1e-7."""

LARGEST_M, SMALLEST_M = 2e-3, 1e-6
"""First and last size of the trust region; no workshop places a block better than the last."""

RADIUS_DECIMALS = 7
"""Decimals of radii in m: finer than any workshop."""

MOST_PROGRAMS = 60
"""Largest number of programs. Each that helps is followed by a larger step."""


def moved_radii(
    catalogue: Catalogue, rings: tuple[Option, ...], reaction: Floats, task: Task
) -> tuple[Option, ...]:
    """Return a design whose radii are moved so that its field is more homogeneous.

    Parameters
    ----------
    catalogue : Catalogue
    rings : tuple of Option
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
    value, size = float(task.value(total)), LARGEST_M
    tie = _groups(catalogue, places)
    for _ in range(MOST_PROGRAMS):
        if size < SMALLEST_M:
            break
        slopes = _slopes(catalogue, rings, places, radii) @ tie
        moves = tie @ _program(task, total, slopes, tie, np.maximum(low - radii, -size),
                               np.minimum(high - radii, size),
                               _apart(catalogue, _with_radii(rings, places, radii), places))
        tried = _totals(catalogue, rings, places, radii + moves, reaction)
        now = float(task.value(tried))
        if now < value:
            radii, total, value, size = radii + moves, tried, now, min(2 * size, LARGEST_M)
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
    new = dict(zip(places, radii.round(RADIUS_DECIMALS).tolist(), strict=True))
    return tuple(tuple(ring and replace(ring, radius_m=new[place, layer])
                       for layer, ring in enumerate(option)) for place, option in enumerate(rings))


def _one_total(catalogue: Catalogue, ring: RingOfBlocks, place: int) -> Floats:
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
        _one_total(catalogue, _ring(moved, place, layer), place) for place, layer in places],
        axis=0)
    return np.append(total, catalogue.mass_of(moved))


def _slopes(
    catalogue: Catalogue, rings: Sequence[Option], places: Sequence[tuple[int, int]],
    radii: Floats,
) -> Floats:
    """Return the derivatives (n + 1, rings) in T/m of field and mean by each radius."""
    found = []
    for (place, layer), radius in zip(places, radii.tolist(), strict=True):
        ring = _ring(rings, place, layer)
        above, below = (_one_total(catalogue, replace(ring, radius_m=radius + step), place)
                        for step in (STEP_M, -STEP_M))
        found.append((above - below) / (2 * STEP_M))
    return np.array(found).T


def _apart(
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
