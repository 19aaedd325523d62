"""Fast summation of the field of dipoles by multipole expansions, compiled by numba.

Sources and targets are cells, or points, in binary trees of clusters. Two clusters interact by
expansions if they are small relative to their distance, else the larger one is divided; two single
cells that are near to each other are left to the exact field of prisms. The cost is proportional to
the number of cells. The method is that of L. Greengard and V. Rokhlin, J. Comput. Phys. 73 (1987)
325, on adaptive trees.

With solid harmonics scaled as ``R_n^m = r^n P_n^m e^(im phi)/(n + m)!`` and
``I_n^m = (n - m)! P_n^m e^(im phi)/r^(n+1)`` all translations are plain sums,
``R_n^m(x + y) = sum R_l^k(y) R_(n-l)^(m-k)(x)`` and
``I_n^m(x - y) = sum conj(R_l^k(y)) I_(n+l)^(m+k)(x)``; see E. O. Steinborn and K. Ruedenberg, Adv.
Quantum Chem. 7 (1973) 1. A cluster has the moments ``M_n^m = sum q R_n^m`` about its centre and the
potential ``sum conj(M_n^m) I_n^m``, and a target cluster the potential ``sum conj(R_l^k) L_l^k``.
Sums of degrees n + l above the order are left out, so that the error is of the size of
``((r_source + r_target)/distance)^order``, which is the opening criterion to that power.

Arrays of harmonics hold degree n and -n <= m <= n at the index n^2 + n + m.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.threads import compiled, reordered
from halbach_fe.solver.moments.near import apart

Harmonics = NDArray[np.complex128]


@compiled
def _complete(values: Harmonics, degree: int) -> None:
    """Write the harmonics of negative m, of a real potential."""
    for n in range(degree + 1):
        sign = -1.0
        for m in range(1, n + 1):
            values[n * n + n - m] = sign * values[n * n + n + m].conjugate()
            sign = -sign


@compiled
def regular(x: float, y: float, z: float, order: int, out: Harmonics) -> None:
    """Write the regular solid harmonics R of degree 0 to ``order`` into ``out``."""
    square, plane = x * x + y * y + z * z, complex(x, y)
    out[0] = 1.0
    for n in range(1, order + 1):
        centre = n * n + n
        below, twice = (n - 1) * (n - 1) + n - 1, (n - 2) * (n - 2) + n - 2
        out[centre + n] = -plane / (2 * n) * out[below + n - 1]
        for m in range(n):
            value = (2 * n - 1) * z * out[below + m]
            if m <= n - 2:
                value -= square * out[twice + m]
            out[centre + m] = value / ((n - m) * (n + m))
    _complete(out, order)


@compiled
def irregular(x: float, y: float, z: float, order: int, out: Harmonics) -> None:
    """Write the irregular solid harmonics I of degree 0 to ``order`` into ``out``."""
    inverse = 1 / (x * x + y * y + z * z)
    plane, up = complex(x, y) * inverse, z * inverse
    out[0] = sqrt(inverse)
    for n in range(1, order + 1):
        centre = n * n + n
        below, twice = (n - 1) * (n - 1) + n - 1, (n - 2) * (n - 2) + n - 2
        out[centre + n] = -(2 * n - 1) * plane * out[below + n - 1]
        for m in range(n):
            value = (2 * n - 1) * up * out[below + m]
            if m <= n - 2:
                value -= ((n - 1) * (n - 1) - m * m) * inverse * out[twice + m]
            out[centre + m] = value
    _complete(out, order)


@compiled
def _divide(order: Ints, places: Floats, axis: int, first: int, last: int, middle: int) -> None:
    """Reorder items so that those before ``middle`` are not farther along an axis than those after.

    It is Hoare's selection; ``last`` is included.
    """
    while first < last:
        pivot = places[order[(first + last) // 2], axis]
        i, j = first, last
        while i <= j:
            while places[order[i], axis] < pivot:
                i += 1
            while places[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            last = j
        elif middle >= i:
            first = i
        else:
            return


@compiled
def build(places: Floats, sizes: Floats) -> Any:
    """Divide items, at places (n, 3) in m and with radii (n,) in m, into a binary tree.

    Returns
    -------
    order : ndarray of int, shape (n,)
        The items in the order of the tree; a cluster is a range of it.
    limits, children : ndarray of int, shape (2n - 1, 2)
        First and last-but-one place in ``order``, and the numbers of both halves (-1 for a single
        item). Clusters come after the cluster that contains them.
    centres : ndarray, shape (2n - 1, 3), in m
    radii : ndarray, shape (2n - 1,), in m
        Of spheres about the centres that contain the items.
    """
    count = len(places)
    order = np.arange(count)
    total = max(1, 2 * count - 1)
    limits, children = np.zeros((total, 2), np.int64), np.full((total, 2), -1, np.int64)
    centres, radii = np.zeros((total, 3)), np.zeros(total)
    limits[0, 1] = count
    known = 1
    for cluster in range(total):
        first, last = limits[cluster]
        widest, width = 0, -1.0
        for axis in range(3):
            low, high = np.inf, -np.inf
            for i in range(first, last):
                item = order[i]
                low = min(low, places[item, axis] - sizes[item])
                high = max(high, places[item, axis] + sizes[item])
            centres[cluster, axis] = (low + high) / 2
            if high - low > width:
                widest, width = axis, high - low
        for i in range(first, last):
            item = order[i]
            distance = 0.0
            for axis in range(3):
                distance += (places[item, axis] - centres[cluster, axis]) ** 2
            radii[cluster] = max(radii[cluster], sqrt(distance) + sizes[item])
        if last - first > 1:
            middle = (first + last) // 2
            _divide(order, places, widest, first, last - 1, middle)
            for half in range(2):
                children[cluster, half] = known
                limits[known, 0] = first if half == 0 else middle
                limits[known, 1] = middle if half == 0 else last
                known += 1
    return order, limits, children, centres, radii


@compiled
def pairs(target_children: Ints, target_centres: Floats, target_radii: Floats,
          children: Ints, centres: Floats, radii: Floats, opening: float) -> Any:
    """Return the pairs of clusters (target, source) that interact, (n, 2) each.

    The first result are those that interact by expansions, the second those of two single items.
    """
    far, near = np.empty((1024, 2), np.int32), np.empty((1024, 2), np.int32)
    stack = np.empty((4096, 2), np.int32)
    far_count = near_count = 0
    depth = 1
    stack[0] = 0
    while depth:
        depth -= 1
        target, source = stack[depth]
        square = 0.0
        for axis in range(3):
            square += (target_centres[target, axis] - centres[source, axis]) ** 2
        sizes = target_radii[target] + radii[source]
        if sizes * sizes <= opening * opening * square:
            if far_count == len(far):
                far = np.concatenate((far, np.empty_like(far)))
            far[far_count, 0], far[far_count, 1] = target, source
            far_count += 1
            continue
        whole_target, whole_source = target_children[target, 0] < 0, children[source, 0] < 0
        if whole_target and whole_source:
            if near_count == len(near):
                near = np.concatenate((near, np.empty_like(near)))
            near[near_count, 0], near[near_count, 1] = target, source
            near_count += 1
        elif whole_source or (not whole_target and target_radii[target] >= radii[source]):
            for half in range(2):
                stack[depth, 0], stack[depth, 1] = target_children[target, half], source
                depth += 1
        else:
            for half in range(2):
                stack[depth, 0], stack[depth, 1] = target, children[source, half]
                depth += 1
    return far[:far_count].copy(), near[:near_count].copy()


@compiled
def dipole_moments(dipoles: Floats, x: float, y: float, z: float, order: int, work: Harmonics,
                   out: Harmonics) -> None:
    """Add the moments of a dipole (3,) at x, y, z from the centre to ``out``."""
    regular(x, y, z, order - 1, work)
    up, down = complex(dipoles[0], -dipoles[1]) / 2, complex(dipoles[0], dipoles[1]) / 2
    for n in range(1, order + 1):
        below = (n - 1) * (n - 1) + n - 1
        for m in range(-n, n + 1):
            value = 0j
            if -n < m < n:
                value += dipoles[2] * work[below + m]
            if -n < m + 1 < n:
                value += up * work[below + m + 1]
            if -n < m - 1 < n:
                value -= down * work[below + m - 1]
            out[n * n + n + m] += value


@compiled
def gather(order: Ints, limits: Ints, children: Ints, centres: Floats, places: Floats,
           dipoles: Floats, degree: int, moments: Harmonics) -> None:
    """Write the moments of all clusters.

    ``places`` (n, q, 3) in m and ``dipoles`` (n, q, 3) in T m^3 are the dipoles of every item.
    """
    work = np.empty((degree + 1) ** 2, np.complex128)
    for cluster in range(len(limits) - 1, -1, -1):
        own = moments[cluster]
        own[:] = 0
        if children[cluster, 0] < 0:
            item = order[limits[cluster, 0]]
            for q in range(places.shape[1]):
                dipole_moments(dipoles[item, q], *apart(places[item, q], centres[cluster]), degree,
                               work, own)
            continue
        for half in range(2):
            child = children[cluster, half]
            regular(*apart(centres[child], centres[cluster]), degree, work)
            for n in range(1, degree + 1):
                for m in range(n + 1):
                    total = 0j
                    for j in range(1, n + 1):
                        rest = n - j
                        for i in range(max(-j, m - rest), min(j, m + rest) + 1):
                            total += work[rest * rest + rest + m - i] * moments[
                                child, j * j + j + i]
                    own[n * n + n + m] += total
        _complete(own, degree)


@reordered
def translate(starts: Ints, sources: Ints, first: int, last: int, target_centres: Floats,
              centres: Floats, real: Floats, imaginary: Floats, degree: int,
              expansions: Harmonics) -> None:
    """Write the expansions of target clusters ``first`` to ``last`` of all sources far from them.

    The sources of target t are ``sources[starts[t]:starts[t + 1]]``. ``real`` and ``imaginary`` are
    the parts of the moments. This function takes most of the time, hence its real arithmetic.
    """
    size = (degree + 1) ** 2
    work, one, two = np.empty(size, np.complex128), np.empty(size), np.empty(size)
    for target in range(first, last):
        own = expansions[target]
        own[:] = 0
        for place in range(starts[target], starts[target + 1]):
            source = sources[place]
            irregular(*apart(target_centres[target], centres[source]), degree, work)
            for i in range(size):
                one[i], two[i] = work[i].real, work[i].imag
            a, b = real[source], imaginary[source]
            sign = 1.0
            for j in range(degree):
                for k in range(j + 1):
                    p = q = 0.0
                    for n in range(1, degree - j + 1):
                        here, there = n * n, (n + j) * (n + j) + j + k
                        x, y = a[here:here + 2 * n + 1], b[here:here + 2 * n + 1]
                        u, v = one[there:there + 2 * n + 1], two[there:there + 2 * n + 1]
                        for m in range(2 * n + 1):
                            p += x[m] * u[m] + y[m] * v[m]
                            q += x[m] * v[m] - y[m] * u[m]
                    own[j * j + j + k] += complex(sign * p, sign * q)
                sign = -sign
        _complete(own, degree)


@compiled
def spread(children: Ints, centres: Floats, degree: int, expansions: Harmonics) -> None:
    """Add the expansion of every cluster to those of its halves."""
    work = np.empty((degree + 1) ** 2, np.complex128)
    for cluster in range(len(children)):
        for half in range(2):
            child = children[cluster, half]
            if child < 0:
                continue
            regular(*apart(centres[child], centres[cluster]), degree, work)
            for j in range(degree):
                for i in range(j + 1):
                    total = 0j
                    for n in range(j, degree):
                        rest = n - j
                        for m in range(max(-n, i - rest), min(n, i + rest) + 1):
                            total += work[rest * rest + rest + m - i].conjugate() * expansions[
                                cluster, n * n + n + m]
                    expansions[child, j * j + j + i] += total
            _complete(expansions[child], degree)


@compiled
def field_of_expansion(expansion: Harmonics, x: float, y: float, z: float, degree: int,
                       work: Harmonics) -> tuple[float, float, float]:
    """Return the field in T of an expansion at x, y, z from its centre."""
    regular(x, y, z, degree - 1, work)
    bx = by = bz = 0.0
    for n in range(1, degree):
        below = (n - 1) * (n - 1) + n - 1
        for m in range(n + 1):
            factor = expansion[n * n + n + m] * (1.0 if m == 0 else 2.0)
            raised = work[below + m + 1] if m + 1 < n else 0j
            lowered = work[below + m - 1] if -n < m - 1 else 0j
            level = work[below + m] if m < n else 0j
            # derivatives along x and y from those along x +- iy
            bx -= (((raised - lowered) / 2).conjugate() * factor).real
            by -= (((raised + lowered) / 2j).conjugate() * factor).real
            bz -= (level.conjugate() * factor).real
    scale = 1 / (4 * np.pi)
    return bx * scale, by * scale, bz * scale


@compiled
def scatter(order: Ints, limits: Ints, children: Ints, centres: Floats, places: Floats,
            degree: int, expansions: Harmonics, first: int, last: int, out: Floats) -> None:
    """Add the field of the expansions at places (n, q, 3) in m of the items to ``out`` (n, q, 3).

    Only clusters ``first`` to ``last`` are evaluated, of which each has its own items.
    """
    work = np.empty((degree + 1) ** 2, np.complex128)
    for cluster in range(first, last):
        if children[cluster, 0] >= 0:
            continue
        item = order[limits[cluster, 0]]
        for q in range(places.shape[1]):
            bx, by, bz = field_of_expansion(
                expansions[cluster], *apart(places[item, q], centres[cluster]), degree, work)
            out[item, q, 0] += bx
            out[item, q, 1] += by
            out[item, q, 2] += bz
