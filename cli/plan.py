"""Choose where to measure: the positions that tell most about the block magnetizations.

Takes them one by one from the study's plan.candidates (default: its own positions) and compares
them with the study's positions. Writes plan.csv, plan.json, plan.html and its figures.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--points", type=common.positive, metavar="N",
                        help="positions to choose (default: the study's plan.points)")


def run(arguments: argparse.Namespace) -> int:
    """Plan, write everything, print a summary."""
    from halbach_fe.design.measurement_plan import plan_measurement
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.report.plan import plan_summary, write_plan  # matplotlib loads when needed
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    with common.session(arguments) as session:
        found = plan_measurement(magnet, session, arguments.points)
    write_plan(magnet, found, arguments.output)
    if arguments.json:
        common.print_json(plan_summary(found))
    else:
        common.print_table([{"what": key, "value": str(value)}
                            for key, value in plan_summary(found).items()])
        common.say(f"Report: {arguments.output / 'plan.html'}")
    return 0
