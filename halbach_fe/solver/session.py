"""The settings of all runs of GetDP: executable, folder, cache, number of processes, progress."""

from __future__ import annotations

import functools
import inspect
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ParamSpec, TypeVar

from halbach_fe.core.arguments import typed
from halbach_fe.core.files import make_folder
from halbach_fe.core.numbers import check_number
from halbach_fe.core.pace import Progress
from halbach_fe.core.result_folder import locked_folder
from halbach_fe.core.temporary_files import folder_until_exit, remove_orphans, temporary_path
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import NO_GETDP, GetDP, Run, getdp_or_none
from halbach_fe.solver.getdp_cache import Cache, default_cache

DEFAULT_JOBS = 2
"""Number of parallel runs of GetDP, if the machine has as many cores. Most problems consist of two
runs, with the real materials and with vacuum in their place."""

TEMPORARY_CACHE_BYTES = 4 * 2**30
"""Size limit of a cache that lasts as long as one search, see `Session.with_cache`."""

P = ParamSpec("P")
R = TypeVar("R")

@dataclass(frozen=True)
class RunSize:
    """The size of a run of GetDP, from which its cost is estimated.

    Attributes
    ----------
    route : str
        Route of the solve, see `halbach_fe.solver.formulation_choice.choose_route`.
    elements, unknowns : int
    solves : int
        Number of linear solves, without those of Newton's steps, whose number is not known in
        advance.
    matrices : int
        Number of different matrices, also without those of Newton's steps.
    newton : bool
        Whether Newton's method solves for the field first.
    """

    route: str
    elements: int
    unknowns: int
    solves: int
    matrices: int = 1
    newton: bool = False


@dataclass
class RunCounter:
    """Collects the runs that a computation would start.

    Attributes
    ----------
    batches : list of (str, sequence of RunSize)
        Purpose of the session, and the runs that it would start in parallel.
    """

    batches: list[tuple[str, Sequence[RunSize]]] = field(default_factory=list)


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
        (`halbach_fe.solver.dask_cluster`).
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
        return cls(getdp_or_none(getdp), Path(folder),
                   jobs=jobs or min(DEFAULT_JOBS, os.cpu_count() or 1), progress=progress,
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
        try:
            yield replace(self, cache=Cache(folder, TEMPORARY_CACHE_BYTES))
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
