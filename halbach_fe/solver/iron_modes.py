"""Finite elements of azimuthal modes assembled here: of iron among sources, and by reciprocity.

**Iron** is rotationally symmetric. GetDP assembles the stiffness of the half-plane in vacuum, K +
m^2 L for mode m, see pro/iron_modes.pro. It is condensed to the unknowns of the iron: a Schur
complement, which is dense on the iron's surface and holds all of the space around. The operators of
the iron's Gauss points give its own part, which depends on the field and is assembled here.

It is given as rectangles of the (r, z) half-plane. Blocks do not shape the grid around it. Its
lines are dense at the edges of the iron, where the field is singular, and their distances grow
geometrically away from the edges.

**Reciprocity.** The reading e of a source b is e . A^-1 b, and A is symmetric. Instead of A^-1 b
for every block, A^-1 e is therefore solved for every reading, and one product with the sources of
all blocks gives their columns (the adjoint method; M. B. Giles, N. A. Pierce, Flow, Turbulence and
Combustion 65 (2000) 393). By azimuthal modes, readings at one (r, z) share the three solves of
every mode, whatever their azimuths are; so do the blocks of one ring. An array of many rings with
few places in its map thus takes as many solves as there are places, and not as many as there are
rings.

The discrete problem is that of `halbach_fe.solver.azimuthal_modes` to rounding. GetDP assembles the
matrix of mode 0, with which the one from our own Gauss points is compared; those of all modes are
factorized here, because GetDP cannot take a reading for a right-hand side. The columns are compared
with the nominal array, which GetDP solves for, where the response is assembled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import resources
from itertools import combinations, pairwise
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg
from numpy.typing import NDArray

from halbach_fe import pro
from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import unique_points
from halbach_fe.solver.azimuthal_modes import (
    AXIS_RADIUS,
    ModesCase,
    fill_run_folder,
    meridian_points,
    modes_needed,
    unknowns_of,
)
from halbach_fe.solver.getdp import Job
from halbach_fe.solver.getdp_files import (
    Unknowns,
    check_difference,
    factorize,
    read_matrix,
    read_solutions,
    read_unknowns,
)
from halbach_fe.solver.interpolation import Located, coordinates, grid_operators, nodal_operators
from halbach_fe.solver.magnetostatics import SOLUTIONS_FILE, variants_of
from halbach_fe.solver.mesh import VerifiedMesh, verify_mesh, write_files
from halbach_fe.solver.session import LOOK_S, MATRIX_FILE, RunSize, Session, Task, run_tasks

ONE_LINE_M = 1e-9
"""Grid lines that are closer than this, in m, are one."""


@dataclass(frozen=True)
class Resolution:
    """How finely the iron and its neighbourhood are resolved."""

    edge: float = 0.35
    """Size of the elements at the edges of iron, relative to the thickness of the thinnest iron."""
    growth: float = 1.7
    """Ratio of the sizes of neighbouring elements."""
    largest: float = 0.055
    """Largest size of elements near the iron, relative to its outer radius."""
    modes: int | None = None
    """Highest azimuthal mode; by default as many as the source needs, see `SOURCE_MODES`."""
    boundary: float = 20.0
    """Distance of the outer boundary, relative to the largest extent of the iron."""

    def coarser(self, modes: int) -> Resolution:
        """Return a resolution with 3 to 9 times the error, where ``modes`` are used here.

        The largest elements are those of the air. With half as large again, points among them
        changed by 16 times the error.
        """
        return Resolution(1.5 * self.edge, 1.15 * self.growth, 1.1 * self.largest,
                          max(1, round(2 * modes / 3)), 0.6 * self.boundary)


def check_bodies(bodies: Sequence[IronSolid]) -> None:
    """Refuse bodies that are empty or overlap.

    Raises
    ------
    StudyError
    """
    for body in bodies:
        if not (0 <= body.inner_radius < body.outer_radius and body.z_min < body.z_max):
            raise StudyError(must_be("Iron", "the magnet", "a rectangle of the (r, z) half-plane",
                                     f"{body}", "Correct its radii and ends."))
    for a, b in combinations(bodies, 2):
        across = min(a.outer_radius, b.outer_radius) - max(a.inner_radius, b.inner_radius)
        along = min(a.z_max, b.z_max) - max(a.z_min, b.z_min)
        if min(across, along) > ONE_LINE_M:
            said = " and ".join(
                f"one from r = {1e3 * body.inner_radius:.6g} to "
                f"{1e3 * body.outer_radius:.6g} mm and z = {1e3 * body.z_min:.6g} to "
                f"{1e3 * body.z_max:.6g} mm" for body in (a, b))
            raise StudyError(must_be("`iron.bodies`", "the magnet", "bodies that do not overlap",
                                     said, "Move them apart, or let them touch."))


def grid_lines(bodies: Sequence[IronSolid], resolution: Resolution) -> tuple[Floats, Floats]:
    """Return the grid lines in r (from 0) and in z, in m, ascending.

    They include all edges of the bodies, and end at the outer boundary.
    """
    outer = max(body.outer_radius for body in bodies)
    extent = max(outer, *(abs(end) for body in bodies for end in (body.z_min, body.z_max)))
    thinnest = min(min(body.outer_radius - body.inner_radius, body.z_max - body.z_min)
                   for body in bodies)
    size, most = resolution.edge * thinnest, resolution.largest * outer
    far = resolution.boundary * extent
    r = _distinct_values(radius for body in bodies
                  for radius in (body.inner_radius, body.outer_radius))
    z = _distinct_values(end for body in bodies for end in (body.z_min, body.z_max))
    growth = resolution.growth
    is_disc = r[0] < ONE_LINE_M
    radii = [] if is_disc else [0.0, *(r[0] - _spaced(r[0], size, growth, most))[::-1][1:]]
    middle = [line for low, high in pairwise(r)
              for line in low + _refined_at_ends(high - low, size, growth, most)]
    radii = [*radii, 0.0 if is_disc else r[0], *middle,
             *r[-1] + _spaced_outward(far - r[-1], size, growth, most, extent / 2)]
    heights = [*(z[0] - _spaced_outward(far + z[0], size, growth, most, extent / 2))[::-1], z[0],
               *(line for low, high in pairwise(z)
                 for line in low + _refined_at_ends(high - low, size, growth, most)),
               *z[-1] + _spaced_outward(far - z[-1], size, growth, most, extent / 2)]
    return np.array(radii), np.array(heights)


def iron_cells(bodies: Sequence[IronSolid], r: Floats, z: Floats) -> NDArray[np.int64]:
    """Return for every rectangle of a grid the number of the body that it is part of, or -1."""
    middles = np.meshgrid((r[1:] + r[:-1]) / 2, (z[1:] + z[:-1]) / 2, indexing="ij")
    result = np.full(middles[0].shape, -1, np.int64)
    for number, body in enumerate(bodies):
        r, z = middles
        result[(r > body.inner_radius) & (r < body.outer_radius)
               & (z > body.z_min) & (z < body.z_max)] = number
    return result


def _distinct_values(values: Iterable[float]) -> list[float]:
    """Return values in ascending order, without those that repeat the one before."""
    ordered = sorted(values)
    return ordered[:1] + [b for a, b in pairwise(ordered) if b - a > ONE_LINE_M]


def _spaced(length: float, size: float, growth: float, most: float) -> Floats:
    """Return positions up to ``length`` with distances that grow from ``size`` up to ``most``.

    All distances are then scaled to end at ``length``.
    """
    steps = [min(size, length)]
    while sum(steps) < length:
        steps.append(min(steps[-1] * growth, most))
    positions = np.cumsum(steps)
    return np.asarray(positions * (length / positions[-1]))


def _refined_at_ends(length: float, size: float, growth: float, most: float) -> Floats:
    """Return positions up to ``length`` with distances that grow from both ends to the middle."""
    half = _spaced(length / 2, size, growth, most)
    return np.concatenate([half, length - half[-2::-1], [length]])


def _spaced_outward(length: float, size: float, growth: float, most: float, near: float) -> Floats:
    """Return positions up to ``length``; the distances are limited up to the distance ``near``."""
    steps = [size]
    while (position := sum(steps)) < length:
        step = steps[-1] * growth
        steps.append(min(step, most) if position < near else step)
    positions = np.cumsum(steps)
    return np.asarray(positions * (length / positions[-1]))


Complexes = NDArray[np.complex128]

PROBLEM = "iron_modes.pro"
MESH = "iron.msh"


@dataclass(frozen=True)
class GaussPoints:
    """Points of the half-plane, with operators from the unknowns to the gradient there."""

    r: Floats
    z: Floats
    """Shape (k,), in m."""
    weights: Floats
    """Weights of integrals over r dr dz. Shape (k,), in m^3."""
    value: sparse.csr_array
    along_r: sparse.csr_array
    along_z: sparse.csr_array
    """psi_m and its derivatives; divide ``value`` by r for the azimuthal one.
    Shape (k, unknowns)."""

    def restricted(self, unknowns: Ints) -> GaussPoints:
        """Return the same points, with operators on some of the unknowns."""
        return replace(self, value=self.value[:, unknowns], along_r=self.along_r[:, unknowns],
                       along_z=self.along_z[:, unknowns])

    @cached_property
    def over_r(self) -> sparse.csr_array:
        """The operator psi_m / r."""
        return sparse.csr_array(sparse.diags_array(1 / self.r) @ self.value)

    def gradient(self, mode: int) -> sparse.csr_array:
        """Return the operator (3 k, unknowns) to (d/dr, m/r, d/dz) psi_m, one after the other.

        The azimuthal component of the gradient of psi_m exp(i m theta) is i times the second.
        """
        return sparse.csr_array(sparse.vstack([self.along_r, mode * self.over_r, self.along_z]))

    def stiffness(self, mode: int, permeability: Floats | float = 1.0) -> sparse.csr_array:
        """Return the stiffness (unknowns, unknowns) of a mode, the integral over r dr dz of
        mu_r (grad psi_m . grad v + m^2/r^2 psi_m v); ``permeability`` is mu_r (k,).
        """
        gradient = self.gradient(mode)
        weights = np.tile(self.weights * permeability, 3)
        return sparse.csr_array(gradient.T @ (sparse.diags_array(weights) @ gradient))


Found = TypeVar("Found", covariant=True)


@dataclass(frozen=True)
class Asked(Generic[Found]):
    """What is to be computed once: what it depends on, and how to do it."""

    key: tuple[object, ...]
    compute: Callable[[], Found] = field(compare=False)


@dataclass(frozen=True)
class IronModes:
    """The finite elements of iron in vacuum, for all azimuthal modes."""

    mesh: VerifiedMesh
    unknowns: Unknowns
    plain: sparse.csr_array
    azimuthal: sparse.csr_array
    """K and L: the stiffness of mode m is K + m^2 L. Shape (unknowns, unknowns)."""
    on_axis: Ints
    """Unknowns that vanish for m > 0."""
    iron: Ints
    """The unknowns of the iron."""
    gauss: GaussPoints
    """Gauss points of the iron's elements, on its unknowns."""
    body: Ints
    """Body that each of these points is in. Shape (k,)."""
    _exteriors: dict[int, Exterior] = field(default_factory=dict, repr=False, compare=False)

    def matrix(self, mode: int) -> sparse.csr_array:
        """Return the stiffness of a mode; unknowns that vanish have unit rows and columns."""
        whole = sparse.csr_array(self.plain + mode**2 * self.azimuthal)
        if mode == 0:
            return whole
        kept = np.ones(len(self.plain.indptr) - 1)
        kept[self.on_axis] = 0
        keep = sparse.diags_array(kept)
        return sparse.csr_array(keep @ whole @ keep + sparse.diags_array(1 - kept))

    @cached_property
    def rest(self) -> Ints:
        """The unknowns outside the iron, in an order that keeps the factors of all modes sparse."""
        rest = np.setdiff1d(np.arange(self.plain.shape[0]), self.iron)
        return np.asarray(rest[np.argsort(factorize(self.matrix(0)[rest][:, rest]).perm_c)])

    def exterior(self, mode: int) -> Exterior:
        """Return the space outside the iron in one mode, of which 2 GB are kept."""
        found = self._exteriors.get(mode)
        # factorized modes are kept up to this memory. Blocks and iron that answer to each other ask
        # for the same modes again and again.
        kept_bytes = 2e9
        if found is None:
            found = _condensed(self, mode)
            if sum(space.bytes for space in self._exteriors.values()) <= kept_bytes:
                self._exteriors[mode] = found
        return found

    @cached_property
    def iron_on_axis(self) -> Ints:
        """Indices into ``iron`` of the unknowns on the axis."""
        return np.flatnonzero(np.isin(self.iron, self.on_axis))

    def gradient(self, mode: int) -> sparse.csr_array:
        """Return `GaussPoints.gradient` in the iron, without the unknowns that vanish."""
        operator = self.gauss.gradient(mode)
        if mode == 0 or not len(self.iron_on_axis):
            return operator
        kept = np.ones(len(self.iron))
        kept[self.iron_on_axis] = 0
        return sparse.csr_array(operator @ sparse.diags_array(kept))


@dataclass(frozen=True)
class Exterior:
    """The space outside the iron in one mode, condensed to the iron's surface."""

    stiffness: sparse.csr_array
    """Stiffness in vacuum, with all other unknowns eliminated. Shape (iron, iron)."""
    rest: Ints
    """The unknowns outside the iron, in the order of the factorization."""
    surface: Ints
    """Indices into the iron's unknowns of those on its surface."""
    schur: Floats
    """Stiffness of the space outside and of the iron's own vacuum, on the surface.
    Shape (surface, surface)."""
    factor: sparse_linalg.SuperLU
    """Factorized stiffness of ``rest``, followed by the surface."""

    @property
    def bytes(self) -> int:
        """Memory of the factors; SuperLU keeps a second copy once they were looked at."""
        return 24 * self.factor.nnz + self.schur.nbytes

    def extend(self, iron: Complexes) -> Complexes:
        """Return the potential outside (rest, k) of potentials (iron, k) on the iron's unknowns."""
        result = np.empty((len(self.rest), iron.shape[1]), complex)
        right = np.zeros(len(self.rest) + len(self.surface))
        for number, column in enumerate((self.schur @ iron[self.surface]).T):
            # SuperLU solves for columns one by one several times faster than for many at once
            for part, values in ((result.real, column.real), (result.imag, column.imag)):
                right[len(self.rest):] = values
                part[:, number] = self.factor.solve(right)[:len(self.rest)]
        return result


def _condensed(modes: IronModes, mode: int) -> Exterior:
    """Eliminate all unknowns of a mode except those of the iron.

    The Schur complement is the product of the last blocks of the triangular factors, since the
    surface comes last in the order of elimination.
    """
    matrix, iron, rest = modes.matrix(mode), modes.iron, modes.rest
    surface = np.flatnonzero(np.diff(matrix[rest][:, iron].tocsc().indptr))
    order = np.concatenate([rest, iron[surface]])
    factor = factorize(matrix[order][:, order], ordered=True)
    kept = np.arange(len(order))
    if not ((factor.perm_c == kept).all() and (factor.perm_r == kept).all()):
        raise AssertionError("SuperLU changed the order of a positive definite matrix")
    first = len(rest)
    schur = factor.L[first:, first:].toarray() @ factor.U[first:, first:].toarray()
    schur = (schur + schur.T) / 2
    own = matrix[iron][:, iron]
    change = sparse.csr_array(
        ((schur - own[surface][:, surface].toarray()).ravel(),
         (np.repeat(surface, len(surface)), np.tile(surface, len(surface)))), shape=own.shape)
    return Exterior(sparse.csr_array(own + change), rest, surface, schur, factor)


def assemble_modes(
    name: str, bodies: Sequence[IronSolid], resolution: Resolution, session: Session
) -> IronModes:
    """Have GetDP assemble the stiffness of the half-plane around iron, and verify it.

    ``name``: name of the study.

    Raises
    ------
    GetDPError
        If GetDP fails, or its matrix differs from that of our own Gauss points.
    """
    from halbach_fe.geo.magnet_meshes import (
        mesh_half_plane,  # imports Gmsh, which only meshing needs
    )

    r, z = grid_lines(bodies, resolution)
    body = iron_cells(bodies, r, z)
    mesh = verify_mesh(write_files(session.folder, "iron", lambda path: mesh_half_plane(
        name, r, z, body >= 0, path)))
    count = unknowns_of(mesh.inner, mesh.axis, 0)
    (unknowns, plain, _), (_, first, _) = assembled(session, mesh, "azimuthal_modes", [
        (f"getdp-iron-mode{mode}", alone(mesh, Job(
            problem=PROBLEM, mesh=MESH, resolution="Mode", outputs=(), solutions=SOLUTIONS_FILE,
            numbers={"MODE": mode}, unknowns=count, time_limit_s=session.time_limit_s)))
        for mode in (0, 1)], count)
    everywhere = gauss_points(mesh, np.arange(mesh.elements), unknowns)
    for mode, matrix in enumerate((plain, first)):
        check_matrix(everywhere, mode, matrix)
    in_iron = np.flatnonzero(mesh.in_iron)
    points = gauss_points(mesh, in_iron, unknowns)
    iron = np.unique(points.along_r.indices)
    number = body[np.searchsorted(r, points.r) - 1, np.searchsorted(z, points.z) - 1]
    return IronModes(mesh, unknowns, plain, sparse.csr_array(first - plain),
                     axis_unknowns(mesh, unknowns), iron, points.restricted(iron), number)


def alone(mesh: VerifiedMesh, job: Job) -> Callable[[Path], Job]:
    """Return what fills a run folder with a problem that needs nothing but a mesh."""
    def stage(folder: Path) -> Job:
        (folder / job.problem).write_bytes(resources.files(pro).joinpath(job.problem).read_bytes())
        (folder / job.mesh).write_bytes(mesh.path.read_bytes())
        return job

    return stage


Assembled = tuple[Unknowns, sparse.csr_array, Floats]
"""Unknowns of a problem, its matrix, and a solution (1, unknowns)."""


def assembled(
    session: Session, mesh: VerifiedMesh, route: str,
    runs: Sequence[tuple[str, Callable[[Path], Job]]], count: int,
) -> list[Assembled]:
    """Have GetDP assemble and solve problems of ``count`` unknowns on a mesh.

    Every run has a name, and what fills its folder.
    """
    found: dict[str, tuple[Unknowns, sparse.csr_array]] = {}

    def task(name: str, stage: Callable[[Path], Job]) -> Task:
        def read(folder: Path) -> Floats:
            (problem,) = (path.stem for path in folder.glob("*.pro") if path.stem != "case")
            found[name] = (read_unknowns(folder / f"{problem}.pre", mesh.cell_type),
                           read_matrix(folder / MATRIX_FILE, count))
            return np.array(read_solutions(folder / SOLUTIONS_FILE, count, 1), float)

        return Task(name, stage, read, (1, count), 1,
                    RunSize(route, mesh.elements, count, 1), matrix=True)

    solutions = run_tasks([task(*each) for each in runs], session)
    return [(*found[name], solution) for (name, _), solution in zip(runs, solutions, strict=True)]


def points_at(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns, anywhere: bool
) -> GaussPoints:
    """Return the operators at located points in air, or ``anywhere``, without weights."""
    operators = nodal_operators if anywhere else grid_operators
    return _operators(mesh, located, operators(mesh, located, unknowns))


def _operators(
    mesh: VerifiedMesh, located: Located,
    operators: tuple[sparse.csr_array, list[sparse.csr_array]],
) -> GaussPoints:
    """Return operators to value and derivatives at located points, without weights."""
    place = coordinates(mesh, located)
    value, (along_r, along_z) = operators
    return GaussPoints(place[:, 0], place[:, 1], np.ones(len(place)), value, along_r, along_z)


def gauss_points(mesh: VerifiedMesh, cells: Ints, unknowns: Unknowns) -> GaussPoints:
    """Return the nine Gauss points of rectangles, those of GetDP's rule GaussLegendre."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    reference = np.array([(u, v) for u in nodes for v in nodes])
    count = len(cells) * len(reference)
    located = Located(np.repeat(cells, len(reference)), np.tile(reference, (len(cells), 1)),
                      sparse.eye_array(count, format="csr"))
    corners = mesh.points[mesh.cells[cells]]
    area = np.prod(np.ptp(corners, axis=1), axis=1)
    found = _operators(mesh, located, nodal_operators(mesh, located, unknowns))
    return replace(found, weights=found.r * np.outer(
        area, np.outer(weights, weights).ravel() / 4).ravel())


def check_matrix(
    points: GaussPoints, mode: int, theirs: sparse.csr_array, permeability: Floats | float = 1.0
) -> None:
    """Check that GetDP's matrix equals that of our Gauss points, `GaussPoints.stiffness`.

    Raises
    ------
    GetDPError
        If the two matrices differ.
    """
    check_difference(abs(points.stiffness(mode, permeability) - theirs).max() / abs(theirs).max())


def axis_unknowns(mesh: VerifiedMesh, unknowns: Unknowns) -> Ints:
    """Return the unknowns of the functions that do not vanish on the axis."""
    inner = np.flatnonzero(mesh.points[mesh.cells, 0].min(axis=1) == 0)
    along = np.array([-1.0, 0.3, 1.0])  # the side of the axis has three functions
    located = Located(
        np.repeat(inner, len(along)),
        np.tile(np.column_stack([np.full_like(along, -1), along]), (len(inner), 1)),
        sparse.eye_array(len(inner) * len(along), format="csr"))
    value = nodal_operators(mesh, located, unknowns)[0].tocoo()
    return np.unique(value.coords[1][np.abs(value.data) > 1e-12])


SAVED_SOLVES = 2000
"""Solves that reciprocity must save. Below that GetDP takes less than some two minutes for the
blocks, and keeps their solutions in the cache, where they serve other points too."""

COMPONENTS = 3
"""Components of a block's remanence: along its middle, across it, along z. As many solves serve the
readings at one place of the half-plane."""


def saves_solves(magnet: Magnet, points: Floats, blocks: Sequence[int]) -> bool:
    """Tell whether reciprocity takes far fewer solves for the columns of blocks.

    Parameters
    ----------
    magnet : Magnet
        To be solved by azimuthal modes.
    points : ndarray, shape (n, 3), in m
    blocks : sequence of int
        Numbers, from 0, of the blocks that are to be solved for.
    """
    rings = len({magnet.blocks[number].ring for number in blocks})
    if COMPONENTS * rings * (modes_needed(magnet, points) + 1) < SAVED_SOLVES:
        return False  # without looking for the places of the points
    places = len(unique_points(meridian_points(magnet, points))[0])
    return COMPONENTS * (rings - places) * (modes_needed(magnet, points) + 1) >= SAVED_SOLVES


@dataclass(frozen=True)
class _Discrete:
    """The discrete problem in the half-plane, for all modes."""

    stiffness: tuple[sparse.csr_array, sparse.csr_array]
    """K and L: the matrix of mode m is w (K + m^2 L), with w = 2 pi for m = 0 and pi otherwise.
    Shape (unknowns, unknowns)."""
    free: tuple[Ints, Ints]
    """The unknowns to solve for, in an order that keeps the factors sparse: of mode 0, and of all
    higher modes, which vanish on the axis."""
    sources: tuple[sparse.csr_array, sparse.csr_array, sparse.csr_array]
    """Integrals over r dr dz, in each ring, of dv/dr, v/r and dv/dz.
    Shape (unknowns, solved rings)."""
    readings: sparse.csr_array
    """Operators to d psi/dr, psi/r and d psi/dz at the m points, one after the other.
    Shape (3 m, unknowns)."""
    half_angle: Floats
    """Shape (solved rings,), in rad."""

    def gradients(self, mode: int) -> Floats:
        """Return d psi/dr, psi/r and d psi/dz (3 solved rings, points, 3) in T of single blocks.

        The numbering of the first axis is that of pro/azimuthal_modes.pro: component by component.
        """
        free = self.free[mode > 0]
        matrix = sparse.csr_array(self.stiffness[0] + mode**2 * self.stiffness[1])
        factor = factorize(matrix[free][:, free], ordered=True)
        in_r, over_r, in_z = (source[free].T for source in self.sources)
        right = sparse.csr_array(self.readings[:, free])
        found = np.empty((COMPONENTS, len(self.half_angle), right.shape[0]))
        cc, ss, plain = angle_integrals(mode, self.half_angle)
        for number in range(right.shape[0]):  # SuperLU is slower with many columns at once
            solution = factor.solve(right[[number]].toarray()[0])
            radial, azimuthal, axial = in_r @ solution, over_r @ solution, in_z @ solution
            found[:, :, number] = (cc * radial + mode * ss * azimuthal,
                                   ss * radial + mode * cc * azimuthal, plain * axial)
        weight = 2 * np.pi if mode == 0 else np.pi
        return np.moveaxis(found.reshape(COMPONENTS * len(self.half_angle), 3, -1), 1, 2) / weight


def angle_integrals(mode: int, half_angle: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the integrals over a block's angle of cos(t) cos(m t), sin(t) sin(m t) and cos(m t).

    ``half_angle`` (n,) in rad is half of that angle.
    """
    def half_integral(order: int) -> Floats:
        """Return the integral of cos(order t) from 0 to the half angle."""
        return np.asarray(half_angle * np.sinc(order * half_angle / np.pi))

    less, more = half_integral(mode - 1), half_integral(mode + 1)
    return less + more, less - more, 2 * half_integral(mode)


def reciprocal_gradients(case: ModesCase, session: Session) -> dict[int, Floats]:
    """Return what `halbach_fe.solver.azimuthal_modes.solve_modes` needs of single blocks.

    Returns
    -------
    dict of int to ndarray, shape (3 solved rings, m, 3), in T
        d psi/dr, psi/r and d psi/dz at the m points of the half-plane by mode: real materials, and
        for the method ``reaction`` minus vacuum. On the axis the values are placeholders, as those
        of `halbach_fe.solver.azimuthal_modes.read_run`.

    Raises
    ------
    GetDPError
        If GetDP fails, or its matrix differs from that of our Gauss points.
    """
    numbers = range(len(case.weights))
    variants = variants_of(case.magnet)
    if session.counter is not None:
        size = RunSize(
            "azimuthal_modes", case.mesh.elements, unknowns_of(case.mesh.inner, case.mesh.axis, 0),
            COMPONENTS * len(case.meridian) * len(numbers), matrices=len(numbers))
        session.counter.batches.append((session.purpose, [size for _ in variants]))
        return {mode: np.zeros((COMPONENTS * len(case.solved), len(case.meridian), 3))
                for mode in numbers}
    unknowns, theirs = _assembled(case, session)
    points = gauss_points(case.real_mesh, np.arange(case.mesh.elements), unknowns)
    ring, permeability = _materials(case)
    per_element = len(points.r) // case.mesh.elements
    permeability = np.repeat(permeability, per_element)
    check_matrix(points, 0, theirs / (2 * np.pi), permeability)
    problems = [_discrete(case, unknowns, points, np.repeat(ring, per_element), values)
                for values in (permeability, np.ones_like(permeability))[:len(variants)]]
    tasks = [(problem, mode) for mode in numbers for problem in problems]
    results = _in_parallel(tasks, session)
    return {mode: results[number * len(problems)] if len(problems) == 1 else (
        results[2 * number] - results[2 * number + 1]) for number, mode in enumerate(numbers)}


def _in_parallel(tasks: list[tuple[_Discrete, int]], session: Session) -> list[Floats]:
    """Solve problems in modes, ``session.jobs`` at a time, and report progress."""
    with ThreadPoolExecutor(max(1, session.jobs)) as pool:
        futures = [pool.submit(problem.gradients, mode) for problem, mode in tasks]
        try:
            running = set(futures)
            while running:
                done, running = wait(running, LOOK_S, FIRST_EXCEPTION)
                for future in done:
                    future.result()
                if session.progress is not None:
                    session.progress(len(futures) - len(running), len(futures))
        finally:
            for future in futures:
                future.cancel()
    return [future.result() for future in futures]


def _assembled(case: ModesCase, session: Session) -> tuple[Unknowns, sparse.csr_array]:
    """Have GetDP assemble mode 0 with the real materials; return its unknowns and its matrix."""
    # a block along z is a right-hand side that does not vanish
    one = replace(case, solved=case.solved[:1])
    source = one.single[1]
    count = unknowns_of(case.mesh.inner, case.mesh.axis, 0)
    ((unknowns, matrix, _),) = assembled(
        session, case.real_mesh, "azimuthal_modes",
        [("getdp-matrix-mode0", lambda folder: fill_run_folder(
            one, folder, [0], (source, source), source, False, session.time_limit_s))], count)
    return unknowns, matrix


def _materials(case: ModesCase) -> tuple[Ints, Floats]:
    """Return of every element the number of its ring, from 0 (-1: none), and its permeability."""
    mesh, magnet = case.real_mesh, case.magnet
    r, z = mesh.points[mesh.cells, :2].mean(axis=1).T
    ring, permeability = np.full(mesh.elements, -1), np.ones(mesh.elements)
    permeability[mesh.in_iron] = magnet.iron_permeability
    for number, ((low, high), (inner, outer)) in enumerate(magnet.ring_sections):
        inside = (low < z) & (z < high) & (inner < r) & (r < outer)
        ring[inside] = number
        permeability[inside] = magnet.blocks[magnet.number_of(number + 1, 1)].recoil_permeability
    return ring, permeability


def _discrete(
    case: ModesCase, unknowns: Unknowns, points: GaussPoints, ring: Ints, permeability: Floats
) -> _Discrete:
    """Return the discrete problem; ``points``, ``ring`` and ``permeability`` (k,) are those of all
    Gauss points.
    """
    plain, first = (points.stiffness(mode, permeability) for mode in (0, 1))
    fixed = axis_unknowns(case.real_mesh, unknowns)
    order = np.argsort(factorize(plain).perm_c)
    number = np.full(len(case.magnet.ring_sections) + 1, -1)
    number[list(case.solved)] = np.arange(len(case.solved))
    here = np.flatnonzero(number[ring] >= 0)
    integrals = sparse.csr_array((points.weights[here], (here, number[ring][here])),
                                 shape=(len(points.r), len(case.solved)))
    value, (along_r, along_z) = grid_operators(case.real_mesh, case.located, unknowns)
    r = np.where(case.meridian[:, 0] < AXIS_RADIUS * case.magnet.bore_radius, np.inf,
                 case.meridian[:, 0])
    magnet = case.magnet
    return _Discrete(
        (plain, sparse.csr_array(first - plain)), (order, order[~np.isin(order, fixed)]),
        tuple(sparse.csr_array(operator.T @ integrals)
              for operator in (points.along_r, points.over_r, points.along_z)),
        sparse.csr_array(sparse.vstack([along_r, sparse.diags_array(1 / r) @ value, along_z])),
        np.pi / np.array([magnet.blocks_by_ring[number] for number in case.solved]))
