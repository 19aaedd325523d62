"""The bodies of iron that a study describes: tubes, prisms, spheres and any other, anywhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Bools, Floats, polygon_area
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.array_layout import counter_clockwise
from halbach_fe.geometry.blocks import rotation_about_z, rotation_matrix
from halbach_fe.geometry.convex_pieces import triangles_of_polygon
from halbach_fe.geometry.outline import Outline, along_edges, closed_outline
from halbach_fe.geometry.surface import (
    Contact,
    contact_of_prism,
    contact_of_sphere,
    contact_of_triangles,
    contact_of_tube,
    distance_from_prism,
    distance_from_triangles,
    distance_from_tube,
)
from halbach_fe.study.iron_keys import (
    CHORDS,
    Iron,
    IronBody,
    IronCurve,
    IronHole,
    IronMaterial,
    IronRing,
    closed_surface,
)
from halbach_fe.study.materials import Curve
from halbach_fe.study.model import curve_from

AROUND = 96
"""Number of chords that stand for circles in the triangles of a body of revolution."""


@dataclass(frozen=True)
class IronSolid:
    """One body of iron."""

    inner_radius: float
    outer_radius: float
    """Of a tube about the z axis; the inner radius of a disc is 0. Of a prism, the radii of the
    cylinders about the z axis that it lies between. In m."""
    z_min: float
    z_max: float
    """Infinite in 2D. In m."""
    outline: Outline | None = None
    """Outline of a prism in the (x, y) plane; None for a tube or sphere."""
    law: float | Curve = field(default=1.0, compare=False)
    """Relative permeability, or magnetization curve."""
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place of the origin of the body's own axes, in which all of the above is, and the rotation
    vector that turns the magnet's axes into them."""
    sphere: bool = False
    """Whether it is a sphere of ``outer_radius``."""
    triangles: Floats | None = field(default=None, compare=False)
    """Of the surface of a body of any shape, with their normals outwards. Shape (n, 3, 3), in m."""
    holes: tuple[Floats, ...] = field(default=(), compare=False)
    """Holes along z of a prism, each the corners (n, 2) in m of a polygon, or for a round one its
    middle and radius (3,). The triangles have them too, round ones with 48 sides."""
    profile: Floats | None = field(default=None, compare=False)
    """Corners r and z of a body of revolution; the triangles are 96 around it.
    Shape (n, 2), in m."""

    @property
    def in_place(self) -> bool:
        """Whether it is a tube, prism or sphere whose own axes are those of the magnet."""
        return self.triangles is None and not self.holes and not any(
            (*self.origin_m, *self.turn_rad))

    @property
    def is_coaxial(self) -> bool:
        """Whether it is a tube or disc about the z axis of the magnet."""
        return self.outline is None and not self.sphere and self.triangles is None and not any(
            (*self.turn_rad, *self.origin_m[:2]))

    @property
    def name(self) -> str:
        """What sentences call it."""
        return "the iron"

    @property
    def surface(self) -> tuple[Floats, Floats, Floats]:
        """Coordinates x, y and z of a grid of points on its surface, each (m, n) in m.

        Those of triangles (n, 3) are their corners.
        """
        angle = np.linspace(0, 2 * np.pi, 97)
        if self.sphere:
            polar = np.linspace(0, np.pi, 25)[:, None]
            rings = self.outer_radius * np.sin(polar), self.outer_radius * np.cos(polar)
        else:
            low, high = self.z_min, self.z_max
            rings = (np.array([self.inner_radius, self.outer_radius, self.outer_radius,
                               self.inner_radius, self.inner_radius])[:, None],
                     np.array([low, low, high, high, low])[:, None])
        x, y, z = (rings[0] * np.cos(angle), rings[0] * np.sin(angle), rings[1] + 0 * angle)
        if self.triangles is not None:
            x, y, z = np.moveaxis(self.triangles, 2, 0)
        elif self.outline is not None:
            corners = np.array([edge.start for edge in (*self.outline, self.outline[0])])
            middle = corners.mean(axis=0)
            x, y = (np.array([middle[i] + 0 * corners[:, i], corners[:, i], corners[:, i],
                              middle[i] + 0 * corners[:, i]]) for i in range(2))
            z = np.array([low, low, high, high])[:, None] + 0 * corners[:, 0]
        if self.in_place:
            return x, y, z
        places = np.stack([x, y, z], axis=2) @ rotation_matrix(self.turn_rad).T + self.origin_m
        x, y, z = np.moveaxis(places, 2, 0)
        return x, y, z

    @property
    def measures(self) -> tuple[float, float, float]:
        """Volume in m^3, surface in m^2, and length of the sharp edges in m."""
        if self.sphere:
            return 4 / 3 * np.pi * self.outer_radius**3, 4 * np.pi * self.outer_radius**2, 0.0
        if self.triangles is not None:
            a, b, c = np.moveaxis(self.triangles, 1, 0)
            areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
            box = np.ptp(self.triangles.reshape(-1, 3), axis=0)  # its edges stand for all of them
            volume = float(np.einsum("ni,ni->", a, np.cross(b, c))) / 6
            return self._rounded(volume), float(areas.sum()), float(4 * box.sum())
        if self.outline is None:
            rim = 2 * np.pi * (self.inner_radius + self.outer_radius)
            area, corners = np.pi * (self.outer_radius**2 - self.inner_radius**2), 0
        else:
            area = polygon_area(np.array([edge.start for edge in self.outline]))
            rim, corners = sum(edge.length for edge in self.outline), len(self.outline)
        length = self.z_max - self.z_min
        return area * length, 2 * area + rim * length, 2 * rim + corners * length

    @property
    def thickness(self) -> float:
        """Twice the volume by the surface in m: a third of a cube's side, or that of a wall."""
        volume, surface, _ = self.measures
        return 2 * volume / surface

    def _rounded(self, volume: float) -> float:
        """Return the volume in m^3 with circles, from that with the chords of the triangles."""
        def share(chords: int) -> float:
            return float(np.sinc(2 / chords))  # of a circle's area that is within its chords

        if self.profile is not None:
            return volume / share(AROUND)
        holes = sum(np.pi * hole[2]**2 for hole in self.holes if hole.ndim == 1)
        return volume - (1 - share(CHORDS)) * float(holes) * (self.z_max - self.z_min)

    @property
    def radius(self) -> float:
        """Radius in m of the cylinder about the z axis around the body."""
        return self.outer_radius if self.in_place else float(np.hypot(*self.surface[:2]).max())

    @property
    def ends(self) -> tuple[float, float]:
        """Smallest and largest z in m of the body."""
        if self.in_place:
            return self.z_min, self.z_max
        return float(self.surface[2].min()), float(self.surface[2].max())

    @property
    def half_length(self) -> float:
        """Largest |z| in m of the body."""
        return max(map(abs, self.ends))

    def contains(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m lie inside the body, and not on its surface."""
        return self.contact(points).inside

    def contact(self, points: Floats) -> Contact:
        """Return where points (n, 3) in m lie relative to the body's surface."""
        if self.in_place:
            return self._own_contact(points)
        axes = rotation_matrix(self.turn_rad)
        found = self._own_contact((points - self.origin_m) @ axes)
        return replace(found, outward=found.outward @ axes.T)

    def _own_contact(self, points: Floats) -> Contact:
        """Return the contact of points in the body's own axes."""
        if self.sphere:
            return contact_of_sphere(self.outer_radius, points)
        if self.triangles is not None:
            return contact_of_triangles(self.triangles, points)
        if self.outline is not None:
            return contact_of_prism(self.outline, self.z_min, self.z_max, points)
        return contact_of_tube(self.inner_radius, self.outer_radius, self.z_min, self.z_max,
                               points)

    def distance(self, points: Floats) -> Floats:
        """Return the distances (n,) in m of points (n, 3) in air from the body."""
        places = points if self.in_place else (
            points - self.origin_m) @ rotation_matrix(self.turn_rad)
        if self.sphere:
            return np.asarray(np.linalg.norm(places, axis=1) - self.outer_radius)
        if self.triangles is not None:
            return distance_from_triangles(self.triangles, places)
        if self.outline is not None:
            return distance_from_prism(self.outline, self.z_min, self.z_max, places)
        return distance_from_tube(self.inner_radius, self.outer_radius, self.z_min, self.z_max,
                                  places)


def iron_solids(
    dimension: int, ring: IronRing | None, iron: Iron | None, array_half_length: float
) -> tuple[IronSolid, ...]:
    """Return the bodies of a study's iron; those without a length are as long as the array."""
    def limits(length: float | None, z: float = 0.0) -> tuple[float, float]:
        if dimension == 2:
            return -np.inf, np.inf
        half = length / 2 if length else array_half_length
        return z - half, z + half

    if ring is not None:
        return (IronSolid(ring.inner_radius_m, ring.outer_radius_m, *limits(ring.length_m),
                          law=law_of(ring)),)
    solids: list[IronSolid] = []
    for body in iron.each if iron else ():
        found: list[IronSolid] = []
        if body.kind == "tube":
            found = [IronSolid(body.inner_radius_m, body.outer_radius_m,
                               *limits(body.length_m, body.z_m))]
        elif body.kind == "sphere":
            found = [IronSolid(0.0, body.radius_m, -body.radius_m, body.radius_m, sphere=True)]
        elif body.kind == "stl":
            if body.file is not None:  # the folder that the path is relative to is not known here
                raise StudyError(must_be("`file` of a body of iron", "study", "read together with "
                                         "the study's own file", f"'{body.file}'",
                                         "Use read_study, or give triangles_m in m."))
            found = [_of_triangles(closed_surface(np.array(body.triangles_m)))]
        elif body.kind == "revolved":
            found = [_revolved(np.array(body.profile_m))]
        elif body.kind == "box":
            x, y, z = np.array(body.size_m) / 2
            found = [_prism(np.array([(-x, -y), (x, -y), (x, y), (-x, y)]), (-z, z))]
        else:
            corners = counter_clockwise(np.array(body.outline_m))
            found = [_prism(corners, limits(body.length_m, body.z_m), body.holes, turn)
                     for turn in (rotation_about_z(2 * np.pi * n / body.copies)[:2, :2]
                                  for n in range(body.copies))]
        law = law_of(body.own_material or iron)
        solids += [_placed(one, body, law) for one in found]
    return tuple(solids)


def _prism(corners: Floats, ends: tuple[float, float], holes: tuple[IronHole, ...] = (),
           turn: Floats | None = None) -> IronSolid:
    """Return a prism on a polygon (n, 2) in m with holes, which are yet to be turned (2, 2)."""
    axes = np.eye(2) if turn is None else turn
    outline = closed_outline(corners @ axes.T)
    radii = np.hypot(*along_edges(outline, 17).T)
    solid = IronSolid(float(radii.min()), float(radii.max()), *ends, outline)
    if not holes or np.isinf(ends).any():  # in 2D the study is refused
        return replace(solid, holes=tuple(hole.corners for hole in holes))
    drawn = tuple(hole.corners @ axes.T if hole.radius_m is None else np.array(
        [*(axes @ (hole.x_m, hole.y_m)), hole.radius_m]) for hole in holes)
    return replace(solid, holes=drawn, triangles=_of_prism(corners, holes, ends, axes))


def _of_prism(corners: Floats, holes: tuple[IronHole, ...], ends: tuple[float, float],
              axes: Floats) -> Floats:
    """Return the triangles (n, 3, 3) of a prism with holes, which is yet to be turned (2, 2)."""
    cap = _cap(tuple(map(tuple, corners.tolist())), holes) @ axes.T
    low, high = (np.concatenate([cap, np.full((*cap.shape[:2], 1), z)], axis=2) for z in ends)
    sides = [low[:, ::-1], high]
    for rim in (corners @ axes.T, *(hole.corners @ axes.T for hole in holes)):
        after = np.roll(rim, -1, axis=0)
        a, b, c, d = (np.column_stack([place, np.full(len(rim), z)]) for place, z in (
            (rim, ends[0]), (after, ends[0]), (after, ends[1]), (rim, ends[1])))
        sides += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return np.concatenate(sides)


@lru_cache(maxsize=64)  # copies of a pole, and its magnet when it is built again
def _cap(corners: tuple[tuple[float, float], ...], holes: tuple[IronHole, ...]) -> Floats:
    """Return the triangles (n, 3, 2) of a polygon with holes."""
    flat = _slit(np.array(corners), [hole.corners for hole in holes])
    cap = flat[np.array(triangles_of_polygon(tuple(map(tuple, flat.tolist()))))]
    cap.setflags(write=False)
    return cap


def _slit(corners: Floats, holes: list[Floats]) -> Floats:
    """Return a polygon with slits to its holes, along short ways that meet no edge."""
    rest = list(holes)
    while rest:
        edges = np.concatenate([np.stack([rim, np.roll(rim, -1, axis=0)], axis=1)
                                for rim in (corners, *rest)])
        for i, number, j in _ways(corners, rest):
            if not _meets(corners[i], rest[number][j], edges):
                hole = rest.pop(number)
                corners = np.concatenate([
                    corners[:i + 1], np.roll(hole, -j, axis=0), hole[j:j + 1], corners[i:]])
                break
        else:
            raise StudyError("The holes of a prism of iron cannot be cut out: no straight way "
                             "leads to one. Please report this with the study.")
    return corners


def _ways(corners: Floats, holes: list[Floats]) -> Iterator[tuple[int, int, int]]:
    """Yield ways to holes: the corner that each starts from, and the hole and its corner.

    The shortest to every corner of a hole come first, from the shortest on; all others follow.
    """
    # from a corner without a slit: at one with a slit it matters on which side the next begins
    _, first, times = np.unique(corners, axis=0, return_index=True, return_counts=True)
    free = first[times == 1]
    tree = KDTree(corners[free])
    ends = [(number, j) for number, hole in enumerate(holes) for j in range(len(hole))]
    places = np.concatenate(holes)
    before = 0
    while before < len(free):
        count = min(len(free), max(1, 8 * before))
        lengths, nearest = tree.query(places, np.arange(before, count) + 1)
        for one in np.argsort(lengths, axis=None, kind="stable").tolist():
            end, neighbour = divmod(one, count - before)
            yield int(free[nearest[end, neighbour]]), *ends[end]
        before = count


def _meets(start: Floats, end: Floats, edges: Floats) -> bool:
    """Tell whether a way between two corners meets any other corner or edge of edges (n, 2, 2)."""
    a, b, way = edges[:, 0] - start, edges[:, 1] - start, end - start
    small = 1e-9 * float(np.abs(edges).max()) ** 2
    own = [np.any([np.hypot(*(part - other).T) < 1e-12 for other in (np.zeros(2), way)], axis=0)
           for part in (a, b)]
    left, right = (way[0] * part[:, 1] - way[1] * part[:, 0] for part in (a, b))
    along = b - a
    near = along[:, 0] * -a[:, 1] - along[:, 1] * -a[:, 0]
    far = along[:, 0] * (way - a)[:, 1] - along[:, 1] * (way - a)[:, 0]
    crossed = (left * right < 0) & (near * far < 0) & ~own[0] & ~own[1]
    share = a @ way / (way @ way)
    touched = (np.abs(left) <= small) & (share > 0) & (share < 1) & ~own[0]
    return bool((crossed | touched).any())


def _revolved(profile: Floats) -> IronSolid:
    """Return a body of revolution with the corners r and z (n, 2) in m."""
    profile = counter_clockwise(profile)
    angle = 2 * np.pi / AROUND * np.arange(AROUND + 1)
    rims = [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(AROUND + 1, z)])
            for r, z in profile]
    found = []
    for (first, start), (last, end) in zip(
            zip(profile[:, 0], rims, strict=True),
            zip(np.roll(profile[:, 0], -1), [*rims[1:], rims[0]], strict=True), strict=True):
        if first:
            found.append(np.stack([start[:-1], start[1:], end[1:]], axis=1))
        if last:
            found.append(np.stack([start[:-1], end[1:], end[:-1]], axis=1))
    return replace(_of_triangles(np.concatenate(found)), profile=profile)


def _of_triangles(triangles: Floats) -> IronSolid:
    """Return a body with a surface of triangles (n, 3, 3) in m."""
    z = triangles[..., 2]
    return IronSolid(0.0, float(np.hypot(*triangles[..., :2].reshape(-1, 2).T).max()),
                     float(z.min()), float(z.max()), triangles=triangles)


def _placed(solid: IronSolid, body: IronBody, law: float | Curve) -> IronSolid:
    """Return a body of iron in its place; a coaxial tube is described in the magnet's own axes."""
    x, y, z = body.centre_m
    turn = tuple(np.radians(body.rotation_deg).tolist())
    if solid.sphere:
        turn = (0.0, 0.0, 0.0)
    elif solid.outline is None and solid.triangles is None and not (x or y or any(turn)):
        return replace(solid, z_min=solid.z_min + z, z_max=solid.z_max + z, law=law)
    return replace(solid, law=law, origin_m=(x, y, z), turn_rad=turn)


def law_of(material: IronMaterial | Iron | None) -> float | Curve:
    """Return the relative permeability or the magnetization curve of iron."""
    if material is None or material.curve is None:
        return (material and material.relative_permeability) or 1.0
    return _curve(material.curve)


@lru_cache(maxsize=32)
def _curve(curve: IronCurve) -> Curve:
    return curve_from(curve)


def check_iron_ring(ring: IronRing, array_outer_radius: float) -> None:
    """Refuse an iron ring that does not lie outside the blocks.

    Raises
    ------
    StudyError
    """
    if ring.inner_radius_m < array_outer_radius * (1 - 1e-9):
        raise StudyError(
            f"Input `iron_ring.inner_radius_m` of study must be at least {array_outer_radius:.6g}, "
            f"where the blocks end; instead received {ring.inner_radius_m:g}. Enlarge the ring.")
