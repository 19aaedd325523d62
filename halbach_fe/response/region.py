"""Regions, and the points at which their field is asked for: a sphere, an ellipsoid, a cylinder.

The field of a block varies within its distance, however large the region is. Points that are to
show all of it are therefore the denser the nearer the blocks are: cells of the region are halved
until they are small beside their distance from what makes the field.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Literal

import numpy as np
from scipy.special import roots_jacobi

from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.numbers import check_number
from halbach_fe.geometry.blocks import MagnetBlock, distance_from_blocks, present_blocks, vector
from halbach_fe.geometry.coils import distance_in_magnet
from halbach_fe.geometry.magnet import Magnet, neighbour_blocks
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.types import MAX_LENGTH_M

INTEGRATION_DEGREE = 10
"""Degree of the functions of the radius, and of z in a panel, whose means are exact."""

ANGULAR_DEGREE = 32
"""Largest degree of the functions of the angles whose means are exact: squares of harmonics of half
of it. Of a magnet that was designed to be homogeneous only harmonics of high degrees are left: with
a degree of 10 the rms of one of 3 009 cubes was 15 % too small (26.8 instead of 31.4 ppm)."""

SURFACE_DEGREE = 36
"""Least degree of the functions that the points of the surface resolve; they are 10° from each
other."""

NEAR_SHARE = 0.7
"""Distance of points of a region from each other, relative to their distance from the nearest
block or iron. Of cubes of 12 mm that come within 0.5 to 4 mm of the region, the peak to peak value
was then found to 0.5 %, but with points at 1.5 to 8 times that distance it was up to half too
large."""

VOLUME_SHARE = 1.0
"""The same of cells of the volume, with 2 or 3 Gauss points along each side. Of regions within 0.7
to 5 mm of cuboids of 12 to 20 mm, mean and rms of |B| were then found to 5e-5 and 1.5e-3; with
points that do not mind the blocks the rms was up to an eighth off."""

PEAKS, CLOSER = 6, 4
"""Number of the smallest and of the largest |B| about which points are added, and how often, each
time at half the distance."""

MOST_CELLS = {"surface": 8000, "volume": 4000}
"""Number of cells from which none is halved any more, which limits the memory of a response matrix
and of the drawn fields to a gigabyte."""

SHOWN_DEGREES = 6
"""Degrees of the harmonics that are listed by default."""

SHAPES = ("sphere", "ellipsoid", "cylinder")


@dataclass(frozen=True)
class Region:
    """A sphere, an ellipsoid, or a cylinder along z.

    Attributes
    ----------
    shape : str
        ``sphere``, ``ellipsoid`` or ``cylinder``.
    half_axes_m : tuple of float
        Half axes along x, y and z in m: of a cylinder its radius twice, and half its length.
    centre_m : tuple of float

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hf.Region.sphere(0.01).half_axes_m
    (0.01, 0.01, 0.01)
    """

    shape: Literal["sphere", "ellipsoid", "cylinder"]
    half_axes_m: tuple[float, float, float]
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse what is no region; StudyError."""
        if self.shape not in SHAPES:
            raise StudyError(must_be("shape", "a region", f"one of {', '.join(SHAPES)}",
                                     f"'{self.shape}'"))
        for name, values in (("half_axes_m", self.half_axes_m), ("centre_m", self.centre_m)):
            if len(values) != 3:
                raise StudyError(must_be(name, "a region", "three numbers", str(len(values))))
            for value in values:
                check_number(name, "a region", value)
        if min(self.half_axes_m) <= 0:
            raise StudyError(must_be("half_axes_m", "a region", "above 0",
                                     f"{min(self.half_axes_m):g}"))
        if max(self.half_axes_m) >= MAX_LENGTH_M:
            raise StudyError(must_be("half_axes_m", "a region", f"below {MAX_LENGTH_M:g} m",
                                     f"{max(self.half_axes_m):g}", "Was it meant in millimetres?"))
        alike = {"sphere": 3, "cylinder": 2, "ellipsoid": 1}[self.shape]
        if len(set(self.half_axes_m[:alike])) > 1:
            raise StudyError(must_be(
                "half_axes_m", f"a region of the shape {self.shape}",
                f"equal along {'x, y and z' if alike == 3 else 'x and y'}",
                ", ".join(f"{value:g}" for value in self.half_axes_m), "Or is it an ellipsoid?"))

    @classmethod
    def sphere(
        cls, radius_m: float, centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> Region:
        """Return the sphere of a radius in m."""
        return cls("sphere", (radius_m, radius_m, radius_m), centre_m)

    @classmethod
    def of(
        cls, sphere_m: float | None, ellipsoid_m: Sequence[float] | None,
        cylinder_m: Sequence[float] | None, centre_m: Sequence[float],
    ) -> Region | None:
        """Return the region of a study or of the command line; None if no shape is given.

        A sphere is given by its radius, an ellipsoid by its half axes, a cylinder by radius and
        length, all in m.
        """
        centre = vector(np.array(centre_m, float))
        if ellipsoid_m is not None:
            return cls("ellipsoid", vector(np.array(ellipsoid_m, float)), centre)
        if cylinder_m is not None:
            radius, length = cylinder_m
            return cls("cylinder", (radius, radius, length / 2), centre)
        return None if sphere_m is None else cls.sphere(sphere_m, centre)

    @property
    def table(self) -> dict[str, float | Sequence[float]]:
        """The keys of [homogeneity] that state the region; the inverse of `of`."""
        radius, other, height = self.half_axes_m
        sizes: dict[str, dict[str, float | Sequence[float]]] = {
            "sphere": {"sphere_m": radius},
            "ellipsoid": {"ellipsoid_m": (radius, other, height)},
            "cylinder": {"cylinder_m": (radius, 2 * height)}}
        return sizes[self.shape] | {"centre_m": self.centre_m}

    @property
    def text(self) -> str:
        """The region in words, in mm."""
        x, y, z = (1e3 * value for value in self.half_axes_m)
        where = "" if not any(self.centre_m) else " about ({}) mm".format(
            ", ".join(f"{1e3 * value:g}" for value in self.centre_m))
        return {"sphere": f"a sphere of {2 * x:g} mm diameter",
                "ellipsoid": f"an ellipsoid of {2 * x:g} x {2 * y:g} x {2 * z:g} mm",
                "cylinder": f"a cylinder of {2 * x:g} mm diameter and {2 * z:g} mm length",
                }[self.shape] + where

    def contains(self, points: Floats) -> Bools:
        """Return which of the points (n, 3) in m are in the region."""
        x, y, z = ((points - self.centre_m) / self.half_axes_m).T
        if self.shape == "cylinder":
            return np.asarray((np.hypot(x, y) <= 1) & (np.abs(z) <= 1))
        return np.asarray(x**2 + y**2 + z**2 <= 1)

    def around(self, unit: Floats, widths: Floats, count: int) -> Floats:
        """Return places (count, count, count, 3) of the region about one (3,), along coordinates
        of which one is normal to the surface.

        All are relative to the half axes, and up to ``widths`` (3,) away, but within the region.
        """
        width = float(widths.min())

        def span(middle: float, width: float = width) -> Floats:
            return np.linspace(max(middle - width, -1.0), min(middle + width, 1.0), count)

        aside = np.linspace(-width, width, count)
        if self.shape == "cylinder":
            radius, angle = np.hypot(*unit[:2]), np.arctan2(unit[1], unit[0])
            aside, along = np.linspace(-widths[0], widths[0], count), span(unit[2], widths[2])
            if radius <= 0.5:
                return np.stack(np.meshgrid(unit[0] + aside, unit[1] + aside, along,
                                            indexing="ij"), axis=-1)
            r, phi, z = np.meshgrid(span(radius, widths[0]), angle + aside, along, indexing="ij")
            return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
        radius = float(np.linalg.norm(unit))
        if radius <= 0.5:
            return unit + np.stack(np.meshgrid(*3 * [aside], indexing="ij"), axis=-1)
        normal = unit / radius
        across = np.linalg.svd(normal[None])[2][1:]
        r, first, second = np.meshgrid(span(radius), aside, aside, indexing="ij")
        direction = normal + first[..., None] * across[0] + second[..., None] * across[1]
        return r[..., None] * direction / np.linalg.norm(direction, axis=-1, keepdims=True)

    def points(
        self, surface_degree: int, panel_m: float = np.inf, angular_degree: int = ANGULAR_DEGREE
    ) -> tuple[Floats, Floats]:
        """Return points (n, 3) in m, those of the surface first, and weights (n,).

        The weights, 0 on the surface, are those of means over the volume.

        Parameters
        ----------
        surface_degree : int
            Degree of the functions whose means over the unit sphere, to which an ellipsoid's
            surface is scaled, are exact.
        panel_m : float
            Length along z within which the field is a polynomial of `INTEGRATION_DEGREE`; longer
            regions are integrated in several panels.
        angular_degree : int
            Degree of the functions of the angles whose means over the outermost shells are exact.
        """
        surface = (_cylinder_surface if self.shape == "cylinder" else _sphere_surface)(
            surface_degree)
        size = INTEGRATION_DEGREE // 2 + 1
        panels = int(np.ceil(2 * self.half_axes_m[2] / panel_m))
        width = max(self.half_axes_m[:2])
        # size, relative to that on the surface, up to which harmonics are left out on shells within
        # a region: there a smaller angular degree suffices
        shell_tail = 0.02
        # ratio of length and width from which an ellipsoid is integrated in panels along z
        elongated = 1.5
        if self.shape == "cylinder" or (panels > 1 and self.half_axes_m[2] > elongated * width):
            radii, radial = _on_radius(size, 1)
            angles = 2 * np.pi * np.arange(angular_degree + 1) / (angular_degree + 1)
            heights, along = _in_panels(size, max(panels, 1))
            r, phi, z = (part.ravel() for part in np.meshgrid(radii, angles, heights,
                                                              indexing="ij"))
            wide = np.ones_like(z) if self.shape == "cylinder" else np.sqrt(1 - z**2)
            inner = np.column_stack([wide * r * np.cos(phi), wide * r * np.sin(phi), z])
            weights = wide**2 * np.einsum(
                "r,p,z->rpz", radial, np.ones(len(angles)), along).ravel()
        else:
            shells = []
            for radius, weight in zip(*_on_radius(size, 2), strict=True):
                needed = 2 * int(np.ceil(np.log(shell_tail) / np.log(radius)))
                directions, angular = sphere_points(
                    int(np.clip(needed, INTEGRATION_DEGREE, angular_degree)))
                shells.append((radius * directions, weight * angular))
            inner = np.vstack([points for points, _ in shells])
            weights = np.concatenate([own for _, own in shells])
        unit = np.vstack([surface, inner])
        return (np.array(self.centre_m) + unit * self.half_axes_m,
                np.append(np.zeros(len(surface)), weights / weights.sum()))

    def places(self, coordinates: Floats) -> Floats:
        """Return points (n, 3) in m at coordinates (n, 3): radius from 0 to 1, angle about z, and z
        from -1 to 1, relative to the radius unless the region is a cylinder.
        """
        r, phi, z = coordinates.T
        if self.shape != "cylinder":
            r, z = r * np.sqrt(1 - z**2), r * z
        unit = np.column_stack([r * np.cos(phi), r * np.sin(phi), z])
        return np.asarray(np.array(self.centre_m) + unit * self.half_axes_m)

    def nodes(self, cells: Floats, size: int) -> tuple[Floats, Floats]:
        """Return Gauss's points (n size^3, 3) in m of cells (n, 3, 2), and their weights."""
        nodes, weights = np.polynomial.legendre.leggauss(size)
        unit = np.stack(np.meshgrid(*3 * [nodes], indexing="ij"), axis=-1).reshape(-1, 3)
        half = np.ptp(cells, axis=2) / 2
        places = (cells.mean(axis=2)[:, None] + half[:, None] * unit).reshape(-1, 3)
        volume = np.outer(half.prod(axis=1), np.einsum("i,j,k->ijk", *3 * [weights])).ravel()
        return self.places(places), volume * places[:, 0]**(1 if self.shape == "cylinder" else 2)

    def cells(self, surface: bool) -> Floats:
        """Return cells (n, 3, 2) of the `places` that make up the region, or its surface."""
        turns = list(pairwise(np.linspace(0, 2 * np.pi, 17).tolist()))
        heights = list(pairwise(np.linspace(-1, 1, 5).tolist()))
        halves = [(0.0, 0.5), (0.5, 1.0)]
        kinds = [([(1.0, 1.0)] if surface else halves, turns, heights)]
        if surface and self.shape == "cylinder":
            kinds.append((halves, turns, [(-1.0, -1.0), (1.0, 1.0)]))
        return np.array([cell for kind in kinds for cell in product(*kind)], float)


def _sphere_surface(degree: int) -> Floats:
    """Return points (n, 3) of the surface of the unit sphere."""
    return sphere_points(degree)[0]


def _in_panels(size: int, panels: int) -> tuple[Floats, Floats]:
    """Return Gauss's points and weights from -1 to 1 in some panels of equal length."""
    nodes, weights = np.polynomial.legendre.leggauss(size)
    middles = (2 * np.arange(panels) + 1) / panels - 1
    return (middles[:, None] + nodes / panels).ravel(), np.tile(weights / panels, panels)


def sphere_points(degree: int) -> tuple[Floats, Floats]:
    """Return points (n, 3) of the unit sphere and weights (n,) of sum 1.

    Means of functions up to a degree are exact: Gauss's points along z, equal angles about it.
    """
    heights, along = np.polynomial.legendre.leggauss(degree // 2 + 1)
    angles = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    z, phi = (part.ravel() for part in np.meshgrid(heights, angles, indexing="ij"))
    aside = np.sqrt(1 - z**2)
    return (np.column_stack([aside * np.cos(phi), aside * np.sin(phi), z]),
            np.repeat(along, degree + 1) / (2 * (degree + 1)))


def _on_radius(size: int, power: int) -> tuple[Floats, Floats]:
    """Return points (size,) from 0 to 1 and weights of integrals with the weight r^power."""
    nodes, weights = roots_jacobi(size, 0, power)
    return np.asarray((1 + nodes) / 2), np.asarray(weights)


def _cylinder_surface(degree: int) -> Floats:
    """Return points (n, 3) of the surface of a cylinder of radius 1 from z = -1 to 1."""
    count = degree // 2 + 1
    angles = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    phi, z = (part.ravel() for part in np.meshgrid(angles, np.linspace(-1, 1, count)))
    wall = np.column_stack([np.cos(phi), np.sin(phi), z])
    r, phi = (part.ravel() for part in np.meshgrid(np.linspace(0, 1, count)[:-1], angles))
    disc = np.column_stack([r * np.cos(phi), r * np.sin(phi), np.ones_like(r)])
    return np.vstack([wall, disc, disc * [1, 1, -1]])


@dataclass(frozen=True)
class Sampling:
    """Points of a region at which its field is computed."""

    points: Floats
    """Those of the surface, of the volume, and more of the surface where blocks are near.
    Shape (n, 3), in m."""
    weights: Floats
    """Of means over the volume; 0 on the surface. Shape (n,)."""
    steps: Floats
    """Distance of each point from those next to it, relative to the half axes. Shape (n, 3)."""
    surface: int
    """Number of points on the surface, or on a sphere within it, that come first."""
    degree: int
    """Degree of the functions that these resolve, see `Region.points`."""
    unresolved_m: float | None = None
    """Distance in m at which blocks, iron, coils or dipoles are too near for the points; None if
    none are."""
    inner_radius: float = 1.0
    """Radius of the first points relative to that of the region: less than 1 if they are on a
    sphere within it, because blocks are too near for those on the surface."""
    near_shims: bool = False
    """Whether shims are so near that these points are denser about them."""

    @property
    def doubt(self) -> str:
        """Say that the extremes may lie between the points, or nothing."""
        if self.unresolved_m is None:
            return ""
        return (f"The region comes within {1e3 * self.unresolved_m:.2g} mm of blocks, iron, "
                "coils or dipoles, nearer than its points resolve: the true peak to peak may be "
                "larger than what is said.")


def region_points(
    magnet: Magnet, region: Region, degrees: int = SHOWN_DEGREES,
    shims: Sequence[MagnetBlock] = (),
) -> Sampling:
    """Return the points of a region in a magnet, perhaps with shims, which may be near.

    Raises
    ------
    StudyError
        If the study is a cross-section, or the region reaches into material.
    """
    if magnet.dimension == 2:
        raise StudyError(must_be("`dimension`", f"study {magnet.name}",
                                 "3, for the homogeneity in a volume", "2"))
    # smallest half axis of a region: in smaller ones the field differs by its rounding errors
    smallest_m = 1e-6
    if min(region.half_axes_m) < smallest_m:
        raise StudyError(must_be("the region", f"study {magnet.name}",
                                 f"of at least {smallest_m:g} m in all directions", region.text))
    magnet.refuse_without_field("the region", float(np.abs(region.centre_m).max()) + max(
        region.half_axes_m), region.text)
    middles = np.array([block.middle for block in magnet.blocks])
    if region.contains(middles).any():  # the points below may miss blocks in a large region
        raise StudyError(must_be("the region", f"study {magnet.name}", "in air",
                                 f"{region.text}, which contains blocks",
                                 _advice(magnet, region)))
    reach = max(region.half_axes_m) / magnet.bore_radius
    # size up to which harmonics of a degree that the surface does not resolve are left out,
    # relative to the field of a block at the wall of the bore: they fall as (R / r)^l from there
    # inwards
    higher_share = 1e-4
    most_degrees = 40  # largest degree that the surface resolves, which limits memory and time
    resolved = most_degrees if reach >= 1 else min(
        most_degrees, int(np.ceil(np.log(higher_share) / np.log(reach))))
    surface_degree = max(resolved + degrees, SURFACE_DEGREE)
    points, weights = region.points(
        surface_degree, magnet.bore_radius,
        int(np.clip(resolved, INTEGRATION_DEGREE, ANGULAR_DEGREE)))
    found = _resolved(magnet, region, Sampling(
        points, weights, np.full(points.shape, 2 * np.pi / (surface_degree + 1)),
        int((weights == 0).sum()), surface_degree), shims, degrees)
    points = found.points
    inside = magnet.contains(points)
    if inside.any():
        x, y, z = 1e3 * points[int(np.argmax(inside))]
        raise StudyError(must_be(
            "the region", f"study {magnet.name}", "in air",
            f"{region.text}, of which the point ({x:.4g}, {y:.4g}, {z:.4g}) mm is inside magnet or "
            "iron", _advice(magnet, region)))
    return found


def _resolved(
    magnet: Magnet, region: Region, base: Sampling, shims: Sequence[MagnetBlock], degrees: int
) -> Sampling:
    """Take denser points of a region where sources are nearer than these are to each other."""
    axes, spacing = np.array(region.half_axes_m), base.steps[0] * region.half_axes_m
    # of no cell that is halved the middle is farther from the blocks
    far = 2 * float(axes.max()) / NEAR_SHARE
    external = magnet.external
    blocks = (*present_blocks(magnet.blocks), *neighbour_blocks(
        magnet.blocks, external.neighbours), *shims)
    # distance up to which points are added, as if blocks that are nearer were so far away
    least = 1e-3 * magnet.bore_radius

    from_zero = _distance_from_zero(region, base.points, blocks)

    def clearance(points: Floats) -> Floats:
        return np.min([distance_from_blocks(blocks, points, far),
                       *(body.distance(points) for body in magnet.iron),
                       *(distance_in_magnet(coil, points) for coil in external.coils),
                       *(np.linalg.norm(points - one.position_m, axis=1)
                         for one in external.dipoles)], axis=0)

    def distance(points: Floats) -> Floats:
        near = np.maximum(clearance(points), least)
        return near if from_zero is None else np.minimum(near, from_zero(points))

    parts, resolved = [], True
    for kind, share in (("surface", NEAR_SHARE), ("volume", VOLUME_SHARE)):
        cells, sides, enough = halved(region.cells(kind == "surface"), region.places, distance,
                                      share, MOST_CELLS[kind])
        parts.append((cells, sides))
        resolved = resolved and enough
    (cells, sides), (inner, long) = parts
    fine, small = sides < spacing.max(), long < spacing.max() / 2
    if not fine.any():
        return base
    # of cells of the surface their corners, which are on its rims, too
    corners = np.vstack([cells[fine][:, np.arange(3), list(corner)]
                         for corner in product((0, 1), repeat=3)])
    length = np.tile(sides[fine], 8)
    points = region.places(corners)
    _, first = np.unique(points.round(12), axis=0, return_index=True)
    points, length = points[first], length[first]
    near_shims = len(shims) > 0 and bool((distance_from_blocks(
        shims, base.points, far) < spacing.max() / NEAR_SHARE).any())
    nodes = [region.nodes(inner[~small], 3), region.nodes(inner[small], 2)]
    more, weights = (np.concatenate(each) for each in zip(*nodes, strict=True))
    lengths = np.append(np.repeat(long[~small] / 3, 27), np.repeat(long[small] / 2, 8))
    base = replace(base, points=base.points[:base.surface])
    if region.shape == "sphere":
        base = _with_inner_sphere(region, base, degrees, float(clearance(
            np.array([region.centre_m]))[0]))
    own = np.concatenate([NEAR_SHARE * distance(base.points), lengths, length])
    nearest = float(clearance(points).min())
    found = replace(
        base, points=np.vstack([base.points, more, points]),
        weights=np.concatenate([np.zeros(len(base.points)), weights / weights.sum(),
                                np.zeros(len(points))]),
        steps=np.minimum(own[:, None] / axes, base.steps[0]), near_shims=near_shims,
        unresolved_m=None if resolved and nearest >= least else max(nearest, 0.0))
    return _about_extremes(region, found, blocks)


def _distance_from_zero(
    region: Region, points: Floats, blocks: Sequence[MagnetBlock]
) -> Distance | None:
    """Return a function that bounds the distance in m from where B is 0, as on the axis of a
    quadrupole: |B| is no smooth function there. None if the field of some blocks in vacuum is far
    from 0 at points (n, 3) of the region.
    """
    some, small = 200, 0.3  # points that are asked; |B| there, relative to the largest
    asked = points[::max(1, len(points) // some)]
    size = np.linalg.norm(field_of(blocks, asked), axis=1)
    if size.min() > small * size.max():
        return None
    # sizes of cells next to a zero: mean, rms and peak to peak of a quadrupole's |B| are then right
    # to 5e-5, 3e-4 and 1e-4, beside cells of an eighth
    least = max(min(region.half_axes_m) / 4, max(region.half_axes_m) / 12)
    scale = max(region.half_axes_m) / float(size.max())
    return lambda places: np.maximum(
        scale * np.linalg.norm(field_of(blocks, places), axis=1), least)


def _with_inner_sphere(
    region: Region, base: Sampling, degrees: int, distance: float
) -> Sampling:
    """Take points of a sphere within one for the harmonics, before those of its surface.

    The harmonics of blocks at a distance in m from the centre fall there with their degree, so that
    few are left of degrees that the points mistake for lower ones.
    """
    left = 1e-4  # of the field of a block at its distance
    radius = min(1.0, left**(1 / (base.degree - degrees)) * distance / region.half_axes_m[0])
    within = np.array(region.centre_m) + radius * (base.points - region.centre_m)
    return replace(base, points=np.vstack([within, base.points]), inner_radius=radius)


def _about_extremes(
    region: Region, sampling: Sampling, blocks: Sequence[MagnetBlock]
) -> Sampling:
    """Add points about the extremes of |B| of some blocks in vacuum, ever closer to them.

    Next to blocks B may turn round, so that |B| falls to zero at single points.
    """
    points, steps = sampling.points, sampling.steps.copy()
    unit = (points - region.centre_m) / region.half_axes_m
    size = np.linalg.norm(field_of(blocks, points), axis=1)
    for sign in (-1.0, 1.0):
        left = sign * size
        for _ in range(PEAKS):
            start = int(left.argmax())
            left[np.linalg.norm((unit - unit[start]) / steps[start], axis=1) <= 2] = -np.inf
            place, step, value = unit[start], steps[start].copy(), float(sign * size[start])
            for _ in range(CLOSER):
                around = region.around(place, step, 3).reshape(-1, 3)
                more = np.array(region.centre_m) + region.half_axes_m * around
                own = sign * np.linalg.norm(field_of(blocks, more), axis=1)
                if own.max() > value:
                    place, value = around[own.argmax()], float(own.max())
                step = step / 2
                points = np.vstack([points, more])
                steps = np.vstack([steps, np.repeat(step[None], len(more), axis=0)])
            steps[start] = step
    return replace(sampling, points=points, steps=steps, weights=np.append(
        sampling.weights, np.zeros(len(points) - len(sampling.points))))


def _advice(magnet: Magnet, region: Region) -> str:
    """Say how a region that contains material gets into air: not smaller about a block's inside."""
    if magnet.contains(np.array([region.centre_m], float)).any():
        return "Move its centre into air: --centre-m X Y Z beside --sphere-m R."
    return "Choose a smaller region, or check the study's radii."


def default_region(magnet: Magnet) -> Region:
    """Return the region of the study, or the sphere about the magnet of half the bore's radius."""
    asked = magnet.study.homogeneity
    own = None if asked is None else Region.of(
        asked.sphere_m, asked.ellipsoid_m, asked.cylinder_m, default_centre(magnet))
    inside = 0.5  # radius of the default sphere, relative to that of the bore
    return own or Region.sphere(inside * magnet.bore_radius, default_centre(magnet))


def default_centre(magnet: Magnet) -> tuple[float, float, float]:
    """Return the centre in m of the study's region, or the middle of the magnet."""
    asked = magnet.study.homogeneity
    stated = None if asked is None else asked.centre_m
    return stated or magnet.middle_m


Distance = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns their distances (n,) in m from what makes the field."""


def halved(
    cells: Floats, place: Callable[[Floats], Floats], distance: Distance, share: float, most: int
) -> tuple[Floats, Floats, bool]:
    """Halve cells along their longest side until it is short beside their distance.

    Parameters
    ----------
    cells : ndarray, shape (n, k, 2)
        Least and largest coordinates of each cell.
    place : callable
        Takes coordinates (m, k) and returns points (m, 3) in m.
    share : float
        Longest side of a cell, relative to the distance of its middle.
    most : int
        Number of cells from which none is halved any more.

    Returns
    -------
    tuple
        The cells (n, k, 2), their longest sides (n,) in m, and whether all are short enough.
    """
    done: list[Floats] = []
    lengths: list[Floats] = []
    count = 0
    while len(cells):
        middle = cells.mean(axis=2)
        sides = np.empty(middle.shape)
        for axis in range(middle.shape[1]):
            ends = np.stack([middle, middle])
            ends[:, :, axis] = cells[:, axis].T
            sides[:, axis] = np.linalg.norm(place(ends[0]) - place(ends[1]), axis=1)
        length = sides.max(axis=1)
        long = length > share * distance(place(middle))
        if count + len(cells) + long.sum() > most:
            return (np.concatenate([*done, cells]), np.concatenate([*lengths, length]),
                    not long.any())
        done.append(cells[~long])
        lengths.append(length[~long])
        count += int((~long).sum())
        rest, axis = cells[long], sides[long].argmax(axis=1)
        rows = np.arange(len(rest))
        lower, upper = rest.copy(), rest.copy()
        lower[rows, axis, 1] = upper[rows, axis, 0] = rest[rows, axis].mean(axis=1)
        cells = np.concatenate([lower, upper])
    return np.concatenate(done), np.concatenate(lengths), True
