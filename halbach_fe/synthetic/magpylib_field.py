"""The field of bodies in vacuum, by magpylib.

A body of remanence B_r and recoil permeability mu_r follows ``B = mu_0 mu_r H + B_r``. Here it is
replaced by one of polarization B_r and permeability 1, as if its material did not respond to the
field. `halbach_fe.synthetic.ngsolve_reaction` adds the field of that response.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import CheckFailedError
from halbach_fe.synthetic.bodies import Body, SectorBody, Shape
from halbach_fe.synthetic.optional_packages import import_extra

LONG = 250.0
"""Length that stands for an infinite one, relative to the distance of the points from the middle.

The ends change the field by a term in 1/length^2. Extrapolation from this length and its double
removes that term; the remaining error is 1e-9 of the remanence, about magpylib's rounding error for
bodies of this length.
"""

SAME_PLACE = 10
"""Decimals of coordinates in m to which two points count as the same: 1e-10 m, or 1e-9 T."""

ASIDE = np.array([1e-8, 2e-8, 3e-8])
"""Displacement in m of points at which magpylib returns no finite field.

Its sectors do so at points some 1e-9 m from the plane of a face. The displacement changes the field
by at most 1e-7 T.
"""

AT_ONCE = 10_000
"""Number of points between two reports of progress."""

Progress = Callable[[int, int], None]
"""Function that is called with the amount of work done and its total."""

Fractions = tuple[float, float]
Piece = tuple[Shape, Fractions, Fractions]
"""A shape, and the fractions of its thickness and half width that limit a part of it.

See `halbach_fe.synthetic.bodies.BodyPart`.
"""

WHOLE: tuple[Fractions, Fractions] = ((0.0, 1.0), (-1.0, 1.0))


def no_progress(done: int, total: int) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class _Task:
    """A field to compute, and the bodies that use it.

    Attributes
    ----------
    piece : Piece
    polarizations : ndarray, shape (k, 3), in T
        Polarizations of the piece for which the field is computed.
    points : ndarray, shape (n, 3), in m
        Points in the piece's own axes.
    users : tuple
        For each body that uses the field: its number, the index of its points among ``points``,
        and its weights (k,) of the polarizations; None stands for a weight of 1.
    """

    piece: Piece
    polarizations: Floats
    points: Floats
    users: tuple[tuple[int, Any, Floats | None], ...]


def vacuum_field(
    bodies: Sequence[Body], points: Floats, progress: Progress = no_progress
) -> Floats:
    """Return B (n, 3) in T of bodies in vacuum, at points (n, 3) in m outside them.

    The field of infinite bodies is that of a cross-section and does not depend on the points' z.
    Bodies of the same shape share the computation at points that have the same coordinates in the
    axes of both, as many points of a map on circles have.
    """
    tasks = tasks_of(bodies, points)
    total = sum(len(task.points) * len(task.polarizations) for task in tasks)
    done, field = 0, np.zeros((len(points), 3))
    for task in tasks:
        columns = []
        for polarization in task.polarizations:
            parts = []
            for chunk in np.array_split(task.points, len(task.points) // AT_ONCE + 1):
                parts.append(_field(task.piece, polarization, chunk))
                done += len(chunk)
                progress(done, total)
            columns.append(np.vstack(parts))
        own = np.stack(columns, axis=2)
        for number, index, weights in task.users:
            body_field = own[index] @ (np.ones(1) if weights is None else weights)
            field += bodies[number].orientation.apply(body_field)
    return field


def tasks_of(bodies: Sequence[Body], points: Floats) -> list[_Task]:
    """Divide the computation of `vacuum_field` into tasks.

    Where pieces of the same shape share enough points, one task computes the fields of three unit
    polarizations for all of them; otherwise each piece has a task with its own polarization.
    """
    groups: dict[Piece, list[tuple[int, Floats]]] = {}
    for number, body in enumerate(bodies):
        remanence = np.array(body.remanence)
        groups.setdefault((body.shape, *WHOLE), []).append((number, remanence))
        for part in body.parts:  # deviation of the part from the body
            groups.setdefault((body.shape, part.u, part.v), []).append(
                (number, (part.factor - 1) * remanence))
    tasks = []
    for piece, members in groups.items():
        seen = [bodies[number].orientation.inv().apply(points - bodies[number].position)
                for number, _ in members]
        if np.isinf(piece[0].length):
            seen = [local * [1, 1, 0] for local in seen]
        together = np.vstack(seen)
        _, first, inverse = np.unique(together.round(SAME_PLACE), axis=0, return_index=True,
                                      return_inverse=True)
        if 3 * len(first) < len(together):
            places = inverse.reshape(len(members), len(points))
            tasks.append(_Task(piece, np.eye(3), together[first], tuple(
                (number, places[row], polarization)
                for row, (number, polarization) in enumerate(members))))
        else:
            tasks += [_Task(piece, polarization[None], local, ((number, slice(None), None),))
                      for (number, polarization), local in zip(members, seen, strict=True)]
    return tasks


def _field(piece: Piece, polarization: Floats, points: Floats) -> Floats:
    """Return B (n, 3) in T of a piece at points (n, 3) in m, both in its own axes.

    Raises
    ------
    CheckFailedError
        If magpylib returns no finite field at some of the points.
    """
    shape, u, v = piece
    if np.isinf(shape.length):
        length = LONG * max(np.abs(points).max(), _reach(shape))
        short, long = (_field((replace(shape, length=factor * length), u, v), polarization, points)
                       for factor in (1, 2))
        return (4 * long - short) / 3 * [1, 1, 0]
    source = _source(shape, u, v, polarization)
    # All points are outside. A test for points inside a mesh is slow, and wrong for slender bodies.
    mesh = isinstance(source, import_extra("magpylib").magnet.TriangularMesh)
    where = {"in_out": "outside"} if mesh else {}

    def field(at: Floats) -> Floats:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(source.getB(at, squeeze=False, **where)[0, 0, 0])

    found = field(points)
    lost = ~np.isfinite(found).all(axis=1)
    if lost.any():
        found[lost] = field(points[lost] + ASIDE)
    if not np.isfinite(found).all():
        raise CheckFailedError("magpylib returns no finite field at some of the points.")
    return found


def _reach(shape: Shape) -> float:
    """Return a length in m that is characteristic of the body's cross-section."""
    if isinstance(shape, SectorBody):
        return shape.outer - shape.inner
    return max(shape.depth, shape.outer_width)


def _source(shape: Shape, u: Fractions, v: Fractions, polarization: Floats) -> Any:
    """Return the magpylib source of a piece, in the piece's own axes."""
    magnet = import_extra("magpylib").magnet
    if isinstance(shape, SectorBody):
        radii, angles = shape.part(u, v)
        return magnet.CylinderSegment(
            dimension=(*radii, shape.length, *np.degrees(angles)), polarization=polarization,
            position=(-shape.middle, 0, 0))
    if shape.inner_width == shape.outer_width and (u, v) == WHOLE:
        turn = Rotation.from_euler("z", shape.turn)
        return magnet.Cuboid(dimension=(shape.depth, shape.inner_width, shape.length),
                             polarization=turn.inv().apply(polarization), orientation=turn)
    corners = shape.part(u, v)
    hull = [(x, y, z) for x, y in corners for z in (-shape.length / 2, shape.length / 2)]
    return magnet.TriangularMesh.from_ConvexHull(points=hull, polarization=polarization)
