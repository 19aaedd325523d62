"""Closed-form field of uniformly polarized prisms, compiled by numba.

A prism stands on a polygon in the (x, y) plane of its frame, between two values of z. Its field is
the sum of line integrals over the polygon that the docstring of
`halbach_fe.solver.exact_block_field` derives. On a straight edge they are elementary. Let d be the
signed distance of the edge from the point along its outward normal, s the position along the edge
relative to the point, u = z - z' and R^2 = s^2 + d^2 + u^2. Then

* ``int ds/R = ln(s + R)``,
* ``int u d ds/((s^2 + d^2) R) = atan(s u/(d R))``,
* ``int u s ds/((s^2 + d^2) R) = ln((R - u)/(R + u))/2``,

and the solid angle of an end face is the sum over its edges of ``atan(s/d) - atan(s u/(d R))``.
The differences between the ends of an edge and between the end faces are formed inside the
logarithms, so that nothing cancels and nothing is singular on the prolongations of edges. On a
face the result is the mean of the limits from both sides; on an edge, where the field is
infinite, it is large and finite.

The six independent components of the symmetric field matrix are in the order xx, yy, zz, xy, xz,
yz: mu_0 H in T for a polarization of 1 T.

This module imports numba, which takes a second; functions that need it import it themselves.
"""

from __future__ import annotations

from math import atan2, log, pi, sqrt
from typing import Any

import numba

from halbach_fe.core.arrays import Floats

compiled: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
"""Decorator of all compiled functions. Threads run them side by side, since they release the GIL;
numba's own threads must not be entered from several Python threads."""

reordered: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
"""The same for sums whose terms may be added in any order, several at a time."""

_TINY = 1e-26
"""Added to squared distances relative to the square of a prism's size, where a logarithm would be
infinite otherwise. It is the square of 1e-13 of the size, which is below rounding."""

Six = tuple[float, float, float, float, float, float]


@compiled
def _angle(s1: float, r1: float, s2: float, r2: float, u: float, d: float) -> float:
    """Return ``[atan(s u/(d R))]`` between two ends of an edge, for d > 0."""
    return atan2(u * d * (s2 * r1 - s1 * r2), d * d * r1 * r2 + s1 * s2 * u * u)


@compiled
def polygon_field(
    vertices: Floats, half: float, x: float, y: float, z: float
) -> Six:
    """Return the field matrix of a prism on a polygon, between z = -half and z = half.

    Parameters
    ----------
    vertices : ndarray, shape (m, 2), in m
        Counter-clockwise. Edges of length zero are ignored.
    half : float, in m
    x, y, z : float, in m
        The point, in the prism's frame.
    """
    up, low = z - half, z + half
    up2, low2 = up * up, low * low
    sign = (1.0 if up > 0 else (-1.0 if up < 0 else 0.0)) - (
        1.0 if low > 0 else (-1.0 if low < 0 else 0.0))
    size2 = half * half
    for i in range(len(vertices)):
        size2 = max(size2, vertices[i, 0] ** 2 + vertices[i, 1] ** 2)
    tiny = _TINY * size2
    xx = yy = zz = xy = xz = yz = 0.0
    last = len(vertices) - 1
    bx, by = vertices[last, 0] - x, vertices[last, 1] - y
    b2 = bx * bx + by * by
    bup, blow = sqrt(b2 + up2 + tiny), sqrt(b2 + low2 + tiny)
    for i in range(len(vertices)):
        ax, ay, a2, aup, alow = bx, by, b2, bup, blow
        bx, by = vertices[i, 0] - x, vertices[i, 1] - y
        b2 = bx * bx + by * by
        bup, blow = sqrt(b2 + up2 + tiny), sqrt(b2 + low2 + tiny)
        length = sqrt((bx - ax) ** 2 + (by - ay) ** 2)
        if length < 1e-12 * sqrt(size2):
            continue
        tx, ty = (bx - ax) / length, (by - ay) / length
        nx, ny = ty, -tx
        d = ax * nx + ay * ny
        s1, s2 = ax * tx + ay * ty, bx * tx + by * ty
        # int ds/R at the upper minus that at the lower face
        if s1 >= 0:
            along = log((s2 + bup) * (s1 + alow) / ((s1 + aup) * (s2 + blow)))
        elif s2 <= 0:
            along = log((aup - s1) * (blow - s2) / ((bup - s2) * (alow - s1)))
        else:
            along = log((s2 + bup) * (aup - s1) * (d * d + low2 + tiny)
                        / ((s2 + blow) * (alow - s1) * (d * d + up2 + tiny)))
        # int u s ds/((s^2 + d^2) R), likewise
        if up > 0:
            tangential = log((blow + low) * (aup + up) / ((bup + up) * (alow + low)))
        elif low < 0:
            tangential = log((bup - up) * (alow - low) / ((blow - low) * (aup - up)))
        else:
            tangential = log((bup - up) * (blow + low) * (a2 + tiny)
                             / ((aup - up) * (alow + low) * (b2 + tiny)))
        normal = subtended = 0.0
        distance = abs(d)
        if distance > 1e-12 * sqrt(size2):
            angle = _angle(s1, aup, s2, bup, up, distance) - _angle(
                s1, alow, s2, blow, low, distance)
            if d < 0:
                angle = -angle
            normal = angle
            subtended = -angle
            if sign != 0:
                whole = atan2(distance * (s2 - s1), d * d + s1 * s2)
                subtended += sign * (whole if d > 0 else -whole)
        fx, fy = nx * normal + tx * tangential, ny * normal + ty * tangential
        xx += fx * nx
        yy += fy * ny
        xy += 0.5 * (fx * ny + fy * nx)
        xz += along * nx
        yz += along * ny
        zz += subtended
    factor = 1 / (4 * pi)
    return (xx * factor, yy * factor, zz * factor, xy * factor, xz * factor, yz * factor)


Eight = tuple[float, float, float, float, float, float, float, float]


@compiled
def _corner_angles(u0: float, u1: float, v0: float, v1: float, w0: float, w1: float,
                   r: Eight, zero: float) -> float:
    """Return the sum of +-atan(v w/(u R)) over the corners, whose distances R are r (u, v, w).

    Two angles at a time are added as the argument of a product of complex numbers; both are smaller
    than pi/2. Terms with u = 0 vanish, which is the mean of the limits on a face.
    """
    total = 0.0
    if abs(u0) > zero:
        both = _angle_between(u0, v1, w0, w1, r[2], r[3]) - _angle_between(
            u0, v0, w0, w1, r[0], r[1])
        total -= both if u0 > 0 else -both
    if abs(u1) > zero:
        both = _angle_between(u1, v1, w0, w1, r[6], r[7]) - _angle_between(
            u1, v0, w0, w1, r[4], r[5])
        total += both if u1 > 0 else -both
    return total


@compiled
def _angle_between(u: float, v: float, w0: float, w1: float, r0: float, r1: float) -> float:
    """Return atan(v w/(abs(u) R)) at the end 1 of an edge along w minus that at its end 0."""
    return atan2(abs(u) * v * (w1 * r0 - w0 * r1), u * u * r0 * r1 + v * v * w0 * w1)


@compiled
def _edge(u0: float, u1: float, r0: float, r1: float, square: float) -> float:
    """Return the exponential of ``int ds/R`` along an edge from u0 to u1.

    ``square`` is the square of the distance of the edge's line.
    """
    if u0 >= 0:
        return (u1 + r1) / (u0 + r0)
    if u1 <= 0:
        return (r0 - u0) / (r1 - u1)
    return (u1 + r1) * (r0 - u0) / square


@compiled
def _inside(u: float, size: float, zero: float) -> float:
    """Return 1 between -size and size, 0 outside, and 1/2 at the ends."""
    distance = abs(u) - size
    return 0.5 if abs(distance) <= zero else (1.0 if distance < 0 else 0.0)


@compiled
def cuboid_field(a: float, b: float, c: float, x: float, y: float, z: float) -> Six:
    """Return the field matrix of a cuboid with half sides a, b and c in m, in its own axes.

    It is that of `polygon_field` in fewer operations: sums over the corners, of which the third
    diagonal component follows from the trace, -1 inside and 0 outside. See Z. J. Yang et al.,
    Supercond. Sci. Technol. 3 (1990) 591.
    """
    size = max(a, max(b, c))
    tiny, zero = _TINY * size * size, 1e-12 * size
    u0, u1, v0, v1, w0, w1 = x - a, x + a, y - b, y + b, z - c, z + c
    p0, p1, q0, q1, t0, t1 = u0 * u0, u1 * u1, v0 * v0, v1 * v1, w0 * w0 + tiny, w1 * w1 + tiny
    r = (sqrt(p0 + q0 + t0), sqrt(p0 + q0 + t1), sqrt(p0 + q1 + t0), sqrt(p0 + q1 + t1),
         sqrt(p1 + q0 + t0), sqrt(p1 + q0 + t1), sqrt(p1 + q1 + t0), sqrt(p1 + q1 + t1))
    xx = -_corner_angles(u0, u1, v0, v1, w0, w1, r, zero)
    yy = -_corner_angles(v0, v1, u0, u1, w0, w1,
                         (r[0], r[1], r[4], r[5], r[2], r[3], r[6], r[7]), zero)
    trace = -4 * pi * _inside(x, a, zero) * _inside(y, b, zero) * _inside(z, c, zero)
    xy = log(_edge(w0, w1, r[0], r[1], p0 + q0 + tiny) * _edge(w0, w1, r[6], r[7], p1 + q1 + tiny)
             / (_edge(w0, w1, r[2], r[3], p0 + q1 + tiny)
                * _edge(w0, w1, r[4], r[5], p1 + q0 + tiny)))
    xz = log(_edge(v0, v1, r[0], r[2], p0 + t0) * _edge(v0, v1, r[5], r[7], p1 + t1)
             / (_edge(v0, v1, r[1], r[3], p0 + t1) * _edge(v0, v1, r[4], r[6], p1 + t0)))
    yz = log(_edge(u0, u1, r[0], r[4], q0 + t0) * _edge(u0, u1, r[3], r[7], q1 + t1)
             / (_edge(u0, u1, r[1], r[5], q0 + t1) * _edge(u0, u1, r[2], r[6], q1 + t0)))
    factor = 1 / (4 * pi)
    return (xx * factor, yy * factor, (trace - xx - yy) * factor,
            xy * factor, xz * factor, yz * factor)


@compiled
def prism_field(vertices: Floats, half: float, cuboid: bool, x: float, y: float, z: float) -> Six:
    """Return `cuboid_field` of a rectangle centred on the axis, else `polygon_field`."""
    if cuboid:
        return cuboid_field(vertices[2, 0], vertices[2, 1], half, x, y, z)
    return polygon_field(vertices, half, x, y, z)


@compiled
def fields_at(vertices: Floats, half: float, cuboid: bool, points: Floats, out: Floats) -> None:
    """Write the field matrix (n, 6) of a prism at points (n, 3) of its frame into ``out``."""
    for i in range(len(points)):
        out[i] = prism_field(vertices, half, cuboid, points[i, 0], points[i, 1], points[i, 2])
