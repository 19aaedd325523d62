"""Checks of polygons that users give by their corners."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats

MAX_PAIRS = 2_000_000
"""Number of pairs of edges that are compared at once."""


def crossing(polygons: Floats) -> NDArray[np.bool_]:
    """Tell which of the polygons (n, corners, 2) have edges that cross, or no area, (n,)."""
    count = polygons.shape[1]
    first, second = np.triu_indices(count, 1)
    apart = (second - first > 1) & (second - first < count - 1)  # neighbours share a corner
    first, second = first[apart], second[apart]
    found = np.zeros(len(polygons), bool)
    step = max(1, MAX_PAIRS // count**2)
    for start in range(0, len(polygons), step):
        corners = polygons[start:start + step] @ [1, 1j]  # Im(conj(a) b) is the cross product
        corners = corners - corners.mean(axis=1, keepdims=True)
        ends = np.roll(corners, -1, axis=1)
        tiny = 1e-12 * np.abs(corners).max(axis=1) ** 2  # rounding of products of coordinates
        flat = np.abs((np.conj(corners) * ends).imag.sum(axis=1)) <= tiny
        edges = ((corners[:, first], ends[:, first]), (corners[:, second], ends[:, second]))
        opposite = []
        for (a, b), others in (edges, edges[::-1]):
            sides = [(np.conj(b - a) * (point - a)).imag for point in others]
            opposite.append((np.minimum(*sides) < -tiny[:, None])
                            & (np.maximum(*sides) > tiny[:, None]))
        found[start:start + step] = flat | (opposite[0] & opposite[1]).any(axis=1)
    return found
