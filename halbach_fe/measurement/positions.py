"""The points at which a study observes the field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.study.measurement import GridPositions, Positions


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
