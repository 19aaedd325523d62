"""Choose the positions whose readings carry most information about the block magnetizations.

If the study has a table [homogeneity], they tell most about the deviation of |B| in its region.
Positions are added one at a time from the study's plan.candidates (default: the positions that the
study measures). Their information is compared with that of the study's positions. Writes plan.csv,
plan.json, plan.html and its figures.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--points", type=common.positive, metavar="N",
                        help="number of positions to choose (default: the study's plan.points)")


def run(arguments: argparse.Namespace) -> int:
    """Choose the positions, write the results, print a summary."""
    from halbach_fe.design.measurement_plan import plan_measurement
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.report.plan import page
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    with common.session(arguments, magnet.study) as session:
        plan = plan_measurement(magnet, session, arguments.points)
    return common.finish(arguments, page(plan))
