"""Compute how homogeneous the field of a magnet is in a region, in ppm and with error bars.

The region is a sphere, an ellipsoid or a cylinder: by default that of the study's table
[homogeneity], or else the sphere about the centre of the magnet of half the radius of the bore.
With --posterior the magnet is the measured one, otherwise those that the study's prior allows.
With --measurements the homogeneity of the map itself is beside it, of a harmonic fit of its
readings.
Writes homogeneity.json, harmonics.csv if the region is a sphere, homogeneity.html and its
figures.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from halbach_fe.cli import common
from halbach_fe.core.numbers import HIGHEST_DEGREE

if TYPE_CHECKING:
    from halbach_fe.response.homogeneity import Region


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    from halbach_fe.cli.format_options import add_map_format_arguments

    common.add_study_arguments(parser)
    add_map_format_arguments(parser, "--measurements")
    parser.add_argument("--posterior", type=common.input_file, metavar="H5",
                        help="posterior.h5 that halbach-fe infer wrote for this study")
    parser.add_argument("--measurements", type=common.input_file, metavar="MAP",
                        help="measured map, whose own homogeneity is shown beside the magnet's")
    add_region_arguments(parser)
    parser.add_argument("--degrees", type=int, choices=range(1, HIGHEST_DEGREE + 1), metavar="L",
                        help=f"largest degree of the spherical harmonics, 1 to {HIGHEST_DEGREE} "
                        "(default: 6)")


def add_region_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that describe a region, see `region_of`."""
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument("--sphere-m", type=common.positive_number, metavar="R",
                       help="radius of the sphere in m (default: the study's region, or half the "
                       "radius of the bore)")
    shape.add_argument("--ellipsoid-m", type=common.positive_number, nargs=3,
                       metavar=("A", "B", "C"), help="half axes along x, y and z in m")
    shape.add_argument("--cylinder-m", type=common.positive_number, nargs=2,
                       metavar=("R", "LENGTH"), help="radius and length along z in m")
    parser.add_argument("--centre-m", type=common.finite_number, nargs=3, metavar=("X", "Y", "Z"),
                        default=(0.0, 0.0, 0.0), help="centre of the region in m (default: 0 0 0)")


def region_of(arguments: argparse.Namespace) -> Region | None:
    """Return the region that the options describe; None for the default one.

    Raises
    ------
    StudyError
        If only its centre is given.
    """
    from halbach_fe.core.errors import StudyError, must_be
    from halbach_fe.response.homogeneity import Region

    region = Region.of(arguments.sphere_m, arguments.ellipsoid_m, arguments.cylinder_m,
                       arguments.centre_m)
    if region is None and any(arguments.centre_m):
        raise StudyError(must_be("--centre-m", "the command line", "beside a region",
                                 "given alone", "Add --sphere-m R."))
    return region


def run(arguments: argparse.Namespace) -> int:
    """Compute the homogeneity, write the results, print the answer and the tables."""
    from halbach_fe.api import homogeneity
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.storage import read_posterior
    from halbach_fe.report.homogeneity import page
    from halbach_fe.response.homogeneity import SHOWN_DEGREES
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    magnet, region = build_magnet(study), region_of(arguments)
    posterior = read_posterior(magnet, arguments.posterior) if arguments.posterior else None
    data = (common.read_one(arguments, arguments.measurements) if arguments.measurements
            else None)
    with common.session(arguments, study) as session:
        found = homogeneity(magnet, session, region, posterior,
                            arguments.degrees or SHOWN_DEGREES, data)
    return common.finish(arguments, page(found))
