"""Work on a real Dask scheduler and workers, processes of their own on this machine."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import psutil
import pytest
import xarray as xr

from halbach_fe.cli import main
from halbach_fe.core.errors import ExtraMissingError, GetDPError, SchedulerError
from halbach_fe.core.untrusted_files import write_hdf5
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.getdp import ENVIRONMENT_VARIABLE
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Cluster, connected
from tests.conftest import ROOT, circle

POINTS = circle(0.07, 8)
QUADRUPOLE = ROOT / "studies" / "quadrupole"


class Grid:
    """A scheduler, and workers that can be killed."""

    def __init__(self, folder):
        self.folder, self.started = folder, []
        where = folder / "scheduler.json"
        scheduler = self._start("dask", "scheduler", "--host", "127.0.0.1", "--port", "0",
                                "--no-dashboard", "--scheduler-file", str(where))
        deadline = time.monotonic() + 60
        while not where.exists() or not where.read_text():
            assert time.monotonic() < deadline
            assert scheduler.poll() is None
            time.sleep(0.1)
        self.address = json.loads(where.read_text())["address"]

    def worker(self, **environment):
        """Start a worker of one thread in a process of its own."""
        return self._start("dask", "worker", self.address, "--nthreads", "1", "--no-dashboard",
                           "--no-nanny", "--local-directory", str(self.folder),
                           environment=environment)

    def _start(self, module, *arguments, environment=None):
        with (self.folder / f"log-{len(self.started)}").open("w") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", module, *arguments], stdout=log, stderr=log,
                env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)} | (
                    environment or {}), cwd=self.folder)
        self.started.append(process)
        return process

    def close(self):
        for process in reversed(self.started):
            process.kill()
            process.wait()


@pytest.fixture
def grid(tmp_path):
    folder = tmp_path / "grid"
    folder.mkdir()
    made = Grid(folder)
    yield made
    made.close()


@pytest.fixture
def cluster(grid):
    with connected(grid.address) as found:
        yield found


def wait_for_workers(cluster, count):
    cluster.client.wait_for_workers(count, timeout=120)


def test_results_equal_the_local_ones(grid, tmp_path, capsys):
    """The whole command, with columns in several runs."""
    grid.worker()
    grid.worker()
    command = ["infer", str(QUADRUPOLE / "study.toml"),
               "--measurements", str(QUADRUPOLE / "campaign" / "map.csv"),
               "--blocks", str(QUADRUPOLE / "campaign" / "blocks.csv"), "--json"]
    said = []
    for name, extra in (("here", []), ("there", ["--scheduler", grid.address, "--jobs", "4"])):
        assert main([*command, "-o", str(tmp_path / name), *extra]) == 0
        said.append(json.loads(capsys.readouterr().out))
    # the same solves, of the same bits; the superposition sums them in parts of another number
    assert said[0] == said[1]
    assert (tmp_path / "here" / "prediction.csv").read_bytes() == (
        tmp_path / "there" / "prediction.csv").read_bytes()


def test_a_scheduler_without_workers_says_so(grid):
    """The control: with a worker nothing is said."""
    said = []
    with connected(grid.address, said.append) as cluster:
        grid.worker()
        wait_for_workers(cluster, 1)
    with connected(grid.address, said.append):
        pass
    (sentence,) = said
    assert f"{grid.address} has no workers: waiting" in sentence


def slow_getdp(getdp, folder):
    """GetDP that waits a while before it solves."""
    path = folder / "slow-getdp"
    path.write_text(f'#!/bin/sh\n[ "$1" = -info ] || sleep 4\nexec {getdp.executable} "$@"\n')
    path.chmod(0o755)
    return {ENVIRONMENT_VARIABLE: str(path)}


def test_work_of_a_lost_worker_is_done_again(grid, cluster, session, dipole, tmp_path):
    study = dipole(mesh__block_size_m=0.04)
    alone = solve_nominal(build_magnet(study), POINTS, session)
    slow = slow_getdp(session.getdp, tmp_path)
    doomed = grid.worker(**slow)
    wait_for_workers(cluster, 1)
    found = []
    there = replace(session, folder=tmp_path / "there", run=cluster.run)
    thread = threading.Thread(
        target=lambda: found.append(solve_nominal(build_magnet(study), POINTS, there)))
    thread.start()
    child = run_of(doomed)
    doomed.send_signal(signal.SIGKILL)
    doomed.wait()
    assert not found
    child.wait(timeout=30)  # GetDP goes with it
    grid.worker()
    thread.join(timeout=120)
    assert np.array_equal(found[0], alone)


def run_of(worker):
    """The run of GetDP that a worker starts; asking for the version is none."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        for child in psutil.Process(worker.pid).children():
            with suppress(psutil.Error):  # it has just ended
                if "-solve" in child.cmdline():
                    return child
        time.sleep(0.02)
    raise AssertionError("no run was started")


def test_what_nobody_waits_for_ends(grid, cluster, session, dipole, tmp_path):
    """A run that was cancelled here does not go on there."""
    worker = grid.worker(**slow_getdp(session.getdp, tmp_path))
    wait_for_workers(cluster, 1)
    cancel = threading.Event()

    def cancelled(*rest):
        return cluster.run(*rest[:4], cancel)

    errors = []

    def solve():
        with pytest.raises(GetDPError) as caught:
            solve_nominal(build_magnet(dipole(mesh__block_size_m=0.04)), POINTS,
                          replace(session, jobs=1, run=cancelled))
        errors.append(str(caught.value))

    thread = threading.Thread(target=solve)
    thread.start()
    child = run_of(worker)
    cancel.set()
    thread.join(timeout=30)
    assert "cancelled" in errors[0]
    child.wait(timeout=30)


def test_a_worker_with_another_getdp_is_refused(grid, cluster, session, dipole, tmp_path):
    other = tmp_path / "other-getdp"
    other.write_text(f'#!/bin/sh\nexec {session.getdp.executable} "$@" 2>&1 | '
                     "sed s/3[.]2[.]0/3.9.9/\n")
    other.chmod(0o755)
    grid.worker(**{ENVIRONMENT_VARIABLE: str(other)})
    with pytest.raises(GetDPError, match=r"another GetDP: 3\.9\.9 .* in place of 3\.2\.0"):
        solve_nominal(build_magnet(dipole()), POINTS, replace(session, run=cluster.run))


def test_a_failure_there_is_told_here(grid, cluster, session, dipole):
    """With the log of GetDP, in this machine's folder."""
    grid.worker()

    def unsound(getdp, job, *rest):
        return cluster.run(getdp, replace(job, unknowns=job.unknowns + 1), *rest)

    with pytest.raises(GetDPError, match="unknowns where the mesh gives") as caught:
        solve_nominal(build_magnet(dipole()), POINTS, replace(session, run=unsound))
    logs = [session.folder / f"getdp-{variant}-failed" / "getdp.log"
            for variant in ("real", "vacuum")]  # either may fail first, and the other is stopped
    (log,) = [log for log in logs if str(log) in str(caught.value)]
    assert "Dofs" in log.read_text()


def test_functions_go_there_too(grid, cluster):
    grid.worker()
    offset = 3.0  # functions made on the spot travel as well
    pids = {future.result()[1] for future in [
        cluster.executor.submit(lambda x: (x + offset, os.getpid()), x) for x in range(3)]}
    assert os.getpid() not in pids
    assert list(cluster.executor.map(partial(pow, 2), [1, 2, 3])) == [2, 4, 8]


def writes(folder):
    data = xr.Dataset({"one": ("x", np.arange(3.0))})
    write_hdf5(data, folder / "data.h5")
    return data


def test_functions_there_write_files(grid, cluster, tmp_path):
    """For which xarray asks the scheduler, if it knows of one."""
    grid.worker()
    data = cluster.executor.submit(writes, tmp_path).result()
    with xr.open_dataset(tmp_path / "data.h5", engine="h5netcdf") as found:
        assert found.equals(data)


def test_a_function_that_kills_its_workers(grid):
    """Dask tries it on four of them."""
    for _ in range(4):
        grid.worker()
    with (pytest.raises(SchedulerError, match="KilledWorker"), connected(grid.address) as cluster):
        cluster.executor.submit(os._exit, 1).result()


def test_a_scheduler_that_ends(grid, cluster, session, dipole):
    grid.worker()
    wait_for_workers(cluster, 1)
    scheduler = grid.started[0]

    def ending(*rest):
        scheduler.kill()
        return cluster.run(*rest)

    with pytest.raises(SchedulerError, match=r"Dask scheduler .* failed"):
        solve_nominal(build_magnet(dipole()), POINTS, replace(session, jobs=1, run=ending))
    cluster.client.close()
    with pytest.raises(SchedulerError, match="closed"):
        solve_nominal(build_magnet(dipole()), POINTS, replace(session, jobs=1, run=cluster.run))


class Lost:
    """A client, and its own future, after Dask has given up, which takes it 20 s."""

    def submit(self, *rest, **options):
        return self

    def done(self):
        return True

    def result(self):
        raise RuntimeError("first reason")

    def cancel(self):
        raise RuntimeError("nobody to tell")


def test_a_client_that_has_given_up(dipole, session):
    lost = Cluster(Lost(), "tcp://nowhere:8786")
    with pytest.raises(SchedulerError, match="first reason"):
        solve_nominal(build_magnet(dipole()), POINTS, replace(session, run=lost.run))


@pytest.mark.parametrize("address", ["", "tcp://127.0.0.1:1", "nonsense", "tcp://127.0.0.1:no"])
def test_nobody_there(address, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("halbach_fe.solver.session.CONNECT_S", 1.0)
    assert main(["solve", str(QUADRUPOLE / "study.toml"), "-o", str(tmp_path / "out"),
                 "--scheduler", address]) == 12
    assert "must be the address of a running Dask scheduler" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["", "nonsense", "http://127.0.0.1:8787"])
def test_an_address_of_no_scheduler(address, monkeypatch):
    """It is refused before there is a client, which would print a traceback when it is deleted."""
    monkeypatch.delattr("distributed.Client")
    with (pytest.raises(SchedulerError, match="must be the address of a running Dask scheduler"),
          connected(address)):
        pass


def test_dask_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (pytest.raises(ExtraMissingError, match=r"pip install .*\[cluster\]"),
          connected("tcp://127.0.0.1:8786")):
        pass
