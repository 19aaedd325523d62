"""Points of the held-out map of a synthetic campaign."""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.positions import grid_axes, on_grid, points_from
from halbach_fe.study.measurement import Positions


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
