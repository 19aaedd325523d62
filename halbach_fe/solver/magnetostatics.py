"""Finite-element solves on the mesh of a magnet: B at points, source by source.

GetDP solves three weak forms of magnetostatics without currents, all with essential conditions on
the outer boundary (the files in pro/ derive them):

* ``magnetostatics_2d.pro``: vector potential a_z, int nu curl a . curl a' = int M . curl a', nodal
  elements of second order; a = 0 on the boundary, so that B . n = 0.
* ``magnetostatics_3d.pro``: the same weak form for the vector potential in 3D, edge elements of
  order 1 or 2 with a tree gauge; a x n = 0 on the boundary, so that B . n = 0.
* ``scalar_potential_3d.pro``: psi = mu_0 phi, int mu_r grad psi . grad v = int B_r . grad v, nodal
  elements of second order; psi = 0 on the boundary, so that H x n = 0.

The scalar potential is the dual of the vector potential. The difference between their solutions
shows the error that the outer boundary causes by its finite distance.

A source is a remanence B_r in the blocks: that of the nominal array (source 0), or 1 T along one
axis of one block. The matrix of a linear problem is the same for all its sources. Non-linear iron
is solved by Newton's method, for samples of the array's magnetization, and linearized for single
blocks.

By the method ``reaction`` every problem is solved twice on the same mesh, with the real materials
and with vacuum in their place, and the difference is the reaction of permeability and iron. The
discretization error of the sources' own field, by far the largest error, cancels.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe import pro
from halbach_fe.core.arrays import Floats, radii_of
from halbach_fe.core.errors import PointsOutsideError
from halbach_fe.core.files import make_folder
from halbach_fe.core.installation import version
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import Job
from halbach_fe.solver.getdp_files import (
    Unknowns,
    read_matrix,
    read_saved,
    read_solutions,
    read_unknowns,
)
from halbach_fe.solver.interpolation import (
    Located,
    apply_operator,
    compare_printed,
    curl_operators,
    locate,
    nodal_operators,
    probes_of,
)
from halbach_fe.solver.mesh import (
    MESH_NAME,
    CountedMesh,
    Entities,
    MeshedCase,
    VerifiedMesh,
    build_meridian,
    build_mesh,
    count_mesh,
    verify_mesh,
)
from halbach_fe.solver.session import (
    MATRIX_FILE,
    RunSize,
    Session,
    Task,
    run_tasks,
    variant_name,
    write_history,
)
from halbach_fe.study.materials import MU_0


@dataclass(frozen=True)
class Formulation:
    """A weak form as a GetDP problem, with its unknowns and its linear solvers."""

    problem: str
    """Name of the problem file in pro/."""
    unknowns: Callable[[Entities], int]
    """Returns the number of unknowns, from the numbers of mesh entities off the outer boundary."""
    flux_density: Callable[[VerifiedMesh, Located, Unknowns], list[sparse.csr_array]]
    """Takes a mesh, located points (n,) and unknowns. Returns three sparse operators (n, unknowns)
    from a solution to Bx, By and Bz in T."""
    factorized: float = np.inf
    """Largest number of unknowns for which the matrix is factorized. Larger systems are solved by
    conjugate gradients."""
    factorized_for_newton: float = np.inf
    """The same limit for Newton's method, where every step has a matrix of its own."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    """Constants of the problem, for ``-setnumber``."""
    law: str = "reluctivity"
    """Law of the iron's curve that enters the weak form: ``reluctivity`` or ``permeability``."""
    route: str = "edge_elements"
    """Name of the route, see `halbach_fe.solver.routes.choose_route`."""


def _curl_of_axial(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    """Return the operators of B = curl (a_z e_z) = (da_z/dy, -da_z/dx, 0)."""
    _, (x, y) = nodal_operators(mesh, located, unknowns)
    return [y, -x, 0 * x]


def _minus_gradient(
    mesh: VerifiedMesh, located: Located, unknowns: Unknowns
) -> list[sparse.csr_array]:
    """Return the operators of B = -grad psi, which holds in air only."""
    return [-slope for slope in nodal_operators(mesh, located, unknowns)[1]]


FACTORIZED = 200_000
"""Largest number of unknowns for which the matrix of the scalar potential is factorized. With
160 000 unknowns the factorization takes 4 GiB and 25 s, once for all sources. For thin iron
conjugate gradients need 2400 iterations, 60 s, for every source."""

CROSS_SECTION = Formulation("magnetostatics_2d.pro", lambda inner: inner.nodes, _curl_of_axial,
                            route="cross_section")
SCALAR_POTENTIAL = Formulation("scalar_potential_3d.pro", lambda inner: inner.nodes,
                               _minus_gradient, FACTORIZED, FACTORIZED // 4, law="permeability",
                               route="scalar_potential")


def edge_elements(order: int) -> Formulation:
    """Return the formulation of the vector potential with edge elements of order 1 or 2."""
    return Formulation(
        # The tree of the gauge starts on the outer boundary. It has one edge for every corner off
        # the boundary, and the unknowns of the tree's edges are fixed to 0.
        "magnetostatics_3d.pro", lambda inner: inner.edges - inner.corners + (
            2 * inner.faces if order == 2 else 0),
        curl_operators, numbers={"ORDER": order})


NOMINAL_SOURCE = 0
"""Number of the source that is the magnetization of the whole array, see pro/sources.pro."""

FLUX_DENSITY_FILE = "flux_density.txt"
NEWTON_FILE = "newton_flux_density.txt"
SOLUTIONS_FILE = "solutions.bin"

NEWTON_TOLERANCE = 1e-10
"""Newton's method stops at this residual relative to the right-hand side. Since convergence is
quadratic, the last step usually ends far below; rounding leaves about 1e-14."""

PROBLEM_INCLUDES = ("problem_data.pro", "sources.pro", "vector_potential.pro", "solve_sources.pro",
                    "solve_newton.pro")


def solve_sources(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session,
    formulation: Formulation, anywhere: bool = False,
) -> Floats:
    """Return the finite-element part of B of the nominal array and of single blocks.

    The iron must be linear. For the method ``direct`` the result is B itself. For ``reaction`` it
    is the difference of two solves on one mesh, real materials minus vacuum, to be added to the
    exact field in vacuum.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    blocks : sequence of int
        Numbers, from 0, of the blocks to solve for with a remanence of 1 T along each of the D
        axes, while all other blocks have none.
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
    """Return the finite-element part of B with non-linear iron, and its Gateaux derivatives.

    The derivatives solve the problem that is linearized at the nominal array: its weak form has the
    differential reluctivity dH/dB (or the differential permeability dB/dH), and a change of the
    remanence is its source.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    blocks : sequence of int
        Numbers, from 0, of the blocks whose derivatives are wanted.
    anywhere : bool
        Whether points may lie in magnet and iron.

    Returns
    -------
    field : ndarray, shape (n, 3), in T
        The nominal array, by Newton's method.
    derivative : ndarray, shape (1 + D len(blocks), n, 3), in T
        The derivative along the nominal magnetization, then the derivatives per tesla of remanence
        of each block along each axis.
    """
    case = _case(magnet, points, blocks, session, formulation, anywhere)

    def tasks(vacuum: bool, parts: int) -> list[Task]:
        return _source_tasks(case, vacuum, 1) if vacuum else [
            _newton_task(case, nominal_samples(magnet), False, NEWTON_TOLERANCE, gateaux=True)]

    real, *vacuum = _run_variants(magnet, session, tasks)
    if vacuum:
        # In vacuum the problem is linear: subtract the nominal array's field from the field and
        # from the derivative along the nominal magnetization, and each block's from its derivative.
        real = real - vacuum[0][[0, *range(len(vacuum[0]))]]
    return real[0], real[1:]


def solve_samples(
    magnet: Magnet, points: Floats, samples: Floats, session: Session, formulation: Formulation,
    cold: bool = False, tolerance: float = NEWTON_TOLERANCE,
) -> Floats:
    """Return the finite-element part (k, n, 3) in T of B by Newton's method for magnetizations.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
        In air.
    samples : ndarray, shape (k, blocks, 3), in A/m
        Magnetizations of all blocks.
    cold : bool
        Whether Newton's method starts from zero for every sample, instead of from the solution of
        the sample before.
    tolerance : float
        Largest residual of a solution, relative to the right-hand side.

    Raises
    ------
    NotConvergedError
        If Newton's method fails; the error has the residuals of the sample that failed.
    """
    case = _case(magnet, points, (), session, formulation)
    return _difference(magnet, session, lambda vacuum, parts: [
        _newton_task(case, samples, vacuum, tolerance, cold=cold)])


def nominal_samples(magnet: Magnet) -> Floats:
    """Return the nominal magnetization as a single sample, (1, blocks, 3) in A/m."""
    return np.array([[block.magnetization for block in magnet.blocks]])


@dataclass(frozen=True)
class Assembly:
    """The linear system of a problem as GetDP assembled it, and its solutions."""

    mesh: VerifiedMesh
    unknowns: Unknowns
    matrix: sparse.csr_array
    """The stiffness, without the fixed degrees of freedom. Shape (unknowns, unknowns)."""
    solutions: Floats
    """The nominal array, then all blocks per tesla of remanence along each axis.
    Shape (1 + D blocks, unknowns)."""


def assemble(magnet: Magnet, session: Session, formulation: Formulation) -> Assembly:
    """Have GetDP assemble and solve the problem of a magnet with linear iron, for all blocks."""
    place = np.zeros((1, 3))  # any point in air, where GetDP prints B to verify our evaluation
    blocks = range(len(magnet.blocks))
    case = _case(magnet, place, blocks, session, formulation)
    last = magnet.dimension * len(blocks)
    system: dict[str, Any] = {}

    def keep_matrix(folder: Path, unknowns: Unknowns, _: NDArray[np.floating]) -> None:
        system["unknowns"] = unknowns
        system["matrix"] = read_matrix(folder / MATRIX_FILE, unknowns.count)

    def keep_solutions(_: Path, __: Unknowns, solutions: NDArray[np.floating]) -> None:
        system["solutions"] = np.array(solutions, float)

    # PETSc writes the matrix anew at every solve, so the matrix has a run of its own with one solve
    alone = replace(_source_task(case, False, (0, 0), "-matrix", keep_matrix), matrix=True)
    run_tasks([alone, _source_task(case, False, (0, last), "", keep_solutions)], session)
    return Assembly(case.real_mesh, **system)


@dataclass(frozen=True)
class _Case(MeshedCase):
    """The data that all runs for a magnet on one mesh share."""

    points: Floats
    """Shape (n, 3), in m."""
    blocks: Sequence[int]
    """Numbers, from 0, of the blocks that are sources of their own."""
    formulation: Formulation
    anywhere: bool
    """Whether points may lie in magnet and iron."""
    time_limit_s: float

    @cached_property
    def located(self) -> Located:
        """The elements that hold the points, and the points' coordinates in them."""
        return locate(self.real_mesh, self.points, self.anywhere)

    @cached_property
    def probes(self) -> tuple[Located, Floats]:
        """Probes (p, 3) in m where GetDP prints B, to check our own evaluation."""
        return probes_of(self.real_mesh, self.located.cells)

    def size(self, solves: int, newton: bool = False) -> RunSize:
        """Return the size of a run with ``solves`` linear solves."""
        return RunSize(self.formulation.route, self.mesh.elements,
                       self.formulation.unknowns(self.mesh.inner), solves, newton=newton)


def _case(
    magnet: Magnet, points: Floats, blocks: Sequence[int], session: Session,
    formulation: Formulation, anywhere: bool = False,
) -> _Case:
    """Return the case of some sources and points, on the mesh of the magnet."""
    if magnet.dimension == 2:
        points = points * [1, 1, 0]  # the field does not depend on z, and the mesh is at z = 0
    kind = "cross_section" if magnet.dimension == 2 else "extruded"
    mesh = open_mesh(magnet, points, session, kind)
    return _Case(magnet, mesh, points, blocks, formulation, anywhere, session.time_limit_s)


def open_mesh(
    magnet: Magnet, points: Floats, session: Session, kind: str
) -> VerifiedMesh | CountedMesh:
    """Mesh a magnet, verify the mesh and check that all points (n, 3) in m lie inside.

    ``kind`` is a key of `halbach_fe.geometry.domain.BOUNDARY_RATIO`. In a session that counts runs,
    only the numbers of mesh entities are estimated.
    """
    mesh = count_mesh(magnet, kind) if session.counter is not None else verify_mesh(
        (build_meridian if kind == "meridian" else build_mesh)(magnet, make_folder(session.folder)))
    check_inside(magnet.name, mesh.radius, mesh.half_length, points)
    return mesh


def variants_of(magnet: Magnet) -> list[bool]:
    """Return whether vacuum replaces all materials, for every solve that the method needs."""
    return [False] if magnet.study.solver.method == "direct" else [False, True]


def _difference(
    magnet: Magnet, session: Session, tasks: Callable[[bool, int], list[Task]]
) -> Floats:
    """Return the field of real materials or, for the method ``reaction``, that minus vacuum."""
    real, *vacuum = _run_variants(magnet, session, tasks)
    return real - vacuum[0] if vacuum else real


def _run_variants(
    magnet: Magnet, session: Session, tasks: Callable[[bool, int], list[Task]]
) -> list[Floats]:
    """Run the tasks of each variant that the study's method needs, real materials first.

    ``tasks`` takes whether materials are replaced by vacuum, and the number of parallel runs among
    which the sources should be divided. It returns the runs of that variant.
    """
    variants = variants_of(magnet)
    by_variant = [tasks(vacuum, max(1, session.jobs // len(variants))) for vacuum in variants]
    results = run_tasks([task for part in by_variant for task in part], session)
    limits = np.cumsum([0, *(len(part) for part in by_variant)])
    return [np.concatenate(results[a:b]) for a, b in pairwise(limits)]


@cache
def _templates() -> jinja2.Environment:
    """Return the templates of pro/, which are compiled once in a process."""
    return jinja2.Environment(
        variable_start_string="<<", variable_end_string=">>", block_start_string="<%",
        block_end_string="%>", comment_start_string="<#", comment_end_string="#>",
        trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined,
        autoescape=False, keep_trailing_newline=True,  # GetDP text, not HTML
        loader=jinja2.FunctionLoader(lambda name: resources.files(pro).joinpath(
            name).read_text("utf-8")))


def render(template: str, *, magnet: Magnet, **data: object) -> str:
    """Return the generated part of a problem as GetDP text, from a template in pro/."""
    return _templates().get_template(template).render(
        study=magnet.study, version=version("halbach-fe"), mu_0=MU_0, blocks=magnet.blocks,
        iron_permeability=magnet.iron_permeability, **data)


def _source_tasks(case: _Case, vacuum: bool, parts: int) -> list[Task]:
    """Return up to ``parts`` runs that solve a linear problem for all its sources."""
    last = case.magnet.dimension * len(case.blocks)
    limits = np.linspace(0, last + 1, min(last + 1, parts) + 1).astype(int)
    return [_source_task(case, vacuum, (int(a), int(b) - 1), f"-{number}" if number else "")
            for number, (a, b) in enumerate(pairwise(limits))]


def _source_task(
    case: _Case, vacuum: bool, sources: tuple[int, int], suffix: str,
    keep: Callable[[Path, Unknowns, NDArray[np.floating]], None] | None = None,
) -> Task:
    """Return the run that solves a linear problem for the sources from first to last.

    ``keep`` is called with the run folder, the unknowns and all solutions.
    """
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
    """Return the run of Newton's method for samples (k, blocks, 3) of magnetization in A/m.

    Its result is the field of each sample, followed with ``gateaux`` by the derivatives at the last
    sample.
    """
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
    """Return the name of the file that GetDP's SaveSolution writes."""
    return f"{Path(case.formulation.problem).stem}.res"


def _unknowns(case: _Case, folder: Path) -> Unknowns:
    """Return the unknowns of a run."""
    return read_unknowns(folder / f"{Path(case.formulation.problem).stem}.pre",
                         case.real_mesh.cell_type)


def _fields(
    case: _Case, unknowns: Unknowns, located: Located, solutions: NDArray[np.floating]
) -> Floats:
    """Return B (solutions, n, 3) in T of all solutions at n located points."""
    operators = case.formulation.flux_density(case.real_mesh, located, unknowns)
    return np.stack([apply_operator(operator, solutions) for operator in operators], axis=2)


@dataclass(frozen=True)
class RunRequest:
    """The sources and materials that one run of GetDP solves for."""

    blocks: Sequence[int] = ()
    """Numbers, from 0, of the blocks that are sources of their own."""
    sources: tuple[int, int] = (NOMINAL_SOURCE, NOMINAL_SOURCE)
    """First and last source, both included. Source 0 is the whole array; the axes of the first of
    ``blocks`` follow, then those of the next."""
    vacuum: bool = False
    """Whether all materials are replaced by vacuum."""
    samples: Floats | None = None
    """Magnetizations of the whole array; by default the nominal one.
    Shape (k, blocks, 3), in A/m."""
    time_limit_s: float = 3600.0


def fill_run_folder(
    magnet: Magnet, mesh: VerifiedMesh, places: Floats, folder: Path, formulation: Formulation,
    request: RunRequest | None = None,
) -> Job:
    """Fill a run folder with everything that GetDP needs, and return the job to run there.

    Parameters
    ----------
    places : ndarray, shape (n, 3), in m
        Points at which GetDP prints the field of the first source.
    folder : Path
        An existing folder.
    request : RunRequest, optional
        By default the nominal array is solved for, with real materials.
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
    """Refuse points (n, 3) in m outside the mesh of a study, where GetDP would print zeros.

    Raises
    ------
    PointsOutsideError
    """
    radius = radii_of(points)
    outside = (radius > radius_m) | (np.abs(points[:, 2]) > half_length_m)
    if outside.any():
        x, y, z = points[np.argmax(outside)]
        raise PointsOutsideError(name, (
            f"(radius {radius_m:g} m, half length {half_length_m:g} m); instead {outside.sum()} "
            f"points lie outside, the first at ({x:g}, {y:g}, {z:g}) m."))
