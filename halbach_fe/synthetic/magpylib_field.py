"""The field of bodies in vacuum, by magpylib in three dimensions and in closed form in two.

A body of remanence B_r and recoil permeability mu_r follows ``B = mu_0 mu_r H + B_r``. Here it is
replaced by one of polarization B_r and permeability 1, as if its material did not respond to the
field. `halbach_fe.synthetic.reaction` adds the field of that response. All fields are mu_0 H, which
is B outside bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, slices
from halbach_fe.core.errors import CheckFailedError
from halbach_fe.core.installation import import_extra
from halbach_fe.core.progress import Progress
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.shapes import (
    CylinderBody,
    Fractions,
    PrismBody,
    SectorBody,
    Shape,
    triangulated,
)
from halbach_fe.synthetic.true_magnet import Body

Complex = NDArray[np.complex128]
Arc = tuple[complex, float, float, float]
"""Centre in m, radius in m, and angles in rad of start and end."""


def plane_field(
    shape: Shape, u: Fractions, v: Fractions, polarization: Floats, points: Floats
) -> Floats:
    """Return B (n, 3) in T of a part of an infinite body, at points (n, 3) in m outside it.

    All is in the shape's own axes; ``u`` and ``v`` are those of `SectorBody.part`.
    """
    z = points[:, 0] + 1j * points[:, 1]
    own = complex(polarization[0], polarization[1])
    total = np.zeros(len(z), complex)
    for edge in _edges(shape, u, v):
        total += _arc(*edge, z) if len(edge) == 4 else _straight(*edge, z)
    conjugate = 1j * own / (4 * np.pi) * total
    return np.column_stack([conjugate.real, -conjugate.imag, np.zeros(len(z))])


def _edges(
    shape: Shape, u: Fractions, v: Fractions
) -> Iterator[tuple[complex, complex] | Arc]:
    """Yield the edges of a part's outline, counter-clockwise."""
    if isinstance(shape, CylinderBody):
        for quarter in range(4):
            yield 0j, shape.radius, np.pi / 2 * quarter, np.pi / 2 * (quarter + 1)
    elif isinstance(shape, SectorBody):
        (inner, outer), (start, stop) = shape.part(u, v)
        centre = complex(-shape.middle)
        angles = np.linspace(start, stop, int(np.ceil((stop - start) / (np.pi / 2))) + 1)
        for first, last in pairwise(angles.tolist()):
            yield centre, float(outer), first, last
            yield centre, float(inner), last, first
        for radii, angle in (((inner, outer), start), ((outer, inner), stop)):
            first, last = (complex(centre + radius * np.exp(1j * angle)) for radius in radii)
            yield first, last
    else:
        corners = [complex(*corner) for corner in shape.part(u, v)]
        yield from zip(corners, [*corners[1:], corners[0]], strict=True)


def _straight(start: complex, end: complex, z: Complex) -> Complex:
    """Return the integral of conj(ds) / (z - s) along a straight edge."""
    along = end - start
    return np.asarray(-along.conjugate() / along * np.log((z - end) / (z - start)))


def _arc(centre: complex, radius: float, start: float, end: float, z: Complex) -> Complex:
    """Return the same along an arc of at most a quarter turn.

    The logarithm follows the chord. Between chord and arc the arc passes on the other side of the
    point, which makes a difference of a full turn.
    """
    series_terms = 56  # number of terms: 0.5^56 is 1e-17
    # Distance from the centre, relative to the radius, within which an arc's integral is a series.
    # The closed form loses two digits there, and all at the centre.
    series_within = 0.5
    y = z - centre
    first, last = radius * np.exp(1j * start), radius * np.exp(1j * end)
    result = np.empty(len(z), complex)
    near = np.abs(y) < series_within * radius
    order = np.arange(2, series_terms + 2)
    step = (last**-order.astype(float) - first**-order.astype(float)) / order
    result[near] = -radius**2 * np.polynomial.polynomial.polyval(y[near], step)
    y = y[~near]
    beyond = np.sign(end - start) * ((last - first).conjugate() * (y - first)).imag < 0
    log = np.log((y - last) / (y - first)) + 2j * np.pi * np.sign(end - start) * (
        beyond & (np.abs(y) < radius))
    result[~near] = -radius**2 * (
        (1 / first - 1 / last) / y + (1j * (end - start) - log) / y**2)
    return result


ASIDE = np.array([1e-8, 2e-8, 3e-8])
"""Displacement in m of points at which magpylib returns no finite field.

Its sectors do so at points some 1e-9 m from the plane of a face. The displacement changes the field
by at most 1e-7 T.
"""

AT_ONCE = 10_000
"""Number of points for which magpylib is called at once."""

Piece = tuple[Shape, Fractions, Fractions]
"""A shape, and the fractions of its thickness and half width that limit a part of it.

See `halbach_fe.synthetic.true_magnet.BodyPart`.
"""

WHOLE: tuple[Fractions, Fractions] = ((0.0, 1.0), (-1.0, 1.0))


def no_progress(done: int, total: int) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class _Task:
    """A field to compute, and the bodies that use it."""

    piece: Piece
    polarizations: Floats
    """Polarizations of the piece for which the field is computed. Shape (k, 3), in T."""
    points: Floats
    """Points in the piece's own axes. Shape (n, 3), in m."""
    users: tuple[tuple[int, Any, Floats | None], ...]
    """For each body that uses the field: its number, the index of its points among ``points``, and
    its weights (k,) of the polarizations; None stands for a weight of 1."""


def vacuum_field(
    bodies: Sequence[Body], points: Floats, progress: Progress = no_progress
) -> Floats:
    """Return mu_0 H (n, 3) in T of bodies in vacuum, at points (n, 3) in m; it is B outside them.

    The field of infinite bodies is that of a cross-section and does not depend on the points' z.
    Bodies of the same shape share the computation at points that have the same coordinates in the
    axes of both, as many points of a map on circles have.
    """
    total = sum(1 + len(body.parts) for body in bodies) * len(points)
    done, field = 0, np.zeros((len(points), 3))
    for task in tasks_of(bodies, points):
        own = np.stack([piece_field(task.piece, polarization, task.points)
                        for polarization in task.polarizations], axis=2)
        for number, index, weights in task.users:
            body_field = own[index] @ (np.ones(1) if weights is None else weights)
            field += body_field @ bodies[number].shape_orientation.as_matrix().T
        done += len(task.users) * len(points)
        progress(done, total)
    return field


def tasks_of(bodies: Sequence[Body], points: Floats) -> Iterator[_Task]:
    """Divide the computation of `vacuum_field` into tasks.

    Where pieces of the same shape share enough points, one task computes the fields of three unit
    polarizations for all of them; otherwise each piece has a task with its own polarization.
    """
    # Largest number of bodies times points that are searched for equal positions: 24 MB.
    searched = 1_000_000
    if not len(points):
        return
    groups: dict[Piece, list[tuple[int, Floats]]] = {}
    for number, body in enumerate(bodies):
        remanence = body.seat_orientation.inv().apply(body.remanence)
        groups.setdefault((body.shape, *WHOLE), []).append((number, remanence))
        for part in body.parts:  # deviation of the part from the body
            groups.setdefault((body.shape, part.u, part.v), []).append(
                (number, (part.factor - 1) * remanence))
    at_once = max(1, searched // len(points))
    for piece, members in groups.items():
        for some in slices(len(members), at_once):
            yield from _tasks(piece, members[some], bodies, points)


def _tasks(
    piece: Piece, members: list[tuple[int, Floats]], bodies: Sequence[Body], points: Floats
) -> Iterator[_Task]:
    """Yield the tasks of some pieces of the same shape, see `tasks_of`."""
    seen = [bodies[number].in_shape(points) for number, _ in members]
    if np.isinf(piece[0].length):
        seen = [local * [1, 1, 0] for local in seen]
    if len(members) > 3:
        together = np.vstack(seen)
        # decimals of coordinates in m to which two points count as the same: 1e-10 m, or 1e-9 T
        digits = 10
        # one number for a place: many times faster than np.unique of rows
        places = together.round(digits) @ np.array([1.0, np.sqrt(2.0), np.sqrt(3.0)])
        _, first, inverse = np.unique(places.round(digits), return_index=True,
                                      return_inverse=True)
        if 3 * len(first) < len(together) and np.allclose(
                together[first][inverse], together, rtol=0, atol=10 * 10.0**-digits):
            rows = inverse.reshape(len(members), len(points))
            yield _Task(piece, np.eye(3), together[first], tuple(
                (number, rows[row], polarization)
                for row, (number, polarization) in enumerate(members)))
            return
    for (number, polarization), local in zip(members, seen, strict=True):
        yield _Task(piece, polarization[None], local, ((number, slice(None), None),))


def unit_fields(body: Body, points: Floats) -> Floats:
    """Return mu_0 H (n, 3, 3) in T of a body without its parts per T of uniform polarization.

    The last index is the direction of the polarization. Points (n, 3) in m, inside or outside, and
    directions are along the magnet's axes.
    """
    turn = body.shape_orientation.as_matrix()
    local = body.in_shape(points)
    own = np.stack([piece_field((body.shape, *WHOLE), axis, local) for axis in np.eye(3)], axis=2)
    return np.asarray(turn @ own @ turn.T)


def piece_field(piece: Piece, polarization: Floats, points: Floats) -> Floats:
    """Return mu_0 H (n, 3) in T of a piece at points (n, 3) in m, both in its own axes.

    Raises
    ------
    CheckFailedError
        If magpylib returns no finite field at some of the points.
    """
    if not np.any(polarization):
        return np.zeros((len(points), 3))
    if np.isinf(piece[0].length):
        return plane_field(*piece, polarization, points)
    compute = _computation(piece, polarization)

    def field(at: Floats) -> Floats:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.vstack([compute(chunk)
                              for chunk in np.array_split(at, len(at) // AT_ONCE + 1)])

    found = field(points)
    lost = ~np.isfinite(found).all(axis=1)
    if lost.any():
        found[lost] = field(points[lost] + ASIDE)
    if not np.isfinite(found).all():
        raise CheckFailedError("magpylib returns no finite field at some of the points.")
    return found


def _computation(piece: Piece, polarization: Floats) -> Callable[[Floats], Floats]:
    """Return the function that computes the field of a piece of finite length."""
    shape, u, v = piece
    magnet = import_extra("magpylib").magnet
    if isinstance(shape, SectorBody):
        radii, angles = shape.part(u, v)
        return _of_segment(_of_source(magnet.CylinderSegment(
            dimension=(*radii, shape.length, *np.degrees(angles)), polarization=polarization,
            position=(-shape.middle, 0, 0))), shape)
    if isinstance(shape, CylinderBody):
        return _of_source(magnet.Cylinder(dimension=(2 * shape.radius, shape.length),
                                          polarization=polarization))
    if isinstance(shape, PrismBody) and shape.is_cuboid and (
            u, v) == WHOLE:
        turn = Rotation.from_euler("z", shape.turn)
        return _of_source(magnet.Cuboid(
            dimension=(shape.depth, shape.inner_width, shape.length),
            polarization=turn.inv().apply(polarization), orientation=turn))
    triangles = _surface(shape.part(u, v), shape.length)
    core = import_extra("magpylib.core")

    def charged(points: Floats) -> Floats:
        total = np.zeros((len(points), 3))
        for triangle in triangles:
            total += core.triangle_Bfield(
                points, np.broadcast_to(triangle, (len(points), 3, 3)),
                np.broadcast_to(polarization, (len(points), 3)))
        return total

    return charged


def _of_segment(
    compute: Callable[[Floats], Floats], shape: SectorBody
) -> Callable[[Floats], Floats]:
    """Return the function that gives the field of a segment at points of its axis and near it, too.

    At a ten-thousandth of its radius from the axis of its surfaces magpylib loses up to all digits
    (12 % at 10 um from the axis of a bore of 92 mm), and none on it. Between the axis and a
    thousandth of the radius the field is interpolated, which leaves 1e-7 of it.
    """
    axis, near = np.array([-shape.middle, 0.0]), 1e-3 * shape.inner

    def field(points: Floats) -> Floats:
        found, away = compute(points), points[:, :2] - axis
        distance = np.linalg.norm(away, axis=1)
        rows = (distance > 0) & (distance < near)
        if rows.any():
            on_axis, beside = points[rows], points[rows]
            on_axis[:, :2] = axis
            beside[:, :2] = axis + away[rows] * near / distance[rows, None]
            share = (distance[rows] / near)[:, None]
            found[rows] = (1 - share) * compute(on_axis) + share * compute(beside)
        return found

    return field


def _of_source(source: Any) -> Callable[[Floats], Floats]:
    """Return the function that gives mu_0 H of a magpylib source."""
    return lambda points: MU_0 * np.asarray(source.getH(points, squeeze=False)[0, 0, 0])


def _surface(corners: Floats, length: float) -> Floats:
    """Return the triangles (n, 3, 3) in m of a prism's surface, their normals outward."""
    half = length / 2

    def at(corner: complex, z: float) -> tuple[float, float, float]:
        return corner.real, corner.imag, z

    outline = tuple(complex(x, y) for x, y in corners)
    found = []
    for a, b, c in triangulated(outline):
        found += [[at(a, half), at(b, half), at(c, half)], [at(a, -half), at(c, -half),
                                                            at(b, -half)]]
    for a, b in zip(outline, outline[1:] + outline[:1], strict=True):
        found += [[at(a, -half), at(b, -half), at(b, half)], [at(a, -half), at(b, half),
                                                              at(a, half)]]
    return np.array(found)
