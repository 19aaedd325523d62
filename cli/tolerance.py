"""Predict the multipoles of magnets whose blocks are drawn from the study's prior.

With --limit-units also the share of the magnets that meet the limit. Writes tolerance.json,
tolerance.html and its figures.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.core.files import InputFile

MOST_DRAWS = 1_000_000
"""Largest number of magnets. It determines a share of 1 % to 1 % of itself, and needs 1 GB for 100
multipoles."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--blocks", type=InputFile, metavar="CSV",
                        help="measured moments of the single blocks, whose prior replaces the "
                        "study's")
    common.add_multipole_arguments(parser)
    parser.add_argument("--draws", type=common.within(common.positive, 1, MOST_DRAWS),
                        default=10_000, metavar="N",
                        help="number of magnets to draw (default: %(default)s)")
    common.add_seed_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Draw magnets, write the results, print the quantiles."""
    from halbach_fe.api import tolerance
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.measurement.block_table import read_blocks
    from halbach_fe.report.tolerance import quantile_table, tolerance_summary, write_tolerance
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    blocks = read_blocks(arguments.blocks) if arguments.blocks else None
    with common.session(arguments, magnet.study) as session:
        result = tolerance(magnet, session, blocks, common.reference(arguments), arguments.draws,
                           arguments.limit_units, arguments.seed)
    write_tolerance(result, arguments.output)
    if arguments.json:
        common.print_json(tolerance_summary(result))
    else:
        common.print_table(quantile_table(result), "Multipoles |c_n| in units of 1e-4")
        if result.share is not None:
            common.say(f"{100 * result.share:.3g} % of the magnets are within the limit.")
        common.say(f"Report: {arguments.output / 'tolerance.html'}")
    return 0
