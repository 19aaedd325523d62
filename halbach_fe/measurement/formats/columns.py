"""Tables of columns: commas, semicolons, tabs or spaces, with a header or without.

Lines before the first one of numbers, or mostly numbers, are preface. Its header is the last line
there, commented or not, that has a name for each column and says what two of them are; a line of
units may follow it.
"""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.formats import names
from halbach_fe.measurement.formats.declared import Declared
from halbach_fe.measurement.formats.names import Name
from halbach_fe.measurement.formats.table import ForeignTable, named
from halbach_fe.measurement.formats.text import (
    Line,
    cells_of,
    comma_hint,
    comments_of,
    delimiter_of,
    is_comment,
    lines_of,
    numbers_among,
    rows_of,
    uncommented,
)

RECOGNIZED = 2  # names; fewer may be words of a sentence


def read(raw: bytes, declared: Declared, where: str) -> ForeignTable:
    """Read a table of columns.

    Raises
    ------
    MeasurementError
        If there are no numbers, or lines of different length.
    """
    return read_lines(lines_of(raw, declared, where), declared, where)


def read_lines(lines: Sequence[Line], declared: Declared, where: str) -> ForeignTable:
    """As `read`, from lines."""
    start = _first_numbers(lines, declared, where)
    delimiter = delimiter_of(lines[start][1], declared)
    count = len(cells_of(lines[start][1], delimiter))
    values, texts = rows_of(lines[start:], count, delimiter, declared, where)
    _refuse_lost_rows(lines[:start], count, delimiter, declared, where)
    columns = _header(lines[:start], count, delimiter, where)
    return ForeignTable(columns, values, where, comments=comments_of(lines[:start]), texts=texts)


def _first_numbers(lines: Sequence[Line], declared: Declared, where: str) -> int:
    """Index of the first line of numbers, or mostly numbers if the next one is like it."""
    before: tuple[int, int] | None = None  # a line of mostly numbers, and how many cells it has
    for index, (_, line) in enumerate(lines):
        if is_comment(line):
            continue
        cells = cells_of(line, delimiter_of(line, declared))
        found = numbers_among(cells, declared.decimal_comma)
        if 2 * found > len(cells) and before and before[1] == len(cells):
            return before[0]
        if found == len(cells):
            return index
        before = (index, len(cells)) if 2 * found > len(cells) else None
    hint = next((comma for _, line in lines for mark in (";", "\t", None)
                 for cell in cells_of(line, mark) if (comma := comma_hint(cell))), "")
    raise MeasurementError(must_be("content", where, "a table with lines of numbers", "none", hint))


def _refuse_lost_rows(
    preface: Sequence[Line], count: int, delimiter: str | None, declared: Declared, where: str
) -> None:
    """A line as long as a row, with some numbers, may be a reading and not a preface."""
    for position, line in preface:
        cells = cells_of(line, delimiter)
        if not is_comment(line) and len(cells) == count and numbers_among(
                cells, declared.decimal_comma):
            raise MeasurementError(must_be(
                f"line {position}", where, "either a reading or a header",
                f"'{line.strip()[:60]}'", "If it is neither, begin it with #."))


def _header(
    preface: Sequence[Line], count: int, delimiter: str | None, where: str
) -> tuple[Name, ...]:
    """Names of the columns; empty ones if nothing names them."""
    below: list[str] = []
    plain: tuple[Name, ...] = ()
    for number, line in reversed(preface):
        for cells in _splits(line, delimiter):
            columns = tuple(names.parse(cell) for cell in cells)
            known = sum(bool(column.quantity) for column in columns)
            if len(cells) == count and not below and names.is_units(cells):
                below = cells
                break
            if len(cells) == count and known >= RECOGNIZED:
                return named(columns, below) if below else columns
            if len(cells) == count and not plain and not is_comment(line):
                plain = columns
        else:
            _refuse_other_length(line, number, count, delimiter, where)
    return plain or (Name(""),) * count


def _splits(line: str, delimiter: str | None) -> list[list[str]]:
    """Ways to cut a line into names; a header may be spaced where its rows have commas."""
    text = uncommented(line) if is_comment(line) else line.strip()
    spaced = _spaced(text)
    return [spaced] if delimiter is None else [cells_of(text, delimiter), spaced]


def _spaced(text: str) -> list[str]:
    """Names between spaces; a bracket with a unit is part of the name before it."""
    found: list[str] = []
    depth = 0
    for word in text.split():
        if found and (depth > 0 or word[0] in "[("):
            found[-1] += word
        else:
            found.append(word)
        depth += sum(map(word.count, "[(")) - sum(map(word.count, "])"))
    return found


def _refuse_other_length(
    line: str, number: int, count: int, delimiter: str | None, where: str
) -> None:
    """A line that is clearly a header, but of another table, is no preface to pass over."""
    for cells in _splits(line, delimiter):
        known = [names.parse(cell).quantity for cell in cells]
        if not is_comment(line) and sum(map(bool, known)) > RECOGNIZED and len(cells) != count:
            raise MeasurementError(must_be(
                f"header in line {number}", where, f"of {count} names, as there are columns",
                str(len(cells)), "Correct the header."))
