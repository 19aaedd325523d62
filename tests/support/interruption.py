"""Commands that are killed at random moments and run again: what is lost, broken or left over."""

from __future__ import annotations

import filecmp
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
import xarray as xr

from halbach_fe.core.result_folder import RECORD
from halbach_fe.report.answer import PAGE_RECORD
from halbach_fe.solver.getdp_cache import FOLDER_VARIABLE, LIMIT_VARIABLE

ENDS = {".json": b"\n", ".csv": b"\n", ".html": b"</html>"}
"""Of whole files."""


@dataclass(frozen=True)
class Killed:
    """What a kill and another run of the same command came to."""

    hit: bool
    """Whether the command was still running."""
    resumed_s: float
    """What the other run took."""
    broken: list[str]
    """What was wrong after the kill or after the other run."""


def command(verb: str, study: Path, campaign: Path, output: Path) -> list[str]:
    """Of halbach-fe, to be run in a process of its own."""
    measured = [] if verb == "solve" else [
        "--measurements", str(campaign / "map.csv"), "--blocks", str(campaign / "blocks.csv")]
    return [sys.executable, "-m", "halbach_fe", verb, str(study), "-o", str(output), *measured]


def undisturbed(arguments: Sequence[str], environment: dict[str, str]) -> float:
    """Run undisturbed; return the seconds it took."""
    start = time.monotonic()
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)}: {done.stderr}")
    return time.monotonic() - start


def kill_and_run_again(
    arguments: Sequence[str], environment: dict[str, str], output: Path, alone: Path,
    moment_s: float, patience_s: float = 30.0,
) -> Killed:
    """Kill a command with SIGKILL after ``moment_s``, and run it again to its end.

    Nothing may be broken in between, no child may survive by more than ``patience_s``, and in the
    end ``output`` must hold what ``alone`` does, and nothing else.
    """
    process = subprocess.Popen(arguments, env=environment, stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL)
    time.sleep(moment_s)
    children = psutil.Process(process.pid).children(recursive=True)
    hit = process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.wait()
    _, surviving = psutil.wait_procs(children, timeout=patience_s)
    broken = [f"{one.name()} survives" for one in surviving if one.status() != "zombie"]
    broken += unreadable(output)
    resumed = undisturbed(arguments, environment)
    return Killed(hit, resumed, broken + differences(output, alone))


def unreadable(folder: Path) -> list[str]:
    """Results in a folder that are there and broken."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.name[0] == "." or "~" in str(path.relative_to(folder)):
            continue  # in the making, and called so
        if path.suffix in (".h5", ".nc"):
            try:
                xr.open_dataset(path, engine="h5netcdf").close()
            except Exception as error:  # any, it must not fail
                found.append(f"{path.name}: {error}")
        elif not path.is_dir() and not path.read_bytes().endswith(ENDS.get(path.suffix, b"")):
            found.append(f"{path.name} is cut off")
    return found


def differences(one: Path, other: Path) -> list[str]:
    """What differs in two folders of results: files, tables, arrays.

    Pages, with page.json beside them, name their folder and how long it took; run.json has their
    hashes.
    """
    names = [{str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
             for folder in (one, other)]
    found = [f"only in one: {name}" for name in sorted(names[0] ^ names[1])]
    for name in sorted(names[0] & names[1]):
        if name.endswith((".h5", ".nc")):
            with (xr.open_dataset(one / name, engine="h5netcdf") as a,
                  xr.open_dataset(other / name, engine="h5netcdf") as b):
                same = a.equals(b)
        elif Path(name).name not in (RECORD, PAGE_RECORD) and name.endswith(
                (".json", ".csv", ".toml", ".msh", ".pro", ".txt")):
            same = filecmp.cmp(one / name, other / name, shallow=False)
        else:
            continue
        if not same:
            found.append(f"{name} differs")
    return found


def environment_of(cache: Path) -> dict[str, str]:
    """With a cache of its own."""
    return os.environ | {FOLDER_VARIABLE: str(cache), LIMIT_VARIABLE: "1", "OMP_NUM_THREADS": "1"}
