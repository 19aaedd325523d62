"""Find which effects a study lacks to explain a measured field map, and add them.

Writes diagnosis.html and its figures, diagnosis.json, and study.diagnosed.toml: the study's own
file with what was missing, which `solve` and `infer` run as it stands.
"""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from halbach_fe.cli import common
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect
from halbach_fe.measurement.block_table import read_blocks
from halbach_fe.measurement.field_map import read_map
from halbach_fe.study.model import Study
from halbach_fe.study.reader import read_study

if TYPE_CHECKING:
    from halbach_fe.diagnosis.discriminating_measurements import Separation
    from halbach_fe.diagnosis.result import Diagnosis


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    parser.add_argument("--measurements", type=Path, required=True, metavar="MAP",
                        help="measured field map (CSV or HDF5)")
    parser.add_argument("--held-out", type=Path, metavar="MAP",
                        help="another map, which is only predicted, at positions of its own")
    parser.add_argument("--blocks", type=Path, metavar="CSV",
                        help="moments of the single blocks, in place of the study's prior")
    parser.add_argument("--effects", type=effects_of, metavar="NAME,NAME...",
                        help="effects to choose from (default: the whole catalogue)")


def effects_of(text: str) -> list[Effect]:
    """Parse names of effects."""
    known = {effect.name: effect for effect in catalogue()}
    for name in text.split(","):
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            raise argparse.ArgumentTypeError(
                f"no effect is called '{name}'"
                + (f"; did you mean {near[0]}?" if near else f"; there are {', '.join(known)}"))
    return [known[name] for name in dict.fromkeys(text.split(","))]


def run(arguments: argparse.Namespace) -> int:
    """Diagnose, write everything, print what was found."""
    from halbach_fe.diagnosis.diagnose import diagnose
    from halbach_fe.diagnosis.discriminating_measurements import separations
    from halbach_fe.diagnosis.summary import diagnosis_summary

    study, data = read_study(arguments.study), read_map(arguments.measurements)
    text = arguments.study.read_text(encoding="utf-8")
    blocks = read_blocks(arguments.blocks) if arguments.blocks else None
    unseen = read_map(arguments.held_out) if arguments.held_out else None
    with common.session(arguments) as session:
        found = diagnose(study, data, session, blocks, arguments.effects, unseen, common.say)
        next_ones = separations(found, data, session, arguments.effects)
    write(found, next_ones, study, text, arguments.output)
    if arguments.json:
        common.print_json(diagnosis_summary(found, next_ones))
        return 0
    tell(found, arguments.output)
    return 0


def write(
    found: Diagnosis, next_ones: Sequence[Separation], study: Study, text: str, folder: Path,
    assumptions: Sequence[str] = (),
) -> None:
    """Write summary, report and the study, whose file is ``text``, with what it lacked."""
    from halbach_fe.diagnosis.summary import write_study, write_summary
    from halbach_fe.report.diagnosis import (
        write_diagnosis_report,  # matplotlib loads only when needed
    )

    write_summary(found, next_ones, folder)
    write_diagnosis_report(found, next_ones, folder, assumptions)
    write_study(text, study, found, folder)


def tell(found: Diagnosis, folder: Path) -> None:
    """Print what was found."""
    from halbach_fe.report.diagnosis import change_table, found_table, verdict

    common.say(" ".join(verdict(found)))
    if found.anything:
        common.print_table(found_table(found), "What the study lacks")
    common.print_table(change_table(found), "The model before and after")
    common.say(f"Report: {folder / 'diagnosis.html'}")
