"""Estimate the error of a study's field: refinement, a farther boundary, the dual formulation.

Solves the nominal array at the study's positions on two coarser meshes, the study's own and a finer
one, with the boundary farther away, and by the dual formulation if the route has one. Writes
verification.json, verification.csv (changes of the field at every point), verification.html and
its figures.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    common.add_dry_run_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Estimate the error, write the results, print a summary."""
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.report.verification import page
    from halbach_fe.response.discretization_error import verify
    from halbach_fe.response.resource_estimate import estimate_verify
    from halbach_fe.study.reader import read_study

    magnet = build_magnet(read_study(arguments.study))
    if arguments.dry_run:
        return common.print_estimate(estimate_verify(magnet, common.jobs(arguments)),
                                     arguments.json)
    exact = magnet.is_vacuum and magnet.study.solver.method != "direct"
    with common.session(arguments, magnet.study) as session:
        verification = verify(magnet, session, say=lambda purpose: (
            None if exact else common.say(f"solving {purpose}")))
    return common.finish(arguments, page(verification))
