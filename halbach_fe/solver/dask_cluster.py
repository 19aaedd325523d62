"""Runs of GetDP and calls of functions on other machines, by Dask.

The input files of a run are sent to a worker, and the files that GetDP wrote are sent back, so that
the machines need no common file system. A worker runs and verifies GetDP as this machine would, and
must have the same version and build of GetDP. When a worker is lost, Dask repeats its tasks on
another worker.
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

from halbach_fe.core.errors import GetDPError, HalbachError, SchedulerError
from halbach_fe.core.installation import import_extra
from halbach_fe.core.pace import Say, quiet
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import GetDP, Job

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
