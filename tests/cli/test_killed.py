"""Commands that are killed end as if they had not been."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest

from benchmarks.recovery import (
    command,
    differences,
    environment_of,
    kill_and_run_again,
    undisturbed,
    unreadable,
)
from tests.conftest import ROOT

EXAMPLE = ROOT / "studies" / "quadrupole"
MOMENTS = 3
"""Of each command; `python -m benchmarks.run recovery` has more, and diagnose."""


@pytest.mark.parametrize("verb", ["solve", "infer"])
def test_killed_and_run_again(verb, tmp_path):
    study, campaign, alone = EXAMPLE / "study.toml", EXAMPLE / "campaign", tmp_path / "alone"
    took = undisturbed(command(verb, study, campaign, alone), environment_of(tmp_path / "cache"))
    generator, hits = np.random.default_rng(), 0
    for number in range(MOMENTS):
        output, moment = tmp_path / str(number), float(generator.uniform(0.2, took))
        end = kill_and_run_again(
            command(verb, study, campaign, output), environment_of(tmp_path / f"cache-{number}"),
            output, alone, moment)
        assert not end.broken, f"killed after {moment} s"
        hits += end.hit
    assert hits


ORPHANING = """
import subprocess, time
subprocess.Popen(["sleep", "7"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
time.sleep(2)
"""


def test_a_process_that_survives_is_seen(tmp_path):
    """The control: a child that nothing ties to its parent."""
    end = kill_and_run_again([sys.executable, "-c", ORPHANING], dict(os.environ), tmp_path,
                             tmp_path, moment_s=1.0)
    assert end.broken == ["sleep survives"]


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
