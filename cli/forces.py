"""Compute forces and torques on every block, in place and while the magnet is assembled.

Each block is looked at twice: with all others in place, and as the next one to be inserted, with
the blocks before it in place (by default ring by ring, slot by slot). Writes forces.csv,
forces.json, forces.html and its figure, with the mass of the magnet.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.core.numbers import DENSITY


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--order", type=common.input_file, metavar="CSV",
                        help="table whose column block names the blocks in the order in which they "
                        "are inserted (default: ring by ring, slot by slot)")
    parser.add_argument("--density-kg-per-m3", type=_density, metavar="D",
                        help="density of the blocks (default: that of their grade, or 7500)")
    parser.add_argument("--price-per-kg", type=common.positive_number, metavar="P",
                        help="price of the blocks per kg, in any currency")


def _density(text: str) -> float:
    """Parse a density in kg/m^3, or refuse one that no magnet has: 7.5 is one in g/cm^3."""
    try:
        return common.within(common.finite_number, *DENSITY)(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; 7.5 g/cm^3 are 7500 kg/m^3") from None


def run(arguments: argparse.Namespace) -> int:
    """Compute the forces, write the results, print the answer and the largest forces."""
    from halbach_fe.design.forces import forces
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.measurement.block_table import read_order
    from halbach_fe.report.forces import page
    from halbach_fe.solver.separate_blocks import present_blocks
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    names = [block.name for block in present_blocks(magnet.blocks)]
    order = read_order(arguments.order, names) if arguments.order else None
    with common.session(arguments, magnet.study) as session:
        found = forces(magnet, session, order, arguments.density_kg_per_m3,
                       arguments.price_per_kg)
    return common.finish(arguments, page(found))
