"""Write the blocks and a holder for them as STEP and STL files, and the plan to assemble them.

The holder consists of plates with a pocket for every block; [holder] of the study says how they are
made. Writes blocks.step and blocks.stl, holder_NN.step and .stl for every different plate,
magnet.step with everything in its place, assembly.csv, assembly.json and assembly.html, a sheet to
print for every plate. Solids are in mm.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_and_output(parser)
    parser.add_argument("--blocks", type=common.input_file, metavar="CSV",
                        help="table of measured blocks in their places, whose serial numbers name "
                        "the blocks: the blocks.sorted.csv of halbach-fe sort")
    common.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Design the holder, write all files, print the answer and what to order and make."""
    from halbach_fe.design.assembly import cad
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.measurement.block_table import read_blocks
    from halbach_fe.report.assembly import page
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    blocks = read_blocks(arguments.blocks) if arguments.blocks else None
    common.own_folder(arguments, "halbach-fe cad", magnet.name)
    plan = cad(magnet, blocks)
    with common.progress_bar("solids") as show:
        return common.finish(arguments, page(plan, show))
