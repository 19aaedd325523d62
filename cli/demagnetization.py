"""Map how near the blocks are to the knee of their demagnetization curve when they are hot.

The study's table `demagnetization` states coercivity, coefficients and temperature of the material.
Writes demagnetization.html and its figures, demagnetization.json, demagnetization.csv (a row per
block) and demagnetization.vtu (cells, for ParaView).
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.core.numbers import ACROSS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--across", type=common.within(common.whole, *ACROSS), metavar="N",
                        help="cells across the thickness of a block (default: 6)")


def run(arguments: argparse.Namespace) -> int:
    """Compute the map, write the results, print the blocks with the smallest margin."""
    from halbach_fe.design.demagnetization import ACROSS, demagnetization_map
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.report.demagnetization import page
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    with common.session(arguments, magnet.study) as session:
        result = demagnetization_map(magnet, session, arguments.across or ACROSS)
    return common.finish(arguments, page(result))
