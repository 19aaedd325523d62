"""Bodies of iron of any shape in the field of sources that no mesh follows, in 3D.

As for rotationally symmetric iron (`halbach_fe.solver.axisymmetric_iron`), the sources' field mu_0
H_s in the iron is given and becomes the gradient of a finite-element potential psi_s there. The
unknown is the total potential psi in the iron and the reaction's potential outside, so that nothing
cancels in iron of high permeability (J. Simkin, C. W. Trowbridge, Int. J. Numer. Meth. Engng. 14
(1979) 423). With psi_s continued by 0 to the nodes outside,

    S (psi - psi_s) + int (mu_r(|grad psi|) - 1) grad psi . grad v = 0    for all v.

GetDP assembles the stiffness S of vacuum, see pro/iron_bodies.pro. Its functions are of third
order: where the field is smooth they are five times as exact as those of second order in the same
time, and twice where edges make it singular. The steps of Newton's method are solved by conjugate
gradients, with two levels as the preconditioner: the corners of the elements, which are factorized,
and all unknowns, which a Gauss-Seidel sweep smooths.

The field outside is that of the polarization J = (mu_r - 1) mu_0 H of the iron, integrated over its
elements. Its error falls faster than that of the gradient of the potential in the air, because it
is a mean over all of the iron.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints, slices
from halbach_fe.core.errors import PointsOutsideError, StudyError, must_be
from halbach_fe.core.threads import available_memory, in_threads, share_out
from halbach_fe.geometry import domain as tags
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.solver.axisymmetric_iron import (
    Source,
    WithBar,
    conjugate_gradients,
    excess_in,
    newton,
)
from halbach_fe.solver.field_kernels import DEEPEST, NEAR, add_field, sweep
from halbach_fe.solver.getdp import CONJUGATE_GRADIENTS, Job
from halbach_fe.solver.getdp_files import Unknowns, check_difference, factorize
from halbach_fe.solver.interpolation import (
    QUADRATURE,
    cubic_slopes,
    elements_of,
    quadrature,
    shape_functions,
    slopes_in,
)
from halbach_fe.solver.iron_modes import MESH, Asked, alone, assembled
from halbach_fe.solver.magnetostatics import SOLUTIONS_FILE
from halbach_fe.solver.mesh import VerifiedMesh, verify_mesh, write_files
from halbach_fe.solver.session import RunSize, Session

PROBLEM = "iron_bodies.pro"
POINTS = 15  # Gauss points of an element

ROUGHLY = (*CONJUGATE_GRADIENTS, "-ksp_rtol", "1e-5")
"""PETSc options for GetDP's solution, which only verifies the matrix."""

ROUGH_RESIDUAL = 1e-3
"""Largest accepted relative residual of that solution, after preconditioning."""

SOLUTION_TOLERANCE = 0.05
"""Largest residual of that solution with our right-hand side, by the largest values of both.
Without preconditioning it is 20 to 60 times as large as what GetDP stops at: 6e-4 were measured by
`ROUGHLY` in twelve boxes, and 0.02 where GetDP stopped just below `ROUGH_RESIDUAL`. Another
numbering of the unknowns makes 0.5 or more."""


_FACES = np.array([(1, 2, 3, 5, 9, 8), (0, 2, 3, 6, 9, 7), (0, 1, 3, 4, 8, 7), (0, 1, 2, 4, 5, 6)])
"""Nodes of the faces of a tetrahedron, of which each is opposite the corner of its number."""


@dataclass(frozen=True)
class Surface:
    """The curved faces of the elements that bound the iron of a mesh.

    Attributes
    ----------
    places : ndarray, shape (f, 6, 3), in m
        Nodes of each face.
    within : ndarray, shape (f, 3), in m
        The corner of its element that is not on the face.
    reach : ndarray, shape (f,), in m
        Distance of the farthest node of the element from its middle.
    """

    places: Floats
    within: Floats
    reach: Floats

    @cached_property
    def _middles(self) -> KDTree:
        return KDTree(self.places[:, :3].mean(axis=1))

    def beside(self, points: Floats) -> Floats:
        """Return points (n, 3) in m, those that are too near moved off to where the field is exact.

        Points on a face of iron are too near, and those beside a round one may lie in the mesh.
        """
        resolved = NEAR / 2**DEEPEST  # distance over size of an element from which it is exact

        found = np.array(points)
        for _ in range(3):  # where two faces meet at an inner corner, each in turn
            foot, normal, face = self._nearest(found)
            near = np.flatnonzero(face >= 0)
            apart = found[near] - foot[near]
            distance, size = np.linalg.norm(apart, axis=1), resolved * self.reach[face[near]]
            height = np.einsum("ni,ni->n", apart, normal[near])
            outside = (height > 0) & (distance > 1e-3 * size)
            moved = (distance < 0.999 * size) | (height < 0)
            out = np.where(outside[:, None], apart / np.maximum(distance, 1e-300)[:, None],
                           normal[near])
            found[near[moved]] = (foot[near] + size[:, None] * out)[moved]
            if not moved.any():
                break
        return found

    def _nearest(self, points: Floats) -> tuple[Floats, Floats, Ints]:
        """Return the nearest places (n, 3) in m on the surface, normals there, and faces (n,).

        The face is -1 for points farther away than a tenth of the element's size.
        """
        foot, normal = np.zeros_like(points), np.zeros_like(points)
        face, best = np.full(len(points), -1), np.full(len(points), np.inf)
        many, most = min(12, len(self.places)), 1.1 * self.reach.max()
        near = np.flatnonzero(self._middles.query(points, distance_upper_bound=most)[0] < np.inf)
        if not len(near):
            return foot, normal, face
        for tried in self._middles.query(points[near], many)[1].reshape(len(near), many).T:
            place, across = self._project(tried, points[near])
            distance = np.linalg.norm(points[near] - place, axis=1)
            closer = (distance < best[near]) & (distance < 0.1 * self.reach[tried])
            rows = near[closer]
            foot[rows], normal[rows] = place[closer], across[closer]
            face[rows], best[rows] = tried[closer], distance[closer]
        return foot, normal, face

    def _project(self, faces: Ints, points: Floats) -> tuple[Floats, Floats]:
        """Return places (n, 3) in m on faces (n,) next to points (n, 3), and normals outwards."""
        nodes, reference = self.places[faces], np.full((len(points), 2), 1 / 3)
        for _ in range(6):  # most faces are flat, so that the first step is exact for them
            values, slopes = shape_functions("triangle6", reference)
            along = np.einsum("nkd,nke->nde", nodes, slopes)
            apart = points - np.einsum("nk,nkd->nd", values, nodes)
            step = np.einsum("nij,nj->ni", np.linalg.pinv(along), apart)
            reference = np.clip(reference + step, 0.0, 1.0)
            reference /= np.maximum(reference.sum(axis=1, keepdims=True), 1.0)
        values, slopes = shape_functions("triangle6", reference)
        place = np.einsum("nk,nkd->nd", values, nodes)
        along = np.einsum("nkd,nke->nde", nodes, slopes)
        normal = np.cross(along[..., 0], along[..., 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        inwards = np.einsum("ni,ni->n", normal, self.within[faces] - place) > 0
        return place, np.where(inwards[:, None], -normal, normal)


@dataclass(frozen=True)
class Problem:
    """The discrete problem of the iron."""

    bodies: tuple[IronSolid, ...]
    stiffness_of_vacuum: sparse.csr_array
    """Shape (n, n)."""
    nodes: Ints
    """Unknowns of the iron's elements: of nodes, edges and faces. Shape (e, 20)."""
    turned: Floats
    """-1 where the function of an unknown counts its edge backwards, otherwise 1. Shape (e, 20)."""
    slopes: Floats
    """Gradients of the functions at the Gauss points. Shape (e, 15, 20, 3), in 1/m."""
    weights: Floats
    """Shape (e, 15), in m^3."""
    places: Floats
    """Places of the nodes. Shape (e, 10, 3), in m."""
    body: Ints
    """Body of each element. Shape (e,)."""
    coarse: sparse.csr_array
    """Values at all nodes of those at the corners, linear in between. Shape (n, corners)."""

    @cached_property
    def points(self) -> Floats:
        """The Gauss points (15 e, 3) in m."""
        values, _ = shape_functions("tetra10", _reference())
        return np.einsum("qa,eai->eqi", values, self.places).reshape(-1, 3)

    @cached_property
    def surface(self) -> Surface:
        """The faces that belong to one element."""
        corners = np.sort(self.nodes[:, _FACES[:, :3]], axis=2).reshape(-1, 3)
        _, first, count = np.unique(corners, axis=0, return_index=True, return_counts=True)
        element, opposite = np.divmod(first[count == 1], 4)
        return Surface(self.places[element[:, None], _FACES[opposite]],
                       self.places[element, opposite], self.middle_and_reach[1][element])

    @cached_property
    def middle_and_reach(self) -> tuple[Floats, Floats]:
        """Middle (e, 3) of each element, and distance (e,) of its farthest node from it, in m."""
        middle = self.places[:, :4].mean(axis=1)
        return middle, np.linalg.norm(self.places - middle[:, None], axis=2).max(axis=1)

    def field(self, potential: Floats) -> Floats:
        """Return grad psi (e, 15, 3, c) of potentials (n, c)."""
        return np.asarray(np.einsum(
            "eqai,eac->eqic", self.slopes, potential[self.nodes], optimize=True))

    def integrate(self, vectors: Floats) -> Floats:
        """Return the integrals (n, c) of vectors (e, 15, 3, c) times grad v."""
        parts = np.einsum("eqai,eqic->eac", self.slopes, vectors * self.weights[..., None, None],
                          optimize=True)
        return np.stack([np.bincount(self.nodes.ravel(), part.ravel(),
                                     self.stiffness_of_vacuum.shape[0])
                         for part in np.moveaxis(parts, 2, 0)], axis=1)

    def strength(self, potential: Floats, points: Floats) -> Floats:
        """Return -grad psi (c, n, 3) in T of potentials (k, c) at points (n, 3) in m in iron.

        Raises
        ------
        PointsOutsideError
            If a point lies in no element.
        """
        rows, cells, reference, missing = elements_of(self.places, points)
        if len(missing):
            raise PointsOutsideError("iron", "in the elements of its iron; instead "
                                     f"{len(missing)} points lie in none of them")
        slopes = _slopes(self.places[cells], reference, self.turned[cells])
        found = np.zeros((len(points), potential.shape[1], 3))
        np.add.at(found, rows, -np.einsum("nkd,nkc->ncd", slopes, potential[self.nodes[cells]]))
        share = np.bincount(rows, minlength=len(points))[:, None, None]
        return np.moveaxis(found / share, 1, 0)

    def stiffness(self, potential: Floats) -> Floats:
        """Return S psi (n, c)."""
        return np.asarray(self.stiffness_of_vacuum @ potential)

    def dot(self, a: Floats, b: Floats) -> Floats:
        """Return the scalar products (c,) of potentials and residuals (n, c)."""
        return np.asarray(np.einsum("nc,nc->c", a, b))

    def law(self, field: Floats) -> tuple[Floats, Floats]:
        """Return `excess_in`, both (e, 15), for grad psi (e, 15, 3)."""
        return excess_in(self.bodies, self.body[:, None], np.einsum("eqi,eqi->eq", field, field))

    def residual(self, total: Floats, source: Floats) -> Floats:
        """Return the residual (n, 1) of the total potential."""
        field = self.field(total)
        excess, _ = self.law(field[..., 0])
        return self.stiffness(total - source) + self.integrate(excess[..., None, None] * field)

    @cached_property
    def _linear(self) -> Tangent:
        return self._tangent(np.zeros((self.stiffness_of_vacuum.shape[0], 1)))

    def tangent(self, total: Floats) -> Tangent:
        """Return the derivative of the residual at a total potential (n, 1)."""
        if all(isinstance(body.law, float | int) for body in self.bodies):
            return self._linear
        return self._tangent(total)

    def _tangent(self, total: Floats) -> Tangent:
        field = self.field(total)[..., 0]
        excess, slope = self.law(field)
        differential = (excess[..., None, None] * np.eye(3)
                        + (slope[..., None] * field)[..., None] * field[..., None, :])
        return Tangent.of(self, self.stiffness_of_vacuum + self.matrix(differential), self.coarse)

    def matrix(self, differential: Floats) -> sparse.csr_array:
        """Return the integrals (n, n) of (tensor (e, 15, 3, 3) grad u) . grad v."""
        size = self.stiffness_of_vacuum.shape[0]
        parts = np.empty((len(self.nodes), *2 * self.nodes.shape[1:]))
        step = 4096  # elements at a time, which limits the memory
        for some in slices(len(parts), step):
            weighted = differential[some] * self.weights[some, :, None, None]
            parts[some] = np.einsum("eqai,eqij,eqbj->eab", self.slopes[some], weighted,
                                    self.slopes[some], optimize=True)
        rows = np.broadcast_to(self.nodes[:, :, None], parts.shape)
        columns = np.broadcast_to(self.nodes[:, None, :], parts.shape)
        return sparse.csr_array(sparse.coo_array(
            (parts.ravel(), (rows.ravel(), columns.ravel())), (size, size)))

    def source_potential(self, values: Floats) -> Floats:
        """Return the potential (n, c) in T m of sources (15 e, 3, c), 0 outside the iron.

        It is free by a constant in every connected body, which the reaction does not depend on.
        """
        right = -self.integrate(values.reshape(*self.weights.shape, 3, -1))
        inside, tangent = self._iron
        found = np.zeros_like(right)
        found[inside] = tangent.solve(right[inside], 1e-8)
        return found

    @cached_property
    def _iron(self) -> tuple[Ints, Tangent]:
        """The unknowns in the iron, and the problem of Poisson in it alone."""
        inside = np.unique(self.nodes)
        own = self.matrix(np.broadcast_to(np.eye(3), (*self.weights.shape, 3, 3)))
        own = own[inside][:, inside]
        corners = np.flatnonzero(np.isin(inside, self.nodes[:, 0]))
        fixed = corners[np.unique(connected_components(own, directed=False)[1][corners],
                                  return_index=True)[1]]
        extra = np.zeros(len(inside))
        extra[fixed] = own.diagonal()[fixed]  # the solution is 0 there, as the rows add up to 0
        up = self.coarse[inside]
        up = up[:, np.unique(up.nonzero()[1])]
        return inside, Tangent.of(self, own + sparse.diags_array(extra), up)


@dataclass(frozen=True)
class Tangent:
    """The derivative of the residual at a state, and its preconditioner on two levels."""

    problem: Problem
    matrix: sparse.csr_array
    up: sparse.csr_array
    coarse: sparse_linalg.SuperLU

    @classmethod
    def of(cls, problem: Problem, matrix: sparse.csr_array, up: sparse.csr_array) -> Tangent:
        """Return the tangent of a matrix (n, n), with ``up`` (n, corners) as `Problem.coarse`."""
        matrix = sparse.csr_array(matrix)
        matrix.sort_indices()  # for `sweep`
        return cls(problem, matrix, up, factorize(up.T @ (matrix @ up)))

    @cached_property
    def _diagonal(self) -> Floats:
        return np.asarray(self.matrix.diagonal())

    def precondition(self, residual: Floats) -> Floats:
        """Return approximate solutions (n, c) by a sweep, the coarse level and a sweep back."""
        a, up, diagonal = self.matrix, self.up, self._diagonal
        found = np.zeros_like(residual)
        sweep(a.indptr, a.indices, a.data, diagonal, residual, found, False)
        rest = np.ascontiguousarray(up.T @ (residual - a @ found))
        for column in range(rest.shape[1]):
            rest[:, column] = self.coarse.solve(rest[:, column].copy())
        found += up @ rest
        sweep(a.indptr, a.indices, a.data, diagonal, residual, found, True)
        return found

    def solve(self, right: Floats, tolerance: float) -> Floats:
        """Solve for steps (n, c), see `conjugate_gradients`."""
        return conjugate_gradients(lambda step: self.matrix @ step, self.precondition,
                                   self.problem.dot, right, tolerance)


@dataclass(frozen=True)
class BodiesReaction(WithBar):
    """The field that iron adds to that of its sources; `solve_bodies` returns it."""

    name: str
    """Name of the study."""
    problem: Problem
    total: Floats
    """The total potential in the iron. Shape (n, 1), in T m."""
    residuals: tuple[float, ...]
    """Relative residual of Newton's method at the start and after every step."""
    coarse: BodiesReaction | None
    """The solution with larger elements, for the error bar."""

    @cached_property
    def polarization(self) -> Floats:
        """J (e, 15, 3) in T at the Gauss points."""
        field = self.problem.field(self.total)[..., 0]
        return -self.problem.law(field)[0][..., None] * field

    @cached_property
    def to_come(self) -> float:
        """What is to come far from iron after elements of half the size, over what these change.

        Between the two of `TO_COME` it goes by (mu - 1) / (mu + 1) of the differential
        permeability mu, by which the field is singular at edges, in the mean by |H| over the iron.
        """
        field = self.problem.field(self.total)[..., 0]
        square = np.einsum("eqi,eqi->eq", field, field)
        excess, slope = self.problem.law(field)
        more = excess + slope * square
        weights = self.problem.weights * np.sqrt(square)
        singular = (weights * more / (more + 2)).sum() / max(weights.sum(), 1e-300)
        return float(np.interp(singular, (0.0, 1.0), TO_COME))

    def field(self, points: Floats) -> Floats:
        """Return the reaction B (n, 3) in T at points (n, 3) in m outside the iron."""
        return self.field_with_errors(points)[0]

    def field_of_bodies(self, numbers: Sequence[int], points: Floats) -> Floats:
        """Return B (n, 3) in T of the polarization of some bodies, counted from 0, alone."""
        mine = np.isin(self.problem.body, numbers)
        part = replace(self.problem, **{key: getattr(self.problem, key)[mine] for key in (
            "nodes", "turned", "slopes", "weights", "places", "body")})
        return _field_of(part, self.polarization[mine], points)

    def field_with_errors(self, points: Floats) -> tuple[Floats, Floats]:
        """Return `field` and its change by finer elements, both (n, 3) in T.

        The field is extrapolated by the coarser solution. The length of the change is the error
        bar in any direction.
        """
        found = _field_of(self.problem, self.polarization, points)
        if self.coarse is None:
            return found, np.full_like(found, np.nan)
        change = found - self.coarse.field(points)
        away = self._distances(points)
        more, share = (np.interp(away, NEAR_AND_FAR, each)[:, None]
                       for each in ((0.0, self.coarse.to_come), BAR))
        return found + more * change, share * change

    def _distances(self, points: Floats) -> Floats:
        """Return distances (n,) of points (n, 3) from the nearest elements, in radii of these."""
        corners = self.problem.places[:, :4]
        middle = corners.mean(axis=1)
        radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
        distance, nearest = KDTree(middle).query(points)
        return np.asarray(distance / radius[nearest])

    def strength(self, points: Floats) -> Floats:
        """Return mu_0 H (n, 3) in T of all sources at points (n, 3) in m in iron."""
        return self.problem.strength(self.total, points)[0]

    def nodes(self, _angles: int = 0) -> Floats:
        """Return the points (k, 3) in m in the iron for `tangent`."""
        return self.problem.points

    def tangent(
        self, sources: Sequence[Source] | Floats, points: Floats, inside: Floats | None = None
    ) -> Floats:
        """Return the derivative (c, n, 3) in T of the reaction with respect to additional sources.

        They are functions, or values (c, k, 3) in T of their mu_0 H at `nodes`. Below it is that of
        mu_0 H (c, i, 3) in iron, at points ``inside`` (i, 3) in m.
        """
        problem = self.problem
        values = np.stack([source(problem.points) if callable(source) else source
                           for source in sources], axis=2)
        tangent = problem.tangent(self.total)
        own = problem.source_potential(values)
        total = tangent.solve(problem.stiffness(own), 1e-7)
        field = problem.field(self.total)[..., 0]
        excess, slope = problem.law(field)
        change = problem.field(total)
        along = np.einsum("eqi,eqic->eqc", field, change)
        polarization = -(excess[..., None, None] * change
                         + (slope[..., None] * field)[..., None] * along[:, :, None])
        reaction = np.stack([_field_of(problem, part, points)
                             for part in np.moveaxis(polarization, 3, 0)])
        return reaction if inside is None else np.concatenate(
            [reaction, problem.strength(total, inside)], axis=1)


def _reference() -> Floats:
    """Return the reference coordinates (15, 3) of the Gauss points."""
    return QUADRATURE["tetra10"][0]


def _field_of(problem: Problem, polarization: Floats, points: Floats) -> Floats:
    """Return B (n, 3) in T at points (n, 3) in m outside of a polarization (e, 15, 3) in T.

    On the surface it is that just outside, see `Surface.beside`.
    """
    reference, weights = QUADRATURE["tetra10"]
    values, _ = shape_functions("tetra10", reference)
    # the polarization in an element as a polynomial of second degree
    by_node = np.einsum("aq,eqi->eai", np.linalg.pinv(values), polarization)
    dipoles = polarization * problem.weights[..., None]
    middle, reach = problem.middle_and_reach
    found = np.zeros((len(points), 3))
    points = problem.surface.beside(points)
    gauss = problem.points.reshape(-1, POINTS, 3)

    def work(first: int, last: int) -> None:
        add_field(first, last, points, middle, reach, gauss, dipoles, problem.places, by_node,
                  reference, weights, found)

    in_threads(work, share_out(len(points)) if len(points) > 1 else [(0, len(points))])
    return found


COARSER = 2.0
"""Ratio of the sizes of elements of two meshes, by whose difference the field is extrapolated."""

NEAR_AND_FAR, TO_COME, BAR = (2.0, 4.0), (0.1, 0.35), (0.6, 0.3)
"""What finer elements will change far from iron that saturates and from other iron, and the error
bar of what they change, near iron and far from it. All are relative to the change from the coarser
mesh. Distances are from the middle of the nearest element in radii of that element; between them
shares are interpolated. Near iron the error changes from point to point with the elements, and
nothing is added. Farther away 0.2 to 0.6 of the change was to come for boxes, whose error falls by
the power 4/3 of the size as the field at edges is singular, and 0.2 to 0.4 for plates, a yoke and
the poles of a quadrupole. Where iron saturates, edges are hardly singular: 0.1 to 0.25 was to come
for a box and a bar, and 0.13 for the pole of an undulator."""


def solve_bodies(
    magnet: Magnet, source: Source, session: Session, estimate: bool = True,
    start: BodiesReaction | None = None, coarseness: float = 1.0,
) -> BodiesReaction:
    """Solve for the reaction of a magnet's bodies of iron to a source.

    Parameters
    ----------
    source : callable
        mu_0 H of the sources in T at points (n, 3) in m in the iron.
    estimate : bool
        Whether to solve once more with larger elements, for the error bar.
    start : BodiesReaction, optional
        Solution of the same iron on the same mesh with a similar source.
    coarseness : float
        Factor to the sizes of elements.
    """
    def advance(share: int) -> None:
        """Report the percentage of the time that is over: as measured, if sources are few.

        Without the coarser mesh the problem may be at hand: the time counts from Newton's method.
        """
        if session.progress is not None:
            session.progress(share, 100)

    advance(0)
    quiet = replace(session, progress=None)
    if not start:
        _check_memory(magnet, coarseness)
    coarse = solve_bodies(magnet, source, quiet.within("coarse"), False,
                          coarseness=COARSER * coarseness) if estimate else None
    advance(8 * estimate)
    problem = start.problem if start else assemble_bodies(magnet, quiet, coarseness)
    advance(50 * estimate)
    own = problem.source_potential(source(problem.points)[..., None])
    before = 70 * estimate
    advance(before)
    total, residuals = newton(problem, own, start.total if start else None,
                              lambda share: advance(before + int((100 - before) * share)))
    return BodiesReaction(magnet.name, problem, total, residuals, coarse)


@lru_cache(maxsize=2)  # that of the field and a coarser one; blocks that are updated change neither
def _assembled(asked: Asked[Problem]) -> Problem:
    return asked.compute()


def key_of(magnet: Magnet, session: Session, coarseness: float) -> tuple[object, ...]:
    """Return what the problem of a magnet's iron depends on."""
    from halbach_fe.geo.iron_mesh import Sizes  # imports Gmsh

    sizes = Sizes.of(magnet.study.mesh, coarseness)
    return magnet.study.iron, magnet.array_half_length, sizes, session.getdp


def assemble_bodies(magnet: Magnet, session: Session, coarseness: float) -> Problem:
    """Mesh the iron and the air near it, have GetDP assemble the stiffness, and verify it."""
    return _assembled(Asked(key_of(magnet, session, coarseness),
                            partial(_assemble, magnet, session, coarseness)))


def _assemble(magnet: Magnet, session: Session, coarseness: float) -> Problem:
    """Assemble the problem, as `assemble_bodies` does."""
    from halbach_fe.geo.iron_mesh import Sizes, mesh_iron  # imports Gmsh

    shells, sizes = [], Sizes.of(magnet.study.mesh, coarseness)

    def draw(path: Path) -> tags.Regions:
        regions, shell = mesh_iron(magnet.name, magnet.iron, sizes, path)
        shells.append(shell)
        return regions

    mesh = verify_mesh(write_files(session.folder, "iron", draw))
    count = mesh.inner.nodes + mesh.inner.edges + mesh.inner.faces
    _check_memory(magnet, coarseness, count)  # gaps between bodies are not in the estimate
    (shell,), numbers = shells, ("CX", "CY", "CZ")
    job = Job(problem=PROBLEM, mesh=MESH, resolution="Vacuum", outputs=(),
              solutions=SOLUTIONS_FILE, unknowns=count, time_limit_s=session.time_limit_s,
              numbers={"R_INNER": shell.inner, "R_OUTER": shell.outer, "BODIES": len(magnet.iron),
                       **dict(zip(numbers, shell.middle, strict=True))},
              options=ROUGHLY, linear_residual=ROUGH_RESIDUAL)
    ((unknowns, matrix, solution),) = assembled(
        session, mesh, "scalar_potential", [("getdp-iron", alone(mesh, job))], count)
    problem = _problem(magnet.iron, mesh, unknowns, matrix)
    in_air = mesh.tags < tags.FIRST_BLOCK_TAG
    check_matrix(problem, _numbers(mesh, unknowns)[in_air], solution.T)
    return problem


def check_matrix(problem: Problem, surface: Ints, solution: Floats) -> None:
    """Check that GetDP's matrix is that of our Gauss points and numbering.

    Inside the iron the two act alike on any potential; on its ``surface``, whose unknowns have
    parts in the air too, ``solution`` (n, 1) is GetDP's for iron magnetized along z.

    Raises
    ------
    GetDPError
        If they differ.
    """
    def difference(theirs: Floats, ours: Floats) -> float:
        return float(np.abs(theirs - ours).max() / np.abs(ours).max())

    matrix = problem.stiffness_of_vacuum
    inside = np.setdiff1d(problem.nodes, surface)
    if len(inside):  # thin bodies of one layer of elements have none
        any_potential = np.random.default_rng(0).standard_normal((matrix.shape[0], 1))
        check_difference(difference((matrix @ any_potential)[inside], problem.integrate(
            problem.field(any_potential))[inside]))
    along_z = np.zeros((*problem.weights.shape, 3, 1))
    along_z[..., 2, 0] = 1.0
    check_difference(difference(matrix @ solution, problem.integrate(along_z)), SOLUTION_TOLERANCE)


def size_of(magnet: Magnet, coarseness: float) -> RunSize:
    """Estimate the size of the run for a magnet's iron, without meshing it."""
    from halbach_fe.geo.iron_mesh import Sizes

    elements, unknowns = Sizes.of(magnet.study.mesh, coarseness).count(magnet.iron)
    return RunSize("scalar_potential", elements, unknowns, 1)


def _check_memory(magnet: Magnet, coarseness: float, known: int | None = None) -> None:
    """Refuse iron whose mesh would not fit into memory, with a size of elements that would.

    ``known`` is the number of unknowns once it is meshed. The estimate before was measured to be a
    quarter low to a third high: what it lets pass wrongly is refused after meshing.
    """
    from halbach_fe.geo.iron_mesh import Sizes  # imports Gmsh

    gib_each, mesh = 26_000 / 2**30, magnet.study.mesh  # memory per unknown: 12 GiB of 4.6e5
    estimate, available = size_of(magnet, coarseness).unknowns, available_memory()
    unknowns = known or estimate
    if available is None or gib_each * unknowns <= available:
        return
    reach = max(max(body.radius, body.half_length) for body in magnet.iron)
    hint, key = (f"The iron reaches {reach:.3g} m from the origin; was it meant in another unit? "
                 "Otherwise leave out thin bodies."), "growth"
    # half the memory is left to others
    enough = available / gib_each / 2 * estimate / unknowns
    tried = [("block_size_m", magnet.study.array.outer_radius_m), ("growth", 4.0)]
    for name, most in tried:
        values = (float(f"{one:.2g}") for one in np.geomspace(getattr(mesh, name), most, 30)[1:-1])
        if found := next((one for one in values if Sizes.of(mesh.with_(**{name: one}), coarseness)
                          .count(magnet.iron)[1] <= enough), None):
            key, hint = name, f"Set mesh.{name} = {found:g}."
            break
    raise StudyError(must_be(
        f"`mesh.{key}`", f"study {magnet.name}",
        f"so large that the mesh of the iron fits into the {available:.2g} GiB of memory that "
        f"are left", f"{getattr(mesh, key):g}, for some {unknowns:.2g} unknowns and "
        f"{gib_each * unknowns:.2g} GiB", hint))


def _problem(bodies: tuple[IronSolid, ...], mesh: VerifiedMesh, unknowns: Unknowns,
             matrix: sparse.csr_array) -> Problem:
    """Return the discrete problem."""
    iron = np.flatnonzero(mesh.tags >= tags.FIRST_BLOCK_TAG)
    located, weights = quadrature(mesh, iron)
    turned = np.ones((len(iron), 20))
    turned[:, 10:16] = np.sign(unknowns.edges[iron])
    slopes = _slopes(mesh.points[mesh.cells[located.cells]], located.reference,
                     np.repeat(turned, POINTS, axis=0))
    return Problem(
        bodies, matrix, _numbers(mesh, unknowns)[iron], turned,
        slopes.reshape(-1, POINTS, 20, 3), weights.reshape(-1, POINTS),
        mesh.points[mesh.cells[iron]],
        mesh.tags[iron] - tags.FIRST_BLOCK_TAG, _prolongation(mesh, unknowns))


def _numbers(mesh: VerifiedMesh, unknowns: Unknowns) -> Ints:
    """Return the unknowns (e, 20) of the functions of all elements, -1 for those that vanish."""
    entities = mesh.cells + 1, np.abs(unknowns.edges), np.abs(unknowns.faces)
    return np.hstack([function[each] for function, each in zip(
        unknowns.functions, entities, strict=True)])


def _slopes(nodes: Floats, reference: Floats, turned: Floats) -> Floats:
    """Return gradients (n, 20, 3) in 1/m of the functions in elements with nodes (n, 10, 3)."""
    slopes = np.concatenate([shape_functions("tetra10", reference)[1], cubic_slopes(reference)],
                            axis=1)
    return slopes_in(nodes, reference, slopes) * turned[..., None]


def _prolongation(mesh: VerifiedMesh, unknowns: Unknowns) -> sparse.csr_array:
    """Return the operator (n, corners) from values at the corners to those at all unknowns."""
    ends = np.array([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)])  # as meshio orders edges
    index = unknowns.functions[0]
    cells = index[mesh.cells + 1]
    corners = np.unique(cells[:, :4])
    corners = corners[corners >= 0]
    number = np.full(int(index.max()) + 2, -1)
    number[corners] = np.arange(len(corners))
    middle = np.repeat(cells[:, 4:].reshape(-1), 2)
    of_edge = cells[:, ends].reshape(-1)
    used = (middle >= 0) & (of_edge >= 0)
    pairs = np.unique(np.column_stack([middle[used], number[of_edge[used]]]), axis=0)
    rows = np.concatenate([corners, pairs[:, 0]])
    columns = np.concatenate([np.arange(len(corners)), pairs[:, 1]])
    values = np.concatenate([np.ones(len(corners)), np.full(len(pairs), 0.5)])
    return sparse.csr_array((values, (rows, columns)), shape=(unknowns.count, len(corners)))
