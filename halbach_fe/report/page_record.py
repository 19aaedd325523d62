"""What a page says, for machines: page.json beside every page.

A report of a campaign is made of these files and the figures beside them, so that it never has to
read HTML.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict

from halbach_fe.core.errors import printable
from halbach_fe.core.files import write_text
from halbach_fe.report.answer import Answer
from halbach_fe.study.model import Study

PAGE_RECORD = "page.json"

DPI = 130
"""Pixels per inch of the figures."""

SMALLEST_PT = 9
"""Size of the smallest texts of a figure, in points of 1/72 inch."""

WIDEST_IN = 6.9
"""Largest width of a figure in inches. It fits between the margins of A4 and of US letter without
being made smaller, so that its texts keep their size on paper, and on a screen of 500 px they are
`LEGIBLE_PX` high."""

LEGIBLE_PX, POINTS_PER_INCH = 9, 72
"""Size in px at which a text can still be read on a screen."""


class Picture(NamedTuple):
    """A figure in a page.

    Attributes
    ----------
    png : str
        The picture in base64.
    caption : str
    file : str
        Name of its file beside the page.
    """

    png: str
    caption: str
    file: str = ""

    @property
    def legible_px(self) -> int:
        """Width in px of a page below which its smallest texts could not be read."""
        return round(self._width_px * LEGIBLE_PX / (SMALLEST_PT * DPI / POINTS_PER_INCH))

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
    """The content of page.json.

    Attributes
    ----------
    page : str
        Name of the page's file.
    title : str
    answer : Answer or None
    figures : tuple of FigureFile
        In the order of the page.
    rows : tuple of dict of str to str
        The page's main table; empty if it has none.
    provenance : dict of str to str
    study : Study or None
        The study that the results are of.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    page: Text
    title: Text
    answer: Annotated[Answer, AfterValidator(_cleaned_answer)] | None = None
    figures: tuple[FigureFile, ...] = ()
    rows: tuple[Row, ...] = ()
    provenance: dict[Text, Text] = {}
    study: Study | None = None


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
