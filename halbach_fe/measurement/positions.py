"""The points at which a field is observed, and the lines in which a stage has scanned them.

Some of the lines are held out as a test.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.study.measurement_keys import GridPositions, Positions


def points_from(positions: Positions) -> Floats:
    """Return the points (n, 3) in m of a study's positions: a line, a list, a grid or circles."""
    if positions.kind == "line":
        return np.linspace(positions.start_m, positions.end_m, positions.count)
    if positions.kind == "points":
        return np.array(positions.points_m, float)
    if positions.kind == "grid":
        return on_grid(grid_axes(positions))
    angle = 2 * np.pi * np.arange(positions.angles) / positions.angles
    z = np.linspace(positions.z_min_m, positions.z_max_m, positions.count)
    radii = np.array(positions.radius_m)
    circles = radii[:, None, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.column_stack([np.tile(circles, (1, len(z), 1)).reshape(-1, 2),
                            np.tile(np.repeat(z, len(angle)), len(radii))])


def grid_axes(positions: GridPositions) -> list[Floats]:
    """Return the coordinates in m of a grid along x, y and z, one array per axis."""
    return [np.linspace(start, end, count) for start, end, count in zip(
        positions.start_m, positions.end_m, positions.count, strict=True)]


def on_grid(axes: Sequence[Floats]) -> Floats:
    """Return the points (n, 3) of a grid with given coordinates along x, y and z.

    The z coordinate changes fastest.
    """
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def between(positions: Positions) -> Floats:
    """Return points (n, 3) in m halfway between those of a study; none if it has one point only.

    Circles are shifted by half a step in the angle and along z, lines by half a step, and grids by
    half a step along each axis that has several points. Of points that are given one by one, each
    is moved halfway to its nearest neighbour.
    """
    points = points_from(positions)
    if positions.kind == "circles":
        z = np.unique(points[:, 2])
        between_z = (z[:-1] + z[1:]) / 2 if len(z) > 1 else z
        angle = 2 * np.pi * (np.arange(positions.angles) + 0.5) / positions.angles
        circle = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        return np.vstack([radius * circle + [0, 0, height]
                          for radius in positions.radius_m for height in between_z])
    if positions.kind == "grid" and len(points) > 1:
        return on_grid([(axis[:-1] + axis[1:]) / 2 if len(axis) > 1 else axis
                        for axis in grid_axes(positions)])
    if positions.kind == "line" or len(points) < 2:
        return (points[:-1] + points[1:]) / 2
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(distance, np.inf)
    middles = (points + points[distance.argmin(axis=1)]) / 2
    return np.unique(middles, axis=0)


HELD_OUT_EVERY = 5
"""Every so many scan lines one is held out by default."""

OF_REGION = 8
"""Largest number of points of a region of a scattered map: a region has an inside."""


def point_spacing(points: Floats) -> float:
    """Return the median distance in m of points (n, 3) from their nearest neighbours."""
    distance = KDTree(points).query(points, 2)[0][:, 1]
    return float(np.median(distance[distance > 0])) if (distance > 0).any() else 1e-3


def scan_lines(points: Floats) -> Ints:
    """Return the number of the scan line (n,) of every point (n, 3).

    Scan lines run along the axis along which there are fewest of them. A map that a stage has not
    scanned in lines or circles has regions in place of them: single points among neighbours would
    test nothing. If there are too few lines or regions to hold one out, every point is one.
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
    if not (few or short):
        return best
    scattered = not few and np.mean(motion(points).any(axis=1)) < 1 / 2
    regions = _regions(points) if scattered else np.zeros(len(points), int)
    return regions if regions.max() + 1 >= HELD_OUT_EVERY else np.arange(len(points))


def _regions(points: Floats) -> Ints:
    """Return the number (n,) of the region of every point (n, 3), of at most `OF_REGION` points.

    Each half of the points along their longest extent is halved again.
    """
    number = np.zeros(len(points), int)
    parts = [np.arange(len(points))]
    while max(map(len, parts)) > OF_REGION:
        halves = []
        for part in parts:
            axis = int(np.argmax(np.ptp(points[part], axis=0)))
            halves += np.array_split(part[np.argsort(points[part, axis], kind="stable")], 2)
        parts = halves
    for region, part in enumerate(parts):
        number[part] = region
    return number


def is_sorted(points: Floats) -> bool:
    """Tell whether points (n, 3) are sorted by their coordinates, upwards, in whatever order of
    the axes; a stage that moves to and fro reads none in such an order.
    """
    return any((np.lexsort(points[:, axes].T) == np.arange(len(points))).all()
               for axes in permutations(range(3)))


def motion(points: Floats, time: Floats | None = None) -> Floats:
    """Return the unit vectors (n, 3) along which a stage came to each of its points (n, 3).

    The points are in the order of the scan, unless times (n,) tell another one. The vectors are 0
    for the first point of a line, where the stage has stopped. Repeated readings at a point have
    that of the first one.
    """
    if time is not None:
        order, found = np.argsort(time, kind="stable"), np.empty(points.shape)
        found[order] = motion(points[order])
        return found
    # Length of a step, relative to the next one along its line, beyond which it is a jump: some
    # rows of a line may be missing, and points are farther apart where the field is smooth.
    jump = 5.0
    new = np.append(True, (points[1:] != points[:-1]).any(axis=1))
    places = points[new]
    step = np.diff(places, axis=0, prepend=places[:1])
    size = np.linalg.norm(step, axis=1)
    way = step / np.where(size > 0, size, 1.0)[:, None]
    ratio = size[1:] / np.where(size[:-1] > 0, size[:-1], np.inf)
    # cosine of the angle between two steps from which they are of one line, or of one circle
    straight = 0.5
    goes_on = np.sum(way[1:] * way[:-1], axis=1) > straight
    on_a_line = np.zeros(len(places), bool)
    on_a_line[1:] |= goes_on & (ratio <= jump)
    on_a_line[:-1] |= goes_on & (ratio >= 1 / jump)
    return np.asarray((way * on_a_line[:, None])[np.cumsum(new) - 1])


def follows_times(points: Floats, time: Floats) -> bool:
    """Tell whether the stage came to points (n, 3) along their rows, by the times (n,) of these.

    Times that start again in every scan of a joined table, by which a stage would jump, say
    nothing of that.
    """
    few = 0.05  # share of rows between which the way differs, as where two have the same time
    other_way = 0.5  # length of the difference of two unit vectors, which are then 30 deg apart
    by_time, by_row = motion(points, time), motion(points)
    if by_time.any(axis=1).sum() <= by_row.any(axis=1).sum() / 2:
        return True
    return bool(np.mean(np.linalg.norm(by_time - by_row, axis=1) > other_way) <= few)


def held_out_lines(lines: Ints, every: int) -> NDArray[np.bool_]:
    """Return which rows (n,), of which the numbers of the lines are given, are held out.

    It is the middle line of every so many, so that neither the first nor the last one is.
    """
    return np.asarray(lines % every == every // 2)
