"""Compute the field of a study's nominal magnet at the study's positions.

Iron with an H(B) curve is solved by Newton's method. Writes field_map.h5, field_map.csv and
field_map.vtu (for ParaView), readings.csv with the readings of the study, multipoles.csv if the
study's positions are circles, report.html, and the run folders of GetDP, which can be run by hand.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

from halbach_fe.cli import common
from halbach_fe.cli.streams import say
from halbach_fe.core.pace import duration

MANY = 10_000
"""Number of blocks above which the command says how far it is: it takes minutes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    common.add_dry_run_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Solve the field, write the results, print a summary."""
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.response.solution import solve, study_observation
    from halbach_fe.solver.formulation_choice import choose_route
    from halbach_fe.solver.session import newton_history
    from halbach_fe.study.reader import read_study

    started = time.monotonic()
    magnet = build_magnet(read_study(arguments.study))
    many = len(magnet.blocks) > MANY
    if arguments.dry_run or (many and not magnet.is_vacuum):
        from halbach_fe.response.resource_estimate import TIME_FACTOR, estimate_solve

        cost = estimate_solve(magnet, study_observation(magnet), common.jobs(arguments))
        if arguments.dry_run:
            return common.print_estimate(cost, arguments.json)
        say(f"{cost.blocks} blocks that magnetize each other, or iron: about "
            f"{duration(cost.seconds)}, within a factor of {TIME_FACTOR:g}, and "
            f"{cost.memory_GiB:.2g} GiB. {cost.warning or ''}")
    elif many:
        say(f"{len(magnet.blocks)} blocks: first their field at the positions and far outside.")
    with common.session(arguments, magnet.study) as session:
        solution = solve(magnet, session)
    seconds = round(time.monotonic() - started, 2)
    if many:
        say(f"Solved in {seconds} s; now its files and the page, which draws a part of the blocks.")
    from halbach_fe.report.solution import page

    summary: dict[str, object] = {"seconds": seconds, "output": str(arguments.output)}
    if magnet.is_nonlinear and choose_route(magnet, solution.points) != "moments":
        summary["newton_residuals"] = newton_history(arguments.output)
    made = page(solution)
    return common.finish(arguments, replace(
        made, summary={**made.summary, **summary},
        provenance={**made.provenance, "solved in": f"{seconds} s"}))
