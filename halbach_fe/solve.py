"""Finite-element solves: from a study and its mesh to B at points, source by source."""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata, resources
from itertools import pairwise
from pathlib import Path

import jinja2
import numpy as np

from halbach_fe import getdp as runner
from halbach_fe.blocks import Floats, blocks_of, points_in_material
from halbach_fe.errors import GetDPError, MeshError, OutputError, StudyError
from halbach_fe.exact_field import field_of
from halbach_fe.getdp import GetDP, Job
from halbach_fe.mesh import MESH_NAME, VerifiedMesh, build_mesh, verify_mesh
from halbach_fe.study import MU_0, Study

NOMINAL_SOURCE = 0
FLUX_DENSITY_FILE = "flux_density.txt"
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


def source_number(study: Study, block: int, component: int) -> int:
    """Number of the source '1 T of block ``block`` along axis ``component``', both from 0."""
    return study.dimension * block + component + 1


def solve_nominal(study: Study, points: Floats, workshop: Workshop) -> Floats:
    """Field of the nominal array at points (n, 3) in m, by the study's method; (n, 3) in T."""
    check_points(study, points)
    correction = solve_sources(study, points, (NOMINAL_SOURCE, NOMINAL_SOURCE), workshop)[0]
    if study.solver.method == "direct":
        return correction
    return field_of(blocks_of(study), points) + correction


def solve_sources(
    study: Study, points: Floats, sources: tuple[int, int], workshop: Workshop
) -> Floats:
    """Finite-element part of the field for a range of sources.

    For the method ``direct`` that is B itself. For ``reaction`` it is the difference of two
    solves on one mesh, real materials minus vacuum, to be added to the exact field in vacuum;
    the discretization error of the sources' own field, by far the largest, cancels.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    sources : (first, last)
        Both included; see `source_number`, and `NOMINAL_SOURCE`.

    Returns
    -------
    ndarray, shape (last - first + 1, n, 3), in T
    """
    first, last = sources
    count = last - first + 1
    if study.solver.method == "reaction" and not has_reaction(study):
        return np.zeros((count, len(points), 3))
    variants = [False] if study.solver.method == "direct" else [False, True]
    folder = _make(workshop.folder)
    mesh = verify_mesh(build_mesh(study, folder))
    _check_inside(mesh, points)
    parts = max(1, min(count, workshop.jobs // len(variants)))
    limits = np.linspace(first, last + 1, parts + 1).astype(int)
    ranges = [(int(a), int(b) - 1) for a, b in pairwise(limits)]
    counter = _Counter(count * len(variants), workshop.progress)
    cancel = threading.Event()
    with ThreadPoolExecutor(max(1, workshop.jobs)) as pool:
        tasks = {
            (vacuum, part): pool.submit(_run, study, mesh, points, part, vacuum, workshop,
                                        counter, cancel)
            for vacuum in variants for part in ranges
        }
        try:
            wait(tasks.values(), return_when=FIRST_EXCEPTION)
            for task in tasks.values():
                if task.done():
                    task.result()
        finally:
            cancel.set()  # on failure and on Ctrl-C nobody waits for the others
    fields = [np.concatenate([tasks[vacuum, part].result() for part in ranges])
              for vacuum in variants]
    return fields[0] if len(fields) == 1 else fields[0] - fields[1]


def has_reaction(study: Study) -> bool:
    """Tell whether any material differs from vacuum."""
    return study.array.recoil_permeability != 1.0 or study.iron_ring is not None


def check_points(study: Study, points: Floats) -> None:
    """Refuse points inside magnet or iron, where the field is not what a probe can read."""
    inside = points_in_material(study, points)
    if inside.any():
        x, y, z = points[np.argmax(inside)]
        raise StudyError(
            f"Input `observation.positions` of study {study.name} must lie in air; instead "
            f"{inside.sum()} of {len(points)} points lie inside magnet or iron, the first at "
            f"({x:g}, {y:g}, {z:g}) m. Move them into the bore or beyond the ends.")


def render_case(study: Study, mesh: VerifiedMesh, points: Floats) -> str:
    """The generated part of the problem, as GetDP text."""
    source = resources.files("halbach_fe.pro").joinpath("case.pro.j2").read_text("utf-8")
    environment = jinja2.Environment(
        variable_start_string="<<", variable_end_string=">>", block_start_string="<%",
        block_end_string="%>", comment_start_string="<#", comment_end_string="#>",
        trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined,
        autoescape=False, keep_trailing_newline=True)  # GetDP text, not HTML
    return environment.from_string(source).render(
        study=study, version=metadata.version("halbach-fe"), mu_0=MU_0,
        blocks=blocks_of(study), points=points.tolist(), regions=mesh.regions,
        recoil_permeability=study.array.recoil_permeability,
        iron_permeability=study.iron_ring.relative_permeability if study.iron_ring else 1.0)


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


def _run(
    study: Study, mesh: VerifiedMesh, points: Floats, sources: tuple[int, int], vacuum: bool,
    workshop: Workshop, counter: _Counter, cancel: threading.Event,
) -> Floats:
    name = f"getdp-{'vacuum' if vacuum else 'real'}" + (f"-{sources[0]}" if sources[0] > 1 else "")
    with _run_folder(workshop.folder, name, cancel) as folder:
        job = stage(study, mesh, points, folder, sources, vacuum, workshop.time_limit_s)
        runner.run(workshop.getdp, job, folder, counter.line, cancel)
        return runner.read_flux_density(folder / FLUX_DENSITY_FILE, points,
                                        sources[1] - sources[0] + 1)


def stage(
    study: Study, mesh: VerifiedMesh, points: Floats, folder: Path,
    sources: tuple[int, int] = (NOMINAL_SOURCE, NOMINAL_SOURCE), vacuum: bool = False,
    time_limit_s: float = 3600.0,
) -> Job:
    """Fill a run folder with everything that GetDP needs, and return the job to run there."""
    problem = f"magnetostatics_{study.dimension}d.pro"
    for name in (problem, *PROBLEM_INCLUDES):
        text = resources.files("halbach_fe.pro").joinpath(name).read_bytes()
        (folder / name).write_bytes(text)
    (folder / "case.pro").write_text(render_case(study, mesh, points), encoding="utf-8")
    shutil.copyfile(mesh.path, folder / MESH_NAME)
    return Job(
        problem=problem, mesh=MESH_NAME, resolution="Magnetostatics",
        numbers={"VACUUM": vacuum, "FIRST_SOURCE": sources[0], "LAST_SOURCE": sources[1]},
        outputs=(FLUX_DENSITY_FILE,), unknowns=mesh.unknowns, time_limit_s=time_limit_s)


@contextmanager
def _run_folder(parent: Path, name: str, cancel: threading.Event) -> Iterator[Path]:
    """A private folder, kept as ``name`` after a good run and as ``name-failed`` (with the log)
    after a bad one; anything else that ends the run leaves nothing.
    """
    folder = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=_make(parent)))
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


def _make(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"Cannot make folder {folder}: {error.strerror}.") from None
    return folder


def _check_inside(mesh: VerifiedMesh, points: Floats) -> None:
    radius = np.hypot(points[:, 0], points[:, 1])
    outside = (radius > mesh.radius) | (np.abs(points[:, 2]) > mesh.half_length)
    if outside.any():
        x, y, z = points[np.argmax(outside)]
        raise MeshError(
            f"Input `observation.positions` of study {mesh.regions.study} must lie within the "
            f"meshed region (radius {mesh.radius:g} m, half length {mesh.half_length:g} m); "
            f"instead {outside.sum()} points lie outside, the first at ({x:g}, {y:g}, {z:g}) m. "
            "Check the units of the points, or enlarge `open_boundary`.")
