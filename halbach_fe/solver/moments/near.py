"""Exact interactions of cells that are near to each other, compiled by numba."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.threads import compiled
from halbach_fe.solver.prism_kernel import NOTHING, Six, added, prism_field

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
