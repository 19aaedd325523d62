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
from dataclasses import dataclass
from functools import partial
from math import factorial

import numpy as np
from scipy.special import lpmv

from halbach_fe.core.arrays import Bools, Floats, azimuths_of, rms
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.measurement.source_free_field import solid_harmonic_fields
from halbach_fe.response.region import SHOWN_DEGREES, Region, Sampling, region_points, sphere_points
from halbach_fe.response.response_matrix import Response, response_matrix
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.measurement_keys import FluxDensity, Instrument, PointPositions
from halbach_fe.study.types import COMPONENTS

PPM = 1e6

STARTS = 2
"""Number of points from which each extreme is looked for, the best ones that are not near each
other: of two peaks the higher one may have the lower points."""

SLICE = 25
"""Number of points along the sides of the slices that are drawn."""

DRAWS = 400
"""Number of magnets drawn from a distribution of magnetizations."""

NAMES = {(1, 0, "a"): "Z", (1, 1, "a"): "X", (1, 1, "b"): "Y", (2, 0, "a"): "Z2",
         (2, 1, "a"): "ZX", (2, 1, "b"): "ZY", (2, 2, "a"): "X2-Y2", (2, 2, "b"): "XY",
         (3, 0, "a"): "Z3", (4, 0, "a"): "Z4"}
"""Names of shim coils for some harmonics, by degree, order, and letter."""


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
    """Mean of |B| over the volume, for the mean magnetizations, and its standard deviation, which
    like all others includes the solver's error."""
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
        self, parameters: Gaussian, seed: int = 0, measured: bool = False
    ) -> Homogeneity:
        """Return the homogeneity for a distribution of the magnetizations in A/m.

        ``seed`` is that of the magnets that are drawn; ``measured`` as in `of_fields`. The drawn
        fields differ by the solver's error too.
        """
        generator = np.random.default_rng(seed)
        mean = self.field(parameters.stacked.mean[:, None])[..., 0]
        drawn = self.drawn(parameters, DRAWS, generator)
        if len(errors := self.response.shared_error[:, :mean.size]):
            drawn = drawn + (errors.T @ generator.standard_normal((len(errors), DRAWS))).reshape(
                drawn.shape)
        return self.of_fields(mean, drawn, measured)

    def drawn(
        self, parameters: Gaussian, count: int, generator: np.random.Generator
    ) -> Floats:
        """Return B (n, 3, count) in T at the region's points of magnets that are drawn."""
        return self.field(parameters.stacked.sample(count, generator).T)

    def field(self, magnetizations: Floats) -> Floats:
        """Return B (n, 3, d) in T at the region's points for magnetizations (parameters, d).

        Those of neighbours' blocks may follow.
        """
        return self._field(magnetizations, slice(0, 3 * len(self.weights)))

    def _field(self, magnetizations: Floats, rows: slice) -> Floats:
        """Return `field` at the points of some rows of the response."""
        own, others = np.split(magnetizations, [len(self.response.nominal)])
        values = self.response.matrix[rows] @ own
        if len(others):
            values = values + self.response.of_neighbours[rows] @ others
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

    def slices(self, parameters: Gaussian) -> list[Slice]:
        """Return |B| in three planes for the mean of a distribution of the magnetizations."""
        size = np.full(len(self.in_air), np.nan)
        field = self._field(parameters.stacked.mean[:, None], slice(3 * len(self.weights), None))
        size[self.in_air] = np.linalg.norm(field[..., 0], axis=1)
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
                            response_matrix(bare, observation, session), degrees)


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


def _quantiles(values: Floats) -> tuple[float, float, float]:
    low, middle, high = np.quantile(values, [0.025, 0.5, 0.975]).tolist()
    return low, middle, high
