"""Sums over pairs of polarized cells, compiled by numba: exact if they are near, else expansions.

Sources and targets are cells, or points, in binary trees of clusters. Two clusters interact by
multipole expansions of the field of dipoles if they are small relative to their distance, else the
larger one is divided; two single cells that are near to each other are left to the exact field of
prisms. The cost is proportional to the number of cells. The method is that of L. Greengard and V.
Rokhlin, J. Comput. Phys. 73 (1987) 325, on adaptive trees.

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

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.threads import compiled, reordered
from halbach_fe.solver.field_kernels import NOTHING, Six, added, prism_field

Singles = NDArray[np.float32]
CellArrays = tuple[Floats, Floats, Floats, Floats, Bools]
"""Of all cells the centres, axes, vertices and half heights, and whether they are cuboids."""


@compiled
def turned(axes: Floats, g: Six) -> Six:
    """Return a field matrix of a frame along the axes of the magnet."""
    xx, yy, zz, xy, xz, yz = g
    ax, ay, az = axes[0]
    bx, by, bz = axes[1]
    cx, cy, cz = axes[2]
    px, py, pz = (ax * xx + ay * xy + az * xz, ax * xy + ay * yy + az * yz,
                  ax * xz + ay * yz + az * zz)
    qx, qy, qz = (bx * xx + by * xy + bz * xz, bx * xy + by * yy + bz * yz,
                  bx * xz + by * yz + bz * zz)
    rx, ry, rz = (cx * xx + cy * xy + cz * xz, cx * xy + cy * yy + cz * yz,
                  cx * xz + cy * yz + cz * zz)
    return (px * ax + py * ay + pz * az, qx * bx + qy * by + qz * bz, rx * cx + ry * cy + rz * cz,
            px * bx + py * by + pz * bz, px * cx + py * cy + pz * cz, qx * cx + qy * cy + qz * cz)


@compiled
def apart(a: Floats, b: Floats) -> tuple[float, float, float]:
    """Return the vector from b to a."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def _in_frame(axes: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a vector of the magnet along the axes of a frame."""
    return (axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z,
            axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z,
            axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z)


@compiled
def _add(g: Any, polarization: Floats, out: Floats) -> None:
    """Add the field of a polarization by a field matrix."""
    jx, jy, jz = polarization[0], polarization[1], polarization[2]
    out[0] += g[0] * jx + g[3] * jy + g[4] * jz
    out[1] += g[3] * jx + g[1] * jy + g[5] * jz
    out[2] += g[4] * jx + g[5] * jy + g[2] * jz


@compiled
def cell_field(cells: CellArrays, cell: int, point: Floats) -> Six:
    """Return the field matrix of a cell at a point of the magnet, along the magnet's axes."""
    centre, axes, vertices, half, cuboid = cells
    x, y, z = _in_frame(axes[cell], *apart(point, centre[cell]))
    return turned(axes[cell], prism_field(vertices[cell], half[cell], cuboid[cell], x, y, z))


@compiled
def mean_matrices(targets: Ints, sources: Ints, first: int, last: int, cells: CellArrays,
                  nodes: Floats, weights: Floats, out: Floats) -> None:
    """Write the means over target cells of the field matrices of source cells, (n, 6).

    ``nodes`` (cells, q, 3) in m and ``weights`` (cells, q) define the means.
    """
    for pair in range(first, last):
        t, total = targets[pair], NOTHING
        for q in range(nodes.shape[1]):
            total = added(total, weights[t, q], cell_field(cells, sources[pair], nodes[t, q]))
        for c in range(6):
            out[pair, c] = total[c]


@compiled
def add_means(starts: Ints, sources: Ints, matrices: Floats, polarization: Floats,
              first: int, last: int, out: Floats) -> None:
    """Add the mean field of near cells to that of target cells ``first`` to ``last``, (n, 3)."""
    for t in range(first, last):
        for pair in range(starts[t], starts[t + 1]):
            _add(matrices[pair], polarization[sources[pair]], out[t])


@compiled
def add_at_nodes(starts: Ints, sources: Ints, first: int, last: int, cells: CellArrays,
                 nodes: Floats, polarization: Floats, out: Floats) -> None:
    """Add the field of near cells at the nodes (n, q, 3) of targets ``first`` to ``last``."""
    for t in range(first, last):
        for pair in range(starts[t], starts[t + 1]):
            s = sources[pair]
            for q in range(nodes.shape[1]):
                _add(cell_field(cells, s, nodes[t, q]), polarization[s], out[t, q])


@compiled
def turn_to_magnet(targets: Ints, kinds: Ints, first: int, last: int, axes: Floats,
                   matrices: Floats, out: Floats) -> None:
    """Write matrices (pairs, 6) along the axes of the magnet from those of kinds of pairs.

    ``matrices`` (kinds, 6) are along the axes of the target cells, and ``kinds`` (pairs,) says
    which belongs to a pair.
    """
    for pair in range(first, last):
        m = matrices[kinds[pair]]
        g = turned(axes[targets[pair]], (m[0], m[1], m[2], m[3], m[4], m[5]))
        for c in range(6):
            out[pair, c] = g[c]


@compiled
def rows_along(targets: Ints, kinds: Ints, first: int, last: int, axes: Floats, matrices: Floats,
               along: Floats, out: Singles) -> None:
    """Write the component along ``along`` (cells, 3) of fields at the nodes of target cells.

    The result (pairs, q, 3) is per component of the polarization of the source cells, by
    ``matrices`` (kinds, q, 6) as for `turn_to_magnet`.
    """
    for pair in range(first, last):
        frame, u = axes[targets[pair]], along[targets[pair]]
        x, y, z = _in_frame(frame, u[0], u[1], u[2])
        for q in range(matrices.shape[1]):
            m = matrices[kinds[pair], q]
            px = m[0] * x + m[3] * y + m[4] * z
            py = m[3] * x + m[1] * y + m[5] * z
            pz = m[4] * x + m[5] * y + m[2] * z
            for c in range(3):
                out[pair, q, c] = frame[c, 0] * px + frame[c, 1] * py + frame[c, 2] * pz


@compiled
def add_along(starts: Ints, sources: Ints, matrices: Singles, polarization: Floats, first: int,
              last: int, out: Floats) -> None:
    """Add the fields of near cells by `rows_along` at the nodes (n, q) of target cells."""
    for t in range(first, last):
        for pair in range(starts[t], starts[t + 1]):
            jx, jy, jz = polarization[sources[pair]]
            for q in range(matrices.shape[1]):
                g = matrices[pair, q]
                out[t, q] += g[0] * jx + g[1] * jy + g[2] * jz


@compiled
def add_of_deviations(starts: Ints, sources: Ints, first: int, last: int, cells: CellArrays,
                      nodes: Floats, deviations: Floats, volume: Floats, out: Floats) -> None:
    """Add the mean over targets ``first`` to ``last`` of the field of deviations, (n, 3).

    ``deviations`` (cells, q, 3) in T m^3 are dipoles at the nodes of near cells. By reciprocity the
    mean over a cell of a dipole's field is the field of the cell, polarized uniformly, at the
    dipole, over its volume; unlike the dipole's field it is not singular.
    """
    each = np.empty(3)
    for t in range(first, last):
        for pair in range(starts[t], starts[t + 1]):
            s = sources[pair]
            for q in range(nodes.shape[1]):
                for axis in range(3):
                    each[axis] = deviations[s, q, axis] / volume[t]
                _add(cell_field(cells, t, nodes[s, q]), each, out[t])


@compiled
def add_of_parts(starts: Ints, sources: Ints, first: int, last: int, cells: CellArrays,
                 cuts: Floats, points: Floats, polarization: Floats, out: Floats) -> None:
    """Add the field of near cells, whose polarization differs from part to part, at points (n, 3).

    ``cuts`` (g + 1,) are the limits of the parts along every direction of a cell, between 0 and 1,
    and ``polarization`` (cells, g^3, 3) in T is that of the parts.
    """
    quad, each = np.empty((4, 2)), np.empty((polarization.shape[1], 6))
    for t in range(first, last):
        for pair in range(starts[t], starts[t + 1]):
            s = sources[pair]
            _parts_at(cells, s, cuts, points[t], quad, each)
            for q in range(len(each)):
                _add(each[q], polarization[s, q], out[t])


@compiled
def _parts_at(cells: CellArrays, cell: int, cuts: Floats, point: Floats, quad: Floats,
              out: Floats) -> None:
    """Write the field matrices (g^3, 6) of the parts of a cell at a point; ``quad`` is scratch."""
    centre, axes, vertices, halves, cuboids = cells
    half, cuboid, number = halves[cell], cuboids[cell], len(cuts) - 1
    x, y, z = _in_frame(axes[cell], *apart(point, centre[cell]))
    part = 0
    for i in range(number):
        for j in range(number):
            _part(vertices[cell], cuts[i], cuts[i + 1], cuts[j], cuts[j + 1], quad)
            mx = my = 0.0
            if cuboid:
                mx, my = (quad[0, 0] + quad[2, 0]) / 2, (quad[0, 1] + quad[2, 1]) / 2
                for corner in range(4):
                    quad[corner, 0] -= mx
                    quad[corner, 1] -= my
            for k in range(number):
                level = half * (cuts[k] + cuts[k + 1] - 1)
                g = turned(axes[cell], prism_field(quad, half * (cuts[k + 1] - cuts[k]), cuboid,
                                                   x - mx, y - my, z - level))
                for c in range(6):
                    out[part, c] = g[c]
                part += 1


@compiled
def _part(base: Floats, r0: float, r1: float, s0: float, s1: float, out: Floats) -> None:
    """Write the part of a quadrilateral between fractions of both its directions."""
    for corner in range(4):
        r = r1 if corner == 1 or corner == 2 else r0
        s = s1 if corner > 1 else s0
        for axis in range(2):
            out[corner, axis] = ((1 - r) * (1 - s) * base[0, axis] + r * (1 - s) * base[1, axis]
                                 + r * s * base[2, axis] + (1 - r) * s * base[3, axis])


@compiled
def touching(targets: Ints, sources: Ints, centre: Floats, radius: Floats, ratio: float) -> Bools:
    """Tell which pairs of cells are nearer than ``ratio`` times the sum of their radii."""
    found = np.empty(len(targets), np.bool_)
    for pair in range(len(targets)):
        t, s = targets[pair], sources[pair]
        x, y, z = apart(centre[t], centre[s])
        found[pair] = sqrt(x**2 + y**2 + z**2) < ratio * (radius[t] + radius[s])
    return found


@compiled
def dipole_field(x: float, y: float, z: float) -> Six:
    """Return the field matrix of a unit dipole in T m^3 at x, y, z from it, times 4 pi."""
    inverse = 1 / (x * x + y * y + z * z)
    cube = inverse * sqrt(inverse)
    five = 3 * cube * inverse
    return (five * x * x - cube, five * y * y - cube, five * z * z - cube,
            five * x * y, five * x * z, five * y * z)


@compiled
def node_matrices(targets: Ints, sources: Ints, first: int, last: int, cells: CellArrays,
                  nodes: Floats, out: Floats) -> None:
    """Write the field matrices (pairs, q, 6) of source cells at the nodes of target cells."""
    for pair in range(first, last):
        for q in range(nodes.shape[1]):
            g = cell_field(cells, sources[pair], nodes[targets[pair], q])
            for c in range(6):
                out[pair, q, c] = g[c]


@compiled
def far_panel(first: int, last: int, begin: int, nodes: Floats, weights: Floats, volume: Floats,
              out: Floats) -> None:
    """Write the mean field of cells ``first`` to ``last`` in all other cells.

    Sources and targets are sums over nodes (n, q, 3) in m with weights (n, q). The result
    ``out[3 t + i, 3 (s - begin) + j]`` is 0 for s = t.
    """
    for t in range(len(nodes)):
        for s in range(first, last):
            total = NOTHING
            if s != t:
                for p in range(nodes.shape[1]):
                    for q in range(nodes.shape[1]):
                        total = added(total, weights[t, p] * weights[s, q],
                                      dipole_field(*apart(nodes[t, p], nodes[s, q])))
            xx, yy, zz, xy, xz, yz = total
            f = volume[s] / (4 * np.pi)
            i, j = 3 * t, 3 * (s - begin)
            out[i, j], out[i + 1, j + 1], out[i + 2, j + 2] = f * xx, f * yy, f * zz
            out[i, j + 1] = out[i + 1, j] = f * xy
            out[i, j + 2] = out[i + 2, j] = f * xz
            out[i + 1, j + 2] = out[i + 2, j + 1] = f * yz


@compiled
def readings_of_cells(first: int, last: int, points: Floats, reach: float, radius: Floats,
                      cells: CellArrays, cuts: Floats, of_parts: Floats, nodes: Floats,
                      moments: Floats, out: Floats) -> None:
    """Write the field at points ``first`` to ``last`` per polarization at every node.

    The result (points, 3, cells, q, 3) has the component of the polarization last. Cells within
    ``reach`` radii of a point consist of exact parts, with ``of_parts`` (q, q) from polarizations
    at the nodes to those of the parts; others of dipoles at the nodes, with ``moments`` (cells, q)
    in m^3.
    """
    quad, each = np.empty((4, 2)), np.empty((nodes.shape[1], 6))
    parts = np.empty_like(each)
    for t in range(first, last):
        for s in range(len(nodes)):
            dx, dy, dz = apart(points[t], cells[0][s])
            if dx * dx + dy * dy + dz * dz < (reach * radius[s]) ** 2:
                _parts_at(cells, s, cuts, points[t], quad, parts)
                for q in range(len(each)):
                    for c in range(6):
                        total = 0.0
                        for p in range(len(each)):
                            total += parts[p, c] * of_parts[p, q]
                        each[q, c] = total
            else:
                for q in range(nodes.shape[1]):
                    g = dipole_field(*apart(points[t], nodes[s, q]))
                    for c in range(6):
                        each[q, c] = g[c] * moments[s, q] / (4 * np.pi)
            for q in range(nodes.shape[1]):
                for i in range(3):
                    out[t, i, s, q, i] = each[q, i]
                    for j in range(i):
                        out[t, i, s, q, j] = out[t, j, s, q, i] = each[q, i + j + 2]


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
