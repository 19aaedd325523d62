"""Running GetDP, and verification of every run; only this module starts GetDP.

GetDP ends with exit code 0 after many failures: an unconverged solver, a region that the mesh
lacks, a misspelt ``-setnumber``, a point outside the mesh. Therefore every run happens in a private
folder, with short relative names (a path over 256 characters overflows a buffer of GetDP). The exit
code, every line of the log, the number of unknowns, the residual of every linear solve and every
number of the output are checked before a result is returned.
"""

from __future__ import annotations

import contextlib
import hashlib
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
from importlib import metadata
from pathlib import Path

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import GetDPError, GetDPNotFoundError, HalbachError, OutputError
from halbach_fe.core.files import is_full
from halbach_fe.core.installation import install_command

ENVIRONMENT_VARIABLE = "HALBACH_FE_GETDP"
LOG_NAME = "getdp.log"

MAX_RELATIVE_RESIDUAL = 1e-8
"""Largest accepted residual of a linear solve, relative to its first residual. A direct solver
leaves 1e-13. A residual of 1e-8 of the source is still 1e-4 of the smallest error bar that is
reported."""

DIRECT_SOLVER = (
    "-petsc_prealloc", "200", "-ksp_type", "richardson", "-ksp_norm_type", "unpreconditioned",
    "-ksp_rtol", "1e-10", "-ksp_max_it", "5",
    "-pc_type", "cholesky", "-pc_factor_mat_solver_type", "mumps",
)
"""PETSc options of the direct solver, MUMPS. The matrices are symmetric, so that a Cholesky
factorization takes half the memory of LU. If rows were longer than preallocated, the assembly would
be many times slower. One step of Richardson's iteration is the direct solve, and the log shows its
residual; of ``preonly`` PETSc 3.10 shows none."""

DIRECT_SOLVER_OF_PLANE = (*DIRECT_SOLVER, "-mat_mumps_icntl_7", "2")
"""PETSc options of the same for a mesh of a plane that is factorized anew for each mode. With the
ordering AMF instead of PORD, a mode with 20 sources takes a sixth less with 53 000 and 66 000
unknowns; meshes in space were not tried. The solutions differ by 3e-14.
"""

CONJUGATE_GRADIENTS = (
    "-petsc_prealloc", "400",
    "-ksp_type", "cg", "-pc_type", "sor", "-pc_sor_local_symmetric", "-ksp_rtol", "1e-10",
    "-ksp_max_it", "5000",
)
"""PETSc options for large scalar potentials of second order in 3D: conjugate gradients with
symmetric SOR as preconditioner. Incomplete Cholesky converges faster if it works, but loses
definiteness on fine meshes. The sweeps of SOR are local to each MPI process, since PETSc has no
parallel SOR."""

NEWTON_STEPS = (
    "-petsc_prealloc", "400",
    "-ksp_type", "cg", "-pc_type", "gamg", "-mg_levels_ksp_type", "richardson",
    "-mg_levels_pc_type", "sor", "-mg_levels_pc_sor_local_symmetric", "-ksp_rtol", "1e-4",
    "-ksp_max_it", "5000",
)
"""PETSc options for the steps of Newton's method, also for large scalar potentials. A step need not
be exact, because the convergence of Newton's method is judged by the non-linear residual. With
160 000 unknowns and thin iron nine steps take 170 s, a quarter of the time of
`CONJUGATE_GRADIENTS`."""

NEWTON_RESIDUAL = 1e-3
"""Largest accepted relative residual of the linear solve in such a step. It exceeds ``-ksp_rtol``,
because PETSc's test applies to the preconditioned residual."""

_ALONE = {"OMPI_MCA_ess_singleton_isolated": "1", "OMPI_MCA_pml": "ob1", "OMPI_MCA_btl": "self"}
"""Environment of a run in one process. Debian's GetDP is built with Open MPI, which would otherwise
start a daemon for every run; the daemon can outlive a killed run, and costs 8 s on a machine whose
own host name does not resolve. It would also try every network for messages that nobody sends: of
0.5 s that a start took on a busy machine, half."""

_TOGETHER = {"OMPI_MCA_mpi_yield_when_idle": "1",
             "OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
             "OMPI_MCA_rmaps_base_oversubscribe": "1", "OMPI_MCA_hwloc_base_binding_policy": "none"}
"""Environment of a run by `mpirun`. Containers often have no user but root, and the number of
processes is the user's choice, even if it exceeds the cores that Open MPI counts: one that waits
for a message gives way, without which two processes on two busy cores took twice the time."""

_PACKAGE = "pyonelab"
"""Package of PyPI that contains the static build of GetDP's makers, for Linux on x86-64."""

_PACKAGED_SHA256 = "ffc369cac19f88668d892cc07c8732c452b2a5331d99a623906e89d340a6b89a"
"""SHA-256 of ``bin/Linux/getdp`` in pyonelab 1.0.5: only the build that was tested is started."""

_COLOURS = re.compile(r"\x1b\[\d*m")
DISK_FULL = "the disk is full"
_NAMED_FAILURES = (  # pattern in the log, and its meaning
    (r"KSPSolve has not converged|KSP_DIVERGED|DIVERGED_", "the linear solver did not converge"),
    (r"[Nn]o space left|[Dd]isk quota|[Ff]ile too large", DISK_FULL),
    (r"bad_alloc|[Oo]ut of memory|[Cc]annot allocate", "memory ran out"),
    (r"Newton's method did not converge", "Newton's method did not converge"),
    (r"MUMPS|INFOG|MatSolve.*mumps|factorization", "MUMPS could not factorize the matrix"),
    (r"IterativeLoop did NOT converge|not converge", "an iteration did not converge"),
    (r"assuming zero|Unset|undefined run-time", "a run-time variable was never set"),
    (r"Unknown (constraint|region)", "a region or constraint is unknown"),
    (r"Zero-size system", "the system has no unknowns"),
)


@dataclass(frozen=True)
class GetDP:
    """A GetDP executable and its build, as ``getdp -info`` prints it."""

    executable: Path
    version: str
    build_options: tuple[str, ...]
    petsc: str
    """Version of PETSc; empty if it is not printed."""


@dataclass(frozen=True)
class Job:
    """One run of GetDP."""

    problem: str
    mesh: str
    """Names of files inside the run folder."""
    resolution: str
    """Name of the Resolution in the problem file."""
    outputs: tuple[str, ...]
    """Files that the run must write."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    """``-setnumber`` constants; each must be declared by a DefineConstant of the problem."""
    solutions: str | None = None
    matrix: str | None = None
    """Files to which PETSc writes the solution of every linear system, and the matrix of the last
    one; `halbach_fe.solver.getdp_files` reads them. None if they are not wanted."""
    unknowns: int | None = None
    """Number of unknowns that the system must have; None if it is not known in advance."""
    solves: int = 1
    """Smallest number of linear solves that the log must show, each with its residuals."""
    options: tuple[str, ...] = DIRECT_SOLVER
    """PETSc options of the linear solver."""
    linear_residual: float = MAX_RELATIVE_RESIDUAL
    """Largest accepted last residual of a linear solve, relative to its first residual."""
    time_limit_s: float = 3600.0
    """The run is killed after this time."""
    threads: int = 1
    """Threads of the linear algebra."""
    processes: int = 1
    """MPI processes that share the run."""

    @property
    def large(self) -> tuple[str, ...]:
        """Names of the large files of solutions and matrices, which only halbach-fe reads."""
        saved = [name for name in self.outputs if name.endswith(".res")]
        return tuple(name for name in (self.solutions, self.matrix, *saved) if name)


Run = Callable[
    [GetDP, Job, Path, Callable[[str], None] | None, threading.Event | None], list[str]]
"""A function with the arguments and results of `run`, such as
`halbach_fe.solver.session.Cluster.run`."""


NO_GETDP = GetDP(Path(), "none", (), "")
"""Stands for GetDP where it is not installed; only a run that needs GetDP refuses it."""


def getdp_or_none(named: str | Path | None) -> GetDP:
    """Return the GetDP of `find_getdp`, or `NO_GETDP` if none was named and none is installed.

    What has a closed form needs no GetDP.
    """
    if named or os.environ.get(ENVIRONMENT_VARIABLE) or shutil.which("getdp") or _packaged():
        return find_getdp(named)
    return NO_GETDP


def _packaged() -> Path | None:
    """Return the GetDP of the package pyonelab, or None if that is not installed as tested."""
    try:
        files = metadata.files(_PACKAGE) or []
    except metadata.PackageNotFoundError:
        return None
    for file in files:
        path = Path(str(file.locate()))
        if file.match("bin/Linux/getdp") and path.is_file():
            content = path.read_bytes()
            return path if hashlib.sha256(content).hexdigest() == _PACKAGED_SHA256 else None
    return None


def _advice() -> str:
    """Return what to do where no GetDP answers."""
    return (f"Install it (`{install_command('getdp')}`; Debian, Ubuntu: `apt-get install getdp "
            f"libopenblas0-pthread`), or name it with --getdp or {ENVIRONMENT_VARIABLE}.")


def find_getdp(named: str | Path | None = None) -> GetDP:
    """Find the GetDP executable and read its version and build from ``getdp -info``.

    ``named``: the executable; by default that of $HALBACH_FE_GETDP, then of PATH, then of pyonelab.

    Raises
    ------
    GetDPNotFoundError
        If there is no executable, or if it does not answer like GetDP.
    """
    wanted = str(named) if named else os.environ.get(ENVIRONMENT_VARIABLE)
    path = shutil.which(wanted or "getdp") or (None if wanted else _packaged())
    if path is None:
        raise GetDPNotFoundError(
            f"GetDP was not found: `{wanted or 'getdp'}` is no executable. {_advice()}")
    executable = Path(path).resolve()
    status = executable.stat()
    return _asked(executable, status.st_size, status.st_mtime_ns)


@cache
def _asked(path: Path, _bytes: int, _changed_ns: int) -> GetDP:
    """Ask an executable for its version and build: the same file once, as it takes 0.25 s."""
    try:
        answer = subprocess.run([path, "-info"], capture_output=True, text=True, timeout=30,
                                errors="replace", check=False, env=os.environ | _ALONE)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise GetDPNotFoundError(
            f"GetDP at {path} does not answer ({error}). {_advice()}") from None
    build = dict(re.findall(r"^(.+?)\s*:\s*(.*)$", answer.stdout + answer.stderr, re.MULTILINE))
    if answer.returncode != 0 or "Version" not in build:
        raise GetDPNotFoundError(f"{path} does not answer like GetDP. {_advice()}")
    return GetDP(executable=path, version=build["Version"],
                 build_options=tuple(build.get("Build options", "").split()),
                 petsc=build.get("PETSc version", ""))


def blas_of(getdp: GetDP) -> Path | None:
    """Return the system's BLAS library that a GetDP loads.

    None if GetDP contains a BLAS of its own, or if ``ldd`` cannot be run.
    """
    try:
        answer = subprocess.run(["ldd", str(getdp.executable)], capture_output=True, text=True,
                                timeout=30, errors="replace", check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    match = re.search(r"^\s*libblas\S* => (/\S+)", answer.stdout, re.MULTILINE)
    return Path(match[1]).resolve() if match else None


def run(
    getdp: GetDP,
    job: Job,
    folder: Path,
    on_line: Callable[[str], None] | None = None,
    cancel: threading.Event | None = None,
) -> list[str]:
    """Run a job, verify its log and output files, and return the lines of the log.

    Parameters
    ----------
    folder : Path
        The run folder with all input files. Output files and the log, ``getdp.log``, are written
        there.
    on_line : callable, optional
        Called with every line of the log as soon as GetDP prints it.
    cancel : threading.Event, optional
        The run is killed when this event is set.

    Raises
    ------
    GetDPError
        Names the failure and the place of the log.
    GetDPNotFoundError
        If ``getdp`` is `NO_GETDP`.
    """
    if getdp == NO_GETDP:
        raise GetDPNotFoundError("This needs finite elements, and GetDP was not found. "
                                 + _advice())
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
                      "-viewer_binary_skip_info"]  # without PETSc's .info file beside the solutions
        written = (*written, job.solutions)
    if job.matrix is not None:
        arguments += ["-ksp_view_mat", f"binary:{job.matrix}"]
        written = (*written, job.matrix)
    for output in written:
        (folder / output).unlink(missing_ok=True)  # GetDP may append to or leave an older file
    if job.solutions is not None:
        (folder / job.solutions).touch()  # PETSc 3.10 appends to files that exist only
    lines = _execute(arguments, job, folder, on_line, cancel)
    _check_log(lines, job, folder)
    for output in written:
        if not (folder / output).is_file() or not (folder / output).stat().st_size:
            raise _failure(f"it did not write {output}", folder)
    return lines


def read_vectors(path: Path, points: Floats) -> Floats:
    """Read a table of vectors (n, 3) at points that GetDP printed as SimpleTable, and verify it.

    Parameters
    ----------
    path : Path
        The file; its columns are x, y, z and three components.
    points : ndarray, shape (n, 3), in m
        The points at which GetDP was asked to print the vectors.

    Raises
    ------
    GetDPError
        If the number of rows or columns is wrong, the points differ, values are not finite, or a
        vector is exactly zero, which GetDP prints for a point outside the mesh.
    """
    where = path.parent
    try:
        lines = path.read_text(encoding="ascii").splitlines()
        table = np.loadtxt(lines, ndmin=2, comments=None) if "".join(lines).strip() else (
            np.empty((0, 0)))  # NumPy would warn about an empty file
    except (ValueError, OSError) as error:
        raise _failure(f"{path.name} is not a table of six columns ({error}); a point outside the "
                       "mesh or a full disk can cause this", where) from None
    if table.shape != (len(points), 6):
        raise _failure(f"{path.name} holds {table.shape[0]} rows of {table.shape[1]} columns in "
                       f"place of {len(points)} of 6; a point outside the mesh or a full disk can "
                       "cause this", where)
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
    """Return the names in the DefineConstant blocks of all problem files of a folder."""
    names: set[str] = set()
    for path in folder.glob("*.pro"):
        text = re.sub(r"//[^\n]*", "", path.read_text(encoding="utf-8"))
        for block in re.findall(r"DefineConstant\s*\[(.*?)\]\s*;", text, re.DOTALL):
            names.update(re.findall(r"(\w+)\s*=", block))
    return names


def _check_before(job: Job, folder: Path) -> None:
    """Check the names, files and constants of a job before GetDP is started."""
    # largest accepted length of a file name. GetDP keeps paths in buffers of 256 characters, and
    # appends to them.
    longest = 200
    for name in (job.problem, job.mesh, *job.outputs):
        if len(name) > longest:
            raise _failure(f"the name {name[:30]}... has {len(name)} characters, and GetDP's "
                           f"buffers end at 256; keep names under {longest}", folder)
    for name in (job.problem, job.mesh):
        if not (folder / name).is_file():
            raise _failure(f"{name} is missing from the run folder", folder)
    unknown = set(job.numbers) - declared_constants(folder)
    if unknown:
        raise _failure(f"-setnumber {min(unknown)} sets a constant that no DefineConstant "
                       "declares, and GetDP would ignore it", folder)


WARDEN = """exec 3<&0 </dev/null
(read _ <&3; kill -KILL -$$) >/dev/null 2>&1 &
exec "$@" 3<&-
"""
"""Shell script that becomes GetDP, whose process group ends when standard input does: when this
process closes it, or ends in whatever way. GetDP may be a wrapper that starts other processes, such
as the modules of a cluster."""


def _launcher(job: Job) -> list[str]:
    """Return the command that GetDP's own command line is appended to.

    With several processes ``mpirun`` starts GetDP in process groups of its own; there the operating
    system kills GetDP when ``mpirun`` ends.
    """
    warden = ["/bin/sh", "-c", WARDEN, "getdp"]
    if job.processes == 1:
        return warden
    return [*warden, "mpirun", "-n", str(job.processes), *_tether()]


@cache
def _tether() -> list[str]:
    """Return the command that ties a process to its parent, or nothing if it is not available.

    ``setpriv`` of util-linux has the option ``--pdeathsig`` since version 2.33; other systems may
    have a ``setpriv`` without it.
    """
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
    """Run a command to its end, save its log, and return the log's lines if it succeeded."""
    threads = str(job.threads)
    environment = os.environ | (_ALONE if job.processes == 1 else _TOGETHER) | {
        "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
    environment.pop("PETSC_OPTIONS", None)  # options must come from the job, or none records them
    lines: list[str] = []
    if job.processes > 1 and shutil.which("mpirun") is None:
        raise _failure("`mpirun` was not found (Debian: openmpi-bin)", folder)
    try:
        process = subprocess.Popen(
            [*_launcher(job), *arguments], cwd=folder, env=environment, stdin=subprocess.PIPE,
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
    reason = ""
    try:
        reader.start()
        while process.poll() is None:
            if cancel is not None and cancel.is_set():
                reason = "it was cancelled"
            elif time.monotonic() > deadline:
                reason = (f"it was still running after the time limit of {job.time_limit_s:g} s; "
                          "use a coarser mesh or raise --time-limit")
            if reason:
                break
            time.sleep(0.02)
    finally:
        if process.poll() is None:
            _kill(process)
        assert process.stdin is not None
        process.stdin.close()  # ends what GetDP has left behind
        if reader.is_alive():
            reader.join(timeout=10)
        _save_log(folder, arguments, lines)
    if reason:
        raise _failure(reason, folder)
    _check_exit(process.returncode, arguments[0], lines, folder)
    return lines


def _check_exit(code: int, executable: str, lines: list[str], folder: Path) -> None:
    """Raise GetDPError, with GetDP's own words, if a process ended with another code than 0."""
    if code < 0:
        name = signal.Signals(-code).name
        if name == "SIGXFSZ":
            raise _failure(f"{DISK_FULL}, or a file grew over its limit ({name})", folder)
        hint = {"SIGKILL": "; out of memory?"}
        raise _failure(f"it crashed ({name}{hint.get(name, '')})", folder)
    if code in (126, 127) and not os.access(executable, os.X_OK):
        raise _failure("it could not be started (No such file, or none that can be run)", folder)
    if code:
        error_line = next((line for line in lines if re.match(r"\s*Error\s*:", line)), "")
        quoted = error_line.partition(":")[2].strip() or (
            lines[-1].strip() if lines else "nothing")
        name = _name_of("\n".join(lines), f"exit code {code}")
        raise _failure(f"{name}: '{quoted[:200]}'", folder)


def _kill(process: subprocess.Popen[str]) -> None:
    """Kill a process with all its children; it leads a process group of its own."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _save_log(folder: Path, arguments: list[str], lines: list[str]) -> None:
    """Write the log: GetDP's options in the first line, then all that it printed."""
    text = "\n".join([" ".join(arguments[1:]), *lines, ""])
    with contextlib.suppress(OSError):  # if the disk is full, report the failure of the run
        (folder / LOG_NAME).write_text(text, encoding="utf-8")


def _check_log(lines: list[str], job: Job, folder: Path) -> None:
    """Check the log of a run that ended with exit code 0.

    Warnings are failures too: GetDP only warns of an unconverged iteration, for example.
    """
    for line in lines:
        if re.match(r"\s*(Warning|Error)\s*:", line):
            quoted = line.partition(":")[2].strip()
            raise _failure(f"{_name_of(quoted, 'GetDP warned')}: '{quoted[:200]}'", folder)
    text = "\n".join(lines)
    if job.processes > 1 and f", {job.processes} nodes," not in text:
        raise _failure(
            f"it did not run in the {job.processes} MPI processes asked for: `mpirun` must belong "
            "to the MPI that GetDP is built with (Debian: openmpi-bin)", folder)
    sizes = [int(n) for n in re.findall(r"System \d+/\d+: (\d{1,15}) Dofs", text)]
    if not sizes or 0 in sizes:
        raise _failure("the system has no unknowns: is the mesh empty?", folder)
    if job.unknowns is not None and sizes[0] != job.unknowns:
        raise _failure(
            f"the system has {sizes[0]} unknowns where the mesh gives {job.unknowns}: a boundary "
            "condition, a gauge or a region is missing", folder)
    count = _check_residuals(lines, job.linear_residual, folder)
    if count < job.solves:
        raise _failure(f"its log shows the residuals of {count} of {job.solves} solves", folder)


def _check_residuals(lines: list[str], largest: float, folder: Path) -> int:
    """Check that every linear solve reduced its residual enough; return the number of solves."""
    first: float | None = None
    count = 0
    last = np.nan
    for line in [*lines, "  0 KSP Residual norm 0"]:  # iteration 0 ends the solve before it
        match = re.search(r"(\d{1,9}) KSP Residual norm (\S+)", line)
        if not match:
            continue
        residual = _residual(match[2], folder)
        if match[1] == "0":
            if first is not None and not last <= largest * first:
                raise _failure(f"a linear solve left a residual of {last:.1e} of {first:.1e}: the "
                               "linear solver did not converge", folder)
            count += first is not None
            first, last = residual, np.inf if residual else 0.0  # no source: 0 is the solution
        else:
            last = residual
    return count


def _residual(text: str, folder: Path) -> float:
    """Return a residual of the log as a finite number."""
    with contextlib.suppress(ValueError):
        if np.isfinite(residual := float(text)):
            return residual
    raise _failure(f"a linear solve left a residual of '{text[:40]}', which is no number: the "
                   "linear solver did not converge", folder)


def _name_of(text: str, otherwise: str) -> str:
    """Return the meaning of the first known failure in a text of the log."""
    return next((name for pattern, name in _NAMED_FAILURES if re.search(pattern, text)), otherwise)


def _failure(reason: str, folder: Path) -> HalbachError:
    """Return the error of a run: of the disk if that is full, else GetDP's with its log."""
    if is_full(folder) or reason.startswith(DISK_FULL):
        return disk_error(folder.parent, reason)
    log = folder / LOG_NAME
    return GetDPError(f"GetDP did not give a result that can be trusted: {reason}.",
                      log if log.is_file() else None)


def disk_error(folder: Path, reason: str) -> OutputError:
    """Return the error of a run that failed for want of space in a folder of results."""
    return OutputError(f"The disk of {folder} is full, and GetDP failed: {reason}. Free some space "
                       "there, or choose another folder.")
