"""Text files of field maps: lines, comments, cells and numbers."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Sequence

import numpy as np

from halbach_fe.core import untrusted
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.files import workbook_in
from halbach_fe.core.numbers import MAX_CELL
from halbach_fe.core.numbers import parse_number as number_in
from halbach_fe.measurement.formats.declared import DELIMITERS, DeclaredFormat

COMMENTS = "#%!"
"""Characters that begin a comment."""
THOUSANDS = re.compile(r"[-+]?\d{1,3}(,\d{3}){1,9}\.\d{1,30}", re.ASCII)
"""A number whose thousands are separated by commas; the point says that they are no decimals."""
MAX_COMMENTS = 2000
"""Largest number of characters of comments that are kept."""

Line = tuple[int, str]
"""Number, from 1, and text of a line."""


def lines_of(raw: bytes, declared: DeclaredFormat, where: str) -> list[Line]:
    """Return the lines of a text file that are not blank, with their numbers.

    Raises
    ------
    MeasurementError
        If the content is not text in the declared encoding, or all lines are blank.
    """
    marked = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    default = declared.encoding == DeclaredFormat.encoding
    try:
        text = raw.decode("utf-16" if marked and default else declared.encoding)
    except LookupError:
        raise MeasurementError(must_be("encoding", where, "one of text (--encoding)",
                                       f"'{declared.encoding}'")) from None
    except ValueError:
        raise MeasurementError(must_be(
            "encoding", where, declared.encoding.removesuffix("-sig").upper(), "other bytes",
            "Is it text? Then name its encoding (--encoding latin-1, utf-16).")) from None
    found = [(number, line) for number, line in enumerate(text.splitlines(), 1)
             if line.strip() and number > declared.skip_lines]
    if not found:
        raise MeasurementError(must_be("content", where, "a table of readings", "blank lines"))
    return found


def text_of_table(raw: bytes, where: str) -> bytes:
    """Return the content of a file, of a workbook its first sheet as CSV.

    Raises
    ------
    MeasurementError
        If a workbook cannot be read.
    """
    if workbook_in(raw) is None:
        return raw
    try:
        return untrusted.sheet_text(raw)
    except ValueError as error:
        raise MeasurementError(must_be(
            "content", where, "an Excel workbook that is whole", f"'{error}'",
            "Save the sheet as CSV.")) from None


def is_comment(line: str) -> bool:
    """Return whether a line starts with #, %, ! or //."""
    return line.lstrip()[:1] in COMMENTS or line.lstrip().startswith("//")


def uncommented(line: str) -> str:
    """Return a comment without the characters that begin it."""
    return line.strip().lstrip(f"{COMMENTS}/").strip()


def comments_of(lines: Sequence[Line]) -> str:
    """Return all comments as a single line of at most `MAX_COMMENTS` printable characters."""
    said = " | ".join(uncommented(line) for _, line in lines if is_comment(line))
    return "".join(c if c.isprintable() else " " for c in said)[:MAX_COMMENTS]


def delimiter_of(line: str, declared: DeclaredFormat) -> str | None:
    """Return the delimiter of a line: the first of semicolon, tab and comma that occurs in it.

    None stands for spaces. With a decimal comma, a comma is no delimiter.
    """
    if declared.delimiter:
        return DELIMITERS[declared.delimiter]
    for mark in ";\t" if declared.decimal_comma else ";\t,":
        if mark in line:
            return mark
    return None


def cells_of(line: str, delimiter: str | None) -> list[str]:
    """Return the cells of a line; a line that is not valid CSV is a single cell."""
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line.strip(" ")], delimiter=delimiter))]
    except (csv.Error, StopIteration):
        return [line]


def number_in_cell(cell: str, decimal_comma: bool = False) -> float:
    """Return the number in a cell, NaN if the cell is empty or ``nan``; else raise ValueError."""
    if decimal_comma:
        if "." in cell:  # 1.234 could be 1234, or a number with a decimal point
            raise ValueError(cell)
        cell = cell.replace(",", ".")
    elif THOUSANDS.fullmatch(cell):
        cell = cell.replace(",", "")
    if not cell or cell.lower() == "nan":
        return np.nan
    return number_in(cell.replace("*^", "e"))  # as Mathematica writes exponents


def numbers_among(cells: Sequence[str], decimal_comma: bool = False) -> int:
    """Return how many cells are numbers; empty cells count if all others are numbers."""
    values = [_number_or_none(cell, decimal_comma) for cell in cells]
    found = sum(value is not None and not np.isnan(value) for value in values)
    return len(cells) if found and None not in values else found


def _number_or_none(cell: str, decimal_comma: bool) -> float | None:
    """Return the number in a cell as `number_in_cell` does, or None for other text."""
    try:
        return number_in_cell(cell, decimal_comma)
    except ValueError:
        return None


def rows_of(
    lines: Sequence[Line], columns: int, delimiter: str | None, declared: DeclaredFormat, where: str
) -> tuple[Floats, dict[int, dict[int, Line]]]:
    """Return the numbers in the rows of a table; comments among the rows are skipped.

    Parameters
    ----------
    lines : sequence of Line
    columns : int
        Number of cells that each row must have.
    delimiter : str or None
        See `delimiter_of`.
    declared : DeclaredFormat
    where : str
        Name of the file in error messages.

    Returns
    -------
    values : ndarray, shape (rows, columns)
        NaN for empty cells and other text.
    texts : dict of int to dict of int to Line
        For each column that contains other text (a time, the name of a scan), the line number and
        the cell by row. These columns cannot be used as coordinates or components.

    Raises
    ------
    MeasurementError
        If a row has another number of cells, or there are no rows.
    """
    rows: list[list[float]] = []
    texts: dict[int, dict[int, Line]] = {}
    for position, line in lines:
        if is_comment(line):
            continue
        cells = cells_of(line, delimiter)
        if len(cells) != columns:
            raise MeasurementError(must_be(
                f"line {position}", where, f"{columns} values", str(len(cells)),
                "Is the file cut short? Else remove the line, or begin it with #; if the table "
                f"begins below it, add --skip-lines {position}; if cells are separated otherwise, "
                "--delimiter."))
        row = [_number_or_none(cell, declared.decimal_comma) for cell in cells]
        for column, value in enumerate(row):
            if value is None:
                texts.setdefault(column, {})[len(rows)] = (position, cells[column])
        rows.append([np.nan if value is None else value for value in row])
    if not rows:
        raise MeasurementError(must_be("content", where, "at least one reading", "none"))
    return np.array(rows), texts


def comma_hint(cell: str) -> str:
    """Return a hint for a cell that may be a number with a decimal comma, else an empty string."""
    if len(cell) <= MAX_CELL and re.fullmatch(r"[-+]?\d*,\d+([eE][-+]?\d+)?", cell.strip()):
        return "If its comma is a decimal comma, add --decimal-comma."
    return ""
