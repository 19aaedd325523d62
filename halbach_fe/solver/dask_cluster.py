"""Independent work on other machines, by Dask: runs of GetDP, and functions.

The files of a run travel to a worker and what GetDP wrote travels back, so that nothing has to be
shared but the network. A worker runs and verifies GetDP as this machine would, and must have the
same version and build of it. What a lost worker was doing is done again by another.
"""

from __future__ import annotations

import contextlib
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from halbach_fe.core.errors import ExtraMissingError, GetDPError, HalbachError, SchedulerError
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import GetDP, Job

CONNECT_S = 20.0
POLL_S = 0.05
WATCH_S = 0.5


@dataclass(frozen=True)
class Answer:
    """What came of a run of GetDP: its log and what it wrote, or why it cannot be trusted."""

    lines: list[str]
    files: dict[str, bytes]
    failure: str = ""


class _Workers(Executor):
    """Runs functions on workers as if they were alone in the world."""

    def __init__(self, inner: Executor) -> None:
        self._inner = inner

    def submit(
        self, fn: Callable[..., Any], /, *args: object, **kwargs: object
    ) -> Future[Any]:
        return self._inner.submit(_alone, fn, *args, **kwargs)


def _alone(function: Callable[..., Any], *args: object, **kwargs: object) -> object:
    """Where there is a Dask scheduler, xarray asks it for leave to write a file."""
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
        """Threads of all workers, and at least 1: workers may still be on their way."""
        return max(1, sum(self.client.nthreads().values()))

    @property
    def executor(self) -> Executor:
        """Runs functions on the workers, each under a key of its own."""
        return _Workers(self.client.get_executor(pure=False))

    def run(
        self, getdp: GetDP, job: Job, folder: Path,
        on_line: Callable[[str], None] | None = None, cancel: threading.Event | None = None,
    ) -> list[str]:
        """Run a job like `halbach_fe.solver.getdp.run`, on some worker; lines come when it has
        ended.
        """
        given = {path.name: path.read_bytes() for path in folder.iterdir()}
        try:
            future = self.client.submit(_answer, getdp, job, given, pure=False)
            try:
                while not future.done():
                    if cancel is not None and cancel.is_set():
                        raise GetDPError("A run of GetDP was cancelled.")
                    time.sleep(POLL_S)
                answer: Answer = future.result()
            finally:
                with contextlib.suppress(Exception):  # the scheduler may be gone, and all with it
                    future.cancel()
        except HalbachError:
            raise
        except Exception as error:  # of Dask's own, by many names
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
def connected(address: str) -> Iterator[Cluster]:
    """The cluster of a Dask scheduler, as ``tcp://host:8786``.

    Raises
    ------
    ExtraMissingError
        If Dask is not installed.
    SchedulerError
        If nobody answers there.
    """
    try:
        import dask
        import distributed
    except ImportError:
        raise ExtraMissingError("--scheduler needs Dask, which is not installed: "
                                "`pip install halbach-fe[cluster]`.") from None
    # a run's files are nowhere but here, so they go with the task
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1TiB"})
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise SchedulerError(
            f"Input --scheduler must be the address of a running Dask scheduler, as "
            f"tcp://host:8786; instead at {address}: {error}.") from None
    try:
        yield Cluster(client, address)
    except Exception as error:
        if type(error).__module__.startswith("distributed"):
            raise _failed(address, error) from None
        raise
    finally:
        client.close()


def _failed(address: str, error: Exception) -> SchedulerError:
    return SchedulerError(f"The Dask scheduler {address} or its workers failed: "
                          f"{type(error).__name__}: {error} Look into their logs.")


def _answer(getdp: GetDP, job: Job, given: dict[str, bytes]) -> Answer:
    """Run a job in a folder of this worker."""
    import distributed

    here = runner.find_getdp()
    if replace(here, executable=getdp.executable) != getdp:
        return Answer([], {}, (
            f"A worker has another GetDP: {here.version} with PETSc {here.petsc} in place of "
            f"{getdp.version} with PETSc {getdp.petsc}, or one that is built otherwise. Install "
            "the same on all machines."))
    cancel = threading.Event()
    worker = distributed.get_worker()
    key = worker.get_current_task()
    done = threading.Event()

    def watch() -> None:
        """End GetDP when nobody waits for it any more."""
        while not done.wait(WATCH_S):
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
            lines = runner.run(here, job, folder, cancel=cancel)
        except GetDPError as error:
            failure = error.sentence
        finally:
            done.set()
        written = {path.name: path.read_bytes() for path in folder.iterdir()
                   if path.name not in given}
    return Answer(lines, written, failure)
