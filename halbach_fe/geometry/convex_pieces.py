"""Convex pieces of outlines, and how far convex prisms in any pose penetrate one another.

All pieces are inside the true shape: chords replace convex arcs, and tangents concave ones, so that
pieces of shapes that touch never overlap.

By the separating-axis theorem two convex polyhedra are apart if and only if their projections are
apart along a normal of a face of either, or along the cross product of an edge of each (S.
Gottschalk, M. C. Lin and D. Manocha, OBBTree, SIGGRAPH 1996). Else the smallest overlap of their
projections is the distance to move one of them until they are apart.

Every vector is a valid axis, and only too few axes can report an overlap that does not exist. The
cross product of nearly parallel edges, whose direction is rounding noise, therefore does no harm;
that of exactly parallel edges is zero and is left out, since it separates nothing that normals of
faces do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from halbach_fe.core.arrays import Floats, Ints, azimuths_of, slices
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.outline import Edge, Outline

Piece = tuple[Floats, Floats]
"""Corners (n, 2) in m of a convex polygon, counter-clockwise, and the different directions (m, 2)
of its edges as unit vectors."""

_MAX_PARTS, _MAX_CORNERS = 4096, 256
"""Largest numbers of parts of a full circle, which leave 3e-7 of the radius between arc and chord,
and of corners of a piece: the time to compare tilted pieces grows with its third power."""

_ROUNDING = 1e-9
"""Relative; coordinates in m carry errors of some 1e-16."""


class Shape:
    """The outline of a body in its own (x, y) plane, and what a search for overlaps needs of it.

    Attributes
    ----------
    middle : ndarray, shape (2,), in m
        Mean of the corners.
    centre : ndarray, shape (2,), in m
    reach : float, in m
        Centre and radius of a circle around the outline.
    polar : tuple of 4 floats, optional
        Inner and outer radius in m, and middle and half of the range of angles in rad, if the
        outline is a sector of an annulus about the axis of the frame.
    """

    def __init__(self, outline: Outline, polar: tuple[float, float, float, float] | None = None):
        self.outline = outline
        self.polar = polar or polar_ranges(outline)
        corners = np.array([edge.start for edge in outline])
        self.middle = corners.mean(axis=0)
        # an arc lies inside the triangle of its ends and the intersection of its tangents
        arcs = [_tangents(edge, 1 + int(abs(edge.angles[1]))) for edge in outline if edge.arc]
        bounds = np.vstack([corners, *arcs]) if arcs else corners
        self.centre = (bounds.min(axis=0) + bounds.max(axis=0)) / 2
        self.reach = float(np.hypot(*(bounds - self.centre).T).max())

    def pieces(self, chord_error: float, smallest: float) -> list[Piece]:
        """Return convex pieces whose distance from arcs is at most a fraction of the width.

        Parameters
        ----------
        chord_error : float
            The fraction.
        smallest : float, in m
            Width of the smallest body, which a sector's pieces are fine enough for; pieces of other
            shapes with arcs are for bodies of their own size.
        """
        width = 2 * self.reach
        if self.polar:
            inner, outer, middle, half = self.polar
            error = min(chord_error * min(width, smallest), (outer - inner) / 8)
            return _sector_pieces(inner, outer, middle - half, 2 * half, error)
        points: list[tuple[float, float]] = []
        for edge in self.outline:
            points.append(edge.start)
            if edge.arc:
                sweep = edge.angles[1]
                parts = _parts(abs(sweep), edge.radius, chord_error * width)
                between = (_tangents(edge, parts) if sweep < 0
                           else edge.at(np.arange(1, parts) / parts)[0])
                points += between.tolist()
        return [(corners, _directions(corners)) for corners in _convex(np.array(points))]


def annulus(inner: float, outer: float) -> Shape:
    """Return the shape of a closed annulus about the axis; its outline is only the outer circle."""
    angles = np.pi / 2 * np.arange(5)
    corners = [(float(outer * np.cos(a)), float(outer * np.sin(a))) for a in angles]
    outline = tuple(Edge(corners[k], corners[(k + 1) % 4], arc=True) for k in range(4))
    return Shape(outline, (inner, outer, 0.0, np.pi))


def polar_ranges(outline: Outline) -> tuple[float, float, float, float] | None:
    """Return the ranges of radius and angle of a sector as `Shape.polar`, None for other shapes."""
    straight = [number for number, edge in enumerate(outline) if not edge.arc]
    if len(straight) != 2 or len(outline) < 4:
        return None
    one, two = straight
    sides = [outline[one + 1:two], outline[two + 1:] + outline[:one]]
    if not (sides[0] and sides[1]):
        return None
    radii = [math.hypot(*side[0].start) for side in sides]
    out, back = sides if radii[0] > radii[1] else sides[::-1]
    inner, outer = sorted(radii)
    sweeps, returns = [edge.angles[1] for edge in out], [edge.angles[1] for edge in back]
    sweep = sum(sweeps)
    if min(sweeps) <= 0 or max(returns) >= 0 or not inner < outer or sweep > 2 * math.pi:
        return None
    rounding = _ROUNDING * outer
    for radius, side in ((outer, out), (inner, back)):
        if any(abs(math.hypot(*point) - radius) > rounding
               for edge in side for point in (edge.start, edge.end)):
            return None
    for edge in (outline[one], outline[two]):  # straight edges must be radial, on one side
        (x0, y0), (x1, y1) = edge.start, edge.end
        if abs(x0 * y1 - y0 * x1) > rounding * outer or x0 * x1 + y0 * y1 < 0:
            return None
    return inner, outer, out[0].angles[0] + sweep / 2, sweep / 2


def _parts(sweep: float, radius: float, error: float) -> int:
    """Return how many chords keep within an error in m of an arc: radius (1 - cos(sweep / 2))."""
    half = np.arccos(max(0.0, 1 - error / radius))
    # parts of at most half a right angle keep the intersections of tangents near the arc
    return int(np.ceil(sweep / 2 / np.clip(half, np.pi / _MAX_PARTS, np.pi / 8) - _ROUNDING))


def _tangents(edge: Edge, parts: int) -> Floats:
    """Return the points (parts, 2) where tangents at the ends of an arc's equal parts intersect."""
    middles = edge.at((np.arange(parts) + 0.5) / parts)[0]
    return np.asarray(middles / np.cos(edge.angles[1] / parts / 2))


def _sector_pieces(
    inner: float, outer: float, start: float, sweep: float, error: float
) -> list[Piece]:
    """Return quadrilaterals between chords of the outer arc and tangents of the inner one."""
    parts = _parts(sweep, outer, error)
    half = sweep / parts / 2
    # corners of a piece whose middle is on the x axis; a disc has triangles
    near = inner / np.cos(half)
    radii, sides = (([near, outer, outer, near], [-1, -1, 1, 1]) if inner > 0
                    else ([0.0, outer, outer], [0, -1, 1]))
    angles = half * np.array(sides) + (start + half * (2 * np.arange(parts) + 1))[:, None]
    corners = np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    # the outer and the inner edge are parallel, and the side faces lead to the axis
    edges = corners[:, 1:] - corners[:, :-1]
    directions = np.concatenate([edges[:, :2], -corners[:, -1:]], axis=1)
    directions /= np.linalg.norm(directions, axis=2)[..., None]
    return list(zip(corners, directions, strict=True))


def _directions(corners: Floats) -> Floats:
    """Return the directions (m, 2) of a polygon's edges; of parallel edges, only one."""
    edges = corners[np.arange(len(corners)) - 1] - corners
    angles = np.sort(azimuths_of(edges) % np.pi)
    new = np.append(True, np.diff(angles) > 1e-12)
    if len(angles) > 1 and angles[-1] - angles[0] > np.pi - 1e-12:
        new[-1] = False
    return np.column_stack([np.cos(angles[new]), np.sin(angles[new])])


def _convex(corners: Floats) -> list[Floats]:
    """Split a simple polygon (n, 2) into convex ones: itself, or triangles.

    StudyError if its edges cross.
    """
    corners = _simplified(corners)
    previous = np.arange(len(corners)) - 1
    if _cross(corners[previous], corners).sum() < 0:
        corners = corners[::-1]
    after = corners - corners[previous]
    before = after[previous]
    turns = np.arctan2(_cross(before, after), np.sum(before * after, axis=1))
    if turns.min() >= -_ROUNDING and turns.sum() < 3 * np.pi:
        last = len(corners) - 1
        return [np.vstack([corners[:1], corners[k:min(k + _MAX_CORNERS, last) + 1]])
                for k in range(1, last, _MAX_CORNERS)]
    if _crosses_itself(corners):
        raise StudyError("Input outline of study must be a polygon whose edges do not cross; "
                         f"instead they do, in the outline that has a corner at ({corners[0, 0]:g},"
                         f" {corners[0, 1]:g}) m. Give the corners in their order around it.")
    return [corners[list(triangle)]
            for triangle in triangles_of_polygon(tuple(map(tuple, corners.tolist())))]


def _simplified(corners: Floats) -> Floats:
    """Return a polygon without corners that repeat the one before."""
    steps = np.hypot(*(corners - corners[np.arange(len(corners)) - 1]).T)
    return corners[steps > 1e-12 * steps.max()]


def _cross(first: Floats, second: Floats) -> Floats:
    """Return the z components (n,) of cross products of vectors (n, 2)."""
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def _crosses_itself(corners: Floats) -> bool:
    """Tell whether any two edges of a polygon (n, 2) cross, each between the ends of the other."""
    start, along = corners, np.roll(corners, -1, axis=0) - corners
    # side[i, j]: of the line through edge i, on which corner j lies
    side = _cross(along[:, None], start[None] - start[:, None])
    rounding = 1e-12 * np.ptp(corners, axis=0).max() ** 2
    sign = np.where(np.abs(side) <= rounding, 0.0, np.sign(side))
    parted = sign * np.roll(sign, -1, axis=1) < 0
    return bool((parted & parted.T).any())


@lru_cache(maxsize=256)  # copies of a pole, and of a non-convex block
def triangles_of_polygon(polygon: tuple[tuple[float, float], ...]) -> list[tuple[int, int, int]]:
    """Triangulate a simple polygon, counter-clockwise, by cutting off ears.

    An ear is a convex corner whose triangle with its neighbours holds no other corner (G. H.
    Meisters, Amer. Math. Monthly 82 (1975) 648). That with the largest smallest angle goes first,
    so that triangles do not become needles.
    """
    corners = np.array(polygon)
    left = list(range(len(corners)))
    found: list[tuple[int, int, int]] = []
    while len(left) > 3:
        points = corners[left]
        previous, following = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
        ahead, behind = following - points, previous - points
        area = _cross(ahead, behind)
        sides = np.linalg.norm([ahead, behind, following - previous], axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            quality = area / np.sort(sides, axis=0)[1:].prod(axis=0)  # sine of the smallest angle
        flat = 1e-12 * np.ptp(corners, axis=0).max() ** 2
        for place in np.argsort(-quality):
            if abs(area[place]) <= flat:  # collinear: nothing to cut off, but a corner less
                break
            if area[place] < 0:
                continue
            a, b, c = previous[place], points[place], following[place]
            inside = points[np.all([_cross(end - start, points - start) > -flat
                                    for start, end in ((a, b), (b, c), (c, a))], axis=0)]
            # its own corners, which a polygon with a slit may have twice
            own = [np.hypot(*(inside - corner).T) < np.sqrt(flat) for corner in (a, b, c)]
            if np.any(own, axis=0).all():
                found.append((left[place - 1], left[place], left[(place + 1) % len(left)]))
                break
        left.pop(int(place))
    found.append((left[0], left[1], left[2]))
    return [triangle for triangle in found
            if _cross(*(corners[list(triangle[1:])] - corners[triangle[0]])) > 0]


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
            lambda at: _centre_offsets(mine[at], others[at]), normals))
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
            lambda at: _centre_offsets(mine[at], others[at]), lambda at: faces[at], crossed))


def _centre_offsets(first: Floats, second: Floats) -> Floats:
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
    return (rows[part] for part in slices(len(rows), step))


def _overlap(axes: Floats, first: Floats, second: Floats) -> Floats:
    """Return the smallest overlap (m,) of the projections of points on axes (m, k, d)."""
    length = np.linalg.norm(axes, axis=2)
    smallest = np.full(len(axes), np.inf)
    step = max(1, _PROJECTIONS // (len(axes) * (first.shape[1] + second.shape[1])))
    for part in slices(axes.shape[1], step):
        some, scale = axes[:, part], length[:, part]
        a, b = (some @ points.swapaxes(1, 2) for points in (first, second))
        overlap = np.minimum(a.max(axis=2) - b.min(axis=2), b.max(axis=2) - a.min(axis=2))
        # an axis of no length, of parallel edges or of coincident centres, tells nothing
        valid = np.divide(overlap, scale, out=np.full_like(overlap, np.inf), where=scale > 0)
        smallest = np.minimum(smallest, valid.min(axis=1))
    return smallest
