"""What a run will take in memory, time and disk, before anything is solved.

The problems are those that `routes`, `discretization` and `verification` will pose, counted in
place of solved. Meshes are counted too: the half-plane's is a grid, and the stacked mesh follows
from the number of its plane triangles (`halbach_fe.geo.plane_size`), of which there are few.

What one GetDP process takes is a law of its unknowns, see `CostLaw`. Measured with GetDP 3.2, MUMPS
and OpenBLAS, one thread; seconds are in units of a factorization that is timed anew.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, PointsOutsideError
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import Symmetry, no_symmetry, symmetry_of, unique_points
from halbach_fe.measurement.observation import Observation
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.discretization_error import DUAL, REFINEMENT, dual, farther, refined
from halbach_fe.response.matrix import LOADED_BYTES
from halbach_fe.solver.azimuthal_modes import (
    NOMINAL_SOURCES,
    modes_needed,
    nominal_waves,
    spans_of,
    unknowns_of,
)
from halbach_fe.solver.field import (
    MESHES,
    axisymmetric_stand_in,
    check_points,
    choose_route,
    formulation_of,
    uses_symmetry,
)
from halbach_fe.solver.magnetostatics import check_inside
from halbach_fe.solver.mesh import Entities, meridian_size
from halbach_fe.stats.linear_gaussian import NUMBERS_AT_ONCE, READINGS_AT_ONCE

GIB = 2.0**30
EXACT_FIELD_ONLY = "exact_field_only"

TIME_FACTOR = 3.0
"""Times are right within it: on nine studies the processor time of all GetDP runs was foretold
between 0.95 and 2.3 times too long, and machines differ in other ways than by their speed."""


@dataclass(frozen=True)
class CostLaw:
    """What a GetDP process takes, by its number n of unknowns.

    Memory is ``GETDP_BYTES + n (bytes_each + fill n^(1/3))``: the factors of a matrix grow as
    n^(4/3) in 3D (A. George, SIAM J. Numer. Anal. 10 (1973) 345), in a plane as n log n, whose
    logarithm does not show. Seconds on the reference machine are ``GETDP_SECONDS``, and
    ``matrix_s n^power`` for every matrix, and ``solve_s n`` for every solve.
    """

    bytes_each: float
    fill: float
    matrix_s: float
    solve_s: float
    power: float = 1.0


GETDP_BYTES, GETDP_SECONDS = 50e6, 0.1

PLANE = CostLaw(3600, 0, 1.5e-5, 2.3e-6)
"""Eleven runs on cross-sections and half-planes, 3 400 to 152 000 unknowns, 1 to 9 solves: memory
within 5 %, of which 2400 bytes each are what ``-petsc_prealloc 200`` takes; time within 20 %."""

FACTORIZED = CostLaw(2480, 150, 1.1e-6, 1.3e-6, 1.4)
"""Scalar potential, 36 000, 61 000, 96 000 and 99 000 unknowns: memory within 8 % but for a flat
magnet, whose factors are smaller: 26 % too much, and twice the time."""

ITERATED = CostLaw(5150, 0, 2e-5, 5.8e-5)
"""By conjugate gradients, 226 000 and 274 000 unknowns: memory within 1 %, time without iron within
5 %. Thin iron takes five times as many iterations."""

IRON_ITERATIONS = 5.0

EDGES = {1: CostLaw(2700, 90, 7e-7, 1.5e-6, 1.4), 2: CostLaw(2430, 88, 5.5e-7, 1.5e-6, 1.4)}
"""Edge elements by order. First: 27 000 to 206 000 unknowns on three magnets, memory within 7 %,
time within 40 %. Second: 42 000, 132 000 and 264 000, memory within 4 %, time within 20 %."""

STEPPED = CostLaw(10_700, 0, 8e-5, 0)
"""Multigrid for Newton's steps, 61 000 and 203 000 unknowns: with `NEWTON_BYTES`, within 1 %."""

NEWTON_BYTES, NEWTON_MATRICES, NEWTON_STEPS = 4400, 2, 6
"""By unknown, for the matrix of the Jacobian, and by step, both measured at 11 000 and 86 000
unknowns; 3 to 9 steps were seen."""

PYTHON_BYTES, ELEMENT_BYTES = 0.27 * GIB, 2000
"""This program, its libraries, and what it reads of a mesh and its unknowns: measured 1000 to 2100
by element, of 10 000 to 208 000."""

PART_COPIES, INFORMATION_COPIES = 4, 3
"""Of the rows of H that are taken at once, and of the square root of the information, while its
singular values are found; measured with 48 to 30 720 parameters and 1 008 to 28 080 readings."""

READING_BYTES, READING_SECONDS = 1200, 6e-5
"""For labels, tables and pictures of every reading; a million were measured."""

CHUNK_BYTES, CHUNK_PLACES, PLACE_BYTES, PLACES_AT_ONCE = 230e6, 40_000, 180, 4_000_000
"""The exact field from 96 000 and 576 000 places (see `_places`): temporary arrays, which many
places fill, and what is kept of each."""

OWN_SECONDS, ELEMENT_SECONDS, PLACE_SECONDS, MATRIX_SECONDS = 5.0, 1.5e-5, 2.5e-5, 1e-9
"""To start and to report; by element of every process; by place; by entry of H and parameter, or
reading if there are fewer."""

COUNTED_PLACES = 500_000
"""At most, half a second."""

MESH_BYTES = {"cross_section": 104, "meridian": 70, "extruded": 104}
"""Of the file, by element, by kind of mesh."""

UNKNOWN_BYTES = {"edge_elements": 75}
"""Of GetDP's list of unknowns, by unknown, by route; of the others `OTHER_UNKNOWN_BYTES`."""

OTHER_UNKNOWN_BYTES = 30

GRID, GRID_SECONDS = 150, 0.095
"""The grid whose factorization tells a machine's speed, and the processor time that it took where
the laws were measured."""

COARSER = {"cross_section": "enlarge mesh.block_size_m",
           "meridian": "enlarge mesh.meridian_size_m",
           "extruded": "enlarge mesh.block_size_m, mesh.bore_size_m or mesh.growth, or take fewer "
                       "mesh.layers_per_ring"}
"""How to have fewer elements, by kind of mesh."""


@dataclass(frozen=True)
class Problem:
    """Runs of GetDP that are alike.

    Attributes
    ----------
    what : str
        Which of the meshes; all runs of a mesh may go side by side.
    route : str
    elements, unknowns : int
    processes : int
    matrices, solves : int
        To be factorized (or prepared for iterations), and to be solved, by each process.
    memory_GiB, seconds, disk_GiB : float
        Of each process: at its peak, alone on a core, of its run folder.
    """

    what: str
    route: str
    elements: int
    unknowns: int
    processes: int
    matrices: int
    solves: int
    memory_GiB: float
    seconds: float
    disk_GiB: float


@dataclass(frozen=True)
class Estimate:
    """What a run will take.

    Attributes
    ----------
    route : str
        The study's own, or ``exact_field_only`` if nothing is left to finite elements.
    blocks, readings, parameters : int
        Parameters are 0 where there is no inference.
    problems : tuple of Problem
        In the order in which they are solved.
    own_memory_GiB : float
        Of this program at its peak.
    memory_GiB : float
        Of this program and as many GetDP processes as run at a time, all at their peaks.
    disk_GiB, seconds : float
    available_GiB : float or None
        Memory that the machine has left; None if it does not say.
    """

    study: str
    route: str
    blocks: int
    readings: int
    parameters: int
    jobs: int
    problems: tuple[Problem, ...]
    own_memory_GiB: float
    memory_GiB: float
    disk_GiB: float
    seconds: float
    available_GiB: float | None

    @property
    def processes(self) -> int:
        """GetDP processes of the whole run."""
        return sum(one.processes for one in self.problems)

    @property
    def solves(self) -> int:
        """Linear solves of the whole run."""
        return sum(one.processes * one.solves for one in self.problems)

    @property
    def warning(self) -> str | None:
        """What to change if the memory is not enough; None if it is."""
        if self.available_GiB is None or self.memory_GiB <= self.available_GiB:
            return None
        hints = []
        alone = self.own_memory_GiB + max((one.memory_GiB for one in self.problems), default=0.0)
        if alone <= self.available_GiB < self.memory_GiB:
            hints.append(f"use --jobs 1 ({alone:.2g} GiB)")
        largest = max(self.problems, key=lambda one: one.memory_GiB, default=None)
        if largest is None or largest.memory_GiB < self.own_memory_GiB:
            hints.append("take fewer readings")
        else:
            hints.append(COARSER[MESHES[largest.route]])
            if largest.route == "edge_elements" and self.route == largest.route:
                hints.append("or take another solver.route or a lower solver.edge_order")
        return (f"This needs about {self.memory_GiB:.2g} GiB of memory, and the machine has "
                f"{self.available_GiB:.2g} GiB left: {', '.join(hints)}.")

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"processes": self.processes, "solves": self.solves,
                               "warning": self.warning}


@dataclass(frozen=True)
class CountedMesh:
    """How many parts a mesh will have: elements, and what is off its boundary and on its axis."""

    elements: int
    inner: Entities
    axis: Entities


def estimate_solve(magnet: Magnet, observation: Observation, jobs: int) -> Estimate:
    """What the field of the nominal array takes, with error bars."""
    check_points(magnet, observation.points)
    problems = [*nominal(magnet, observation.points, jobs), *error_bars(magnet, observation, jobs)]
    return _estimate(magnet, observation.points, len(observation), problems, jobs)


def estimate_infer(magnet: Magnet, observation: Observation, jobs: int) -> Estimate:
    """What the matrix H takes, with error bars, and the update."""
    points = observation.points
    check_points(magnet, points)
    try:
        problems = field_of_blocks(magnet, points, jobs)
    except PointsOutsideError as error:
        raise MeasurementError(error.sentence(f"map of study {error.study}")) from None
    if axisymmetric_stand_in(magnet, choose_route(magnet, points), points) is None:
        problems += error_bars(magnet, observation, jobs)
    if magnet.is_nonlinear:  # is the iron linear enough?
        problems += nominal(magnet, points, jobs, "the updated magnet")
    return _estimate(magnet, points, len(observation), problems, jobs,
                     magnet.dimension * len(magnet.blocks))


def estimate_verify(magnet: Magnet, jobs: int) -> Estimate:
    """What refinement, a farther boundary and the dual route take."""
    points = points_from(magnet.study.observation.positions)
    check_points(magnet, points)
    route = choose_route(magnet, points)
    variants = {"the study's mesh": magnet, "a coarser mesh": refined(magnet, 1 / REFINEMENT),
                "a finer mesh": refined(magnet, REFINEMENT),
                "a farther boundary": farther(magnet, MESHES[route], REFINEMENT)}
    if route in DUAL:
        variants["the dual route"] = dual(magnet, route)
    problems = [problem for what, variant in variants.items()
                for problem in nominal(variant, points, jobs, what)]
    return _estimate(magnet, points, 3 * len(points), problems, jobs)


def nominal(
    magnet: Magnet, points: Floats, jobs: int, what: str = "the study's mesh"
) -> list[Problem]:
    """What `routes.finite_element_part` solves without single blocks."""
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        return []
    return runs_of(magnet, choose_route(magnet, points), points, (), jobs, what)


def field_of_blocks(magnet: Magnet, points: Floats, jobs: int) -> list[Problem]:
    """What `routes.finite_element_part` solves with single blocks."""
    if magnet.study.solver.method == "reaction" and magnet.is_vacuum:
        return []
    route = choose_route(magnet, points)
    near = axisymmetric_stand_in(magnet, route, points)
    if near is not None:
        return field_of_blocks(near, points, jobs) + [
            problem for one, what in ((magnet, "as it is"), (near, "simpler"))
            for problem in runs_of(one, "scalar_potential", points, (), jobs, what)]
    return runs_of(magnet, route, points, _symmetry(magnet).sources, jobs, "the study's mesh")


def error_bars(magnet: Magnet, observation: Observation, jobs: int) -> list[Problem]:
    """What `discretization.reading_errors` solves."""
    route = choose_route(magnet, observation.points)
    if route in DUAL:
        return nominal(dual(magnet, route), observation.points, jobs, "error bars, dual route")
    coarser, far = refined(magnet, 1 / REFINEMENT), farther(magnet, MESHES[route], REFINEMENT)
    return [*nominal(coarser, observation.points, jobs, "error bars, coarser mesh"),
            *nominal(far, observation.points, jobs, "error bars, farther boundary")]


def runs_of(
    magnet: Magnet, route: str, points: Floats, blocks: Sequence[int], jobs: int, what: str
) -> list[Problem]:
    """The runs for the nominal array, and for blocks with 1 T along each axis.

    They are what `solve.solve_sources`, `solve_tangent`, `solve_samples` and
    `azimuthal.solve_modes` start.
    """
    kind = MESHES[route]
    half = boundary_half_length(magnet, kind) if magnet.dimension == 3 else np.inf
    check_inside(magnet.name, boundary_radius(magnet, kind), half, points)
    mesh = counted(magnet, kind)
    variants = 1 if magnet.study.solver.method == "direct" else 2
    sources = 1 + magnet.dimension * len(blocks)

    def problem(unknowns: int, law: CostLaw, processes: int, matrices: int, solves: int) -> Problem:
        each = law.bytes_each + law.fill * unknowns ** (1 / 3)
        seconds = (GETDP_SECONDS + matrices * law.matrix_s * unknowns**law.power
                   + solves * law.solve_s * unknowns)
        disk = mesh.elements * MESH_BYTES[kind] + unknowns * (
            UNKNOWN_BYTES.get(route, OTHER_UNKNOWN_BYTES) + 8 * solves)
        return Problem(what, route, mesh.elements, unknowns, processes, matrices, solves,
                       (GETDP_BYTES + unknowns * each) / GIB, seconds, disk / GIB)

    if route == "azimuthal_modes":
        weights = nominal_waves(magnet, modes_needed(magnet, points))
        rings = len({number // magnet.array.blocks_per_ring for number in blocks})
        each = (NOMINAL_SOURCES - 1 + 3 * rings) * unknowns_of(mesh.inner, mesh.axis, 1)
        spans = [(first, last - first + 1) for first, last in spans_of(
            weights, bool(blocks), each)]
        return [problem(unknowns_of(mesh.inner, mesh.axis, first), PLANE, variants, modes,
                        modes * (NOMINAL_SOURCES + 3 * rings)) for first, modes in spans]
    formulation = formulation_of(magnet, route)
    unknowns = formulation.unknowns(mesh.inner)
    law = PLANE if route == "cross_section" else EDGES[magnet.study.solver.edge_order]
    if route == "scalar_potential":
        law = FACTORIZED if unknowns <= formulation.factorized else ITERATED
        if law is ITERATED and magnet.iron_ring is not None:
            law = replace(law, solve_s=IRON_ITERATIONS * law.solve_s)
    if not magnet.is_nonlinear:
        parts = min(sources, max(1, jobs // variants))
        return [problem(unknowns, law, variants * parts, 1, math.ceil(sources / parts))]
    linear = [problem(unknowns, law, 1, 1, sources)] if blocks and variants == 2 else []
    if not blocks and unknowns > formulation.factorized_for_newton:
        law = STEPPED
    law = replace(law, bytes_each=law.bytes_each + NEWTON_BYTES)
    return [problem(unknowns, law, 1 if blocks else variants, NEWTON_MATRICES * NEWTON_STEPS,
                    NEWTON_STEPS + (sources if blocks else 0)), *linear]


def _symmetry(magnet: Magnet) -> Symmetry:
    return symmetry_of(magnet) if uses_symmetry(magnet) else no_symmetry(magnet)


def counted(magnet: Magnet, kind: str) -> CountedMesh:
    """Count the parts of a kind of mesh (a value of `routes.MESHES`), without making it."""
    from halbach_fe import geo  # Gmsh loads only when something is meshed

    if kind == "meridian":
        columns, rows = geo.grid_size(magnet, meridian_size(magnet))
        cells = (columns - 1) * (rows - 1)
        nodes = (columns - 1) * (rows - 2)  # the outer boundary is three sides of the half-plane
        return CountedMesh(cells, Entities(nodes, nodes, nodes + cells, cells),
                           Entities(rows - 2, rows - 2, rows - 1, 0))
    triangles, rim = (round(number) for number in geo.plane_size(magnet, kind))
    # Euler: a disk of T triangles with R edges on its rim has E edges and V corners
    edges = (3 * triangles + rim) // 2
    corners = 1 + edges - triangles
    none = Entities(0, 0, 0, 0)
    if kind == "cross_section":
        inner = Entities(corners + edges - 2 * rim, corners - rim, edges - rim, triangles)
        return CountedMesh(triangles, inner, none)
    # every prism on a triangle is cut into three, every rectangle on an edge into two
    layers = len(geo.layers(magnet)) - 1
    inner_corners = (corners - rim) * (layers - 1)
    inner_edges = ((corners - rim) * layers + (edges - rim) * (layers - 1)  # upright, level
                   + (edges - rim) * layers)  # and across the rectangles
    inner_faces = triangles * (layers - 1) + 2 * (edges - rim) * layers + 2 * triangles * layers
    return CountedMesh(3 * triangles * layers, Entities(
        inner_corners + inner_edges, inner_corners, inner_edges, inner_faces), none)


def _estimate(
    magnet: Magnet, points: Floats, readings: int, problems: Sequence[Problem], jobs: int,
    parameters: int = 0,
) -> Estimate:
    """Add what this program itself takes: for elements, for fields of sources at points, for H."""
    blocks, speed = magnet.blocks, machine_speed()
    elements = max((one.elements for one in problems), default=0)
    matrix = readings * parameters
    places = 0.0 if magnet.study.solver.method == "direct" else _places(magnet, points)
    fields = parameters * len(points) * 3 if problems else 0
    known = parameters * min(readings, parameters)
    # the fields of blocks are gone when the posterior is found
    making = (8 * fields + CHUNK_BYTES * min(1.0, places / CHUNK_PLACES)
              + PLACE_BYTES * min(places, PLACES_AT_ONCE))
    learning = 8 * (PART_COPIES * min(matrix, NUMBERS_AT_ONCE, READINGS_AT_ONCE * parameters)
                    + INFORMATION_COPIES * known)
    own = (PYTHON_BYTES + ELEMENT_BYTES * elements + max(making, learning)
           + (READING_BYTES * readings if parameters else 0)
           + (8 * matrix if 8 * matrix <= LOADED_BYTES else 8 * NUMBERS_AT_ONCE)) / GIB
    side_by_side = 0.0
    seconds = OWN_SECONDS + ELEMENT_SECONDS * sum(one.elements * one.processes for one in problems)
    seconds += PLACE_SECONDS * places + MATRIX_SECONDS * matrix * min(readings, parameters)
    seconds += READING_SECONDS * readings if parameters else 0
    for what in dict.fromkeys(one.what for one in problems):
        runs = [one for problem in problems if problem.what == what
                for one in [problem] * problem.processes]
        largest = sorted((one.memory_GiB for one in runs), reverse=True)[:jobs]
        side_by_side = max(side_by_side, sum(largest))
        at_once = min(jobs, os.cpu_count() or 1)
        seconds += max(max(one.seconds for one in runs),
                       sum(one.seconds for one in runs) / at_once)
    return Estimate(
        study=magnet.name, blocks=len(blocks), readings=readings, parameters=parameters, jobs=jobs,
        route=problems[0].route if problems else EXACT_FIELD_ONLY,
        problems=tuple(replace(one, seconds=one.seconds / speed) for one in problems),
        own_memory_GiB=own, memory_GiB=own + side_by_side,
        disk_GiB=sum(one.processes * one.disk_GiB for one in problems)
        + 8 * (matrix + known) / GIB,
        seconds=seconds / speed, available_GiB=available_memory())


def _places(magnet: Magnet, points: Floats) -> float:
    """From how many places blocks see points: those on circles are seen by many from the same, and
    share integrals (`exact_field.unit_fields`). Counted for the blocks of one ring.
    """
    slots = np.arange(1, magnet.array.blocks_per_ring + 1)
    some = points[:COUNTED_PLACES // len(slots) + 1]
    middles = np.radians([position_angle_deg(magnet.array, slot) for slot in slots.tolist()])
    turn = np.arctan2(some[:, 1], some[:, 0])[:, None] - middles
    turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    r = np.hypot(some[:, 0], some[:, 1])[:, None]
    z = np.broadcast_to(some[:, 2:], turn.shape)
    different, _ = unique_points(np.column_stack(
        [x.ravel() for x in (r * np.cos(turn), r * np.sin(turn), z)]).round(9))
    return magnet.array.rings * len(different) * len(points) / len(some)


def machine_speed() -> float:
    """How fast this machine is now, over the one that the laws were measured on: by a sparse
    factorization of fixed size, the best of three.
    """
    line = sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(GRID, GRID))
    one = sparse.eye_array(GRID)
    matrix = sparse.csc_array(sparse.kron(line, one) + sparse.kron(one, line))

    def factorize() -> float:
        started = time.perf_counter()
        splu(matrix)
        return time.perf_counter() - started

    return GRID_SECONDS / min(factorize() for _ in range(3))


def available_memory() -> float | None:
    """Memory in GiB that can be had: of the machine, or of the container if that is less."""
    found = []
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        found.append(int(lines["MemAvailable"].split()[0]) / 2**20)
        group = Path("/sys/fs/cgroup")
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            found.append((int(limit) - int((group / "memory.current").read_text())) / GIB)
    except (OSError, KeyError, ValueError):
        pass
    return min(found, default=None)
