"""Assign measured blocks to slots so that unwanted multipoles become small.

Blocks are sorted before the magnet is assembled. Each goes to a slot of its own type; the table may
have more blocks than there are slots. Writes blocks.sorted.csv, sort.json, sort.html and its
figures.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.core.files import InputFile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("blocks", type=InputFile, metavar="BLOCKS",
                        help="table of measured blocks (CSV); ring and slot may be missing")
    common.add_multipole_arguments(parser)
    common.add_seed_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Sort the blocks, write the results, print the multipoles."""
    from halbach_fe.api import sort
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.measurement.block_table import read_blocks
    from halbach_fe.report.sorting import order_table, sort_summary, write_sorted
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    table = read_blocks(arguments.blocks)
    with common.session(arguments, magnet.study) as session, common.progress_bar("sorting") as show:
        assignment = sort(magnet, table, session, common.reference(arguments), arguments.seed, show)
    write_sorted(assignment, arguments.limit_units, arguments.output)
    if arguments.json:
        common.print_json(sort_summary(assignment, arguments.limit_units))
    else:
        common.print_table(order_table(assignment), "Multipoles in units of 1e-4")
        common.say(f"Report: {arguments.output / 'sort.html'}")
    return 0
