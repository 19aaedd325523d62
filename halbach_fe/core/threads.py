"""Functions that numba compiles, threads for them, and the memory that is left."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])


class Compiled:
    """A function that numba compiles when it is first called: to import numba takes a second.

    Threads run it side by side, since it releases the GIL; numba's own threads must not be entered
    from several Python threads.
    """

    def __init__(self, function: Callable[..., Any], fastmath: bool = False) -> None:
        self.function, self.fastmath = function, fastmath

    def __call__(self, *values: Any) -> Any:
        """Return what the function returns."""
        return self.machine_code(*values)

    @cached_property
    def machine_code(self) -> Callable[..., Any]:
        """The function for numba, which also has those that it calls under their names."""
        import numba

        code: Callable[..., Any] = numba.njit(
            cache=True, nogil=True, error_model="numpy",
            fastmath=self.fastmath or {"contract"})(self.function)
        names = self.function.__globals__
        for name in self.function.__code__.co_names:
            if isinstance(called := names.get(name), Compiled):
                names[name] = code if called is self else called.machine_code
        return code


def compiled(function: F) -> F:
    """Decorate a function that numba compiles, see `Compiled`."""
    return cast(F, Compiled(function))


def reordered(function: F) -> F:
    """Decorate a sum whose terms may be added in any order, several at a time."""
    return cast(F, Compiled(function, fastmath=True))


def in_threads(work: Callable[[int, int], object], shares: list[tuple[int, int]]) -> None:
    """Call compiled ``work`` with every share, in as many threads as ``NUMBA_NUM_THREADS`` says.

    By default that is the number of cores. With 1, no thread is started: to start them takes 0.3 ms
    of processor time, which small problems pay thousands of times.
    """
    threads = int(os.environ.get("NUMBA_NUM_THREADS", os.cpu_count() or 1))
    if 1 in (threads, len(shares)):
        for share in shares:
            work(*share)
        return
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(work, *share) for share in shares]:
            done.result()


def share_out(count: int, parts: int = 16) -> list[tuple[int, int]]:
    """Return ranges of about the same size."""
    if parts == 1:
        return [(0, count)]
    limits = np.unique(np.linspace(0, count, parts + 1).astype(int)).tolist()
    return list(pairwise(limits))


def available_memory() -> float | None:
    """Return the available memory in GiB of the machine, or of the container if that is less.

    It is None if the operating system does not tell.
    """
    limits = []
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        limits.append(int(lines["MemAvailable"].split()[0]) / 2**20)
        group = Path("/sys/fs/cgroup")
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            limits.append((int(limit) - int((group / "memory.current").read_text())) / 2**30)
    except (OSError, KeyError, ValueError):
        pass
    return min(limits, default=None)
