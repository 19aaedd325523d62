"""The shapes of true blocks: prisms along the z axis of the shape's own axes.

The origin is in the middle of the shape. Angles are in rad, lengths in m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Bools, Floats, radii_of

Fractions = tuple[float, float]
Vector = tuple[float, float, float]
Triangle = tuple[complex, complex, complex]

HALF_TURN = 0.99 * np.pi
"""Angle in rad from which the arcs of a sector are divided in three.

The middle of a block, about which it is rotated, is the mean of its corners, and the points that
divide the arcs count as corners.
"""


@dataclass(frozen=True)
class SectorBody:
    """A sector of a tube, whose axis is at x = -(inner + outer) / 2 in the shape's own axes."""

    inner: float
    outer: float
    """Radii. In m."""
    half_angle: float
    """Half of the angle that the sector spans. In rad."""
    length: float
    """Length along z; infinite in two dimensions. In m."""

    @property
    def middle(self) -> float:
        """Distance in m from the tube's axis to the shape's origin, the mean radius."""
        return (self.inner + self.outer) / 2

    @property
    def volume(self) -> float:
        """The volume in m^3."""
        return self.half_angle * (self.outer**2 - self.inner**2) * self.length

    @property
    def thickness(self) -> float:
        """Extent in m from the inner to the outer face."""
        return self.outer - self.inner

    @property
    def pivot(self) -> complex:
        """Mean of the corners, x + iy in m."""
        parts = 2 if 2 * self.half_angle < HALF_TURN else 4
        angles = np.linspace(-self.half_angle, self.half_angle, parts)
        return complex(self.middle * (np.cos(angles).mean() - 1))

    @property
    def reach(self) -> float:
        """Radius in m of a sphere about the origin that holds the shape."""
        across = max(abs(radius * np.exp(1j * self.half_angle) - self.middle)
                     for radius in (self.inner, self.outer))
        far = self.outer + self.middle if self.half_angle > np.pi / 2 else across
        return float(np.hypot(max(far, across), self.length / 2))

    @property
    def has_four_edges(self) -> bool:
        """Whether a gradient or a loss at the corners has a meaning."""
        return 2 * self.half_angle < HALF_TURN

    def share(self, u: Fractions, v: Fractions) -> float:
        """Return the fraction of the shape's volume that a part has; u and v are as in `part`."""
        radii, angles = self.part(u, v)
        return float(np.diff(angles)[0] * np.diff(radii**2)[0] / 2 / (
            self.half_angle * (self.outer**2 - self.inner**2)))

    def part(self, u: Fractions, v: Fractions) -> tuple[Floats, Floats]:
        """Return the limiting radii (2,) in m and angles (2,) in rad of a part.

        The part lies between the fractions u of the thickness, from 0 inside to 1 outside, and
        between the fractions v of the half angle, from -1 to 1.
        """
        return (self.inner + (self.outer - self.inner) * np.array(u),
                self.half_angle * np.array(v))

    def nodes(self, count: int) -> tuple[Floats, Floats]:
        """Return Gauss points (n, 3) in m and their volumes (n,) in m^3, ``count`` along a side."""
        t, weight = np.polynomial.legendre.leggauss(count)
        radius = self.middle + (self.outer - self.inner) / 2 * t
        r, a, z = np.meshgrid(radius, self.half_angle * t, self.length / 2 * t, indexing="ij")
        volume = np.einsum("i,j,k->ijk", weight * radius, weight, weight)
        points = np.stack([r * np.cos(a) - self.middle, r * np.sin(a), z], axis=-1)
        return points.reshape(-1, 3), self.volume * volume.ravel() / volume.sum()

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m, in the shape's axes, are inside or on the surface."""
        x, y, z = points.T
        x = x + self.middle
        radius = np.hypot(x, y)
        return ((radius >= self.inner) & (radius <= self.outer) & (np.abs(z) <= self.length / 2)
                & (np.abs(np.arctan2(y, x)) <= self.half_angle))


@dataclass(frozen=True)
class PrismBody:
    """A trapezoidal prism or a cuboid."""

    depth: float
    """Extent along x. In m."""
    inner_width: float
    outer_width: float
    """Extents along y at the inner and the outer face. In m."""
    length: float
    """Length along z; infinite in two dimensions. In m."""
    turn: float = 0.0
    """Angle about z by which the prism is turned relative to the shape's own axes. In rad."""

    has_four_edges = True
    pivot = 0j

    @property
    def volume(self) -> float:
        """The volume in m^3."""
        return self.depth * (self.inner_width + self.outer_width) / 2 * self.length

    @property
    def thickness(self) -> float:
        """Extent in m from the inner to the outer face."""
        return self.depth

    @property
    def reach(self) -> float:
        """Radius in m of a sphere about the origin that holds the shape."""
        return float(np.linalg.norm(
            [self.depth, max(self.inner_width, self.outer_width), self.length])) / 2

    @property
    def is_cuboid(self) -> bool:
        """Whether the section is a rectangle."""
        return self.inner_width == self.outer_width

    @property
    def corners(self) -> Floats:
        """Corners (4, 2) in m, counter-clockwise."""
        return self.part()

    def share(self, u: Fractions, v: Fractions) -> float:
        """Return the fraction of the shape's volume that a part has; u and v are as in `part`."""
        middle = self.inner_width + (self.outer_width - self.inner_width) * (u[0] + u[1]) / 2
        return middle * (v[1] - v[0]) * (u[1] - u[0]) / (self.inner_width + self.outer_width)

    def part(self, u: Fractions = (0.0, 1.0), v: Fractions = (-1.0, 1.0)) -> Floats:
        """Return the corners (4, 2) in m, counter-clockwise, of a part; by default of the whole.

        The part lies between the fractions u of the depth, from 0 inside to 1 outside, and between
        the fractions v of the half width, from -1 to 1.
        """
        def corner(a: float, b: float) -> tuple[float, float]:
            width = self.inner_width + (self.outer_width - self.inner_width) * a
            return self.depth * (a - 0.5), width / 2 * b

        local = np.array([corner(u[0], v[0]), corner(u[1], v[0]), corner(u[1], v[1]),
                          corner(u[0], v[1])])
        c, s = np.cos(self.turn), np.sin(self.turn)
        return local @ np.array([[c, s], [-s, c]])

    def nodes(self, count: int) -> tuple[Floats, Floats]:
        """Return Gauss points (n, 3) in m and their volumes (n,) in m^3, ``count`` along a side."""
        t, weight = np.polynomial.legendre.leggauss(count)
        u, v, z = np.meshgrid((t + 1) / 2, t, self.length / 2 * t, indexing="ij")
        width = self.inner_width + (self.outer_width - self.inner_width) * u
        x, y = self.depth * (u - 0.5), width / 2 * v
        c, s = np.cos(self.turn), np.sin(self.turn)
        volume = np.einsum("i,j,k->ijk", weight, weight, weight) * width
        points = np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
        return points.reshape(-1, 3), self.volume * volume.ravel() / volume.sum()

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m, in the shape's axes, are inside or on the surface."""
        corners = self.part()
        inside = np.abs(points[:, 2]) <= self.length / 2
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            (dx, dy), to = end - start, points[:, :2] - start
            inside &= dx * to[:, 1] - dy * to[:, 0] >= 0
        return inside


@dataclass(frozen=True)
class PolygonBody:
    """A prism of any polygonal section, ``outline`` in m as x + iy, counter-clockwise.

    The mean of its corners is at the origin. ``length`` in m is infinite in two dimensions. Of four
    corners, the inner face leads from the last to the first.
    """

    outline: tuple[complex, ...]
    length: float

    pivot = 0j

    @property
    def corners(self) -> Floats:
        """Corners (n, 2) in m, counter-clockwise."""
        return np.column_stack([np.real(self.outline), np.imag(self.outline)])

    @property
    def area(self) -> float:
        """Area of the section in m^2, by the shoelace formula."""
        return shoelace(np.array(self.outline))

    @property
    def volume(self) -> float:
        """The volume in m^3."""
        return self.area * self.length

    @property
    def thickness(self) -> float:
        """Side in m of a square of the section's area."""
        return float(np.sqrt(self.area))

    @property
    def reach(self) -> float:
        """Radius in m of a sphere about the origin that holds the shape."""
        return float(np.hypot(np.abs(self.outline).max(), self.length / 2))

    @property
    def has_four_edges(self) -> bool:
        """Whether a gradient or a loss at the corners has a meaning."""
        return len(self.outline) == 4

    def share(self, u: Fractions, v: Fractions) -> float:
        """Return the fraction of the shape's volume that a part has; u and v are as in `part`."""
        x, y = self.part(u, v).T
        return shoelace(x + 1j * y) / self.area

    def part(self, u: Fractions = (0.0, 1.0), v: Fractions = (-1.0, 1.0)) -> Floats:
        """Return the corners (n, 2) in m of a part, see `PrismBody.part`.

        Only the whole can be asked for unless the section has four corners.
        """
        if (u, v) == ((0.0, 1.0), (-1.0, 1.0)):
            return self.corners
        first, second, third, fourth = self.outline

        def corner(a: float, b: float) -> complex:
            near, far = ((one * (1 - b) + other * (1 + b)) / 2
                         for one, other in ((first, fourth), (second, third)))
            return near * (1 - a) + far * a

        found = np.array([corner(u[0], v[0]), corner(u[1], v[0]), corner(u[1], v[1]),
                          corner(u[0], v[1])])
        return np.column_stack([found.real, found.imag])

    def nodes(self, count: int) -> tuple[Floats, Floats]:
        """Return points (n, 3) in m and their volumes (n,) in m^3: Gauss points of triangles."""
        triangles = triangulated(self.outline)
        across = count if len(triangles) <= 4 else max(1, count // 2)
        t, weight = np.polynomial.legendre.leggauss(across)
        s, side = np.meshgrid((t + 1) / 2, (t + 1) / 2, indexing="ij")
        along, along_weight = np.polynomial.legendre.leggauss(count)
        points, volumes = [], []
        for a, b, c in triangles:
            plane = (a + s * (b - a + side * (c - b))).ravel()  # the square's edge s = 0 is a
            area = (np.outer(weight, weight) * s).ravel() * ((b - a).conjugate() * (c - a)).imag / 4
            for z, share in zip(self.length / 2 * along, along_weight / 2, strict=True):
                points.append(np.column_stack([plane.real, plane.imag, np.full(len(plane), z)]))
                volumes.append(area * share * self.length)
        return np.vstack(points), np.concatenate(volumes)

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m, in the shape's axes, are inside or on the surface.

        The sum of the angles that the edges subtend is a full turn inside (the winding number).
        """
        place = points[:, 0] + 1j * points[:, 1]
        corners = np.array(self.outline)
        to = corners[:, None] - place
        turn = np.angle(np.roll(to, -1, axis=0) * to.conj()).sum(axis=0)
        return (np.abs(turn) > np.pi / 2) & (np.abs(points[:, 2]) <= self.length / 2)


@dataclass(frozen=True)
class CylinderBody:
    """A full cylinder of a ``radius`` in m about its own z axis, with a ``length`` in m."""

    radius: float
    length: float

    has_four_edges = False
    pivot = 0j

    @property
    def volume(self) -> float:
        """The volume in m^3."""
        return np.pi * self.radius**2 * self.length

    @property
    def thickness(self) -> float:
        """Diameter in m."""
        return 2 * self.radius

    @property
    def reach(self) -> float:
        """Radius in m of a sphere about the origin that holds the shape."""
        return float(np.hypot(self.radius, self.length / 2))

    def nodes(self, count: int) -> tuple[Floats, Floats]:
        """Return points (n, 3) in m and their volumes (n,) in m^3, 2 ``count`` on every circle."""
        t, weight = np.polynomial.legendre.leggauss(count)
        angles = np.pi * (np.arange(2 * count) + 0.5) / count
        radius = self.radius * (t + 1) / 2
        r, a, z = np.meshgrid(radius, angles, self.length / 2 * t, indexing="ij")
        volume = np.einsum("i,j,k->ijk", weight * radius, np.ones(2 * count), weight)
        points = np.stack([r * np.cos(a), r * np.sin(a), z], axis=-1)
        return points.reshape(-1, 3), self.volume * volume.ravel() / volume.sum()

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m, in the shape's axes, are inside or on the surface."""
        return (radii_of(points) <= self.radius) & (
            np.abs(points[:, 2]) <= self.length / 2)


Shape = SectorBody | PrismBody | PolygonBody | CylinderBody


def shoelace(outline: NDArray[np.complex128]) -> float:
    """Return the area in m^2 of a polygon of corners x + iy; negative if it runs clockwise."""
    return float((outline.conj() * np.roll(outline, -1)).imag.sum() / 2)


@lru_cache(maxsize=1024)
def triangulated(outline: tuple[complex, ...]) -> tuple[Triangle, ...]:
    """Divide a simple polygon, counter-clockwise, into triangles, counter-clockwise too.

    A corner whose triangle with its neighbours is convex and holds no other corner is cut off, and
    again from what is left (G. H. Meisters, Amer. Math. Monthly 82 (1975) 648).
    """
    left, found = list(outline), []
    small = 1e-12 * float(np.ptp(np.real(outline)) + np.ptp(np.imag(outline)))**2
    while len(left) > 3:
        for number in range(len(left)):
            a, b, c = left[number - 1], left[number], left[(number + 1) % len(left)]
            others = [p for p in left if p not in (a, b, c)]
            if abs(_doubled(a, b, c)) <= small or (_doubled(a, b, c) > 0 and not any(
                    min(_doubled(a, b, p), _doubled(b, c, p), _doubled(c, a, p)) > -small
                    for p in others)):
                break
        if _doubled(a, b, c) > small:
            found.append((a, b, c))
        left.pop(number)
    if _doubled(*left) > small:
        found.append((left[0], left[1], left[2]))
    return tuple(found)


def _doubled(a: complex, b: complex, c: complex) -> float:
    """Return twice the signed area of a triangle."""
    return ((b - a).conjugate() * (c - a)).imag
