"""Finite-element solves: from a study and its mesh to B at points, source by source."""

from __future__ import annotations

import re
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import metadata, resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe import getdp as runner
from halbach_fe import pro
from halbach_fe.blocks import Floats, blocks_of
from halbach_fe.cache import Cache
from halbach_fe.errors import GetDPError, NotConvergedError, OutputError, PointsOutsideError
from halbach_fe.evaluation import Located, curl_operators, locate, nodal_operators, probes_of
from halbach_fe.getdp import GetDP, Job, Run
from halbach_fe.in_the_making import name_in_the_making, remove_left_behind
from halbach_fe.mesh import MESH_NAME, Entities, VerifiedMesh, build_mesh, verify_mesh
from halbach_fe.solutions import (
    Unknowns,
    read_matrix,
    read_saved,
    read_solutions,
    read_unknowns,
)
from halbach_fe.study import MU_0, Study, curve_of

NOMINAL_SOURCE = 0
FLUX_DENSITY_FILE = "flux_density.txt"
NEWTON_FILE = "newton_flux_density.txt"
NEWTON_HISTORY = "newton.csv"
SOLUTIONS_FILE = "solutions.bin"
MATRIX_FILE = "matrix.bin"
SOLUTIONS_AT_ONCE = 32
PRINTED_TOLERANCE = 1e-9
"""Of the largest value. Both evaluate the same polynomials; where GetDP finds a point in a curved
element by iteration, up to 1e-10 was measured. Another numbering shows at 1."""

NEWTON_TOLERANCE = 1e-10
"""Residual of Newton's method relative to the right-hand side: the last step, quadratic, ends far
below; rounding leaves 1e-14 or so."""

PROBLEM_INCLUDES = ("sources.pro", "solve_sources.pro", "solve_newton.pro")
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
    cache : Cache, optional
        Keeps what GetDP answered, for the next time that the same is asked.
    run : callable
        What runs GetDP: here, or elsewhere (`halbach_fe.cluster`).
    processes : int
        MPI processes of every run, for a solve that is too large for one.
    """

    getdp: GetDP
    folder: Path
    jobs: int = 1
    time_limit_s: float = 3600.0
    progress: Progress | None = None
    cache: Cache | None = None
    run: Run = runner.run
    processes: int = 1


@dataclass(frozen=True)
class Formulation:
    """A problem file, what its unknowns are, and what solves it.

    Attributes
    ----------
    problem : str
    unknowns : callable
        How many there must be, by what a mesh has off the boundary.
    flux_density : callable
        Mesh, located points and unknowns to the sparse operators of Bx, By, Bz there.
    factorized : int
        Up to so many unknowns the matrix is factorized, beyond it conjugate gradients are used.
    factorized_for_newton : int
        The same of Newton's method, where every step has a matrix of its own.
    numbers : mapping
        Constants of the problem.
    law : str
        Which of a curve's laws it solves with: ``reluctivity`` or ``permeability``.
    """

    problem: str
    unknowns: Callable[[Entities], int]
    flux_density: Callable[[VerifiedMesh, Located, Unknowns], list[sparse.csr_array]]
    factorized: float = np.inf
    factorized_for_newton: float = np.inf
    numbers: Mapping[str, float] = field(default_factory=dict)
    law: str = "reluctivity"


def _curl_of_axial(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    _, (x, y) = nodal_operators(mesh, located, unknowns)
    return [y, -x, 0 * x]


def _minus_gradient(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    return [-slope for slope in nodal_operators(mesh, located, unknowns)[1]]


FACTORIZED = 200_000
"""Unknowns of a scalar potential of second order: 160 000 take 4 GiB and 25 s, while thin iron
takes conjugate gradients 2400 iterations, 60 s, for every source."""

CROSS_SECTION = Formulation("magnetostatics_2d.pro", lambda inner: inner.nodes, _curl_of_axial)
SCALAR_POTENTIAL = Formulation("scalar_potential_3d.pro", lambda inner: inner.nodes,
                               _minus_gradient, FACTORIZED, FACTORIZED // 4, law="permeability")


def edge_elements(order: int) -> Formulation:
    """Edge elements of order 1 or 2."""
    return Formulation(
        # the tree of the gauge, started on the boundary, has one edge per corner off it
        "magnetostatics_3d.pro", lambda inner: inner.edges - inner.corners + (
            2 * inner.faces if order == 2 else 0),
        curl_operators, numbers={"ORDER": order})


def solve_sources(
    study: Study, points: Floats, blocks: Sequence[int], workshop: Workshop,
    formulation: Formulation, anywhere: bool = False,
) -> Floats:
    """Finite-element part of the field of the nominal array and of single blocks, iron being
    linear.

    For the method ``direct`` that is B itself. For ``reaction`` it is the difference of two
    solves on one mesh, real materials minus vacuum, to be added to the exact field in vacuum;
    the discretization error of the sources' own field, by far the largest, cancels.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    blocks : sequence of int
        Numbers, from 0, of the blocks to solve for with 1 T along each axis.
    anywhere : bool
        Whether points may lie in magnet and iron.

    Returns
    -------
    ndarray, shape (1 + D len(blocks), n, 3), in T
        The nominal array, then block by block, axis by axis.
    """
    case = _case(study, points, blocks, workshop, formulation, anywhere)
    return _difference(study, workshop, lambda vacuum, parts: _source_tasks(case, vacuum, parts))


def solve_tangent(
    study: Study, points: Floats, blocks: Sequence[int], workshop: Workshop,
    formulation: Formulation, anywhere: bool = False,
) -> tuple[Floats, Floats]:
    """Finite-element part of the field of a magnet with non-linear iron, and its derivative.

    With ``anywhere`` points may lie in magnet and iron.

    Returns
    -------
    field : ndarray, shape (n, 3), in T
        Of the nominal array, by Newton's method.
    derivative : ndarray, shape (1 + D len(blocks), n, 3), in T
        There, along the nominal magnetization, then per tesla of each block along each axis: the
        Gateaux problem, with the differential reluctivity dH/dB.
    """
    case = _case(study, points, blocks, workshop, formulation, anywhere)

    def tasks(vacuum: bool, parts: int) -> list[Task]:
        return _source_tasks(case, vacuum, 1) if vacuum else [
            _newton_task(case, nominal_samples(study), False, NEWTON_TOLERANCE, gateaux=True)]

    real, *vacuum = _run_variants(study, workshop, tasks)
    if vacuum:  # of the nominal array, for the field, and for the derivative along it
        real = real - vacuum[0][[0, *range(len(vacuum[0]))]]
    return real[0], real[1:]


def solve_samples(
    study: Study, points: Floats, samples: Floats, workshop: Workshop, formulation: Formulation,
    cold: bool = False, tolerance: float = NEWTON_TOLERANCE,
) -> Floats:
    """Finite-element part of the field for samples of magnetization, by Newton's method.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    samples : ndarray, shape (k, blocks, 3), in A/m
    cold : bool
        Whether every sample starts from zero, not from the one before.
    tolerance : float
        Of the residual, relative to the right-hand side.

    Returns
    -------
    ndarray, shape (k, n, 3), in T

    Raises
    ------
    NotConvergedError
        With the residuals of the sample that failed.
    """
    case = _case(study, points, (), workshop, formulation)
    return _difference(study, workshop, lambda vacuum, parts: [
        _newton_task(case, samples, vacuum, tolerance, cold=cold)])


def nominal_samples(study: Study) -> Floats:
    """The nominal magnetization as the only sample, (1, blocks, 3) in A/m."""
    return np.array([[block.magnetization for block in blocks_of(study)]])


@dataclass(frozen=True)
class Assembly:
    """A linear problem as GetDP assembled it, and its solutions.

    Attributes
    ----------
    matrix : sparse array, shape (unknowns, unknowns)
    solutions : ndarray, shape (1 + D blocks, unknowns)
        Of the nominal array, and of all blocks per tesla along each axis.
    """

    mesh: VerifiedMesh
    unknowns: Unknowns
    matrix: sparse.csr_array
    solutions: Floats


def assemble(study: Study, workshop: Workshop, formulation: Formulation) -> Assembly:
    """Have GetDP assemble and solve a study with linear iron, for all its blocks."""
    place = np.zeros((1, 3))  # any in air: GetDP prints there what is compared
    blocks = range(len(blocks_of(study)))
    case = _case(study, place, blocks, workshop, formulation)
    last = study.dimension * len(blocks)
    kept: dict[str, Any] = {}

    def keep_matrix(folder: Path, unknowns: Unknowns, _: NDArray[np.floating]) -> None:
        kept["unknowns"] = unknowns
        kept["matrix"] = read_matrix(folder / MATRIX_FILE, unknowns.count)

    def keep_solutions(_: Path, __: Unknowns, solutions: NDArray[np.floating]) -> None:
        kept["solutions"] = np.array(solutions, float)

    # PETSc writes the matrix at every solve, so one run for it and one for the solutions
    alone = replace(_source_task(case, False, (0, 0), "-matrix", keep_matrix), matrix=True)
    run_tasks([alone, _source_task(case, False, (0, last), "", keep_solutions)], workshop)
    return Assembly(case.mesh, **kept)


@dataclass(frozen=True)
class _Case:
    """What the runs of a study on one mesh have in common."""

    study: Study
    mesh: VerifiedMesh
    located: Located
    blocks: Sequence[int]
    formulation: Formulation
    time_limit_s: float


def _case(
    study: Study, points: Floats, blocks: Sequence[int], workshop: Workshop,
    formulation: Formulation, anywhere: bool = False,
) -> _Case:
    if study.dimension == 2:
        points = points * [1, 1, 0]  # the mesh's plane stands for every other
    mesh = verify_mesh(build_mesh(study, make_folder(workshop.folder)))
    check_inside(study.name, mesh.radius, mesh.half_length, points)
    return _Case(study, mesh, locate(mesh, points, anywhere), blocks, formulation,
                 workshop.time_limit_s)


def _difference(
    study: Study, workshop: Workshop, tasks: Callable[[bool, int], list[Task]]
) -> Floats:
    """B by the study's method: of real materials, or that minus vacuum."""
    real, *vacuum = _run_variants(study, workshop, tasks)
    return real - vacuum[0] if vacuum else real


def _run_variants(
    study: Study, workshop: Workshop, tasks: Callable[[bool, int], list[Task]]
) -> list[Floats]:
    """Run the tasks of each variant that the study's method needs, real materials first.

    ``tasks`` makes those of real materials (False) or vacuum (True), in about so many parts.
    """
    variants = [False] if study.solver.method == "direct" else [False, True]
    made = [tasks(vacuum, max(1, workshop.jobs // len(variants))) for vacuum in variants]
    results = run_tasks([task for part in made for task in part], workshop)
    limits = np.cumsum([0, *(len(part) for part in made)])
    return [np.concatenate(results[a:b]) for a, b in pairwise(limits)]


@dataclass(frozen=True)
class Task:
    """One GetDP run: how to fill its folder, how to read its answer, how many solves it makes,
    and whether PETSc writes the matrix.
    """

    name: str
    stage: Callable[[Path], Job]
    read: Callable[[Path], Floats]
    solves: int
    matrix: bool = False


def run_tasks(tasks: Sequence[Task], workshop: Workshop) -> list[Floats]:
    """Run GetDP for every task, ``workshop.jobs`` at a time; the first failure ends them all."""
    counter = _Counter(sum(task.solves for task in tasks), workshop.progress)
    cancel = threading.Event()
    stored: list[bool] = []

    def run(task: Task) -> Floats:
        with _run_folder(workshop.folder, task.name, cancel) as folder:
            job = replace(task.stage(folder), processes=workshop.processes)
            if task.matrix:
                job = replace(job, matrix=MATRIX_FILE)
            history: list[str] = []

            def see(line: str) -> None:
                counter.line(line)
                if line.startswith("NEWTON"):
                    history.append(line)

            kept = workshop.cache.entry(workshop.getdp, job, folder) if workshop.cache else None
            try:
                if kept is None or not kept.restore(see):
                    workshop.run(workshop.getdp, job, folder, see, cancel)
            except GetDPError as error:
                raise _with_history(error, newton_residuals(history)) from None
            result = task.read(folder)
            if kept is not None:
                stored.append(kept.store())  # what was read and found sound
            for name in job.large:  # and not needed to run the folder by hand
                (folder / name).unlink()
            return result

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
            if workshop.cache is not None and any(stored):
                workshop.cache.trim()


def _with_history(error: GetDPError, history: list[list[float]]) -> GetDPError:
    """The error, with the residuals if Newton's method is what failed."""
    if "Newton's method did not converge" not in str(error) or not history:
        return error
    residuals = tuple(history[-1])
    return NotConvergedError(
        f"{error} Relative residuals of sample {len(history)}: "
        f"{', '.join(f'{residual:.1e}' for residual in residuals)}. Refine the mesh in the iron, "
        "or smooth its H(B) curve.", residuals)


def render(template: str, *, study: Study, **data: object) -> str:
    """The generated part of a problem, as GetDP text."""
    source = resources.files(pro).joinpath(template).read_text("utf-8")
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
        if line.startswith(("SOURCE", "SAMPLE")) and self._progress is not None:
            with self._lock:
                self._done += 1
                self._progress(self._done, self._total)


def _source_tasks(case: _Case, vacuum: bool, parts: int) -> list[Task]:
    """The nominal array and all sources of a linear problem, in up to so many runs."""
    last = case.study.dimension * len(case.blocks)
    limits = np.linspace(0, last + 1, min(last + 1, parts) + 1).astype(int)
    return [_source_task(case, vacuum, (int(a), int(b) - 1), f"-{number}" if number else "")
            for number, (a, b) in enumerate(pairwise(limits))]


def _source_task(
    case: _Case, vacuum: bool, sources: tuple[int, int], suffix: str,
    keep: Callable[[Path, Unknowns, NDArray[np.floating]], None] | None = None,
) -> Task:
    """The nominal array and sources of a linear problem; ``keep`` sees all solutions."""
    count = sources[1] - sources[0] + 1
    probes, places = probes_of(case.mesh, case.located)

    def read(folder: Path) -> Floats:
        unknowns = _unknowns(case, folder)
        solutions = read_solutions(folder / SOLUTIONS_FILE, unknowns.count, count)
        printed = _fields(case, unknowns, probes, solutions[:1])[0]
        compare_printed(printed, folder / FLUX_DENSITY_FILE, places)
        result = _fields(case, unknowns, case.located, solutions)
        if keep is not None:
            keep(folder, unknowns, solutions)
        return result

    return Task(
        name=f"getdp-{_variant(vacuum)}{suffix}",
        stage=lambda folder: stage(case.study, case.mesh, places, folder, case.formulation,
                                   case.blocks, sources, vacuum, case.time_limit_s),
        read=read, solves=count)


def _newton_task(
    case: _Case, samples: Floats, vacuum: bool, tolerance: float, cold: bool = False,
    gateaux: bool = False,
) -> Task:
    """Newton's method for samples (k, blocks, 3) in A/m; its fields, then derivatives if wanted."""
    columns = 1 + case.study.dimension * len(case.blocks) if gateaux else 0
    probes, places = probes_of(case.mesh, case.located)

    def fill(folder: Path) -> Job:
        job = stage(case.study, case.mesh, places, folder, case.formulation, case.blocks,
                    (0, max(columns - 1, 0)), vacuum, case.time_limit_s, samples)
        outputs = [NEWTON_FILE] + ([FLUX_DENSITY_FILE] if gateaux else [])
        unknowns = case.formulation.unknowns(case.mesh.inner)
        if not gateaux and unknowns > case.formulation.factorized_for_newton:
            job = replace(job, options=runner.NEWTON_STEPS, linear_residual=runner.NEWTON_RESIDUAL)
        return replace(
            job, resolution="Newton", solves=max(columns, 1),
            outputs=(*outputs, _saved(case)), solutions=SOLUTIONS_FILE if gateaux else None,
            numbers={**job.numbers, "TOLERANCE": tolerance, "COLD": cold, "GATEAUX": gateaux})

    def read(folder: Path) -> Floats:
        steps = write_history(folder)
        unknowns = _unknowns(case, folder)
        saved = read_saved(folder / _saved(case), unknowns.count, len(samples))
        compare_printed(_fields(case, unknowns, probes, saved[:1])[0], folder / NEWTON_FILE, places)
        fields = _fields(case, unknowns, case.located, saved)
        if not gateaux:
            return fields
        derivatives = read_solutions(folder / SOLUTIONS_FILE, unknowns.count, columns, steps)
        compare_printed(_fields(case, unknowns, probes, derivatives[:1])[0],
                        folder / FLUX_DENSITY_FILE, places)
        fields = np.concatenate([fields, _fields(case, unknowns, case.located, derivatives)])
        return fields

    return Task(f"getdp-{_variant(vacuum)}", fill, read, len(samples) + columns)


def _variant(vacuum: bool) -> str:
    return "vacuum" if vacuum else "real"


def _saved(case: _Case) -> str:
    """The file that GetDP's SaveSolution writes."""
    return f"{Path(case.formulation.problem).stem}.res"


def _unknowns(case: _Case, folder: Path) -> Unknowns:
    return read_unknowns(folder / f"{Path(case.formulation.problem).stem}.pre", case.mesh.cell_type)


def _fields(
    case: _Case, unknowns: Unknowns, located: Located, solutions: NDArray[np.floating]
) -> Floats:
    operators = case.formulation.flux_density(case.mesh, located, unknowns)
    return np.stack([apply_to(operator, solutions) for operator in operators], axis=2)


def newton_residuals(lines: Iterable[str]) -> list[list[float]]:
    """Relative residuals of Newton's method in a log of GetDP, by sample and step."""
    found: list[list[float]] = []
    for line in lines:
        match = re.search(
            r"NEWTON \d+ (\d+) (\d{1,20}(?:\.\d{1,20})?(?:e[-+]?\d+)?|nan|inf)\b", line)
        if match and (found or match[1] == "0"):
            if match[1] == "0":
                found.append([])
            found[-1].append(float(match[2]))
    return found


def newton_history(folder: Path) -> list[float]:
    """Relative residuals of Newton's method in the run that a workshop's folder keeps."""
    log = folder / f"getdp-{_variant(False)}" / runner.LOG_NAME
    return newton_residuals(log.read_text("utf-8").splitlines())[-1]


def write_history(folder: Path) -> int:
    """Keep the residuals of a run's log as a table; return the number of steps."""
    history = newton_residuals((folder / runner.LOG_NAME).read_text("utf-8").splitlines())
    rows = [f"{sample},{step},{residual:.6e}" for sample, residuals in enumerate(history)
            for step, residual in enumerate(residuals)]
    (folder / NEWTON_HISTORY).write_text("\n".join(["sample,step,residual", *rows, ""]), "utf-8")
    return sum(len(residuals) - 1 for residuals in history)


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
    vacuum: bool = False, time_limit_s: float = 3600.0, samples: Floats | None = None,
) -> Job:
    """Fill a run folder with everything that GetDP needs, and return the job to run there.

    ``places`` (n, 3) in m are where GetDP prints the first source's field; ``sources`` are the
    first and last to solve for, 0 being the whole array, the others the axes of ``blocks``.
    ``samples`` (k, blocks, 3) in A/m are magnetizations of the whole array; default the nominal.
    """
    for name in (formulation.problem, *PROBLEM_INCLUDES):
        text = resources.files(pro).joinpath(name).read_bytes()
        (folder / name).write_bytes(text)
    ranks = np.zeros(len(mesh.regions.blocks), int)
    ranks[list(blocks)] = np.arange(1, len(blocks) + 1)
    (folder / "case.pro").write_text(
        render("case.pro.j2", study=study, regions=mesh.regions, points=places.tolist(),
               ranks=ranks.tolist(), curve=curve_of(study),
               samples=(nominal_samples(study) if samples is None else samples).tolist()),
        encoding="utf-8")
    shutil.copyfile(mesh.path, folder / MESH_NAME)
    unknowns = formulation.unknowns(mesh.inner)
    direct = unknowns <= formulation.factorized
    return Job(
        problem=formulation.problem, mesh=MESH_NAME, resolution="Magnetostatics",
        numbers={"VACUUM": vacuum, "FIRST_SOURCE": sources[0], "LAST_SOURCE": sources[1]}
        | dict(formulation.numbers),
        outputs=(FLUX_DENSITY_FILE,), solutions=SOLUTIONS_FILE,
        unknowns=unknowns, solves=sources[1] - sources[0] + 1,
        options=runner.DIRECT_SOLVER if direct else runner.CONJUGATE_GRADIENTS,
        time_limit_s=time_limit_s)


@contextmanager
def _run_folder(parent: Path, name: str, cancel: threading.Event) -> Iterator[Path]:
    """A private folder, kept as ``name`` after a good run and as ``name-failed`` (with the log)
    after a bad one; anything else that ends the run leaves nothing.
    """
    remove_left_behind(make_folder(parent))
    folder = Path(tempfile.mkdtemp(prefix=name_in_the_making(name), dir=parent))
    try:
        yield folder
        _replace(folder, parent / name)
    except GetDPError as error:
        if cancel.is_set():
            raise
        kept = parent / f"{name}-failed"
        _replace(folder, kept)
        error.args = (str(error).replace(str(folder), str(kept)),)
        raise
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


def check_inside(name: str, radius_m: float, half_length_m: float, points: Floats) -> None:
    """Refuse points (n, 3) outside the mesh of a study, where GetDP would print zeros."""
    radius = np.hypot(points[:, 0], points[:, 1])
    outside = (radius > radius_m) | (np.abs(points[:, 2]) > half_length_m)
    if outside.any():
        x, y, z = points[np.argmax(outside)]
        raise PointsOutsideError(
            f"Input `observation.positions` of study {name} must lie within the meshed region "
            f"(radius {radius_m:g} m, half length {half_length_m:g} m); instead {outside.sum()} "
            f"points lie outside, the first at ({x:g}, {y:g}, {z:g}) m. Check the units of the "
            "points, or enlarge `open_boundary`.")
