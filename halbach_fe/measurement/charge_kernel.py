"""The field of magnetic charges at many points, compiled by numba.

A charge of amplitude a at the place c has the field ``a R / |R|^3`` at the distance R = x - c.
"""

from __future__ import annotations

from math import sqrt

from halbach_fe.core.arrays import Floats
from halbach_fe.core.threads import reordered


@reordered
def fields_along(points: Floats, directions: Floats, places: Floats, scale: float, first: int,
                 last: int, out: Floats) -> None:
    """Write the component along ``directions`` (n, 3) of the field of every charge.

    ``out`` (n, k or more) is at points ``first`` to ``last`` of (n, 3) in m, for charges at
    ``places`` (k, 3) in m whose amplitude is ``scale``.
    """
    px, py, pz = places[:, 0].copy(), places[:, 1].copy(), places[:, 2].copy()
    for n in range(first, last):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        u, v, w = scale * directions[n, 0], scale * directions[n, 1], scale * directions[n, 2]
        row = out[n]
        for k in range(len(px)):
            x, y, z = a - px[k], b - py[k], c - pz[k]
            square = x * x + y * y + z * z
            row[k] = (x * u + y * v + z * w) / (square * sqrt(square))


@reordered
def field(points: Floats, places: Floats, amplitudes: Floats, first: int, last: int,
          out: Floats) -> None:
    """Write the field (n, 3) of all charges at points ``first`` to ``last``."""
    for n in range(first, last):
        bx = by = bz = 0.0
        for k in range(len(places)):
            x, y, z = (points[n, 0] - places[k, 0], points[n, 1] - places[k, 1],
                       points[n, 2] - places[k, 2])
            square = x * x + y * y + z * z
            weight = amplitudes[k] / (square * sqrt(square))
            bx += weight * x
            by += weight * y
            bz += weight * z
        out[n, 0], out[n, 1], out[n, 2] = bx, by, bz


@reordered
def gradient(points: Floats, places: Floats, amplitudes: Floats, first: int, last: int,
             out: Floats) -> None:
    """Write the gradient (n, 3, 3) of the field of all charges at points ``first`` to ``last``."""
    for n in range(first, last):
        xx = yy = xy = xz = yz = 0.0
        for k in range(len(places)):
            x, y, z = (points[n, 0] - places[k, 0], points[n, 1] - places[k, 1],
                       points[n, 2] - places[k, 2])
            square = x * x + y * y + z * z
            weight = amplitudes[k] / (square * sqrt(square))
            more = 3 * weight / square
            xx += weight - more * x * x
            yy += weight - more * y * y
            xy -= more * x * y
            xz -= more * x * z
            yz -= more * y * z
        out[n, 0, 0], out[n, 1, 1], out[n, 2, 2] = xx, yy, -xx - yy
        out[n, 0, 1] = out[n, 1, 0] = xy
        out[n, 0, 2] = out[n, 2, 0] = xz
        out[n, 1, 2] = out[n, 2, 1] = yz
