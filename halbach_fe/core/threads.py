"""Functions that numba compiles, threads for them, and the memory that is left."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np


def compiled(function: Callable[..., Any], fastmath: bool = False) -> Any:
    """Decorate a function that numba compiles; to import numba takes a second.

    Threads run it side by side, since it releases the GIL; numba's own threads must not be entered
    from several Python threads.
    """
    import numba

    return numba.njit(cache=True, nogil=True, error_model="numpy",
                      fastmath=fastmath or {"contract"})(function)


reordered = partial(compiled, fastmath=True)
"""The same for sums whose terms may be added in any order, several at a time."""


def in_threads(work: Callable[[int, int], object], shares: list[tuple[int, int]]) -> None:
    """Call compiled ``work`` with every share, in as many threads as there are cores."""
    if len(shares) == 1:
        work(*shares[0])
        return
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
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
