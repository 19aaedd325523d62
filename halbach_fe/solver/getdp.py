"""The one module that runs GetDP, and that believes nothing it says.

GetDP ends with exit code 0 after many failures: an unconverged solver, a region that the mesh
lacks, a misspelt ``-setnumber``, a point outside the mesh. So every run happens in a private
folder, with short relative names (a path over 256 characters overflows a buffer of GetDP), and
its exit code, every line of its log, the number of unknowns, the residual of every solve and
every number of its output are checked before the result is handed on.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import GetDPError, GetDPNotFoundError

ENVIRONMENT_VARIABLE = "HALBACH_FE_GETDP"
LOG_NAME = "getdp.log"
MAX_NAME = 200
"""GetDP keeps paths in 256 characters, and appends to them."""

MAX_RELATIVE_RESIDUAL = 1e-8
"""A direct solve leaves 1e-13; 1e-8 of the source is still 1e-4 of the smallest error we state."""

DIRECT_SOLVER = (
    "-petsc_prealloc", "200",
    "-ksp_type", "preonly", "-pc_type", "cholesky", "-pc_factor_mat_solver_type", "mumps",
)
"""The matrices are symmetric: Cholesky takes half the memory of LU. Rows longer than those
preallocated make assembling many times slower."""

CONJUGATE_GRADIENTS = (
    "-petsc_prealloc", "400",
    "-ksp_type", "cg", "-pc_type", "sor", "-pc_sor_local_symmetric", "-ksp_rtol", "1e-10",
    "-ksp_max_it", "5000",
)
"""For large scalar potentials of second order in 3D. Incomplete Cholesky is faster where it works,
but loses definiteness on fine meshes. Sweeps are local to each MPI process; there are no others."""

NEWTON_STEPS = (
    "-petsc_prealloc", "400",
    "-ksp_type", "cg", "-pc_type", "gamg", "-mg_levels_ksp_type", "richardson",
    "-mg_levels_pc_type", "sor", "-mg_levels_pc_sor_local_symmetric", "-ksp_rtol", "1e-4",
    "-ksp_max_it", "5000",
)
"""For large scalar potentials again: a step of Newton's method need not be exact, its convergence
is judged by the residual itself. With 160 000 unknowns and thin iron nine steps take 170 s, a
quarter of what `CONJUGATE_GRADIENTS` take."""

NEWTON_RESIDUAL = 1e-3
"""Of such a step: that of a preconditioner is not that of the equations."""

_ALONE = {"OMPI_MCA_ess_singleton_isolated": "1"}
"""Open MPI, which Debian's GetDP is built with, otherwise starts a daemon for every run; it can
outlive a killed run, and costs 8 s where the machine's own name does not resolve."""

_TOGETHER = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
             "OMPI_MCA_rmaps_base_oversubscribe": "1", "OMPI_MCA_hwloc_base_binding_policy": "none"}
"""For `mpirun`: containers have no other user than root, and who asks knows the cores."""

_INSTALL = ("Install it (Debian, Ubuntu: `apt-get install getdp libopenblas0-pthread`), or name it "
            f"with --getdp or {ENVIRONMENT_VARIABLE}.")
_COLOURS = re.compile(r"\x1b\[\d*m")
_NAMED_FAILURES = (  # pattern in the log, what it means
    (r"KSPSolve has not converged|KSP_DIVERGED|DIVERGED_", "the linear solver did not converge"),
    (r"[Nn]o space left", "the disk is full"),
    (r"Newton's method did not converge", "Newton's method did not converge"),
    (r"MUMPS|INFOG|MatSolve.*mumps|factorization", "MUMPS could not factorize the matrix"),
    (r"IterativeLoop did NOT converge|not converge", "an iteration did not converge"),
    (r"assuming zero|Unset|undefined run-time", "a run-time variable was never set"),
    (r"Unknown (constraint|region)", "a region or constraint is unknown"),
    (r"Zero-size system", "the system has no unknowns"),
)


@dataclass(frozen=True)
class GetDP:
    """A GetDP executable and what it says of itself."""

    executable: Path
    version: str
    build_options: tuple[str, ...]
    petsc: str


@dataclass(frozen=True)
class Job:
    """One run of GetDP.

    Attributes
    ----------
    problem, mesh : str
        Names inside the run folder.
    resolution : str
        The resolution to solve.
    numbers : mapping
        ``-setnumber`` constants; each must be declared by a DefineConstant of the problem.
    outputs : tuple of str
        Files that the run must write.
    solutions, matrix : str or None
        Files for the solution of every linear system, and the last one's matrix, see
        `halbach_fe.solver.dofs`.
    unknowns : int or None
        Number of unknowns that the system must have; None where it cannot be foretold.
    solves : int
        Linear solves that the log must show, each with its residuals.
    options : tuple of str
        PETSc options of the linear solver.
    linear_residual : float
        That every linear solve must leave at most, over the first.
    time_limit_s : float
        The run is ended after so many seconds.
    threads : int
        Threads of the linear algebra.
    processes : int
        MPI processes that share the run.
    """

    problem: str
    mesh: str
    resolution: str
    outputs: tuple[str, ...]
    numbers: Mapping[str, float] = field(default_factory=dict)
    solutions: str | None = None
    matrix: str | None = None
    unknowns: int | None = None
    solves: int = 1
    options: tuple[str, ...] = DIRECT_SOLVER
    linear_residual: float = MAX_RELATIVE_RESIDUAL
    time_limit_s: float = 3600.0
    threads: int = 1
    processes: int = 1

    @property
    def large(self) -> tuple[str, ...]:
        """Files of solutions and matrices, which only this program reads."""
        saved = [name for name in self.outputs if name.endswith(".res")]
        return tuple(name for name in (self.solutions, self.matrix, *saved) if name)


Run = Callable[
    [GetDP, Job, Path, Callable[[str], None] | None, threading.Event | None], list[str]]
"""What runs a job like `run` does."""


def find_getdp(named: str | Path | None = None) -> GetDP:
    """Find GetDP: as named, else in the environment variable, else on PATH; ask what it is.

    Raises
    ------
    GetDPNotFoundError
        If there is none, or what is there does not answer like GetDP.
    """
    wanted = str(named) if named else os.environ.get(ENVIRONMENT_VARIABLE) or "getdp"
    found = shutil.which(wanted)
    if found is None:
        raise GetDPNotFoundError(f"GetDP was not found: `{wanted}` is no executable. {_INSTALL}")
    try:
        answer = subprocess.run([found, "-info"], capture_output=True, text=True, timeout=30,
                                errors="replace", check=False, env=os.environ | _ALONE)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise GetDPNotFoundError(
            f"GetDP at {found} does not answer ({error}). {_INSTALL}") from None
    said = dict(re.findall(r"^(.+?)\s*:\s*(.*)$", answer.stdout + answer.stderr, re.MULTILINE))
    if answer.returncode != 0 or "Version" not in said:
        raise GetDPNotFoundError(f"{found} does not answer like GetDP. {_INSTALL}")
    return GetDP(executable=Path(found).resolve(), version=said["Version"],
                 build_options=tuple(said.get("Build options", "").split()),
                 petsc=said.get("PETSc version", ""))


def blas_of(getdp: GetDP) -> Path | None:
    """The system's BLAS that a GetDP loads; None if it has one of its own, or nobody tells."""
    try:
        answer = subprocess.run(["ldd", str(getdp.executable)], capture_output=True, text=True,
                                timeout=30, errors="replace", check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    found = re.search(r"^\s*libblas\S* => (/\S+)", answer.stdout, re.MULTILINE)
    return Path(found[1]).resolve() if found else None


def run(
    getdp: GetDP,
    job: Job,
    folder: Path,
    on_line: Callable[[str], None] | None = None,
    cancel: threading.Event | None = None,
) -> list[str]:
    """Run a job in ``folder``, verify how it went, and return its log.

    The log is kept as ``getdp.log`` in the folder. ``on_line`` sees every line as it comes;
    setting ``cancel`` ends the run.

    Raises
    ------
    GetDPError
        With what went wrong, by name, and where the log is.
    """
    _check_before(job, folder)
    arguments = [
        str(getdp.executable), job.problem, "-msh", job.mesh, "-solve", job.resolution,
        "-v", "4", "-skip_petscrc", "-ksp_error_if_not_converged", *job.options,
    ]
    for name, value in job.numbers.items():
        arguments += ["-setnumber", name, f"{value:.17g}"]
    written = job.outputs
    if job.solutions is not None:
        arguments += ["-ksp_view_solution", f"binary:{job.solutions}::append",
                      "-viewer_binary_skip_info"]  # PETSc's own note of the options beside it
        written = (*written, job.solutions)
    if job.matrix is not None:
        arguments += ["-ksp_view_mat", f"binary:{job.matrix}"]
        written = (*written, job.matrix)
    for output in written:
        (folder / output).unlink(missing_ok=True)  # GetDP would append to, or leave, a stale one
    lines = _execute(arguments, job, folder, on_line, cancel)
    _check_log(lines, job, folder)
    for output in written:
        if not (folder / output).is_file() or not (folder / output).stat().st_size:
            raise _failure(f"it did not write {output}", folder)
    return lines


def read_vectors(path: Path, points: Floats) -> Floats:
    """Read GetDP's SimpleTable of vectors at points, and verify it.

    Parameters
    ----------
    path : Path
        Rows ``x y z`` and three components.
    points : ndarray, shape (n, 3), in m
        Where the vector was asked for.

    Returns
    -------
    ndarray, shape (n, 3)

    Raises
    ------
    GetDPError
        Wrong number of rows or columns, other points, values that are not finite, or the zeros
        that stand for a point outside the mesh.
    """
    where = path.parent
    try:
        lines = path.read_text(encoding="ascii").splitlines()
        table = np.loadtxt(lines, ndmin=2, comments=None) if "".join(lines).strip() else (
            np.empty((0, 0)))  # of nothing NumPy warns
    except (ValueError, OSError) as error:
        raise _failure(f"{path.name} is not a table of six columns ({error}); a point outside the "
                       "mesh looks like this, and so does a full disk", where) from None
    if table.shape != (len(points), 6):
        raise _failure(f"{path.name} holds {table.shape[0]} rows of {table.shape[1]} columns in "
                       f"place of {len(points)} of 6; a point outside the mesh looks "
                       "like this, and so does a full disk", where)
    scale = max(1e-9, float(np.abs(points).max()))
    if not np.allclose(table[:, :3], points, rtol=0, atol=1e-9 * scale):
        raise _failure(f"{path.name} was evaluated at other points than asked for", where)
    vectors = table[:, 3:]
    if not np.isfinite(vectors).all():
        raise _failure(f"{path.name} holds values that are not finite", where)
    zero = np.flatnonzero(~vectors.any(axis=1))
    if len(zero):
        x, y, z = points[zero[0]]
        raise _failure(f"the field at ({x:g}, {y:g}, {z:g}) m is exactly zero, GetDP's sign for a "
                       f"point outside the mesh ({len(zero)} such values)", where)
    return vectors


def declared_constants(folder: Path) -> set[str]:
    """Names in the DefineConstant blocks of all problem files of a folder."""
    names: set[str] = set()
    for path in folder.glob("*.pro"):
        text = re.sub(r"//[^\n]*", "", path.read_text(encoding="utf-8"))
        for block in re.findall(r"DefineConstant\s*\[(.*?)\]\s*;", text, re.DOTALL):
            names.update(re.findall(r"(\w+)\s*=", block))
    return names


def _check_before(job: Job, folder: Path) -> None:
    for name in (job.problem, job.mesh, *job.outputs):
        if len(name) > MAX_NAME:
            raise _failure(f"the name {name[:30]}... has {len(name)} characters, and GetDP's "
                           f"buffers end at 256; keep names under {MAX_NAME}", folder)
    for name in (job.problem, job.mesh):
        if not (folder / name).is_file():
            raise _failure(f"{name} is missing from the run folder", folder)
    unknown = set(job.numbers) - declared_constants(folder)
    if unknown:
        raise _failure(f"-setnumber {min(unknown)} sets a constant that no DefineConstant "
                       "declares, and GetDP would ignore it", folder)


def _launcher(job: Job) -> list[str]:
    """What GetDP is started by: so that it ends when its starter does, however that ends, and
    under MPI if several processes share the run.
    """
    tether = _tether()
    return tether if job.processes == 1 else [*tether, "mpirun", "-n", str(job.processes), *tether]


@cache
def _tether() -> list[str]:
    """util-linux has it since 2.33; others may have a `setpriv` without."""
    tether = ["setpriv", "--pdeathsig", "KILL"]
    try:
        tried = subprocess.run([*tether, "true"], capture_output=True, check=False, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return []
    return tether if tried.returncode == 0 else []


def _execute(
    arguments: list[str], job: Job, folder: Path,
    on_line: Callable[[str], None] | None, cancel: threading.Event | None,
) -> list[str]:
    threads = str(job.threads)
    environment = os.environ | (_ALONE if job.processes == 1 else _TOGETHER) | {
        "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
    environment.pop("PETSC_OPTIONS", None)  # nobody would know of them afterwards
    lines: list[str] = []
    if job.processes > 1 and shutil.which("mpirun") is None:
        raise _failure("`mpirun` was not found (Debian: openmpi-bin)", folder)
    try:
        process = subprocess.Popen(
            [*_launcher(job), *arguments], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
            start_new_session=True)
    except OSError as error:
        raise _failure(f"it could not be started ({error.strerror})", folder) from None

    def read() -> None:
        assert process.stdout is not None
        with process.stdout:
            for text in process.stdout:  # progress bars use carriage returns
                for line in re.split(r"[\r\b]+", _COLOURS.sub("", text.rstrip("\n"))):
                    if line.strip() and not re.search(r"rocessing \(|%\s+: P", line):
                        lines.append(line)
                        if on_line is not None:
                            on_line(line)

    reader = threading.Thread(target=read, daemon=True)
    deadline = time.monotonic() + job.time_limit_s
    ended = ""
    try:
        reader.start()
        while process.poll() is None:
            if cancel is not None and cancel.is_set():
                ended = "it was cancelled"
            elif time.monotonic() > deadline:
                ended = (f"it was still running after the time limit of {job.time_limit_s:g} s; "
                         "use a coarser mesh or raise --time-limit")
            if ended:
                break
            time.sleep(0.02)
    finally:
        if process.poll() is None:
            _kill(process)
        if reader.is_alive():
            reader.join(timeout=10)
        _save_log(folder, arguments, lines)
    if ended:
        raise _failure(ended, folder)
    if process.returncode < 0:
        name = signal.Signals(-process.returncode).name
        hint = {"SIGKILL": "; out of memory?", "SIGXFSZ": "; a file grew over its limit"}
        raise _failure(f"it crashed ({name}{hint.get(name, '')})", folder)
    if process.returncode:
        complaint = next((line for line in lines if re.match(r"\s*Error\s*:", line)), "")
        said = complaint.partition(":")[2].strip() or (lines[-1].strip() if lines else "nothing")
        name = _name_of("\n".join(lines), f"exit code {process.returncode}")
        raise _failure(f"{name}: '{said[:200]}'", folder)
    return lines


def _kill(process: subprocess.Popen[str]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _save_log(folder: Path, arguments: list[str], lines: list[str]) -> None:
    text = "\n".join([" ".join(arguments[1:]), *lines, ""])
    with contextlib.suppress(OSError):  # the failure that filled the disk is the one to report
        (folder / LOG_NAME).write_text(text, encoding="utf-8")


def _check_log(lines: list[str], job: Job, folder: Path) -> None:
    for line in lines:
        if re.match(r"\s*(Warning|Error)\s*:", line):
            said = line.partition(":")[2].strip()
            raise _failure(f"{_name_of(said, 'GetDP warned')}: '{said[:200]}'", folder)
    text = "\n".join(lines)
    if job.processes > 1 and f", {job.processes} nodes," not in text:
        raise _failure(
            f"it did not run in the {job.processes} MPI processes asked for: `mpirun` must be of "
            "the MPI that GetDP is built with (Debian: openmpi-bin)", folder)
    sizes = [int(n) for n in re.findall(r"System \d+/\d+: (\d{1,15}) Dofs", text)]
    if not sizes or 0 in sizes:
        raise _failure("the system has no unknowns: is the mesh empty?", folder)
    if job.unknowns is not None and sizes[0] != job.unknowns:
        raise _failure(
            f"the system has {sizes[0]} unknowns where the mesh gives {job.unknowns}: a boundary "
            "condition, a gauge or a region is missing", folder)
    found = _check_residuals(lines, job.linear_residual, folder)
    if found < job.solves:
        raise _failure(f"its log shows the residuals of {found} of {job.solves} solves", folder)


def _check_residuals(lines: list[str], largest: float, folder: Path) -> int:
    """Every linear solve must have brought its residual down; return how many there were."""
    first: float | None = None
    found = 0
    last = np.nan
    for line in [*lines, "  0 KSP Residual norm 0"]:
        match = re.search(r"(\d{1,9}) KSP Residual norm (\S+)", line)
        if not match:
            continue
        residual = _residual(match[2], folder)
        if match[1] == "0":
            if first is not None and not last <= largest * first:
                raise _failure(f"a linear solve left a residual of {last:.1e} of {first:.1e}: the "
                               "linear solver did not converge", folder)
            found += first is not None
            first, last = residual, np.inf
        else:
            last = residual
    return found


def _residual(text: str, folder: Path) -> float:
    with contextlib.suppress(ValueError):
        if np.isfinite(residual := float(text)):
            return residual
    raise _failure(f"a linear solve left a residual of '{text[:40]}', which is no number: the "
                   "linear solver did not converge", folder)


def _name_of(text: str, otherwise: str) -> str:
    return next((name for pattern, name in _NAMED_FAILURES if re.search(pattern, text)), otherwise)


def _failure(what: str, folder: Path) -> GetDPError:
    hint = ""
    if shutil.disk_usage(folder).free < 10_000_000:
        hint = " The disk is full: free some space."
    log = folder / LOG_NAME
    return GetDPError(f"GetDP did not give a result that can be trusted: {what}.{hint}",
                      log if log.is_file() else None)
