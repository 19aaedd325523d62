"""How far convex prisms in any pose penetrate one another, by the separating-axis theorem.

Two convex polyhedra are apart if and only if their projections are apart along a normal of a face
of either, or along the cross product of an edge of each (S. Gottschalk, M. C. Lin and D. Manocha,
OBBTree, SIGGRAPH 1996). Else the smallest overlap of their projections is the distance to move one
of them until they are apart.

Every vector is a valid axis, and only too few axes can report an overlap that does not exist. The
cross product of nearly parallel edges, whose direction is rounding noise, therefore does no harm;
that of exactly parallel edges is zero and is left out, since it separates nothing that normals of
faces do not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from halbach_fe.core.arrays import Floats, Ints

PARALLEL = 1e-9
"""Tilt in rad below which z axes count as parallel; over a body's length it moves no point by as
much as the penetrations that are allowed."""

_PROJECTIONS = 4_000_000
"""Number of projected corners that are computed at once: 32 MB."""


@dataclass(frozen=True)
class Prisms:
    """Pairs of convex prisms, (m, ...): corners, directions of edges and limits of z of both.

    Each is in the frame of its own; ``turn`` and ``shift`` lead from the second to the first.
    """

    corners: Floats
    directions: Floats
    limits: Floats
    other_corners: Floats
    other_directions: Floats
    other_limits: Floats
    turn: Floats
    shift: Floats

    def depth(self, allowed: Floats) -> Floats:
        """Return how far they penetrate, (m,) in m; at most ``allowed`` where they are apart."""
        depth = np.empty(len(allowed))
        parallel = np.abs(self.turn[:, :2, 2]).max(axis=1) <= PARALLEL
        for rows, compare in ((np.flatnonzero(parallel), self._parallel),
                              (np.flatnonzero(~parallel), self._tilted)):
            if len(rows):
                depth[rows] = compare(rows, allowed[rows])
        return depth

    def _parallel(self, rows: Ints, allowed: Floats) -> Floats:
        """Compare prisms with parallel z axes: their limits of z, and their outlines."""
        ends = np.sort(self.turn[rows, 2, 2:] * self.other_limits[rows] + self.shift[rows, 2:])
        limits = self.limits[rows]
        depth = np.minimum(limits[:, 1] - ends[:, 0], ends[:, 1] - limits[:, 0])
        level = depth > allowed
        rows, allowed = rows[level], allowed[level]
        plane = self.turn[rows, :2, :2].swapaxes(1, 2)
        mine = self.corners[rows]
        others = self.other_corners[rows] @ plane + self.shift[rows, None, :2]

        def normals(at: Ints) -> Floats:
            turned = self.other_directions[rows[at]] @ plane[at]
            edges = np.concatenate([self.directions[rows[at]], turned], axis=1)
            return np.asarray(edges[..., ::-1] * [1.0, -1.0])

        sizes = 1, self.directions.shape[1] + self.other_directions.shape[1]
        depth[level] = _smallest_overlap(depth[level], allowed, mine, others, sizes, (
            lambda at: _between(mine[at], others[at]), normals))
        return depth

    def _tilted(self, rows: Ints, allowed: Floats) -> Floats:
        """Compare prisms with any z axes."""
        turn, shift = self.turn[rows], self.shift[rows]
        back = turn.swapaxes(1, 2)
        mine = _solid(self.corners[rows], self.limits[rows])
        others = _solid(self.other_corners[rows], self.other_limits[rows]) @ back + shift[:, None]
        edges, normals = zip(*(_edges_and_normals(directions[rows]) for directions in (
            self.directions, self.other_directions)), strict=True)
        other_edges = edges[1] @ back
        faces = np.concatenate([normals[0], normals[1] @ back], axis=1)

        def crossed(at: Ints) -> Floats:
            product = np.cross(edges[0][at][:, :, None], other_edges[at][:, None])
            return np.asarray(product.reshape(len(at), -1, 3))

        sizes = 1, faces.shape[1], edges[0].shape[1] * other_edges.shape[1]
        return _smallest_overlap(np.full(len(rows), np.inf), allowed, mine, others, sizes, (
            lambda at: _between(mine[at], others[at]), lambda at: faces[at], crossed))


def _between(first: Floats, second: Floats) -> Floats:
    """Return the vectors (m, 1, d) between the centres of points (m, n, d) and (m, k, d)."""
    return np.asarray(second.mean(axis=1, keepdims=True) - first.mean(axis=1, keepdims=True))


def _solid(corners: Floats, limits: Floats) -> Floats:
    """Return the corners (m, 2 n, 3) of prisms with the outlines (m, n, 2) and limits (m, 2)."""
    ends = [np.concatenate([corners, np.broadcast_to(
        limits[:, end, None, None], (*corners.shape[:2], 1))], axis=2) for end in (0, 1)]
    return np.concatenate(ends, axis=1)


def _edges_and_normals(directions: Floats) -> tuple[Floats, Floats]:
    """Return the edges and the normals of faces of prisms, (m, n + 1, 3), from edges (m, n, 2)."""
    count = len(directions)
    along = np.broadcast_to([[0.0, 0.0, 1.0]], (count, 1, 3))
    level = np.concatenate([directions, np.zeros((*directions.shape[:2], 1))], axis=2)
    return (np.concatenate([level, along], axis=1),
            np.concatenate([level[..., [1, 0, 2]] * [1.0, -1.0, 0.0], along], axis=1))


def _smallest_overlap(
    depth: Floats, allowed: Floats, first: Floats, second: Floats, sizes: Sequence[int],
    stages: Sequence[Callable[[Ints], Floats]],
) -> Floats:
    """Return the smallest overlap of projections, (m,) in m, at most ``depth``.

    ``stages`` return axes (rows, size, d) for pairs of points (m, n, d) and (m, k, d). The line
    between the centres comes first, since it separates most pairs; pairs that are apart by one
    stage do not go through the next.
    """
    for size, axes in zip(sizes, stages, strict=True):
        for rows in _lumps(np.flatnonzero(depth > allowed), size):
            depth[rows] = np.minimum(depth[rows], _overlap(axes(rows), first[rows], second[rows]))
    return depth


def _lumps(rows: Ints, size: int) -> Iterator[Ints]:
    """Split row numbers so that every part has at most `_PROJECTIONS` axes of ``size`` each."""
    step = max(1, _PROJECTIONS // (8 * size))
    for start in range(0, len(rows), step):
        yield rows[start:start + step]


def _overlap(axes: Floats, first: Floats, second: Floats) -> Floats:
    """Return the smallest overlap (m,) of the projections of points on axes (m, k, d)."""
    length = np.linalg.norm(axes, axis=2)
    smallest = np.full(len(axes), np.inf)
    step = max(1, _PROJECTIONS // (len(axes) * (first.shape[1] + second.shape[1])))
    for start in range(0, axes.shape[1], step):
        some, scale = axes[:, start:start + step], length[:, start:start + step]
        a, b = (some @ points.swapaxes(1, 2) for points in (first, second))
        overlap = np.minimum(a.max(axis=2) - b.min(axis=2), b.max(axis=2) - a.min(axis=2))
        # an axis of no length, of parallel edges or of coincident centres, tells nothing
        valid = np.divide(overlap, scale, out=np.full_like(overlap, np.inf), where=scale > 0)
        smallest = np.minimum(smallest, valid.min(axis=1))
    return smallest
