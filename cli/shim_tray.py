"""Choose small magnets for the places of a shim tray so that the field becomes homogeneous.

The tray and its inventory are [shim_tray] of the study; the magnet is the measured one, whose
posterior halbach-fe infer wrote. Writes shim_tray.csv, the table to fill the tray from,
shim_tray.json, shim_tray.html and its figures.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from halbach_fe.cli import common
from halbach_fe.cli.homogeneity import add_region_arguments, region_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--posterior", type=common.input_file, metavar="H5", required=True,
                        help="posterior.h5 that halbach-fe infer wrote for this magnet")
    add_region_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fill the tray, write the results, print the answer and the table."""
    from halbach_fe.design.shim_tray import shim_tray
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.storage import read_posterior
    from halbach_fe.report.shim_tray import page
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    magnet, region = build_magnet(study), region_of(arguments)
    stored = read_posterior(magnet, arguments.posterior)
    with common.session(arguments, study) as session:
        found = replace(shim_tray(magnet, session, stored["posterior"], region),
                        disagreement=stored.disagreement)
    return common.finish(arguments, page(found))
