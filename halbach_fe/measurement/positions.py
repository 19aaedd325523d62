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
