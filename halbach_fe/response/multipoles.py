"""Multipoles of a magnet as linear functions of its block magnetizations.

``B_y + i B_x = sum_n C_n ((x + i y) / R)^(n - 1)`` at the reference radius R, n = 1 the dipole,
with ``C_n = B_n + i A_n``: normal and skew (the European convention; S. Russenschuck, Field
Computation for Accelerator Magnets, 2010, ch. 6). On the circle that is ``B_r = sum A_n cos(n phi)
+ B_n sin(n phi)``, the Fourier coefficients that a study observes. Unwanted multipoles are in units
of 1e-4 of the main one, ``c_n = 1e4 C_n / |C_N|``, along axes turned about z such that the nominal
magnet's main multipole is normal: ``C_n exp(-i n arg(C_N) / N)``.

In 2D the multipoles are those of a single circle. In 3D they are those of the field integrated
along all of z, because this integral solves the two-dimensional Laplace equation again.
Alternatively, they are the coefficients of B_r on the circle at a given z.

The integral of a block's field is that of a plane magnet, its projection along z with the thickness
as weight: of a volume dV at ``Z = x + i y`` with the polarization J it is ``B_y + i B_x = i (J_x +
i J_y) dV / (2 pi (z - Z)^2)``, and J_z has none. What permeability and iron add is summed from one
end to the other, and continued beyond as it falls there. That of a uniform field is infinite.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import pairwise

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.integrate import quad_vec

from halbach_fe.core.arrays import Floats, azimuths_of, radii_of, rms, unit_circle
from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError, must_be
from halbach_fe.core.numbers import HIGHEST_ORDER, check_number, decimals
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.coils import crosses_disc, distance_from_axis, distance_in_magnet
from halbach_fe.geometry.magnet import Magnet, neighbour_blocks
from halbach_fe.geometry.outline import at_heights
from halbach_fe.measurement.campaign_maps import SAME_PLACE_M
from halbach_fe.measurement.observation_operator import (
    Observation,
    concatenate,
    fourier_analysis,
    observe,
)
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.block_variation import (
    Deviations,
    changes_by_amplitudes,
    neighbour_columns,
    neighbour_remanences,
)
from halbach_fe.response.response_matrix import Response, StoredMatrix, response_matrix
from halbach_fe.solver.exact_block_field import external_field, unit_fields
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian, correlated_values
from halbach_fe.study.external_keys import External
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement_keys import CirclePositions, FourierCoefficients, Instrument
from halbach_fe.study.types import COMPONENTS

Complexes = NDArray[np.complex128]

UNITS = 1e4
"""Units per main multipole: unwanted multipoles are given in units of 1e-4 of the main one."""

DEFAULT_ORDERS = tuple(range(1, 11))
"""Default orders of multipoles."""

NOTHING_THERE = 1e-6
"""Tolerance below which the main multipole counts as zero, relative to the largest multipole that
the blocks could produce together."""


@dataclass(frozen=True)
class MultipoleReference:
    """The reference radius, orders and z of multipoles.

    Attributes
    ----------
    radius_m : float or None
        Reference radius R in m. None stands for the radius of the study's circles if they have a
        single radius, and else for two thirds of the inner radius of the blocks, or
        of poles of iron that are nearer to the axis.
    orders : tuple of int
        Orders of the unwanted multipoles, 1 for the dipole. The magnet's main order is ignored.
    z_m : float or None
        Only in 3D: position in m of the circle on which the multipoles are taken. None stands for
        the field integrated along z.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> reference = hf.MultipoleReference(radius_m=0.02, orders=(2, 3))
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> model, _ = hf.multipoles(magnet, hf.Session.open("results"), reference).tables[0]
    >>> model.radius, model.orders
    (0.02, (2, 3))
    """

    radius_m: float | None = None
    orders: tuple[int, ...] = DEFAULT_ORDERS
    z_m: float | None = None

    def __post_init__(self) -> None:
        """Refuse numbers that are none, and orders that no multipole has; StudyError."""
        for name, value in (("radius_m", self.radius_m), ("z_m", self.z_m)):
            if value is not None:
                check_number(name, "MultipoleReference", value)
        if isinstance(self.orders, str) or not isinstance(self.orders, Collection):
            raise StudyError(must_be("orders", "MultipoleReference", "a tuple of whole numbers",
                                     f"a {type(self.orders).__name__}"))
        for order in self.orders:
            check_number("orders", "MultipoleReference", order, 1, HIGHEST_ORDER, whole=True)


@dataclass(frozen=True)
class Multipoles:
    """The multipoles of a magnet, with their uncertainty."""

    orders: tuple[int, ...]
    """Orders of the unwanted multipoles. Length k."""
    main: float
    main_sd: float
    """Mean of |C_N| in T, or in T m if integrated along z, and its standard deviation, including
    the solver's error."""
    roll: float
    roll_sd: float
    """The same of the angle in rad by which the main multipole is turned about z from that of the
    nominal magnet."""
    mean: Floats
    """Means of b_n of all orders, followed by those of a_n, in units of 1e-4 of the main one.
    Shape (2 k,)."""
    root: Floats
    """Root of the covariance of these, in the same units. Shape (2 k, q)."""
    error: Floats
    """Error of the solver for the nominal magnet in the same units, which ``root`` does not
    include. Shape (2 k,)."""
    root_T: Floats
    """Root of the covariance of B_n and A_n themselves, which are known where the main one, to
    which ``root`` refers, is not. Shape (2 k, q), in T (integrated: T m)."""

    @property
    def absolute(self) -> Multipoles:
        """These multipoles in mT, or mT m if integrated, instead of units of the main one."""
        each = 1e3 * self.main / UNITS
        return replace(self, mean=each * self.mean, root=1e3 * self.root_T,
                       error=each * self.error)

    @property
    def covariance(self) -> Floats:
        """Covariance (2 k, 2 k) of b_n and a_n in units^2, without the solver's error."""
        return self.root @ self.root.T

    @property
    def sd(self) -> Floats:
        """Standard deviations (2 k,) of b_n and a_n in units, including the solver's error."""
        return np.sqrt(np.einsum("ij,ij->i", self.root, self.root) + self.error**2)

    @property
    def sizes(self) -> Floats:
        """Magnitudes |c_n| (k,) of the mean, in units."""
        return np.hypot(*self.mean.reshape(2, -1))

    @property
    def expected_square(self) -> float:
        """Expectation of the sum of all |c_n|^2 in units^2, without the solver's error."""
        return float(self.mean @ self.mean + np.sum(self.root**2))

    @property
    def rms(self) -> float:
        """Root of `expected_square` per order, in units."""
        return float(np.sqrt(self.expected_square / len(self.orders)))

    @property
    def rms_of_mean(self) -> float:
        """Rms of `sizes`, in units."""
        return rms(self.sizes)

    def share_within(self, limit: float, normals: Floats) -> float:
        """Return the probability that all |c_n| are within a limit, from normals (count, 2 k)."""
        return met(self.sizes_of(normals), limit)

    def sizes_of(self, normals: Floats) -> Floats:
        """Return |c_n| (count, k) of samples made from standard normal numbers (count, 2 k)."""
        covariance = self.covariance + np.diag(self.error**2)
        drawn = correlated_values(self.mean, covariance, normals)
        return np.hypot(*drawn.reshape(len(drawn), 2, -1).swapaxes(0, 1))

    def table(self) -> list[dict[str, float]]:
        """Return a row per order, as plain numbers for JSON."""
        size = len(self.orders)
        return [{"n": order, "b": float(self.mean[i]), "b_sd": float(self.sd[i]),
                 "a": float(self.mean[size + i]), "a_sd": float(self.sd[size + i]),
                 "size": float(self.sizes[i])} for i, order in enumerate(self.orders)]


@dataclass(frozen=True)
class MultipoleModel:
    """The linear model ``C = offset + matrix p`` of the multipoles, with the main one first.

    C is in T, or in T m if integrated along z, and p are the magnetizations in A/m.
    """

    orders: tuple[int, ...]
    """Orders of the unwanted multipoles. Length k."""
    main: int
    """The magnet's main order N."""
    radius: float
    """Reference radius in m."""
    z: float | None
    """Position in m of the circle, in 3D; None in 2D and for the integral along z."""
    integrated: bool
    """Whether the field is integrated along z."""
    matrix: Complexes
    """Rows for the main multipole and for ``orders``, along axes in which the nominal main
    multipole is normal. Shape (1 + k, parameters), in T m/A (integrated: T m^2/A)."""
    offset: Complexes
    """Multipoles of external fields. Shape (1 + k,), in T (integrated: T m)."""
    error: Floats
    """Error bar of the solver for the moduli |C|. Shape (1 + k,), in T (integrated: T m)."""
    nominal: Floats
    """Nominal magnetization. Shape (parameters,), in A/m."""
    turn: float
    """Angle in rad of the axes about z."""
    left_out_T: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Uniform field that the integral along z, which would be infinite, is without."""
    of_neighbours: Complexes | None = None
    """Rows for what the magnetizations of neighbours' blocks deviate, which a distribution knows
    beside its parameters. Shape (1 + k, neighbours' parameters), in T m/A (integrated: T m^2/A)."""

    @property
    def unit(self) -> str:
        """Unit of the main multipole."""
        return "T m" if self.integrated else "T"

    @cached_property
    def nominal_main(self) -> float:
        """|C_N| of the nominal magnet, in `unit`."""
        return float(abs((self.offset + self.matrix @ self.nominal)[0]))

    def scaled(self, main: float) -> Floats:
        """Return the matrix (2 k, parameters) from magnetizations to b_n, a_n for a given |C_N|."""
        return UNITS / main * np.vstack([self.matrix[1:].real, self.matrix[1:].imag])

    def of(self, parameters: Gaussian) -> Multipoles:
        """Return the multipoles of normally distributed magnetizations in A/m."""
        mean, root = parameters.products(self.matrix, self.of_neighbours)
        return self.known(self.offset + mean, root)

    def known(self, mean: Complexes, root: Complexes) -> Multipoles:
        """Return the multipoles for a mean (1 + k,) of C and a root (1 + k, q) of its covariance.

        The ratios of C to |C_N| are linearized about the mean.
        """
        strength = float(abs(mean[0]))
        along = (np.conj(mean[0]) * root[0]).real / strength  # of |C_N|
        across = (np.conj(mean[0]) * root[0]).imag / strength**2
        relative = mean[1:] / strength
        own = (root[1:] - np.outer(relative, along)) / strength
        error = float(self.error[0])
        return Multipoles(
            self.orders, strength, float(np.hypot(np.linalg.norm(along), error)),
            # in axes turned by theta, C_N becomes C_N exp(i N theta)
            float(-np.angle(mean[0])) / self.main,
            float(np.hypot(np.linalg.norm(across), error / strength)) / self.main,
            UNITS * np.concatenate([relative.real, relative.imag]),
            UNITS * np.vstack([own.real, own.imag]),
            UNITS * np.tile(self.error[1:] / strength, 2),
            np.vstack([root[1:].real, root[1:].imag]))

    def units(self, coefficients: Complexes) -> Floats:
        """Return b_n, a_n (..., 2 k) of coefficients C (..., 1 + k), without linearization."""
        relative = UNITS * coefficients[..., 1:] / np.abs(coefficients[..., :1])
        return np.concatenate([relative.real, relative.imag], axis=-1)


def multipole_model(magnet: Magnet, reference: MultipoleReference,
                    session: Session) -> MultipoleModel:
    """Build the matrix from block magnetizations to multipoles, as `response_matrix` does for
    readings.

    Raises
    ------
    StudyError
        If the reference does not fit the study, or the nominal magnet has no main multipole.
    """
    return multipole_models(magnet, (reference,), session)[0][0]


def multipole_models(
    magnet: Magnet, references: Sequence[MultipoleReference], session: Session
) -> tuple[list[MultipoleModel], tuple[str, ...]]:
    """Return the `multipole_model` of several references, which share the solves.

    Those at which the main multipole of the nominal magnet vanishes, or that have sources within
    the circle, are left out, unless all are; the sentences that say so come second.

    Warns
    -----
    HalbachWarning
        If one is left out.
    """
    main = magnet.array.multipole_order
    wanted, observations = [], []
    for reference in references:
        orders, radius = unwanted_orders(magnet, reference)
        wanted.append((orders, radius, reference.z_m))
        observations.append(_observation(magnet, radius, max(*orders, main), reference.z_m))
        _check_air(magnet, radius, observations[-1].points)
    bare = magnet.with_(instrument=Instrument())
    model = response_matrix(bare, reduce(concatenate, observations), session)
    models: list[MultipoleModel] = []
    left_out: list[str] = []
    first = 0
    for (orders, radius, z), observation in zip(wanted, observations, strict=True):
        part = slice(first, first + len(observation))
        first = part.stop
        integrated = magnet.dimension == 3 and z is None
        matrix, offset, others = (_complexes(each[part]) for each in (
            model.matrix, model.offset, model.of_neighbours))
        error = model.error[part]
        index = np.array([main, *orders]) - 1
        place = ("The field integrated along z" if integrated
                 else f"The circle at z = {decimals(1e3 * (z or 0.0), 4)} mm")
        why = "a coil or dipole within the circle, and no multipoles there: its table"
        try:
            if integrated:
                matrix, offset, error = _along_all_z(magnet, observation, model, part)
                others = _neighbours_along_all_z(magnet, observation, model.of_neighbours[part])
            else:
                _check_no_source(magnet, radius, z or 0.0)
            why = (f"no multipole of order {main}, which cancels there: its table, in units of "
                   "1e-4 of that,")
            turn = _turn(magnet, matrix[main - 1], model, offset[main - 1])
        except StudyError:
            if len(left_out) == len(references) - 1:
                raise
            left_out.append(f"{place} has {why} is left out.")
            continue
        phases = np.exp(-1j * turn * (index + 1))
        models.append(MultipoleModel(
            orders, main, radius, z, integrated, phases[:, None] * matrix[index],
            phases * offset[index], error[index], model.nominal, -turn,
            magnet.external.background_T if integrated else (0.0, 0.0, 0.0),
            phases[:, None] * others[index]))
    for each in left_out:
        warnings.warn(each, HalbachWarning, stacklevel=2)
    return models, tuple(left_out)


def _neighbours_along_all_z(
    magnet: Magnet, observation: Observation, readings: Floats
) -> Complexes:
    """Return C_n (K, parameters) of the `neighbour_prior`, integrated along all of z, in T m^2/A.

    ``readings`` are the sums of `_along_all_z`, which are kept for what iron adds.
    """
    added = readings - _neighbours_in_vacuum(magnet, observation)
    near, far = np.split(added, 2)
    radius, highest = float(np.hypot(*observation.points[0, :2])), len(near) // 2
    return _complexes(near + far) + np.hstack([np.zeros((highest, 0)), *(
        np.einsum("bk,bm->kbm", _integrals_of_shapes(blocks, radius, highest)[0],
                  matrices[:, 0] + 1j * matrices[:, 1]).reshape(highest, -1)
        for blocks, matrices in neighbour_remanences(magnet))])


def _neighbours_in_vacuum(magnet: Magnet, observation: Observation) -> Floats:
    """Return readings (n, parameters) in T per A/m of the `neighbour_prior` without iron."""
    return observation.apply(np.moveaxis(neighbour_columns(magnet, observation.points), -1, 0)).T


def _check_air(magnet: Magnet, radius: float, points: Floats) -> None:
    """Refuse a reference circle of which points (n, 3) in m are not in air."""
    if magnet.contains(points).any():
        bore = "" if magnet.has_bore else ", which has no bore there"
        raise StudyError(must_be(
            "the reference circle of multipoles", f"study {magnet.name}", "in air",
            f"one of {1e3 * radius:.4g} mm about the z axis, inside magnet or iron{bore}",
            "Only a field about a free axis has multipoles; halbach-fe solve computes this one at "
            "any points."))


def _check_no_source(magnet: Magnet, radius: float, z: float) -> None:
    """Refuse a reference circle within which a coil or a dipole is: B_r has no multipoles there."""
    if source := _source_within(magnet, radius, z):
        raise StudyError(must_be(
            "the reference circle of multipoles", f"study {magnet.name}",
            "free of coils and dipoles within it", f"one of {1e3 * radius:.4g} mm at z = "
            f"{1e3 * z:.4g} mm, within which `external.{source}` is",
            "Take a smaller radius or another z where there is none; halbach-fe solve computes "
            "this field at any points."))


def _source_within(magnet: Magnet, radius: float, z: float) -> str:
    """Return the first coil or dipole in the flat disc within a circle; empty if there is none."""
    external = magnet.external
    return next((f"coils[{number}]" for number, coil in enumerate(external.coils, start=1)
                 if crosses_disc(coil, radius, z)), "") or next(
        (f"dipoles[{number}]" for number, one in enumerate(external.dipoles, start=1)
         if np.hypot(*one.position_m[:2]) <= radius
         and abs(one.position_m[2] - z) < radius / 200), "")


def unwanted_orders(
    magnet: Magnet, reference: MultipoleReference
) -> tuple[tuple[int, ...], float]:
    """Return the orders of the unwanted multipoles, and the reference radius in m.

    Raises
    ------
    StudyError
        If the reference does not fit the study.
    """
    orders = tuple(sorted(set(reference.orders) - {magnet.array.multipole_order}))
    if not orders:
        raise StudyError(must_be("--orders", f"study {magnet.name}",
                                 "those of unwanted multipoles", "only the main order"))
    if magnet.dimension == 2 and reference.z_m is not None:
        raise StudyError(must_be("--at-z-m", f"study {magnet.name}", "left out, since it is 2D",
                                 f"{reference.z_m:g}"))
    if reference.z_m is not None:
        magnet.refuse_without_field("--at-z-m", abs(reference.z_m), f"{reference.z_m:g}")
    return orders, _radius(magnet, reference)


def circle_models(
    magnet: Magnet, observation: Observation, model: Response, whole: bool = False
) -> list[MultipoleModel]:
    """Return the multipoles on the circles that a study reads, without a further solve.

    They include all orders that the readings resolve, the main order too, in units of the main
    multipole on the circle of the same radius that is nearest to the middle of the magnet. The list
    is empty if the study reads no full circles; if that main multipole is no larger than its error
    bar or than 3 % of the largest at other z, as between the poles of an undulator; or if its
    instrument changes or moves the readings: these are then not on circles about the magnet's axis,
    or at other z than the map states. Circles within which a coil or a dipole is are left out.

    The multipoles are Fourier coefficients of B_r at the study's own angles. With m angles, order n
    also contains (aliases with) order m - n, which the field of blocks in vacuum and of external
    sources tells: it is subtracted. What permeable blocks and iron make of order m - n is
    neglected, some per cent of it. ``whole`` tells that the only parameter is the strength of the
    nominal magnet.
    """
    main, models = magnet.array.multipole_order, []

    def from_middle(z: float) -> float:
        return abs(z - magnet.middle_z_m)

    deviations = Deviations.of(magnet)
    circles = [(radius, z, analysis) for radius, z, analysis in _read_circles(magnet, observation)
               if not _source_within(magnet, radius, z)]
    for radius in sorted({radius for radius, _, _ in circles}):
        own = sorted((z, analysis) for other, z, analysis in circles if other == radius)
        _, middle = min(own, key=lambda pair: from_middle(pair[0]))
        orders = tuple(range(1, middle.shape[0] // 2 + 1))[:len(DEFAULT_ORDERS)]
        if main not in orders:
            continue
        by_z: dict[float, Complexes] = {}
        offsets: dict[float, Complexes] = {}
        beside: dict[float, Complexes] = {}
        for z, analysis in own:
            mistaken, of_others, of_neighbours = _aliases(
                deviations, observation, radius, z, analysis.shape[0] // 2, whole)
            by_z[z] = _complexes(_seen(analysis, model.matrix)) - mistaken
            offsets[z] = _complexes(_seen(analysis, model.offset)) - of_others
            beside[z] = _complexes(_seen(analysis, model.of_neighbours)) - of_neighbours
        reference, fixed, others = (each[min(by_z, key=from_middle)][main - 1:main]
                                    for each in (by_z, offsets, beside))
        try:
            # between the poles of an undulator 0.5 % of the largest were left of mesh and columns
            least = 0.03 * max(abs(row[main - 1] @ model.nominal) for row in by_z.values())
            turn = _turn(magnet, reference[0], model, fixed[0], max(
                least, _circle_error(middle, model.error)[main - 1]))
        except StudyError:
            continue
        order = np.array([main, *orders])
        phases = np.exp(-1j * turn * order)
        for z, analysis in own:
            matrix, offset, rest = (each[z][:len(orders)] for each in (by_z, offsets, beside))
            models.append(MultipoleModel(
                orders, main, radius, z if magnet.dimension == 3 else None, False,
                phases[:, None] * np.vstack([reference, matrix]),
                phases * np.concatenate([fixed, offset]),
                _circle_error(analysis, model.error)[order - 1], model.nominal, -turn,
                of_neighbours=phases[:, None] * np.vstack([others, rest])))
    return models


def solved_circles(
    magnet: Magnet, points: Floats, flux_density: Floats, errors: Floats
) -> list[tuple[MultipoleModel, Multipoles]]:
    """Return the multipoles of a solved field on the study's circles.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
        The study's positions.
    flux_density : ndarray, shape (n, 3), in T
        B at these points.
    errors : ndarray, shape (readings,), in T
        Error bar of the solver for each of the study's readings.
    """
    observed = magnet.study.observation
    if observed.quantity == "flux_density":
        errors = np.repeat(errors.reshape(len(points), -1)[:, 0], len(COMPONENTS))
        observed = observed.with_(components=COMPONENTS)
    bare = magnet.with_(instrument=Instrument(), observation=observed)
    observation = observe(bare.study, points, np.ones_like(points, bool))
    readings = observation.apply(flux_density)
    # a model with a single parameter, the strength of the whole magnet
    whole = Response(readings[:, None], ("strength",), np.ones(1), 0 * readings, errors, 0.0,
                     of_neighbours=_neighbours_in_vacuum(magnet, observation))
    exact = Gaussian(np.ones(1), np.zeros((1, 1)))
    return [(model, model.of(exact)) for model in circle_models(
        bare, observation, whole, whole=True)]


def _aliases(
    deviations: Deviations, observation: Observation, radius: float, z: float, orders: int,
    whole: bool,
) -> tuple[Complexes, Complexes, Complexes]:
    """Return what the angles of a circle mistake for its orders 1 ... K, in vacuum.

    The first result is (K, parameters) in T per parameter, the second that of external fields (K,)
    in T; of the ``whole`` nominal magnet it is (K, 1) with external fields, and zero. The third is
    that of the `neighbour_prior`, in T m/A. It is the difference of the sums over the circle's own
    angles and over a multiple of them.
    """
    magnet, points = deviations.magnet, observation.map_points
    # relative difference of radii up to which points are on one circle, and angle in rad up to
    # which points on it are one
    same_radius, same_angle = 2e-6, 1e-6
    here = points[np.isclose(radii_of(points), radius, rtol=same_radius)
                  & np.isclose(points[:, 2], z, atol=SAME_PLACE_M)]
    own = len(np.unique(np.round(azimuths_of(here) / same_angle)))
    # orders count as aliases until their decay in the bore, (radius / bore radius)^n, is below the
    # first; where circles are near the blocks or outside of the bore, the second is their decay
    alias_left, slowest_decay = 1e-6, 0.95
    nearest = min(magnet.bore_radius, radius + _nearest_source(magnet, radius, z))
    decay = min(radius / nearest, slowest_decay)
    needed = orders + int(np.ceil(np.log(alias_left) / np.log(decay)))
    times = max(1, int(np.ceil(needed / own)))
    angle = np.arctan2(here[0, 1], here[0, 0]) + 2 * np.pi * np.arange(times * own) / (times * own)
    direction = unit_circle(angle)
    places = radius * direction
    places[:, 2] = z
    columns = deviations.columns(places).reshape(len(places), 3, -1)
    others = external_field(magnet, places)[..., None]
    if whole:
        nominal = np.zeros(columns.shape[2])
        nominal[:len(magnet.nominal_magnetization)] = magnet.nominal_magnetization
        columns, others = (columns @ nominal)[..., None] + others, 0 * others
    radial = np.einsum("ni,nip->np", direction, np.concatenate(
        [columns, others, neighbour_columns(magnet, places)], axis=2))
    wave = np.exp(-1j * np.outer(np.arange(1, orders + 1), angle)) * 2j  # B_n + i A_n
    found = wave[:, ::times] @ radial[::times] / own - wave @ radial / len(angle)
    own = columns.shape[2]
    return found[:, :own], found[:, own], found[:, own + 1:]


def _seen(analysis: sparse.csr_array, values: Floats | StoredMatrix) -> Floats:
    """Return an analysis (k, readings) of values (readings, ...), reading only the rows it uses."""
    used = np.unique(analysis.indices)
    return np.asarray(analysis[:, used] @ values[used])


def _complexes(values: Floats) -> Complexes:
    """Return C_n = B_n + i A_n from rows in the order A_1 ... A_K, B_1 ... B_K."""
    half = len(values) // 2
    return values[half:] + 1j * values[:half]


def _turn(
    magnet: Magnet, row: Complexes, model: Response, external: complex, least_T: float = 0.0
) -> float:
    """Return the angle in rad of the nominal main multipole about z.

    ``row`` (parameters,) is the row of the main multipole in the matrix from magnetizations to C,
    and ``external`` what external fields add to it.

    StudyError if the main multipole of the nominal magnet, with external fields or without,
    vanishes, or is no larger than ``least_T``.
    """
    own = row @ model.nominal
    scale = np.abs(row).sum() * np.abs(model.nominal).max()
    if not min(abs(own), abs(own + external)) > max(NOTHING_THERE * scale, least_T):
        raise StudyError(must_be(
            "`array`", f"study {magnet.name}",
            f"that of a magnet with a multipole of order {magnet.array.multipole_order}",
            "a magnet without it", "Check multipole_order and its exceptions; of an undulator, "
            "whose field cancels along z, ask on circles at poles: --at-z-m Z."))
    angle, beside_pi = float(np.angle(own + external)), 0.1
    # of pi and -pi, between which rounding decides, the axes of other orders may be opposite ones
    return (angle + 2 * np.pi * (angle < beside_pi - np.pi)) / magnet.array.multipole_order


def _read_circles(
    magnet: Magnet, observation: Observation
) -> list[tuple[float, float, sparse.csr_array]]:
    """Return radius and z in m of each circle, and the matrix from readings to its coefficients.

    The matrix is (2 K, readings), with rows A_1 ... A_K, B_1 ... B_K.
    """
    positions, labels = observation.positions, np.array(observation.labels)
    settings, size = magnet.study.observation.positions, len(labels)
    plain = (observation.operator.shape == observation.analysis.shape
             and (observation.operator != observation.analysis).nnz == 0
             and np.abs(observation.points - observation.map_points).max() < SAME_PLACE_M)
    if not isinstance(settings, CirclePositions) or not plain:
        return []
    pick = sparse.eye_array(size, format="csr")
    if magnet.study.observation.quantity == "fourier_coefficients":
        rows = np.array([label[1:].isdigit() for label in observation.labels])
        circles = dict.fromkeys((float(x), float(z)) for x, _, z in positions[rows])
        return [(radius, z, pick[np.flatnonzero(
            rows & (positions[:, 0] == radius) & (positions[:, 2] == z))]) for radius, z in circles]
    x, y = (np.flatnonzero(labels == name) for name in ("Bx", "By"))
    harmonics = min(len(DEFAULT_ORDERS), (settings.angles - 1) // 2)
    if not len(x) or len(x) != len(y) or harmonics < 1 or (positions[x] != positions[y]).any():
        return []
    try:
        analysis, _, where = fourier_analysis(positions[x], FourierCoefficients(
            quantity="fourier_coefficients", harmonics=harmonics, positions=settings))
    except MeasurementError:  # the circles are not full
        return []
    matrix = sparse.csr_array(analysis[:, 0::3] @ pick[x] + analysis[:, 1::3] @ pick[y])
    return [(float(where[first, 0]), float(where[first, 2]), matrix[first:first + 2 * harmonics])
            for first in range(0, len(where), 2 * harmonics)]


def _circle_error(analysis: sparse.csr_array, errors: Floats) -> Floats:
    """Return the error bars (K,) of |C_n| on a circle, in T.

    If the readings are Fourier coefficients, these are the error bars of the readings. If they are
    flux densities, they are the largest errors of coefficients that the errors at the points of the
    circle allow by Parseval's theorem.
    """
    if np.all(np.diff(analysis.indptr) == 1):
        return np.asarray(analysis @ errors)[:analysis.shape[0] // 2]
    own = errors[np.unique(analysis.indices)]
    return np.full(analysis.shape[0] // 2, np.sqrt(2 * np.mean(own**2)))


def _along_all_z(
    magnet: Magnet, observation: Observation, model: Response, part: slice
) -> tuple[Complexes, Complexes, Floats]:
    """Return matrix, offset and error bars (K, ...) of the field integrated along all of z.

    Those of the `model` are sums of fields over the magnet's length and its surroundings, and what
    is beyond if it falls as the multipole of its order does. They are kept for what permeability
    and iron add, with all that is beyond as error bar; blocks in vacuum and external fields have
    integrals of their own.
    """
    def complexes(values: Floats) -> tuple[Complexes, Complexes]:
        near, far = np.split(values, 2)
        return _complexes(near), _complexes(far)

    sources = observation.operator @ external_field(magnet, observation.points).ravel()
    summed = np.hstack([
        observation.operator @ unit.reshape(-1, 3) @ (MU_0 * block.recoil_tensor)
        for block, unit in zip(magnet.blocks, unit_fields(
            magnet.blocks, observation.points), strict=True)])
    size = summed.shape[1]
    matrix, offset = model.matrix[part].copy(), model.offset[part] - sources
    matrix[:, :size] -= summed
    amplitudes = magnet.study.uncertain_of_magnet
    first = matrix.shape[1] - len(amplitudes)  # whose sources have integrals of their own, too
    if amplitudes:
        matrix[:, first:] -= observation.operator @ changes_by_amplitudes(
            magnet, lambda other: external_field(other, observation.points)).reshape(
                -1, len(amplitudes))
    near, far = complexes(matrix)
    offset_near, offset_far = complexes(offset)
    radius, highest = float(np.hypot(*observation.points[0, :2])), len(near)
    shapes, inexact = _integrals_of_shapes(magnet.blocks, radius, highest)
    sources, sources_error = _integrals_of_sources(magnet, radius, highest)
    mesh = model.error[part].reshape(2, 2, -1).max(axis=1).sum(axis=0)
    error = mesh + np.abs(offset_far + far @ model.nominal) + inexact + sources_error
    total = near + far
    if amplitudes:
        total[:, first:] += changes_by_amplitudes(
            magnet, lambda other: _integrals_of_sources(other, radius, highest)[0])
    tensors = MU_0 * np.array([block.recoil_tensor for block in magnet.blocks])
    total[:, :size] += np.einsum("bk,bj->kbj", shapes, tensors[:, 0] + 1j * tensors[:, 1]).reshape(
        highest, size)
    return total, offset_near + offset_far + sources, error


def _integrals_of_sources(
    magnet: Magnet, radius: float, highest: int
) -> tuple[Complexes, Floats]:
    """Return C_n (K,) of external sources but a uniform field, integrated along all of z, and error
    bars (K,), in T m.
    """
    others = neighbour_blocks(magnet.blocks, magnet.external.neighbours)
    shapes, inexact = _integrals_of_shapes(others, radius, highest)
    of_others = sum((one.polarization[0] + 1j * one.polarization[1]) * shape
                    for one, shape in zip(others, shapes, strict=True))
    coils, error = _integrals_of_coils(magnet, radius, highest)
    return of_others + coils, inexact + error


def _integrals_of_shapes(
    blocks: Sequence[MagnetBlock], radius: float, highest: int
) -> tuple[Complexes, Floats]:
    """Return `_harmonics_of_shape` of blocks (blocks, K), and error bars (K,) in T m.

    These are the changes of the sum of all by quadratures of fewer points.
    """
    fewer = 4  # points of every panel
    # of a panel as long as it is far from the axis, sqrt(1 + 2^2) + 2 = 4.2 is the base of the
    # powers by which a quadrature converges; harmonics of order n vary n times as fast
    size = 14 + highest // 2
    found, errors = np.zeros((len(blocks), highest), complex), np.zeros(highest)
    for number, block in enumerate(blocks):
        found[number], coarser = (_harmonics_of_shape(block, radius, highest, points)
                                  for points in (size, size - fewer))
        errors += np.abs(found[number] - coarser) * np.hypot(*block.polarization[:2])
    return found, errors


def _harmonics_of_shape(block: MagnetBlock, radius: float, highest: int, size: int) -> Complexes:
    """Return C_n (K,) in m per J_x + i J_y of a block, integrated along z.

    By Gauss's theorem the integral of (x + i y)^-(n + 1) over the block's volume is one over its
    outline and along the axis of its frame, of a block that stands upright times its height.

    Parameters
    ----------
    radius : float
        Reference radius in m.
    highest : int
        K.
    size : int
        Gauss points in every panel, which is not longer than the block is far from the axis.
    """
    nodes, weights = np.polynomial.legendre.leggauss(size)
    most_panels = 64  # along a side of blocks that all but touch the axis

    def panels(length: float, longest: float) -> tuple[Floats, Floats]:
        count = min(int(np.ceil(length / longest)), most_panels)
        starts = np.arange(count)[:, None]
        return ((starts + (1 + nodes) / 2) / count).ravel(), np.tile(weights / 2 / count, count)

    axes = block.axes[0] + 1j * block.axes[1]  # in the plane of x and y
    aside = int(np.argmax(np.abs(axes[:2])))
    height = block.z_max - block.z_min
    origin = complex(*block.position[:2]) + block.z_min * axes[2]
    rounding = 1e-15
    upright = abs(axes[2]) < rounding
    total = np.zeros(highest, complex)
    for factor, part in block.parts:
        sides = [edge.at(np.linspace(0, 1, 17))[0] @ axes[:2] for edge in part.outline]
        distance = float(np.abs(origin + np.concatenate(sides)[:, None]
                                + height * axes[2] * np.linspace(0, 1, 9)).min())
        levels, along = (np.zeros(1), np.ones(1)) if upright else panels(height, distance)
        for edge in part.outline:
            t, across = panels(edge.length, distance)
            places, normals = edge.at(t)
            z = (origin + places @ axes[:2])[:, None] + height * axes[2] * levels
            power = factor * height * np.outer(across * normals[:, aside], along) / (
                axes[aside] * z)
            for order in range(highest):
                total[order] += power.sum()
                power *= radius / z
    return np.asarray(total / (2j * np.pi))


def _integrals_of_coils(
    magnet: Magnet, radius: float, highest: int
) -> tuple[Complexes, float]:
    """Return C_n (K,) of external coils and dipoles, integrated along all of z, in T m.

    The error bar in T m of all comes second. The ``radius`` of the circle is in m.

    StudyError if one of them is within the circle, at any z: then the integral has sources there.
    """
    external = External(coils=magnet.external.coils, dipoles=magnet.external.dipoles)
    if external == External():
        return np.zeros(highest, complex), 0.0
    closest = np.inf
    for name, nearest in (*((f"coils[{number}]", distance_from_axis(coil, radius / 1000))
                            for number, coil in enumerate(external.coils, start=1)),
                          *((f"dipoles[{number}]", float(np.hypot(*one.position_m[:2])))
                            for number, one in enumerate(external.dipoles, start=1))):
        if nearest < radius:
            raise StudyError(must_be(
                f"`external.{name}`", f"study {magnet.name}", "outside the circle, at whatever z, "
                f"for multipoles that are integrated along z: farther than {radius:g} m from the "
                "axis", f"{max(nearest, 0.0):.4g} m", "Ask on a circle at one place: --at-z-m Z, "
                "in Python MultipoleReference(z_m=Z)."))
        closest = min(closest, max(nearest, 1.002 * radius))
    alone = magnet.with_(external=external)
    angles = _angles(highest, radius / closest)
    angle = 2 * np.pi * np.arange(angles) / angles
    circle = radius * unit_circle(angle)[:, :2]
    wave = np.exp(-1j * np.outer(np.arange(highest), angle)) / len(angle)

    def harmonics(z: float) -> Floats:
        field = external_field(alone, at_heights(circle, z))
        found = wave @ (field[:, 1] + 1j * field[:, 0])
        return np.concatenate([found.real, found.imag])

    places = [0.0, *(one.position_m[2] for one in external.dipoles),
              *(one.centre_m[2] for one in external.coils)]
    relative_error = 1e-10  # far below what is known of external fields
    # of a coaxial coil all integrals are 0, to which no relative error is ever reached
    strongest = max(float(np.abs(external_field(alone, at_heights(circle, z))).max())
                    for z in places)
    found, error = quad_vec(
        harmonics, -np.inf, np.inf, epsrel=relative_error,
        epsabs=relative_error * strongest * closest, norm="max", points=sorted(set(places)))
    return found[:highest] + 1j * found[highest:], float(error)


def _radius(magnet: Magnet, reference: MultipoleReference) -> float:
    """Return the reference radius in m, by default as `MultipoleReference` describes."""
    positions = magnet.study.observation.positions
    free, radius = _free_radius(magnet, reference.z_m), reference.radius_m
    # default reference radius relative to the inner radius of the blocks, the usual choice
    default_radius = 2 / 3
    if radius is None:
        own = positions.radius_m if isinstance(positions, CirclePositions) else ()
        radius = own[0] if len(own) == 1 else default_radius * free
    # smallest and largest reference radius relative to that of the bore. Far inside, multipoles of
    # high orders are zero to all digits; nearer to blocks or iron, sums over angles and z need very
    # many points, and finite elements are inexact.
    least_radius, most_radius = 1e-3, 0.95
    bore = free if radius < free else magnet.bore_radius  # a circle in iron is no circle in air
    if not least_radius * bore <= radius <= most_radius * bore:
        raise StudyError(must_be(
            "--reference-radius-m", f"study {magnet.name}",
            f"from {least_radius * bore:g} to {most_radius * bore:.4g} m, as the "
            f"{'blocks' if bore == magnet.bore_radius else 'poles'}' inner radius is {bore:.4g} m",
            f"{radius:g}",
            "Was it meant in millimetres?" if radius / 1000 <= most_radius * bore < radius / 10
            else "Choose a smaller one." if radius > most_radius * bore else ""))
    if reference.z_m is not None:
        free = _free_radius(magnet, reference.z_m, 0.0)
    if radius > free:
        raise StudyError(must_be(
            "--reference-radius-m", f"study {magnet.name}", f"at most {free:.4g} m, where iron "
            "begins: a circle around iron has no multipoles", f"{radius:g}",
            "Only a field about a free axis has multipoles; halbach-fe solve computes this one at "
            "any points."))
    return radius


def _free_radius(magnet: Magnet, z: float | None, beside: float = np.inf) -> float:
    """Return the radius in m about the axis within which there are neither blocks nor iron.

    Poles of iron may stand nearer to the axis than the blocks. Beside a circle at ``z`` only those
    count that are nearer to it along z than the blocks are to the axis, and than ``beside`` in m.
    """
    bore = magnet.bore_radius
    bodies = [body for body in magnet.iron if not body.is_coaxial or body.inner_radius < bore]
    if not bodies:
        return bore
    heights = np.zeros(1)
    if magnet.dimension == 3:
        ends = [(body.surface[2].min(), body.surface[2].max()) for body in bodies]
        heights = np.unique(np.concatenate([np.linspace(*each, 9) for each in ends]))
        if z is not None:
            heights = np.append(heights[np.abs(heights - z) < min(bore, beside)], z)
    angle = 2 * np.pi * np.arange(720) / 720
    circles = np.column_stack([np.tile(np.cos(angle), len(heights)),
                               np.tile(np.sin(angle), len(heights)), np.repeat(heights, 720)])

    def is_free(radius: float) -> bool:
        return not any(body.contains(circles * [radius, radius, 1.0]).any() for body in bodies)

    spans = [np.hypot(*body.surface[:2]) for body in bodies]
    middles = [(span.min() + span.max()) / 2 for span in spans]  # of walls thinner than the steps
    radii = np.unique([*np.linspace(0, bore, 65), *np.minimum(middles, bore)]).tolist()
    for free, beyond in pairwise(radii):
        if not is_free(beyond):
            for _ in range(12):
                middle = (free + beyond) / 2
                free, beyond = (middle, beyond) if is_free(middle) else (free, middle)
            return free
    return bore


def _observation(magnet: Magnet, radius: float, highest: int, z: float | None) -> Observation:
    """Return an observation of the Fourier coefficients of B_r.

    They are those of the circle at z, or in 3D with z None those of the field summed along z, and
    then, as further readings, what is beyond the ends if order n falls as z^-(n + 2) there.
    """
    free = _free_radius(magnet, z)
    bore = free if radius < free else magnet.bore_radius
    if magnet.dimension == 2 or z is not None:  # the sum along z is without coils and dipoles
        bore = min(bore, radius + _nearest_source(magnet, radius, z or 0.0))
    angles = _angles(highest, radius / bore)
    limits: tuple[float, float, int] = (z or 0.0, z or 0.0, 1)
    if magnet.dimension == 3 and z is None:
        end = magnet.field_reach
        step = 2 * np.pi * (bore - radius) / -np.log(SUM_ERROR)
        limits = (-end, end, int(np.ceil(2 * end / step)) + 1)
    settings = FourierCoefficients(
        quantity="fourier_coefficients", harmonics=highest, positions=CirclePositions(
            kind="circles", radius_m=(radius,), angles=angles, z_min_m=limits[0],
            z_max_m=limits[1], count=limits[2]))
    points = points_from(settings.positions)
    matrix, labels, positions = fourier_analysis(points, settings)
    step = (limits[1] - limits[0]) / (limits[2] - 1) if limits[2] > 1 else 1.0
    weights = np.full(limits[2], step)
    if limits[2] > 1:
        weights[[0, -1]] /= 2
    size = 2 * highest
    total = sparse.csr_array(sparse.kron(weights[None], sparse.eye_array(size)) @ matrix)
    labels, positions = labels[:size], positions[:size]
    if limits[2] > 1:
        ends = np.isin(np.arange(limits[2]), (0, limits[2] - 1)).astype(float)
        falling = np.tile(limits[1] / (1 + np.arange(1, highest + 1)), 2)
        beyond = sparse.kron(ends[None], sparse.diags_array(falling)) @ matrix
        total = sparse.csr_array(sparse.vstack([total, beyond]))
        labels, positions = 2 * labels, np.tile(positions, (2, 1))
    return Observation(points, total, total, points, labels, positions)


SUM_ERROR = 1e-8
"""Tolerance of sums over equally spaced angles or z, relative to the field at blocks and iron.

Such a sum mixes a small part of a multipole into another. Harmonics of order k fall as (R / r)^k
from their inner radius r inwards, and the sum over steps h along z of a field whose sources are at
the distance d has the error exp(-2 pi d / h)."""


def _angles(highest: int, ratio: float) -> int:
    """Return how many angles tell orders up to the highest, if harmonics fall as ratio^k."""
    return max(2 * highest + 1, highest + int(np.ceil(np.log(SUM_ERROR) / np.log(ratio))))


def _nearest_source(magnet: Magnet, radius: float, z: float) -> float:
    """Return how far in m the nearest coil or dipole is from a circle at z in m, or 1/200 of the
    radius if it is nearer; infinite without any.
    """
    angle = np.linspace(0, 2 * np.pi, 1000)
    circle = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle + z])
    apart = [distance_in_magnet(coil, circle).min() for coil in magnet.external.coils] + [
        np.linalg.norm(circle - one.position_m, axis=1).min() for one in magnet.external.dipoles]
    return max(float(min(apart, default=np.inf)), radius / 200)



def text_table(**columns: Multipoles) -> list[dict[str, str]]:
    """Return a row of text per order, with ``b_n ± sd`` and ``a_n ± sd`` in units.

    The columns are multipoles of the same orders, each by a name for the heading, which may be
    empty if there is one column. The main multipole, 10 000 units by definition, is no error: its
    cell has a word. What is exact has no standard deviation.
    """
    # size of a multipole that can only be the main one, in units of it; its axes turn by little
    main_units = 9000.0
    def text(known: Multipoles, number: int) -> str:
        if known.mean[number] > main_units:
            return "main"
        value, sd = round(float(known.mean[number]), 2), float(known.sd[number])
        spread = "" if not sd else " ± <0.01" if sd < 0.005 else f" ± {sd:.2f}"
        return f"{value:+.2f}{spread}" if value else f"0{spread}"

    first = next(iter(columns.values()))
    rows = []
    for i, order in enumerate(first.orders):
        row = {"n": str(order)}
        for letter, number in (("b", i), ("a", len(first.orders) + i)):
            row |= {f"{letter}_n {name}".strip(): text(column, number)
                    for name, column in columns.items()}
        rows.append(row)
    return rows


def met(sizes: Floats, limit: float) -> float:
    """Return the share of samples (count, k) of |c_n| with all |c_n| within a limit in units."""
    return float(np.mean((sizes <= limit).all(axis=1)))


def plain(known: Multipoles, unit: str) -> dict[str, object]:
    """Return multipoles as plain data for JSON; ``unit`` is the unit of the main multipole."""
    name = unit.replace(" ", "_")
    return {f"main_{name}": known.main, f"main_sd_{name}": known.main_sd, "roll_rad": known.roll,
            "roll_sd_rad": known.roll_sd, "rms_units": known.rms, "multipoles": known.table()}
