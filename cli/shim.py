"""Choose blocks to swap, turn or replace: for small multipoles, or a homogeneous field.

It is a homogeneous field if the study has a table [homogeneity] with its region. The moves are
chosen from the posterior of the block magnetizations, which is computed as by `halbach-fe infer`.
Writes shim.json, shim.html and its figures, and study.shimmed.toml, the study with the blocks in
their new places.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.core.errors import StudyError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    from halbach_fe.cli.format_options import add_map_format_arguments

    common.add_study_arguments(parser)
    add_map_format_arguments(parser, "--measurements")
    parser.add_argument("--measurements", type=common.input_file, required=True, metavar="MAP",
                        help="measured field map (CSV or HDF5)")
    parser.add_argument("--blocks", type=common.input_file, metavar="CSV",
                        help="measured moments of the single blocks, whose prior replaces the "
                        "study's")
    common.add_objective_arguments(parser)
    parser.add_argument("--swaps", type=common.count, default=8, metavar="N",
                        help="largest number of swaps of two blocks (default: %(default)s)")
    parser.add_argument("--cycles", type=common.count, default=0, metavar="N",
                        help="largest number of cyclic exchanges of three blocks "
                        "(default: %(default)s)")
    parser.add_argument("--turns", type=common.count, default=8, metavar="N",
                        help="largest number of blocks turned in their slots "
                        "(default: %(default)s)")
    parser.add_argument("--replace", type=common.count, default=0, metavar="N",
                        help="largest number of blocks replaced by blocks of the stock, or without "
                        "--stock by new ones (default: %(default)s)")
    parser.add_argument("--stock", type=common.input_file, metavar="CSV",
                        help="table of measured blocks that may replace others: blocks "
                        "that are not in the magnet, without ring and slot")
    common.add_seed_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Infer, choose the moves, write the results, print moves and what they change."""
    from halbach_fe.api import shim
    from halbach_fe.design.objective import check_objective
    from halbach_fe.design.shimming import check_shimming, check_stock
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.infer import infer
    from halbach_fe.measurement.block_table import read_blocks
    from halbach_fe.measurement.campaign import refuse_several_maps
    from halbach_fe.report.shimming import page
    from halbach_fe.study.reader import read_study

    if arguments.stock and not arguments.replace:
        raise StudyError("Input --stock must go with --replace N, the number of blocks that may be "
                         "replaced; instead --replace is missing. Add --replace.")
    magnet = build_magnet(read_study(arguments.study))
    check_shimming(magnet.study)
    refuse_several_maps(magnet.study, "shim")
    data = common.read_one(arguments, arguments.measurements)
    blocks, _ = common.blocks_and_held_out(arguments)
    stock = read_blocks(arguments.stock) if arguments.stock else None
    # refuse before the solves, which may take long, what does not fit the study
    check_objective(magnet, common.reference(arguments), arguments.limit_units,
                    arguments.limit_ppm)
    if stock:
        check_stock(magnet, stock, blocks.serial if blocks else None)
    with common.session(arguments, magnet.study) as session:
        result = infer(magnet, data, session, blocks)
        moves = shim(result, session, common.reference(arguments), arguments.swaps,
                     arguments.turns, arguments.replace, arguments.limit_units, stock,
                     arguments.seed, arguments.limit_ppm, arguments.cycles)
    if result.disagreement:
        common.say(f"warning: Model and measurement disagree. {result.disagreement}")
    return common.finish(arguments, page(moves))
