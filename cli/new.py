"""Write a commented study file to start from.

The file is a valid study, and a comment explains every key.
"""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Mapping

from halbach_fe.cli import common
from halbach_fe.core.errors import CommandLineError, must_be
from halbach_fe.magnets import new_magnet
from halbach_fe.study.template import OUTER_RADIUS, MagnetTemplate, write_new_study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    template = MagnetTemplate()
    parser.add_argument("study", type=common.path, metavar="STUDY", help="file to write (TOML)")
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
                        help=f"shape of the blocks (default: {template.shape})")
    strength.add_argument("--material", metavar="GRADE",
                        help="grade of the blocks, such as N42, in place of the remanence")
    rings.add_argument("--inner-radii-m", type=_radii, metavar="X,X,...", default=(),
                       help="inner radii of rings that differ, in the order of z; needs "
                       "--ring-length-m")
    rings.add_argument("--free-blocks", type=common.path, metavar="TABLE",
                       help="table of the blocks (CSV or HDF5), in place of rings")
    rings.add_argument("--cube-m", type=common.positive_number, metavar="X",
                       help="edge of cubes in rings on --radius-m; sets shape, radii and length")
    parser.add_argument("--radius-m", type=common.positive_number, metavar="X",
                        help="radius of the middles of the cubes of --cube-m")
    parser.add_argument("--iron-ring", action="store_true",
                        help="add an iron tube around the blocks")
    parser.add_argument("--steel", metavar="NAME",
                        help="steel of the iron tube, whose magnetization curve is known, such as "
                        "aisi_1010; adds the tube")
    parser.add_argument("--dsv-m", type=common.positive_number, metavar="X",
                        help="diameter of a spherical volume in the middle, on whose surface the "
                        "field is measured, and in which that of a dipole is to be homogeneous "
                        "(default: circles along the magnet)")


def _radii(text: str) -> tuple[float, ...]:
    """Return the radii in m of a list, or refuse it."""
    return tuple(map(common.positive_number, text.split(",")))


def run(arguments: argparse.Namespace) -> int:
    """Write the file and print the command that solves it."""
    given = {name: value for name, value in vars(arguments).items()
             if name in MagnetTemplate.__dataclass_fields__ and value}
    _check(given, arguments.radius_m)
    if "cube_m" in given:
        edge, radius = given["cube_m"], arguments.radius_m
        given |= {"shape": "cuboid", "ring_length_m": edge,
                  "inner_radius_m": round(radius - edge / 2, 9),
                  "outer_radius_m": round(radius + edge / 2, 9)}
    if "steel" in given:
        given["iron_ring"] = True
    inner = max([*given.get("inner_radii_m", ()), given.get("inner_radius_m", 0.0)])
    if inner:
        given.setdefault("outer_radius_m", round(OUTER_RADIUS * inner, 6))
    path, folder = arguments.study, arguments.study.parent
    if "free_blocks" in given:
        given["free_blocks"] = os.path.relpath(given["free_blocks"], folder)
    magnet, template = new_magnet(MagnetTemplate(**given), path.stem, folder)
    if template.dsv_m is not None:
        from halbach_fe.response.homogeneity import Region, region_points

        region_points(magnet, Region.sphere(template.dsv_m / 2))  # refuses one that is not in air
    write_new_study(path, template)
    name = str(path) if not str(path).startswith("-") else f"./{path}"
    common.say(f"Wrote {path}. Its noise suits the field of the magnet: "
               f"{1e6 * template.sigma_T:g} µT for a reading, {1e6 * template.position_sd_m:g} µm "
               f"for a position. Next: halbach-fe solve {shlex.quote(name)} -o DIR")
    return 0


def _check(given: Mapping[str, object], radius_m: float | None) -> None:
    """Refuse options that the study would not show beside others.

    Raises
    ------
    CommandLineError
    """
    if "inner_radii_m" in given and "ring_length_m" not in given:
        raise CommandLineError(must_be(
            "--ring-length-m", "the command line", "given with --inner-radii-m", "nothing",
            "Rings that follow each other along z have a length."))
    rings = given.get("rings")
    if isinstance(rings, int) and rings > 1 and not given.keys() & {
            "ring_length_m", "cube_m", "free_blocks"}:
        raise CommandLineError(must_be(
            "--ring-length-m", "the command line", "given with --rings", "nothing",
            "Rings that follow each other along z have a length."))
    if "dsv_m" in given and not given.keys() & {"ring_length_m", "cube_m", "free_blocks"}:
        raise CommandLineError(must_be(
            "--ring-length-m", "the command line", "given with --dsv-m", "nothing",
            "A cross-section has no volume."))
    edge = given.get("cube_m")
    if isinstance(edge, float) and radius_m is not None and not edge < 2 * radius_m:
        raise CommandLineError(must_be(
            "--cube-m", "the command line", f"less than twice --radius-m, {radius_m:g}, at which "
            "the cubes have their middles", f"{edge:g}", "Both are in metres."))
    if ("cube_m" in given) != (radius_m is not None):
        raise CommandLineError(must_be(
            "--radius-m", "the command line", "given together with --cube-m", "one of them",
            "Cubes have their middles at this radius."))
    of_table = given.keys() - {"free_blocks", "multipole_order", "iron_ring", "steel", "dsv_m"}
    for option, others, why in (
            ("free_blocks", of_table, "The table has it."),
            ("inner_radii_m", given.keys() & {"rings"}, "There is a ring of each radius."),
            ("cube_m", given.keys() & {"shape", "outer_radius_m", "ring_length_m"},
             "The cube has it.")):
        if option in given and others:
            raise CommandLineError(must_be(
                f"--{min(others).replace('_', '-')}", "the command line",
                f"left out with --{option.replace('_', '-')}", "both", why))
