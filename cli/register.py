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
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from halbach_fe.cli import common
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.numbers import parse_number

if TYPE_CHECKING:
    import xarray as xr

    from halbach_fe.inference.pose_result import OpenKey
    from halbach_fe.study.model import Study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    # Largest standard deviation of a map's distance from the axis: that of all lengths of a study.
    most_across_m = 10.0
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
                        type=common.within(common.positive_number, 0, most_across_m),
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
    from halbach_fe.report.registration import page
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    data = common.read_measurements(arguments, study)
    say: Callable[[str], None] = (lambda _: None) if arguments.json else common.say
    if isinstance(data, dict):
        for name in ("alternative", "most", "across_m", "turn_rad"):
            if getattr(arguments, name):
                option = f"--{name.replace('_', '-')}"
                raise StudyError(must_be(
                    option, "the command line", "left out for a study that lists several maps",
                    "given", "Register one of the maps alone with it."))
        return _run_campaign(arguments, study, data, say)
    pose = PosePrior(arguments.across_m, arguments.turn_rad or PosePrior.turn_rad)
    with common.session(arguments, study) as session:
        found = register(build_magnet(study), data, session, open_keys=arguments.fit,
                         alternatives=arguments.alternative, most=arguments.most, pose=pose,
                         say=say)
    return common.finish(arguments, page(study, data, found))


def _run_campaign(
    arguments: argparse.Namespace, study: Study, data: dict[str, xr.Dataset],
    say: Callable[[str], None],
) -> int:
    """Register all maps that the study lists, each with a page in a folder of its own."""
    from halbach_fe.core.files import make_folder
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.campaign_registration import register_maps, registered_study
    from halbach_fe.measurement.campaign import maps_of
    from halbach_fe.report.page import write_changed_study, write_files
    from halbach_fe.report.registration import NOTE, STUDY_FILE, pages_of_maps

    maps = maps_of(study, data)
    with common.session(arguments, study) as session:
        found = register_maps(build_magnet(study.with_(maps=())), maps, session, arguments.fit, say)
    write_changed_study(arguments.output / STUDY_FILE,
                        [(registered_study(study, maps, found), NOTE)], arguments.study)
    pages = pages_of_maps(maps, found)
    paths = {name: write_files(page, make_folder(arguments.output / name))
             for name, page in pages.items()}
    if arguments.json:
        common.print_json({"maps": {name: page.summary for name, page in pages.items()}})
        return 0
    for name, page in pages.items():
        common.say(f"Map {name}:")
        common.say_page(arguments, page, paths[name])
    return 0
