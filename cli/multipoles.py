"""Compute the multipoles of a magnet, with their standard deviations.

With --posterior they are those of the measured magnet, otherwise those that the study's prior
predicts. A 3D magnet has two tables: of the field integrated along z, and of the circle at --at-z-m
(default: the middle of the magnet). Writes multipoles.csv, multipoles.json, multipoles.html and its
figures.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

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
    from halbach_fe.report.multipoles import page
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    magnet = build_magnet(study)
    posterior = read_posterior(magnet, arguments.posterior) if arguments.posterior else None
    with common.session(arguments, study) as session:
        found = multipoles(magnet, session, common.reference(arguments), posterior)
    return common.finish(arguments, page(replace(found, limit=arguments.limit_units)))
