"""Finite-element solves: from a study and its mesh to B at points, source by source."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import metadata, resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe import pro
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import PointsOutsideError
from halbach_fe.core.files import make_folder
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.dofs import Unknowns, read_matrix, read_saved, read_solutions, read_unknowns
from halbach_fe.solver.formulations import Formulation
from halbach_fe.solver.getdp import Job
from halbach_fe.solver.interpolation import (
    Located,
    apply_operator,
    compare_printed,
    locate,
    probes_of,
)
from halbach_fe.solver.mesh import (
    MESH_NAME,
    CountedMesh,
    VerifiedMesh,
    build_mesh,
    count_mesh,
    verify_mesh,
)
from halbach_fe.solver.runs import MATRIX_FILE, Task, run_tasks, variant_name, write_history
from halbach_fe.solver.session import RunSize, Session
from halbach_fe.study.materials import MU_0

NOMINAL_SOURCE = 0
FLUX_DENSITY_FILE = "flux_density.txt"
NEWTON_FILE = "newton_flux_density.txt"
SOLUTIONS_FILE = "solutions.bin"

NEWTON_TOLERANCE = 1e-10
"""Residual of Newton's method relative to the right-hand side: the last step, quadratic, ends far
below; rounding leaves 1e-14 or so."""

PROBLEM_INCLUDES = ("problem_data.pro", "sources.pro", "vector_potential.pro", "solve_sources.pro",
                    "solve_newton.pro")


def solve_sources(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session,
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
    case = _case(magnet, points, blocks, session, formulation, anywhere)
    return _difference(magnet, session, lambda vacuum, parts: _source_tasks(case, vacuum, parts))


def solve_tangent(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session,
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
    case = _case(magnet, points, blocks, session, formulation, anywhere)

    def tasks(vacuum: bool, parts: int) -> list[Task]:
        return _source_tasks(case, vacuum, 1) if vacuum else [
            _newton_task(case, nominal_samples(magnet), False, NEWTON_TOLERANCE, gateaux=True)]

    real, *vacuum = _run_variants(magnet, session, tasks)
    if vacuum:  # of the nominal array, for the field, and for the derivative along it
        real = real - vacuum[0][[0, *range(len(vacuum[0]))]]
    return real[0], real[1:]


def solve_samples(
    magnet: Magnet, points: Floats, samples: Floats, session: Session, formulation: Formulation,
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
    case = _case(magnet, points, (), session, formulation)
    return _difference(magnet, session, lambda vacuum, parts: [
        _newton_task(case, samples, vacuum, tolerance, cold=cold)])


def nominal_samples(magnet: Magnet) -> Floats:
    """The nominal magnetization as the only sample, (1, blocks, 3) in A/m."""
    return np.array([[block.magnetization for block in magnet.blocks]])


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


def assemble(magnet: Magnet, session: Session, formulation: Formulation) -> Assembly:
    """Have GetDP assemble and solve a study with linear iron, for all its blocks."""
    place = np.zeros((1, 3))  # any in air: GetDP prints there what is compared
    blocks = range(len(magnet.blocks))
    case = _case(magnet, place, blocks, session, formulation)
    last = magnet.dimension * len(blocks)
    kept: dict[str, Any] = {}

    def keep_matrix(folder: Path, unknowns: Unknowns, _: NDArray[np.floating]) -> None:
        kept["unknowns"] = unknowns
        kept["matrix"] = read_matrix(folder / MATRIX_FILE, unknowns.count)

    def keep_solutions(_: Path, __: Unknowns, solutions: NDArray[np.floating]) -> None:
        kept["solutions"] = np.array(solutions, float)

    # PETSc writes the matrix at every solve, so one run for it and one for the solutions
    alone = replace(_source_task(case, False, (0, 0), "-matrix", keep_matrix), matrix=True)
    run_tasks([alone, _source_task(case, False, (0, last), "", keep_solutions)], session)
    return Assembly(case.real_mesh, **kept)


@dataclass(frozen=True)
class _Case:
    """What the runs for a magnet on one mesh have in common."""

    magnet: Magnet
    mesh: VerifiedMesh | CountedMesh
    points: Floats
    blocks: Sequence[int]
    formulation: Formulation
    anywhere: bool
    time_limit_s: float

    @property
    def real_mesh(self) -> VerifiedMesh:
        """The mesh; one that is only counted cannot be solved on."""
        assert isinstance(self.mesh, VerifiedMesh)
        return self.mesh

    @cached_property
    def located(self) -> Located:
        """Elements of the points."""
        return locate(self.real_mesh, self.points, self.anywhere)

    @cached_property
    def probes(self) -> tuple[Located, Floats]:
        """Some of the points and their places, where GetDP prints what is compared."""
        return probes_of(self.real_mesh, self.located)

    def size(self, solves: int, newton: bool = False) -> RunSize:
        """Size of a run with so many linear solves."""
        return RunSize(self.formulation.route, self.mesh.elements,
                       self.formulation.unknowns(self.mesh.inner), solves, newton=newton)


def _case(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session,
    formulation: Formulation, anywhere: bool = False,
) -> _Case:
    if magnet.dimension == 2:
        points = points * [1, 1, 0]  # the mesh's plane stands for every other
    mesh: VerifiedMesh | CountedMesh
    if session.counter is None:
        mesh = verify_mesh(build_mesh(magnet, make_folder(session.folder)))
    else:
        mesh = count_mesh(magnet, "cross_section" if magnet.dimension == 2 else "extruded")
    check_inside(magnet.name, mesh.radius, mesh.half_length, points)
    return _Case(magnet, mesh, points, blocks, formulation, anywhere, session.time_limit_s)


def _difference(
    magnet: Magnet, session: Session, tasks: Callable[[bool, int], list[Task]]
) -> Floats:
    """B by the study's method: of real materials, or that minus vacuum."""
    real, *vacuum = _run_variants(magnet, session, tasks)
    return real - vacuum[0] if vacuum else real


def _run_variants(
    magnet: Magnet, session: Session, tasks: Callable[[bool, int], list[Task]]
) -> list[Floats]:
    """Run the tasks of each variant that the study's method needs, real materials first.

    ``tasks`` makes those of real materials (False) or vacuum (True), in about so many parts.
    """
    variants = [False] if magnet.study.solver.method == "direct" else [False, True]
    made = [tasks(vacuum, max(1, session.jobs // len(variants))) for vacuum in variants]
    results = run_tasks([task for part in made for task in part], session)
    limits = np.cumsum([0, *(len(part) for part in made)])
    return [np.concatenate(results[a:b]) for a, b in pairwise(limits)]


def render(template: str, *, magnet: Magnet, **data: object) -> str:
    """The generated part of a problem, as GetDP text."""
    source = resources.files(pro).joinpath(template).read_text("utf-8")
    environment = jinja2.Environment(
        variable_start_string="<<", variable_end_string=">>", block_start_string="<%",
        block_end_string="%>", comment_start_string="<#", comment_end_string="#>",
        trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined,
        autoescape=False, keep_trailing_newline=True)  # GetDP text, not HTML
    return environment.from_string(source).render(
        study=magnet.study, version=metadata.version("halbach-fe"), mu_0=MU_0, blocks=magnet.blocks,
        iron_permeability=magnet.iron_ring.relative_permeability if magnet.iron_ring else 1.0,
        **data)


def _source_tasks(case: _Case, vacuum: bool, parts: int) -> list[Task]:
    """The nominal array and all sources of a linear problem, in up to so many runs."""
    last = case.magnet.dimension * len(case.blocks)
    limits = np.linspace(0, last + 1, min(last + 1, parts) + 1).astype(int)
    return [_source_task(case, vacuum, (int(a), int(b) - 1), f"-{number}" if number else "")
            for number, (a, b) in enumerate(pairwise(limits))]


def _source_task(
    case: _Case, vacuum: bool, sources: tuple[int, int], suffix: str,
    keep: Callable[[Path, Unknowns, NDArray[np.floating]], None] | None = None,
) -> Task:
    """The nominal array and sources of a linear problem; ``keep`` sees all solutions."""
    count = sources[1] - sources[0] + 1

    def read(folder: Path) -> Floats:
        unknowns = _unknowns(case, folder)
        solutions = read_solutions(folder / SOLUTIONS_FILE, unknowns.count, count)
        probes, places = case.probes
        printed = _fields(case, unknowns, probes, solutions[:1])[0]
        compare_printed(printed, folder / FLUX_DENSITY_FILE, places)
        result = _fields(case, unknowns, case.located, solutions)
        if keep is not None:
            keep(folder, unknowns, solutions)
        return result

    return Task(
        name=f"getdp-{variant_name(vacuum)}{suffix}",
        stage=lambda folder: fill_run_folder(
            case.magnet, case.real_mesh, case.probes[1], folder, case.formulation, RunRequest(
                case.blocks, sources, vacuum, time_limit_s=case.time_limit_s)),
        read=read, shape=(count, len(case.points), 3), solves=count, size=case.size(count))


def _newton_task(
    case: _Case, samples: Floats, vacuum: bool, tolerance: float, cold: bool = False,
    gateaux: bool = False,
) -> Task:
    """Newton's method for samples (k, blocks, 3) in A/m; its fields, then derivatives if wanted."""
    columns = 1 + case.magnet.dimension * len(case.blocks) if gateaux else 0

    def fill(folder: Path) -> Job:
        job = fill_run_folder(
            case.magnet, case.real_mesh, case.probes[1], folder, case.formulation, RunRequest(
                case.blocks, (0, max(columns - 1, 0)), vacuum, samples, case.time_limit_s))
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
        probes, places = case.probes
        compare_printed(_fields(case, unknowns, probes, saved[:1])[0], folder / NEWTON_FILE, places)
        fields = _fields(case, unknowns, case.located, saved)
        if not gateaux:
            return fields
        derivatives = read_solutions(folder / SOLUTIONS_FILE, unknowns.count, columns, steps)
        compare_printed(_fields(case, unknowns, probes, derivatives[:1])[0],
                        folder / FLUX_DENSITY_FILE, places)
        fields = np.concatenate([fields, _fields(case, unknowns, case.located, derivatives)])
        return fields

    return Task(f"getdp-{variant_name(vacuum)}", fill, read,
                (len(samples) + columns, len(case.points), 3), len(samples) + columns,
                case.size(columns, newton=True))


def _saved(case: _Case) -> str:
    """The file that GetDP's SaveSolution writes."""
    return f"{Path(case.formulation.problem).stem}.res"


def _unknowns(case: _Case, folder: Path) -> Unknowns:
    return read_unknowns(folder / f"{Path(case.formulation.problem).stem}.pre",
                         case.real_mesh.cell_type)


def _fields(
    case: _Case, unknowns: Unknowns, located: Located, solutions: NDArray[np.floating]
) -> Floats:
    operators = case.formulation.flux_density(case.real_mesh, located, unknowns)
    return np.stack([apply_operator(operator, solutions) for operator in operators], axis=2)


@dataclass(frozen=True)
class RunRequest:
    """What one run of GetDP shall solve for.

    Attributes
    ----------
    blocks : sequence of int
        Numbers, from 0, of the blocks that are sources of their own.
    sources : tuple of int
        First and last source: 0 is the whole array, then come the axes of ``blocks``.
    vacuum : bool
        Whether all materials are replaced by vacuum.
    samples : ndarray, shape (k, blocks, 3), in A/m, or None
        Magnetizations of the whole array; by default the nominal one.
    time_limit_s : float
    """

    blocks: Sequence[int] = ()
    sources: tuple[int, int] = (NOMINAL_SOURCE, NOMINAL_SOURCE)
    vacuum: bool = False
    samples: Floats | None = None
    time_limit_s: float = 3600.0


def fill_run_folder(
    magnet: Magnet, mesh: VerifiedMesh, places: Floats, folder: Path, formulation: Formulation,
    request: RunRequest | None = None,
) -> Job:
    """Fill a run folder with everything that GetDP needs, and return the job to run there.

    GetDP prints the first source's field at the ``places`` (n, 3) in m. Without a request it
    solves for the nominal array.
    """
    request = request or RunRequest()
    blocks, sources, samples = request.blocks, request.sources, request.samples
    for name in (formulation.problem, *PROBLEM_INCLUDES):
        text = resources.files(pro).joinpath(name).read_bytes()
        (folder / name).write_bytes(text)
    ranks = np.zeros(len(mesh.regions.blocks), int)
    ranks[list(blocks)] = np.arange(1, len(blocks) + 1)
    (folder / "case.pro").write_text(
        render("case.pro.j2", magnet=magnet, regions=mesh.regions, points=places.tolist(),
               ranks=ranks.tolist(), curve=magnet.curve,
               samples=(nominal_samples(magnet) if samples is None else samples).tolist()),
        encoding="utf-8")
    shutil.copyfile(mesh.path, folder / MESH_NAME)
    unknowns = formulation.unknowns(mesh.inner)
    direct = unknowns <= formulation.factorized
    return Job(
        problem=formulation.problem, mesh=MESH_NAME, resolution="Magnetostatics",
        numbers={"VACUUM": request.vacuum, "FIRST_SOURCE": sources[0], "LAST_SOURCE": sources[1]}
        | dict(formulation.numbers),
        outputs=(FLUX_DENSITY_FILE,), solutions=SOLUTIONS_FILE,
        unknowns=unknowns, solves=sources[1] - sources[0] + 1,
        options=runner.DIRECT_SOLVER if direct else runner.CONJUGATE_GRADIENTS,
        time_limit_s=request.time_limit_s)


def check_inside(name: str, radius_m: float, half_length_m: float, points: Floats) -> None:
    """Refuse points (n, 3) outside the mesh of a study, where GetDP would print zeros."""
    radius = np.hypot(points[:, 0], points[:, 1])
    outside = (radius > radius_m) | (np.abs(points[:, 2]) > half_length_m)
    if outside.any():
        x, y, z = points[np.argmax(outside)]
        raise PointsOutsideError(name, (
            f"(radius {radius_m:g} m, half length {half_length_m:g} m); instead {outside.sum()} "
            f"points lie outside, the first at ({x:g}, {y:g}, {z:g}) m."))
