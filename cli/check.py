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
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from halbach_fe.cli import common

if TYPE_CHECKING:
    import xarray as xr


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    from halbach_fe.cli.format_options import add_map_format_arguments

    parser.add_argument("map", type=common.input_file, metavar="MAP",
                        help="field map (CSV, HDF5 or VTU)")
    parser.add_argument("-o", "--output", type=common.path, metavar="DIR",
                        help="folder for the page and its files")
    common.add_json_argument(parser)
    add_map_format_arguments(parser, "MAP")


def run(arguments: argparse.Namespace) -> int:
    """Check the map, write the results, print a summary."""
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
