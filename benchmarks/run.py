"""Measure the figures that README and docs quote, in one run, and write benchmarks/results.json.

``make benchmark``. Ratios compare two ways of doing the same thing on the same machine, one after
the other; seconds are there to be read, not to be asserted. ``python -m benchmarks.run PART ...``
measures some parts and leaves the figures of the others as they are, each with its date.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
from pathlib import Path

from benchmarks import (
    calibration,
    campaign_kinds,
    design,
    diagnosis,
    front,
    inference,
    iron3d,
    iron_any,
    moments,
    mri,
    nonlinear,
    real,
    recipe,
    recovery,
    response,
    scaling,
    speed,
    suspicion,
    unknown,
)
from halbach_fe.cli import common
from halbach_fe.core.files import write_text

RESULTS = Path(__file__).parent / "results.json"
PARTS = {"response": response.run, "nonlinear": nonlinear.run,
         "inference": inference.run, "diagnosis": diagnosis.run, "recovery": recovery.run,
         "recipe": recipe.run,
         "scaling": scaling.run, "moments": moments.run, "iron3d": iron3d.run,
         "iron_any": iron_any.run, "iron_undulator": iron_any.run_undulator,
         "iron_times": iron_any.run_times,
         "iron_columns": iron_any.columns, "team13": iron_any.team13,
         "calibration": calibration.run, "check": calibration.instrument,
         "joined": calibration.joined, "joined_lacking": calibration.joined_lacking,
         "unknown": unknown.run,
         "suspicion": suspicion.run,
         "campaign_kinds": campaign_kinds.run, "campaign_knee": campaign_kinds.run_knee,
         "real": real.emphatic, "overlap": real.overlap, "real_mri": real.mri, "faser": real.faser,
         "design": design.run, "mri": mri.run, "first_field": front.first_field,
         "no_root": front.no_root, "speed": speed.run, "speed_small": speed.small,
         "speed_full": speed.full, "speed_permeability": speed.permeability,
         "speed_solvers": speed.solvers, "speed_waiting": speed.waiting,
         "speed_quadrupole": speed.quadrupole, "speed_growth": speed.growth}
ALONE = ("recovery", "recipe", "scaling", "moments", "iron3d", "iron_any", "iron_undulator",
         "iron_times", "iron_columns", "team13", "calibration", "check", "joined", "joined_lacking",
         "overlap", "unknown", "suspicion",
         "campaign_kinds", "campaign_knee", "real", "real_mri", "faser",
         "design", "mri", "first_field", "no_root", "speed", "speed_small", "speed_full",
         "speed_permeability",
         "speed_solvers", "speed_waiting", "speed_quadrupole", "speed_growth")
"""Parts that are measured only when they are named: they take long."""


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART",
                        help=f"of {', '.join(PARTS)} (default: all but {', '.join(ALONE)})")
    chosen = parser.parse_args().parts or [part for part in PARTS if part not in ALONE]
    results = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}

    def note(name: str, value: float, unit: str, against: str) -> None:
        rounded = float(f"{value:.{6 if unit == 'mm' else 3}g}")  # a place of 252 mm, to 1 µm
        results[name] = {
            "value": rounded, "unit": unit, "compared_with": against,
            "date": datetime.date.today().isoformat(),
            "machine": f"{platform.machine()}, {os.cpu_count()} cores"}
        common.say(f"{name} = {rounded:g} {unit}")

    for part in chosen:
        PARTS[part](note)
        # a run of hours that is interrupted keeps the parts that it has finished
        write_text(RESULTS, json.dumps(results, indent=1) + "\n")
    common.print_table([{"name": name} | {key: str(value) for key, value in entry.items()}
                        for name, entry in results.items()])


if __name__ == "__main__":
    main()
