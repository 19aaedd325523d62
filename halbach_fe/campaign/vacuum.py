"""The field of bodies in vacuum, by magpylib.

A body of remanence B_r and recoil permeability mu_r is taken for one of polarization B_r and
permeability 1, as if its material did not respond: with ``B = mu_0 mu_r H + B_r``, or
``M = B_r / (mu_0 mu_r)``, what the permeability adds is the rest (`halbach_fe.campaign.reaction`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.campaign.bodies import Body, Floats, Sector
from halbach_fe.campaign.extras import needed

LONG = 250.0
"""Length of what is infinite, over the distance of points and bodies from the axis. The ends add
1/length^2 of the field; from two lengths, this and its double, that is taken off, which leaves
1e-10 of the remanence, about magpylib's rounding for such bodies."""

Progress = Callable[[int, int], None]


def silent(done: int, total: int) -> None:
    """Show no progress."""


def vacuum_field(bodies: Sequence[Body], points: Floats, progress: Progress = silent) -> Floats:
    """B (n, 3) in T of bodies at points (n, 3) in m outside them.

    Infinite bodies give the field of a cross-section, whatever the z of the points.
    """
    total = np.zeros((len(points), 3))
    for number, body in enumerate(bodies):
        if np.isinf(body.shape.length):
            flat = points * [1, 1, 0]
            reach = max(np.abs(flat).max(), np.abs(body.centre).max())
            short, long = (_field(_finite(body, factor * LONG * reach), flat)
                           for factor in (1, 2))
            total += (4 * long - short) / 3 * [1, 1, 0]
        else:
            total += _field(body, points)
        progress(number + 1, len(bodies))
    return total


def _finite(body: Body, length: float) -> Body:
    return replace(body, shape=replace(body.shape, length=length))


def _field(body: Body, points: Floats) -> Floats:
    mesh = needed("magpylib").magnet.TriangularMesh
    field = np.zeros((len(points), 3))
    for source in _sources(body):
        # it need not look for points inside, which takes long and fails for slender bodies
        where = {"in_out": "outside"} if isinstance(source, mesh) else {}
        field += source.getB(points, squeeze=False, **where)[0, 0, 0]
    return field


def _sources(body: Body) -> Iterator[Any]:
    """A body's own magnet, and what its parts differ by."""
    remanence = np.array(body.remanence)
    yield _source(body, (0.0, 1.0), (-1.0, 1.0), remanence)
    for part in body.parts:
        yield _source(body, part.u, part.v, (part.factor - 1) * remanence)


def _source(
    body: Body, u: tuple[float, float], v: tuple[float, float], polarization: Floats
) -> Any:
    magnet, shape = needed("magpylib").magnet, body.shape
    place = {"position": body.position, "orientation": body.orientation}
    if isinstance(shape, Sector):
        radii, angles = shape.part(u, v)
        offset = body.orientation.apply([-shape.middle, 0, 0])
        return magnet.CylinderSegment(
            dimension=(*radii, shape.length, *np.degrees(angles)), polarization=polarization,
            position=body.position + offset, orientation=body.orientation)
    if shape.inner_width == shape.outer_width and (u, v) == ((0.0, 1.0), (-1.0, 1.0)):
        turn = Rotation.from_euler("z", shape.turn)
        return magnet.Cuboid(dimension=(shape.depth, shape.inner_width, shape.length),
                             polarization=turn.inv().apply(polarization),
                             position=body.position, orientation=body.orientation * turn)
    corners = shape.part(u, v)
    hull = [(x, y, z) for x, y in corners for z in (-shape.length / 2, shape.length / 2)]
    return magnet.TriangularMesh.from_ConvexHull(points=hull, polarization=polarization, **place)
