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
    from halbach_fe.report.ring_design import (
        answer,
        design_rows,
        design_summary,
        ring_rows,
        write_design,
    )
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    with common.session(arguments, study) as session:
        found = design_rings(study, session, region_of(arguments), arguments.seed)
    write_design(found, arguments.study.read_text(encoding="utf-8-sig"), arguments.output,
                 {"GetDP": session.getdp.version, **common.digests(
                     {"study file": arguments.study})})
    if arguments.json:
        common.print_json(design_summary(found))
    else:
        common.print_table(design_rows(found), f"Designs, by their field in {found.region.text}")
        common.print_table(ring_rows(found), "The rings of the best design")
        common.say(f"Study: {arguments.output / 'study.designed.toml'}")
        common.say_answer(arguments, answer(found), arguments.output / "design.html")
    return 0
