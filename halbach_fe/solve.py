"""Finite-element solves: from a study and its mesh to B at points, source by source."""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import metadata, resources
from itertools import pairwise
from pathlib import Path

import jinja2
import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe import getdp as runner
from halbach_fe.blocks import Floats, blocks_of
from halbach_fe.errors import GetDPError, OutputError, PointsOutsideError
from halbach_fe.evaluation import Located, curl_operators, locate, nodal_operators, probes_of
from halbach_fe.getdp import GetDP, Job
from halbach_fe.mesh import MESH_NAME, VerifiedMesh, build_mesh, verify_mesh
from halbach_fe.solutions import Unknowns, read_solutions, read_unknowns
from halbach_fe.study import MU_0, Study

NOMINAL_SOURCE = 0
FLUX_DENSITY_FILE = "flux_density.txt"
SOLUTIONS_FILE = "solutions.bin"
SOLUTIONS_AT_ONCE = 32
PRINTED_TOLERANCE = 1e-10
"""Of the largest value. Both evaluate the same polynomials; points are found to 1e-13."""

PROBLEM_INCLUDES = ("sources.pro", "solve_sources.pro")
Progress = Callable[[int, int], None]
"""Called with the number of solves done and the number of all."""


@dataclass(frozen=True)
class Workshop:
    """What a solve needs besides the study.

    Attributes
    ----------
    getdp : GetDP
    folder : Path
        Where run folders are made; the finished ones are kept as ``getdp-real`` and
        ``getdp-vacuum``, to be run by hand.
    jobs : int
        GetDP processes at a time.
    time_limit_s : float
        For each of them.
    progress : callable, optional
    """

    getdp: GetDP
    folder: Path
    jobs: int = 1
    time_limit_s: float = 3600.0
    progress: Progress | None = None


@dataclass(frozen=True)
class Formulation:
    """A problem file, what its unknowns are, and what solves it.

    Attributes
    ----------
    problem : str
    unknowns : callable
        How many there must be on a mesh.
    flux_density : callable
        Mesh, located points and unknowns to the sparse operators of Bx, By, Bz there.
    options : tuple of str
        PETSc's.
    numbers : mapping
        Constants of the problem.
    """

    problem: str
    unknowns: Callable[[VerifiedMesh], int]
    flux_density: Callable[[VerifiedMesh, Located, Unknowns], list[sparse.csr_array]]
    options: tuple[str, ...] = runner.DIRECT_SOLVER
    numbers: Mapping[str, float] = field(default_factory=dict)


def _curl_of_axial(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    _, (x, y) = nodal_operators(mesh, located, unknowns)
    return [y, -x, 0 * x]


def _minus_gradient(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    return [-slope for slope in nodal_operators(mesh, located, unknowns)[1]]


CROSS_SECTION = Formulation("magnetostatics_2d.pro", lambda mesh: mesh.inner.nodes, _curl_of_axial)
SCALAR_POTENTIAL = Formulation("scalar_potential_3d.pro", lambda mesh: mesh.inner.nodes,
                               _minus_gradient, runner.CONJUGATE_GRADIENTS)


def edge_elements(order: int) -> Formulation:
    """Edge elements of order 1 or 2."""
    return Formulation(
        # the tree of the gauge, started on the boundary, has one edge per corner off it
        "magnetostatics_3d.pro", lambda mesh: mesh.inner.edges - mesh.inner.corners + (
            2 * mesh.inner.faces if order == 2 else 0),
        curl_operators, numbers={"ORDER": order})


def solve_sources(
    study: Study, points: Floats, blocks: Sequence[int], workshop: Workshop,
    formulation: Formulation,
) -> Floats:
    """Finite-element part of the field of the nominal array and of single blocks.

    For the method ``direct`` that is B itself. For ``reaction`` it is the difference of two
    solves on one mesh, real materials minus vacuum, to be added to the exact field in vacuum;
    the discretization error of the sources' own field, by far the largest, cancels.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    blocks : sequence of int
        Numbers, from 0, of the blocks to solve for with 1 T along each axis.

    Returns
    -------
    ndarray, shape (1 + D len(blocks), n, 3), in T
        The nominal array, then block by block, axis by axis.
    """
    last = study.dimension * len(blocks)
    if study.dimension == 2:
        points = points * [1, 1, 0]  # the mesh's plane stands for every other
    folder = make_folder(workshop.folder)
    mesh = verify_mesh(build_mesh(study, folder))
    check_inside(mesh, points)
    located = locate(mesh, points)
    variants = [False] if study.solver.method == "direct" else [False, True]
    parts = max(1, min(last + 1, workshop.jobs // len(variants)))
    limits = np.linspace(0, last + 1, parts + 1).astype(int)
    ranges = [(int(a), int(b) - 1) for a, b in pairwise(limits)]
    tasks = [_task(study, mesh, located, blocks, part, vacuum, workshop, formulation,
                   f"-{number}" if number else "")
             for vacuum in variants for number, part in enumerate(ranges)]
    results = run_tasks(tasks, workshop)
    fields = [np.concatenate(results[i * parts:(i + 1) * parts]) for i in range(len(variants))]
    return fields[0] if len(fields) == 1 else fields[0] - fields[1]


@dataclass(frozen=True)
class Task:
    """One GetDP run: how to fill its folder, how to read its answer, how many solves it makes."""

    name: str
    stage: Callable[[Path], Job]
    read: Callable[[Path], Floats]
    solves: int


def run_tasks(tasks: Sequence[Task], workshop: Workshop) -> list[Floats]:
    """Run GetDP for every task, ``workshop.jobs`` at a time; the first failure ends them all."""
    counter = _Counter(sum(task.solves for task in tasks), workshop.progress)
    cancel = threading.Event()

    def run(task: Task) -> Floats:
        with _run_folder(workshop.folder, task.name, cancel) as folder:
            job = task.stage(folder)
            runner.run(workshop.getdp, job, folder, counter.line, cancel)
            return task.read(folder)

    with ThreadPoolExecutor(max(1, workshop.jobs)) as pool:
        futures = [pool.submit(run, task) for task in tasks]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future.done():
                    future.result()
            return [future.result() for future in futures]
        finally:
            cancel.set()  # on failure and on Ctrl-C nobody waits for the others
            for future in futures:
                future.cancel()


def render(template: str, *, study: Study, **data: object) -> str:
    """The generated part of a problem, as GetDP text."""
    source = resources.files("halbach_fe.pro").joinpath(template).read_text("utf-8")
    environment = jinja2.Environment(
        variable_start_string="<<", variable_end_string=">>", block_start_string="<%",
        block_end_string="%>", comment_start_string="<#", comment_end_string="#>",
        trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined,
        autoescape=False, keep_trailing_newline=True)  # GetDP text, not HTML
    return environment.from_string(source).render(
        study=study, version=metadata.version("halbach-fe"), mu_0=MU_0, blocks=blocks_of(study),
        iron_permeability=study.iron_ring.relative_permeability if study.iron_ring else 1.0,
        **data)


class _Counter:
    """Counts finished solves of several threads."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self._lock, self._done, self._total = threading.Lock(), 0, total
        self._progress = progress

    def line(self, line: str) -> None:
        if line.startswith("SOURCE") and self._progress is not None:
            with self._lock:
                self._done += 1
                self._progress(self._done, self._total)


def _task(
    study: Study, mesh: VerifiedMesh, located: Located, blocks: Sequence[int],
    sources: tuple[int, int], vacuum: bool, workshop: Workshop, formulation: Formulation,
    suffix: str,
) -> Task:
    count = sources[1] - sources[0] + 1
    probes, places = probes_of(mesh, located)

    def read(folder: Path) -> Floats:
        unknowns = read_unknowns(folder / f"{Path(formulation.problem).stem}.pre", mesh.cell_type)
        solutions = read_solutions(folder / SOLUTIONS_FILE, unknowns.count, count)

        def field(located: Located, chosen: NDArray[np.floating]) -> Floats:
            operators = formulation.flux_density(mesh, located, unknowns)
            return np.stack([apply_to(operator, chosen) for operator in operators], axis=2)

        compare_printed(field(probes, solutions[:1])[0], folder / FLUX_DENSITY_FILE, places)
        result = field(located, solutions)
        (folder / SOLUTIONS_FILE).unlink()  # large, and not needed to run the folder by hand
        return result

    return Task(
        name=f"getdp-{'vacuum' if vacuum else 'real'}{suffix}",
        stage=lambda folder: stage(study, mesh, places, folder, formulation, blocks, sources,
                                   vacuum, workshop.time_limit_s),
        read=read, solves=count)


def apply_to(operator: sparse.csr_array, solutions: NDArray[np.floating]) -> Floats:
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
            f"in {printed}: the unknowns of this GetDP are numbered in another way than expected. "
            "Use GetDP 3.2.")


def stage(
    study: Study, mesh: VerifiedMesh, places: Floats, folder: Path, formulation: Formulation,
    blocks: Sequence[int] = (), sources: tuple[int, int] = (NOMINAL_SOURCE, NOMINAL_SOURCE),
    vacuum: bool = False, time_limit_s: float = 3600.0,
) -> Job:
    """Fill a run folder with everything that GetDP needs, and return the job to run there.

    ``places`` (n, 3) in m are where GetDP prints the first source's field; ``sources`` are the
    first and last to solve for, 0 being the nominal array, the others the axes of ``blocks``.
    """
    for name in (formulation.problem, *PROBLEM_INCLUDES):
        text = resources.files("halbach_fe.pro").joinpath(name).read_bytes()
        (folder / name).write_bytes(text)
    ranks = np.zeros(len(mesh.regions.blocks), int)
    ranks[list(blocks)] = np.arange(1, len(blocks) + 1)
    (folder / "case.pro").write_text(
        render("case.pro.j2", study=study, regions=mesh.regions, points=places.tolist(),
               ranks=ranks.tolist()), encoding="utf-8")
    shutil.copyfile(mesh.path, folder / MESH_NAME)
    return Job(
        problem=formulation.problem, mesh=MESH_NAME, resolution="Magnetostatics",
        numbers={"VACUUM": vacuum, "FIRST_SOURCE": sources[0], "LAST_SOURCE": sources[1]}
        | dict(formulation.numbers),
        outputs=(FLUX_DENSITY_FILE,), solutions=SOLUTIONS_FILE,
        unknowns=formulation.unknowns(mesh), solves=sources[1] - sources[0] + 1,
        options=formulation.options, time_limit_s=time_limit_s)


@contextmanager
def _run_folder(parent: Path, name: str, cancel: threading.Event) -> Iterator[Path]:
    """A private folder, kept as ``name`` after a good run and as ``name-failed`` (with the log)
    after a bad one; anything else that ends the run leaves nothing.
    """
    folder = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=make_folder(parent)))
    try:
        yield folder
        _replace(folder, parent / name)
    except GetDPError as error:
        if cancel.is_set():
            raise
        kept = parent / f"{name}-failed"
        _replace(folder, kept)
        raise GetDPError(str(error).replace(str(folder), str(kept))) from None
    except OSError as error:
        raise OutputError(f"Cannot write into {parent}: {error.strerror}.") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _replace(folder: Path, kept: Path) -> None:
    shutil.rmtree(kept, ignore_errors=True)
    folder.rename(kept)


def make_folder(folder: Path) -> Path:
    """Make a folder and its parents if need be; raise OutputError if that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"Cannot make folder {folder}: {error.strerror}.") from None
    return folder


def check_inside(mesh: VerifiedMesh, points: Floats) -> None:
    """Refuse points outside the mesh, where GetDP would print zeros."""
    radius = np.hypot(points[:, 0], points[:, 1])
    outside = (radius > mesh.radius) | (np.abs(points[:, 2]) > mesh.half_length)
    if outside.any():
        x, y, z = points[np.argmax(outside)]
        raise PointsOutsideError(
            f"Input `observation.positions` of study {mesh.regions.study} must lie within the "
            f"meshed region (radius {mesh.radius:g} m, half length {mesh.half_length:g} m); "
            f"instead {outside.sum()} points lie outside, the first at ({x:g}, {y:g}, {z:g}) m. "
            "Check the units of the points, or enlarge `open_boundary`.")
