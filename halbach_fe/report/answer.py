"""What every page says first, and the terminal too: the answer, how far to trust it, what next.

page.json beside a page says it for machines, with its table and the names of its figures: the
report of a campaign is made of that, so that it never has to read HTML.
"""

from __future__ import annotations

import base64
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict

from halbach_fe.core.errors import printable
from halbach_fe.core.files import write_text
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.result import OWN_NOISE, Reservation
from halbach_fe.report.words import in_a_row
from halbach_fe.study.model import Study

STANDS_FOR = {
    "STUDY": "your study file", "MAP": "the file of your field map (CSV or HDF5)",
    "NEW_MAP": "the file of the map that you measure then",
    "BLOCKS": "the table of your measured blocks (CSV)",
    "POSTERIOR": "the posterior.h5 that halbach-fe infer wrote",
    "DIR": "a new folder for the results"}
"""What a command's words stand for where the path is not known."""

MAP_OPTIONS = "options of MAP"
"""Key of the options, a list of words, without which a map in other columns cannot be read."""

LISTED_MAPS = "maps of STUDY"
"""Key of whether the study lists its maps, so that a command must not name one."""

MOST_WORDS = 40
"""Largest number of words of a box in large type, which are read at a glance."""

TAKE_LISTED_MAPS = ("infer", "diagnose", "register")
"""Commands that take the maps that a study lists."""

_NAMES: ContextVar[Mapping[str, object] | None] = ContextVar("names", default=None)

_INPUTS: ContextVar[Mapping[str, str] | None] = ContextVar("inputs", default=None)


@contextmanager
def _while_it_runs(variable: ContextVar[Any], value: object) -> Iterator[None]:
    """Let a variable have a value while the block runs."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def known_inputs(inputs: Mapping[str, str]) -> AbstractContextManager[None]:
    """While the block runs, let the provenance of pages have these files.

    They are texts with name and SHA-256, by what the file is.
    """
    return _while_it_runs(_INPUTS, inputs)


def inputs_of_command() -> Mapping[str, str]:
    """Return what the command that is running has read, see `known_inputs`."""
    return _INPUTS.get() or {}


def known_paths(paths: Mapping[str, object]) -> AbstractContextManager[None]:
    """While the block runs, let answers of pages name these files, see `Answer.with_paths`."""
    return _while_it_runs(_NAMES, paths)


@dataclass(frozen=True)
class Answer:
    """The answer of a command in plain words."""

    question: str
    """What was asked."""
    said: str
    """The answer, with its uncertainty."""
    trust: str
    """Whether it can be trusted, and why not."""
    step: str
    """What to do next."""
    command: str = ""
    """The command for that, in which STUDY, MAP, BLOCKS and POSTERIOR stand for files of the user,
    ``DIR/`` for the folder of this command, and a single DIR for another one; empty if no command
    does it."""
    sound: bool = True
    """Whether the answer may be used as it stands. Otherwise its box is a warning."""
    concern: str = ""
    """What is bad about the magnet itself, in a sentence that no summary may leave out; empty if
    nothing is."""
    changes_study: bool = True
    """Whether a study that the command wrote says something else than the one that it read, beyond
    the error bars. Otherwise results of the one are as good as those of the other."""
    gist: str = ""
    """The answer in a sentence, where that is not the first one of ``said``."""
    numbers: tuple[tuple[str, str], ...] = ()
    """What the answer is about, and its size with a unit: the largest type of the page."""

    @property
    def headline(self) -> str:
        """The gist, or the first sentence, as far as the words of large type suffice.

        What is cut ends in a word, not within a number and its error bar.
        """
        first = self.gist or _first_sentence(self.said)
        words = first.split(" ")
        most = MOST_WORDS - sum(len(f"{name} {size}".split(" ")) for name, size in self.numbers)
        if len(words) <= most:
            return first
        kept = words[:most - 1]
        while len(kept) > 1 and not kept[-1].strip(",;:()").isalpha():
            kept.pop()
        return f"{' '.join(kept).rstrip(',;:(')} …"

    @property
    def short_trust(self) -> str:
        """The verdict on whether it can be trusted, and the first reason."""
        return _first_sentence(self.trust)

    @property
    def level(self) -> str:
        """How far it can be trusted: "", "partial" or "doubtful"."""
        return ("partial" if self.trust.startswith("Only") else "" if self.sound else "doubtful")

    @property
    def sentences(self) -> tuple[str, str, str]:
        """What the terminal says before the command."""
        return self.said, self.trust, f"Next: {self.step}"

    @property
    def to_fill_in(self) -> str:
        """What the words of the command stand for that no path is known for; empty without any."""
        found = [f"{word} is {meaning}" for word, meaning in STANDS_FOR.items()
                 if word in self.command.split(" ")]
        return f"In this command {in_a_row(found)}." if found else ""

    def with_paths(self, paths: Mapping[str, object]) -> Answer:
        """Return the answer with the paths that are known in place of the words of its command.

        An update with a map gets the table of blocks too, if its path is known, and `infer` and
        `diagnose` the held-out map. Of a study that lists its maps, `infer`, `diagnose` and
        `register` take no other.
        """
        def known(word: str) -> str:
            name, slash, rest = word.partition("/")
            path = paths.get(name)
            if path is None or (name == "DIR") != bool(slash):
                return word
            options = paths.get(MAP_OPTIONS) if name == "MAP" else None
            return shlex.join([str(Path(str(path), rest)),
                               *(options if isinstance(options, list) else [])])

        words = self.command.split(" ")
        if "--measurements" in words and "NEW_MAP" not in words:
            for option, word, verbs in (("--blocks", "BLOCKS", words),
                                        ("--held-out", "HELD_OUT", ("infer", "diagnose"))):
                if paths.get(word) is not None and option not in words and {*verbs} & {*words}:
                    words[words.index("-o"):words.index("-o")] = [option, word]
        if paths.get(LISTED_MAPS) and "MAP" in words and {*TAKE_LISTED_MAPS} & set(words):
            first = words.index("--measurements")
            del words[first:first + 2]
        return replace(self, command=" ".join(map(known, words)))

    def with_known_paths(self, folder: bool = True) -> Answer:
        """Return the answer with the paths of the command that is running, see `known_paths`.

        Without ``folder``, its own folder stays ``DIR/``: results may be moved, and a report of
        several names them by its own place.
        """
        return self.with_paths({
            name: path for name, path in (_NAMES.get() or {}).items() if folder or name != "DIR"})


def _first_sentence(text: str) -> str:
    """Return the first sentence of a text, or two if the first is a mere verdict of up to three
    words, as "Passed." and "Only in part.".
    """
    first, *others = re.split(r"(?<=[.!?]) (?=[A-Z])", text)
    return first if len(first.split(" ")) > 3 else " ".join([first, *others[:1]])


def agreement(disagreement: str | None) -> str:
    """Say that an answer may be trusted whose update agrees with its map, or is not known to."""
    return ("Yes, as far as the update agrees with its map, which its own page says."
            if disagreement is None else "Yes: the update agrees with its map.")


def along_the_axis(magnet: Magnet, options: str = "") -> tuple[str, str]:
    """Return the next step, and its command, of a magnet whose field has to cancel along z."""
    middle, reach = magnet.middle_z_m, 5 * (magnet.half_length + magnet.radius)
    return ("See its field on the axis, whose first and second integrals must vanish: an undulator "
            "has no mean field to be homogeneous.",
            f"halbach-fe field STUDY {options}--from-m 0 0 {middle - reach:.3g} --to-m 0 0 "
            f"{middle + reach:.3g} --count 2001 -o DIR")


STATE_NOISE = ("State the noise that the map has (sigma_T, position_sd_m) and update again. This "
               "command finds it, if the map's points are near enough to each other to tell; else "
               "read the probe repeatedly at one place.", "halbach-fe check MAP -o DIR")
"""The next step, and its command, if readings scatter less than their noise."""


def of_a_conflict(question: str, said: str, disagreement: str) -> Answer:
    """Return an answer from an update that disagrees with its map, which is not to be trusted.

    One that agrees, but with a `Reservation`, is to be trusted as far as that says.
    """
    if isinstance(disagreement, Reservation):
        return Answer(
            question, said, f"{disagreement} These numbers are of that update.",
            "Find out what it is, and update again, before you rely on these numbers.",
            "halbach-fe infer STUDY --measurements MAP -o DIR", sound=False)
    if disagreement.endswith(OWN_NOISE):  # the readings are nearer than their noise, and no more
        return Answer(
            question, "Not known, as model and measurement agree better than the stated noise "
            f"allows. If the noise were right: {said}", f"No. {disagreement}", *STATE_NOISE,
            sound=False)
    return Answer(
        question, f"Not known, as model and measurement disagree. If the model were right: {said}",
        f"No. {disagreement}",
        "Look for what the study lacks, and update again, before you use these numbers.",
        "halbach-fe diagnose STUDY --measurements MAP -o DIR", sound=False)


PAGE_RECORD = "page.json"

DPI = 130
"""Pixels per inch of the figures."""

SMALLEST_PT = 9
"""Size of the smallest texts of a figure, in points of 1/72 inch."""

WIDEST_IN = 6.9
"""Largest width of a figure in inches. It fits between the margins of A4 and of US letter without
being made smaller, so that its texts keep their size on paper, and on a screen of 500 px they are
`LEGIBLE_PX` high."""

LEGIBLE_PX = 9
"""Size in px at which a text can still be read on a screen."""


class Picture(NamedTuple):
    """A figure in a page."""

    png: str
    """The picture in base64."""
    caption: str
    file: str = ""
    """Name of its file beside the page."""

    @property
    def legible_px(self) -> int:
        """Width in px of a page below which its smallest texts could not be read."""
        return round(self._width_px * LEGIBLE_PX / (SMALLEST_PT * DPI / 72))  # points of an inch

    @property
    def width_in(self) -> float:
        """Width in inches at which its texts have the size that they were drawn with."""
        return round(self._width_px / DPI, 2)

    @property
    def _width_px(self) -> int:
        header = base64.b64decode(self.png[:32])  # signature, length and name of the first chunk
        return int.from_bytes(header[16:20], "big")


def _cleaned(text: str) -> str:
    """Return a text without control characters."""
    # Largest number of characters of a text. The longest answers have some thousand.
    longest_text = 10_000
    return printable(text, longest_text)


def _cleaned_answer(answer: Answer) -> Answer:
    """Return an answer whose texts have no control characters."""
    cleaned: dict[str, Any] = {key: _cleaned(value) for key, value in vars(answer).items()
                               if isinstance(value, str)}
    return replace(answer, **cleaned, numbers=tuple(
        (_cleaned(name), _cleaned(size)) for name, size in answer.numbers))


Text = Annotated[str, AfterValidator(_cleaned)]
Row = dict[Text, Text]


class FigureFile(BaseModel):
    """The file of a figure beside a page, and its caption."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    file: Text
    caption: Text


class PageRecord(BaseModel):
    """The content of page.json."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    page: Text
    """Name of the page's file."""
    title: Text
    answer: Annotated[Answer, AfterValidator(_cleaned_answer)] | None = None
    figures: tuple[FigureFile, ...] = ()
    """In the order of the page."""
    rows: tuple[Row, ...] = ()
    """The page's main table; empty if it has none."""
    provenance: dict[Text, Text] = {}
    study: Study | None = None
    """The study that the results are of."""


def write_record(
    page: Path, title: str, answer: Answer | None, pictures: Sequence[Picture],
    rows: Sequence[Mapping[str, str]], provenance: Mapping[str, str], study: Study | None,
) -> None:
    """Write page.json beside a page; see `PageRecord`."""
    record = PageRecord(
        page=page.name, title=title, answer=answer, rows=tuple(map(dict, rows)), study=study,
        figures=tuple(FigureFile(file=each.file, caption=each.caption) for each in pictures),
        provenance=dict(provenance))
    write_text(page.with_name(PAGE_RECORD), record.model_dump_json(indent=1) + "\n")
