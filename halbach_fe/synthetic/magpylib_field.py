"""The field of bodies in vacuum, by magpylib.

A body of remanence B_r and recoil permeability mu_r is taken for one of polarization B_r and
permeability 1, as if its material did not respond: with ``B = mu_0 mu_r H + B_r``, or
``M = B_r / (mu_0 mu_r)``, what the permeability adds is the rest
(`halbach_fe.synthetic.ngsolve_reaction`).
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
from halbach_fe.synthetic.extras import needed

LONG = 250.0
"""Length of what is infinite, over the distance of points from its middle. The ends add 1/length^2
of the field; from two lengths, this and its double, that is taken off, which leaves 1e-9 of the
remanence, about magpylib's rounding for such bodies."""

SAME_PLACE = 10
"""Digits, in m, to which points are in the same place of two bodies: 1e-10 m, or 1e-9 T."""

ASIDE = np.array([1e-8, 2e-8, 3e-8])
"""Where the field is taken instead, in m, at points 1e-9 m and the like from the plane of a face,
for which magpylib's sectors have no number; that is 1e-7 T off at most."""

AT_ONCE = 10_000  # points between two signs of progress

Progress = Callable[[int, int], None]
Fractions = tuple[float, float]
Piece = tuple[Shape, Fractions, Fractions]
"""A shape, and the part of it between fractions of its thickness and of its half width."""

WHOLE: tuple[Fractions, Fractions] = ((0.0, 1.0), (-1.0, 1.0))


def silent(done: int, total: int) -> None:
    """Show no progress."""


@dataclass(frozen=True)
class _Task:
    """Field of a piece of some polarizations (k, 3) in T at points (n, 3) in its own axes, and what
    is made of it: for each body its number, the index of its points, and its own polarization.
    """

    piece: Piece
    polarizations: Floats
    points: Floats
    users: tuple[tuple[int, Any, Floats | None], ...]


def vacuum_field(bodies: Sequence[Body], points: Floats, progress: Progress = silent) -> Floats:
    """B (n, 3) in T of bodies at points (n, 3) in m outside them.

    Infinite bodies give the field of a cross-section, whatever the z of the points. Bodies that are
    alike and see points from the same places share the work: of a map on circles many do.
    """
    tasks = tasks_of(bodies, points)
    total = sum(len(task.points) * len(task.polarizations) for task in tasks)
    done, field = 0, np.zeros((len(points), 3))
    for task in tasks:
        columns = []
        for polarization in task.polarizations:
            parts = []
            for some in np.array_split(task.points, len(task.points) // AT_ONCE + 1):
                parts.append(_field(task.piece, polarization, some))
                done += len(some)
                progress(done, total)
            columns.append(np.vstack(parts))
        own = np.stack(columns, axis=2)
        for number, index, weights in task.users:
            one = own[index] @ (np.ones(1) if weights is None else weights)
            field += bodies[number].orientation.apply(one)
    return field


def tasks_of(bodies: Sequence[Body], points: Floats) -> list[_Task]:
    """What is to be computed: unit fields where bodies share enough of the points, else each body's
    own.
    """
    groups: dict[Piece, list[tuple[int, Floats]]] = {}
    for number, body in enumerate(bodies):
        remanence = np.array(body.remanence)
        groups.setdefault((body.shape, *WHOLE), []).append((number, remanence))
        for part in body.parts:  # what it differs by
            groups.setdefault((body.shape, part.u, part.v), []).append(
                (number, (part.factor - 1) * remanence))
    tasks = []
    for piece, members in groups.items():
        seen = [bodies[number].orientation.inv().apply(points - bodies[number].position)
                for number, _ in members]
        if np.isinf(piece[0].length):
            seen = [one * [1, 1, 0] for one in seen]
        together = np.vstack(seen)
        _, first, inverse = np.unique(together.round(SAME_PLACE), axis=0, return_index=True,
                                      return_inverse=True)
        if 3 * len(first) < len(together):
            places = inverse.reshape(len(members), len(points))
            tasks.append(_Task(piece, np.eye(3), together[first], tuple(
                (number, places[row], polarization)
                for row, (number, polarization) in enumerate(members))))
        else:
            tasks += [_Task(piece, polarization[None], one, ((number, slice(None), None),))
                      for (number, polarization), one in zip(members, seen, strict=True)]
    return tasks


def _field(piece: Piece, polarization: Floats, points: Floats) -> Floats:
    """B (n, 3) in T of a piece at points (n, 3) in m, in its own axes."""
    shape, u, v = piece
    if np.isinf(shape.length):
        length = LONG * max(np.abs(points).max(), _reach(shape))
        short, long = (_field((replace(shape, length=factor * length), u, v), polarization, points)
                       for factor in (1, 2))
        return (4 * long - short) / 3 * [1, 1, 0]
    source = _source(shape, u, v, polarization)
    # a mesh need not look for points inside, which takes long and fails for slender bodies
    mesh = isinstance(source, needed("magpylib").magnet.TriangularMesh)
    where = {"in_out": "outside"} if mesh else {}

    def field(at: Floats) -> Floats:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(source.getB(at, squeeze=False, **where)[0, 0, 0])

    found = field(points)
    lost = ~np.isfinite(found).all(axis=1)
    if lost.any():
        found[lost] = field(points[lost] + ASIDE)
    if not np.isfinite(found).all():
        raise CheckFailedError("magpylib gives no field at some of the points.")
    return found


def _reach(shape: Shape) -> float:
    """A length of the size of the body."""
    if isinstance(shape, SectorBody):
        return shape.outer - shape.inner
    return max(shape.depth, shape.outer_width)


def _source(shape: Shape, u: Fractions, v: Fractions, polarization: Floats) -> Any:
    magnet = needed("magpylib").magnet
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
