"""Update a study's block magnetizations with a measured field map.

Writes posterior.h5, prediction.csv, summary.json, report.html and its figures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from halbach_fe.block_table import read_blocks
from halbach_fe.cli import common
from halbach_fe.field_map import read_map
from halbach_fe.study import read_study
from halbach_fe.update import infer, summary, write_update


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--measurements", type=Path, required=True, metavar="MAP",
                        help="measured field map (CSV or HDF5)")
    parser.add_argument("--blocks", type=Path, metavar="CSV",
                        help="moments of the single blocks, in place of the study's prior")


def run(arguments: argparse.Namespace) -> int:
    """Infer, write everything, print the before/after table."""
    from halbach_fe.report.inference import (  # matplotlib loads only when needed
        score_table,
        write_report,
    )

    study, data = read_study(arguments.study), read_map(arguments.measurements)
    blocks = read_blocks(arguments.blocks) if arguments.blocks else None
    with common.workshop(arguments) as workshop:
        update = infer(study, data, workshop, blocks)
    if update.response.reused:
        common.say("The response matrix of an earlier run in this folder fits and was reused.")
    write_update(update, arguments.output)
    write_report(update, arguments.output)
    if arguments.json:
        common.print_json(summary(update))
    else:
        common.print_table(score_table(update), "Median relative error, before and after")
        common.say(f"Report: {arguments.output / 'report.html'}")
    return 0
