"""Runs of GetDP beside each other: an interruption at any moment ends them all."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.core.errors import GetDPError
from halbach_fe.solver.getdp import Job
from halbach_fe.solver.session import RunSize, Task, run_tasks

PATIENCE_S = 60.0
"""What a run that nobody ends would take."""


def task(name):
    return Task(name, lambda folder: Job("a.pro", "a.msh", "Solve", ()), lambda folder: np.zeros(1),
                (1,), 1, RunSize("direct", 1, 1, 1, 1))


def test_an_interruption_while_runs_are_handed_out_ends_the_first(session, monkeypatch):
    """Ctrl-C comes after the first run was started, and before the second is."""
    begun, ended = threading.Event(), []

    def run(getdp, job, folder, on_line, cancel):
        begun.set()
        ended.append(cancel.wait(PATIENCE_S))
        raise GetDPError("it was cancelled")

    class Interrupted(ThreadPoolExecutor):
        def submit(self, work, *arguments):
            if begun.is_set():
                raise KeyboardInterrupt
            future = super().submit(work, *arguments)
            assert begun.wait(PATIENCE_S)
            return future

    monkeypatch.setattr("halbach_fe.solver.session.ThreadPoolExecutor", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_tasks([task("one"), task("two")], replace(session, run=run))
    assert ended == [True], "the first run went on until its end"
