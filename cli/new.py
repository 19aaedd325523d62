"""Write a commented study file to start from.

The file is a valid study, and a comment explains every key.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from halbach_fe.cli import common
from halbach_fe.study.template import MagnetTemplate, write_new_study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    template = MagnetTemplate()
    parser.add_argument("study", type=Path, metavar="STUDY", help="file to write (TOML)")
    for name, kind, text in (
            ("multipole-order", common.positive, "main multipole: 1 dipole, 2 quadrupole, ..."),
            ("blocks-per-ring", common.positive, "number of blocks in each ring"),
            ("rings", common.positive, "number of rings along z"),
            ("inner-radius-m", common.positive_number, "inner radius of the blocks"),
            ("outer-radius-m", common.positive_number, "outer radius of the blocks (default: 1.8 "
             "times the inner radius)"),
            ("ring-length-m", common.positive_number, "length of a ring along z; without it the "
             "study is a cross-section"),
            ("remanence-T", common.positive_number, "remanence of the blocks")):
        default = getattr(template, name.replace("-", "_"))
        parser.add_argument(f"--{name}", type=kind, metavar="N" if kind is common.positive else "X",
                            help=text if "default" in text or default is None
                            else f"{text} (default: {default})")
    parser.add_argument("--shape", choices=("sector", "trapezoid", "cuboid"),
                        default=template.shape,
                        help="shape of the blocks (default: %(default)s)")
    parser.add_argument("--iron-ring", action="store_true",
                        help="add an iron tube around the blocks")


def run(arguments: argparse.Namespace) -> int:
    """Write the file and print the command that solves it."""
    given = {name: value for name, value in vars(arguments).items()
             if name in MagnetTemplate.__dataclass_fields__ and value is not None}
    if "inner_radius_m" in given:
        given.setdefault("outer_radius_m", round(1.8 * given["inner_radius_m"], 6))
    write_new_study(arguments.study, MagnetTemplate(**given))
    common.say(f"Wrote {arguments.study}. Next: halbach-fe solve {arguments.study} -o DIR")
    return 0
