"""Turn moments of single blocks, measured in a Helmholtz coil, into a prior.

Writes prior.h5 (mean and covariance), prior.json, prior.html and its figure. `halbach-fe infer
--blocks` uses the same prior directly.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_and_output(parser)
    parser.add_argument("blocks", type=common.input_file, metavar="BLOCKS",
                        help="table of measured blocks (CSV)")
    common.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Estimate the prior, write the results, print the table of types."""
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.block_prior import prior_from_blocks
    from halbach_fe.measurement.block_table import read_blocks
    from halbach_fe.report.prior import page
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    table = read_blocks(arguments.blocks)
    common.own_folder(arguments, "halbach-fe prior", magnet.study.name)
    prior = prior_from_blocks(magnet, table)
    return common.finish(arguments, page(magnet, prior))
