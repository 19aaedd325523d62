"""Sealed cases outside the catalogue, and suspicions: how often the diagnosis says what it may say.

Maps are of a small magnet of cuboids in vacuum, by magpylib. Every case is kept in
``results/unknown``; an interrupted run goes on, and several processes may share the cases::

    python -m benchmarks.unknown --part 1 2 &
    python -m benchmarks.unknown --part 2 2
    python -m benchmarks.run unknown
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.core.files import write_text
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.linearization import NominalSolver
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.session import Session
from tests.support.unlisted import STUDY, false_names
from tests.support.unlisted_causes import UnlistedCause, simulate_unlisted

FOLDER = Path(__file__).parent.parent / "results" / "unknown"
SEEDS = range(16, 76)
"""Seeds of the cases; smaller ones were seen while the rules were made."""

def outcome(seed: int, cause: UnlistedCause, found: Diagnosis) -> dict[str, Any]:
    """Return what is scored of a case."""
    unknown = found.unknown
    return {
        "seed": seed, "family": cause.family, "axes": cause.axes, "rms_T": cause.rms_T,
        "rms_over_noise": cause.rms_over_noise, "named": false_names(found),
        "unknown": unknown and unknown.kind,
        "described": [[part.acts_on, part.along, list(part.or_else), list(part.components),
                       part.smooth, part.rms_T] for part in (unknown.parts if unknown else ())],
        "suspected": [list(one.effects) for one in found.suspected],
        "chi2_before": found.before.prior_conflict, "rounds": found.rounds,
        "at_rest": found.converged}


def run_cases(numbers: list[int], folder: Path = FOLDER) -> list[dict[str, Any]]:
    """Diagnose the cases that are not there yet, and return the results of all."""
    with TemporaryDirectory(prefix="halbach-fe-") as name:
        session = Session(find_getdp(None), Path(name))
        solver = NominalSolver(session)
        for seed in numbers:
            path = folder / f"{seed:03d}.json"
            if path.exists():
                continue
            data, cause = simulate_unlisted(STUDY, seed)
            found = outcome(seed, cause, diagnose(STUDY, data, session, solver=solver))
            write_text(path, json.dumps(found, indent=1) + "\n")
            common.say(f"{seed} {found['family']} {found['rms_over_noise']:.1f} sigma: "
                       f"{found['named']} {found['unknown']} {found['described']}")
    return [json.loads((folder / f"{seed:03d}.json").read_text(encoding="utf-8"))
            for seed in numbers]


def run(note: Note) -> None:
    """Note the rates of all cases."""
    found = run_cases(list(SEEDS))
    count = f"{len(found)} maps of magnets with a cause outside the catalogue"
    note("diagnosis.unknown_rate", float(np.mean([one["unknown"] is not None for one in found])),
         "ratio", count)
    note("diagnosis.false_names_per_case", float(np.mean([len(one["named"]) for one in found])),
         "names per case", count)


def main() -> None:
    """Run a part of the cases."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--part", type=int, nargs=2, default=(1, 1), metavar=("K", "N"))
    part, parts = parser.parse_args().part
    run_cases(list(SEEDS)[part - 1::parts])


if __name__ == "__main__":
    main()
