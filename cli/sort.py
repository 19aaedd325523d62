"""Assign measured blocks to slots: for small multipoles, or a homogeneous field.

It is a homogeneous field if the study has a table [homogeneity] with its region.
Blocks are sorted before the magnet is assembled. Each goes to a slot of its own type; the table may
have more blocks than there are slots. Writes blocks.sorted.csv, sort.json, sort.html and its
figures.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from halbach_fe.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("blocks", type=common.input_file, metavar="BLOCKS",
                        help="table of measured blocks (CSV); ring and slot may be missing")
    common.add_objective_arguments(parser)
    parser.add_argument("--turns", action="store_true",
                        help="turn blocks in their slots too, where shape and nominal "
                        "magnetization allow it: cubes about their magnetization")
    common.add_seed_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Sort the blocks, write the results, print the multipoles."""
    from halbach_fe.api import sort
    from halbach_fe.design.objective import check_objective
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.measurement.block_table import read_blocks
    from halbach_fe.report.sorting import page
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    table = read_blocks(arguments.blocks)
    with common.session(arguments, magnet.study) as session, common.progress_bar("sorting") as show:
        check_objective(magnet, common.reference(arguments), arguments.limit_units,
                        arguments.limit_ppm)
        assignment = sort(magnet, table, session, common.reference(arguments), arguments.seed, show,
                          arguments.turns)
    return common.finish(arguments, page(replace(
        assignment, limit=arguments.limit_units or arguments.limit_ppm)))
