"""The lines in which a stage has scanned a map, of which some are held out as a test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints

HELD_OUT_EVERY = 5
"""Every so many scan lines one is held out by default."""


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


def held_out_lines(lines: Ints, every: int) -> NDArray[np.bool_]:
    """Return which rows (n,), of which the numbers of the lines are given, are held out.

    It is the middle line of every so many, so that neither the first nor the last one is.
    """
    return np.asarray(lines % every == every // 2)
