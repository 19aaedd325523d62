"""Outlines of blocks in the (x, y) plane, made of straight edges and arcs about the z axis.

A prism stands on an outline between two values of z: the blocks that stand upright, and the plates
and openings that hold them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from halbach_fe.core.arrays import Bools, Floats, box_middle, unit_circle

if TYPE_CHECKING:  # blocks stand on outlines
    from halbach_fe.geometry.blocks import MagnetBlock


@dataclass(frozen=True)
class Edge:
    """A directed edge of an outline: straight, or (``arc``) an arc about the z axis.

    ``start`` and ``end`` are in m.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    arc: bool = False

    @property
    def angles(self) -> tuple[float, float]:
        """Start angle and signed sweep of an arc in rad; the sweep is between -pi and pi."""
        first = np.arctan2(self.start[1], self.start[0])
        last = np.arctan2(self.end[1], self.end[0])
        sweep = (last - first + np.pi) % (2 * np.pi) - np.pi
        return float(first), float(sweep)

    @property
    def radius(self) -> float:
        """Distance in m of the edge's start from the z axis; the radius of an arc."""
        return float(np.hypot(*self.start))

    @property
    def length(self) -> float:
        """Length in m."""
        if self.arc:
            return abs(self.angles[1]) * self.radius
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """Return points on the edge and its scaled normals at parameters t in [0, 1].

        Parameters
        ----------
        t : ndarray, shape (n,)

        Returns
        -------
        points : ndarray, shape (n, 2), in m
        normals : ndarray, shape (n, 2), in m
            Outward normals whose length is the derivative of the arc length by t. Outlines run
            counter-clockwise, so that outward is to the right of the edge.
        """
        t = np.asarray(t, float)[:, None]
        if self.arc:
            first, sweep = self.angles
            radial = np.hstack([np.cos(first + sweep * t), np.sin(first + sweep * t)])
            return self.radius * radial, self.radius * sweep * radial
        start, end = np.array(self.start), np.array(self.end)
        along = end - start
        return start + t * along, np.broadcast_to([along[1], -along[0]], (len(t), 2))


Outline = tuple[Edge, ...]


@lru_cache(maxsize=4096)  # the same magnet is built with many instruments and effects
def points_on(outline: Outline) -> Floats:
    """Return points (n, 2) in m on an outline: its corners, and some on its arcs."""
    parts_of_arc = 8  # number of equal parts of an arc at whose ends `points_on` has points
    t = np.linspace(0.0, 1.0, parts_of_arc + 1)[:-1]
    points = np.vstack([edge.at(t if edge.arc else t[:1])[0] for edge in outline])
    points.flags.writeable = False
    return points


def along_edges(outline: Outline, per_edge: int) -> Floats:
    """Return points (n, 2) in m along an outline, evenly spread over each edge, ends and all."""
    return np.vstack([edge.at(np.linspace(0.0, 1.0, per_edge))[0] for edge in outline])


def at_heights(flat: Floats, *heights: float) -> Floats:
    """Return points (n, 2) at each of some heights, (heights n, 3), in m."""
    return np.vstack([np.column_stack([flat, np.full(len(flat), z)]) for z in heights])


@lru_cache(maxsize=4096)
def mean_corner(outline: Outline) -> tuple[float, float]:
    """Return the mean of the corners of an outline, in m."""
    x, y = np.mean([edge.start for edge in outline], axis=0).tolist()
    return x, y


def outline_contains(outline: Outline, points: Floats) -> Bools:
    """Tell which points (n, 2) in m lie inside an outline.

    The even-odd rule (crossings of a ray along +x) decides for the polygon of the corners. Points
    in a circular segment, between the chord and the arc of an edge, are on the other side of the
    outline than of the polygon.
    """
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for edge in outline:
        (x0, y0), (x1, y1) = edge.start, edge.end
        crosses = (y0 > y) != (y1 > y)
        if y1 != y0:
            inside ^= crosses & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    for edge in outline:
        if edge.arc:
            (x0, y0), (x1, y1) = edge.start, edge.end
            side = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
            beyond = side < 0 if edge.angles[1] > 0 else side > 0
            inside ^= beyond & (np.hypot(x, y) < edge.radius)
    return inside


@lru_cache(maxsize=4096)  # the same magnet is built with many instruments and effects
def outline_area(outline: Outline) -> float:
    """Return the area in m^2 inside an outline.

    It is the boundary integral of Green's theorem. The quadrature is exact: the integrand is a
    polynomial on straight edges and constant on arcs.
    """
    t, weight = np.polynomial.legendre.leggauss(3)
    total = 0.0
    for edge in outline:
        points, normals = edge.at((t + 1) / 2)
        total += float(np.sum(weight / 2 * np.einsum("ij,ij->i", points, normals))) / 2
    return total


def outline_centroid(outline: Outline) -> Floats:
    """Return the centroid (2,) in m of the area inside an outline, by Green's theorem.

    The quadrature is exact on straight edges, and to rounding on arcs.
    """
    t, weight = np.polynomial.legendre.leggauss(16)
    total = np.zeros(2)
    for edge in outline:
        points, normals = edge.at((t + 1) / 2)
        total += np.sum(weight[:, None] / 4 * points**2 * normals, axis=0)
    return total / outline_area(outline)


@lru_cache(maxsize=4096)
def ring_radii(outline: Outline) -> tuple[float, float] | None:
    """Return inner and outer radius in m of a sector of a whole turn, whose seam is no surface.

    The first of its eight edges and the fifth, straight ones, lie on each other; None for others.
    """
    if len(outline) != 8 or [edge.arc for edge in outline] != 2 * [False, True, True, True]:
        return None
    out, back = outline[0], outline[4]
    seam = np.array([out.start, out.end]) - np.array([back.end, back.start])
    rounding = 1e-12  # relative, of sines and cosines of half a turn
    if np.abs(seam).max() > rounding * out.length + rounding * back.radius:
        return None
    return out.radius, back.radius


def places_in(outline: Outline, depth: Floats, width: Floats) -> Floats:
    """Return points (n, m, 2) in m in an outline, on a grid of fractions of thickness and width.

    The points lie on straight lines between the inner face (edge 3 of every shape) and the outer
    face (edge 1).

    Parameters
    ----------
    depth : ndarray, shape (n,)
        Fractions of the thickness, from the inner face.
    width : ndarray, shape (m,)
        Fractions of the width.
    """
    far, near = outline[1].at(width)[0], outline[3].at(1 - width)[0]
    share = depth[:, None, None]
    return np.asarray((1 - share) * near + share * far)


def outline_part(outline: Outline, inner: float, outer: float, start: float,
                 stop: float) -> Outline:
    """Return the part of an outline between two fractions of its thickness and of its width.

    ``inner`` and ``outer`` are fractions of the thickness, counted from the inner face; ``start``
    and ``stop`` are fractions of the width.
    """
    (first, second), (fourth, third) = places_in(
        outline, np.array([inner, outer]), np.array([start, stop])).swapaxes(0, 1)
    return closed_outline(np.array([first, second, third, fourth]), tuple(
        number for number in (1, 3) if outline[number].arc))


def closed_outline(corners: Floats, arcs: tuple[int, ...] = ()) -> Outline:
    """Return the outline through corners (n, 2) in m, in their order.

    ``arcs`` are the numbers (from 0) of the edges that are arcs about the z axis.
    """
    points = [(float(x), float(y)) for x, y in corners]
    return tuple(Edge(points[i], points[(i + 1) % len(points)], arc=i in arcs)
                 for i in range(len(points)))


def trapezoid_corners(x: tuple[float, float], half_widths: tuple[float, float]) -> Floats:
    """Return the corners (4, 2) in m of a trapezoid along x, with its half widths along y."""
    (near, far), (narrow, wide) = x, half_widths
    return np.array([(near, -narrow), (far, -wide), (far, wide), (near, narrow)])


def circle(radius: float) -> Outline:
    """Return a circle about the origin, in four arcs; the x axis crosses the middle of one."""
    angles = np.pi / 4 * np.array([-3, -1, 1, 3])
    return closed_outline(radius * unit_circle(angles)[:, :2], (0, 1, 2, 3))


def rectangle(size_x: float, size_y: float) -> Outline:
    """Return a rectangle about the origin."""
    return closed_outline(trapezoid_corners((-size_x / 2, size_x / 2), (size_y / 2, size_y / 2)))


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
    centres = np.array([box_middle(polygon) for polygon in polygons])
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
                distance = _polygon_distance(polygons[first], polygons[second])
                nearest = min(nearest, (distance, first, second))
    return nearest


def distance_from_origin(polygon: Floats) -> float:
    """Return the distance in m of a polygon (n, 2) from the origin; 0 if it is inside."""
    if _contains(polygon, np.zeros(2)):
        return 0.0
    return float(_edge_distances(np.zeros((1, 2)), polygon).min())


def _polygon_distance(first: Floats, second: Floats) -> float:
    """Return the distance of two polygons, 0 if they overlap."""
    if (_contains(first, second[0]) or _contains(second, first[0]) or _edges_cross(first, second)):
        return 0.0
    return float(min(_edge_distances(first, second).min(), _edge_distances(second, first).min()))


def _edge_distances(points: Floats, polygon: Floats) -> Floats:
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


def _edges_cross(first: Floats, second: Floats) -> bool:
    """Tell whether any edges of two polygons cross."""
    a, b = first[:, None], np.roll(first, -1, axis=0)[:, None]
    c, d = second[None], np.roll(second, -1, axis=0)[None]

    def side(start: Floats, end: Floats, point: Floats) -> Floats:
        along, to = end - start, point - start
        return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])

    return bool(((side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)).any())


ARC_STEP_RAD = np.radians(1.0)
"""Longest part of an arc that a chord replaces. At 150 mm from the centre it is 6 µm off."""

Curve = tuple[tuple[float, float], tuple[float, float], tuple[float, float] | None]
"""Start, end and, of an arc of less than half a turn, centre in m."""


@dataclass(frozen=True)
class Prism:
    """A solid between two values of z."""

    outline: Outline
    """Its cross-section in a frame of its own, in m."""
    z_min: float
    z_max: float
    """In m."""
    axes: Floats = field(default_factory=lambda: np.eye(2))
    """Axes of that frame in the (x, y) plane, as columns; they may be those of a mirror image.
    Shape (2, 2)."""
    origin: Floats = field(default_factory=lambda: np.zeros(2))
    """Origin of that frame. Shape (2,), in m."""

    def placed(self, points: Floats) -> Floats:
        """Return points (n, 2) in m of the own frame in the (x, y) plane."""
        return np.asarray(points @ self.axes.T + self.origin)

    @cached_property
    def curves(self) -> tuple[Curve, ...]:
        """Edges of the cross-section in the (x, y) plane."""
        starts = self.placed(np.array([edge.start for edge in self.outline]))
        corners = [(float(x), float(y)) for x, y in starts]
        centre = float(self.origin[0]), float(self.origin[1])
        return tuple((start, end, centre if edge.arc else None) for start, end, edge in zip(
            corners, corners[1:] + corners[:1], self.outline, strict=True))

    @cached_property
    def polygon(self) -> Floats:
        """Points (n, 2) in m around the cross-section in the (x, y) plane, with arcs as chords."""
        parts = []
        for edge in self.outline:
            count = int(np.ceil(abs(edge.angles[1]) / ARC_STEP_RAD)) if edge.arc else 1
            parts.append(edge.at(np.arange(count) / count)[0])
        return self.placed(np.vstack(parts))

    @property
    def volume(self) -> float:
        """Volume in m^3."""
        return outline_area(self.outline) * (self.z_max - self.z_min)


def upright(block: MagnetBlock) -> Prism | None:
    """Return a block as a prism along z, or None if it is tilted.

    The frame of the block is centred in z. Its z axis points up or down; of a cuboid any axis may.
    """
    axes, half = block.axes, (block.z_max - block.z_min) / 2
    centre = block.position + (block.z_max + block.z_min) / 2 * axes[:, 2]
    # tilt up to which a block counts as upright: it moves the top of a block of 20 mm by 2 µm
    tilt_rad = 1e-4
    standing = np.abs(axes[2]) > np.cos(tilt_rad)
    if standing[2]:
        return Prism(block.outline, centre[2] - half, centre[2] + half, axes[:2, :2], centre[:2])
    corners = np.array([edge.start for edge in block.outline])
    size = np.ptp(corners, axis=0)
    box = len(corners) == 4 and not any(edge.arc for edge in block.outline) and (
        np.abs(np.abs(corners - corners.mean(axis=0)) - size / 2).max() < 1e-9)
    if not (box and standing.any()):
        return None
    centre = centre + axes[:, :2] @ corners.mean(axis=0)
    sizes = np.array([*size, 2 * half])
    vertical = int(np.argmax(standing))
    across = [axis for axis in range(3) if axis != vertical]
    return Prism(rectangle(*sizes[across].tolist()), centre[2] - sizes[vertical] / 2,
                 centre[2] + sizes[vertical] / 2, axes[:2, across], centre[:2])


def widened(outline: Outline, distance: float) -> Outline | None:
    """Return an outline whose edges are moved outwards by a distance in m.

    Corners stay sharp. It is None if an edge would vanish, so that there is no such outline.
    """
    corners = [_offset_corner(outline[number - 1], edge, distance)
               for number, edge in enumerate(outline)]
    found = tuple(Edge(start, end, edge.arc) for start, end, edge in zip(
        corners, corners[1:] + corners[:1], outline, strict=True))
    for old, new in zip(outline, found, strict=True):
        before, after = (np.subtract(edge.end, edge.start) for edge in (old, new))
        if not before @ after > 0 or (old.arc and not old.angles[1] * new.angles[1] > 0):
            return None
    return found


def _offset_corner(first: Edge, second: Edge, distance: float) -> tuple[float, float]:
    """Return the corner of two edges that are moved outwards."""
    (point, one), (other, two) = (_offset_edge(edge, at, distance) for edge, at in (
        (first, 1.0), (second, 0.0)))
    if first.arc and second.arc:
        found = point  # of arcs about the same centre, with the same radius
    elif not (first.arc or second.arc):
        # both lines: point + s one = other + t two
        matrix = np.column_stack([one, -two])
        size = np.linalg.norm(one) * np.linalg.norm(two)
        if abs(np.linalg.det(matrix)) < 1e-9 * size:
            found = point
        else:
            found = point + np.linalg.solve(matrix, other - point)[0] * one
    else:
        line, along, radius = (other, two, np.hypot(*point)) if first.arc else (
            point, one, np.hypot(*other))
        along = along / np.linalg.norm(along)
        nearest = line - (line @ along) * along  # to the centre of the arc
        half = np.sqrt(max(radius**2 - nearest @ nearest, 0.0))
        found = nearest + np.copysign(half, line @ along) * along
    return float(found[0]), float(found[1])


def _offset_edge(edge: Edge, at: float, distance: float) -> tuple[Floats, Floats]:
    """Return a point of an edge that is moved outwards, and the edge's direction there."""
    points, normals = edge.at(np.array([at]))
    normal = normals[0] / np.linalg.norm(normals[0])
    return points[0] + distance * normal, np.array([-normal[1], normal[0]])


def with_notch(
    outline: Outline, centre: Floats, direction: Floats, depth: float, half_width: float
) -> Outline:
    """Return an outline with a triangular notch where a ray from ``centre`` leaves it.

    Parameters
    ----------
    centre, direction : ndarray, shape (2,)
        Start in m and direction of the ray, in the frame of the outline.
    depth : float, in m
        Distance of the tip from the outline, along the ray; inwards if it is negative.
    half_width : float, in m
        Half the length of the outline that the notch replaces.
    """
    ray = direction / np.linalg.norm(direction)
    exits = [(number, t) for number, edge in enumerate(outline)
             for t in _crossings(edge, centre, ray)]
    if not exits:  # the centre is not inside
        return outline
    lengths = np.array([edge.length for edge in outline])
    ends = np.cumsum(lengths)

    def at(number: int, t: float) -> tuple[float, float]:
        x, y = outline[number].at(np.array([t]))[0][0].tolist()
        return x, y

    def place(s: float) -> tuple[int, float]:
        """Return the edge at an arc length, and its parameter there."""
        s = s % ends[-1]
        number = min(int(np.searchsorted(ends, s, side="right")), len(outline) - 1)
        return number, float((s - ends[number]) / lengths[number] + 1)

    farthest = max(exits, key=lambda one: float((np.array(at(*one)) - centre) @ ray))
    middle = ends[farthest[0]] - (1 - farthest[1]) * lengths[farthest[0]]
    x, y = at(*farthest) + depth * ray
    first, last = place(middle - half_width), place(middle + half_width)
    before, tip, after = at(*first), (float(x), float(y)), at(*last)
    between = [outline[(last[0] + step) % len(outline)]
               for step in range(1, (first[0] - last[0] - 1) % len(outline) + 1)]
    kept = (Edge(after, outline[last[0]].end, outline[last[0]].arc), *between,
            Edge(outline[first[0]].start, before, outline[first[0]].arc),
            Edge(before, tip), Edge(tip, after))
    shortest_m = 1e-8  # edges up to this length are rounding, and left out
    return tuple(edge for edge in kept if edge.length > shortest_m)


def _crossings(edge: Edge, centre: Floats, ray: Floats) -> list[float]:
    """Return the parameters of an edge at which a ray leaves through it."""
    t = np.linspace(0.0, 1.0, 65 if edge.arc else 2)
    seen = edge.at(t)[0] - centre
    sideways = seen @ [-ray[1], ray[0]]  # grows with the angle, in which an outline runs
    found = []
    for number in np.flatnonzero((sideways[:-1] <= 0) & (sideways[1:] > 0)).tolist():
        share = sideways[number] / (sideways[number] - sideways[number + 1])
        point = (1 - share) * seen[number] + share * seen[number + 1]
        if point @ ray > 0:
            found.append(float(t[number] + share * (t[number + 1] - t[number])))
    return found
