"""Commands that are killed end as if they had not been."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

from halbach_fe.core.errors import GetDPError, NotConvergedError, StudyError
from tests.conftest import ROOT
from tests.support.interruption import (
    command,
    differences,
    environment_of,
    kill_and_run_again,
    undisturbed,
    unreadable,
)

EXAMPLE = ROOT / "studies" / "quadrupole"
MOMENTS = 1
"""`python -m benchmarks.run recovery` has more, and other commands."""
IMPORTS = 0.3
"""Share of a command's time that its imports take, before there is anything to lose."""


def test_killed_and_run_again(tmp_path):
    """Of `infer`, which solves what `solve` does and writes more."""
    study, campaign, alone = tmp_path / "study.toml", EXAMPLE / "campaign", tmp_path / "alone"
    study.write_text((EXAMPLE / "study.toml").read_text().replace(
        "block_size_m = 0.003\nbore_size_m = 0.002", "block_size_m = 0.008\nbore_size_m = 0.006"))
    took = undisturbed(command("infer", study, campaign, alone), environment_of(tmp_path / "cache"))
    generator, hits, earliest = np.random.default_rng(), 0, min(IMPORTS * took, 1.0)
    for number in range(5 * MOMENTS):
        output, moment = tmp_path / str(number), float(generator.uniform(earliest, took))
        end = kill_and_run_again(
            command("infer", study, campaign, output), environment_of(tmp_path / f"cache-{number}"),
            output, alone, moment)
        assert not end.broken, f"killed after {moment} s"
        hits += end.hit
        if hits == MOMENTS:
            break
        if not end.hit:  # the machine is less busy than when the time was taken
            took = max(0.7 * took, 1.1 * earliest)
    assert hits == MOMENTS


ORPHANING = """
import subprocess, sys, time
try:
    open(sys.argv[1], "x").close()
except FileExistsError:
    sys.exit()  # it is run again
subprocess.Popen(["sleep", "9"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
time.sleep(30)
"""


def test_a_process_that_survives_is_seen(tmp_path):
    """The control: a child that nothing ties to its parent."""
    end = kill_and_run_again([sys.executable, "-c", ORPHANING, str(tmp_path / "begun")],
                             dict(os.environ), tmp_path, tmp_path, moment_s=2.0, patience_s=0.5)
    assert end.broken == ["sleep survives"]


QUEUED = """
import argparse, sys, time
from halbach_fe.cli import common
def run():
    with common.workers(argparse.Namespace(scheduler=None, jobs=1)) as pool:
        waiting = [pool.submit(time.sleep, 0.5) for _ in range(120)]
        waiting[0].result()
        print("one", flush=True)
        return sum(one.result() is None for one in waiting)
if __name__ == "__main__":
    sys.exit(common.guarded(run))
"""


def test_what_waits_is_not_begun_after_an_interrupt(tmp_path):
    script = tmp_path / "queued.py"
    script.write_text(QUEUED)
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "one\n"
    children = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=50)  # all of them would take a minute
    assert (process.returncode, said.strip()) == (130, "interrupted")
    assert not psutil.wait_procs(children, timeout=30)[1]


STUCK = """
import ctypes, sys
from halbach_fe.cli import process
process.PATIENCE_S = float(sys.argv[1])
def run():
    lock, mutex = ctypes.CDLL(None).pthread_mutex_lock, ctypes.create_string_buffer(64)
    lock(mutex)
    print("locked", flush=True)
    lock(mutex)  # never returns, whatever signal comes
sys.exit(process.guarded(run))
"""


@pytest.mark.parametrize("patience_s", [0.3, 100.0])
def test_a_library_that_does_not_return_is_ended(tmp_path, patience_s):
    """Gmsh meshes for minutes without looking at signals; with long patience, the control."""
    script = tmp_path / "stuck.py"
    script.write_text(STUCK)
    with subprocess.Popen([sys.executable, str(script), str(patience_s)], text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == "locked\n"
        while psutil.Process(process.pid).status() != psutil.STATUS_SLEEPING:
            time.sleep(0.05)
        time.sleep(0.2)  # it sleeps in the library by now, where Python sees no signal
        process.send_signal(signal.SIGTERM)
        if patience_s > 1:
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(timeout=0.6)
            process.kill()
        said = process.communicate(timeout=30)[1].strip()
    assert (process.returncode, said) == ((130, "interrupted") if patience_s < 1 else (-9, ""))


def test_errors_travel_between_processes():
    for one in (NotConvergedError("no", (1.0, 2.0)), GetDPError("no"), StudyError("no")):
        there = pickle.loads(pickle.dumps(one))
        assert (type(there), str(there), vars(there)) == (type(one), str(one), vars(one))


def test_what_is_broken_is_seen(tmp_path):
    """The control of the comparisons."""
    one, other = tmp_path / "one", tmp_path / "other"
    for folder in (one, other):
        (folder / "run").mkdir(parents=True)
        (folder / "run" / "map.csv").write_text("a,b\n1,2\n")
    assert not unreadable(one)
    assert not differences(one, other)
    (one / "run" / "map.csv").write_text("a,b\n1,")
    (one / "field.h5").write_bytes(b"\x89HDF")
    (other / "left").write_text("")
    assert len(unreadable(one)) == 2
    assert differences(one, other) == ["only in one: field.h5", "only in one: left",
                                       "run/map.csv differs"]
