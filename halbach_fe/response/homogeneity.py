"""Homogeneity of the field in a region, with error bars: ppm and spherical harmonics.

Deviations are those of |B| from its mean over the region's volume, relative to that mean. The rms
is over the volume; the peak-to-peak value is that of the extremes between the points too, most of
which are on the surface, where the component along the field has its extremes: see `extremes`.

In a sphere of radius R the component of B along the mean field is expanded as ``B_n = sum_lm
(r/R)^l P_lm(cos theta) (a_lm cos(m phi) + b_lm sin(m phi))`` about its centre. The polar axis is
the magnet's z axis, and P_lm are the associated Legendre functions without the phase (-1)^m of
Condon and Shortley, in the semi-normalization of A. Schmidt: the mean square over the sphere of a
term of amplitude 1 is 1/(2l + 1). Multiply by ``sqrt(2 (l - m)!/(l + m)!)`` for m > 0 to get the
functions of F. Romeo and D. I. Hoult (Magn. Reson. Med. 1 (1984) 44) that shim coils are named
after.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from math import factorial
from typing import Literal

import numpy as np
from scipy.special import lpmv, roots_jacobi

from halbach_fe.core.arrays import Bools, Floats, azimuths_of, rms
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.numbers import check_number
from halbach_fe.geometry.blocks import MagnetBlock, present_blocks, vector
from halbach_fe.geometry.cells import Distance, distance_from_blocks, halved
from halbach_fe.geometry.magnet import Magnet, neighbour_blocks
from halbach_fe.measurement.harmonic_field import solid_harmonic_fields
from halbach_fe.measurement.observation import observe
from halbach_fe.response.block_variation import neighbour_deviations
from halbach_fe.response.matrix import Response, response_matrix
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.measurement import FluxDensity, Instrument, PointPositions
from halbach_fe.study.types import COMPONENTS, MAX_LENGTH_M

PPM = 1e6

INTEGRATION_DEGREE = 10
"""Degree of the functions of the radius, and of z in a panel, whose means are exact."""

ANGULAR_DEGREE = 32
"""Largest degree of the functions of the angles whose means are exact: squares of harmonics of half
of it. Of a magnet that was designed to be homogeneous only harmonics of high degrees are left: with
a degree of 10 the rms of one of 3 009 cubes was 15 % too small (26.8 instead of 31.4 ppm)."""

SURFACE_DEGREE = 36
"""Least degree of the functions that the points of the surface resolve; they are 10° from each
other."""

STARTS = 2
"""Number of points from which each extreme is looked for, the best ones that are not near each
other: of two peaks the higher one may have the lower points."""

SLICE = 25
"""Number of points along the sides of the slices that are drawn."""

NEAR_SHARE = 0.7
"""Distance of points of a region from each other, relative to their distance from the nearest
block. Of cubes of 12 mm that come within 0.5 to 4 mm of the region, the peak to peak value was then
found to 0.5 %, but with points at 1.5 to 8 times that distance it was up to half too large."""

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

DRAWS = 400
"""Number of magnets drawn from a distribution of magnetizations."""

NAMES = {(1, 0, "a"): "Z", (1, 1, "a"): "X", (1, 1, "b"): "Y", (2, 0, "a"): "Z2",
         (2, 1, "a"): "ZX", (2, 1, "b"): "ZY", (2, 2, "a"): "X2-Y2", (2, 2, "b"): "XY",
         (3, 0, "a"): "Z3", (4, 0, "a"): "Z4"}
"""Names of shim coils for some harmonics, by degree, order, and letter."""


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
class Harmonic:
    """A spherical harmonic of the component along the mean field."""

    degree: int
    order: int
    letter: str
    """``a`` for cos(m phi), ``b`` for sin(m phi)."""
    ppm: float
    sd_ppm: float
    """Amplitude on the surface of the sphere relative to the mean field, and its standard
    deviation."""

    @property
    def name(self) -> str:
        """Name of the shim coil for it, or its degree and order."""
        return NAMES.get((self.degree, self.order, self.letter),
                         f"{self.letter}({self.degree},{self.order})")


@dataclass(frozen=True)
class Homogeneity:
    """The field in a region for one distribution of magnetizations."""

    mean_T: float
    mean_sd_T: float
    """Mean of |B| over the volume, for the mean magnetizations, and its standard deviation."""
    direction: Floats
    """Direction of the mean of B. Shape (3,)."""
    direction_sd_rad: float
    """Standard deviation of its angle, rms over the two directions across it."""
    rms_ppm: float
    peak_to_peak_ppm: float
    """Of the field of the mean magnetizations; of what was measured the medians of the ranges: the
    mean field lacks what is not known, so that it may be below all that is likely."""
    rms_range_ppm: tuple[float, float, float]
    peak_to_peak_range_ppm: tuple[float, float, float]
    """Quantiles 2.5, 50 and 97.5 % of magnets that are drawn from the distribution. They are larger
    than those of the mean field if the distribution is wide, as that of magnets whose blocks were
    not measured."""
    harmonics: tuple[Harmonic, ...]
    """Empty unless the region is a sphere."""
    components: str = ""
    """Names of the components whose size stands for |B|, if the others were not measured, or
    ``|B|`` if it was measured alone; there is no direction then."""


@dataclass(frozen=True)
class Slice:
    """|B| in a plane through the centre of a region."""

    across: str
    """The axis that is normal to the plane."""
    first_m: Floats
    second_m: Floats
    """Coordinates along the other axes, in the order of x, y and z. Shape (k,)."""
    size_T: Floats
    """|B|, with the second axis along the rows; NaN inside material. Shape (k, k)."""


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
    unresolved_m: float = 0.0
    """Distance in m at which blocks are too near for the points; 0 if none is."""
    inner_radius: float = 1.0
    """Radius of the first points relative to that of the region: less than 1 if they are on a
    sphere within it, because blocks are too near for those on the surface."""
    near_shims: bool = False
    """Whether shims are so near that these points are denser about them."""

    @property
    def doubt(self) -> str:
        """Say that the extremes may lie between the points, or nothing."""
        if not self.unresolved_m:
            return ""
        return (f"The region comes within {1e3 * self.unresolved_m:.2g} mm of blocks, nearer than "
                "its points resolve: the true peak to peak may be larger than what is said.")


@dataclass(frozen=True)
class HomogeneityModel:
    """The linear model of B at the points of a region and of three slices through it."""

    region: Region
    points: Floats
    """Those of the region, followed by those of the slices that are in air. Shape (m, 3), in m."""
    sampling: Sampling
    """Those of the region."""
    in_air: Bools
    """Which points of the slices are among those of the response, after the region's.
    Shape (3 SLICE^2,)."""
    response: Response
    """Of Bx, By and Bz at each point."""
    degrees: int
    """Largest degree of the harmonics."""
    of_neighbours: Floats
    """B of what neighbours' blocks deviate by independent modes, of one standard deviation of the
    prior each, at the region's points. Shape (n, 3, modes), in T."""

    @property
    def weights(self) -> Floats:
        """Of the region's points (n,) in means over the volume."""
        return self.sampling.weights

    @property
    def nominal_mean(self) -> Floats:
        """Mean of B (3,) in T over the region, of the nominal magnet."""
        return np.asarray(self.weights @ self.field(self.response.nominal[:, None])[..., 0])

    @property
    def solver_error_ppm(self) -> float:
        """Rms error bar of the solver for a component, relative to the nominal mean field."""
        field = self.field(self.response.nominal[:, None])[..., 0]
        mean = float(self.weights @ np.linalg.norm(field, axis=1))
        return PPM * rms(self.response.error) / mean

    def of(
        self, parameters: Gaussian, seed: int = 0, measured: bool = False, before: bool = False
    ) -> Homogeneity:
        """Return the homogeneity for a distribution of the magnetizations in A/m.

        ``seed`` is that of the magnets that are drawn; ``measured`` as in `of_fields`, ``before``
        as in `drawn`.
        """
        mean = self.field(parameters.mean[:, None])[..., 0]
        return self.of_fields(
            mean, self.drawn(parameters, DRAWS, np.random.default_rng(seed), before), measured)

    def drawn(
        self, parameters: Gaussian, count: int, generator: np.random.Generator, before: bool
    ) -> Floats:
        """Return B (n, 3, count) in T at the region's points of magnets that are drawn.

        ``before`` a map was read nobody knows what the blocks of neighbours deviate.
        """
        found = self.field(parameters.sample(count, generator).T)
        return found + self.of_neighbours @ generator.standard_normal(
            (self.of_neighbours.shape[2], count)) if before else found

    def field(self, magnetizations: Floats) -> Floats:
        """Return B (n, 3, d) in T at the region's points for magnetizations (parameters, d)."""
        rows = slice(0, 3 * len(self.weights))
        values = self.response.matrix[rows] @ magnetizations
        return np.asarray(self.response.offset[rows, None] + values).reshape(
            -1, 3, magnetizations.shape[1])

    def of_fields(
        self, field: Floats, drawn: Floats, measured: bool = False, told: Floats | None = None
    ) -> Homogeneity:
        """Return the homogeneity for a mean field (n, 3) and drawn fields (n, 3, d) in T.

        The n points are those of the region. Of a ``measured`` field the deviations are medians of
        the drawn ones. ``told`` is a projector (3, 3) to the part of B whose size stands for |B|.
        """
        size, rms, whole = self.deviations(field[..., None], told)
        sizes, every_rms, every_whole = self.deviations(drawn, told)
        if told is not None:
            field, drawn = field @ told, told @ drawn
        mean = self.weights @ field
        direction = mean / np.linalg.norm(mean)
        along = np.einsum("n,ncd->cd", self.weights, drawn)
        aside = along / np.linalg.norm(along, axis=0) - direction[:, None]
        ranges = _quantiles(every_rms), _quantiles(every_whole)
        return Homogeneity(
            float(size[0]), float(np.std(sizes)), direction,
            float(np.sqrt(np.mean(np.sum(aside**2, axis=0)) / 2)),
            *((ranges[0][1], ranges[1][1]) if measured else (float(rms[0]), float(whole[0]))),
            *ranges,
            self._harmonics(field, drawn, direction, float(size[0]), sizes))

    def slices(self, mean: Floats) -> list[Slice]:
        """Return |B| in three planes for magnetizations (parameters,) in A/m."""
        size = np.full(len(self.in_air), np.nan)
        rows = slice(3 * len(self.weights), None)
        field = self.response.offset[rows] + self.response.matrix[rows] @ mean
        size[self.in_air] = np.linalg.norm(field.reshape(-1, 3), axis=1)
        return slices_of(self.region, size)

    def deviations(
        self, fields: Floats, told: Floats | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """Return mean |B| (d,) in T, rms and peak-to-peak deviations (d,) in ppm.

        They are those of fields (n, 3, d) in T at the points of the region, or of the part of them
        that a projector (3, 3) has ``told``.
        """
        size = _size(fields, told)
        mean = self.weights @ size
        deviation = PPM * (size / mean - 1)
        low, high = extremes(self.region, self.sampling.points, self.sampling.steps, fields, told)
        return mean, np.sqrt(self.weights @ deviation**2), PPM * (high - low) / mean

    def _harmonics(
        self, field: Floats, drawn: Floats, direction: Floats, size: float, sizes: Floats
    ) -> tuple[Harmonic, ...]:
        """Return the harmonics of a field, in ppm of its mean |B| ``size``, and how much those of
        drawn fields vary, each in ppm of its own mean (d,): a strength of all blocks changes none.
        """
        if self.region.shape != "sphere":
            return ()
        first = self.sampling.surface
        terms, functions = real_harmonics(
            self.degrees, self.sampling.degree, self.sampling.inner_radius)
        mean = PPM / size * functions @ (field[:first] @ direction)
        every = PPM / sizes * (functions @ np.einsum("ncd,c->nd", drawn[:first], direction))
        return tuple(Harmonic(*term, float(value), float(sd)) for term, value, sd in zip(
            terms, mean, np.std(every, axis=1), strict=True))


def extremes(
    region: Region, points: Floats, steps: Floats, fields: Floats, told: Floats | None = None
) -> tuple[Floats, Floats]:
    """Return the least and the largest |B| (d,) in a region, of fields (n, 3, d) at its points.

    Between the points a field is a sum of solid harmonics about the best of them, of which the
    points near determine the amplitudes. Where such a fit is no better than what it adds, as in a
    field that varies from point to point, the value at the best point is returned.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    steps : ndarray, shape (n, 3)
        Distance of each point from those next to it, relative to the half axes.
    fields : ndarray, shape (n, 3, d)
    told : ndarray, shape (3, 3), optional
        Projector to the part of B whose size is meant: that part alone is no field of potentials.
    """
    size = _size(fields, told)
    unit = (points - region.centre_m) / region.half_axes_m
    found = []
    for sign in (-1.0, 1.0):
        left = sign * size
        value = left.max(axis=0)
        for _ in range(STARTS):
            best = left.argmax(axis=0)
            for start in np.unique(best):
                own = np.flatnonzero(best == start)
                value[own] = np.maximum(value[own], _climbed(
                    region, unit, int(start), steps[start], fields[..., own],
                    partial(_size, told=told, sign=sign)))
                near = np.linalg.norm((unit - unit[start]) / steps[start], axis=1) <= 2
                left[np.ix_(near, own)] = -np.inf
        found.append(sign * value)
    return found[0], found[1]


def _size(fields: Floats, told: Floats | None, sign: float = 1.0) -> Floats:
    """Return ``sign`` |B| (n, d) of fields (n, 3, d), or of the part that a projector tells."""
    return sign * np.asarray(np.linalg.norm(fields if told is None else told @ fields, axis=1))


def _climbed(
    region: Region, unit: Floats, start: int, step: Floats, fields: Floats,
    size: Callable[[Floats], Floats],
) -> Floats:
    """Return the largest ``size`` (d,) of fields (n, 3, d) near a point; see `extremes`.

    ``unit`` are the points relative to the half axes of the region, as is their ``step`` (3,).
    """
    distance = np.linalg.norm((unit - unit[start]) / step, axis=1)
    # degrees of the solid harmonics about a point that are fitted to the field at the points near
    local_degrees = 7
    unknowns = local_degrees * (local_degrees + 2)
    # how far these points are from it, and the distance at which one counts less by a factor of e,
    # in distances of points from each other
    near_distance, weighed_distance = 3.0, 1.5
    reach = max(near_distance, float(np.sort(distance)[min(unknowns, len(unit)) - 1]))
    near = distance <= reach
    away = (unit[near] - unit[start]) * region.half_axes_m
    scale = float(np.linalg.norm(away, axis=1).max())
    if reach > 2 * near_distance:  # few points are near, so that farther ones determine the fit
        weighed_distance *= reach / near_distance
    weight = np.exp(-(distance[near] / weighed_distance)**2)[:, None, None]
    design = solid_harmonic_fields(away / scale, local_degrees)
    amplitudes = np.linalg.lstsq((weight * design).reshape(-1, unknowns),
                                 (weight * fields[near]).reshape(-1, fields.shape[2]),
                                 rcond=None)[0]
    rest = np.linalg.norm(weight * (fields[near] - design @ amplitudes), axis=1).max(axis=0)
    # number of places along each coordinate about a point, up to a distance in distances of points,
    # among which the extreme is looked for. A parabola along each coordinate through the best one
    # and its neighbours gives the rest.
    tried, width = 7, 1.5
    places = region.around(unit[start], width * step, tried).reshape(-1, 3) - unit[start]
    found = size(solid_harmonic_fields(
        places * region.half_axes_m / scale, local_degrees) @ amplitudes)
    value = _vertex(found.reshape(*3 * [tried], -1))
    sampled = size(fields[start][None])[0]
    # a fit through too few points may leave no rest: it adds no more than they differ by
    spread = np.ptp(size(fields[near]), axis=0)
    return np.where((value - sampled > rest) & (value - sampled <= spread), value, sampled)


def _vertex(values: Floats) -> Floats:
    """Return the largest values (d,) of functions at the points of a cube (k, k, k, d), with what
    a parabola along each axis adds.
    """
    size, every = values.shape[0], np.arange(values.shape[3])
    best = np.array(np.unravel_index(values.reshape(-1, len(every)).argmax(axis=0), 3 * (size,)))
    middle = values[(*best, every)]
    total = middle.copy()
    for axis in range(3):
        before, after = best.copy(), best.copy()
        before[axis], after[axis] = best[axis] - 1, np.minimum(best[axis] + 1, size - 1)
        low, high = values[(*before, every)], values[(*after, every)]
        bend = 2 * middle - low - high
        inside = (best[axis] > 0) & (best[axis] < size - 1) & (bend > 0)
        total += np.where(inside, (high - low)**2 / (8 * np.where(inside, bend, 1.0)), 0.0)
    return total


def real_harmonics(
    degrees: int, surface_degree: int, radius: float = 1.0
) -> tuple[list[tuple[int, int, str]], Floats]:
    """Return degree, order and letter of the harmonics, and the matrix to their amplitudes.

    The matrix (harmonics, n) multiplies values at the `sphere_points` of ``surface_degree`` on a
    sphere of a radius, relative to that of the amplitudes.
    """
    points, weights = sphere_points(surface_degree)
    phi = azimuths_of(points)
    terms, rows = [], []
    for degree in range(1, degrees + 1):
        for order in range(degree + 1):
            scale = 1.0 if not order else np.sqrt(
                2 * factorial(degree - order) / factorial(degree + order))
            legendre = scale * (-1) ** order * lpmv(order, degree, points[:, 2])
            for letter, wave in (("a", np.cos(order * phi)), ("b", np.sin(order * phi))):
                if order or letter == "a":
                    terms.append((degree, order, letter))
                    rows.append((2 * degree + 1) / radius**degree * weights * legendre * wave)
    return terms, np.array(rows)


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
    far = magnet.field_reach
    if np.abs(region.centre_m).max() + max(region.half_axes_m) > far:
        raise StudyError(must_be("the region", f"study {magnet.name}",
                                 f"within {far:.3g} m of the middle of the magnet, where there is "
                                 "some field", region.text, "Was it meant in millimetres?"))
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
    """Take denser points of a region where blocks are nearer than these are to each other."""
    axes, spacing = np.array(region.half_axes_m), base.steps[0] * region.half_axes_m
    # of no cell that is halved the middle is farther from the blocks
    far = 2 * float(axes.max()) / NEAR_SHARE
    blocks = (*present_blocks(magnet.blocks), *neighbour_blocks(
        magnet.blocks, magnet.external.neighbours), *shims)
    # distance up to which points are added, as if blocks that are nearer were so far away
    least = 1e-3 * magnet.bore_radius

    from_zero = _distance_from_zero(region, base.points, blocks)

    def distance(points: Floats) -> Floats:
        near = np.maximum(distance_from_blocks(blocks, points, far), least)
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
        base = _with_inner_sphere(region, base, degrees, float(distance_from_blocks(
            blocks, np.array([region.centre_m]), far)[0]))
    own = np.concatenate([NEAR_SHARE * distance(base.points), lengths, length])
    nearest = float(distance_from_blocks(blocks, points, far).min())
    found = replace(
        base, points=np.vstack([base.points, more, points]),
        weights=np.concatenate([np.zeros(len(base.points)), weights / weights.sum(),
                                np.zeros(len(points))]),
        steps=np.minimum(own[:, None] / axes, base.steps[0]), near_shims=near_shims,
        unresolved_m=0.0 if resolved and nearest >= least else max(nearest, 0.0))
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


def homogeneity_model(
    magnet: Magnet, region: Region, session: Session, degrees: int = SHOWN_DEGREES,
    shims: Sequence[MagnetBlock] = (),
) -> HomogeneityModel:
    """Build the matrix from block magnetizations to the field in a region.

    The field of ``shims``, which may be near, is not part of it, but varies little from point to
    point.

    Raises
    ------
    StudyError
        If the study is a cross-section, or the region reaches into material.
    """
    sampling = region_points(magnet, region, degrees, shims)
    planes = slice_points(region)
    in_air = ~magnet.contains(planes)
    bare = magnet.with_(instrument=Instrument(), observation=FluxDensity(
        quantity="flux_density", positions=PointPositions(kind="points", points_m=(
            region.centre_m,))))
    every = np.vstack([sampling.points, planes[in_air]])
    observation = observe(bare.study, every, np.ones(every.shape, bool))
    return HomogeneityModel(region, every, sampling, in_air,
                            response_matrix(bare, observation, session), degrees, np.moveaxis(
                                neighbour_deviations(magnet, sampling.points), 0, -1))


def slice_points(region: Region) -> Floats:
    """Return the points (3 SLICE^2, 3) in m of slices across x, y and z, see `Slice`."""
    found = []
    for axis in range(3):
        unit = np.zeros((SLICE, SLICE, 3))
        first, second = (other for other in range(3) if other != axis)
        unit[..., first], unit[..., second] = np.meshgrid(*2 * [np.linspace(-1, 1, SLICE)])
        found.append(unit.reshape(-1, 3))
    return np.array(region.centre_m) + np.vstack(found) * region.half_axes_m


def slices_of(region: Region, size_T: Floats) -> list[Slice]:
    """Return the slices of |B| in T at `slice_points`, NaN inside material."""
    found = []
    for axis, values in enumerate(size_T.reshape(3, SLICE, SLICE)):
        first, second = (region.centre_m[other] + region.half_axes_m[other]
                         * np.linspace(-1, 1, SLICE) for other in range(3) if other != axis)
        found.append(Slice(COMPONENTS[axis], first, second, values))
    return found


def default_region(magnet: Magnet) -> Region:
    """Return the region of the study, or the sphere about the magnet of half the bore's radius."""
    asked = magnet.study.homogeneity
    own = None if asked is None else Region.of(
        asked.sphere_m, asked.ellipsoid_m, asked.cylinder_m, asked.centre_m)
    inside = 0.5  # radius of the default sphere, relative to that of the bore
    return own or Region.sphere(inside * magnet.bore_radius, (0.0, 0.0, magnet.middle_z_m))


def _quantiles(values: Floats) -> tuple[float, float, float]:
    low, middle, high = np.quantile(values, [0.025, 0.5, 0.975]).tolist()
    return low, middle, high
