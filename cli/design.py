"""Search for the rings of a magnet whose field in a region is homogeneous.

The rings to choose from (radii, layers, sizes of blocks), the least field and the largest mass are
[design] of the study. Writes study.designed.toml, the study with the best rings, rings.csv,
design.json, design.html with the designs of larger fields, and its figures.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.cli.homogeneity import add_region_arguments, region_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    add_region_arguments(parser)
    common.add_seed_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Search, write the results, print the answer and the tables."""
    from halbach_fe.design.ring_design import design_rings
    from halbach_fe.report.ring_design import page
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    with common.session(arguments, study) as session:
        found = design_rings(study, session, region_of(arguments), arguments.seed)
    return common.finish(arguments, page(found))
