"""Evaluation of finite-element solutions at points, as sparse operators on the unknowns.

The points are located once in the curved elements of the mesh. Every solution then costs one sparse
product, whereas GetDP's own Print searches the mesh for every point of every solution.

The shape functions and their numbering are those of GetDP: nodal functions of second order (see
O. C. Zienkiewicz, R. L. Taylor, The Finite Element Method), and edge functions of order 1 and 2 on
tetrahedra. `compare_printed` verifies them against a few values that GetDP prints.

On a grid of rectangles of the half-plane a solution of second order is more exact at the nodes than
in between: its error falls with the fourth power of the element size h there, while the gradient
inside an element is right to h^2 only (L. B. Wahlbin, Superconvergence in Galerkin Finite Element
Methods, 1995). Where the nodes around a point lie in one material, `grid_operators` therefore take
the gradient from the polynomial of fifth degree through 6 x 6 of them. 75 mm off the axis of the
dipole of studies/faser, 29 mm from its blocks, this has a seventh of the error of the element's own
gradient. Near materials and beside their corners, where the field is not smooth, the element's own
gradient is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Bools, Floats, Ints, slices
from halbach_fe.core.errors import GetDPError, PointsOutsideError
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp_files import Unknowns
from halbach_fe.solver.mesh import VerifiedMesh

SEARCHES = ((12, 1e-8), (128, 1e-8), (1024, 1e-8), (128, 0.05))
"""Passes of the search for the element that holds a point: number of candidate elements, nearest
centroids first, and tolerance in the element's reference coordinates within which a point outside
counts as inside. The last pass is for points beside a curved face, which elements of second order
only approximate."""

CELL_TYPES = {4: "quad", 6: "triangle6", 10: "tetra10"}
"""meshio's name of a type of elements by their number of nodes."""

_SIMPLEX_EDGES = {2: ((0, 1), (1, 2), (2, 0)),
                  3: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))}  # as meshio orders them
_TETRAHEDRON_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # as GetDP numbers them
_TETRAHEDRON_FACES = ((0, 1, 3), (0, 1, 2), (0, 2, 3), (1, 2, 3))
_QUADRANGLE = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])  # corners
_PROBE = {"triangle6": (0.3, 0.2), "tetra10": (0.3, 0.2, 0.1), "quad": (0.31, -0.17)}
# The sides in GetDP's order: the axis whose coordinate is constant on the side, and its value.
_QUADRANGLE_SIDES = ((1, -1), (0, -1), (0, 1), (1, 1))


@dataclass(frozen=True)
class Located:
    """Points located in the elements of a mesh.

    A point on a face belongs to both neighbouring elements. Derivatives of a solution jump there,
    and the mean over the elements that hold the point is taken. A point therefore has one or
    several instances (m >= n).
    """

    cells: Ints
    """Index of the element that holds an instance, in the mesh's order. Shape (m,)."""
    reference: Floats
    """Reference coordinates of an instance in its element. Shape (m, d)."""
    mean: sparse.csr_array
    """Operator from values at the m instances to their means at the n points. Shape (n, m)."""


def locate(mesh: VerifiedMesh, points: Floats, anywhere: bool = False) -> Located:
    """Find the elements that hold each point.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
        On a 2D mesh the third coordinate is ignored.
    anywhere : bool
        Whether to search all elements, and not only those of air. A point on the surface of a
        magnet or of iron then gets a mean over both materials.

    Raises
    ------
    PointsOutsideError
        If a point lies in no element.
    """
    dimension = mesh.regions.dimension
    points = points[:, :dimension]
    air = np.flatnonzero(mesh.in_air | anywhere)
    nodes = mesh.points[mesh.cells[air]]
    rows, cells, reference, missing = elements_of(nodes, points)
    if len(missing):
        where = ", ".join(f"{x:g}" for x in points[missing[0]])
        raise PointsOutsideError(mesh.regions.study, (
            f"in its {'elements' if anywhere else 'air'}; instead {len(missing)} points lie in "
            f"none of its elements, the first at ({where}) m."))
    share = 1 / np.bincount(rows, minlength=len(points))[rows]
    mean = sparse.csr_array((share, (rows, np.arange(len(rows)))), shape=(len(points), len(rows)))
    return Located(air[cells], reference, mean)


def elements_of(nodes: Floats, points: Floats) -> tuple[Ints, Ints, Floats, Ints]:
    """Return which elements hold points (n, d), of elements of nodes (e, k, d) in m.

    Point, element and reference coordinates (d,) of every pair, and the points that none holds.
    """
    tree = KDTree(nodes.mean(axis=1))
    # no element reaches beyond the box of its nodes by a third, however curved
    low, high = nodes.min(axis=1), nodes.max(axis=1)
    low, high = low - (high - low) / 3, high + (high - low) / 3
    hits: list[tuple[Ints, Ints, Floats]] = []
    missing = np.arange(len(points))
    for count, slack in ((min(n, len(nodes)), slack) for n, slack in SEARCHES):
        nearest = tree.query(points[missing], count)[1].reshape(len(missing), count)
        held = np.zeros(len(points), bool)
        for column in nearest.T:
            at = points[missing]
            near = ((at >= low[column]) & (at <= high[column])).all(axis=1)
            chosen, tried = column[near], missing[near]
            reference, inside = _invert(nodes[chosen], points[tried], slack)
            hits.append((tried[inside], chosen[inside], reference[inside]))
            held[tried[inside]] = True
        missing = missing[~held[missing]]
        if not len(missing):
            break
    return (np.concatenate([row for row, _, _ in hits]),
            np.concatenate([cell for _, cell, _ in hits]),
            np.vstack([reference for _, _, reference in hits]), missing)


def probes_of(mesh: VerifiedMesh, cells: Ints) -> tuple[Located, Floats]:
    """Choose probes at which GetDP prints the field, to verify our evaluation.

    There is one probe in each of up to 10 air elements, chosen from ``cells``, or from all
    of air if these are not in air: in other materials the gradient of a scalar potential is not B.
    A probe lies inside its element, where B does not depend on a choice between neighbours, and off
    the element's planes of symmetry, where some shape functions or their derivatives vanish, so
    that an error in them would not show.

    Returns
    -------
    probes : Located
        m points.
    places : ndarray, shape (m, 3), in m
    """
    cells = np.unique(cells)
    cells = cells[mesh.in_air[cells]]
    if not len(cells):
        cells = np.flatnonzero(mesh.in_air)
    cells = cells[np.unique(np.linspace(0, len(cells) - 1, 10).astype(int))]
    dimension = mesh.regions.dimension
    reference = np.tile(_PROBE[mesh.cell_type], (len(cells), 1))
    located = Located(cells, reference, sparse.eye_array(len(cells), format="csr"))
    places = np.zeros((len(cells), 3))
    places[:, :dimension] = coordinates(mesh, located)
    return located, places


def quadrature(mesh: VerifiedMesh, cells: Ints) -> tuple[Located, Floats]:
    """Return GetDP's Gauss points of some elements, and the weights of integrals over the elements.

    The rules, with 7 points on triangles and 15 on tetrahedra, are exact for polynomials of degree
    5; see O. C. Zienkiewicz, R. L. Taylor, The Finite Element Method, and P. Keast, Comput.
    Methods Appl. Mech. Engrg. 55 (1986) 339. The same points as in GetDP give the same discrete
    problem.

    ``cells``: indices of the elements.

    Returns
    -------
    points : Located
        m points.
    weights : ndarray, shape (m,), in m^d
    """
    reference, weights = QUADRATURE[mesh.cell_type]
    count = len(reference)
    located = Located(np.repeat(cells, count), np.tile(reference, (len(cells), 1)),
                      sparse.eye_array(len(cells) * count, format="csr"))
    _, slopes = shape_functions(mesh.cell_type, located.reference)
    jacobian = np.einsum("nkd,nke->nde", mesh.points[mesh.cells[located.cells]], slopes)
    return located, np.abs(np.linalg.det(jacobian)) * np.tile(weights, len(cells))


def _rule(groups: list[tuple[float, float, set[tuple[float, ...]]]]) -> tuple[Floats, Floats]:
    """Assemble a quadrature rule on a reference simplex.

    Every group is the relative weight of a point, the measure of the simplex, and the barycentric
    coordinates of all points of the group. Returns points (n, d) and weights (n,).
    """
    points, weights = [], []
    for weight, volume, coordinates_ in groups:
        for place in sorted(coordinates_):
            points.append(place[1:])
            weights.append(weight * volume)
    return np.array(points), np.array(weights)


def _orbit(*coordinates_: float) -> set[tuple[float, ...]]:
    """Return all different permutations of barycentric coordinates."""
    return set(permutations(coordinates_))


_ROOT = np.sqrt(15)
_A, _B, _C = (7 - _ROOT) / 34, (7 + _ROOT) / 34, (10 - 2 * _ROOT) / 40
QUADRATURE = {
    "triangle6": _rule([(9 / 40, 1 / 2, _orbit(1 / 3, 1 / 3, 1 / 3))] + [
        ((155 + sign * _ROOT) / 1200, 1 / 2,
         _orbit(a := (6 + sign * _ROOT) / 21, a, 1 - 2 * a)) for sign in (-1, 1)]),
    "tetra10": _rule([
        (16 / 135, 1 / 6, _orbit(1 / 4, 1 / 4, 1 / 4, 1 / 4)),
        ((2665 + 14 * _ROOT) / 37800, 1 / 6, _orbit(_A, _A, _A, 1 - 3 * _A)),
        ((2665 - 14 * _ROOT) / 37800, 1 / 6, _orbit(_B, _B, _B, 1 - 3 * _B)),
        (10 / 189, 1 / 6, _orbit(_C, _C, 1 / 2 - _C, 1 / 2 - _C))]),
}
"""Points and weights in the reference element, of the fifth degree, by the type of its cells."""


def coordinates(mesh: VerifiedMesh, located: Located) -> Floats:
    """Return the positions (n, d) in m of located points."""
    values, _ = shape_functions(mesh.cell_type, located.reference)
    return np.asarray(located.mean @ np.einsum(
        "nk,nkd->nd", values, mesh.points[mesh.cells[located.cells]]))


def shape_functions(kind: str, reference: Floats) -> tuple[Floats, Floats]:
    """Return values (n, k) and derivatives (n, k, d) of the shape functions of an element's nodes.

    Parameters
    ----------
    kind : str
        meshio's name of the element type, ``triangle6``, ``tetra10`` or ``quad``. The order of the
        k nodes is meshio's too.
    reference : ndarray, shape (n, d)
        Reference coordinates: 0 to 1 on simplices, -1 to 1 on quadrangles.
    """
    if kind == "quad":
        u, v = ((1 + reference[:, axis, None] * _QUADRANGLE[:, axis]) / 2 for axis in range(2))
        return u * v, np.stack([_QUADRANGLE[:, 0] / 2 * v, u * _QUADRANGLE[:, 1] / 2], axis=2)
    weights, slopes = _barycentric(reference)
    corner = weights * (2 * weights - 1), (4 * weights - 1)[:, :, None] * slopes
    a, b = np.array(_SIMPLEX_EDGES[reference.shape[1]]).T
    edge = 4 * weights[:, a] * weights[:, b], 4 * (
        weights[:, a, None] * slopes[b] + weights[:, b, None] * slopes[a])
    return np.hstack([corner[0], edge[0]]), np.concatenate([corner[1], edge[1]], axis=1)


def _bubbles(reference: Floats) -> tuple[Floats, Floats]:
    """Return values (n, 5) and derivatives (n, 5, 2) of the second-order functions of quadrangles.

    They are GetDP's BF_Node_2E on the four sides and BF_Node_2F inside.
    """
    factors = []
    for axis, value in _QUADRANGLE_SIDES:
        t, s = reference[:, 1 - axis], 1 + value * reference[:, axis]
        slope = np.empty_like(reference)
        slope[:, 1 - axis], slope[:, axis] = -2 * t * s**2, (1 - t**2) * 2 * value * s
        factors.append(((1 - t**2) * s**2, slope))
    u, v = reference.T
    factors.append(((1 - u**2) * (1 - v**2),
                    np.column_stack([-2 * u * (1 - v**2), -2 * v * (1 - u**2)])))
    values, slopes = zip(*factors, strict=True)
    return np.stack(values, axis=1) / 16, np.stack(slopes, axis=1) / 16


def cubic_slopes(reference: Floats) -> Floats:
    """Return derivatives (n, 10, 3) of what makes nodal functions of tetrahedra third order.

    They are GetDP's BF_Node_3E on the six edges and BF_Node_3F on the four faces.
    """
    w, slopes = _barycentric(reference)
    s = np.broadcast_to(slopes, (len(w), *slopes.shape))
    a, b = np.array(_TETRAHEDRON_EDGES).T
    of_edges = ((2 * w[:, a] - w[:, b]) * w[:, b])[..., None] * s[:, a] + (
        (w[:, a] - 2 * w[:, b]) * w[:, a])[..., None] * s[:, b]
    a, b, c = np.array(_TETRAHEDRON_FACES).T
    of_faces = sum((w[:, p] * w[:, q])[..., None] * s[:, r]
                   for p, q, r in ((a, b, c), (b, c, a), (c, a, b)))
    return np.concatenate([of_edges, of_faces], axis=1)


def _barycentric(reference: Floats) -> tuple[Floats, Floats]:
    """Return barycentric coordinates (n, d + 1) and their constant derivatives (d + 1, d)."""
    dimension = reference.shape[1]
    slopes = np.vstack([-np.ones(dimension), np.eye(dimension)])
    return np.column_stack([1 - reference.sum(axis=1), reference]), slopes


def _invert(
    nodes: Floats, points: Floats, slack: float
) -> tuple[Floats, Bools]:
    """Invert the map from reference coordinates to space by Newton's method.

    Parameters
    ----------
    nodes : ndarray, shape (n, k, d), in m
        Nodes of one element for every point.
    points : ndarray, shape (n, d), in m
    slack : float
        Distance in reference coordinates up to which a point outside counts as inside.

    Returns
    -------
    reference : ndarray, shape (n, d)
        Reference coordinates of each point in its element.
    inside : ndarray of bool, shape (n,)
        False also if Newton's method has not converged, as for points far from the element.
    """
    kind = CELL_TYPES[nodes.shape[1]]
    dimension = points.shape[1]
    reference = np.full((len(points), dimension), 0.0 if kind == "quad" else 1 / (dimension + 1))
    most_steps = 8  # most elements are not curved, so that the first step is exact for them
    for _ in range(most_steps):
        values, slopes = shape_functions(kind, reference)
        residual = points - np.einsum("nk,nkd->nd", values, nodes)
        jacobian = np.einsum("nkd,nke->nde", nodes, slopes)
        step = np.linalg.solve(jacobian, residual[..., None])[..., 0]
        reference = np.clip(reference + step, -3, 3)
        if np.abs(step).max(initial=0) < 1e-13:
            break
    converged = np.abs(step).max(axis=1) < 1e-9
    if kind == "quad":
        return reference, converged & (np.abs(reference) <= 1 + slack).all(axis=1)
    weights, _ = _barycentric(reference)
    return reference, converged & (weights >= -slack).all(axis=1)


def slopes_in(nodes: Floats, reference: Floats, slopes: Floats | None = None) -> Floats:
    """Return gradients (n, k, d) in 1/m of functions in elements at reference coordinates (n, d).

    ``nodes`` (n, nodes, d) in m are those of the element of every point, and ``slopes`` (n, k, d)
    the functions' derivatives with respect to the reference coordinates, by default those of the
    shape functions.
    """
    _, geometry = shape_functions(CELL_TYPES[nodes.shape[1]], reference)
    jacobian = np.einsum("nkd,nke->nde", nodes, geometry)
    return np.einsum("nke,ned->nkd", geometry if slopes is None else slopes,
                     np.linalg.inv(jacobian))


def nodal_operators(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> tuple[sparse.csr_array, list[sparse.csr_array]]:
    """Return the operators from the unknowns of a nodal function to its value and derivatives.

    The function is of second order. On quadrangles it has unknowns on nodes, edges and faces, on
    triangles and tetrahedra on nodes only.

    Returns
    -------
    value : sparse array, shape (n, unknowns)
    derivatives : list of sparse array, shape (n, unknowns), in 1/m
        One for each of the d coordinates.
    """
    values, reference_slopes = shape_functions(mesh.cell_type, located.reference)
    index = unknowns.functions[0][mesh.cells[located.cells] + 1]  # GetDP counts nodes from 1
    if mesh.cell_type == "quad":
        more, more_slopes = _bubbles(located.reference)
        values = np.hstack([values, more])
        reference_slopes = np.concatenate([reference_slopes, more_slopes], axis=1)
        index = np.hstack([index, *(function[np.abs(entities[located.cells])]
                                    for function, entities in zip(
                                        unknowns.functions[1:], (unknowns.edges, unknowns.faces),
                                        strict=True))])
    slopes = slopes_in(mesh.points[mesh.cells[located.cells]], located.reference, reference_slopes)
    return (located.mean @ sparse_operator(values, index, unknowns.count),
            [located.mean @ sparse_operator(slopes[..., axis], index, unknowns.count)
             for axis in range(slopes.shape[2])])


def curl_operators(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    """Return the operators from the unknowns of a vector function on tetrahedra to its curl.

    The unknowns are circulations along edges (order 1) and, for order 2, also two per face.

    Returns
    -------
    list of sparse array, shape (n, unknowns), in 1/m^2
        One for each of the three components.
    """
    weights, reference_slopes = _barycentric(located.reference)
    slopes = slopes_in(mesh.points[mesh.cells[located.cells]], located.reference, np.broadcast_to(
        reference_slopes, (len(weights), *reference_slopes.shape)))
    edges, cells = unknowns.edges[located.cells], mesh.cells[located.cells]
    a, b = np.array(_TETRAHEDRON_EDGES).T
    # first order, edge from a to b: w_a grad w_b - w_b grad w_a with the curl 2 grad w_a x grad w_b
    curls = [2 * np.cross(slopes[:, a], slopes[:, b]) * np.sign(edges)[..., None]]
    index = [unknowns.functions[0][np.abs(edges)]]
    for number, function in enumerate(unknowns.functions[1:]):
        # second order: the curl of a face function is grad(w_q w_r) x grad w_p. In the first
        # function p is the corner with the smallest number, in the second function the next corner.
        order = np.argsort(cells[:, np.array(_TETRAHEDRON_FACES)], axis=2)
        corners = np.take_along_axis(
            np.broadcast_to(_TETRAHEDRON_FACES, order.shape), order, axis=2)
        turned = np.roll(corners, -number, axis=2)
        row = np.arange(len(cells))[:, None]
        w, s = weights, slopes
        p, q, r = turned.transpose(2, 0, 1)
        product = (w[row, q][..., None] * s[row, r] + w[row, r][..., None] * s[row, q])
        curls.append(np.cross(product, s[row, p]))
        index.append(function[np.abs(unknowns.faces[located.cells])])
    all_curls, all_index = np.concatenate(curls, axis=1), np.concatenate(index, axis=1)
    return [located.mean @ sparse_operator(all_curls[..., axis], all_index, unknowns.count)
            for axis in range(3)]


def sparse_operator(values: Floats, columns: Ints, unknowns: int) -> sparse.csr_array:
    """Return the operator (n, unknowns) with ``values`` (n, k) in ``columns`` (n, k).

    Column -1 marks a function without an unknown, whose coefficient is 0.
    """
    rows = np.broadcast_to(np.arange(len(values))[:, None], values.shape)
    used = columns >= 0
    return sparse.csr_array((values[used], (rows[used], columns[used])),
                            shape=(len(values), unknowns))


def apply_operator(operator: sparse.csr_array, solutions: NDArray[np.floating]) -> Floats:
    """Apply an operator (n, unknowns) to solutions (k, unknowns); the result has shape (k, n)."""
    result = np.empty((len(solutions), operator.shape[0]))
    step = 32  # number of solutions that are read from the disk at a time, which limits the memory
    for part in slices(len(solutions), step):
        result[part] = (operator @ solutions[part].astype(float).T).T
    return result


def compare_printed(ours: Floats, printed: Path, places: Floats) -> None:
    """Verify our evaluation of a solution against the values that GetDP printed.

    Parameters
    ----------
    ours : ndarray, shape (n, 3)
        Vectors from our evaluation.
    printed : Path
        File in which GetDP printed the vectors of the same solution.
    places : ndarray, shape (n, 3), in m
        The points.

    Raises
    ------
    GetDPError
        If the values differ by more than 1e-7 of the largest one.
    """
    theirs = runner.read_vectors(printed, places)
    difference = np.abs(ours - theirs).max()
    # tolerance relative to the largest printed value. Both programs evaluate the same polynomials.
    # Where GetDP locates a point in a curved element by iteration, differences of 4e-10 T were
    # measured on coarse meshes. Another numbering of the unknowns makes a relative difference of
    # order 1.
    printed_tolerance = 1e-7
    if not difference <= printed_tolerance * np.abs(theirs).max():
        raise GetDPError(
            f"GetDP's solution, evaluated here, is {difference:.1e} from what GetDP prints of it "
            f"in {printed.name}: this GetDP numbers its unknowns in another way than expected. "
            "Use GetDP 3.2.")


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
        (first_r >= 0) & (first_z >= 0) & _are_air(
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


def _grid(mesh: VerifiedMesh) -> tuple[tuple[Floats, Floats], Ints, Bools]:
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


def _are_air(
    material: Bools, of_r: tuple[Ints, Ints], of_z: tuple[Ints, Ints]
) -> Bools:
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
