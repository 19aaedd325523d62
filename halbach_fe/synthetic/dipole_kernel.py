"""The field of many dipoles at many points, compiled by numba.

Source: J. D. Jackson, Classical Electrodynamics, 3rd ed., equation 5.56; in two dimensions the same
integrated along z.
"""

from __future__ import annotations

from math import sqrt

from halbach_fe.core.arrays import Floats
from halbach_fe.core.threads import reordered


@reordered
def field_2d(points: Floats, places: Floats, moments: Floats, first: int, last: int,
             out: Floats) -> None:
    """Write 2 pi B (n, 2) of lines of dipoles at points ``first`` to ``last`` of (n, 2) in m.

    ``places`` (2, m) in m and ``moments`` (2, m) have a row per axis.
    """
    for n in range(first, last):
        bx = by = 0.0
        for k in range(places.shape[1]):
            x, y = points[n, 0] - places[0, k], points[n, 1] - places[1, k]
            inverse = 1 / (x * x + y * y)
            along = 2 * (x * moments[0, k] + y * moments[1, k]) * inverse
            bx += (along * x - moments[0, k]) * inverse
            by += (along * y - moments[1, k]) * inverse
        out[n, 0], out[n, 1] = bx, by


@reordered
def field_3d(points: Floats, places: Floats, moments: Floats, first: int, last: int,
             out: Floats) -> None:
    """Write 4 pi B (n, 3) of dipoles at points ``first`` to ``last`` of (n, 3) in m.

    ``places`` (3, m) in m and ``moments`` (3, m) have a row per axis.
    """
    for n in range(first, last):
        bx = by = bz = 0.0
        for k in range(places.shape[1]):
            x, y, z = (points[n, 0] - places[0, k], points[n, 1] - places[1, k],
                       points[n, 2] - places[2, k])
            square = 1 / (x * x + y * y + z * z)
            cube = square * sqrt(square)
            along = 3 * square * (x * moments[0, k] + y * moments[1, k] + z * moments[2, k])
            bx += (along * x - moments[0, k]) * cube
            by += (along * y - moments[1, k]) * cube
            bz += (along * z - moments[2, k]) * cube
        out[n, 0], out[n, 1], out[n, 2] = bx, by, bz
