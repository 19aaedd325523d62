"""Fields of polarized prisms and curved tetrahedra, and sweeps of Gauss-Seidel, by numba.

A prism stands on an outline in the (x, y) plane of its frame, between two values of z. Its field is
the sum of line integrals over the outline that the docstring of
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
"""

from __future__ import annotations

from functools import lru_cache
from math import atan2, cos, inf, log, pi, sin, sqrt

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.threads import compiled

_TINY = 1e-26
"""Added to squared distances relative to the square of a prism's size, where a logarithm would be
infinite otherwise. It is the square of 1e-13 of the size, which is below rounding."""

Six = tuple[float, float, float, float, float, float]
End = tuple[float, float, float, float, float]
"""An end of an edge relative to the point: x and y, the square of its distance in the plane, and
the point's distances R from it in the planes of the upper and the lower face."""
Faces = tuple[float, float, float, float, float]
"""How far the point is above the upper and the lower face, the squares of both, and the difference
of their signs: -2 between the end faces, 0 outside. Those of an infinite prism are infinitely far.
"""


@compiled
def _angle(
    s1: float, aup: float, alow: float, s2: float, bup: float, blow: float,
    up: float, low: float, d: float,
) -> float:
    """Return ``[[atan(s u/(d R))]]`` between two ends of an edge and the end faces, for d > 0.

    It is minus the solid angle of the side face, from 0 to 2 pi. The angles of both end faces are
    the arguments of complex numbers, and their difference is that of a quotient, up to a turn.
    """
    im1, re1 = up * d * (s2 * aup - s1 * bup), d * d * aup * bup + s1 * s2 * up * up
    im2, re2 = low * d * (s2 * alow - s1 * blow), d * d * alow * blow + s1 * s2 * low * low
    angle = atan2(im1 * re2 - re1 * im2, re1 * re2 + im1 * im2)
    # beside the face it is at most pi, so that a small positive angle is 0 but for rounding
    beside = s1 >= 0 or s2 <= 0 or up >= 0 or low <= 0
    return angle - 2 * pi if angle > (1.0 if beside else 0.0) else angle


@compiled
def _sign(u: float) -> float:
    """Return the sign of u, 0 for u = 0."""
    return 1.0 if u > 0 else (-1.0 if u < 0 else 0.0)


@compiled
def _faces(z: float, z_min: float, z_max: float) -> Faces:
    """Return the `Faces` of a prism between two values of z."""
    up, low = z - z_max, z - z_min
    return up, low, up * up, low * low, _sign(up) - _sign(low)


@compiled
def _end(x: float, y: float, faces: Faces, tiny: float) -> End:
    """Return an end of an edge at x, y from the point."""
    square = x * x + y * y
    return x, y, square, sqrt(square + faces[2] + tiny), sqrt(square + faces[3] + tiny)


@compiled
def _straight_edge(a: End, b: End, faces: Faces, tiny: float, zero: float) -> Six:
    """Return 4 pi times the contribution of an edge from a to b to the field matrix.

    Only sums over closed outlines have the symmetric matrix that is returned for every edge.
    """
    ax, ay, a2, aup, alow = a
    bx, by, b2, bup, blow = b
    up, low, up2, low2, side = faces
    length = sqrt((bx - ax) ** 2 + (by - ay) ** 2)
    if length < zero:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    tx, ty = (bx - ax) / length, (by - ay) / length
    nx, ny = ty, -tx
    d = ax * nx + ay * ny
    s1, s2 = ax * tx + ay * ty, bx * tx + by * ty
    distance = abs(d)
    if low == inf:
        tangential = log((a2 + tiny) / (b2 + tiny))
        normal = -2 * atan2(d * (s2 - s1), d * d + s1 * s2) if distance > zero else 0.0
        fx, fy = nx * normal + tx * tangential, ny * normal + ty * tangential
        return fx * nx, fy * ny, 0.0, 0.5 * (fx * ny + fy * nx), 0.0, 0.0
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
    if distance > zero:
        angle = _angle(s1, aup, alow, s2, bup, blow, up, low, distance)
        if d < 0:
            angle = -angle
        normal = angle
        subtended = -angle
        if side != 0:
            whole = atan2(distance * (s2 - s1), d * d + s1 * s2)
            subtended += side * (whole if d > 0 else -whole)
    fx, fy = nx * normal + tx * tangential, ny * normal + ty * tangential
    return fx * nx, fy * ny, subtended, 0.5 * (fx * ny + fy * nx), along * nx, along * ny


NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@compiled
def added(a: Six, factor: float, b: Six) -> Six:
    """Return a + factor b of two field matrices."""
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2],
            a[3] + factor * b[3], a[4] + factor * b[4], a[5] + factor * b[5])


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
    faces = _faces(z, -half, half)
    size2 = half * half
    for i in range(len(vertices)):
        size2 = max(size2, vertices[i, 0] ** 2 + vertices[i, 1] ** 2)
    tiny, zero = _TINY * size2, 1e-12 * sqrt(size2)
    total, last = NOTHING, len(vertices) - 1
    there = _end(vertices[last, 0] - x, vertices[last, 1] - y, faces, tiny)
    for i in range(len(vertices)):
        here, there = there, _end(vertices[i, 0] - x, vertices[i, 1] - y, faces, tiny)
        total = added(total, 1.0, _straight_edge(here, there, faces, tiny, zero))
    return added(NOTHING, 1 / (4 * pi), total)


ARC_LEVELS, ARC_NODES = 28, 12
"""Number of sizes of an arc's parts, each half the one before, and Gauss nodes of every part.

The smallest part is 1e-8 of the arc; at points that are nearer the field is less accurate."""


@lru_cache(maxsize=64)
def arc_table(sweep: float) -> tuple[Floats, Floats]:
    """Return Gauss nodes of the parts of an arc, as turns from the middle of a part, and weights.

    A part is not longer than its distance from the point, so that `ARC_NODES` nodes leave an error
    of 1e-15 of its integral.

    Returns
    -------
    turns : ndarray, shape (`ARC_LEVELS`, `ARC_NODES`, 2)
        Cosine and sine of the angles for parts of 1, 1/2, 1/4 ... of the arc.
    weights : ndarray, shape (`ARC_NODES`,)
        They add up to 1.
    """
    nodes, weights = np.polynomial.legendre.leggauss(ARC_NODES)
    angle = sweep / 2 * nodes / 2.0 ** np.arange(ARC_LEVELS)[:, None]
    return np.stack([np.cos(angle), np.sin(angle)], axis=2), weights / 2


@compiled
def _arc(radius: float, first: float, sweep: float, turns: Floats, weights: Floats,
         x: float, y: float, faces: Faces) -> Six:
    """Return 4 pi times the contribution of an arc about the z axis, by Gauss quadrature.

    The arc is halved, and its halves are, until no panel is longer than the distance from its
    middle to the point; see `arc_table`, which makes ``turns`` and ``weights``.
    """
    up, low, up2, low2, side = faces
    levels, order, flat = turns.shape[0], turns.shape[1], low == inf
    beyond = up if up > 0 else (-low if low < 0 else 0.0)
    beyond2 = beyond * beyond
    xx = yy = zz = xy = xz = yz = 0.0
    place, level = 1, 0  # of a panel in the tree of halves: panel k has the halves 2k and 2k + 1
    while place:
        share = 1.0 / (1 << level)
        middle = first + sweep * share * (place - (1 << level) + 0.5)
        cosine, sine = cos(middle), sin(middle)
        length = radius * abs(sweep) * share
        distance2 = (x - radius * cosine) ** 2 + (y - radius * sine) ** 2 + beyond2
        if distance2 < length * length and level < levels - 1:
            place, level = 2 * place, level + 1
            continue
        scale = radius * sweep * share
        for k in range(order):
            c = cosine * turns[level, k, 0] - sine * turns[level, k, 1]
            s = sine * turns[level, k, 0] + cosine * turns[level, k, 1]
            nx, ny = weights[k] * scale * c, weights[k] * scale * s
            px, py = x - radius * c, y - radius * s  # from the source to the point
            rho2 = px * px + py * py
            if flat:
                xx += px * nx * 2 / rho2
                yy += py * ny * 2 / rho2
                xy += (px * ny + py * nx) / rho2
                continue
            rup, rlow = sqrt(rho2 + up2), sqrt(rho2 + low2)
            # (1 - abs(u)/R)/rho^2 without cancellation
            solid = (_sign(up) / (rup * (rup + abs(up)))
                     - _sign(low) / (rlow * (rlow + abs(low))))
            # between the end faces low/rlow and -up/rup have the same sign
            bracket = solid if side == 0 else (low / rlow - up / rup) / rho2
            inverse = 1 / rup - 1 / rlow
            xx += px * nx * bracket
            yy += py * ny * bracket
            xy += 0.5 * (px * ny + py * nx) * bracket
            xz += inverse * nx
            yz += inverse * ny
            zz -= (px * nx + py * ny) * solid
        while place & 1:  # the next panel is the right half of the last one that has not had its
            place, level = place >> 1, level - 1
        place += 1 if place else 0
    return xx, yy, zz, xy, xz, yz


@compiled
def outline_fields(
    edges: Floats, arcs: Floats, turns: Floats, weights: Floats, z_min: float, z_max: float,
    points: Floats, first: int, last: int, out: Floats,
) -> None:
    """Write the field matrices of a prism on an outline of straight edges and arcs.

    Parameters
    ----------
    edges : ndarray, shape (m, 4), in m
        Start and end (x, y) of the straight edges. Outlines run counter-clockwise.
    arcs : ndarray, shape (k, 3)
        Radius in m, angle of the start and signed sweep in rad of the arcs about the z axis.
    turns : ndarray, shape (k, levels, order, 2)
        `arc_table` of every arc.
    weights : ndarray, shape (order,)
        Gauss weights on [0, 1].
    z_min, z_max : float, in m
        Infinite for the field of a cross-section.
    points : ndarray, shape (n, 3), in m
    first, last : int
        The points to do.
    out : ndarray, shape (n, 6)
    """
    size2 = 0.0 if z_max == inf else 0.25 * (z_max - z_min) ** 2
    for i in range(len(edges)):
        size2 = max(size2, (edges[i, 2] - edges[i, 0]) ** 2 + (edges[i, 3] - edges[i, 1]) ** 2)
    tiny, zero = _TINY * size2, 1e-12 * sqrt(size2)
    for n in range(first, last):
        x, y = points[n, 0], points[n, 1]
        faces = _faces(points[n, 2], z_min, z_max)
        total = NOTHING
        for i in range(len(edges)):
            total = added(total, 1.0, _straight_edge(
                _end(edges[i, 0] - x, edges[i, 1] - y, faces, tiny),
                _end(edges[i, 2] - x, edges[i, 3] - y, faces, tiny), faces, tiny, zero))
        for i in range(len(arcs)):
            total = added(total, 1.0, _arc(arcs[i, 0], arcs[i, 1], arcs[i, 2], turns[i], weights,
                                           x, y, faces))
        out[n] = added(NOTHING, 1 / (4 * pi), total)


Four = tuple[float, float, float, float]


@compiled
def _face(u: float, v0: float, v1: float, w0: float, w1: float, r: Four) -> tuple[float, float]:
    """Return a complex number whose argument is the solid angle of a face at the distance u.

    The face is between v0 and v1, w0 and w1; its corners (v0, w0), (v0, w1), (v1, w0), (v1, w1)
    are at the distances r. The solid angle is the sum over these of +-atan(v w/(abs(u) R)), added
    as a product of complex numbers.
    """
    u = abs(u)
    im0, re0 = u * v0 * (w1 * r[0] - w0 * r[1]), u * u * r[0] * r[1] + v0 * v0 * w0 * w1
    im1, re1 = u * v1 * (w1 * r[2] - w0 * r[3]), u * u * r[2] * r[3] + v1 * v1 * w0 * w1
    return re1 * re0 + im1 * im0, im1 * re0 - re1 * im0


@compiled
def _angle_of(re: float, im: float, least: float) -> float:
    """Return the argument of a complex number between ``least`` and that plus 2 pi."""
    angle = atan2(im, re)
    return angle + 2 * pi if angle < least else angle


@compiled
def _across(
    u0: float, u1: float, v0: float, v1: float, w0: float, w1: float, r0: Four, r1: Four,
    size: float, zero: float,
) -> float:
    """Return 4 pi times the diagonal component of a cuboid's field matrix across two of its faces.

    The faces are at u0 and u1 with corners at the distances r0 and r1; u1 is not negative. A face
    at u = 0 has none, which is the mean of the limits from both sides.
    """
    re0, im0 = _face(u0, v0, v1, w0, w1, r0)
    re1, im1 = _face(u1, v0, v1, w0, w1, r1)
    # a face is seen as more than half of the sphere by what is near and in front of it only; other
    # angles are at most pi, and 0 but for rounding if they are negative
    before = v0 < 0 < v1 and w0 < 0 < w1
    least0 = 0.0 if before and abs(u0) < size else -1.0
    least1 = 0.0 if before and u1 < size else -1.0
    if u0 > zero:  # beside the near face the far one may be larger
        return _angle_of(re0 * re1 + im0 * im1, im0 * re1 - re0 * im1, least0 if before else -pi)
    total = -_angle_of(re1, im1, least1)
    return total - _angle_of(re0, im0, least0) if u0 < -zero else total


@compiled
def _edge(u0: float, u1: float, r0: float, r1: float, square: float) -> tuple[float, float]:
    """Return numerator and denominator of the exponential of ``int ds/R`` along an edge.

    The edge is from u0 to u1, which is not negative; ``square`` is the square of the distance of
    its line.
    """
    if u0 >= 0:
        return u1 + r1, u0 + r0
    return (u1 + r1) * (r0 - u0), square


@compiled
def _edges(
    u0: float, u1: float, r: tuple[Four, Four], squares: Four,
) -> float:
    """Return the sum of ``int ds/R`` along four parallel edges, the second and third negative.

    ``r`` are the distances of their beginnings and ends.
    """
    n0, d0 = _edge(u0, u1, r[0][0], r[1][0], squares[0])
    n1, d1 = _edge(u0, u1, r[0][1], r[1][1], squares[1])
    n2, d2 = _edge(u0, u1, r[0][2], r[1][2], squares[2])
    n3, d3 = _edge(u0, u1, r[0][3], r[1][3], squares[3])
    return log(n0 * d1 * d2 * n3 / (d0 * n1 * n2 * d3))


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
    size = 2 * max(a, max(b, c))
    tiny, zero = _TINY * size * size, 1e-12 * size
    along, across, height = _sign(x), _sign(y), _sign(z)
    x, y, z = abs(x), abs(y), abs(z)
    u0, u1, v0, v1, w0, w1 = x - a, x + a, y - b, y + b, z - c, z + c
    p0, p1, q0, q1, t0, t1 = u0 * u0, u1 * u1, v0 * v0, v1 * v1, w0 * w0 + tiny, w1 * w1 + tiny
    r000, r001 = sqrt(p0 + q0 + t0), sqrt(p0 + q0 + t1)
    r010, r011 = sqrt(p0 + q1 + t0), sqrt(p0 + q1 + t1)
    r100, r101 = sqrt(p1 + q0 + t0), sqrt(p1 + q0 + t1)
    r110, r111 = sqrt(p1 + q1 + t0), sqrt(p1 + q1 + t1)
    xx = _across(u0, u1, v0, v1, w0, w1, (r000, r001, r010, r011), (r100, r101, r110, r111),
                 size, zero)
    yy = _across(v0, v1, u0, u1, w0, w1, (r000, r001, r100, r101), (r010, r011, r110, r111),
                 size, zero)
    trace = -4 * pi * _inside(x, a, zero) * _inside(y, b, zero) * _inside(z, c, zero)
    xy = along * across * _edges(
        w0, w1, ((r000, r010, r100, r110), (r001, r011, r101, r111)),
        (p0 + q0 + tiny, p0 + q1 + tiny, p1 + q0 + tiny, p1 + q1 + tiny))
    xz = along * height * _edges(
        v0, v1, ((r000, r001, r100, r101), (r010, r011, r110, r111)),
        (p0 + t0, p0 + t1, p1 + t0, p1 + t1))
    yz = across * height * _edges(
        u0, u1, ((r000, r001, r010, r011), (r100, r101, r110, r111)),
        (q0 + t0, q0 + t1, q1 + t0, q1 + t1))
    factor = 1 / (4 * pi)
    return (xx * factor, yy * factor, (trace - xx - yy) * factor,
            xy * factor, xz * factor, yz * factor)


@compiled
def cuboid_fields(
    middle: Floats, half: Floats, cosine: float, sine: float, points: Floats, first: int, last: int,
    out: Floats,
) -> None:
    """Write the field matrices of a cuboid that is turned about the z axis.

    Parameters
    ----------
    middle, half : ndarray, shape (3,), in m
        Its middle, and its half sides.
    cosine, sine : float
        Of the angle from x to the first side.
    points : ndarray, shape (n, 3), in m
    first, last : int
        The points to do.
    out : ndarray, shape (n, 6)
    """
    for n in range(first, last):
        dx, dy, dz = (points[n, 0] - middle[0], points[n, 1] - middle[1], points[n, 2] - middle[2])
        xx, yy, zz, xy, xz, yz = cuboid_field(
            half[0], half[1], half[2], cosine * dx + sine * dy, cosine * dy - sine * dx, dz)
        out[n, 0] = cosine * cosine * xx + sine * sine * yy - 2 * cosine * sine * xy
        out[n, 1] = xx + yy - out[n, 0]
        out[n, 2] = zz
        out[n, 3] = cosine * sine * (xx - yy) + (cosine * cosine - sine * sine) * xy
        out[n, 4], out[n, 5] = cosine * xz - sine * yz, sine * xz + cosine * yz


@compiled
def prism_field(vertices: Floats, half: float, cuboid: bool, x: float, y: float, z: float) -> Six:
    """Return `cuboid_field` of a rectangle centred on the axis, else `polygon_field`."""
    if cuboid:
        return cuboid_field(vertices[2, 0], vertices[2, 1], half, x, y, z)
    return polygon_field(vertices, half, x, y, z)


NEAR, DEEPEST = 2.0, 8
"""Distance of a point from an element, by the size of this, within which `add_field` divides it,
and how often it does at most. At points of blocks that touch a yoke the error is 4e-5 of the field
rms and 2e-4 at most; with 3 it is a twentieth, in three times as long, with 1.5 it is 5e-4 rms."""


@compiled
def sweep(starts: Ints, columns: Ints, values: Floats, diagonal: Floats, right: Floats,
          found: Floats, back: bool) -> None:
    """Improve solutions (n, c) of a sparse matrix by a Gauss-Seidel sweep, forth from 0 or back.

    The columns of every row are sorted. Those after the diagonal find nothing but 0 on the way
    forth.
    """
    size, many = found.shape
    for k in range(many):
        for number in range(size):
            row = size - 1 - number if back else number
            rest = right[row, k]
            for place in range(starts[row], starts[row + 1]):
                column = columns[place]
                if column > row and not back:
                    break
                rest -= values[place] * found[column, k]
            found[row, k] += rest / diagonal[row]


@compiled
def _add_dipole(x: float, y: float, z: float, px: float, py: float, pz: float,
                out: Floats) -> None:
    """Add the field of a dipole p at the distance (x, y, z), without the factor 1 / 4 pi."""
    square = x * x + y * y + z * z
    one = 1 / (square * sqrt(square))
    along = 3 * (x * px + y * py + z * pz) / square
    out[0] += (along * x - px) * one
    out[1] += (along * y - py) * one
    out[2] += (along * z - pz) * one


@compiled
def _functions(u: float, v: float, w: float, value: Floats, slope: Floats) -> None:
    """Set values (10,) and derivatives (10, 3) of the functions of the nodes, in meshio's order."""
    t = 1 - u - v - w
    value[0], value[1], value[2], value[3] = (
        t * (2 * t - 1), u * (2 * u - 1), v * (2 * v - 1), w * (2 * w - 1))
    value[4], value[5], value[6] = 4 * t * u, 4 * u * v, 4 * t * v
    value[7], value[8], value[9] = 4 * t * w, 4 * u * w, 4 * v * w
    slope[:] = 0.0
    slope[0, :] = 1 - 4 * t
    slope[1, 0], slope[2, 1], slope[3, 2] = 4 * u - 1, 4 * v - 1, 4 * w - 1
    slope[4, :] = -4 * u
    slope[4, 0] += 4 * t
    slope[5, 0], slope[5, 1] = 4 * v, 4 * u
    slope[6, :] = -4 * v
    slope[6, 1] += 4 * t
    slope[7, :] = -4 * w
    slope[7, 2] += 4 * t
    slope[8, 0], slope[8, 2] = 4 * w, 4 * u
    slope[9, 1], slope[9, 2] = 4 * w, 4 * v


@compiled
def _at(nodes: Floats, value: Floats, axis: int) -> float:
    """Return a component of a quantity (10, 3) at the nodes, where their functions have a value."""
    total = 0.0
    for node in range(10):
        total += value[node] * nodes[node, axis]
    return total


@compiled
def _is_far(x: float, y: float, z: float, size: float) -> bool:
    """Tell whether the distance (x, y, z) is far relative to a size."""
    return x * x + y * y + z * z > (NEAR * size) ** 2


@compiled
def _volume(places: Floats, slope: Floats) -> float:
    """Return the volume of an element at a point per that of the reference element there."""
    xu = xv = xw = yu = yv = yw = zu = zv = zw = 0.0
    for node in range(10):
        x, y, z = places[node, 0], places[node, 1], places[node, 2]
        du, dv, dw = slope[node, 0], slope[node, 1], slope[node, 2]
        xu, xv, xw = xu + x * du, xv + x * dv, xw + x * dw
        yu, yv, yw = yu + y * du, yv + y * dv, yw + y * dw
        zu, zv, zw = zu + z * du, zv + z * dv, zw + z * dw
    return abs(xu * (yv * zw - yw * zv) - xv * (yu * zw - yw * zu) + xw * (yu * zv - yv * zu))


@compiled
def _add_part(x: float, y: float, z: float, part: Floats, share: float, places: Floats,
              polarization: Floats, reference: Floats, weights: Floats, out: Floats) -> None:
    """Add the field of a part of an element, by a dipole at each of its own Gauss points.

    The part has the corners (4, 3) in reference coordinates, and ``share`` of the element's volume.
    """
    value, slope = np.empty(10), np.empty((10, 3))
    for q in range(len(weights)):
        r, s, t = reference[q, 0], reference[q, 1], reference[q, 2]
        rest = 1 - r - s - t
        u, v, w = (rest * part[0, 0] + r * part[1, 0] + s * part[2, 0] + t * part[3, 0],
                   rest * part[0, 1] + r * part[1, 1] + s * part[2, 1] + t * part[3, 1],
                   rest * part[0, 2] + r * part[1, 2] + s * part[2, 2] + t * part[3, 2])
        _functions(u, v, w, value, slope)
        volume = _volume(places, slope) * (weights[q] * share)
        _add_dipole(
            x - _at(places, value, 0), y - _at(places, value, 1), z - _at(places, value, 2),
            volume * _at(polarization, value, 0), volume * _at(polarization, value, 1),
            volume * _at(polarization, value, 2), out)


@compiled
def _divide(part: Floats, parts: Floats) -> None:
    """Set the corners (8, 4, 3) of the eight parts of a tetrahedron (4, 3)."""
    corners = np.empty((10, 3))
    corners[:4] = part
    corners[4], corners[5], corners[6] = (
        (part[0] + part[1]) / 2, (part[0] + part[2]) / 2, (part[0] + part[3]) / 2)
    corners[7], corners[8], corners[9] = (
        (part[1] + part[2]) / 2, (part[1] + part[3]) / 2, (part[2] + part[3]) / 2)
    for child in range(8):
        for corner in range(4):
            parts[child, corner] = corners[CHILDREN[child, corner]]


@compiled
def _add_near(x: float, y: float, z: float, reach: float, places: Floats, polarization: Floats,
              reference: Floats, weights: Floats, out: Floats) -> None:
    """Add the field of a near element: of its parts, divided until each is far or at `DEEPEST`."""
    waiting = np.empty((8 * DEEPEST + 8, 4, 3))  # parts, the next one last
    depth = np.empty(8 * DEEPEST + 8, np.int64)
    value, slope = np.empty(10), np.empty((10, 3))
    waiting[0] = 0.0
    waiting[0, 1, 0] = waiting[0, 2, 1] = waiting[0, 3, 2] = 1.0  # the whole element
    depth[0] = 0
    count = 1
    while count:
        count -= 1
        part, level = waiting[count].copy(), depth[count]
        u, v, w = part[:, 0].sum() / 4, part[:, 1].sum() / 4, part[:, 2].sum() / 4
        _functions(u, v, w, value, slope)
        far = _is_far(x - _at(places, value, 0), y - _at(places, value, 1),
                      z - _at(places, value, 2), reach / 2.0**level)
        if far or level == DEEPEST:
            _add_part(x, y, z, part, 1 / 8.0**level, places, polarization, reference, weights, out)
        else:
            _divide(part, waiting[count:count + 8])
            depth[count:count + 8] = level + 1
            count += 8


@compiled
def add_field(first: int, last: int, points: Floats, middle: Floats, reach: Floats, gauss: Floats,
              dipoles: Floats, places: Floats, polarization: Floats, reference: Floats,
              weights: Floats, out: Floats) -> None:
    """Set the field (n, 3) in T at points ``first`` to ``last`` of the polarization of elements.

    Elements that are near, relative to their size, are divided into eight again and again.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    middle, reach : ndarray, shapes (e, 3) and (e,), in m
        Of the elements: middle, and distance of the farthest node from it.
    gauss, dipoles : ndarray, shape (e, q, 3), in m and T m^3
        Gauss points and the integrals of the polarization that they stand for.
    places, polarization : ndarray, shape (e, 10, 3), in m and T
        At the nodes.
    reference, weights : ndarray, shapes (q, 3) and (q,)
        The rule of quadrature on the reference element.
    """
    for n in range(first, last):
        x, y, z = points[n]
        total = out[n]
        total[:] = 0.0
        for e in range(len(middle)):
            if _is_far(x - middle[e, 0], y - middle[e, 1], z - middle[e, 2], reach[e]):
                for q in range(len(weights)):
                    _add_dipole(x - gauss[e, q, 0], y - gauss[e, q, 1], z - gauss[e, q, 2],
                                dipoles[e, q, 0], dipoles[e, q, 1], dipoles[e, q, 2], total)
            else:
                _add_near(x, y, z, reach[e], places[e], polarization[e], reference, weights, total)
        for i in range(3):
            total[i] /= 4 * pi


CHILDREN = np.array([
    (0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3),
    (4, 5, 6, 8), (4, 5, 7, 8), (5, 6, 8, 9), (5, 7, 8, 9)])
"""Corners of the eight parts of a tetrahedron: 0 to 3 are its own, 4 to 9 the middles of the edges
01, 02, 03, 12, 13 and 23."""
