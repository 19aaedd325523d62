"""Cells of a region, halved until they are small beside their distance from what makes the field.

The field of a block varies within its distance, however large the region is. Points that are to
show all of it are therefore the denser the nearer the blocks are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.outline import points_on, ring_radii
from halbach_fe.geometry.surface import distance_from_prism

Distance = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns their distances (n,) in m from what makes the field."""


def distance_from_blocks(blocks: Sequence[MagnetBlock], points: Floats, far_m: float) -> Floats:
    """Return the distances (n,) in m of points (n, 3) from the nearest of some blocks.

    They are negative inside, and ``far_m`` where all blocks are farther than that.
    """
    found = np.full(len(points), far_m)
    for block in blocks:
        corners = points_on(block.outline)
        if radii := ring_radii(block.outline):
            corners = radii[1] * np.array([[-1.0, -1.0], [1.0, 1.0]])
        places = block.to_frame(points)
        low = np.append(corners.min(axis=0), block.z_min)
        high = np.append(corners.max(axis=0), block.z_max)
        # arcs bulge by less than their chords
        bulge = float(np.linalg.norm(np.ptp(corners, axis=0))) if any(
            edge.arc for edge in block.outline) else 0.0
        beyond = np.maximum(np.maximum(low - places, places - high), 0.0)
        near = np.flatnonzero(np.linalg.norm(beyond, axis=1) - bulge < found)
        if not len(near):
            continue
        if radii := ring_radii(block.outline):
            radius = np.hypot(*places[near, :2].T)
            across = np.maximum(radii[0] - radius, radius - radii[1])
            along = np.maximum(block.z_min - places[near, 2], places[near, 2] - block.z_max)
            own = np.hypot(*np.maximum([across, along], 0.0))
            own = np.where(own > 0, own, np.maximum(across, along))
        else:
            own = distance_from_prism(block.outline, block.z_min, block.z_max, places[near])
        found[near] = np.minimum(found[near], own)
    return found


def halved(
    cells: Floats, place: Callable[[Floats], Floats], distance: Distance, share: float, most: int
) -> tuple[Floats, Floats, bool]:
    """Halve cells along their longest side until it is short beside their distance.

    Parameters
    ----------
    cells : ndarray, shape (n, k, 2)
        Least and largest coordinates of each cell.
    place : callable
        Takes coordinates (m, k) and returns points (m, 3) in m.
    share : float
        Longest side of a cell, relative to the distance of its middle.
    most : int
        Number of cells from which none is halved any more.

    Returns
    -------
    tuple
        The cells (n, k, 2), their longest sides (n,) in m, and whether all are short enough.
    """
    done: list[Floats] = []
    lengths: list[Floats] = []
    count = 0
    while len(cells):
        middle = cells.mean(axis=2)
        sides = np.empty(middle.shape)
        for axis in range(middle.shape[1]):
            ends = np.stack([middle, middle])
            ends[:, :, axis] = cells[:, axis].T
            sides[:, axis] = np.linalg.norm(place(ends[0]) - place(ends[1]), axis=1)
        length = sides.max(axis=1)
        long = length > share * distance(place(middle))
        if count + len(cells) + long.sum() > most:
            return (np.concatenate([*done, cells]), np.concatenate([*lengths, length]),
                    not long.any())
        done.append(cells[~long])
        lengths.append(length[~long])
        count += int((~long).sum())
        rest, axis = cells[long], sides[long].argmax(axis=1)
        rows = np.arange(len(rest))
        lower, upper = rest.copy(), rest.copy()
        lower[rows, axis, 1] = upper[rows, axis, 0] = rest[rows, axis].mean(axis=1)
        cells = np.concatenate([lower, upper])
    return np.concatenate(done), np.concatenate(lengths), True
