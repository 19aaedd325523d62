"""Fields between the grid lines of a half-plane, by polynomials through the nodes around a point.

On a grid of rectangles a solution of second order is more exact at the nodes than in between: its
error falls with the fourth power of the element size h there, while the gradient inside an element
is right to h^2 only (L. B. Wahlbin, Superconvergence in Galerkin Finite Element Methods, 1995).
Where the nodes around a point lie in one material, the gradient is therefore taken from the
polynomial of fifth degree through 6 x 6 of them. 75 mm off the axis of the dipole of
studies/faser, 29 mm from its blocks, this has a seventh of the error of the element's own gradient.

Near materials and beside their corners, where the field is not smooth, the element's own gradient
is kept.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.solver.dofs import Unknowns
from halbach_fe.solver.interpolation import Located, coordinates, nodal_operators, sparse_operator
from halbach_fe.solver.mesh import VerifiedMesh

LINES = 6
"""Number of grid lines, along r and along z, through whose crossings a polynomial is laid. The
point lies between the middle two of them, except near the axis, where the grid begins. For a
point at the z of a line, the mean of two polynomials is taken, as if it were below the line and
above: then a magnet and its mirror image at z = 0 have mirrored fields, which columns that follow
from each other by symmetry need."""

SAME_LINE = 9
"""Decimals of m to which coordinates of the nodes on one grid line agree."""


def grid_operators(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> tuple[sparse.csr_array, list[sparse.csr_array]]:
    """Return operators as `nodal_operators` does, more exact where all nodes around lie in air.

    Parameters
    ----------
    mesh : VerifiedMesh
        A grid of rectangles of the (r, z) half-plane.
    located : Located
        n points in air.
    unknowns : Unknowns

    Returns
    -------
    value : sparse array, shape (n, unknowns)
    derivatives : list of sparse array, shape (n, unknowns), in 1/m
        Along r and along z.
    """
    value, (along_r, along_z) = nodal_operators(mesh, located, unknowns)
    points = coordinates(mesh, located)
    (r, z), node, material = _grid(mesh)
    first_r = _first_line(r, points[:, 0], "right", from_the_first=True)
    both_z = [_first_line(z, points[:, 1], side) for side in ("left", "right")]
    smooth = np.flatnonzero(np.all([
        (first_r >= 0) & (first_z >= 0) & _in_air(
            material, _cells_around(r, first_r), _cells_around(z, first_z))
        for first_z in both_z], axis=0))
    if not len(smooth):
        return value, [along_r, along_z]
    lines = np.arange(LINES)
    of_r = first_r[smooth, None] + lines
    of_z = np.hstack([first_z[smooth, None] + lines for first_z in both_z])
    index = unknowns.functions[0][node[of_r[:, :, None], of_z[:, None, :]] + 1]  # from 1 in GetDP
    at_r, slope_r = _polynomials(r[of_r], points[smooth, 0])
    at_z, slope_z = (np.hstack(halves) / 2 for halves in zip(*(
        _polynomials(z[part], points[smooth, 1]) for part in np.hsplit(of_z, 2)), strict=True))
    own = sparse.diags_array(np.isin(np.arange(len(points)), smooth, invert=True).astype(float))
    place = sparse.csr_array(
        (np.ones(len(smooth)), (smooth, np.arange(len(smooth)))), (len(points), len(smooth)))

    def joined(inside: sparse.csr_array, by_r: Floats, by_z: Floats) -> sparse.csr_array:
        weights = (by_r[:, :, None] * by_z[:, None, :]).reshape(len(smooth), -1)
        return sparse.csr_array(own @ inside + place @ sparse_operator(
            weights, index.reshape(weights.shape), unknowns.count))

    return joined(value, at_r, at_z), [
        joined(along_r, slope_r, at_z), joined(along_z, at_r, slope_z)]


def _grid(mesh: VerifiedMesh) -> tuple[tuple[Floats, Floats], Ints, NDArray[np.bool_]]:
    """Return the grid lines (r, z) in m, the node at each crossing, and which cells are not air."""
    places = np.round(mesh.points[:, :2], SAME_LINE)
    r, z = (np.unique(places[:, axis]) for axis in range(2))
    node = np.zeros((len(r), len(z)), int)
    node[np.searchsorted(r, places[:, 0]), np.searchsorted(z, places[:, 1])] = np.arange(
        len(places))
    middle = mesh.points[mesh.cells, :2].mean(axis=1)
    material = np.ones((len(r) - 1, len(z) - 1), bool)
    material[np.searchsorted(r, middle[:, 0]) - 1,
             np.searchsorted(z, middle[:, 1]) - 1] = ~mesh.in_air
    return (r, z), node, material


def _first_line(
    lines: Floats, at: Floats, side: Literal["left", "right"], from_the_first: bool = False
) -> Ints:
    """Return the number of the first of the `LINES` lines around each place (n,), -1 if too few.

    A place on a line is taken for one on this side of it. ``from_the_first`` takes the first lines
    where there are too few below the place.
    """
    first = np.searchsorted(lines, np.round(at, SAME_LINE), side=side) - LINES // 2
    if from_the_first:
        first = np.maximum(first, 0)
    return np.where((first >= 0) & (first + LINES <= len(lines)), first, -1)


def _cells_around(lines: Floats, first: Ints) -> tuple[Ints, Ints]:
    """Return the first cell (n,), and the one after the last, of windows that begin at some lines.

    A window is widened by its widest cell, so that it keeps off the corners of materials, where
    grid lines are dense.
    """
    of_window = lines[np.maximum(first, 0)[:, None] + np.arange(LINES)]
    widest = np.diff(of_window, axis=1).max(axis=1)
    return (np.maximum(np.searchsorted(lines, of_window[:, 0] - widest, side="right") - 1, 0),
            np.minimum(np.searchsorted(lines, of_window[:, -1] + widest), len(lines) - 1))


def _in_air(
    material: NDArray[np.bool_], of_r: tuple[Ints, Ints], of_z: tuple[Ints, Ints]
) -> NDArray[np.bool_]:
    """Tell of which ranges of cells along r and z, from the first to before the last, are air."""
    count = np.zeros((material.shape[0] + 1, material.shape[1] + 1), int)
    count[1:, 1:] = material.cumsum(axis=0).cumsum(axis=1)
    (a, b), (c, d) = of_r, of_z
    return np.asarray(count[b, d] - count[a, d] - count[b, c] + count[a, c] == 0)


def _polynomials(nodes: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Return values (n, k) and derivatives (n, k) of Lagrange's polynomials on nodes (n, k)."""
    values, slopes = np.empty_like(nodes), np.empty_like(nodes)
    for number in range(nodes.shape[1]):
        others = np.delete(nodes, number, axis=1)
        below = np.prod(nodes[:, number, None] - others, axis=1)
        distance = at[:, None] - others
        values[:, number] = np.prod(distance, axis=1) / below
        slopes[:, number] = sum(np.prod(np.delete(distance, left_out, axis=1), axis=1)
                                for left_out in range(others.shape[1])) / below
    return values, slopes
