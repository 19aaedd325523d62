"""Find where a field map lies in the magnet, and the probe's axes.

Needs no first guess: every rotation by right angles and every place along the axis is tried, then
pose and probe are fitted together with the blocks. Numbers that a drawing leaves open can be fitted
too, and sets of them are compared with --alternative. Writes study.registered.toml (the study's own
file with the instrument and these numbers), registration.json, registration.html and its figure. A
symmetric magnet allows several poses, all of which are reported with their odds; the file has the
most probable one, or of those between which the readings do not decide the one that is turned
least. If the study lists maps, they are registered one after the other, each in the
magnet as those before it have updated it, and each gets a folder with its own page.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from halbach_fe.cli import common
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.numbers import parse_number

if TYPE_CHECKING:
    import xarray as xr

    from halbach_fe.inference.pose_result import OpenKey, Registration
    from halbach_fe.study.measurement import Instrument
    from halbach_fe.study.model import Study


MOST_ACROSS_M = 10.0
"""Largest standard deviation of a map's distance from the axis: that of all lengths of a study."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    from halbach_fe.cli.format_options import add_map_format_arguments

    common.add_study_arguments(parser)
    add_map_format_arguments(parser, "--measurements")
    parser.add_argument("--measurements", type=common.input_file, metavar="MAP",
                        help="measured field map (CSV or HDF5), unless the study lists maps")
    parser.add_argument("--fit", type=_open_key, action=_DifferentKeys, default=[],
                        metavar="KEY=SD", help="a number of the study that is open, with its "
                        "standard deviation, such as array.remanence_T=0.02, or "
                        "instrument.z_scale=0.02 for the step of the map; can be given several "
                        "times")
    parser.add_argument("--alternative", type=_open_keys, action="append", default=[],
                        metavar="KEY=SD,...", help="other numbers that may be open in place of "
                        "those of --fit; their odds are compared; can be given several times")
    parser.add_argument("--most", type=common.positive, metavar="N",
                        help="largest number of poses that are fitted with the blocks (default: "
                        "4, or 8 on a line, of those that the search finds)")
    parser.add_argument("--across-m", metavar="SD",
                        type=common.within(common.positive_number, 0, MOST_ACROSS_M),
                        help="prior standard deviation of the map's distance from the axis, for a "
                        "map that does not determine it (default: the blocks' outer radius)")
    parser.add_argument("--turn-rad", metavar="SD",
                        type=common.within(common.positive_number, 0, math.pi / 2),
                        help="prior standard deviation of the map's turns from right angles, for a "
                        "map that does not determine them (default: 0.1)")


def _open_key(text: str) -> OpenKey:
    from halbach_fe.inference.pose_result import OpenKey

    key, _, sd = text.partition("=")
    try:
        value = parse_number(sd)
    except ValueError:
        value = math.nan
    if not key or not (0 < value < math.inf):
        raise argparse.ArgumentTypeError(
            f"must be KEY=SD with a positive number, such as array.remanence_T=0.02, not '{text}'")
    return OpenKey(key, value)


def _open_keys(text: str) -> list[OpenKey]:
    found = [_open_key(part.strip()) for part in text.split(",")]
    keys = [each.key for each in found]
    for key in keys:
        if keys.count(key) > 1:
            raise argparse.ArgumentTypeError(f"must name {key} once")
    return found


class _DifferentKeys(argparse.Action):
    """An option that can be given several times, for another key each time."""

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        before = getattr(namespace, self.dest)
        if any(each.key == values.key for each in before):
            raise argparse.ArgumentError(self, f"is given twice for {values.key}; leave one out")
        setattr(namespace, self.dest, [*before, values])


def run(arguments: argparse.Namespace) -> int:
    """Register the map, write the results, print a summary."""
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.pose_result import PosePrior
    from halbach_fe.inference.registration import register
    from halbach_fe.report.registration import registration_summary, write_registration
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    data = common.read_measurements(arguments, study)
    text = arguments.study.read_text(encoding="utf-8-sig")
    say: Callable[[str], None] = (lambda _: None) if arguments.json else common.say
    if isinstance(data, dict):
        for name in ("alternative", "most", "across_m", "turn_rad"):
            if getattr(arguments, name):
                option = f"--{name.replace('_', '-')}"
                raise StudyError(must_be(
                    option, "the command line", "left out for a study that lists several maps",
                    "given", "Register one of the maps alone with it."))
        return _run_campaign(arguments, study, text, data, say)
    pose = PosePrior(arguments.across_m, arguments.turn_rad or PosePrior.turn_rad)
    with common.session(arguments, study) as session:
        found = register(build_magnet(study), data, session, open_keys=arguments.fit,
                         alternatives=arguments.alternative, most=arguments.most, pose=pose,
                         say=say)
    write_registration(study, text, data, found, arguments.output, common.digests({
        "study file": arguments.study, "measurements": arguments.measurements}))
    if arguments.json:
        common.print_json(registration_summary(found))
        return 0
    _print(arguments, found, arguments.output / "registration.html", study.instrument)
    return 0


def _run_campaign(
    arguments: argparse.Namespace, study: Study, text: str, data: dict[str, xr.Dataset],
    say: Callable[[str], None],
) -> int:
    """Register all maps that the study lists."""
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.campaign_registration import register_maps, registered_study
    from halbach_fe.measurement.campaign import maps_of, with_paths_from
    from halbach_fe.report.registration import (
        NOMINAL,
        UPDATED,
        registration_summary,
        write_campaign_registration,
    )

    maps = maps_of(study, data)
    with common.session(arguments, study) as session:
        found = register_maps(build_magnet(study.with_(maps=())), maps, session, arguments.fit, say)
    registered = with_paths_from(registered_study(study, maps, found), arguments.study.parent,
                                 arguments.output)
    write_campaign_registration(registered, text, maps, found, arguments.output, common.digests(
        {"study file": arguments.study} | common.map_files(arguments, study)))
    if arguments.json:
        common.print_json({"maps": {name: registration_summary(poses)
                                    for name, poses in found.items()}})
        return 0
    for number, one in enumerate(maps):
        common.say(f"Map {one.name}:")
        _print(arguments, found[one.name], arguments.output / one.name / "registration.html",
               one.study.instrument, UPDATED if number else NOMINAL, one.name)
    return 0


def _print(arguments: argparse.Namespace, found: Sequence[Registration], page: Path,
           assumed: Instrument, *of_map: str) -> None:
    """Print what was found about one map, see `halbach_fe.report.registration.answer`."""
    from halbach_fe.report.registration import answer, place_table, pose_table, sentences

    for sentence in sentences(found):
        common.say(sentence)
    common.print_table(pose_table(found, *of_map[:1]), "Poses of the map")
    common.print_table(place_table(found), "Where the map lies in the magnet")
    common.say_answer(arguments, answer(found, *of_map, assumed=assumed), page)
