"""Import of text tables with commas, semicolons, tabs or spaces, with or without a header.

They come from gaussmeters, mappers, spreadsheets, and programs such as CST or JMAG.

All lines before the first line of numbers, or mostly numbers, form the preface. The header is the
last line of the preface, commented or not, that has a name for each column and of which at least
two names are recognized. A line of units may follow the header.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be, printable
from halbach_fe.measurement.field_map import (
    FIELD_COLUMNS,
    OTHER_COLUMNS,
    POSITION_COLUMNS,
    SIGMA_COLUMNS,
)
from halbach_fe.measurement.formats import column_names
from halbach_fe.measurement.formats.column_names import ColumnName
from halbach_fe.measurement.formats.columns_to_map import ForeignTable, with_units
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.units import in_si, kind_of, unit_symbol
from halbach_fe.measurement.text_tables import (
    MAX_LINE,
    RUN_TOGETHER,
    Line,
    cells_of,
    comma_hint,
    comments_of,
    delimiter_of,
    is_comment,
    joining,
    lines_of,
    numbers_among,
    rows_of,
    uncommented,
    undecorated,
)

MARKED = re.compile(r"(?i)^(variables\s*=|[;*$]\s)\s*|\s\*$")
"""What stands before a header: of Tecplot, of MAD-X, and of comments in other programs."""
LEAD = re.compile(r"[^\W\d_]{3,20}:\s+(?=\S)")
"""A word before a header: Coordinates: x (mm), y (mm)."""
VECTOR = re.compile(r"(?i)vector data\W*b(_vector|x)?\b")
SCALAR = re.compile(r"(?i)scalar data\b.*\bMag_?B\b.*")
RECOGNIZED = 2
"""Smallest number of recognized names in a header. Fewer may be words of a sentence."""
OWN_COLUMNS = frozenset((*POSITION_COLUMNS, *FIELD_COLUMNS, *SIGMA_COLUMNS, *OTHER_COLUMNS))
ATTRIBUTE = re.compile(r"#\s*([^:\s][^:]{0,99}?)\s*:\s*(.*)")
"""An attribute of a map in halbach-fe's own columns: # key: value."""
MEANING = re.compile(
    r"(?i)\b(?:symmetr\w*|mirror\w*|flip\w*|extend[xyz]?|quadrant|octant|half|scal(?:e|ed|ing)|"
    r"factor|norm[be]?|normali[sz]\w*|offsets?|shift\w*|multipl\w*|cent(?:er|re)|origin)\b")
"""Words of a line above the table that may change the meaning of its numbers."""
CENTRE = re.compile(r"(?i)\b(?:cent(?:er|re)|origin)\b.*?\bx[\s=:]{0,3}([-+\d.e]+)\s*(\w+)?\W+"
                    r"y[\s=:]{0,3}([-+\d.e]+)\s*(\w+)?\W+z[\s=:]{0,3}([-+\d.e]+)\s*(\w+)")
"""A point with its coordinates and their unit: centre in lab: x 1 mm, y 2 mm, z 3 mm."""
COORDINATE = re.compile(
    r"(?i)([xyz])\s*[=:]\s*([-+\d.e]{1,30})\s*[\[(]?\s*([^\W\d]{1,12})?\W?")
"""A comment that is a coordinate of the rows below it."""
JSON = re.compile(rb'\s*(?:\[\s*)?\{\s*"')
KICKS = re.compile(r"(?i)\bkick[ _-]?(?:map|angles?)\b|\b(?:horizontal|vertical) kicks?\b")
"""Words of the comments of a map of kicks, as tracking programs read it."""
MAX_COUNTS = 4
MAX_HEADER = 20_000
"""Number of characters of a line that are read as names of columns."""
MAX_REMARKS = 5
"""Number of such lines that are told."""


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read a table of columns.

    Raises
    ------
    MeasurementError
        If there are no numbers, or lines of different length.
    """
    lines = [(number, undecorated(line)) for number, line in lines_of(raw, declared, where)]
    if JSON.match(raw[:MAX_LINE]):
        raise MeasurementError(must_be(
            "content", where, "a table with lines of numbers", "JSON", "Write it with a row x, y, "
            "z, Bx, By, Bz of numbers for each point, as CSV; in Python by pandas.DataFrame(...)"
            ".to_csv('map.csv', index=False)."))
    if any(KICKS.search(line[:MAX_LINE]) for _, line in lines[:20] if is_comment(line)):
        raise MeasurementError(must_be(
            "content", where, "readings of a field", "a map of kicks, which are integrals along "
            "lines", "Import the map of the field from which it was made."))
    _refuse_limits_above(lines, where)
    if not declared.columns:
        _refuse_grid_above(lines[:4], where)
    return read_lines([one for one in lines if one[1]], declared, where)


def read_lines(lines: Sequence[Line], declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read a table of columns from lines, as `read` does."""
    lines, start = _with_numbers_apart(lines, declared, where)
    first = _below_counts(lines, start, declared, where)
    counts, preface = lines[start:first], lines[:first]
    header = {line.strip() for _, line in preface}  # repeated above every part of some files
    body = [line for line in lines[first:]
            if is_comment(line[1]) or line[1].strip() not in header]
    values, texts, delimiter, remarks = _rows(body, declared, where)
    if counts:
        remarks += (_counted(counts[0], len(values), where),)
    values = _without_empty_end(values, texts, lines[:start], delimiter)
    count = values.shape[1]
    _refuse_lost_rows(lines[:start], count, delimiter, declared, where)
    named = [text for text in declared.columns if text != "-"]
    if (each := len(named) // count) > 1 and len(declared.columns) == each * count:
        raise MeasurementError(must_be(
            "--columns", where, f"of {count} columns, as the file has", len(declared.columns),
            joining(each, body[0][0], delimiter) + " Else name each column; - ignores a column."))
    columns = _header(preface, count, delimiter, "" if declared.columns else where)
    _refuse_other_header(body, columns, delimiter, where)
    own = {column.text for column in columns} <= OWN_COLUMNS
    stated = [column_names.parse(text, stated=True) for text in declared.columns] or columns
    known = {column.quantity for column in stated}
    added, more = _in_comments(preface, body, known) if declared.positions is None else ([], [])
    if added:
        columns, values = (*columns, *added), np.column_stack([values, *more])
        remarks += (f"{' and '.join(column.quantity for column in added)} of the rows "
                    f"{'is that' if len(added) == 1 else 'are those'} of the comment above them.",)
    return ForeignTable(
        columns, values, where, added=len(added), texts=texts,
        comments="" if own else comments_of(preface),
        attributes={part[1]: part[2].strip() for _, line in preface if (
            part := ATTRIBUTE.fullmatch(line.strip())) and part[0].isprintable()} if own else {},
        remarks=remarks if own else remarks + unused_lines(preface, columns))


def _with_numbers_apart(
    lines: Sequence[Line], declared: DeclaredFormat, where: str
) -> tuple[Sequence[Line], int]:
    """Return the lines, in which no numbers run together, and the index of the first row."""
    apart = [(number, line if is_comment(line) else RUN_TOGETHER.sub(r"\1 ", line))
             for number, line in lines]
    try:
        start = _first_numbers(lines, declared, where)
    except MeasurementError as error:  # unless the numbers of all rows run together
        try:
            start = _first_numbers(apart, declared, where)
        except MeasurementError:
            raise error from None
        lines = apart
    if delimiter_of(lines[start][1], declared) is None:
        while start and _are_alike(apart[start - 1][1], apart[start][1]) and (
                apart[start - 1] != lines[start - 1]):  # a first row of numbers run together
            start -= 1
        lines = [*lines[:start], *apart[start:]]
    return lines, start


def _rows(
    body: Sequence[Line], declared: DeclaredFormat, where: str
) -> tuple[Floats, dict[int, dict[int, Line]], str | None, tuple[str, ...]]:
    """Return what `rows_of` does, the delimiter of the cells, and a remark if tabs are repeated."""
    delimiter = delimiter_of(body[0][1], declared)
    try:
        return *rows_of(body, len(cells_of(body[0][1], delimiter)), delimiter, declared,
                        where), delimiter, ()
    except MeasurementError as error:
        if delimiter != "\t" or declared.delimiter:
            raise
        try:
            found = rows_of(body, len(body[0][1].split()), None, declared, where)
        except MeasurementError:
            raise error from None
    return *found, None, (
        "Some cells are separated by several tabs, which were taken for one: then all rows are "
        "equally long.",)


def _refuse_grid_above(first: Sequence[Line], where: str) -> None:
    """Raise MeasurementError for maps whose first lines are the axes of a grid.

    Those of ASTRA are a number of coordinates and the coordinates, those of TraceWin a number of
    steps and the first and last coordinate, of z the last alone, and a factor.
    """
    axes = [line[:MAX_HEADER].split() for _, line in first]
    if axes and axes[0] and axes[0][0].startswith("3DMagnetoStatic"):
        raise MeasurementError(must_be(
            "content", where, "rows with positions", "a map of OPAL, whose grid stands above them",
            "Add --skip-lines 4, --columns Bx[T],By[T],Bz[T] with its unit, and --positions TABLE: "
            "x, y and z of every row, in the order that its first line states."))
    astra = len(axes) == 4 and len(axes[3]) != len(axes[0]) and all(
        len(axis) > 2 and axis[0] == str(len(axis) - 1) and _rises(axis[1:]) for axis in axes[:3])
    tracewin = [len(axis) for axis in axes] == [2, 3, 3, 1] and all(
        axis[0].isdigit() and _rises(axis[1:]) for axis in axes[:3])
    if astra or tracewin:
        raise MeasurementError(must_be(
            "content", where, "rows with positions", f"a map of {'ASTRA' if astra else 'TraceWin'},"
            " of one component on the grid of its first three lines", "Write a table with a row "
            "x, y, z, Bx, By, Bz for every point from its three files, in which x changes fastest "
            "and z slowest."))


def _refuse_limits_above(lines: Sequence[Line], where: str) -> None:
    """Raise MeasurementError for rows below three lines of the first and last coordinate of a grid
    and their number, as in maps of FairRoot below the word nosym: these lines are no readings.
    """
    least = 4  # lines, so that there are rows
    for start in (0, 1):
        limits = [line[:MAX_HEADER].split() for _, line in lines[start:start + 3]]
        if len(lines) < start + least or not all(
                len(axis) == 3 and _rises(axis[:2]) and re.fullmatch(r"[1-9]\d{0,8}", axis[2])
                for axis in limits):
            continue
        if math.prod(int(axis[2]) for axis in limits) == len(lines) - start - 3:
            raise MeasurementError(must_be(
                "content", where, "rows with positions", "rows below the limits of their grid",
                f"Add --skip-lines {lines[start + 2][0]}, --columns Bx[T],By[T],Bz[T] with its "
                "unit, and --positions TABLE: x, y and z of every row, of which z changes fastest "
                "in maps of FairRoot."))


def _rises(cells: Sequence[str]) -> bool:
    """Tell whether cells are numbers, each larger than the one before."""
    with suppress(ValueError):
        return all(float(one) < float(after) for one, after in pairwise(cells))
    return False


def _are_alike(line: str, other: str) -> bool:
    """Tell whether two lines consist of equally many numbers, and of nothing else."""
    cells = line.split()
    return not is_comment(line) and len(cells) == len(other.split()) and all(
        re.fullmatch(r"[-+]?[\d.]+(?:[eEdD][-+]?\d+)?", cell) for cell in cells)


def _in_comments(
    preface: Sequence[Line], body: Sequence[Line], known: set[str]
) -> tuple[list[ColumnName], list[list[float]]]:
    """Return coordinates that comments among the rows state, as "# z = 10 mm" above each plane.

    The second list has their values by row. Those that are in ``known`` or never change are no such
    coordinates.
    """
    at: dict[str, tuple[float, str]] = {}
    by_row: list[dict[str, tuple[float, str]]] = []
    for number, (_, line) in enumerate([*preface, *body]):
        found = COORDINATE.fullmatch(uncommented(line)[:MAX_LINE])
        if found:
            with suppress(ValueError):
                at = at | {found[1].lower(): (float(found[2]), found[3] or "")}
        elif number >= len(preface) and not is_comment(line):
            by_row.append(at)
    axes = [axis for axis in column_names.POSITIONS[:3] if axis not in known
            and all(axis in row for row in by_row) and len({row[axis] for row in by_row}) > 1
            and len({row[axis][1] for row in by_row}) == 1]
    return ([ColumnName(axis, axis, by_row[0][axis][1]) for axis in axes],
            [[row[axis][0] for row in by_row] for axis in axes])


def _below_counts(
    lines: Sequence[Line], start: int, declared: DeclaredFormat, where: str
) -> int:
    """Return the index of the first row of readings: below a line of one to four counts."""
    rows = [index for index in range(start, len(lines)) if not is_comment(lines[index][1])][:3]
    if len(rows) > 2 and not numbers_among(cells_of(  # a header between counts and rows
            lines[rows[1]][1], delimiter_of(lines[rows[1]][1], declared))):
        del rows[1]
    whole = [cells_of(lines[index][1], delimiter_of(lines[index][1], declared)) for index in rows]
    cells = [[cell for cell in row if cell] for row in whole]
    if len(rows) < 2 or len(whole[0]) == len(whole[1]) or len(cells[0]) == len(cells[1]) or (
            len(cells[0]) > MAX_COUNTS) or not all(
                re.fullmatch(r"[1-9]\d{0,8}", cell) for cell in cells[0]):
        return start
    return rows[1]


def _counted(counts: Line, rows: int, where: str) -> str:
    """Return the sentence about a line of counts, which must agree with the number of rows."""
    number, line = counts
    found = [int(cell) for cell in re.findall(r"\d+", line)]
    if rows not in (math.prod(found), math.prod(found[:3]), *found):
        raise MeasurementError(must_be(
            f"line {number}", where, f"a reading, or counts of the {rows} rows below it",
            f"'{printable(line.strip(), 40)}'",
            f"Is the file cut short? If the line is none of both, add --skip-lines {number}, and "
            "--columns, as its header is skipped too."))
    return f"Line {number} was read as counts of points: there are as many rows."


def _without_empty_end(
    values: Floats, texts: Mapping[int, object], preface: Sequence[Line], delimiter: str | None
) -> Floats:
    """Return the columns but for a last one that a delimiter at the end of all rows makes."""
    last = values.shape[1] - 1
    if last < 1 or last in texts or not np.isnan(values[:, last]).all() or any(
            len(cells) == last + 1 and cells[-1] for _, line in preface
            for cells in _splits(line, delimiter)):
        return values
    return values[:, :last]


def unused_lines(preface: Sequence[Line], columns: Sequence[ColumnName]) -> tuple[str, ...]:
    """Return sentences about lines that may change the meaning of the numbers below them.

    The header, which has the names of all columns, is used.
    """
    names = [re.sub(r"\s", "", column.text) for column in columns if column.text]
    found = [f"Line {number} says '{printable(line.strip(), 80)}', of which nothing was used: "
             + (_shift(line) or "if it is a shift, state it by --origin-m, and what else it says "
                "by other options or in the study.")
             for number, line in preface if MEANING.search(line[:MAX_LINE])
             and not (names and all(name in re.sub(r"\s", "", line) for name in names))]
    return tuple(found[:MAX_REMARKS])


def _shift(line: str) -> str:
    """Return how to use the centre that a line states; empty if it states none."""
    found = CENTRE.search(line[:MAX_LINE])
    unit = unit_symbol(found[6]) if found else ""
    if not found or kind_of(unit) != "length":
        return ""
    try:
        at = -in_si(np.array([float(found[number]) for number in (1, 3, 5)]), unit)
    except ValueError:
        return ""
    return ("if the magnet's centre is there in the coordinates of the file, add --origin-m="
            + ",".join(f"{value + 0.0:.9g}" for value in at) + ", which puts it at the origin.")


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
    hint = next((comma for _, line in lines for mark in (";", "\t", ",", None)
                 for cell in cells_of(line[:MAX_HEADER], mark) if (comma := comma_hint(cell))), "")
    raise MeasurementError(must_be(
        "content", where, "a table with lines of numbers", "none", hint or "Write it with a row "
        "x, y, z, Bx, By, Bz of numbers for each point, as CSV; if there are such rows, state "
        "what separates the numbers: --delimiter comma, semicolon, tab or spaces."))


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
                f"'{line.strip()[:60]}'", next(filter(None, map(comma_hint, cells)), "")
                or f"If it is neither, begin it with #, or add --skip-lines {position}."))


def _header(
    preface: Sequence[Line], count: int, delimiter: str | None, where: str
) -> tuple[ColumnName, ...]:
    """Return the names of the columns; they are empty if there is no header.

    An empty ``where`` stands for a file whose columns the user states: no header is refused.
    """
    below: list[str] = []
    plain: tuple[ColumnName, ...] = ()
    for number, line in reversed(preface):
        for cells in map(_with_vector, _splits(line, delimiter)):
            if len(cells) == count + 1 and not cells[-1].strip():  # as the rows, with an empty end
                cells = cells[:-1]
            columns = column_names.with_axes([column_names.parse(cell) for cell in cells])
            known = sum(bool(column.quantity) for column in columns)
            if len(cells) == count and not below and column_names.is_units(cells):
                below = cells
                break
            if len(cells) == count and known >= RECOGNIZED:
                return with_units(columns, below) if below else columns
            if len(cells) == count and not plain and not is_comment(line):
                plain = columns
        else:
            if where:
                _refuse_other_length(line, number, count, delimiter, where)
    return plain or (ColumnName(""),) * count


def _refuse_other_header(
    body: Sequence[Line], columns: Sequence[ColumnName], delimiter: str | None, where: str
) -> None:
    """Raise MeasurementError if a comment among the rows names other columns or units than the
    header, which holds for rows above the comment alone.
    """
    for number, line in body if any(column.quantity for column in columns) else ():
        if not is_comment(line) or numbers_among(_spaced(uncommented(line))):
            continue  # a comment with numbers is one on the rows below, such as # z = 5 mm
        other = _header([(number, line)], len(columns), delimiter, "")
        if any(one.quantity for one in other) and any(
                one.quantity != column.quantity or (
                    one.unit and unit_symbol(one.unit) != unit_symbol(column.unit))
                for one, column in zip(other, columns, strict=True)):
            raise MeasurementError(must_be(
                f"line {number}", where, "a header as that above the table, if one comes again",
                f"'{printable(line.strip(), 80)}'", "Write the rows below it as a file of their "
                "own; several maps are several files."))


def _splits(line: str, delimiter: str | None) -> list[list[str]]:
    """Return the possible splits of a line into names.

    A header may be separated by spaces even if its rows are separated by commas.
    """
    text = (uncommented(line) if is_comment(line) else line.strip())[:MAX_HEADER]
    text = MARKED.sub("", text).strip("| ") if text.count("|") > 2 else MARKED.sub("", text)
    marks = [mark for mark in (delimiter, ",", ";", "\t", " |", " * ") if mark and mark in text]
    split = [[cell.strip() for cell in text.split(mark)] if mark[0] == " " else cells_of(text, mark)
             for mark in dict.fromkeys(marks)]
    split = [_spaced(text), *split] if delimiter is None else [*split, _spaced(text)]
    return [*(_splits(text[lead.end():], delimiter) if (lead := LEAD.match(text)) else ()), *split]


def _with_vector(cells: list[str]) -> list[str]:
    """Return names in which a last one of a vector, as of Ansys Maxwell, is that of components."""
    vector = next((n for n, cell in enumerate(cells) if VECTOR.match(cell[:MAX_LINE])), None)
    if vector is not None:
        return [*cells[:vector], *column_names.FIELDS[:3]]
    if cells and SCALAR.fullmatch(cells[-1][:MAX_LINE]):
        return [*cells[:-1], column_names.TOTAL]
    return cells


def _spaced(text: str) -> list[str]:
    """Split at spaces; a bracket with a unit belongs to the name before it."""
    found: list[str] = []
    depth = 0
    for word in text.split():
        if found and (depth > 0 or (word[0] in "[(" and found[-1][0] not in "[(")):
            found[-1] += word
        else:
            found.append(word)
        depth += sum(map(word.count, "[(")) - sum(map(word.count, "])"))
    return found


def _refuse_other_length(
    line: str, number: int, count: int, delimiter: str | None, where: str
) -> None:
    """Raise MeasurementError for a header with another number of names than there are columns.

    No header is what has numbers, far fewer words, or as many names if it is split otherwise.
    """
    splits = [_with_vector(cells) for cells in _splits(line, delimiter)]
    if is_comment(line) or any(len(cells) == count or numbers_among(cells) for cells in splits):
        return
    for cells in splits:
        known = [column_names.parse(cell).quantity for cell in cells]
        if sum(map(bool, known)) > RECOGNIZED and 2 * len(cells) >= count:
            raise MeasurementError(must_be(
                f"header in line {number}", where, f"of {count} names, as there are columns",
                str(len(cells)), "State what separates them by --delimiter, correct the header, or "
                "state the columns: --columns NAME,NAME,... takes its place."
                + (" If commas are decimal commas too, write the file anew with semicolons."
                   if delimiter == "," and count > len(cells) else "")))
