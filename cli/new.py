"""Write a commented study file to start from.

It is valid as it stands; every key says what it means.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from halbach_fe.cli import common
from halbach_fe.study.template import MagnetTemplate, write_new_study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    usual = MagnetTemplate()
    parser.add_argument("study", type=Path, metavar="STUDY", help="file to write (TOML)")
    for name, kind, what in (
            ("multipole-order", common.positive, "1 dipole, 2 quadrupole, ..."),
            ("blocks-per-ring", common.positive, "blocks in each ring"),
            ("rings", common.positive, "rings along z"),
            ("inner-radius-m", common.positive_number, "of the bore"),
            ("outer-radius-m", common.positive_number, "of the blocks (default: 1.8 times the "
             "inner one)"),
            ("ring-length-m", common.positive_number, "along z; without it the study is a "
             "cross-section"),
            ("remanence-T", common.positive_number, "of the blocks")):
        default = getattr(usual, name.replace("-", "_"))
        parser.add_argument(f"--{name}", type=kind, metavar="N" if kind is common.positive else "X",
                            help=what if "default" in what or default is None
                            else f"{what} (default: {default})")
    parser.add_argument("--shape", choices=("sector", "trapezoid", "cuboid"), default=usual.shape,
                        help="of the blocks (default: %(default)s)")
    parser.add_argument("--iron-ring", action="store_true", help="an iron tube around the blocks")


def run(arguments: argparse.Namespace) -> int:
    """Write the file and say what to do with it."""
    given = {name: value for name, value in vars(arguments).items()
             if name in MagnetTemplate.__dataclass_fields__ and value is not None}
    if "inner_radius_m" in given:
        given.setdefault("outer_radius_m", round(1.8 * given["inner_radius_m"], 6))
    write_new_study(arguments.study, MagnetTemplate(**given))
    common.say(f"Wrote {arguments.study}. Next: halbach-fe solve {arguments.study} -o DIR")
    return 0
