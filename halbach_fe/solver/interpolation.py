"""B at points as a sparse operator on the unknowns of a finite-element solution.

Points are located once in the mesh's curved elements; then every solution costs one sparse
product, where GetDP's own printing searches the mesh for every point of every solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import GetDPError, PointsOutsideError
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.dofs import Unknowns
from halbach_fe.solver.mesh import VerifiedMesh

SEARCHES = ((12, 1e-8), (128, 1e-8), (1024, 1e-8), (128, 0.05))
"""How a point is looked for: in so many elements, by distance of their middle, and how far outside,
in the element's own coordinates, it still counts as inside. The last is for points beside a curved
face, which elements of second order do not quite meet."""

_NEWTON_STEPS = 8  # elements are hardly curved: the first step is exact in most
_SIMPLEX_EDGES = {2: ((0, 1), (1, 2), (2, 0)),
                  3: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))}  # as meshio orders them
_TETRAHEDRON_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # as GetDP numbers them
_TETRAHEDRON_FACES = ((0, 1, 3), (0, 1, 2), (0, 2, 3), (1, 2, 3))
_QUADRANGLE = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])  # corners
_PROBE = {"triangle6": (0.3, 0.2), "tetra10": (0.3, 0.2, 0.1), "quad": (0.31, -0.17)}
_QUADRANGLE_SIDES = ((1, -1), (0, -1), (0, 1), (1, 1))  # as GetDP numbers them: axis and its value


@dataclass(frozen=True)
class Located:
    """Points in the elements of a mesh. One on a face belongs to both neighbours, between which
    a derivative jumps: the mean of those found is taken.

    Attributes
    ----------
    cells : ndarray, shape (m,)
        Index of an element among the mesh's.
    reference : ndarray, shape (m, d)
        Coordinates of a point in it.
    mean : sparse array, shape (n, m)
        From these m to the n points.
    """

    cells: Ints
    reference: Floats
    mean: sparse.csr_array


def locate(mesh: VerifiedMesh, points: Floats, anywhere: bool = False) -> Located:
    """Find the air elements, or with ``anywhere`` all, that hold each of the points (n, 3).

    In 2D, z is not looked at.

    Raises
    ------
    PointsOutsideError
        If one is in none.
    """
    dimension = mesh.regions.dimension
    points = points[:, :dimension]
    air = np.flatnonzero(mesh.in_air | anywhere)
    nodes = mesh.points[mesh.cells[air]]
    tree = KDTree(nodes.mean(axis=1))
    found: list[tuple[Ints, Ints, Floats]] = []  # points, elements, coordinates
    missing = np.arange(len(points))
    for count, slack in ((min(n, len(air)), slack) for n, slack in SEARCHES):
        nearest = tree.query(points[missing], count)[1].reshape(len(missing), count)
        held = np.zeros(len(missing), bool)
        for chosen in nearest.T:
            reference, inside = _invert(nodes[chosen], points[missing], slack)
            found.append((missing[inside], air[chosen[inside]], reference[inside]))
            held |= inside
        missing = missing[~held]
        if not len(missing):
            break
    if len(missing):
        where = ", ".join(f"{x:g}" for x in points[missing[0]])
        raise PointsOutsideError(mesh.regions.study, (
            f"in its {'elements' if anywhere else 'air'}; instead {len(missing)} points lie in "
            f"none of its elements, the first at ({where}) m."))
    rows = np.concatenate([row for row, _, _ in found])
    share = 1 / np.bincount(rows, minlength=len(points))[rows]
    mean = sparse.csr_array((share, (rows, np.arange(len(rows)))), shape=(len(points), len(rows)))
    return Located(np.concatenate([cell for _, cell, _ in found]),
                   np.vstack([reference for _, _, reference in found]), mean)


def probes_of(mesh: VerifiedMesh, located: Located, count: int = 10) -> tuple[Located, Floats]:
    """Points (m, 3) inside up to ``count`` of the elements of air that hold the located ones, or of
    all air if none does: in matter a potential's gradient is not B.

    There B does not depend on which of two neighbours a point is taken to belong to. They are off
    all planes of symmetry, where some of an element's functions or their slopes vanish.
    """
    cells = np.unique(located.cells)
    cells = cells[mesh.in_air[cells]]
    if not len(cells):
        cells = np.flatnonzero(mesh.in_air)
    cells = cells[np.unique(np.linspace(0, len(cells) - 1, count).astype(int))]
    dimension = located.reference.shape[1]
    reference = np.tile(_PROBE[mesh.cell_type], (len(cells), 1))
    located = Located(cells, reference, sparse.eye_array(len(cells), format="csr"))
    places = np.zeros((len(cells), 3))
    places[:, :dimension] = coordinates(mesh, located)
    return located, places


def quadrature(mesh: VerifiedMesh, cells: Ints) -> tuple[Located, Floats]:
    """GetDP's Gauss points of elements, and the weights (m,) of integrals over them in m^d.

    The rules, of 7 points on triangles and 15 on tetrahedra, are exact for polynomials of degree
    5; see O. C. Zienkiewicz, R. L. Taylor, The Finite Element Method, and P. Keast, Comput.
    Methods Appl. Mech. Engrg. 55 (1986) 339.
    """
    reference, weights = _RULES[mesh.cell_type]
    count = len(reference)
    located = Located(np.repeat(cells, count), np.tile(reference, (len(cells), 1)),
                      sparse.eye_array(len(cells) * count, format="csr"))
    _, slopes = shape_functions(mesh.cell_type, located.reference)
    jacobian = np.einsum("nkd,nke->nde", mesh.points[mesh.cells[located.cells]], slopes)
    return located, np.abs(np.linalg.det(jacobian)) * np.tile(weights, len(cells))


def _rule(groups: list[tuple[float, float, set[tuple[float, ...]]]]) -> tuple[Floats, Floats]:
    """Points and weights from groups of a weight, a total and barycentric coordinates, permuted."""
    points, weights = [], []
    for weight, volume, coordinates_ in groups:
        for place in sorted(coordinates_):
            points.append(place[1:])
            weights.append(weight * volume)
    return np.array(points), np.array(weights)


def _orbit(*coordinates_: float) -> set[tuple[float, ...]]:
    return set(permutations(coordinates_))


_ROOT = np.sqrt(15)
_A, _B, _C = (7 - _ROOT) / 34, (7 + _ROOT) / 34, (10 - 2 * _ROOT) / 40
_RULES = {
    "triangle6": _rule([(9 / 40, 1 / 2, _orbit(1 / 3, 1 / 3, 1 / 3))] + [
        ((155 + sign * _ROOT) / 1200, 1 / 2,
         _orbit(a := (6 + sign * _ROOT) / 21, a, 1 - 2 * a)) for sign in (-1, 1)]),
    "tetra10": _rule([
        (16 / 135, 1 / 6, _orbit(1 / 4, 1 / 4, 1 / 4, 1 / 4)),
        ((2665 + 14 * _ROOT) / 37800, 1 / 6, _orbit(_A, _A, _A, 1 - 3 * _A)),
        ((2665 - 14 * _ROOT) / 37800, 1 / 6, _orbit(_B, _B, _B, 1 - 3 * _B)),
        (10 / 189, 1 / 6, _orbit(_C, _C, 1 / 2 - _C, 1 / 2 - _C))]),
}


def coordinates(mesh: VerifiedMesh, located: Located) -> Floats:
    """Where located points are, (n, d) in m."""
    values, _ = shape_functions(mesh.cell_type, located.reference)
    return np.asarray(located.mean @ np.einsum(
        "nk,nkd->nd", values, mesh.points[mesh.cells[located.cells]]))


def shape_functions(kind: str, reference: Floats) -> tuple[Floats, Floats]:
    """Values (n, k) and derivatives (n, k, d) of the functions of an element's nodes.

    ``kind`` is meshio's ``triangle6``, ``tetra10`` or ``quad``, and so is the order of nodes.
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
    """Values (n, 5) and derivatives (n, 5, 2) of GetDP's second-order functions on the sides and
    the inside of a quadrangle (BF_Node_2E, BF_Node_2F).
    """
    factors = []
    for along, value in _QUADRANGLE_SIDES:  # `along` is constant on the side
        t, s = reference[:, 1 - along], 1 + value * reference[:, along]
        slope = np.empty_like(reference)
        slope[:, 1 - along], slope[:, along] = -2 * t * s**2, (1 - t**2) * 2 * value * s
        factors.append(((1 - t**2) * s**2, slope))
    u, v = reference.T
    factors.append(((1 - u**2) * (1 - v**2),
                    np.column_stack([-2 * u * (1 - v**2), -2 * v * (1 - u**2)])))
    values, slopes = zip(*factors, strict=True)
    return np.stack(values, axis=1) / 16, np.stack(slopes, axis=1) / 16


def _barycentric(reference: Floats) -> tuple[Floats, Floats]:
    """Barycentric coordinates (n, d + 1) and their constant slopes (d + 1, d)."""
    dimension = reference.shape[1]
    slopes = np.vstack([-np.ones(dimension), np.eye(dimension)])
    return np.column_stack([1 - reference.sum(axis=1), reference]), slopes


def _invert(
    nodes: Floats, points: Floats, slack: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Coordinates of each point in its element with nodes (n, k, d), and whether it is inside."""
    kind = {4: "quad", 6: "triangle6", 10: "tetra10"}[nodes.shape[1]]
    dimension = points.shape[1]
    reference = np.full((len(points), dimension), 0.0 if kind == "quad" else 1 / (dimension + 1))
    for _ in range(_NEWTON_STEPS):
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


def _slopes(mesh: VerifiedMesh, located: Located, reference_slopes: Floats) -> Floats:
    """Gradients (n, k, d) in space of functions whose slopes in the element are given."""
    _, geometry = shape_functions(mesh.cell_type, located.reference)
    jacobian = np.einsum("nkd,nke->nde", mesh.points[mesh.cells[located.cells]], geometry)
    return np.einsum("nke,ned->nkd", reference_slopes, np.linalg.inv(jacobian))


def nodal_operators(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> tuple[sparse.csr_array, list[sparse.csr_array]]:
    """Value (n, unknowns) and each derivative of a second-order function at the points.

    On quadrangles it has unknowns on nodes, edges and faces, elsewhere on nodes.
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
    slopes = _slopes(mesh, located, reference_slopes)
    return (located.mean @ _sparse(values, index, unknowns.count),
            [located.mean @ _sparse(slopes[..., axis], index, unknowns.count)
             for axis in range(slopes.shape[2])])


def curl_operators(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    """Each component (n, unknowns) of the curl of a function on edges, and faces if any."""
    weights, reference_slopes = _barycentric(located.reference)
    slopes = _slopes(mesh, located, np.broadcast_to(
        reference_slopes, (len(weights), *reference_slopes.shape)))
    edges, cells = unknowns.edges[located.cells], mesh.cells[located.cells]
    a, b = np.array(_TETRAHEDRON_EDGES).T
    # the curl of w_a grad w_b - w_b grad w_a
    curls = [2 * np.cross(slopes[:, a], slopes[:, b]) * np.sign(edges)[..., None]]
    index = [unknowns.functions[0][np.abs(edges)]]
    for number, function in enumerate(unknowns.functions[1:]):
        # grad(w_b w_c) x grad w_a, a being the corner of the smallest number, or the second
        order = np.argsort(cells[:, np.array(_TETRAHEDRON_FACES)], axis=2)
        corners = np.take_along_axis(
            np.broadcast_to(_TETRAHEDRON_FACES, order.shape), order, axis=2)
        turned = np.roll(corners, -number, axis=2)
        row = np.arange(len(cells))[:, None]
        w, s = weights, slopes
        one, two, three = turned.transpose(2, 0, 1)
        product = (w[row, two][..., None] * s[row, three] + w[row, three][..., None] * s[row, two])
        curls.append(np.cross(product, s[row, one]))
        index.append(function[np.abs(unknowns.faces[located.cells])])
    all_curls, all_index = np.concatenate(curls, axis=1), np.concatenate(index, axis=1)
    return [located.mean @ _sparse(all_curls[..., axis], all_index, unknowns.count)
            for axis in range(3)]


def _sparse(values: Floats, columns: Ints, unknowns: int) -> sparse.csr_array:
    """Rows of values; a column of -1 is a function that vanishes."""
    rows = np.broadcast_to(np.arange(len(values))[:, None], values.shape)
    used = columns >= 0
    return sparse.csr_array((values[used], (rows[used], columns[used])),
                            shape=(len(values), unknowns))


SOLUTIONS_AT_ONCE = 32
PRINTED_TOLERANCE = 1e-9
"""Of the largest value. Both evaluate the same polynomials; where GetDP finds a point in a curved
element by iteration, up to 1e-10 was measured. Another numbering shows at 1."""


def apply_operator(operator: sparse.csr_array, solutions: NDArray[np.floating]) -> Floats:
    """Rows of an operator (n, unknowns) on all solutions (k, unknowns), as (k, n)."""
    result = np.empty((len(solutions), operator.shape[0]))
    for first in range(0, len(solutions), SOLUTIONS_AT_ONCE):
        part = slice(first, first + SOLUTIONS_AT_ONCE)
        result[part] = (operator @ solutions[part].astype(float).T).T
    return result


def compare_printed(ours: Floats, printed: Path, places: Floats) -> None:
    """Compare vectors (n, 3) at places (n, 3), by our evaluation of a solution, with what GetDP
    itself printed of it.

    Raises
    ------
    GetDPError
        If they differ by more than the rounding of 16 printed digits.
    """
    theirs = runner.read_vectors(printed, places)
    difference = np.abs(ours - theirs).max()
    if not difference <= PRINTED_TOLERANCE * np.abs(theirs).max():
        raise GetDPError(
            f"GetDP's solution, evaluated here, is {difference:.1e} from what GetDP prints of it "
            f"in {printed.name}: this GetDP numbers its unknowns in another way than expected. "
            "Use GetDP 3.2.")
