"""Runs of GetDP, several at a time, each in its own folder; the first failure ends them all."""

from __future__ import annotations

import re
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import GetDPError, NotConvergedError, OutputError
from halbach_fe.core.files import make_folder
from halbach_fe.core.temporary_files import remove_orphans, temporary_name
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import Job
from halbach_fe.solver.session import Progress, RunSize, Session

NEWTON_HISTORY = "newton.csv"
MATRIX_FILE = "matrix.bin"


@dataclass(frozen=True)
class Task:
    """One run of GetDP.

    Attributes
    ----------
    name : str
        Of its folder.
    stage : callable
        Fills the run folder and returns the job to run there.
    read : callable
        Reads the verified result, an array of ``shape``, from the run folder.
    shape : tuple of int
    solves : int
        Solves that the run reports as progress.
    size : RunSize
        What the run is expected to cost.
    matrix : bool
        Whether PETSc writes the matrix.
    """

    name: str
    stage: Callable[[Path], Job]
    read: Callable[[Path], Floats]
    shape: tuple[int, ...]
    solves: int
    size: RunSize
    matrix: bool = False


def run_tasks(tasks: Sequence[Task], session: Session) -> list[Floats]:
    """Run GetDP for every task, ``session.jobs`` at a time; the first failure ends them all.

    A session that counts gets zeros.
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

            def see(line: str) -> None:
                counter.line(line)
                if line.startswith("NEWTON"):
                    history.append(line)

            kept = session.cache.entry(session.getdp, job, folder) if session.cache else None
            try:
                if kept is None or not kept.restore(see):
                    session.run(session.getdp, job, folder, see, cancel)
            except GetDPError as error:
                raise _with_history(error, newton_residuals(history)) from None
            result = task.read(folder)
            if kept is not None:
                stored.append(kept.store())  # what was read and found sound
            for name in job.large:  # and not needed to run the folder by hand
                (folder / name).unlink()
            return result

    with ThreadPoolExecutor(max(1, session.jobs)) as pool:
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
            if session.cache is not None and any(stored):
                session.cache.trim()


def _with_history(error: GetDPError, history: list[list[float]]) -> GetDPError:
    """The error, with the residuals if Newton's method is what failed."""
    if "Newton's method did not converge" not in error.sentence or not history:
        return error
    residuals = tuple(history[-1])
    return NotConvergedError(
        f"{error.sentence} Relative residuals of sample {len(history)}: "
        f"{', '.join(f'{residual:.1e}' for residual in residuals)}. Refine the mesh in the iron, "
        "or smooth its H(B) curve.", residuals, error.log)


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


def variant_name(vacuum: bool) -> str:
    """What a run folder is called by: materials as they are, or all replaced by vacuum."""
    return "vacuum" if vacuum else "real"


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
    """Relative residuals of Newton's method in the run that a session's folder keeps."""
    log = folder / f"getdp-{variant_name(False)}" / runner.LOG_NAME
    return newton_residuals(log.read_text("utf-8").splitlines())[-1]


def write_history(folder: Path) -> int:
    """Keep the residuals of a run's log as a table; return the number of steps."""
    history = newton_residuals((folder / runner.LOG_NAME).read_text("utf-8").splitlines())
    rows = [f"{sample},{step},{residual:.6e}" for sample, residuals in enumerate(history)
            for step, residual in enumerate(residuals)]
    (folder / NEWTON_HISTORY).write_text("\n".join(["sample,step,residual", *rows, ""]), "utf-8")
    return sum(len(residuals) - 1 for residuals in history)


@contextmanager
def run_folder(parent: Path, name: str, cancel: threading.Event) -> Iterator[Path]:
    """A private folder, kept as ``name`` after a good run and as ``name-failed`` (with the log)
    after a bad one; anything else that ends the run leaves nothing.
    """
    remove_orphans(make_folder(parent))
    folder = Path(tempfile.mkdtemp(prefix=temporary_name(name), dir=parent))
    try:
        yield folder
        _replace(folder, parent / name)
    except GetDPError as error:
        if cancel.is_set():
            raise
        kept = parent / f"{name}-failed"
        _replace(folder, kept)
        if error.log is not None:
            error.log = kept / error.log.name
        raise
    except OSError as error:
        raise OutputError(f"Cannot write into {parent}: {error.strerror}.") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _replace(folder: Path, kept: Path) -> None:
    shutil.rmtree(kept, ignore_errors=True)
    folder.rename(kept)
