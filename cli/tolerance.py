"""Predict the multipoles, or the homogeneity, of magnets whose blocks are drawn from the prior.

It is the homogeneity in the region of the study's table [homogeneity], if there is one. With a
limit also the share of the magnets that meet it. Writes tolerance.json, tolerance.html and its
figures.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.core.numbers import DRAWS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--blocks", type=common.input_file, metavar="CSV",
                        help="measured moments of the single blocks, whose prior replaces the "
                        "study's")
    common.add_objective_arguments(parser)
    parser.add_argument("--draws", type=common.within(common.whole, *DRAWS), default=10_000,
                        metavar="N",
                        help="number of magnets to draw (default: %(default)s)")
    common.add_seed_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Draw magnets, write the results, print the quantiles."""
    from halbach_fe.api import tolerance
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.measurement.block_table import read_blocks
    from halbach_fe.report.tolerance import page
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    blocks = read_blocks(arguments.blocks) if arguments.blocks else None
    with common.session(arguments, magnet.study) as session:
        result = tolerance(magnet, session, blocks, common.reference(arguments), arguments.draws,
                           arguments.limit_units, arguments.seed, arguments.limit_ppm)
    return common.finish(arguments, page(result))
