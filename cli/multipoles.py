"""Compute the multipoles of a magnet, with their standard deviations.

With --posterior they are those of the measured magnet, otherwise those that the study's prior
predicts. A 3D magnet has two tables: of the field integrated along z, and of the circle at --at-z-m
(default: the middle of the magnet). Writes multipoles.csv, multipoles.json, multipoles.html and its
figures.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--posterior", type=common.input_file, metavar="H5",
                        help="posterior.h5 that halbach-fe infer wrote for this study")
    common.add_multipole_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Compute the multipoles, write the results, print the tables."""
    from halbach_fe.api import multipoles
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.storage import read_posterior
    from halbach_fe.report.multipoles import (
        multipole_rows,
        multipoles_summary,
        place_of,
        write_multipoles,
    )
    from halbach_fe.study.reader import read_study

    study, limit = read_study(arguments.study), arguments.limit_units
    magnet = build_magnet(study)
    posterior = read_posterior(magnet, arguments.posterior) if arguments.posterior else None
    with common.session(arguments, study) as session:
        found = multipoles(magnet, session, common.reference(arguments), posterior)
    tables = found.tables
    answer = write_multipoles(study, tables, limit, arguments.output, {
        "GetDP": session.getdp.version, **common.digests(
            {"study file": arguments.study, "posterior": arguments.posterior})},
        found.disagreement, found.left_out)
    if arguments.json:
        common.print_json(multipoles_summary(study, tables, limit))
    else:
        for model, columns in tables:
            common.print_table(multipole_rows(columns), "Multipoles in units of 1e-4, " + (
                "integrated along z" if model.integrated else
                "of the cross-section" if model.z is None else f"on {place_of(model)}"))
        common.say_answer(arguments, answer, arguments.output / "multipoles.html")
    return 0
