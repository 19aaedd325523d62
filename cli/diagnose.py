"""Find which effects a study lacks to explain measured field maps, and add them to the study.

If the study lists maps, all of them are diagnosed together: an effect of the magnet must explain
all maps, and one of an instrument is named with its map, or with the probe that maps share.

Writes diagnosis.html and its figures, diagnosis.json, and study.diagnosed.toml: the study's own
file with the identified effects added, which `halbach-fe solve` and `halbach-fe infer` can use
without further changes.
"""

from __future__ import annotations

import argparse
import difflib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from halbach_fe.cli import common
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.files import InputFile
from halbach_fe.study.types import COMPONENTS

if TYPE_CHECKING:
    import xarray as xr

    from halbach_fe.diagnosis.cost import DiagnosisEstimate
    from halbach_fe.diagnosis.effects.base import Effect
    from halbach_fe.diagnosis.result import Floor


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    from halbach_fe.cli.format_options import add_map_format_arguments

    common.add_study_arguments(parser, time_limit=False)
    common.add_dry_run_argument(parser)
    common.add_measurement_arguments(parser, several=True)
    common.add_held_out_argument(parser)
    add_map_format_arguments(parser, "--measurements and --held-out")
    parser.add_argument("--time-limit", dest="diagnosis_limit", type=common.positive_number,
                        metavar="SECONDS",
                        help="time in s after which the search ends with what it has so far; the "
                        "step under way is finished (default: none)")
    parser.add_argument("--check", action="append", metavar="[MAP=]JSON",
                        help="check.json of halbach-fe check for this map, whose model-free "
                        "floor is shown beside the results; for each map that the study lists, "
                        "with its name")
    parser.add_argument("--effects", type=effects_of, metavar="NAME,NAME...",
                        help="candidate effects (default: all effects of the catalogue)")


def effects_of(text: str) -> list[Effect]:
    """Parse a comma-separated list of names of effects."""
    from halbach_fe.diagnosis.effects import catalogue

    effect_by_name = {effect.name: effect for effect in catalogue()}
    for name in text.split(","):
        if name not in effect_by_name:
            near = difflib.get_close_matches(name, effect_by_name, 1, 0.5)
            raise argparse.ArgumentTypeError(
                f"no effect is called '{name}'"
                + (f"; did you mean {near[0]}?" if near
                   else f"; there are {', '.join(effect_by_name)}"))
    return [effect_by_name[name] for name in dict.fromkeys(text.split(","))]


def floor_of(path: Path, data: xr.Dataset) -> dict[str, float]:
    """Return the model-free floor in T by component from the check.json of a map.

    Raises
    ------
    MeasurementError
        If the file is not one of `halbach-fe check`, or belongs to another map.
    """
    from halbach_fe.measurement.field_map import readings_sha256

    try:
        found = json.loads(path.read_text("utf-8"))
        floor = [0.0 if value is None else float(value) for value in found["floor_T"]]
        maps = set(found["maps_sha256"].values())
    except OSError as error:
        raise MeasurementError(must_be("file --check", str(path), "a readable file",
                                       f"'{error.strerror}'", "Check the path.")) from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        floor, maps = [], set[str]()
    if len(floor) != len(COMPONENTS) or not all(0 <= value < math.inf for value in floor):
        raise MeasurementError(must_be(
            "file --check", str(path), "a check.json that `halbach-fe check` wrote",
            "a file without a floor of three components and the hashes of its maps"))
    if readings_sha256(data) not in maps:
        raise MeasurementError(must_be(
            "file --check", str(path), "that of the map that is diagnosed", "that of another map",
            "Run `halbach-fe check` with this map."))
    return {f"B{name}": value for name, value, own in zip(
        COMPONENTS, floor, found["floor_T"], strict=True) if own is not None}


def floors_of(
    given: Sequence[str] | None, data: xr.Dataset | dict[str, xr.Dataset]
) -> Floor | None:
    """Return the model-free floor of the map, or of each map that a study lists, by name.

    Raises
    ------
    MeasurementError
        If a file is not one of `halbach-fe check` or belongs to another map, or the names of the
        maps are not those of the study.
    """
    if not given:
        return None
    if not isinstance(data, dict) and len(given) == 1:
        return floor_of(InputFile(given[0]), data)
    maps = data if isinstance(data, dict) else {}
    pairs = [text.partition("=") for text in given]
    wrong = [text for text, (name, sign, _) in zip(given, pairs, strict=True)
             if not sign or name not in maps]
    if wrong or len({name for name, *_ in pairs}) < len(pairs):
        raise MeasurementError(must_be(
            "--check", "the command line", "given once for each map, as NAME=JSON" if maps
            else "given once, since there is one map", " ".join(wrong or given),
            f"The study's maps are {', '.join(maps)}." if maps else ""))
    return {name: floor_of(InputFile(path), maps[name]) for name, _, path in pairs}


def run(arguments: argparse.Namespace) -> int:
    """Diagnose, write the results, print a summary."""
    from halbach_fe.diagnosis.diagnose import diagnose
    from halbach_fe.diagnosis.discriminating_measurements import separations
    from halbach_fe.report.diagnosis import page
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    data = common.read_measurements(arguments, study)
    blocks, validation_map = common.blocks_and_held_out(arguments)
    floor = floors_of(arguments.check, data)
    if arguments.dry_run:
        from halbach_fe.diagnosis.cost import estimate_diagnosis

        return print_cost(estimate_diagnosis(study, data, blocks, arguments.effects,
                                             validation_map, common.jobs(arguments)),
                          arguments.json)
    # no process may take longer than GetDP's own limit, unless the whole diagnosis may
    arguments.time_limit = max(common.GETDP_LIMIT_S, arguments.diagnosis_limit or 0.0)
    with common.session(arguments, study) as session:
        diagnosis = diagnose(study, data, session, blocks, arguments.effects, validation_map,
                             common.say, floor_T=floor, time_limit_s=arguments.diagnosis_limit)
        separating = separations(diagnosis, data, session, arguments.effects)
    return common.finish(arguments, page(diagnosis, separating, study))


def print_cost(estimate: DiagnosisEstimate, as_json: bool) -> int:
    """Print what a diagnosis would solve; return 0."""
    if as_json:
        common.print_json(estimate.as_dict())
        return 0
    from halbach_fe.core.pace import duration
    from halbach_fe.response.resource_estimate import TIME_FACTOR

    common.print_estimate(estimate.update, as_json=False)
    rounds = estimate.as_dict()["rounds"]
    times = " to ".join(map(duration, (estimate.shortest_s, estimate.longest_s)))
    common.say(f"That is one round; a diagnosis that finds something takes {rounds[0]} to "
               f"{rounds[1]}. The first one compares {estimate.signatures} hypotheses, which need "
               f"{estimate.fields} more fields of whole magnets. In all {times}, within a factor "
               f"of about {TIME_FACTOR:g}.")
    return 0
