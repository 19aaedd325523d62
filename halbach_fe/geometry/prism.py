"""Prisms along z: the blocks that stand upright, and the plates and openings that hold them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.outline import Edge, Outline, outline_area, rectangle

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
