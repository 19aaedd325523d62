"""Explain a field map: whether it is sound, where it lies, of what magnet it is, what is missing.

Runs the commands that lead from a map to the magnet that was measured, each as far as it is
needed: check (does the map obey Maxwell's equations?), infer (update the magnet), and where the
update does not explain the map register (where does the map lie?) and diagnose (what does the study
lack?), with a new update after each. Says every command line, so that any of them can be run again
by itself. Writes the folders check, inferred, registered, updated, diagnosed and explained, as far
as there are such, and explanation.html, which joins their pages.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from halbach_fe.cli import common
from halbach_fe.core.errors import MeasurementError, StudyError, must_be
from halbach_fe.core.files import InputFile

if TYPE_CHECKING:
    from halbach_fe.report.answer import Answer

PAGE = "explanation.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    from halbach_fe.cli.format_options import add_map_format_arguments

    common.add_study_arguments(parser)
    parser.add_argument("map", type=common.input_file, metavar="MAP",
                        help="measured field map (CSV, HDF5, or any that import-map reads)")
    parser.add_argument("--blocks", type=common.input_file, metavar="CSV",
                        help="measured moments of the single blocks")
    common.add_held_out_argument(parser)
    add_map_format_arguments(parser, "MAP and --held-out")


@dataclass
class _Explanation:
    """The commands that were run, and the study and map with which the next one goes on."""

    arguments: argparse.Namespace
    study: Path
    map: Path
    folders: list[Path] = field(default_factory=list)

    def run(self, verb: str, folder: str, *names: Path) -> Answer:
        """Run a command into a folder, with the options of this one that it has, and return what
        its page says.
        """
        from halbach_fe.cli.verbs import module_of, parser
        from halbach_fe.report.page_record import PAGE_RECORD, PageRecord

        output = self.arguments.output / folder
        words = [verb, *map(str, names), "-o", str(output)]
        if verb != "check":
            words += ["--measurements", str(self.map)]
        common.say(f"\nhalbach-fe {shlex.join(words)}")
        own = parser([verb]).parse_args([*words, "--json"])
        for name in vars(own).keys() & vars(self.arguments).keys() - {
                "verb", "study", "map", "output", "json"}:
            if self.map == self.arguments.map or name not in _format_names():
                setattr(own, name, getattr(self.arguments, name))
        with contextlib.redirect_stdout(io.StringIO()):
            common.with_folder(module_of(verb).run, own)
        self.folders.append(output)
        said = PageRecord.model_validate_json((output / PAGE_RECORD).read_bytes()).answer
        assert said is not None  # every command that is run here has an answer
        for sentence in (said.said, said.trust):
            common.say(sentence)
        return said

    def check(self) -> None:
        """Check the map by itself, and go on with the map in the right axes if it is not."""
        try:
            self.run("check", "check", self.map)
        except MeasurementError as error:
            common.say(f"The map cannot be checked by itself: {error}")
            return
        oriented = self.arguments.output / "check" / "oriented_map.csv"
        if oriented.exists():
            self.map = InputFile(oriented)

    def infer(self, folder: str) -> bool:
        """Update the magnet, and tell whether it explains the map."""
        return self.run("infer", folder, self.study).sound

    def register(self) -> bool:
        """Find where the map lies, and tell whether its pose there may be used."""
        from halbach_fe.report.registration import STUDY_FILE

        try:
            found = self.run("register", "registered", self.study)
        except (MeasurementError, StudyError) as error:  # of a plane; or diagnose knows why
            common.say(f"The map cannot be registered: {error}")
            return False
        if STUDY_FILE in found.command:
            self.study = InputFile(self.arguments.output / "registered" / STUDY_FILE)
        else:  # nothing follows from it
            self.folders.pop()
        return found.sound

    def diagnose(self) -> bool:
        """Look for what the study lacks, and tell whether it was found and may be used."""
        from halbach_fe.diagnosis.summary import STUDY_FILE

        found = self.run("diagnose", "diagnosed", self.study)
        if found.changes_study:
            self.study = InputFile(self.arguments.output / "diagnosed" / STUDY_FILE)
        return found.sound and found.changes_study


def _format_names() -> frozenset[str]:
    """Return the names of the options that describe the columns of a map."""
    from halbach_fe.cli.format_options import add_format_arguments

    parser = argparse.ArgumentParser(add_help=False)
    add_format_arguments(parser)
    return frozenset(vars(parser.parse_args([])))


def run(arguments: argparse.Namespace) -> int:
    """Run what is needed, and join the pages."""
    from halbach_fe.cli import report
    from halbach_fe.explanation import follow
    from halbach_fe.study.reader import read_study

    if read_study(arguments.study).maps:
        raise StudyError(must_be(
            "`maps`", f"study {arguments.study}", "left out for explain, which takes one map",
            "a list of maps", "Of maps that a study lists, run halbach-fe check, register, infer "
            "and diagnose; they take all of them."))
    steps = _Explanation(arguments, arguments.study, arguments.map)
    follow(steps)
    common.say("")
    return report.run(argparse.Namespace(
        folders=steps.folders, output=arguments.output / PAGE, json=arguments.json))
