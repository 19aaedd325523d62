"""A low-field MRI magnet of 3 009 cubes, from the wish to the shimmed magnet.

Every stage is a command of halbach-fe: rings are designed, tolerances foretold, delivered cubes
measured one by one and sorted, the magnet mapped, updated and diagnosed, and a shim tray filled.
The delivery and the map are simulated by magpylib; in the map one ring is displaced, of which the
study says nothing. One page links all results::

    python studies/mri/run.py -o results/mri
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

from halbach_fe.cli import common, main
from halbach_fe.measurement.block_table import write_blocks
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.simulate import simulate_delivery

HERE = Path(__file__).parent

SEED = 1
"""Of the delivered cubes, and of the noise of the map."""

HIDDEN = "ring_shifted=23,8e-4,-5e-4"
"""The inner ring beside the middle, displaced in x and y by so many metres."""

DRAWS = 2000
"""Of magnets within the tolerances: the rms that 95 % of them keep is known to 3 %."""


def stages(folder: Path, study: Path) -> dict[str, Callable[[], int]]:
    """Return what each stage does, by its name; each returns an exit code."""
    designed = folder / "design" / "study.designed.toml"
    delivered, placed = folder / "delivered.csv", folder / "sort" / "blocks.sorted.csv"
    diagnosed = folder / "diagnosis" / "study.diagnosed.toml"
    readings = ["--measurements", folder / "campaign" / "map.csv", "--blocks", placed,
                "--held-out", folder / "campaign" / "held-out.csv"]

    def deliver() -> int:
        write_blocks(simulate_delivery(read_study(designed), SEED), delivered)
        return 0

    def stage(verb: str, name: str, *arguments: object) -> Callable[[], int]:
        return lambda: main([verb, *map(str, arguments), "-o", str(folder / name)])

    return {
        "design": stage("design", "design", study),
        "tolerance": stage("tolerance", "tolerance", designed, "--draws", DRAWS),
        "delivery": deliver,
        "sort": stage("sort", "sort", designed, delivered),
        "cad": stage("cad", "cad", designed, "--blocks", placed),
        "map": stage("simulate-measurement", "campaign", designed, "--seed", SEED, "--placed",
                     placed, "--hide", HIDDEN),
        "infer": stage("infer", "inferred", designed, *readings),
        "diagnose": stage("diagnose", "diagnosis", designed, *readings),
        "infer again": stage("infer", "improved", diagnosed, *readings),
        "shim tray": stage("shim-tray", "shim-tray", diagnosed, "--posterior",
                           folder / "improved" / "posterior.h5"),
        "report": stage("report", "report.html", *(folder / name for name in (
            "design", "tolerance", "sort", "cad", "campaign", "inferred", "diagnosis", "improved",
            "shim-tray"))),
    }


def run(folder: Path, study: Path) -> int:
    """Run all stages and print their seconds; stop at the first that fails."""
    rows = []
    for name, stage in stages(folder, study).items():
        began, used = perf_counter(), sum(os.times()[:4])
        code = stage()
        rows.append({"stage": name, "seconds": f"{perf_counter() - began:.0f}",
                     "processor seconds": f"{sum(os.times()[:4]) - used:.0f}"})
        if code:
            return code
    common.print_table(rows, "What the stages took")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("study", type=Path, nargs="?", default=HERE / "study.toml")
    parser.add_argument("-o", "--output", type=Path, default=Path("results", "mri"))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    sys.exit(run(arguments.output, arguments.study))
