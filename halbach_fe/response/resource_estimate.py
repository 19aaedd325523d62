"""An estimate of the memory, time and disk that a run needs, before it is started.

The functions that would solve the field are called with a session that counts the runs of GetDP
instead of starting them. Meshes are counted as well, not built: that of a half-plane is a grid, and
the number of elements of an extruded mesh follows from the number of its plane triangles
(`halbach_fe.geo.plane_size`), which is quick to find.

The memory and time of a GetDP process are functions of its number of unknowns, see `CostLaw`. Their
constants were measured with GetDP 3.2, MUMPS and OpenBLAS on one thread of a reference machine. The
speed of the present machine relative to it follows from the time of a factorization.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from halbach_fe.core.arrays import Floats, radii_of
from halbach_fe.core.errors import MeasurementError, PointsOutsideError
from halbach_fe.core.threads import available_memory
from halbach_fe.geometry.blocks import present_blocks
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import unique_points
from halbach_fe.measurement.observation_operator import Observation
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.discretization_error import reading_errors, variants_to_compare
from halbach_fe.response.response_matrix import LOADED_BYTES
from halbach_fe.solver.azimuthal_modes import is_axisymmetric, meridian_points, mode_decay
from halbach_fe.solver.magnetostatics import check_inside
from halbach_fe.solver.moments.cells import cells_of
from halbach_fe.solver.moments.interaction import Interaction
from halbach_fe.solver.routes import Route, check_points, choose_route, finite_element_part
from halbach_fe.solver.session import RunSize, Session
from halbach_fe.stats.posteriors import NUMBERS_AT_ONCE, READINGS_AT_ONCE
from halbach_fe.study.model import CELLS_PER_SIDE
from halbach_fe.study.types import COMPONENTS

GIB = 2.0**30
EXACT_FIELD_ONLY = "exact_field_only"
"""Route of an estimate without finite elements."""

UPDATED_MAGNET = "the updated magnet"
"""Purpose of the solve that checks whether the iron is linear enough."""

TIME_FACTOR = 3.0
"""Factor within which the estimated times hold. On nine studies the estimated processor time of all
GetDP runs was 0.95 to 2.3 times the measured one, and machines differ in more than their speed."""


@dataclass(frozen=True)
class CostLaw:
    """Memory and time of a GetDP process as functions of its number n of unknowns.

    To the memory in bytes of a process comes ``n (bytes_each + fill n^(1/3))``. The factors of a
    matrix grow as n^(4/3) in 3D (A. George, SIAM J. Numer. Anal. 10 (1973) 345) and as n log n in a
    plane, where the logarithm is too weak to matter. To the time in seconds on the reference
    machine comes ``matrix_s n^power`` for every matrix and ``solve_s n`` for every solve.
    """

    bytes_each: float
    fill: float
    matrix_s: float
    solve_s: float
    power: float = 1.0


PLANE = CostLaw(3600, 0, 1.8e-5, 8e-7)
"""Law for plane meshes. The memory is within 5 % of that of eleven runs on cross-sections and
half-planes with 3 400 to 152 000 unknowns, the time within 30 % of that of eight runs with 38 000
to 139 000 unknowns, 1 to 29 matrices and 1 to 580 solves. Of the bytes per unknown,
``-petsc_prealloc 200`` takes 2400."""

FACTORIZED = CostLaw(2480, 150, 1.1e-6, 1.3e-6, 1.4)
"""Law for the scalar potential with a factorized matrix. It fits runs with 36 000, 61 000, 96 000
and 99 000 unknowns: the memory within 8 %, except for a flat magnet, whose factors are smaller. For
that magnet the law gives 26 % too much memory and twice the time."""

ITERATED = CostLaw(5150, 0, 2e-5, 5.8e-5)
"""Law for the scalar potential with conjugate gradients. It fits runs with 226 000 and 274 000
unknowns: the memory within 1 %, and without iron the time within 5 %."""

EDGES = {1: CostLaw(2700, 90, 7e-7, 1.5e-6, 1.4), 2: CostLaw(2430, 88, 5.5e-7, 1.5e-6, 1.4)}
"""Laws for edge elements, by their order. The law of the first order fits runs with 27 000 to
206 000 unknowns on three magnets: the memory within 7 %, the time within 40 %. That of the second
order fits runs with 42 000, 132 000 and 264 000 unknowns within 4 % and 20 %."""

STEPPED = CostLaw(10_700, 0, 8e-5, 0)
"""Law for multigrid in Newton's steps. Together with the bytes for the Jacobian it fits the memory
of runs with 61 000 and 203 000 unknowns within 1 %."""

PYTHON_BYTES = 0.27 * GIB
"""Memory in bytes of this program with its libraries."""

MESH_BYTES = {"cross_section": 104, "meridian": 70, "extruded": 104}
"""Bytes per element of a mesh file, by the kind of mesh."""

UNKNOWN_BYTES = {"edge_elements": 75}
"""Bytes per unknown of GetDP's list of unknowns, by route."""

COARSER = {"cross_section": "enlarge mesh.block_size_m",
           "meridian": "enlarge mesh.meridian_size_m",
           "extruded": "enlarge mesh.block_size_m, mesh.bore_size_m or mesh.growth, or take fewer "
                       "mesh.layers_per_ring"}
"""Advice on how to reduce the number of elements, by the kind of mesh."""


@dataclass(frozen=True)
class Problem:
    """Runs of GetDP that are equal in size."""

    what: str
    """Purpose of the mesh; all runs on the same mesh may go side by side."""
    route: str
    """Formulation, see `halbach_fe.solver.routes.choose_route`."""
    elements: int
    unknowns: int
    """Numbers of elements and unknowns of each run."""
    processes: int
    """Number of runs, each of which is a GetDP process."""
    matrices: int
    solves: int
    """Numbers of matrices that each process factorizes (or prepares for iterations), and of linear
    systems that it solves."""
    memory_GiB: float
    seconds: float
    disk_GiB: float
    """Peak memory of each process, its time alone on a core, and the size of its run folder."""


@dataclass(frozen=True)
class Estimate:
    """The memory, time and disk that a run of the command line is expected to need."""

    study: str
    """Name of the study."""
    route: str
    """Formulation of the study's own solve, or ``exact_field_only`` if the exact field needs no
    finite elements."""
    blocks: int
    readings: int
    parameters: int
    """Sizes of the problem; the number of parameters is 0 if there is no inference."""
    jobs: int
    """Number of GetDP processes that run at a time."""
    problems: tuple[Problem, ...]
    """Runs of GetDP, in the order in which they are solved."""
    own_memory_GiB: float
    """Peak memory of this program."""
    memory_GiB: float
    """Peak memory of this program and of the GetDP processes that run at a time."""
    disk_GiB: float
    seconds: float
    """Disk space and time of the whole run."""
    available_GiB: float | None
    """Memory that the machine has left; None if it is not known."""

    @property
    def processes(self) -> int:
        """Number of GetDP processes of the whole run."""
        return sum(problem.processes for problem in self.problems)

    @property
    def solves(self) -> int:
        """Number of linear solves of the whole run."""
        return sum(problem.processes * problem.solves for problem in self.problems)

    @property
    def warning(self) -> str | None:
        """A sentence about what to change if the memory does not suffice, or None if it does."""
        if self.available_GiB is None or self.memory_GiB <= self.available_GiB:
            return None
        hints = []
        alone = self.own_memory_GiB + max((each.memory_GiB for each in self.problems), default=0.0)
        if alone <= self.available_GiB < self.memory_GiB:
            hints.append(f"use --jobs 1 ({alone:.2g} GiB)")
        largest = max(self.problems, key=lambda problem: problem.memory_GiB, default=None)
        if largest is None or largest.memory_GiB < self.own_memory_GiB:
            hints.append("take fewer mesh.cells_per_side" if self.route == "moments"
                         else "take fewer readings")
        else:
            hints.append(COARSER[str(Route(largest.route).mesh)])
            if largest.route == "edge_elements" and self.route == largest.route:
                hints.append("or take another solver.route or a lower solver.edge_order")
        return (f"This needs about {self.memory_GiB:.2g} GiB of memory, and the machine has "
                f"{self.available_GiB:.2g} GiB left: {', '.join(hints)}.")

    def as_dict(self) -> dict[str, Any]:
        """Return the estimate as plain data for JSON."""
        return asdict(self) | {"processes": self.processes, "solves": self.solves,
                               "warning": self.warning}


def estimate_solve(magnet: Magnet, observation: Observation, jobs: int) -> Estimate:
    """Estimate the cost of solving the field of the nominal array, with error bars."""
    check_points(magnet, observation.points)
    check_domain(magnet, observation.points)
    session = Session.counting(jobs)
    few = decisive_points(magnet, observation.points)
    parts = finite_element_part(magnet, few.points, session, columns=False)
    reading_errors(magnet, few, parts, session)
    return _estimate(magnet, observation.points, len(observation), session, jobs)


def estimate_infer(magnet: Magnet, observation: Observation, jobs: int) -> Estimate:
    """Estimate the cost of the response matrix, with error bars, and of the update."""
    check_points(magnet, observation.points)
    try:
        check_domain(magnet, observation.points)
    except PointsOutsideError as error:
        raise MeasurementError(error.sentence(f"map of study {error.study}")) from None
    session = Session.counting(jobs)
    few = decisive_points(magnet, observation.points)
    parts = finite_element_part(magnet, few.points, session)
    reading_errors(magnet, few, parts, session)
    if magnet.is_nonlinear:  # `infer` checks whether the iron is linear enough
        finite_element_part(magnet, few.points, replace(session, purpose=UPDATED_MAGNET),
                            columns=False)
    return _estimate(magnet, observation.points, len(observation), session, jobs,
                     magnet.dimension * len(magnet.blocks))


def estimate_verify(magnet: Magnet, jobs: int) -> Estimate:
    """Estimate the cost of `verify`: refinement, a farther boundary and the dual formulation."""
    points = points_from(magnet.study.observation.positions)
    check_points(magnet, points)
    check_domain(magnet, points)
    session = Session.counting(jobs)
    few = decisive_points(magnet, points)
    for purpose, variant in variants_to_compare(magnet, points).items():
        finite_element_part(variant, few.points, replace(session, purpose=purpose), columns=False)
    return _estimate(magnet, points, 3 * len(points), session, jobs,
                     variants=tuple(variants_to_compare(magnet, points).values()))


def check_domain(magnet: Magnet, points: Floats) -> None:
    """Refuse points (n, 3) outside the mesh that the solver will make, as it does itself."""
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        return
    kind = choose_route(magnet, points).mesh
    if kind is None:  # blocks without a mesh need no boundary
        return
    half_length = boundary_half_length(magnet, kind) if magnet.dimension == 3 else np.inf
    check_inside(magnet.name, boundary_radius(magnet, kind), half_length, points)


def decisive_points(magnet: Magnet, points: Floats) -> Observation:
    """Return an observation of the few points that determine the runs of GetDP.

    These are the point that needs the most azimuthal modes, and the points farthest from the axis
    and from the plane z = 0. If azimuthal modes apply, there is also a point at every place (r, z)
    of the half-plane, up to the number of rings: whether there are fewer places than rings decides
    what is solved for, see `halbach_fe.solver.iron_modes`.
    """
    decisive = [
        np.argmax(mode_decay(magnet, points)) if magnet.dimension == 3 else 0,
        np.argmax(radii_of(points)), np.argmax(np.abs(points[:, 2]))]
    if is_axisymmetric(magnet):
        places = unique_points(meridian_points(magnet, points))[1]
        decisive += np.unique(places, return_index=True)[1][:len(magnet.blocks_by_ring)].tolist()
    few = points[np.unique(np.array(decisive, int))]
    readings = sparse.csr_array(sparse.eye_array(3 * len(few)))
    labels = tuple(f"B{name}" for name in COMPONENTS) * len(few)
    return Observation(few, readings, readings, few, labels, np.repeat(few, 3, axis=0))


def problems_of(magnet: Magnet, session: Session) -> list[Problem]:
    """Return the runs that a session has counted, with equal runs put together."""
    assert session.counter is not None
    return [_problem(magnet, purpose, size, count)
            for purpose, sizes in session.counter.batches
            for size, count in Counter(sizes).items()]


def _problem(magnet: Magnet, purpose: str, size: RunSize, processes: int) -> Problem:
    """Return the cost of some equal runs, by the `CostLaw` of their route."""
    route = Route(size.route)
    formulation = route.formulation(magnet)
    law = {"cross_section": PLANE, "azimuthal_modes": PLANE, "edge_elements": EDGES[
        magnet.study.solver.edge_order]}.get(size.route, FACTORIZED)
    iron_iterations = 5.0  # factor by which thin iron increases the number of iterations
    if size.route == "scalar_potential" and size.unknowns > formulation.factorized:
        law = ITERATED
        if magnet.iron:
            law = replace(law, solve_s=iron_iterations * law.solve_s)
    matrices, solves = size.matrices, size.solves
    # for Newton's method: additional bytes per unknown for the Jacobian, matrices per step, and the
    # assumed number of steps (3 to 9 were seen). The first two were measured with 11 000 and 86 000
    # unknowns.
    newton_bytes, newton_matrices, newton_steps = 4400, 2, 6
    if size.newton:
        if not solves and size.unknowns > formulation.factorized_for_newton:
            law = STEPPED
        law = replace(law, bytes_each=law.bytes_each + newton_bytes)
        matrices, solves = newton_matrices * newton_steps, solves + newton_steps
    each = law.bytes_each + law.fill * size.unknowns ** (1 / 3)
    # memory and time of a GetDP process that do not depend on its number of unknowns
    getdp_bytes, getdp_seconds = 50e6, 0.1
    seconds = (getdp_seconds + matrices * law.matrix_s * size.unknowns**law.power
               + solves * law.solve_s * size.unknowns)
    other_unknown_bytes = 30  # bytes per unknown of GetDP's list of unknowns for all other routes
    disk = size.elements * MESH_BYTES[str(route.mesh)] + size.unknowns * (
        UNKNOWN_BYTES.get(size.route, other_unknown_bytes) + 8 * solves)
    return Problem(purpose, size.route, size.elements, size.unknowns, processes, matrices, solves,
                   (getdp_bytes + size.unknowns * each) / GIB, seconds, disk / GIB)


def _estimate(
    magnet: Magnet, points: Floats, readings: int, session: Session, jobs: int,
    parameters: int = 0, variants: Sequence[Magnet] = (),
) -> Estimate:
    """Add the cost of this program itself: for elements, for fields of blocks at points, for H.

    ``variants`` are the magnets that are solved, by default the magnet itself.
    """
    blocks, speed, problems = magnet.blocks, machine_speed(), problems_of(magnet, session)
    elements = max((problem.elements for problem in problems), default=0)
    matrix = readings * parameters
    exact = 0 if magnet.study.solver.method == "direct" else len(points)
    moments_bytes, moments_seconds = _cost_of_moments(variants or (magnet,), points, matrix)
    fields = parameters * len(points) * 3 if problems or moments_seconds else 0
    information = parameters * min(readings, parameters)
    # memory in bytes per point for the exact field of a block: its matrix in the frames of the
    # block and of the magnet, and the product between them
    point_bytes = 340
    # the fields of the blocks are freed before the posterior is computed
    building = 8 * fields + point_bytes * exact + moments_bytes
    # numbers of copies in memory of the rows of H that are processed together, and of the square
    # root of the information while its singular values are computed. They were measured with 48 to
    # 30 720 parameters and 1 008 to 28 080 readings.
    part_copies, information_copies = 4, 3
    updating = 8 * (part_copies * min(matrix, NUMBERS_AT_ONCE, READINGS_AT_ONCE * parameters)
                    + information_copies * information)
    # memory in bytes and time in s per reading for labels, tables and figures, measured with a
    # million readings
    reading_bytes, reading_seconds = 1200, 6e-5
    # memory in bytes per element for the mesh and the unknowns that are read: it was 1000 to 2100
    # for meshes of 10 000 to 208 000 elements
    element_bytes = 2000
    # memory in bytes per unknown to solve for iron of any shape in this program: 5600 were measured
    # with 444 000 unknowns, of saturating plates
    solved = (magnet.iron and not magnet.iron_is_axisymmetric
              and choose_route(magnet, points) is Route.MOMENTS)
    solving = 5600 * max((each.unknowns for each in problems), default=0) if solved else 0
    own = (PYTHON_BYTES + element_bytes * elements + solving + max(building, updating)
           + (reading_bytes * readings if parameters else 0)
           + (8 * matrix if 8 * matrix <= LOADED_BYTES else 8 * NUMBERS_AT_ONCE)) / GIB
    side_by_side = 0.0
    # time in s of this program: to start and to write the report; per element of every GetDP
    # process; per block and point of the exact field; and per entry of H, times the number of
    # parameters or readings, whichever is smaller. Two threads took 2e-7 to 5e-7 s per block and
    # point, in a plane and for sectors in space.
    own_seconds, element_seconds, pair_seconds, matrix_seconds = 5.0, 1.5e-5, 5e-7, 1e-9
    seconds = own_seconds + element_seconds * sum(
        problem.elements * problem.processes for problem in problems)
    seconds += moments_seconds + pair_seconds * len(blocks) * exact
    seconds += matrix_seconds * matrix * min(readings, parameters)
    seconds += reading_seconds * readings if parameters else 0
    for purpose in dict.fromkeys(problem.what for problem in problems):
        runs = [run for problem in problems if problem.what == purpose
                for run in [problem] * problem.processes]
        largest = sorted((run.memory_GiB for run in runs), reverse=True)[:jobs]
        side_by_side = max(side_by_side, sum(largest))
        at_once = min(jobs, os.cpu_count() or 1)
        seconds += max(max(run.seconds for run in runs),
                       sum(run.seconds for run in runs) / at_once)
    return Estimate(
        study=magnet.name, blocks=len(blocks), readings=readings, parameters=parameters, jobs=jobs,
        route=_route(magnet, points, problems),
        problems=tuple(replace(problem, seconds=problem.seconds / speed) for problem in problems),
        own_memory_GiB=own, memory_GiB=own + side_by_side,
        disk_GiB=sum(problem.processes * problem.disk_GiB for problem in problems)
        + 8 * (matrix + information) / GIB,
        seconds=seconds / speed, available_GiB=available_memory())


def _cost_of_moments(
    magnets: Sequence[Magnet], points: Floats, entries: int
) -> tuple[float, float]:
    """Return the memory in bytes and the time in s of the method of moments, with its iron.

    ``entries`` is the number of entries of H. Both results are 0 for other routes.
    """
    there = [magnet for magnet in magnets if not magnet.is_vacuum
             and choose_route(magnet, points) is Route.MOMENTS]
    found = [Interaction(cells_of(present_blocks(magnet.blocks),
                                  magnet.study.mesh.cells_per_side or CELLS_PER_SIDE))
             for magnet in there]
    cells = [len(each.cells) for each in found]
    iron = [magnet for magnet in there if magnet.iron and magnet.iron_is_axisymmetric]
    # memory in bytes of the method of moments per cell, per cell if H is computed too, and per pair
    # of near cells. Slender and flat cells have many times the pairs of cubes. Without H the sum is
    # within 20 % of that of lattices of 108 to 500 hexagonal prisms of 20 and 60 mm, aligned and
    # turned at random, and of 512 and 1 728 cubes; with H it is that of the cubes above.
    cell_bytes, column_cell_bytes, near_bytes = 8_000, 43_000, 300
    per_cell = column_cell_bytes if entries else cell_bytes
    # memory in bytes and time in s of iron by azimuthal modes with separate blocks in turn.
    # Measured with 990 cubes in a tube that is 4 mm from them; iron that is farther away takes
    # less.
    modes_bytes, modes_seconds = 2.0 * GIB, 60.0
    memory = modes_bytes * bool(iron) + max(
        (per_cell * len(each.cells) + near_bytes * each.near_pairs for each in found), default=0)
    # time in s of the method of moments per cell, and per entry of H. Measured with 990 cubes and
    # 396 readings, and with 4 032 cubes and 432 readings.
    cell_seconds, column_seconds = 1.2e-3, 1.6e-5
    return memory, (cell_seconds * sum(cells) + column_seconds * entries * bool(there)
                    + modes_seconds * len(iron))


def _route(magnet: Magnet, points: Floats, problems: Sequence[Problem]) -> str:
    """Return the route of most points: that of the first run of GetDP, if there is any."""
    if problems and magnet.iron_is_axisymmetric:
        return problems[0].route
    return EXACT_FIELD_ONLY if magnet.is_vacuum else choose_route(magnet, points)


@cache
def machine_speed() -> float:
    """Return the speed of this machine relative to the reference machine.

    It is measured once, by the shortest time of three factorizations of a sparse matrix of fixed
    size.
    """
    # side of the grid whose factorization measures the speed of a machine, and the processor time
    # in s that the factorization took on the reference machine
    side, usual_seconds = 150, 0.095
    line = sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(side, side))
    identity = sparse.eye_array(side)
    matrix = sparse.csc_array(sparse.kron(line, identity) + sparse.kron(identity, line))

    def factorize() -> float:
        started = time.perf_counter()
        splu(matrix)
        return time.perf_counter() - started

    return usual_seconds / min(factorize() for _ in range(3))
