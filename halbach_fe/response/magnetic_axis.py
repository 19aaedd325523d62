"""Magnetic centre, axis and roll of a magnet, with standard deviations.

**Roll**: the angle by which the main multipole of order N is turned about z from that of the
nominal magnet. A turn by theta multiplies C_N by exp(-i N theta), see
`halbach_fe.response.multipoles`.

**Centre**, N >= 2: where the multipole of order N - 1 vanishes. A multipole of order N about
(x0, y0) has at the origin, by feed-down, ``C_(N-1) = -(N - 1) C_N (x0 + i y0) / R``.

**Axis**, N >= 2: the straight line along z through the centres at several heights, by least
squares. Its point at z = 0 is the centre of a 3D magnet.

**Centre**, N = 1, in 3D: the stationary point of the component along the field, where its gradient
vanishes: that is where a homogeneous magnet is most homogeneous. It is a saddle point, since the
component is harmonic. The axis of a dipole is not defined.

The field is linear in the magnetizations, as in `halbach_fe.response.matrix`: permeable blocks and
iron answer to deviations too. (Of an iron tube close to the blocks, that is a quarter of a roll.)
With non-linear iron the field is that of the updated magnet, which is solved for, and standard
deviations are those of the blocks in vacuum: columns of all blocks take as long as an update.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import flux_density_at
from halbach_fe.response.block_variation import distribution_of
from halbach_fe.response.deviation_field import Deviations, with_magnetizations
from halbach_fe.response.matrix import response_matrix
from halbach_fe.response.multipoles import NOTHING_THERE, Complexes
from halbach_fe.solver.formulation_choice import solve_nominal
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
        x and y, of a dipole in 3D x, y and z; None if no centre is defined.
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
    distribution_of(magnet, magnetizations, "magnetizations")
    flat, order, bore = magnet.dimension == 2, magnet.array.multipole_order, magnet.bore_radius
    radius = RADIUS * bore
    reach = 0.0 if flat else LENGTH * magnet.array_half_length
    heights = np.zeros(1) if flat else np.linspace(-reach, reach, HEIGHTS)
    count = 2 * (order + 2)
    angles = 2 * np.pi * np.arange(count) / count
    circle = radius * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    around = (circle + heights[:, None, None] * [0, 0, 1.0]).reshape(-1, 3)
    # distance of the points from which gradient and curvatures of a dipole's field follow, relative
    # to the radius of the bore
    step_share = 1 / 4
    cross = np.vstack([np.zeros(3), *(sign * step_share * bore * unit for unit in _DIRECTIONS
                                      for sign in (1, -1))])
    points = np.vstack([around, cross]) if order == 1 and not flat else around
    if magnet.contains(points).any():  # something stands in the bore
        return None
    size = magnet.dimension
    field, nominal, columns = (
        values[:, :size] for values in _fields(magnet, points, session, magnetizations.mean))
    on_circles = slice(0, len(around))

    def multipole(number: int, values: Floats) -> Complexes:
        """Return C (heights, ...) of an order from values (points, 2 or 3, ...) of the field."""
        parts = values[on_circles].reshape(len(heights), count, size, *values.shape[2:])
        wave = np.exp(-1j * (number - 1) * angles) / count
        return np.einsum("hp...,p->h...", parts[:, :, 1] + 1j * parts[:, :, 0], wave)

    main, root = multipole(order, field), multipole(order, columns)
    was = multipole(order, nominal)
    if not np.abs(was).max() > NOTHING_THERE * np.abs(root).sum(axis=1).max() * np.abs(
            magnet.nominal_magnetization).max():
        return None
    # weighted by the nominal field, which turns along no z of a magnet whose blocks are in place
    total = np.conj(was) @ main
    roll = float(-np.angle(total)) / order
    roll_row = -(np.conj(total) * (np.conj(was) @ root)).imag / abs(total)**2 / order
    roll_sd = float(magnetizations.sd_of(roll_row[None])[0])
    if order == 1:
        if flat:
            return MagneticAxis(order, roll, roll_sd)
        centre = _stationary(field[len(around):], columns[len(around):], step_share * bore,
                             magnetizations)
        return MagneticAxis(order, roll, roll_sd, *centre)
    below, below_root = multipole(order - 1, field), multipole(order - 1, columns)
    scale = -radius / (order - 1)
    places = scale * below / main  # x0 + i y0 at each height
    place_rows = scale * (below_root - (below / main)[:, None] * root) / main[:, None]
    design = np.column_stack([np.ones_like(heights), heights])[:, :1 if flat else 2]
    fit = np.linalg.pinv(design)
    line = fit @ places
    rows = fit @ place_rows

    def both(number: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        sd = magnetizations.sd_of(np.vstack([rows[number].real, rows[number].imag]))
        return (float(line[number].real), float(line[number].imag)), tuple(sd.tolist())

    return MagneticAxis(order, roll, roll_sd, *both(0), *(() if flat else both(1)))


def _fields(
    magnet: Magnet, points: Floats, session: Session, mean: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return B at points (n, 3) in m with the magnetizations ``mean`` in A/m, and with the nominal
    ones, (n, 3) in T, and the derivative (n, 3, parameters) of the former.
    """
    own = session.within("axis")
    if magnet.is_nonlinear:
        uniform = mean[:len(magnet.parameter_names)]
        updated = Magnet(magnet.study, with_magnetizations(magnet, uniform))
        nominal = solve_nominal(magnet, points, own.within("nominal"))
        field = solve_nominal(updated, points, own.within("updated"))
        columns = Deviations.of(magnet).columns(points).reshape(len(points), 3, -1)
        inside = columns[..., len(uniform):] @ mean[len(uniform):]  # variations inside blocks
        return field + inside, nominal, columns
    response = response_matrix(magnet, flux_density_at(points), own)
    columns, external = (values.reshape(len(points), 3, *values.shape[1:])
                         for values in (response.whole, response.offset))
    return columns @ mean + external, columns @ response.nominal + external, columns


_DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1]], float)
"""Directions along which differences give gradient and curvatures."""


def _stationary(
    field: Floats, columns: Floats, step: float, magnetizations: Gaussian
) -> tuple[tuple[float, ...], tuple[float, ...]] | tuple[()]:
    """Return the stationary point of the component along the field, and its standard deviations.

    Both are (3,) in m. They are empty if the point is too far away. The quadratic part of the
    field, from B (13, 3) at the middle and a step in m to both sides along each of `_DIRECTIONS`,
    counts as that of the mean magnetizations. ``columns`` (13, 3, parameters) belong to B.
    """
    direction = field[0] / np.linalg.norm(field[0])
    along, rows = field @ direction, np.einsum("pcm,c->pm", columns, direction)
    plus, minus = along[1::2], along[2::2]
    gradient = (plus - minus)[:3] / (2 * step)
    second = (plus + minus - 2 * along[0]) / step**2
    curvature = np.diag(second[:3])
    for number, (one, other) in zip((3, 4, 5), ((0, 1), (0, 2), (1, 2)), strict=True):
        mixed = (second[number] - second[one] - second[other]) / 2
        curvature[one, other] = curvature[other, one] = mixed
    inverse = np.linalg.pinv(curvature)
    place = -inverse @ gradient
    # farthest stationary point of a dipole's field that counts, in steps from the middle. Farther
    # away the field has other curvatures; that of a homogeneous magnet may be anywhere.
    most_steps = 1
    if not np.linalg.norm(place) <= most_steps * step:
        return ()
    gradient_rows = (rows[1::2] - rows[2::2])[:3] / (2 * step)
    return (tuple(place.tolist()),
            tuple(magnetizations.sd_of(-inverse @ gradient_rows).tolist()))
