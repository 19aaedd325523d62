"""The settings of all runs of GetDP, and parallel runs, each in its own folder, here or by Dask.

A `Session` has the executable, folder, cache, number of processes and progress. A run is described
by a `Task`. Results come from the cache if it has them. The first failure ends all runs. The
folders of finished runs are kept, so that a run can be repeated by hand.

**Other machines.** The input files of a run are sent to a worker, and the files that GetDP wrote
are sent back, so that the machines need no common file system. A worker runs and verifies GetDP as
this machine would, and must have the same version and build of GetDP. When a worker is lost, Dask
repeats its tasks on another worker.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import (
    GetDPError,
    HalbachError,
    NotConvergedError,
    OutputError,
    SchedulerError,
)
from halbach_fe.core.files import (
    folder_until_exit,
    is_full,
    make_folder,
    remove_orphans,
    temporary_path,
)
from halbach_fe.core.installation import import_extra
from halbach_fe.core.interface import typed
from halbach_fe.core.numbers import check_number
from halbach_fe.core.progress import Progress, Say, quiet
from halbach_fe.core.result_folder import is_run_folder, locked_folder
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import NO_GETDP, GetDP, Job, Run, getdp_or_none
from halbach_fe.solver.getdp_cache import Cache, default_cache

P = ParamSpec("P")
R = TypeVar("R")

@dataclass(frozen=True)
class RunSize:
    """The size of a run of GetDP, from which its cost is estimated."""

    route: str
    """Route of the solve, see `halbach_fe.solver.routes.choose_route`."""
    elements: int
    unknowns: int
    solves: int
    """Number of linear solves, without those of Newton's steps, whose number is not known in
    advance."""
    matrices: int = 1
    """Number of different matrices, also without those of Newton's steps."""
    newton: bool = False
    """Whether Newton's method solves for the field first."""


@dataclass
class RunCounter:
    """Collects the runs that a computation would start."""

    batches: list[tuple[str, Sequence[RunSize]]] = field(default_factory=list)
    """Purpose of the session, and the runs that it would start in parallel."""


@dataclass(frozen=True)
class Session:
    """The settings with which GetDP runs; `Session.open` returns the usual ones.

    Attributes
    ----------
    getdp : GetDP
        The executable, with its version and build.
    folder : Path
        Folder for meshes and runs. The folders of finished runs are kept (``getdp-real``,
        ``getdp-vacuum``), and GetDP can be started in them by hand.
    jobs : int
        Largest number of parallel runs of GetDP.
    time_limit_s : float
        Longest time of a single run.
    progress : callable, optional
        Called with the number of finished solves and the number of all solves.
    cache : Cache, optional
        Results of earlier runs, which are not computed again.
    run : callable
        Runs a job on this machine (`halbach_fe.solver.getdp.run`), or on another machine
        (`halbach_fe.solver.session`).
    processes : int
        MPI processes that share each run, for a solve that is too large for one process.
    purpose : str
        Purpose of the solves, as estimates print it.
    counter : RunCounter, optional
        If given, the session does not mesh or solve; it only counts the runs that it would start.

    Examples
    --------
    >>> session = Session.open("results", jobs=1)
    >>> session.jobs, session.folder.name
    (1, 'results')
    """

    getdp: GetDP
    folder: Path
    jobs: int = 1
    time_limit_s: float = 3600.0
    progress: Progress | None = None
    cache: Cache | None = None
    run: Run = runner.run
    processes: int = 1
    purpose: str = "the study's mesh"
    counter: RunCounter | None = None

    @classmethod
    @typed
    def open(
        cls, folder: str | Path, jobs: int | None = None, getdp: str | None = None,
        progress: Progress | None = None,
    ) -> Session:
        """Return a session with the usual settings: GetDP of this machine, and its cache.

        Parameters
        ----------
        folder : str or Path
            Folder for meshes, runs and results; created when it is needed.
        jobs : int, optional
            Largest number of parallel runs of GetDP; two by default, or one on a machine with one
            core.
        getdp : str, optional
            GetDP executable; by default that of $HALBACH_FE_GETDP, then of PATH, then of the
            package pyonelab. Without any, what needs no finite elements still works.
        progress : callable, optional
            Called with the number of finished solves and the number of all solves.

        Returns
        -------
        Session

        Raises
        ------
        GetDPNotFoundError
            If ``getdp`` is not found, or does not answer like GetDP.
        StudyError
            If ``jobs`` is not at least 1.

        Examples
        --------
        >>> Session.open("results").jobs in (1, 2)
        True
        """
        if jobs is not None:
            check_number("jobs", "Session.open", jobs, 1, whole=True)
        # number of parallel runs of GetDP, if the machine has as many cores. Most problems consist
        # of two runs, with the real materials and with vacuum in their place.
        default_jobs = 2
        return cls(getdp_or_none(getdp), Path(folder),
                   jobs=jobs or min(default_jobs, os.cpu_count() or 1), progress=progress,
                   cache=default_cache(None))

    @classmethod
    def temporary(cls) -> Session:
        """Return a session with the usual settings, whose folder is removed when Python ends."""
        return cls.open(folder_until_exit())

    @classmethod
    def counting(cls, jobs: int) -> Session:
        """Return a session that counts runs of GetDP instead of starting them."""
        return cls(NO_GETDP, Path(), jobs=jobs, counter=RunCounter())

    def within(self, name: str) -> Session:
        """Return the same session with a subfolder of this session's folder."""
        return replace(self, folder=self.folder / name)

    @contextmanager
    def with_cache(self) -> Iterator[Session]:
        """Yield the session with its cache; if it has none, with one that is removed at the end.

        A search of several rounds needs one, even if no results of earlier runs are wanted: what
        has not changed since the last round is not solved for again.
        """
        if self.cache is not None or self.counter is not None:
            yield self
            return
        remove_orphans(make_folder(self.folder))  # of processes that were killed
        folder = temporary_path(self.folder / "cache")
        # size limit of a cache that lasts as long as one search, see `Session.with_cache`
        temporary_cache_bytes = 4 * 2**30
        try:
            yield replace(self, cache=Cache(folder, temporary_cache_bytes))
        finally:
            shutil.rmtree(folder, ignore_errors=True)


NOT_KEPT = Session(NO_GETDP, Path())
"""Stands for a session whose files nobody wants to keep, see `Session.temporary`."""


def alone(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function with an argument ``session``, in whose folder nobody else may write.

    `NOT_KEPT` becomes a session of its own. A second run in the same folder raises OutputError
    until the function has returned. Functions may call each other. Arguments of other classes than
    its own are refused, see `typed`.
    """
    signature = inspect.signature(function)

    @typed
    @functools.wraps(function)
    def locked(*arguments: P.args, **options: P.kwargs) -> R:
        bound = signature.bind(*arguments, **options)
        session = bound.arguments.get("session", NOT_KEPT)
        if session is NOT_KEPT:
            session = bound.arguments["session"] = Session.temporary()
        if session.counter is not None:  # which writes nothing
            return function(*bound.args, **bound.kwargs)
        with locked_folder(session.folder):
            return function(*bound.args, **bound.kwargs)

    return locked


NEWTON_HISTORY = "newton.csv"
"""File in the run folder with the relative residual of every Newton step."""

LOOK_S = 0.2
"""Longest time in s for which the main thread waits for runs without looking at signals. A signal
that comes just before a thread blocks does not wake it, and Ctrl-C would then have no effect."""

MATRIX_FILE = "matrix.bin"
"""File in the run folder to which PETSc writes the matrix."""


@dataclass(frozen=True)
class Task:
    """One run of GetDP."""

    name: str
    """Name of its folder."""
    stage: Callable[[Path], Job]
    """Takes the run folder, fills it, and returns the job to run there."""
    read: Callable[[Path], Floats]
    """Takes the run folder after the run, verifies the result and returns it."""
    shape: tuple[int, ...]
    """Shape of the result."""
    solves: int
    """Number of solves that the run reports as progress."""
    size: RunSize
    """Size of the run, for estimates of its cost."""
    matrix: bool = False
    """Whether PETSc writes the matrix to `MATRIX_FILE`."""


def run_tasks(tasks: Sequence[Task], session: Session) -> list[Floats]:
    """Run GetDP for every task, ``session.jobs`` at a time; the first failure ends them all.

    If the session only counts runs, the tasks are recorded and their results are zeros.

    Raises
    ------
    GetDPError
        The error of the first run that failed.
    """
    if session.counter is not None:
        session.counter.batches.append((session.purpose, [task.size for task in tasks]))
        return [np.zeros(task.shape) for task in tasks]
    counter = _Counter(sum(task.solves for task in tasks), session.progress)
    cancel = threading.Event()
    stored: list[bool] = []

    def run(task: Task) -> Floats:
        with run_folder(session.folder, task.name, cancel) as folder:
            job = replace(task.stage(folder), processes=session.processes)
            if task.matrix:
                job = replace(job, matrix=MATRIX_FILE)
            history: list[str] = []

            def on_line(line: str) -> None:
                counter.line(line)
                if line.startswith("NEWTON"):
                    history.append(line)

            entry = session.cache.entry(session.getdp, job, folder) if session.cache else None
            try:
                if entry is None or not entry.restore(on_line):
                    session.run(session.getdp, job, folder, on_line, cancel)
            except GetDPError as error:
                raise _with_history(error, newton_residuals(history)) from None
            result = task.read(folder)
            if entry is not None:
                stored.append(entry.store())  # only now: reading has verified the result
            for name in job.large:  # repeating the run by hand does not need these files
                (folder / name).unlink()
            return result

    futures: list[Future[Floats]] = []
    with ThreadPoolExecutor(max(1, session.jobs)) as pool:
        try:
            for task in tasks:  # Ctrl-C may come here, while the first runs go on already
                futures.append(pool.submit(run, task))
            running: Collection[Future[Floats]] = futures
            while running:
                done, running = wait(futures, LOOK_S, FIRST_EXCEPTION)
                for future in done:
                    future.result()
            return [future.result() for future in futures]
        finally:
            cancel.set()  # on failure and on Ctrl-C, end the runs that still go on
            for future in futures:
                future.cancel()
            if session.cache is not None and any(stored):
                session.cache.trim()


def _with_history(error: GetDPError, history: list[list[float]]) -> GetDPError:
    """Return the error, with the residuals of the last sample if Newton's method failed.

    ``history`` has the relative residuals by sample and step.
    """
    if "Newton's method did not converge" not in error.sentence or not history:
        return error
    residuals = tuple(history[-1])
    return NotConvergedError(
        f"{error.sentence} Relative residuals of sample {len(history)}: "
        f"{', '.join(f'{residual:.1e}' for residual in residuals)}. Refine the mesh in the iron, "
        "or smooth its H(B) curve.", residuals, error.log)


class _Counter:
    """Counts the finished solves of several threads, and reports them as progress."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self._lock, self._done, self._total = threading.Lock(), 0, total
        self._progress = progress

    def line(self, line: str) -> None:
        """Count a line of a log if it reports a finished solve."""
        if line.startswith(("SOURCE", "SAMPLE")) and self._progress is not None:
            with self._lock:
                self._done += 1
                self._progress(self._done, self._total)


def variant_name(vacuum: bool) -> str:
    """Return the name of a variant in run folders: real materials, or vacuum in their place."""
    return "vacuum" if vacuum else "real"


def newton_residuals(lines: Iterable[str]) -> list[list[float]]:
    """Return the relative residuals of Newton's method in a log of GetDP, by sample and step."""
    history: list[list[float]] = []
    for line in lines:
        match = re.search(
            r"NEWTON \d+ (\d+) (\d{1,20}(?:\.\d{1,20})?(?:e[-+]?\d+)?|nan|inf)\b", line)
        if match and (history or match[1] == "0"):
            if match[1] == "0":  # step 0 starts the next sample
                history.append([])
            history[-1].append(float(match[2]))
    return history


def newton_history(folder: Path) -> list[float]:
    """Return the relative residuals of the last sample's Newton steps.

    ``folder`` is a session's folder, with the finished run for the real materials.
    """
    log = folder / f"getdp-{variant_name(False)}" / runner.LOG_NAME
    return newton_residuals(log.read_text("utf-8").splitlines())[-1]


def write_history(folder: Path) -> int:
    """Write the residuals in the log of a run as a table, and return the number of Newton steps."""
    history = newton_residuals((folder / runner.LOG_NAME).read_text("utf-8").splitlines())
    rows = [f"{sample},{step},{residual:.6e}" for sample, residuals in enumerate(history)
            for step, residual in enumerate(residuals)]
    (folder / NEWTON_HISTORY).write_text("\n".join(["sample,step,residual", *rows, ""]), "utf-8")
    return sum(len(residuals) - 1 for residuals in history)


@contextmanager
def run_folder(parent: Path, name: str, cancel: threading.Event) -> Iterator[Path]:
    """Make a private folder for a run, and keep it after the run.

    Parameters
    ----------
    name : str
        The folder is kept as ``name`` if the run succeeds, and as ``name-failed`` (with the log) if
        it raises a GetDPError. In all other cases, and if the run was cancelled, it is removed.
    cancel : threading.Event
        Set if the run was cancelled.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    remove_orphans(make_folder(parent))
    folder = temporary_path(parent / name)
    try:
        folder.mkdir()
        yield folder
        _replace(folder, parent / name)
    except GetDPError as error:
        if cancel.is_set():
            raise
        if is_full(parent):  # what GetDP wrote is cut off, which it does not notice
            raise runner.disk_error(parent, error.sentence.rstrip(".")) from None
        failed = parent / f"{name}-failed"
        _replace(folder, failed)
        if error.log is not None:
            error.log = failed / error.log.name
        raise
    except OSError as error:
        raise OutputError(f"Cannot write into {parent}: {error.strerror}.") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _replace(folder: Path, target: Path) -> None:
    """Rename a folder to ``target``, and remove the folder of an older run of that name."""
    if os.path.lexists(target) and not is_run_folder(target):
        raise OutputError(f"{target} is no folder of a run of GetDP, which would replace it. Name "
                          "another folder, or move this to another place.")
    shutil.rmtree(target, ignore_errors=True)
    folder.rename(target)


CONNECT_S = 20.0
"""Time limit in s for the connection to the scheduler."""


@dataclass(frozen=True)
class Answer:
    """The outcome of a run of GetDP on a worker."""

    lines: list[str]
    """The log, empty after a failure."""
    files: dict[str, bytes]
    """Content of every file that the run wrote, by name; after a failure the log is among them."""
    failure: str = ""
    """Why the result cannot be trusted; empty if the run passed verification."""


class _Workers(Executor):
    """An executor of Dask whose functions do not use Dask themselves, see `_without_scheduler`."""

    def __init__(self, inner: Executor) -> None:
        self._inner = inner

    def submit(
        self, fn: Callable[..., Any], /, *args: object, **kwargs: object
    ) -> Future[Any]:
        """Call a function on a worker."""
        return self._inner.submit(_without_scheduler, fn, *args, **kwargs)


def _without_scheduler(function: Callable[..., Any], *args: object, **kwargs: object) -> object:
    """Call a function on a worker, with Dask's scheduler hidden from it.

    On a worker xarray would ask the scheduler for a lock before it writes a file.
    """
    import dask

    with dask.config.set(scheduler="synchronous"):
        return function(*args, **kwargs)


@dataclass(frozen=True)
class Cluster:
    """A Dask scheduler and its workers."""

    client: Any
    address: str

    @property
    def cores(self) -> int:
        """Number of threads of all workers; at least 1, since workers may connect later."""
        return max(1, sum(self.client.nthreads().values()))

    @property
    def executor(self) -> Executor:
        """An executor on the workers. Equal calls are not merged into a single one."""
        return _Workers(self.client.get_executor(pure=False))

    def run(
        self, getdp: GetDP, job: Job, folder: Path,
        on_line: Callable[[str], None] | None = None, cancel: threading.Event | None = None,
    ) -> list[str]:
        """Run a job on a worker, with the arguments and results of `halbach_fe.solver.getdp.run`.

        ``on_line`` receives all lines of the log at once, when the run has ended.

        Raises
        ------
        GetDPError
            If the run failed, did not pass verification or was cancelled, or if the worker has
            another GetDP.
        SchedulerError
            If Dask failed.
        """
        given = {path.name: path.read_bytes() for path in folder.iterdir()}
        poll_s = 0.05  # time in s between two looks at whether a run has ended
        try:
            future = self.client.submit(_answer, getdp, job, given, pure=False)
            try:
                while not future.done():
                    if cancel is not None and cancel.is_set():
                        raise GetDPError("A run of GetDP was cancelled.")
                    time.sleep(poll_s)
                answer: Answer = future.result()
            finally:
                with contextlib.suppress(Exception):  # the scheduler may have been lost
                    future.cancel()
        except HalbachError:
            raise
        except Exception as error:  # Dask has many types of errors without a common base
            raise _failed(self.address, error) from None
        for name, content in answer.files.items():
            (folder / name).write_bytes(content)
        if on_line is not None:
            for line in answer.lines:
                on_line(line)
        if answer.failure:
            log = folder / runner.LOG_NAME
            raise GetDPError(answer.failure, log if log.is_file() else None)
        return answer.lines


@contextmanager
def connected(
    address: str, say: Say = quiet
) -> Iterator[Cluster]:
    """Connect to a Dask scheduler, and disconnect at the end of the context.

    Parameters
    ----------
    address : str
        Address of the scheduler, such as ``tcp://host:8786``.
    say : callable, optional
        Called with a sentence if no worker is there yet: work would wait in silence.

    Raises
    ------
    ExtraMissingError
        If Dask is not installed.
    SchedulerError
        If no scheduler answers at the address, or if Dask fails within the context.
    """
    distributed = import_extra("distributed", "cluster", "--scheduler needs Dask")
    import dask
    from distributed.comm.addressing import parse_address, parse_host_port
    from distributed.comm.registry import get_backend

    # The files of a run are part of its task, so large tasks are intended: silence Dask's warning.
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1TiB"})
    try:  # a client that fails on such an address would print a traceback when it is deleted
        scheme, location = parse_address(address)
        get_backend(scheme)
        parse_host_port(location)
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise SchedulerError(
            f"Input --scheduler must be the address of a running Dask scheduler, such as "
            f"tcp://host:8786; instead received {address or 'an empty text'} ({error}). "
            "Start the scheduler, or correct its address.") from None
    try:
        if not client.nthreads():
            say(f"The scheduler {address} has no workers: waiting for the first one "
                f"(dask worker {address}).")
        yield Cluster(client, address)
    except Exception as error:
        if type(error).__module__.startswith("distributed"):
            raise _failed(address, error) from None
        raise
    finally:
        client.close()


def _failed(address: str, error: Exception) -> SchedulerError:
    """Return the error for a failure of Dask itself."""
    return SchedulerError(f"The Dask scheduler {address} or its workers failed: "
                          f"{type(error).__name__}: {error} Look into their logs.")


def _answer(getdp: GetDP, job: Job, given: dict[str, bytes]) -> Answer:
    """Run a job on this worker, in a temporary folder with the files ``given`` by name."""
    import distributed

    local = runner.find_getdp()
    if replace(local, executable=getdp.executable) != getdp:
        return Answer([], {}, (
            f"A worker has another GetDP: {local.version} with PETSc {local.petsc} in place of "
            f"{getdp.version} with PETSc {getdp.petsc}, or another build of it. Install the same "
            "GetDP on all machines."))
    cancel = threading.Event()
    worker = distributed.get_worker()
    key = worker.get_current_task()
    done = threading.Event()

    watch_s = 0.5  # time in s between two looks of a worker at whether its task was cancelled
    def watch() -> None:
        """End the run of GetDP when the task was cancelled, since no client waits for it."""
        while not done.wait(watch_s):
            task = worker.state.tasks.get(key)
            if task is None or task.state in ("cancelled", "released", "forgotten"):
                cancel.set()

    threading.Thread(target=watch, daemon=True).start()
    with tempfile.TemporaryDirectory(prefix="halbach-fe-") as name:
        folder = Path(name)
        for file, content in given.items():
            (folder / file).write_bytes(content)
        lines, failure = [], ""
        try:
            lines = runner.run(local, job, folder, cancel=cancel)
        except GetDPError as error:
            failure = error.sentence
        finally:
            done.set()
        written = {path.name: path.read_bytes() for path in folder.iterdir()
                   if path.name not in given}
    return Answer(lines, written, failure)
