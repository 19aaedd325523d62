"""What every solve needs besides the magnet: GetDP, folders, cache, progress."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import GetDP, Run, find_getdp
from halbach_fe.solver.getdp_cache import Cache, default_cache

DEFAULT_JOBS = 2
"""Runs of GetDP at a time, if the machine has as many cores: most problems are two runs, with the
materials as they are and with vacuum in their place."""

Progress = Callable[[int, int], None]
"""Called with the number of solves done and the number of all."""


@dataclass(frozen=True)
class RunSize:
    """How large a run of GetDP is.

    Attributes
    ----------
    route : str
        Formulation that it solves, see `halbach_fe.solver.field.choose_route`.
    elements, unknowns : int
    solves : int
        Linear solves; those of Newton's steps, which nobody knows before, do not count.
    matrices : int
        Different matrices; of Newton's method, again, none of its steps counts.
    newton : bool
        Whether the field is solved by Newton's method first.
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
        Runs that may go side by side, with the purpose of the session that starts them.
    """

    batches: list[tuple[str, Sequence[RunSize]]] = field(default_factory=list)


@dataclass(frozen=True)
class Session:
    """How and where GetDP runs; `Session.open` makes one with the usual settings.

    Attributes
    ----------
    getdp : GetDP
        The executable and what is known of its build.
    folder : Path
        Run folders are made here; those of finished runs are kept (``getdp-real``,
        ``getdp-vacuum``) and can be run by hand.
    jobs : int
        Runs of GetDP at a time.
    time_limit_s : float
        Longest time of a single run.
    progress : callable, optional
        Called with the number of finished solves and the number of all.
    cache : Cache, optional
        Answers of GetDP that are kept; the same question is not solved again.
    run : callable
        Runs a job on this machine, or elsewhere (`halbach_fe.solver.dask_cluster`).
    processes : int
        MPI processes that share each run, for a solve that is too large for one process.
    purpose : str
        What the solves are for, in words.
    counter : RunCounter, optional
        With it nothing is meshed or solved: the runs that would be started are counted.

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
    def open(
        cls, folder: str | Path, jobs: int | None = None, getdp: str | None = None,
        progress: Progress | None = None,
    ) -> Session:
        """Return a session with the usual settings: GetDP of this machine, and its cache.

        Parameters
        ----------
        folder : str or Path
            Folder for meshes, runs and results; made when needed.
        jobs : int, optional
            Runs of GetDP at a time; two by default, or one on a machine of one core.
        getdp : str, optional
            GetDP executable; by default that of $HALBACH_FE_GETDP, then of PATH.
        progress : callable, optional
            See `Session`.

        Returns
        -------
        Session

        Raises
        ------
        GetDPNotFoundError
            If there is no GetDP.

        Examples
        --------
        >>> Session.open("results").jobs in (1, 2)
        True
        """
        return cls(find_getdp(getdp), Path(folder),
                   jobs=jobs or min(DEFAULT_JOBS, os.cpu_count() or 1), progress=progress,
                   cache=default_cache(None))

    @classmethod
    def counting(cls, jobs: int) -> Session:
        """Return a session that counts runs of GetDP in place of starting them."""
        return cls(GetDP(Path(), "", (), ""), Path(), jobs=jobs, counter=RunCounter())

    def within(self, name: str) -> Session:
        """Return the same session in a folder of its own, inside this one's."""
        return replace(self, folder=self.folder / name)
