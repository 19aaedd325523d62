"""Points on the surface of blocks and iron: told from those inside and outside, to rounding.

The normal component of B is continuous across a face and its tangential one is not, so that a point
on a face stands for its limit from outside, where a probe can be. On edges the field of a uniformly
magnetized body is infinite. Coordinates have rounding errors, those of turned bodies above all, so
that a face is as thick as `ON_SURFACE` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Bools, Floats, Ints, azimuths_of, face_vectors
from halbach_fe.geometry.outline import Outline, outline_contains, points_on
from halbach_fe.study.iron_keys import windings
from halbach_fe.study.types import look_like_mm

ON_SURFACE = 1e-8
"""Distance from a surface, relative to the size of the body, up to which a point lies on it: 0.2 nm
for a block of 20 mm. Rounding errors are 1e-16 of a coordinate, which is less even if the body lies
a million times its size from the origin. Across this distance the field changes by about 1e-8 of
the remanence."""


def is_in_plane(points: Floats, thickness: float = 1e-3) -> bool:
    """Tell whether points (n, 3) in m lie in one plane across z, or in one that is slightly tilted.

    ``thickness`` is the largest distance from that plane, relative to the size of the points: by
    default what stages keep.
    """
    largest_tilt_rad = 0.1  # which changes distances across by 0.5 %
    away = points - points.mean(axis=0)
    size = np.ptp(points[:, :2], axis=0).max()
    slope = np.linalg.lstsq(away[:, :2], away[:, 2], rcond=None)[0]
    return bool(np.ptp(points[:, 2]) <= largest_tilt_rad * size
                and np.abs(away[:, 2] - away[:, :2] @ slope).max() <= thickness * size)


def is_cross_section(points: Floats) -> bool:
    """Tell whether points (n, 3) in m can be those of a cross-section, also by tilted mappers.

    The field of a long magnet does not depend on z.
    """
    return is_in_plane(points, 0.1)


@dataclass(frozen=True)
class Contact:
    """Where points (n,) lie relative to a body."""

    inside: Bools
    on_edge: Bools
    on_face: Bools
    """At most one is true. Shape (n,)."""
    outward: Floats
    """What takes a point on a face to its place just outside; zero for others.
    Shape (n, 3), in m."""

    @classmethod
    def nowhere(cls, count: int) -> Contact:
        """Return that of points outside."""
        return cls(np.zeros(count, bool), np.zeros(count, bool), np.zeros(count, bool),
                   np.zeros((count, 3)))


class Body(Protocol):
    """A block or a body of iron."""

    @property
    def name(self) -> str:
        """Its name in sentences."""

    def contact(self, points: Floats) -> Contact:
        """Return where points (n, 3) in m of the magnet lie relative to the body."""


@dataclass(frozen=True)
class _Section:
    """Where points (n,) lie relative to a cross-section.

    ``distance`` (n,) in m from the boundary is negative inside, ``normal`` (n, 2) is the outward
    one there, ``corner`` (n,) the distance in m from the nearest corner, and ``curved`` (n,) tells
    whether the nearest part of the boundary is an arc.
    """

    distance: Floats
    normal: Floats
    corner: Floats
    curved: Bools


def contact_of_prism(outline: Outline, z_min: float, z_max: float, points: Floats) -> Contact:
    """Return where points (n, 3) in m lie relative to a prism on an outline, in its frame.

    Infinite ``z_min`` and ``z_max`` are those of a cross-section.
    """
    low, high, size = _extent(outline)
    size = max(size, z_max - z_min) if np.isfinite(z_max) else size
    near = np.flatnonzero(_in_box(points, (*low, z_min), (*high, z_max), ON_SURFACE * size))
    if not len(near):
        return Contact.nowhere(len(points))
    return _contact(_section(outline, points[near, :2]), z_min, z_max, size, points, near)


def contact_of_tube(inner: float, outer: float, z_min: float, z_max: float,
                    points: Floats) -> Contact:
    """Return where points (n, 3) in m lie relative to a tube or, with ``inner`` 0, to a disc."""
    size = max(2 * outer, z_max - z_min) if np.isfinite(z_max) else 2 * outer
    near = np.flatnonzero(_in_box(points, (-outer, -outer, z_min), (outer, outer, z_max),
                                  ON_SURFACE * size))
    radius = np.hypot(*points[near, :2].T)
    hole = (radius < (inner + outer) / 2) & (inner > 0)
    sign = np.where(hole, -1.0, 1.0)
    normal = sign[:, None] * points[near, :2] / np.maximum(radius, 1e-300)[:, None]
    section = _Section(sign * (radius - np.where(hole, inner, outer)), normal,
                       np.full(len(near), np.inf), np.ones(len(near), bool))
    return _contact(section, z_min, z_max, size, points, near)


def contact_of_sphere(radius: float, points: Floats) -> Contact:
    """Return where points (n, 3) in m lie relative to a sphere about the origin."""
    distance = np.linalg.norm(points, axis=1)
    found = Contact.nowhere(len(points))
    found.on_face[:] = np.abs(distance - radius) <= 2 * ON_SURFACE * radius
    found.inside[:] = (distance < radius) & ~found.on_face
    beside = np.where(found.on_face, radius * (1 + ON_SURFACE) - distance, 0.0)
    found.outward[:] = (beside / np.maximum(distance, 1e-300))[:, None] * points
    return found


def contact_of_triangles(triangles: Floats, points: Floats) -> Contact:
    """Return where points (n, 3) in m lie relative to a closed surface of triangles (m, 3, 3).

    Their normals point outwards.
    """
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    size = float((high - low).max())
    found = Contact.nowhere(len(points))
    near = np.flatnonzero(_in_box(points, low, high, ON_SURFACE * size))
    at_once = 1 + 600_000 // len(triangles)  # points, for some 100 MB
    for some in np.split(near, np.arange(at_once, len(near), at_once)):
        _touch_triangles(found, triangles, points, some, ON_SURFACE * size)
    return found


def _touch_triangles(found: Contact, triangles: Floats, points: Floats, some: Ints,
                     small: float) -> None:
    """Set the contact of ``some`` of the points with triangles, ``small`` in m thick."""
    a, b, c = np.moveaxis(triangles[None] - points[some, None, None], 2, 0)
    across = face_vectors(triangles)
    normal = across / np.linalg.norm(across, axis=1)[:, None]
    height = -np.einsum("nmi,mi->nm", a, normal)
    # distances in the plane from the three sides, inwards
    depth = np.min([np.einsum("nmi,mi->nm", -start, np.cross(normal, along) / np.linalg.norm(
        along, axis=1)[:, None]) for start, along in (
            (a, triangles[:, 1] - triangles[:, 0]), (b, triangles[:, 2] - triangles[:, 1]),
            (c, triangles[:, 0] - triangles[:, 2]))], axis=0)
    on = (np.abs(height) <= small) & (depth >= -small)
    first = on.argmax(axis=1)
    face = on.any(axis=1)
    # on an edge where triangles meet that are not in one plane
    along = np.einsum("nm,mi,ni->nm", on, normal, normal[first])
    edge = face & (np.where(on, along, 1.0).min(axis=1) < 1 - 1e-9)
    found.inside[some] = (windings(triangles, points[some]) > 0.5) & ~face
    found.on_edge[some], found.on_face[some] = edge, face & ~edge
    beside = np.where(face & ~edge, small - height[np.arange(len(some)), first], 0.0)
    found.outward[some] = beside[:, None] * normal[first]


def distance_from_prism(outline: Outline, z_min: float, z_max: float, points: Floats) -> Floats:
    """Return distances (n,) in m of points (n, 3) from a prism in its frame; negative inside."""
    return _distance(_section(outline, points[:, :2]).distance, z_min, z_max, points)


def distance_from_tube(inner: float, outer: float, z_min: float, z_max: float,
                       points: Floats) -> Floats:
    """Return distances (n,) in m of points (n, 3) from a tube or, with ``inner`` 0, from a disc.

    They are negative inside.
    """
    radius = np.hypot(*points[:, :2].T)
    across = np.maximum(inner - radius, radius - outer) if inner else radius - outer
    return _distance(across, z_min, z_max, points)


def _distance(across: Floats, z_min: float, z_max: float, points: Floats) -> Floats:
    """Return distances from a body along z, from those (n,) in m of its cross-section."""
    beyond = np.maximum(points[:, 2] - z_max, z_min - points[:, 2])
    outside = np.hypot(np.maximum(across, 0.0), np.maximum(beyond, 0.0))
    return np.where(outside > 0, outside, np.maximum(across, beyond))


def distance_from_triangles(triangles: Floats, points: Floats) -> Floats:
    """Return distances (n,) in m of points (n, 3) from the nearest of triangles (m, 3, 3)."""
    found = np.asarray(KDTree(triangles.reshape(-1, 3)).query(points)[0])
    for corners in triangles:
        middle = corners.mean(axis=0)
        reach = np.linalg.norm(corners - middle, axis=1).max()
        near = np.flatnonzero(np.linalg.norm(points - middle, axis=1) - reach < found)
        along = np.roll(corners, -1, axis=0) - corners
        normal = face_vectors(corners[None])[0]
        normal = normal / np.linalg.norm(normal)
        starts = points[near, None] - corners
        parts = np.einsum("nki,ki->nk", starts, along) / (along**2).sum(axis=1)
        sides = np.linalg.norm(starts - parts.clip(0.0, 1.0)[..., None] * along, axis=2)
        over = (np.einsum("nki,ki->nk", starts, np.cross(normal, along)) >= 0).all(axis=1)
        own = np.where(over, np.abs(starts[:, 0] @ normal), sides.min(axis=1))
        found[near] = np.minimum(found[near], own)
    return found


def _in_box(points: Floats, low: Sequence[float], high: Sequence[float],
            margin: float) -> Bools:
    """Tell which points (n, 3) lie in a box that is widened by a margin in m."""
    inside = np.ones(len(points), bool)
    for values, first, last in zip(points.T, low, high, strict=True):
        inside &= (values >= first - margin) & (values <= last + margin)
    return inside


def _contact(section: _Section, z_min: float, z_max: float, size: float, points: Floats,
             near: Ints) -> Contact:
    """Return the contact of all points from the cross-section at those that are near."""
    small = ON_SURFACE * size
    z = points[near, 2]
    above, below = z - z_max, z_min - z
    beyond = np.maximum(above, below)
    side = (np.abs(section.distance) <= small) & (beyond <= small)
    end = (np.abs(beyond) <= small) & (section.distance <= small)
    edge = (side & end) | ((section.corner <= small) & (beyond <= small))
    # distance from an edge, relative to the size of the body, up to which a point on a curved face
    # counts as on the edge: nearer, `beside_curved` changes the field by more than 1e-4 of the
    # remanence
    edge_of_curved = 1e-5
    edge |= side & section.curved & (
        np.minimum(section.corner, np.abs(beyond)) <= edge_of_curved * size)
    face = (side | end) & ~edge
    # distance, relative to the size of the body, at which the limit from outside is evaluated.
    # Closed forms of flat faces tell it from the face by 1e-12; the quadrature on arcs has parts of
    # 1e-8 of the arc, see `halbach_fe.solver.field_kernels`.
    beside_flat, beside_curved = 1e-11, 1e-8
    beside = size * np.where(side & section.curved, beside_curved, beside_flat)
    distance = np.where(side, section.distance, np.where(end, beyond, 0.0))
    normal = np.zeros((len(near), 3))
    normal[side, :2] = section.normal[side]
    normal[end, 2] = np.where(above > below, 1.0, -1.0)[end]
    found = Contact.nowhere(len(points))
    found.inside[near] = (section.distance < 0) & (beyond < 0) & ~side & ~end & ~edge
    found.on_edge[near], found.on_face[near] = edge, face
    found.outward[near] = (
        np.where(face, np.maximum(beside - distance, 0.0), 0.0)[:, None] * normal)
    return found


@lru_cache(maxsize=4096)
def _extent(outline: Outline) -> tuple[Floats, Floats, float]:
    """Return the corners (2,) in m of a box about an outline, and the outline's size in m.

    Radii of arcs count for the size too: rounding errors are relative to them.
    """
    points = points_on(outline)
    bulge = max((edge.radius * (1 - np.cos(edge.angles[1] / 2)) for edge in outline if edge.arc),
                default=0.0)  # arcs may pass the points on them by less than this
    low, high = points.min(axis=0) - bulge, points.max(axis=0) + bulge
    size = max(float(np.ptp(points, axis=0).max()),
               max((edge.radius for edge in outline if edge.arc), default=0.0))
    return low, high, size


@lru_cache(maxsize=4096)
def _sharp_corners(outline: Outline) -> Floats:
    """Return the corners (m, 2) in m of an outline at which it is not smooth."""
    outline = tuple(edge for edge in outline if edge.length > 0)
    ends = np.array([edge.at(np.array([0.0, 1.0]))[1] for edge in outline])
    ends = ends / np.linalg.norm(ends, axis=2, keepdims=True)
    before, after = np.roll(ends[:, 1], 1, axis=0), ends[:, 0]
    # largest angle in rad between neighbouring parts of an outline that meet smoothly, as the arcs
    # of a cylinder do. The field's singularity is proportional to it.
    smooth = 1e-9
    sharp = np.linalg.norm(before - after, axis=1) > smooth
    return np.array([edge.start for edge in outline])[sharp]


def _section(outline: Outline, points: Floats) -> _Section:
    """Return where points (n, 2) in m lie relative to an outline."""
    nearest, signed = np.full(len(points), np.inf), np.zeros(len(points))
    normal, curved = np.zeros((len(points), 2)), np.zeros(len(points), bool)
    for edge in outline:
        if not edge.length > 0:
            continue
        if edge.arc:
            first, sweep = edge.angles
            turn = np.sign(sweep) * (azimuths_of(points) - first)
            # from the middle of the arc, so that what is beyond an end is nearest to that end
            middle = abs(sweep) / 2
            share = ((turn - middle + np.pi) % (2 * np.pi) - np.pi + middle) / abs(sweep)
        else:
            along = np.subtract(edge.end, edge.start)
            share = (points - edge.start) @ along / (along @ along)
        foot, outward = edge.at(np.clip(share, 0.0, 1.0))
        outward = outward / np.linalg.norm(outward, axis=1, keepdims=True)
        apart = points - foot
        distance = np.hypot(*apart.T)
        closer = distance < nearest
        nearest[closer], curved[closer] = distance[closer], edge.arc
        normal[closer] = outward[closer]
        signed[closer] = np.einsum("ij,ij->i", apart, outward)[closer]
    # beside a corner the sign is that of the outline; on a face that of the normal
    away = np.abs(np.abs(signed) - nearest) > 1e-3 * nearest
    away |= nearest > 1e-3 * _extent(outline)[2]
    signed[away] = (np.where(outline_contains(outline, points), -1.0, 1.0) * nearest)[away]
    corners = _sharp_corners(outline)
    apart = points[:, None] - corners
    corner = np.hypot(apart[..., 0], apart[..., 1]).min(axis=1, initial=np.inf)
    return _Section(signed, normal, corner, curved)


@dataclass(frozen=True)
class Surroundings:
    """Where points (n,) lie in a magnet."""

    points: Floats
    """Points at which the field is to be evaluated: those on a face are just outside.
    Shape (n, 3), in m."""
    inside: Bools
    on_edge: Bools
    """Inside a body, and on an edge of one. Shape (n,)."""
    faces: Ints
    """Number of bodies on whose faces a point lies; 2 between bodies that touch. Shape (n,)."""
    names: dict[int, list[str]]
    """Names of the bodies whose faces or edges the point with this number touches."""
    reach: float = np.inf
    """Distance in m from the origin to which the magnet reaches."""

    @property
    def no_air(self) -> Bools:
        """Which points have no field that a probe could measure."""
        return np.asarray(self.inside | self.on_edge | (self.faces > 1))

    def refusal(self) -> tuple[int, int, str, str] | None:
        """Return why points are refused: number of the first, how many, what they are, what to do.

        It is None if no point is.
        """
        touching = (self.faces > 1) & ~self.inside & ~self.on_edge
        edges = self.on_edge & ~self.inside
        for chosen, what, hint in (
                (self.inside, "inside magnet or iron", ""),
                (edges, "on an edge of {}, where the field is infinite",
                 "Move them off the edge, by 0.1 mm say."),
                (touching, "between {}, which touch there, so that it is not in air",
                 "Move them out of the blocks.")):
            if chosen.any():
                first = int(np.argmax(chosen))
                names = self.names.get(first, [])[:2]
                if chosen is edges and len(names) > 1:
                    what += ", unless they are magnetized alike and flush"
                    hint = ("Move them off the edge, by 0.1 mm say; or state blocks that are alike "
                            "and flush as one block, which has a face there.")
                return first, int(chosen.sum()), what.format(" and ".join(names)), hint
        return None

    def far_away(self) -> str | None:
        """Return the sentence about points so far away that they may be in mm, None without any."""
        far = look_like_mm(self.points, self.reach)
        if not far.any():
            return None
        distance = np.linalg.norm(self.points, axis=1).max()
        return (f"{far.sum()} of {len(far)} points lie up to {distance:.3g} m from the origin, "
                f"from which the magnet reaches to {self.reach:.3g} m: hardly any of its field is "
                f"left there. Are they in mm? Then write {distance / 1000:.3g} for {distance:.3g}.")

    def on_faces(self) -> str | None:
        """Return the sentence about points on faces, None if there are none."""
        chosen = self.faces > 0
        if not chosen.any():
            return None
        first = int(np.argmax(chosen))
        return (f"{chosen.sum()} of {len(chosen)} points lie on a face of magnet or iron, the "
                f"first on {self.names[first][0]}: their field is that just outside, where a probe "
                "can be; just inside, its part along the face differs.")


def surroundings(bodies: Sequence[Body], points: Floats) -> Surroundings:
    """Return where points (n, 3) in m lie relative to all bodies of a magnet."""
    inside, edge = np.zeros(len(points), bool), np.zeros(len(points), bool)
    faces, moved = np.zeros(len(points), int), np.array(points, float)
    names: dict[int, list[str]] = {}
    for body in bodies:
        found = body.contact(points)
        inside |= found.inside
        touched = np.flatnonzero(found.on_edge | found.on_face)
        if not len(touched):
            continue
        edge |= found.on_edge
        faces += found.on_face
        moved += found.outward
        for number in touched.tolist():
            names.setdefault(number, []).append(body.name)
    return Surroundings(moved, inside, edge, faces, names)
