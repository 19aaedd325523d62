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
    from halbach_fe.report.verification import answer, difference_table, write_verification
    from halbach_fe.report.words import flux_density
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
    write_verification(magnet, verification, arguments.output, {
        "GetDP": session.getdp.version, "study file": common.digest(arguments.study)})
    if arguments.json:
        common.print_json(verification.plain())
    else:
        common.print_table(
            difference_table(verification),
            f"Changes of B in ppm of {flux_density(verification.main_field_T, 4)}, route "
            f"{verification.route.replace('_', ' ')}")
        common.say_answer(arguments, answer(verification), arguments.output / "verification.html")
    return 0
