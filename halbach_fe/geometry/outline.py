"""Outlines of blocks in the (x, y) plane: straight edges, and arcs about the z axis."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError


@dataclass(frozen=True)
class Edge:
    """A directed edge of an outline, straight or (``arc``) along a circle about the z axis."""

    start: tuple[float, float]
    end: tuple[float, float]
    arc: bool = False

    @property
    def angles(self) -> tuple[float, float]:
        """Start angle and signed sweep in rad of an arc; the sweep is the shorter way round."""
        first = np.arctan2(self.start[1], self.start[0])
        last = np.arctan2(self.end[1], self.end[0])
        sweep = (last - first + np.pi) % (2 * np.pi) - np.pi
        return float(first), float(sweep)

    @property
    def radius(self) -> float:
        """Distance of the start from the z axis in m."""
        return float(np.hypot(*self.start))

    @property
    def length(self) -> float:
        """Length in m."""
        if self.arc:
            return abs(self.angles[1]) * self.radius
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """Return points (n, 2) in m and outward normals times speed (n, 2) in m, t in [0, 1].

        Outlines run counter-clockwise, so outward is to the right of the edge.
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


def outline_contains(outline: Outline, points: Floats) -> NDArray[np.bool_]:
    """Tell which points (n, 2) lie inside an outline, by their angle of view of each edge.

    Outlines are polygons, of which some edges bulge as arcs about the origin: the polygon's
    winding number is corrected by the circular segments between chord and arc.
    """
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for edge in outline:  # even-odd rule along +x
        (x0, y0), (x1, y1) = edge.start, edge.end
        crosses = (y0 > y) != (y1 > y)
        if y1 != y0:
            inside ^= crosses & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    for edge in outline:
        if edge.arc:  # a point between chord and arc is on the other side than the chord says
            (x0, y0), (x1, y1) = edge.start, edge.end
            side = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
            beyond = side < 0 if edge.angles[1] > 0 else side > 0
            inside ^= beyond & (np.hypot(x, y) < edge.radius)
    return inside


def plane_rotation(angle: float) -> Floats:
    """Rotation by ``angle`` rad in the plane, (2, 2)."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def places_in(outline: Outline, depth: Floats, width: Floats) -> Floats:
    """Points (n, m, 2) in m at fractions (n,) of an outline's thickness, from the inner side, and
    (m,) of its width.

    The second and fourth edge, from inner to outer corners and back in all shapes, are joined by
    straight lines.
    """
    far, near = outline[1].at(width)[0], outline[3].at(1 - width)[0]
    share = depth[:, None, None]
    return np.asarray((1 - share) * near + share * far)


def outline_part(outline: Outline, inner: float, outer: float, start: float,
                 stop: float) -> Outline:
    """The part of an outline between two fractions of its thickness, from the inner side, and of
    its width.
    """
    (one, two), (four, three) = places_in(
        outline, np.array([inner, outer]), np.array([start, stop])).swapaxes(0, 1)
    return closed_outline(np.array([one, two, three, four]), tuple(
        number for number in (1, 3) if outline[number].arc))


def closed_outline(corners: Floats, arcs: tuple[int, ...] = ()) -> Outline:
    """The outline through corners (n, 2) in m, in their order; the edges numbered in ``arcs``, from
    0, are arcs about the z axis, the others are straight.
    """
    points = [(float(x), float(y)) for x, y in corners]
    return tuple(Edge(points[i], points[(i + 1) % len(points)], arc=i in arcs)
                 for i in range(len(points)))


@lru_cache(maxsize=32)  # a diagnosis asks for the same blocks hundreds of times
def check_overlaps(outlines: tuple[Outline, ...]) -> None:
    """Refuse outlines that overlap: one holds a point of another, or their edges cross.

    Shared faces are allowed; outlines are drawn in by 1e-6 so that rounding decides nothing.
    """
    t = np.linspace(0.0, 1.0, 9)
    drawn_in, centres, reaches, widths = [], [], [], []
    for outline in outlines:
        boundary = np.vstack([edge.at(t)[0][:-1] for edge in outline])
        centre = np.mean([edge.start for edge in outline], axis=0)
        drawn_in.append(centre + (1 - 1e-6) * (boundary - centre))
        centres.append(centre)
        reaches.append(1.1 * np.hypot(*(boundary - centre).T).max())  # arcs bulge between samples
        widths.append([np.abs(_angles(polygon, centre)).max()
                       for polygon in (drawn_in[-1], boundary)])
    places, sizes = np.array(centres), np.array(reaches)
    inside, whole = np.where(np.array(widths) < np.pi / 2, widths, np.pi).T  # or the axis is in it
    for i, polygon in enumerate(drawn_in):
        samples = np.vstack([polygon, polygon.mean(axis=0)])
        # those in other sectors about the axis are apart: with shared faces, by what is drawn in
        near = (np.hypot(*(places - places[i]).T) <= sizes + sizes[i]) & (
            np.abs(_angles(places, places[i])) <= inside[i] + whole)
        for j in np.flatnonzero(near).tolist():
            if i != j and (outline_contains(outlines[j], samples).any()
                           or _cross(polygon, drawn_in[j])):
                raise StudyError(
                    f"Input `array.block` of study must leave neighbours apart; instead blocks "
                    f"{i + 1} and {j + 1} of a ring overlap. Reduce the block's width, or place "
                    "the blocks on a larger radius."
                )


def _angles(points: Floats, from_: Floats) -> Floats:
    """Angles (n,) about the axis in rad of points (n, 2), from that of another one (2,)."""
    turned = np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(from_[1], from_[0])
    return np.asarray((turned + np.pi) % (2 * np.pi) - np.pi)


def _cross(one: Floats, two: Floats) -> bool:
    """Tell whether any side of one closed polygon crosses any of another."""
    a, b = one[:, None], np.roll(one, -1, axis=0)[:, None]
    c, d = two[None], np.roll(two, -1, axis=0)[None]

    def side(p: Floats, q: Floats, x: Floats) -> Floats:
        return ((q[..., 0] - p[..., 0]) * (x[..., 1] - p[..., 1])
                - (q[..., 1] - p[..., 1]) * (x[..., 0] - p[..., 0]))

    def apart(x: Floats, y: Floats) -> NDArray[np.bool_]:
        """Clearly on two sides: sides of aligned blocks are collinear but for rounding."""
        return (np.minimum(x, y) < -tiny) & (np.maximum(x, y) > tiny)

    tiny = 1e-9 * float(np.ptp(one)) ** 2
    return bool((apart(side(a, b, c), side(a, b, d)) & apart(side(c, d, a), side(c, d, b))).any())
