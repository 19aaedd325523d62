"""The lines in which a stage has scanned a map, of which some are held out as a test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints

HELD_OUT_EVERY = 5
"""Every so many scan lines one is held out by default."""

JUMP = 1.5
"""Length of a step, relative to the median one, beyond which it is a jump to another line."""

STRAIGHT = 0.5
"""Cosine of the angle between two steps from which they are of one line, or of one circle."""

NEAR, AGAINST, MANY = 8, -0.7, 0.2
"""Number of neighbours that are near, cosine of the angle to the way to a neighbour below which it
is in the opposite direction, and share of points with such a neighbour that are many."""

ENOUGH = 20_000
"""Number of points that show how a stage moves."""


def point_spacing(points: Floats) -> float:
    """Return the median distance in m of points (n, 3) from their nearest neighbours."""
    distance = KDTree(points).query(points, 2)[0][:, 1]
    return float(np.median(distance[distance > 0])) if (distance > 0).any() else 1e-3


def scan_lines(points: Floats) -> Ints:
    """Return the number of the scan line (n,) of every point (n, 3).

    Scan lines run along the axis along which there are fewest of them. If they are no lines, or
    too few to hold one out, every point is one.
    """
    spacing = point_spacing(points)
    best = np.arange(len(points))
    for axis in range(3):
        across = np.delete(points, axis, axis=1)
        number = np.unique(np.round(across / (spacing / 4)).astype(int), axis=0,
                           return_inverse=True)[1].ravel()
        if number.max() < best.max():
            best = number
    few, short = best.max() + 1 < HELD_OUT_EVERY, len(points) < 3 * (best.max() + 1)
    return np.arange(len(points)) if few or short else best


def motion(points: Floats) -> Floats:
    """Return the unit vectors (n, 3) along which a stage came to each of its points (n, 3).

    They are 0 for the first point of a line: the stage has stopped there.
    """
    step = np.diff(points, axis=0, prepend=points[:1])
    size = np.linalg.norm(step, axis=1)
    usual = np.median(size[size > 0]) if size.any() else 0.0
    moved = (size > 0) & (size <= JUMP * usual)
    way = np.where(moved[:, None], step / np.where(moved, size, 1.0)[:, None], 0.0)
    goes_on = np.sum(way[1:] * way[:-1], axis=1) > STRAIGHT
    on_a_line = np.zeros(len(points), bool)
    on_a_line[1:] |= goes_on
    on_a_line[:-1] |= goes_on
    return np.asarray(way * on_a_line[:, None])


def goes_both_ways(points: Floats) -> bool:
    """Tell whether many of a map's points (n, 3) were come to against the way to others nearby."""
    points = points[:ENOUGH]
    way = motion(points)
    moved = way.any(axis=1)
    if moved.sum() < 2:
        return False
    count = min(NEAR + 1, int(moved.sum()))
    near = KDTree(points[moved]).query(points[moved], np.arange(2, count + 1))[1]
    along = np.einsum("nc,nkc->nk", way[moved], way[moved][near])
    return bool(np.mean((along < AGAINST).any(axis=1)) > MANY)


def held_out_lines(lines: Ints, every: int) -> NDArray[np.bool_]:
    """Return which rows (n,), of which the numbers of the lines are given, are held out.

    It is the middle line of every so many, so that neither the first nor the last one is.
    """
    return np.asarray(lines % every == every // 2)
