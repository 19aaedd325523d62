"""Write a commented study file to start from.

The file is a valid study, and a comment explains every key.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from halbach_fe.cli import common
from halbach_fe.study.template import MagnetTemplate, write_new_study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    template = MagnetTemplate()
    parser.add_argument("study", type=Path, metavar="STUDY", help="file to write (TOML)")
    strength = parser.add_mutually_exclusive_group()
    rings = parser.add_mutually_exclusive_group()
    groups = {"remanence-T": strength, "inner-radius-m": rings}
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
        groups.get(name, parser).add_argument(
                            f"--{name}", type=kind, metavar="N" if kind is common.positive else "X",
                            help=text if "default" in text or default is None
                            else f"{text} (default: {default})")
    parser.add_argument("--shape", choices=("sector", "trapezoid", "cuboid"),
                        default=template.shape,
                        help="shape of the blocks (default: %(default)s)")
    strength.add_argument("--material", metavar="GRADE",
                        help="grade of the blocks, such as N42, in place of the remanence")
    rings.add_argument("--inner-radii-m", type=_radii, metavar="X,X,...", default=(),
                       help="inner radii of rings that differ, in the order of z")
    rings.add_argument("--free-blocks", type=Path, metavar="TABLE",
                       help="table of the blocks (CSV or HDF5), in place of rings")
    parser.add_argument("--iron-ring", action="store_true",
                        help="add an iron tube around the blocks")


def _radii(text: str) -> tuple[float, ...]:
    """Return the radii in m of a list, or refuse it."""
    return tuple(map(common.positive_number, text.split(",")))


def run(arguments: argparse.Namespace) -> int:
    """Write the file and print the command that solves it."""
    given = {name: value for name, value in vars(arguments).items()
             if name in MagnetTemplate.__dataclass_fields__ and value is not None}
    inner = max([*given["inner_radii_m"], given.get("inner_radius_m", 0.0)])
    if inner:
        given.setdefault("outer_radius_m", round(1.8 * inner, 6))
    if "free_blocks" in given:
        given["free_blocks"] = os.path.relpath(given["free_blocks"], arguments.study.parent)
    write_new_study(arguments.study, MagnetTemplate(**given))
    common.say(f"Wrote {arguments.study}. Next: halbach-fe solve {arguments.study} -o DIR")
    return 0
