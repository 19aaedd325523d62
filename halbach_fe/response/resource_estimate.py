"""What a run will take in memory, time and disk, before anything is solved.

The problems are those that `routes`, `discretization` and `verification` will pose, counted in
place of solved. Meshes are counted too: the half-plane's is a grid, and the stacked mesh follows
from the number of its plane triangles (`halbach_fe.geo.plane_size`), of which there are few.

What one GetDP process takes is a law of its unknowns, see `CostLaw`. Measured with GetDP 3.2, MUMPS
and OpenBLAS, one thread; seconds are in units of a factorization that is timed anew.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, PointsOutsideError
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import unique_points
from halbach_fe.measurement.observation import Observation
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.discretization_error import error_bar_session, reading_errors
from halbach_fe.response.matrix import LOADED_BYTES
from halbach_fe.response.mesh_convergence import variants_to_compare
from halbach_fe.solver.azimuthal_modes import mode_decay
from halbach_fe.solver.field import MESHES, check_points, finite_element_part, formulation_of
from halbach_fe.solver.session import RunSize, Session
from halbach_fe.stats.linear_gaussian import NUMBERS_AT_ONCE, READINGS_AT_ONCE
from halbach_fe.study.types import COMPONENTS

GIB = 2.0**30
EXACT_FIELD_ONLY = "exact_field_only"
UPDATED_MAGNET = "the updated magnet"

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


def estimate_solve(magnet: Magnet, observation: Observation, jobs: int) -> Estimate:
    """Estimate what the field of the nominal array takes, with error bars."""
    check_points(magnet, observation.points)
    session = Session.counting(jobs)
    few = decisive_points(magnet, observation.points)
    parts = finite_element_part(magnet, few.points, session, columns=False)
    reading_errors(magnet, few, parts, error_bar_session(session))
    return _estimate(magnet, observation.points, len(observation), session, jobs)


def estimate_infer(magnet: Magnet, observation: Observation, jobs: int) -> Estimate:
    """Estimate what the response matrix takes, with error bars, and the update."""
    check_points(magnet, observation.points)
    session = Session.counting(jobs)
    few = decisive_points(magnet, observation.points)
    try:
        parts = finite_element_part(magnet, few.points, session)
    except PointsOutsideError as error:
        raise MeasurementError(error.sentence(f"map of study {error.study}")) from None
    reading_errors(magnet, few, parts, error_bar_session(session))
    if magnet.is_nonlinear:  # is the iron linear enough?
        finite_element_part(magnet, few.points, replace(session, purpose=UPDATED_MAGNET),
                            columns=False)
    return _estimate(magnet, observation.points, len(observation), session, jobs,
                     magnet.dimension * len(magnet.blocks))


def estimate_verify(magnet: Magnet, jobs: int) -> Estimate:
    """Estimate what refinement, a farther boundary and the dual route take."""
    points = points_from(magnet.study.observation.positions)
    check_points(magnet, points)
    session = Session.counting(jobs)
    few = decisive_points(magnet, points)
    for purpose, variant in variants_to_compare(magnet, points).items():
        finite_element_part(variant, few.points, replace(session, purpose=purpose), columns=False)
    return _estimate(magnet, points, 3 * len(points), session, jobs)


def decisive_points(magnet: Magnet, points: Floats) -> Observation:
    """Return an observation of the few points that decide which runs there are: those that need the
    most azimuthal modes and that lie farthest out.
    """
    decisive = np.unique([
        np.argmax(mode_decay(magnet, points)) if magnet.dimension == 3 else 0,
        np.argmax(np.hypot(points[:, 0], points[:, 1])), np.argmax(np.abs(points[:, 2]))])
    few = points[decisive]
    readings = sparse.csr_array(sparse.eye_array(3 * len(few)))
    labels = tuple(f"B{name}" for name in COMPONENTS) * len(few)
    return Observation(few, readings, readings, few, labels, np.repeat(few, 3, axis=0))


def problems_of(magnet: Magnet, session: Session) -> list[Problem]:
    """Return the runs that a session has counted, those that are alike together."""
    assert session.counter is not None
    return [_problem(magnet, purpose, size, count)
            for purpose, sizes in session.counter.batches
            for size, count in Counter(sizes).items()]


def _problem(magnet: Magnet, purpose: str, size: RunSize, processes: int) -> Problem:
    """What each of some runs takes, by the `CostLaw` of its route."""
    formulation = formulation_of(magnet, size.route)
    law = {"cross_section": PLANE, "azimuthal_modes": PLANE, "edge_elements": EDGES[
        magnet.study.solver.edge_order]}.get(size.route, FACTORIZED)
    if size.route == "scalar_potential" and size.unknowns > formulation.factorized:
        law = ITERATED
        if magnet.iron_ring is not None:
            law = replace(law, solve_s=IRON_ITERATIONS * law.solve_s)
    matrices, solves = size.matrices, size.solves
    if size.newton:
        if not solves and size.unknowns > formulation.factorized_for_newton:
            law = STEPPED
        law = replace(law, bytes_each=law.bytes_each + NEWTON_BYTES)
        matrices, solves = NEWTON_MATRICES * NEWTON_STEPS, solves + NEWTON_STEPS
    each = law.bytes_each + law.fill * size.unknowns ** (1 / 3)
    seconds = (GETDP_SECONDS + matrices * law.matrix_s * size.unknowns**law.power
               + solves * law.solve_s * size.unknowns)
    disk = size.elements * MESH_BYTES[MESHES[size.route]] + size.unknowns * (
        UNKNOWN_BYTES.get(size.route, OTHER_UNKNOWN_BYTES) + 8 * solves)
    return Problem(purpose, size.route, size.elements, size.unknowns, processes, matrices, solves,
                   (GETDP_BYTES + size.unknowns * each) / GIB, seconds, disk / GIB)


def _estimate(
    magnet: Magnet, points: Floats, readings: int, session: Session, jobs: int,
    parameters: int = 0,
) -> Estimate:
    """Add what this program itself takes: for elements, for fields of sources at points, for H."""
    blocks, speed, problems = magnet.blocks, machine_speed(), problems_of(magnet, session)
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
