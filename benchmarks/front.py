"""The front door: what a first field takes in Python, and the main commands without root."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.note import Note

ROOT = Path(__file__).parent.parent

LINES = """import halbach_fe as hf
magnet = hf.halbach_ring(order=2, inner_radius_m=0.015, outer_radius_m=0.04, length_m=0.05)
print(magnet.field_T([[0.01, 0.0, 0.0]]))"""

REPEATS = 5


def first_field(note: Note) -> None:
    """Measure what a new user waits for, on a machine that does nothing else."""
    waited, processor = [], []
    for _ in range(REPEATS):
        began, before = time.perf_counter(), os.times()
        subprocess.run([sys.executable, "-c", LINES], check=True, stdout=subprocess.DEVNULL)
        after = os.times()
        waited.append(time.perf_counter() - began)
        processor.append(after.children_user + after.children_system
                         - before.children_user - before.children_system)
    note("front.steps_to_first_field", len(LINES.splitlines()), "lines", "a bare interpreter")
    note("front.seconds_to_first_field", min(waited), "s", f"best of {REPEATS} interpreters")
    note("front.processor_s_to_first_field", min(processor), "s", f"best of {REPEATS} interpreters")


def no_root(note: Note) -> None:
    """Count the commands that run without root."""
    said = subprocess.run([ROOT / "tools" / "check_wheel.sh"], check=True, capture_output=True,
                          text=True).stdout
    ran, of = map(int, re.findall(r"^(\d+) of (\d+) commands ran without root$", said, re.M)[-1])
    note("front.no_root", ran, "commands", f"{of}: doctor, Python, explain, solve with iron, of "
         "the wheel alone with the static GetDP")
