"""The field of infinite bodies in vacuum, in closed form by complex line integrals.

With s = x + iy on the outline and the point z, the charge J . n of a uniform polarization J has the
field ``B_x - i B_y = 1/2pi int (J . n) dl / (z - s)``. Along an outline that runs counter-clockwise
``(J . n) dl = (conj(J) ds - J conj(ds)) / 2i``, and of the two terms the first is zero outside. On
a straight edge conj(ds) is ds times a constant. On an arc about c of radius R, ``conj(s - c) = R^2
/ (s - c)``. Both integrals are elementary.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.synthetic.shapes import CylinderBody, Fractions, SectorBody, Shape

Complex = NDArray[np.complex128]
Arc = tuple[complex, float, float, float]
"""Centre in m, radius in m, and angles in rad of start and end."""

SERIES_WITHIN = 0.5
"""Distance from the centre, relative to the radius, within which an arc's integral is a series.

The closed form loses two digits there, and all at the centre.
"""

SERIES_TERMS = 56
"""Number of terms: 0.5^56 is 1e-17."""


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
    y = z - centre
    first, last = radius * np.exp(1j * start), radius * np.exp(1j * end)
    result = np.empty(len(z), complex)
    near = np.abs(y) < SERIES_WITHIN * radius
    order = np.arange(2, SERIES_TERMS + 2)
    step = (last**-order.astype(float) - first**-order.astype(float)) / order
    result[near] = -radius**2 * np.polynomial.polynomial.polyval(y[near], step)
    y = y[~near]
    beyond = np.sign(end - start) * ((last - first).conjugate() * (y - first)).imag < 0
    log = np.log((y - last) / (y - first)) + 2j * np.pi * np.sign(end - start) * (
        beyond & (np.abs(y) < radius))
    result[~near] = -radius**2 * (
        (1 / first - 1 / last) / y + (1j * (end - start) - log) / y**2)
    return result
