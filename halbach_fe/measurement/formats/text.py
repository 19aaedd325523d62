"""Text of measured maps: lines, comments, cells and numbers."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.numbers import MAX_CELL
from halbach_fe.core.numbers import parse_number as number_in
from halbach_fe.measurement.formats.declared import Declared

COMMENTS = "#%!"
MAX_COMMENTS = 2000

Line = tuple[int, str]


def lines_of(raw: bytes, declared: Declared, where: str) -> list[Line]:
    """Lines that are not blank, each with its number.

    Raises
    ------
    MeasurementError
        If it is no text in the encoding, or there is none.
    """
    try:
        text = raw.decode(declared.encoding)
    except LookupError:
        raise MeasurementError(must_be("encoding", where, "one of text (--encoding)",
                                       f"'{declared.encoding}'")) from None
    except ValueError:
        raise MeasurementError(must_be(
            "encoding", where, declared.encoding.removesuffix("-sig").upper(), "other bytes",
            "Is it text? Then name its encoding (--encoding latin-1, utf-16).")) from None
    found = [(number_in_cell, line) for number_in_cell,
             line in enumerate(text.splitlines(), 1) if line.strip()]
    if not found:
        raise MeasurementError(must_be("content", where, "a table of readings", "blank lines"))
    return found


def is_comment(line: str) -> bool:
    """Whether a line starts with #, % or !."""
    return line.lstrip()[:1] in COMMENTS


def uncommented(line: str) -> str:
    """A comment without its marks."""
    return line.strip().lstrip(COMMENTS).strip()


def comments_of(lines: Sequence[Line]) -> str:
    """What the comments say, on one line that any file can hold."""
    said = " | ".join(uncommented(line) for _, line in lines if is_comment(line))
    return "".join(c if c.isprintable() else " " for c in said)[:MAX_COMMENTS]


def delimiter_of(line: str, declared: Declared) -> str | None:
    """Semicolon, tab or comma, the first that occurs; None for spaces."""
    for mark in ";\t" if declared.decimal_comma else ";\t,":
        if mark in line:
            return mark
    return None


def cells_of(line: str, delimiter: str | None) -> list[str]:
    """Cells of a line; of one that is no CSV the line as a whole."""
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line.strip(" ")], delimiter=delimiter))]
    except (csv.Error, StopIteration):
        return [line]


def number_in_cell(cell: str, decimal_comma: bool = False) -> float:
    """The number in a cell, NaN for an empty one or NaN; ValueError for anything else."""
    if decimal_comma:
        cell = cell.replace(",", ".")
    if not cell or cell.lower() == "nan":
        return np.nan
    return number_in(cell)


def numbers_among(cells: Sequence[str], decimal_comma: bool = False) -> int:
    """How many cells are numbers; all of them if the others are empty."""
    values = [_number_or_none(cell, decimal_comma) for cell in cells]
    found = sum(value is not None and not np.isnan(value) for value in values)
    return len(cells) if found and None not in values else found


def _number_or_none(cell: str, decimal_comma: bool) -> float | None:
    try:
        return number_in_cell(cell, decimal_comma)
    except ValueError:
        return None


def rows_of(
    lines: Sequence[Line], columns: int, delimiter: str | None, declared: Declared, where: str
) -> tuple[Floats, dict[int, Line]]:
    """Numbers (rows, columns) of lines, NaN for other text; comments among them are skipped.

    Also, of each column with other text (a time, the name of a scan), where it comes first: such
    a column is of no use.

    Raises
    ------
    MeasurementError
        With the first line that has another length.
    """
    rows: list[list[float]] = []
    texts: dict[int, Line] = {}
    for position, line in lines:
        if is_comment(line):
            continue
        cells = cells_of(line, delimiter)
        if len(cells) != columns:
            raise MeasurementError(must_be(f"line {position}", where, f"{columns} values",
                                           str(len(cells)), "Is the file cut short?"))
        row = [_number_or_none(cell, declared.decimal_comma) for cell in cells]
        for column, value in enumerate(row):
            if value is None:
                texts.setdefault(column, (position, cells[column]))
        rows.append([np.nan if value is None else value for value in row])
    if not rows:
        raise MeasurementError(must_be("content", where, "at least one reading", "none"))
    return np.array(rows), texts


def comma_hint(cell: str) -> str:
    """What to do about a number with a comma."""
    if len(cell) <= MAX_CELL and re.fullmatch(r"[-+]?\d*,\d+([eE][-+]?\d+)?", cell.strip()):
        return "If its comma is a decimal one, add --decimal-comma."
    return ""
