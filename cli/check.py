"""Check a field map against Maxwell's equations, before any magnet.

Fits the map by a field of sources outside the mapped region together with the parameters of a
three-axis probe. Says which signs or exchanged axes make the map obey div B = 0 and curl B = 0,
where the sensors are, how the probe is turned, which rows are broken, and which noise remains: no
model of a magnet can explain the map any better. With an output folder, also writes check.json,
check.csv (the residual of every reading), check.html and its figures, oriented_map.csv, the
map without broken rows and with its components along the right axes, inner_map.csv, its region that
a field without sources describes, if it is not all, and corrected_map.csv, what a probe without
errors would have read. A map of one or two components is judged by what these show. Of a map of
|B| alone only rows that are broken, repeated places and noise are checked, and the folder has
check.json and check.html.

Several maps of one magnet are checked one by one and then joined: their relative poses follow from
where they overlap and from one field without sources for all, no magnet is assumed. Maps that
contradict each other are named. The folder then has joined.json (poses with their covariance),
joined.csv (all maps in the frame of the first one), joined.html, and a folder for each map.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from halbach_fe.cli import common
from halbach_fe.core.errors import CommandLineError, must_be

if TYPE_CHECKING:
    from halbach_fe.core.files import InputFile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    from halbach_fe.cli.format_options import add_map_format_arguments

    parser.add_argument("map", type=common.input_file, metavar="MAP",
                        help="field map (CSV, HDF5 or VTU)")
    parser.add_argument("others", type=common.input_file, metavar="MAP", nargs="*",
                        help="other maps of the same magnet, to be joined with the first one")
    parser.add_argument("-o", "--output", type=common.path, metavar="DIR",
                        help="folder for the page and its files")
    common.add_json_argument(parser)
    add_map_format_arguments(parser, "MAP")


def run(arguments: argparse.Namespace) -> int:
    """Check the map, or all and where they lie to each other; write and print the results."""
    from halbach_fe.measurement.field_map import is_total_field

    files = [arguments.map, *arguments.others]
    if arguments.others:
        arguments.listed_maps = _by_name(files)
    maps = [common.read_one(arguments, file) for file in files]
    if arguments.output is not None:  # before the check, which may take a minute
        common.own_folder(arguments, "halbach-fe check")
    say: Callable[[str], None] = (lambda _: None) if arguments.json else common.say
    with common.progress_bar("checking") as show:
        if arguments.others:
            from halbach_fe.measurement.map_join import join_maps
            from halbach_fe.report import map_join

            named = dict(zip(arguments.listed_maps, maps, strict=True))
            page = map_join.page(named, join_maps(named, say, show))
        elif is_total_field(maps[0]):
            from halbach_fe.measurement.total_check import check_total
            from halbach_fe.report import map_check

            page = map_check.total_page(maps[0], check_total(maps[0]))
        else:
            from halbach_fe.measurement.map_check import check_map
            from halbach_fe.report import map_check

            page = map_check.page(maps[0], check_map(maps[0], say, show))
    return common.finish(arguments, page)


def _by_name(files: list[InputFile]) -> dict[str, InputFile]:
    """Return the files by the names of their maps, which are those of the files or their folders.

    CommandLineError if that does not tell them apart.
    """
    for names in ([file.stem for file in files],
                  [f"{file.parent.name}_{file.stem}" for file in files]):
        if len(set(names)) == len(files):
            return dict(zip(names, files, strict=True))
    raise CommandLineError(must_be(
        "MAP", "command line", "maps of different names", " and ".join(map(str, files)),
        "Leave out the one that was given twice, or rename it."))
