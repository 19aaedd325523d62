"""The code as it was before it was made fast, and as it is: ratios of times measured in turn.

The old code is a commit of this repository, installed beside the checkout. Each task runs in
processes of its own (`benchmarks.speed_tasks`), old and new in turn; what counts is the processor
time of a process and its children, which another program on the machine hardly changes.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
from pathlib import Path

import tomlkit

from benchmarks.note import Note
from benchmarks.speed_tasks import SECTORS, changed

ROOT = Path(__file__).parent.parent
BEFORE = "5c3aed3"
"""The last commit before the compiled field."""

BEFORE_WAITING = "c8473ba"
"""The last commit before check, register and the update of lattices were made fast."""

REPEATS = {"exact": 3, "help": 7, "diagnose-map": 1, "solve": 1, "response": 1, "command": 1}

HIDDEN = "block_displaced=6,5,3e-3,0,0"
"""A block that is displaced in the simulated maps: ring, slot, displacement in m."""

MOVED = "mapper_translation=1e-3,-5e-4,2e-3"
"""A mapper that is displaced, in m."""


def old_code(commit: str = BEFORE) -> Path:
    """Return a folder with the packages of the old code, which is installed there if need be."""
    site = ROOT / "build" / f"before-{commit}"
    if not site.exists():
        source = ROOT / "build" / f"source-{commit}"
        source.mkdir(parents=True, exist_ok=True)
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True,
                                 capture_output=True).stdout
        subprocess.run(["tar", "-x"], cwd=source, input=archive, check=True)
        subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps",
                        "--target", str(site), str(source)], check=True)
    return site


def simulated(name: str, study: str, hidden: str = HIDDEN) -> Path:
    """Return a folder with a study and a map of it, which magpylib and NGSolve simulate."""
    folder = ROOT / "build" / "speed" / name
    if not (folder / "map.csv").exists():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "study.toml").write_text(study)
        subprocess.run(
            [sys.executable, "-m", "halbach_fe", "simulate-measurement", folder / "study.toml",
             "--seed", "1", "--hide", hidden, "-o", folder / "campaign"], check=True,
            stdout=subprocess.DEVNULL)
        (folder / "campaign" / "map.csv").replace(folder / "map.csv")
    return folder


def run_task(
    name: str, site: Path | None, folder: Path | None = None
) -> tuple[float, dict[str, float]]:
    """Run a task with the code at ``site`` (None: this checkout), on the files of a folder.

    Returns
    -------
    seconds : float
        Of processor time.
    found : dict
        What the task printed.
    """
    # threads of the linear algebra that wait for each other count as processor time
    known = dict(os.environ) | dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    if site is not None:
        known["PYTHONPATH"] = str(site)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, str(Path(__file__).parent / "speed_tasks.py"), name,
                           *([] if folder is None else [str(folder)])],
                          env=known, check=True, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = (after.ru_utime + after.ru_stime) - (before.ru_utime + before.ru_stime)
    return seconds, json.loads(done.stdout.splitlines()[-1])


def both(
    name: str, folder: Path | None = None, commit: str = BEFORE
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the smallest figures of a task by the old code and by the new, run in turn."""
    runs: tuple[list[dict[str, float]], list[dict[str, float]]] = [], []
    for _ in range(REPEATS[name]):
        for site, found in zip((old_code(commit), None), runs, strict=True):
            seconds, figures = run_task(name, site, folder)
            found.append({"processor_s": seconds, **figures})
    old, new = ({key: min(one[key] for one in found) for key in found[0]} for found in runs)
    return old, new


def exact(note: Note) -> None:
    """Note the throughput of the exact field of blocks."""
    old, new = both("exact")
    for shape in ("sectors", "cuboids"):
        note(f"exact.speedup_{shape}", old[f"{shape}_s"] / new[f"{shape}_s"], "ratio",
             f"processor time of the code before, commit {BEFORE}: {old[f'{shape}_s']:.3g} s; now "
             f"{new[f'{shape}_s']:.3g} s")
        note(f"exact.over_magpylib_{shape}", new[f"{shape}_magpylib_s"] / new[f"{shape}_s"],
             "ratio", "processor time of magpylib over ours, three unit columns of each block")
        note(f"exact.error_{shape}", new[f"{shape}_error"], "of the largest column",
             "largest difference from magpylib")


def command_line(note: Note) -> None:
    """Note how long the command line takes to show its help."""
    new = both("help")[1]
    note("cli.help_over_python", new["help_s"] / new["python_s"], "ratio",
         "time of halbach-fe --help over that of an interpreter that does nothing, smallest of 7")


def small(note: Note) -> None:
    """Note how much faster a diagnosis is: 192 blocks in vacuum, 3840 readings, one displaced."""
    folder = ROOT / "build" / "speed" / "small"
    folder.mkdir(parents=True, exist_ok=True)
    run_task("make-map", None, folder)
    run_task("diagnose-map", None, folder)  # what is compiled is kept from then on
    _note_diagnosis(note, "small", *both("diagnose-map", folder))


def full(note: Note) -> None:
    """Note the same of 192 blocks with permeability in an iron tube, and 28 080 readings."""
    study = (ROOT / "studies" / "faser" / "campaign.toml").read_text()
    _note_diagnosis(note, "full", *both("diagnose-map", simulated("full", study)))


def permeability(note: Note) -> None:
    """Note the same of the small magnet with permeability, and 3840 readings."""
    study = tomlkit.dumps(changed(SECTORS, array__recoil_permeability=1.05))
    _note_diagnosis(note, "permeability",
                    *both("diagnose-map", simulated("permeability", study)))


def quadrupole(note: Note) -> None:
    """Note the same of a quadrupole with permeability, 777 points, and a mapper that is displaced,
    against the code before `waiting`.
    """
    study = tomlkit.dumps(changed(
        SECTORS, array__multipole_order=2, array__blocks_per_ring=12, array__rings=3,
        array__recoil_permeability=1.05, observation__positions={
            "kind": "circles", "radius_m": 0.06, "angles": 21, "z_min_m": -0.25, "z_max_m": 0.25,
            "count": 37}))
    folder = simulated("quadrupole", study, MOVED)
    _note_diagnosis(note, "quadrupole", *both("diagnose-map", folder, BEFORE_WAITING),
                    BEFORE_WAITING, "mapper_translation")


def _note_diagnosis(
    note: Note, name: str, old: dict[str, float], new: dict[str, float], commit: str = BEFORE,
    hidden: str = "block_displaced",
) -> None:
    """Note the ratio of both times, and the new one."""
    others = [one["effects"] - one[hidden] for one in (old, new)]
    note(f"diagnosis.speedup_{name}", old["processor_s"] / new["processor_s"], "ratio",
         f"processor time of the code before, commit {commit}: {old['processor_s']:.3g} s; now "
         f"{new['processor_s']:.3g} s; {hidden} named: {old[hidden]:g}, {new[hidden]:g}; "
         f"other effects named: {others[0]:g}, {others[1]:g}")
    note(f"diagnosis.seconds_{name}", new["wall_s"], "s",
         f"wall time; before {old['wall_s']:.3g} s")


def waiting(note: Note) -> None:
    """Note how much faster those commands are that people wait for.

    What is compiled once is compiled before, by both, on the smaller of the tasks.
    """
    folder = _waiting()
    for site in (old_code(BEFORE_WAITING), None):
        for name in ("register", "check-2565"):
            run_task("command", site, folder / name)
    for name, figure in (("register", "register.speedup"),
                         ("register-many", "register.speedup_400x4000"),
                         ("check-2565", "check.speedup_2565"),
                         ("check-8892", "check.speedup_8892"), ("infer", "infer.lattice_speedup")):
        old, new = both("command", folder / name, BEFORE_WAITING)
        answers = "".join(f"; {key} {old[key]:.4g}, {new[key]:.4g}" for key in new
                          if key.endswith("_mm"))
        note(figure, old["processor_s"] / new["processor_s"], "ratio",
             f"processor time of the code before, commit {BEFORE_WAITING}: "
             f"{old['processor_s']:.3g} s; now {new['processor_s']:.3g} s{answers}; peak memory "
             f"{old['peak_GiB']:.3g} GiB, {new['peak_GiB']:.3g} GiB")


def _waiting() -> Path:
    """Return the folder of the studies and maps of `waiting`, which are made if need be."""
    folder = ROOT / "build" / "speed" / "waiting"
    if not (folder / "check-50000" / "map.csv").exists():
        run_task("make-waiting", None, folder)
    return folder


def growth(note: Note) -> None:
    """Note with which power of the number of points the time of ``check`` grows."""
    folder = _waiting()
    run_task("command", None, folder / "check-2565")  # what is compiled once
    seconds, points = [], []
    for name in ("check-2565", "check-50000"):
        seconds.append(run_task("command", None, folder / name)[0])
        rows = (folder / name / "map.csv").read_text().splitlines()
        points.append(sum(not row.startswith("#") for row in rows) - 1)
    note("check.time_exponent", math.log(seconds[1] / seconds[0]) / math.log(
        points[1] / points[0]), "exponent", f"processor time of {points[0]} points: "
         f"{seconds[0]:.3g} s, of {points[1]}: {seconds[1]:.3g} s")


def solvers(note: Note) -> None:
    """Note how much faster the response of the FASER dipole is, and its field in thin iron."""
    for task, study, figure in (("response", "campaign", "response.speedup"),
                                ("solve", "iron", "nonlinear.faser_3d_speedup")):
        old, new = both(task, ROOT / "studies" / "faser" / f"{study}.toml")
        note(figure, old["processor_s"] / new["processor_s"], "ratio",
             f"processor time of the code before, commit {BEFORE}: {old['processor_s']:.3g} s; now "
             f"{new['processor_s']:.3g} s; wall time {old['wall_s']:.3g} s and "
             f"{new['wall_s']:.3g} s")


def run(note: Note) -> None:
    """Note the figures that take minutes."""
    exact(note)
    command_line(note)
