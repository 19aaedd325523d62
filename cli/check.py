"""Check a field map against Maxwell's equations, before any magnet.

Fits the map by a field of sources outside the mapped region together with the parameters of a
three-axis probe. Says which signs or exchanged axes make the map obey div B = 0 and curl B = 0,
where the sensors are, how the probe is turned, which rows are broken, and which noise remains: no
model of a magnet can explain the map any better. With an output folder, also writes check.json,
check.csv (the residual of every reading), check.html and its figures, oriented_map.csv, the
map without broken rows and with its components along the right axes, inner_map.csv, its region that
a field without sources describes, if it is not all, and corrected_map.csv, what a probe without
errors would have read. Of a map of |B| alone only rows that are broken, repeated
places and noise are checked, and the folder has check.json alone.

Several maps of one magnet are checked one by one and then joined: their relative poses follow from
where they overlap and from one field without sources for all, no magnet is assumed. Maps that
contradict each other are named. The folder then has joined.json (poses with their covariance),
joined.csv (all maps in the frame of the first one), joined.html, and a folder for each map.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from halbach_fe.cli import common
from halbach_fe.core.errors import CommandLineError, must_be

if TYPE_CHECKING:
    import xarray as xr

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
    """Check the map, write the results, print a summary."""
    if arguments.others:
        return _join(arguments)
    from halbach_fe.measurement.field_map import is_total_field
    from halbach_fe.measurement.map_check import check_map
    from halbach_fe.report.map_check import (
        answer,
        check_summary,
        instrument_table,
        sentences,
        write_map_check,
    )

    data = common.read_one(arguments, arguments.map)
    if arguments.output is not None:  # before the check, which may take a minute
        common.own_folder(arguments, "halbach-fe check")
    if is_total_field(data):
        return _check_total(arguments, data)
    with common.progress_bar("checking") as show:
        check = check_map(data, (lambda _: None) if arguments.json else common.say, show)
    if arguments.output is not None:
        write_map_check(data, check, arguments.output, {
            "map": common.digest(arguments.map)})
    if arguments.json:
        common.print_json(check_summary(data, check))
        return 0
    for sentence in sentences(check):
        common.say(sentence)
    common.print_table(instrument_table(check), "The instrument, by the map alone")
    common.say_answer(arguments, answer(check),
                      None if arguments.output is None else arguments.output / "check.html")
    return 0


def _check_total(arguments: argparse.Namespace, data: xr.Dataset) -> int:
    """Check a map of |B| alone, which has no page."""
    from halbach_fe.measurement.total_check import check_total
    from halbach_fe.report.map_check import total_answer, total_sentences, write_total_check

    check = check_total(data)
    if arguments.output is not None:
        write_total_check(data, check, arguments.output)
    if arguments.json:
        common.print_json(check.plain())
        return 0
    for sentence in total_sentences(check):
        common.say(sentence)
    common.say_answer(arguments, total_answer(check),
                      None if arguments.output is None else arguments.output / "check.json")
    return 0


def _join(arguments: argparse.Namespace) -> int:
    """Check several maps, and find where they lie to each other."""
    from halbach_fe.measurement.map_join import join_maps
    from halbach_fe.report.map_join import answer, pose_table, sentences, term_table, write_joined

    files = [arguments.map, *arguments.others]
    arguments.listed_maps = _by_name(files)
    maps = {name: common.read_one(arguments, file)
            for name, file in arguments.listed_maps.items()}
    if arguments.output is not None:
        common.own_folder(arguments, "halbach-fe check")
    with common.progress_bar("checking") as show:
        joined = join_maps(maps, (lambda _: None) if arguments.json else common.say, show)
    if arguments.output is not None:
        write_joined(maps, joined, arguments.output, common.digests(
            {f"map {name}": file for name, file in arguments.listed_maps.items()}))
    if arguments.json:
        common.print_json(joined.plain())
        return 0
    for sentence in sentences(joined):
        common.say(sentence)
    common.print_table(pose_table(joined), "Where the maps lie in the frame of the first one")
    common.print_table(term_table(joined), "The instrument, by all maps together")
    common.say_answer(arguments, answer(joined),
                      None if arguments.output is None else arguments.output / "joined.html")
    return 0


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
