"""Walls between the openings of a plate: the smallest distance of polygons in a plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from halbach_fe.core.arrays import Floats


def thinnest_wall(polygons: Sequence[Floats], owners: Sequence[object]) -> tuple[float, int, int]:
    """Return the smallest distance in m of two polygons, and their numbers.

    Parameters
    ----------
    polygons : sequence of ndarray, shape (n, 2), in m
        Corners, counter-clockwise or clockwise.
    owners : sequence
        Polygons of one owner may touch and overlap; they are not compared.

    Returns
    -------
    distance : float, in m
        0 if two polygons overlap; infinite if there is nothing to compare.
    first, second : int
    """
    centres = np.array([(polygon.max(axis=0) + polygon.min(axis=0)) / 2 for polygon in polygons])
    reach = np.array([np.hypot(*(polygon - centre).T).max()
                      for polygon, centre in zip(polygons, centres, strict=True)])
    nearest = (np.inf, 0, 0)
    tree = cKDTree(centres)
    for first, centre in enumerate(centres):
        # all whose circles are nearer than the nearest pair so far
        limit = min(nearest[0], 4 * reach.max()) + reach[first] + reach.max()
        for second in tree.query_ball_point(centre, limit):
            if second <= first or owners[first] == owners[second]:
                continue
            apart = np.hypot(*(centres[second] - centre)) - reach[first] - reach[second]
            if apart < nearest[0]:
                distance = _distance(polygons[first], polygons[second])
                nearest = min(nearest, (distance, first, second))
    return nearest


def distance_from_origin(polygon: Floats) -> float:
    """Return the distance in m of a polygon (n, 2) from the origin; 0 if it is inside."""
    if _contains(polygon, np.zeros(2)):
        return 0.0
    return float(_to_edges(np.zeros((1, 2)), polygon).min())


def _distance(first: Floats, second: Floats) -> float:
    """Return the distance of two polygons, 0 if they overlap."""
    if (_contains(first, second[0]) or _contains(second, first[0]) or _cross(first, second)):
        return 0.0
    return float(min(_to_edges(first, second).min(), _to_edges(second, first).min()))


def _to_edges(points: Floats, polygon: Floats) -> Floats:
    """Return the distances (points, edges) of points from the edges of a polygon."""
    along = np.roll(polygon, -1, axis=0) - polygon
    apart = points[:, None] - polygon
    share = np.clip(np.sum(apart * along, axis=2) / np.sum(along**2, axis=1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(apart - share[:, :, None] * along, axis=2))


def _contains(polygon: Floats, point: Floats) -> bool:
    """Tell whether a point is inside a polygon, by the even-odd rule."""
    (x0, y0), (x1, y1) = polygon.T, np.roll(polygon, -1, axis=0).T
    crosses = np.flatnonzero((y0 > point[1]) != (y1 > point[1]))
    x = x0[crosses] + (point[1] - y0[crosses]) / (y1[crosses] - y0[crosses]) * (
        x1[crosses] - x0[crosses])
    return bool(np.sum(x > point[0]) % 2)


def _cross(first: Floats, second: Floats) -> bool:
    """Tell whether any edges of two polygons cross."""
    a, b = first[:, None], np.roll(first, -1, axis=0)[:, None]
    c, d = second[None], np.roll(second, -1, axis=0)[None]

    def side(start: Floats, end: Floats, point: Floats) -> Floats:
        along, to = end - start, point - start
        return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])

    return bool(((side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)).any())
