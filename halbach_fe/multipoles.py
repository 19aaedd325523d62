"""Multipoles of a magnet as linear functions of its block magnetizations.

``B_y + i B_x = sum_n C_n ((x + i y) / R)^(n - 1)`` at the reference radius R, n = 1 the dipole,
with ``C_n = B_n + i A_n``: normal and skew (the European convention; S. Russenschuck, Field
Computation for Accelerator Magnets, 2010, ch. 6). On the circle that is ``B_r = sum A_n cos(n phi)
+ B_n sin(n phi)``, the Fourier coefficients that a study observes. Unwanted multipoles are in units
of 1e-4 of the main one, ``c_n = 1e4 C_n / |C_N|``, along axes turned about z such that the nominal
magnet's main multipole is normal: ``C_n exp(-i n arg(C_N) / N)``.

In two dimensions there is one circle. In three the field is integrated along z over the magnet and
far beyond its ends, which makes it a solution of the two-dimensional Laplace equation again; or,
at one z, the coefficients of B_r there are given as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe.blocks import Floats, blocks_of
from halbach_fe.errors import StudyError, must_be
from halbach_fe.extent import magnet_half_length, magnet_radius
from halbach_fe.inference.prior import Gaussian
from halbach_fe.observation import Observation, fourier_analysis, points_from
from halbach_fe.response import response
from halbach_fe.solve import Workshop
from halbach_fe.study import (
    MU_0,
    CirclePositions,
    FourierCoefficients,
    Instrument,
    Study,
)

Complexes = NDArray[np.complex128]

UNITS = 1e4
"""Multipoles are given in 1e-4 of the main one."""

DEFAULT_RADIUS = 2 / 3
"""Reference radius over the blocks' inner radius, as is usual."""

DEFAULT_ORDERS = tuple(range(1, 11))

SUM_ERROR = 1e-8
"""What equally spaced angles, or z, may add of one multipole to another, relative to the field at
the blocks. Harmonics of order k fall as (R / r)^k from the blocks' radius r inwards, and a sum over
steps h along z of a field whose sources are d away errs by exp(-2 pi d / h)."""

BEYOND_ENDS = 4.5
"""How far sums along z go beyond the magnet, over its outer radius. A block's field falls as 1/z^3,
which leaves some 1e-3 of a block's own integral of order 1 to the field of point dipoles beyond.
Higher orders fall faster: for two rings of 80 mm with errors of 2 %, 0.01 units remain. It is half
of the way to where 3D meshes end."""

NOTHING_THERE = 1e-6
"""Main multipole below which a magnet has none, relative to what its blocks could do together."""


@dataclass(frozen=True)
class Reference:
    """Where multipoles are taken, and which.

    Attributes
    ----------
    radius_m : float or None
        Default: that of the study's own circles if it has one, else `DEFAULT_RADIUS` of the bore.
    orders : tuple of int
        Unwanted ones; the main one, if it is there, does not count.
    z_m : float or None
        In three dimensions: of one circle, in place of the integral along z.
    """

    radius_m: float | None = None
    orders: tuple[int, ...] = DEFAULT_ORDERS
    z_m: float | None = None


@dataclass(frozen=True)
class Multipoles:
    """Multipoles of a magnet, as far as they are known.

    Attributes
    ----------
    orders : tuple of int
        Unwanted ones, k of them.
    main : float
        |C_N| in T, or T m if integrated along z; ``main_sd`` its standard deviation.
    roll : float
        Angle in rad by which the main multipole is turned about z from the nominal one.
    mean : ndarray, shape (2 k,)
        b_n of all orders, then a_n, in units of 1e-4 of the main one.
    root : ndarray, shape (2 k, q)
        Root of their covariance.
    error : ndarray, shape (2 k,)
        The solver's own, of the nominal magnet, not in ``root``.
    """

    orders: tuple[int, ...]
    main: float
    main_sd: float
    roll: float
    roll_sd: float
    mean: Floats
    root: Floats
    error: Floats

    @property
    def covariance(self) -> Floats:
        """Shape (2 k, 2 k)."""
        return self.root @ self.root.T

    @property
    def sd(self) -> Floats:
        """Standard deviations (2 k,), the solver's error included."""
        return np.sqrt(np.einsum("ij,ij->i", self.root, self.root) + self.error**2)

    @property
    def sizes(self) -> Floats:
        """|c_n| (k,) of the mean."""
        return np.hypot(*self.mean.reshape(2, -1))

    @property
    def expected_square(self) -> float:
        """Expected sum of all |c_n|^2, without the solver's error."""
        return float(self.mean @ self.mean + np.sum(self.root**2))

    def sizes_of(self, normals: Floats) -> Floats:
        """|c_n| (count, k) of samples, made of standard normal numbers (count, 2 k)."""
        values, vectors = np.linalg.eigh(self.covariance + np.diag(self.error**2))
        drawn = self.mean + normals * np.sqrt(np.maximum(values, 0)) @ vectors.T
        return np.hypot(*drawn.reshape(len(drawn), 2, -1).swapaxes(0, 1))

    def table(self) -> list[dict[str, float]]:
        """One row per order, as plain numbers."""
        size = len(self.orders)
        return [{"n": order, "b": float(self.mean[i]), "b_sd": float(self.sd[i]),
                 "a": float(self.mean[size + i]), "a_sd": float(self.sd[size + i]),
                 "size": float(self.sizes[i])} for i, order in enumerate(self.orders)]


@dataclass(frozen=True)
class MultipoleModel:
    """Multipoles ``C = offset + matrix p`` in T (integrated: T m), the main one first.

    Attributes
    ----------
    orders : tuple of int
        Unwanted ones.
    main : int
        The magnet's own order N.
    radius : float, in m
    z : float or None
        In m, of one circle in three dimensions.
    integrated : bool
    matrix : ndarray of complex, shape (1 + k, parameters)
        Along axes in which the nominal main multipole is normal.
    offset : ndarray of complex, shape (1 + k,)
    error : ndarray, shape (1 + k,)
        Of the solver, of the modulus.
    nominal : ndarray, shape (parameters,), in A/m
    turn : float
        Angle of those axes in rad.
    """

    orders: tuple[int, ...]
    main: int
    radius: float
    z: float | None
    integrated: bool
    matrix: Complexes
    offset: Complexes
    error: Floats
    nominal: Floats
    turn: float

    @property
    def unit(self) -> str:
        """Of the main multipole."""
        return "T m" if self.integrated else "T"

    @cached_property
    def nominal_main(self) -> float:
        """|C_N| of the nominal magnet."""
        return float(abs((self.offset + self.matrix @ self.nominal)[0]))

    def scaled(self, main: float) -> Floats:
        """The matrix (2 k, parameters) of b_n, a_n for a given |C_N|."""
        return UNITS / main * np.vstack([self.matrix[1:].real, self.matrix[1:].imag])

    def of(self, parameters: Gaussian) -> Multipoles:
        """Multipoles of magnetizations in A/m."""
        return self.known(self.offset + self.matrix @ parameters.mean,
                          self.matrix @ parameters.root)

    def known(self, mean: Complexes, root: Complexes) -> Multipoles:
        """Multipoles of a mean (1 + k,) and a root (1 + k, q) of C, linearized about that mean."""
        strength = float(abs(mean[0]))
        along = (np.conj(mean[0]) * root[0]).real / strength  # of |C_N|
        across = (np.conj(mean[0]) * root[0]).imag / strength**2
        relative = mean[1:] / strength
        own = (root[1:] - np.outer(relative, along)) / strength
        return Multipoles(
            self.orders, strength, float(np.linalg.norm(along)),
            # C_N exp(i N theta) is that of axes turned by theta
            float(-np.angle(mean[0])) / self.main, float(np.linalg.norm(across)) / self.main,
            UNITS * np.concatenate([relative.real, relative.imag]),
            UNITS * np.vstack([own.real, own.imag]),
            UNITS * np.tile(self.error[1:] / strength, 2))

    def units(self, coefficients: Complexes) -> Floats:
        """b_n, a_n (..., 2 k) of coefficients C (..., 1 + k), without linearizing."""
        relative = UNITS * coefficients[..., 1:] / np.abs(coefficients[..., :1])
        return np.concatenate([relative.real, relative.imag], axis=-1)


def multipole_model(study: Study, reference: Reference, workshop: Workshop) -> MultipoleModel:
    """Build the matrix from block magnetizations to multipoles, as `response` does for readings.

    Raises
    ------
    StudyError
        If the reference is none for this study, or the nominal magnet has no main multipole.
    """
    orders = tuple(sorted(set(reference.orders) - {study.array.multipole_order}))
    if not orders:
        raise StudyError(must_be("--orders", f"study {study.name}",
                                 "those of unwanted multipoles", "the main one only"))
    if study.dimension == 2 and reference.z_m is not None:
        raise StudyError(must_be("--at-z-m", f"study {study.name}", "left out, since it is 2D",
                                 f"{reference.z_m:g}"))
    radius = _radius(study, reference)
    integrated = study.dimension == 3 and reference.z_m is None
    bare = study.model_copy(update={"instrument": Instrument()})
    main = study.array.multipole_order
    model = response(bare, _observation(study, radius, max(*orders, main), reference.z_m), workshop)
    harmonics = len(model.offset) // 2
    index = np.array([main, *orders]) - 1

    def complexes(values: Floats) -> Complexes:
        return values[harmonics + index] + 1j * values[index]

    matrix, offset = complexes(model.matrix), complexes(model.offset)
    if integrated:
        matrix[index == 0] += beyond(study, _reach(study))
    own = matrix[0] @ model.nominal
    scale = np.abs(model.matrix[harmonics + main - 1]).sum() * np.abs(model.nominal).max()
    if not abs(own) > NOTHING_THERE * scale:
        raise StudyError(must_be(
            "`array`", f"study {study.name}", f"that of a magnet with a multipole of order {main}",
            "one without", "Check multipole_order and its exceptions."))
    turn = float(np.angle(own)) / main
    phases = np.exp(-1j * turn * np.array([main, *orders]))
    return MultipoleModel(
        orders, main, radius, reference.z_m, integrated, phases[:, None] * matrix,
        phases * offset, model.error[index], model.nominal, -turn)


def beyond(study: Study, reach: float) -> Complexes:
    """Integral of B_y + i B_x on the axis, beyond |z| = reach in m, per A/m of every block as a
    point dipole in vacuum: (parameters,) in T m.

    ``B = mu_0 / 4 pi (3 (m R) R / R^5 - m / R^3)``, integrated along z by hand.
    """
    found = []
    for block in blocks_of(study):
        middle, total = block.middle, np.zeros((2, 3))
        aside = -middle[:2]
        square = float(aside @ aside)
        for side in (1.0, -1.0):  # the lower end is the upper one of the mirrored magnet
            z = reach - side * middle[2]
            distance = np.hypot(z, np.sqrt(square))
            third = (1 - z / distance) / square
            fifth = (2 - z * (2 * z**2 + 3 * square) / distance**3) / (3 * square**2)
            total[:, :2] += 3 * fifth * np.outer(aside, aside) - third * np.eye(2)
            total[:, 2] += side * aside / distance**3
        total *= MU_0 * block.volume / (4 * np.pi)
        found.append(total[1] + 1j * total[0])
    return np.concatenate(found)


def _reach(study: Study) -> float:
    """Where sums along z end, in m from the middle."""
    return magnet_half_length(study) + BEYOND_ENDS * magnet_radius(study)


def _radius(study: Study, reference: Reference) -> float:
    positions = study.observation.positions
    bore = study.array.inner_radius_m
    radius = reference.radius_m
    if radius is None:
        own = positions.radius_m if isinstance(positions, CirclePositions) else ()
        radius = own[0] if len(own) == 1 else DEFAULT_RADIUS * bore
    if not 0 < radius < bore:
        raise StudyError(must_be("--reference-radius-m", f"study {study.name}",
                                 f"between 0 and the blocks' inner radius of {bore:g} m",
                                 f"{radius:g}", "Was it meant in millimetres?"))
    return radius


def _observation(study: Study, radius: float, highest: int, z: float | None) -> Observation:
    """Fourier coefficients of B_r, of one circle or integrated along z."""
    bore = study.array.inner_radius_m
    angles = max(2 * highest + 1, highest + int(np.ceil(np.log(SUM_ERROR) / np.log(radius / bore))))
    limits: tuple[float, float, int] = (z or 0.0, z or 0.0, 1)
    if study.dimension == 3 and z is None:
        end = _reach(study)
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
    total = sparse.csr_array(sparse.kron(weights[None], sparse.eye_array(2 * highest)) @ matrix)
    return Observation(points, total, total, points, labels[:2 * highest],
                       positions[:2 * highest])


def text_table(**columns: Multipoles) -> list[dict[str, str]]:
    """Rows of text, ``b_n ± sd`` and ``a_n ± sd`` in units, of magnets by name."""
    names, known = list(columns), list(columns.values())
    first = known[0]
    rows = []
    for i, order in enumerate(first.orders):
        row = {"n": str(order)}
        for letter, number in (("b", i), ("a", len(first.orders) + i)):
            row |= {f"{letter}_n {name}": f"{one.mean[number]:+.2f} ± {one.sd[number]:.2f}"
                    for name, one in zip(names, known, strict=True)}
        rows.append(row)
    return rows


def met(sizes: Floats, limit: float) -> float:
    """Share of samples (count, k) of |c_n| none of which is above a limit in units."""
    return float(np.mean((sizes <= limit).all(axis=1)))


def plain(known: Multipoles, unit: str) -> dict[str, object]:
    """For scripts."""
    name = unit.replace(" ", "_")
    return {f"main_{name}": known.main, f"main_sd_{name}": known.main_sd, "roll_rad": known.roll,
            "roll_sd_rad": known.roll_sd, "rms_units": float(np.sqrt(
                known.expected_square / len(known.orders))), "multipoles": known.table()}
