"""Find where a field map lies in the magnet, and the probe's axes.

Needs no first guess: every rotation by right angles and every place along the axis is tried, then
pose and probe are fitted together with the blocks. Numbers that a drawing leaves open can be fitted
too. Writes study.registered.toml (the study's own file with the instrument and these numbers),
registration.json, registration.html and its figure. A symmetric magnet allows several poses, all of
which are reported with their odds; the file has the most probable one.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from halbach_fe.cli import common
from halbach_fe.core.numbers import parse_number

if TYPE_CHECKING:
    from halbach_fe.inference.registration import OpenKey


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--measurements", type=Path, required=True, metavar="MAP",
                        help="measured field map (CSV or HDF5)")
    parser.add_argument("--fit", type=_open_key, action="append", default=[], metavar="KEY=SD",
                        help="a number of the study that is open, with its standard deviation, "
                        "such as array.remanence_T=0.02; can be given several times")


def _open_key(text: str) -> OpenKey:
    from halbach_fe.inference.registration import OpenKey

    key, _, sd = text.partition("=")
    try:
        value = parse_number(sd)
    except ValueError:
        value = math.nan
    if not key or not (0 < value < math.inf):
        raise argparse.ArgumentTypeError(
            f"must be KEY=SD with a positive number, such as array.remanence_T=0.02, not '{text}'")
    return OpenKey(key, value)


def run(arguments: argparse.Namespace) -> int:
    """Register the map, write the results, print a summary."""
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.registration import register
    from halbach_fe.measurement.field_map import read_map
    from halbach_fe.report.registration import (
        pose_table,
        registration_summary,
        sentences,
        write_registration,
    )
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    text = arguments.study.read_text(encoding="utf-8")
    data = read_map(arguments.measurements)
    with common.session(arguments) as session:
        found = register(build_magnet(study), data, session, open_keys=arguments.fit,
                         say=(lambda _: None) if arguments.json else common.say)
    write_registration(study, text, data, found, arguments.output, common.digests({
        "study file": arguments.study, "measurements": arguments.measurements}))
    if arguments.json:
        common.print_json(registration_summary(found))
        return 0
    for sentence in sentences(found):
        common.say(sentence)
    common.print_table(pose_table(found), "Where the map lies in the magnet")
    common.say(f"Report: {arguments.output / 'registration.html'}")
    return 0
