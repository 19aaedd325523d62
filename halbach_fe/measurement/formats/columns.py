"""Import of text tables with commas, semicolons, tabs or spaces, with or without a header.

All lines before the first line of numbers, or mostly numbers, form the preface. The header is the
last line of the preface, commented or not, that has a name for each column and of which at least
two names are recognized. A line of units may follow the header.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from halbach_fe.core.errors import MeasurementError, must_be, printable
from halbach_fe.measurement.field_map import (
    FIELD_COLUMNS,
    OTHER_COLUMNS,
    POSITION_COLUMNS,
    SIGMA_COLUMNS,
)
from halbach_fe.measurement.formats import names
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.names import ColumnName
from halbach_fe.measurement.formats.table import ForeignTable, with_units
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

RECOGNIZED = 2
"""Smallest number of recognized names in a header. Fewer may be words of a sentence."""
OWN_COLUMNS = frozenset((*POSITION_COLUMNS, *FIELD_COLUMNS, *SIGMA_COLUMNS, *OTHER_COLUMNS))
ATTRIBUTE = re.compile(r"#\s*([^:\s][^:]{0,99}?)\s*:\s*(.*)")
MEANING = re.compile(
    r"(?i)\b(?:symmetr\w*|mirror\w*|flip\w*|extend[xyz]?|quadrant|octant|half|scal(?:e|ed|ing)|"
    r"factor|norm[be]?|normali[sz]\w*|offsets?|multipl\w*|cent(?:er|re)|origin)\b")
"""Words of a line above the table that may change the meaning of its numbers."""
MAX_LINE, MAX_REMARKS = 200, 5
"""Number of characters of such a line that are searched, and of such lines that are told."""


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read a table of columns.

    Raises
    ------
    MeasurementError
        If there are no numbers, or lines of different length.
    """
    return read_lines(lines_of(raw, declared, where), declared, where)


def read_lines(lines: Sequence[Line], declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read a table of columns from lines, as `read` does."""
    start = _first_numbers(lines, declared, where)
    delimiter = delimiter_of(lines[start][1], declared)
    count = len(cells_of(lines[start][1], delimiter))
    values, texts = rows_of(lines[start:], count, delimiter, declared, where)
    _refuse_lost_rows(lines[:start], count, delimiter, declared, where)
    columns = _header(lines[:start], count, delimiter, where)
    own = {column.text for column in columns} <= OWN_COLUMNS
    return ForeignTable(
        columns, values, where, comments="" if own else comments_of(lines[:start]), texts=texts,
        attributes=attributes_of(lines[:start]) if own else {},
        remarks=() if own else unused_lines(lines[:start], columns))


def attributes_of(preface: Sequence[Line]) -> dict[str, str]:
    """Return the attributes ``# key: value`` of a map in halbach-fe's own columns."""
    found = (ATTRIBUTE.fullmatch(line.strip()) for _, line in preface)
    return {part[1]: part[2].strip() for part in found if part and part[0].isprintable()}


def unused_lines(preface: Sequence[Line], columns: Sequence[ColumnName]) -> tuple[str, ...]:
    """Return sentences about lines that may change the meaning of the numbers below them.

    The header, which has the names of all columns, is used.
    """
    names = [re.sub(r"\s", "", column.text) for column in columns if column.text]
    found = [f"Line {number} says '{printable(line.strip(), 80)}', of which nothing was used: "
             "if it is a shift, state it by --origin-m, and what else it says "
             "by other options or in the study."
             for number, line in preface if MEANING.search(line[:MAX_LINE])
             and not (names and all(name in re.sub(r"\s", "", line) for name in names))]
    return tuple(found[:MAX_REMARKS])


def _first_numbers(lines: Sequence[Line], declared: DeclaredFormat, where: str) -> int:
    """Return the index of the first row of the table.

    The first row contains only numbers, or mostly numbers if the next line does too and has as many
    cells.
    """
    # index and number of cells of the previous line, if it contains mostly numbers
    before: tuple[int, int] | None = None
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
    preface: Sequence[Line], count: int, delimiter: str | None, declared: DeclaredFormat, where: str
) -> None:
    """Raise MeasurementError for a line of the preface that may be a reading.

    Such a line is not a comment, has as many cells as a row, and contains a number.
    """
    for position, line in preface:
        cells = cells_of(line, delimiter)
        if not is_comment(line) and len(cells) == count and numbers_among(
                cells, declared.decimal_comma):
            raise MeasurementError(must_be(
                f"line {position}", where, "either a reading or a header",
                f"'{line.strip()[:60]}'", "If it is neither, begin it with #."))


def _header(
    preface: Sequence[Line], count: int, delimiter: str | None, where: str
) -> tuple[ColumnName, ...]:
    """Return the names of the columns; they are empty if there is no header."""
    below: list[str] = []
    plain: tuple[ColumnName, ...] = ()
    for number, line in reversed(preface):
        for cells in _splits(line, delimiter):
            columns = tuple(names.parse(cell) for cell in cells)
            known = sum(bool(column.quantity) for column in columns)
            if len(cells) == count and not below and names.is_units(cells):
                below = cells
                break
            if len(cells) == count and known >= RECOGNIZED:
                return with_units(columns, below) if below else columns
            if len(cells) == count and not plain and not is_comment(line):
                plain = columns
        else:
            _refuse_other_length(line, number, count, delimiter, where)
    return plain or (ColumnName(""),) * count


def _splits(line: str, delimiter: str | None) -> list[list[str]]:
    """Return the possible splits of a line into names.

    A header may be separated by spaces even if its rows are separated by commas.
    """
    text = uncommented(line) if is_comment(line) else line.strip()
    spaced = _spaced(text)
    return [spaced] if delimiter is None else [cells_of(text, delimiter), spaced]


def _spaced(text: str) -> list[str]:
    """Split at spaces; a bracket with a unit belongs to the name before it."""
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
    """Raise MeasurementError for a header with another number of names than there are columns."""
    for cells in _splits(line, delimiter):
        known = [names.parse(cell).quantity for cell in cells]
        if not is_comment(line) and sum(map(bool, known)) > RECOGNIZED and len(cells) != count:
            raise MeasurementError(must_be(
                f"header in line {number}", where, f"of {count} names, as there are columns",
                str(len(cells)), "Correct the header."))
