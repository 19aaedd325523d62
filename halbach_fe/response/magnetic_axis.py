"""Magnetic centre, axis and roll of a magnet, with standard deviations.

**Roll**: the angle by which the main multipole of order N is turned about z from that of the
nominal magnet. A turn by theta multiplies C_N by exp(-i N theta), see
`halbach_fe.response.multipoles`.

**Centre**, N >= 2: where the multipole of order N - 1 vanishes. A multipole of order N about
(x0, y0) has at the origin, by feed-down, ``C_(N-1) = -(N - 1) C_N (x0 + i y0) / R``.

**Axis**, N >= 2: the straight line along z through the centres at several heights, by least
squares. Its point in the middle along z, `Magnet.middle_z_m`, is the centre of a 3D magnet.

**Centre**, N = 1, in 3D: the stationary point of the component along the field, where its gradient
vanishes: that is where a homogeneous magnet is most homogeneous. It is a saddle point, since the
component is harmonic. The axis of a dipole is not defined.

The field is linear in the magnetizations, as in `halbach_fe.response.response_matrix`: permeable
blocks and iron answer to deviations too. (Of an iron tube close to the blocks, that is a quarter of
a roll.)
With non-linear iron the field is that of the updated magnet, which is solved for, and standard
deviations are those of the blocks in vacuum: columns of all blocks take as long as an update.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import product

import numpy as np
from scipy import optimize

from halbach_fe.core.arrays import Floats, unit_circle
from halbach_fe.geometry.coils import distance_in_magnet
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation_operator import flux_density_at
from halbach_fe.measurement.source_free_field import solid_harmonic_fields
from halbach_fe.response.block_variation import (
    Deviations,
    distribution_of,
    neighbour_columns,
    updated_field,
)
from halbach_fe.response.multipoles import NOTHING_THERE, Complexes
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session, alone
from halbach_fe.stats.gaussian import Gaussian

RADIUS = 0.1
"""Radius of the circles, relative to that of the bore. Farther out, a multipole's change along z
mixes into those of lower order (of a quadrupole of 0.18 m length and 0.2 m bore, slopes are 8 %
off with 1/3, 1 % with 0.1); farther in, errors of meshes count for more."""

HEIGHTS = 9
"""Number of circles along the axis of a 3D magnet."""

LENGTH = 0.5
"""Length along which they lie, relative to that of the magnet: the ends have fields of their own.
"""


@dataclass(frozen=True)
class MagneticAxis:
    """Centre, axis and roll of a magnet.

    Attributes
    ----------
    order : int
        The magnet's main order.
    roll_rad, roll_sd_rad : float
        Right-handed about z.
    centre_m, centre_sd_m : tuple of float or None
        x and y, of a dipole in 3D x, y and z; None if no centre is defined. That of an axis is in
        the middle of the magnet along z.
    slope_rad, slope_sd_rad : tuple of float or None
        dx/dz and dy/dz of the axis; None for dipoles and cross-sections.
    """

    order: int
    roll_rad: float
    roll_sd_rad: float
    centre_m: tuple[float, ...] | None = None
    centre_sd_m: tuple[float, ...] | None = None
    slope_rad: tuple[float, ...] | None = None
    slope_sd_rad: tuple[float, ...] | None = None

    def summary(self) -> dict[str, object]:
        """Return the axis as plain data for JSON."""
        return asdict(self)


@alone
def magnetic_axis(
    magnet: Magnet, session: Session, magnetizations: Gaussian
) -> MagneticAxis | None:
    """Compute magnetic centre, axis and roll for a distribution of the magnetizations in A/m.

    Parameters
    ----------
    magnet : Magnet
    session : Session
    magnetizations : Gaussian
        For example the posterior of `halbach_fe.infer`.

    Returns
    -------
    MagneticAxis or None
        None if the nominal magnet has no main multipole, or the middle of the bore is not free.
    """
    magnetizations = distribution_of(magnet, magnetizations, "magnetizations").stacked
    order, bore, circles = magnet.array.multipole_order, magnet.bore_radius, _Circles.of(magnet)
    in_3d, points = magnet.dimension == 3, circles.points
    if order == 1 and in_3d:  # a dipole's field is expanded on a sphere
        points = np.vstack([points, circles.middle + bore / 4 * _ON_SPHERE])
    if magnet.contains(points).any() or _has_source(magnet, bore / 4, circles.axis):
        return None  # something stands in the bore
    field, nominal, columns = (
        values[:, :magnet.dimension]
        for values in _fields(magnet, points, session, magnetizations.mean))
    was, main, root = (circles.multipole(order, values) for values in (nominal, field, columns))
    if not np.abs(was).max() > NOTHING_THERE * np.abs(root).sum(axis=1).max() * np.abs(
            magnet.nominal_magnetization).max():
        return None
    # weighted by the nominal field, which turns along no z of a magnet whose blocks are in place
    total = np.conj(was) @ main
    roll = float(-np.angle(total)) / order
    roll_row = -(np.conj(total) * (np.conj(was) @ root)).imag / abs(total)**2 / order
    roll_sd = float(magnetizations.sd_of(roll_row[None])[0])
    if order > 1:
        line, rows = _line(circles, order, field, columns)
        return MagneticAxis(order, roll, roll_sd, *(
            each for place, row in zip(line.tolist(), rows, strict=True)
            for each in ((place.real, place.imag), tuple(magnetizations.sd_of(
                np.vstack([row.real, row.imag])).tolist()))))
    return MagneticAxis(order, roll, roll_sd, *(_stationary(
        field[-len(_ON_SPHERE):], columns[-len(_ON_SPHERE):], bore / 4, circles.middle,
        magnetizations) if in_3d else ()))


@dataclass(frozen=True)
class _Circles:
    """Circles about the axis of a magnet, and the multipoles of the field on them."""

    middle: Floats
    """Of the magnet."""
    radius: float
    heights: Floats
    """Along z from the middle; 0 alone in a cross-section. In m."""
    angles: Floats

    @classmethod
    def of(cls, magnet: Magnet) -> _Circles:
        middle, heights = np.array(magnet.middle_m), np.zeros(1)
        if magnet.dimension == 3:
            reach = LENGTH * (magnet.array_half_length - abs(middle[2]))
            heights = np.linspace(-reach, reach, HEIGHTS)
        count = 2 * (magnet.array.multipole_order + 2)
        return cls(middle, RADIUS * magnet.bore_radius, heights,
                   2 * np.pi * np.arange(count) / count)

    @property
    def axis(self) -> Floats:
        """Their middles (heights, 3) in m."""
        return self.middle + self.heights[:, None] * [0, 0, 1.0]

    @property
    def points(self) -> Floats:
        """Points (heights * angles, 3) in m."""
        circle = self.radius * unit_circle(self.angles)
        return self.middle + (circle + self.heights[:, None, None] * [0, 0, 1.0]).reshape(-1, 3)

    def multipole(self, order: int, values: Floats) -> Complexes:
        """Return C (heights, ...) of an order from the field (points, 2 or 3, ...), of which the
        first points are these.
        """
        shape = len(self.heights), len(self.angles)
        parts = values[:shape[0] * shape[1]].reshape(*shape, *values.shape[1:])
        wave = np.exp(-1j * (order - 1) * self.angles) / len(self.angles)
        return np.einsum("hp...,p->h...", parts[:, :, 1] + 1j * parts[:, :, 0], wave)


def _line(
    circles: _Circles, order: int, field: Floats, columns: Floats
) -> tuple[Complexes, Complexes]:
    """Return the line through the centres, x + i y in the middle and, in 3D, its slope, (1 or 2,),
    and the derivatives (1 or 2, parameters) of these.
    """
    (below, main), (below_root, root) = (
        [circles.multipole(each, values) for each in (order - 1, order)]
        for values in (field, columns))
    scale = -circles.radius / (order - 1)
    places = circles.middle[:2] @ [1, 1j] + scale * below / main  # x0 + i y0 at each height
    rows = scale * (below_root - (below / main)[:, None] * root) / main[:, None]
    fit = np.linalg.pinv(np.vander(circles.heights, min(len(places), 2), increasing=True))
    return fit @ places, fit @ rows


def _has_source(magnet: Magnet, radius: float, line: Floats) -> bool:
    """Return whether a coil or dipole is within a radius in m of a line of places (n, 3) in m."""
    count = 1 + 2 * int(np.ceil(np.ptp(line[:, 2]) / radius))
    axis = np.linspace(line[0], line[-1], count)
    return any((distance_in_magnet(coil, axis) < radius).any()
               for coil in magnet.external.coils) or any(
        (np.linalg.norm(axis - one.position_m, axis=1) < radius).any()
        for one in magnet.external.dipoles)


def _fields(
    magnet: Magnet, points: Floats, session: Session, mean: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return B at points (n, 3) in m with the magnetizations ``mean`` in A/m, and with the nominal
    ones, (n, 3) in T, and the derivative (n, 3, parameters) of the former.
    """
    own = session.within("axis")
    if magnet.is_nonlinear:
        uniform = mean[:len(magnet.parameter_names)]
        nominal = solve_nominal(magnet, points, own.within("nominal"))
        field = updated_field(magnet, uniform, points, own.within("updated"))
        columns = Deviations.of(magnet).columns(points).reshape(len(points), 3, -1)
        columns = np.concatenate([columns, neighbour_columns(
            magnet, points, own.within("neighbours"))], axis=2)
        # variations inside blocks, and neighbours' blocks
        beside = columns[..., len(uniform):] @ mean[len(uniform):]
        return field + beside, nominal, columns
    response = response_matrix(magnet, flux_density_at(points), own)
    columns, external, others = (values.reshape(len(points), 3, *values.shape[1:]) for values in (
        response.whole, response.offset, response.of_neighbours))
    nominal = columns @ response.nominal + external
    columns = np.concatenate([columns, others], axis=2)
    return columns @ mean + external, nominal, columns


_ON_SPHERE = np.array([np.array(place) / np.linalg.norm(place)
                       for place in product((-1.0, 0.0, 1.0), repeat=3) if any(place)])
"""Points (26, 3) of the unit sphere: the six ends of the axes, and those between them."""

_DEGREES = 6
"""Degree of the harmonic polynomials that stand for the potential in the sphere: a field of blocks
at four times its radius has 2e-4 of itself beyond. Differences of the field over the sphere, which
follow it to degree 3, were off by 0.05 mm in a dipole of 24 cubes of 1 %, 18 error bars."""


def _stationary(
    field: Floats, columns: Floats, radius: float, origin: Floats, magnetizations: Gaussian
) -> tuple[tuple[float, ...], tuple[float, ...]] | tuple[()]:
    """Return the stationary point of the component along the field, and its standard deviations.

    Both are (3,) in m. They are empty if the point is not in the sphere of a ``radius`` in m about
    the ``origin``, on which B (26, 3) is given, or may be out of it by its standard deviations:
    farther away the field of a homogeneous magnet may be stationary anywhere. The curvatures count
    as those of the mean magnetizations. ``columns`` (26, 3, parameters) belong to B.
    """
    fit = np.linalg.pinv(solid_harmonic_fields(_ON_SPHERE, _DEGREES).reshape(field.size, -1))
    amplitudes = fit @ field.ravel()
    middle = solid_harmonic_fields(np.zeros((1, 3)), _DEGREES)[0] @ amplitudes
    direction = middle / np.linalg.norm(middle)
    near = 1e-3  # distance for differences of these polynomials, in radii

    def slopes(place: Floats) -> Floats:
        """Return the gradient (3, amplitudes) of the component, whose unit is the radius."""
        ends = solid_harmonic_fields(
            np.vstack([place + near * np.eye(3), place - near * np.eye(3)]), _DEGREES)
        along = np.einsum("pck,c->pk", ends, direction)
        return np.asarray((along[:3] - along[3:]) / (2 * near))

    small = 1e-12  # step in radii at which the search ends; it may begin where the slope is 0
    found = optimize.least_squares(
        lambda place: slopes(place) @ amplitudes / np.linalg.norm(amplitudes), np.zeros(3),
        xtol=small, ftol=small, gtol=small)
    if not found.success or np.linalg.norm(found.x) > 1:
        return ()
    changes = [slopes(found.x + near * axis) - slopes(found.x - near * axis) for axis in np.eye(3)]
    curvature = np.array([change @ amplitudes for change in changes]).T / (2 * near)
    rows = -np.linalg.solve(curvature, slopes(found.x) @ (fit @ columns.reshape(field.size, -1)))
    sd = magnetizations.sd_of(rows)
    if np.linalg.norm(sd) > 1:
        return ()
    return tuple((origin + radius * found.x).tolist()), tuple((radius * sd).tolist())
