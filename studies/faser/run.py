"""The first FASER dipole: update the model with the published on-axis profile.

The profile is that of Fig. 4 of Fleig, Liebsch, Russenschuck and Schoeps (2023): B_x at 156
positions, published as an index without a coordinate. This script states where it puts them, runs
the inference, and prints its errors beside the published ones::

    python studies/faser/run.py -o results/faser
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from halbach_fe.cli import common

from halbach_fe.errors import HalbachError
from halbach_fe.field_map import field_map, read_map, write_map
from halbach_fe.report import Published, score_table, write_report
from halbach_fe.study import read_study
from halbach_fe.update import infer, write_update

HERE = Path(__file__).parent
Z_STEP_M = 0.010
ASSUMPTIONS = (
    "The profile is published by index, not by position. Here index i is at z = (i - 78.5) × "
    "{step_mm:g} mm: that step, and centred on the magnet. Neither is published.",
    "The 1.0 m magnet has 12 rings of 83.3 mm; the ring length is inferred.",
    "The nominal moment of 330 A m² per block, as published, gives a bore field some 2 % above "
    "the measured one; the prior allows 5 % for what all blocks share.",
    "No iron ring: what fills the envelope outside the blocks is not published.",
)


def profile_to_map(source: Path, target: Path, z_step: float) -> Published:
    """Write the published profile as a map; return the published relative errors."""
    index, prior, posterior, measured = np.loadtxt(source, delimiter=",", skiprows=1).T
    z = np.round((index - (len(index) + 1) / 2) * z_step, 9)
    points = np.column_stack([0 * z, 0 * z, z])
    flux_density = np.full((len(z), 3), np.nan)
    flux_density[:, 0] = measured
    write_map(field_map(points, flux_density, attributes={
        "source": "Fleig et al. 2023, Fig. 4", "assumed_z_step_m": str(z_step)}), target)
    return Published("paper", z, prior, posterior)


def main() -> int:
    """Run the study; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.set_defaults(study=HERE / "study.toml")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/faser"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--z-step-m", type=float, default=Z_STEP_M,
                        help="assumed distance of the readings (default: %(default)g m)")
    parser.add_argument("--time-limit", type=float, default=3600.0)
    common.add_getdp_argument(parser)
    arguments = parser.parse_args()
    try:
        published = profile_to_map(HERE / "fig4_faser_on_axis.csv",
                                   arguments.output / "measured.csv", arguments.z_step_m)
        common.say("FASER dipole: 576 unknown magnetizations, 156 readings. This takes minutes.")
        with common.workshop(arguments) as workshop:
            update = infer(read_study(arguments.study), read_map(arguments.output / "measured.csv"),
                           workshop)
        write_update(update, arguments.output)
        assumptions = [s.format(step_mm=1000 * arguments.z_step_m) for s in ASSUMPTIONS]
        write_report(update, arguments.output, published, assumptions)
    except HalbachError as error:
        common.say(f"error: {error}")
        return error.exit_code
    common.print_table(score_table(update, published),
                       "Median relative error of B_x on the axis, before and after the update")
    common.say(f"Report: {arguments.output / 'report.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
