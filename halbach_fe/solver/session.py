"""What every solve needs besides the study: GetDP, folders, cache, progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import GetDP, Run
from halbach_fe.solver.getdp_cache import Cache

Progress = Callable[[int, int], None]
"""Called with the number of solves done and the number of all."""


@dataclass(frozen=True)
class Session:
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
    cache : Cache, optional
        Keeps what GetDP answered, for the next time that the same is asked.
    run : callable
        What runs GetDP: here, or elsewhere (`halbach_fe.solver.dask_cluster`).
    processes : int
        MPI processes of every run, for a solve that is too large for one.
    """

    getdp: GetDP
    folder: Path
    jobs: int = 1
    time_limit_s: float = 3600.0
    progress: Progress | None = None
    cache: Cache | None = None
    run: Run = runner.run
    processes: int = 1
