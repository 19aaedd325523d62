"""Tables in text: our own CSV, with attributes in its comments, and those of other programs.

Lines, comments, cells and numbers; errors name the file, the line and the cell. Also times of
readings: numbers in a unit, times of day (14:23:59, 142359) and ISO stamps.
"""

from __future__ import annotations

import codecs
import csv
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from itertools import groupby
from pathlib import Path

import numpy as np

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachWarning, MeasurementError, must_be, not_utf8, printable
from halbach_fe.core.files import workbook_in
from halbach_fe.core.numbers import MAX_CELL, WITH_COMMAS, in_a_row, other_separator
from halbach_fe.core.numbers import parse_number as number_in
from halbach_fe.measurement.formats.declared_format import DELIMITERS, DeclaredFormat


def csv_table(
    raw: bytes, where: str, hint: str = ""
) -> tuple[dict[str, str], list[str], Iterator[tuple[int, list[str]]]]:
    """Split the content of a CSV file into attributes, header and rows.

    Parameters
    ----------
    raw : bytes
        Content of the file.
    where : str
        Name of the file in error messages.
    hint : str
        What to do if the file has no header.

    Returns
    -------
    attributes : dict
        Key and value of each comment ``# key: value``.
    header : list of str
        Names of the columns.
    rows : iterator of (int, list of str)
        Line number and cells of each row.

    Raises
    ------
    MeasurementError
        If the content is not UTF-8 text, or has no header. The iterator raises it if there are no
        rows, or a row has another length than the header; the caller can thus check the header
        first.
    """
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise MeasurementError(not_utf8(where, error)) from None
    attributes: dict[str, str] = {}
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        comment = re.match(r"\s*#\s*(?:([^:]+?)\s*:\s*(.*))?", line)
        if comment:
            if comment[1]:
                attributes[comment[1]] = comment[2].strip()
        elif line.strip():
            if not rows and (separator := other_separator(line)) is not None:
                raise MeasurementError(must_be("header", where, "names that commas separate",
                                               f"names that {separator} separate",
                                               hint or WITH_COMMAS))
            rows.append((number, _cells(line, number, where)))
    if not rows:
        raise MeasurementError(must_be("content", where, "a table with a header", "only comments"))
    header = rows[0][1]
    if all(map(_is_number, header)):
        raise MeasurementError(must_be("header", where, "the names of columns", "numbers", hint))
    if len(set(header)) < len(header):
        raise MeasurementError(must_be("header", where, "without repeated columns",
                                       ",".join(header)))
    return attributes, header, _equally_long(len(header), rows[1:], where)


def _equally_long(
    count: int, rows: list[tuple[int, list[str]]], where: str
) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows; raise MeasurementError if there are none, or one has not ``count`` cells."""
    if not rows:
        raise MeasurementError(must_be("content", where, "at least one row of numbers",
                                       "a header alone"))
    for number, cells in rows:
        if len(cells) != count:
            raise MeasurementError(must_be(f"line {number}", where, f"{count} values",
                                           str(len(cells)), "Is the file cut short?"))
        yield number, cells


def _is_number(cell: str) -> bool:
    """Tell whether a cell holds a number."""
    try:
        number_in(cell)
    except ValueError:
        return False
    return True


def check_columns(
    header: Sequence[str], known: Sequence[str], where: str, hint: str = "Rename or remove it."
) -> None:
    """Raise MeasurementError if the header has an unknown column."""
    for name in header:
        if name not in known:
            raise MeasurementError(must_be("header", where, f"made of {', '.join(known)}",
                                           f"column '{name}'", hint))


def write_csv(columns: Mapping[str, Iterable[object]], attributes: Mapping[str, str],
              path: Path) -> None:
    """Write named columns, with attributes as comments; NaN becomes an empty cell."""
    with path.open("w", encoding="utf-8", newline="") as file:
        for key, value in attributes.items():
            file.write(f"# {_one_line(key)}: {_one_line(value)}\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([_cell(value) for value in row])


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


def _cell(value: object) -> str:
    if isinstance(value, float | np.floating):
        return "" if np.isnan(value) else repr(float(value))
    return _one_line(value)


def _cells(line: str, number: int, where: str) -> list[str]:
    try:
        cells = [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise MeasurementError(must_be(f"line {number}", where, "comma-separated values",
                                       f"'{error}'")) from None
    _check_printable(cells, f"line {number}", where)
    return cells


def _check_printable(names: Iterable[str], what: str, where: str) -> None:
    """Raise MeasurementError for control characters.

    Serial numbers, types and scans are printed in terminals and written to other files.
    """
    for name in names:
        if not name.isprintable():
            raise MeasurementError(must_be(what, where, "without control characters", f"'{name}'"))


def finite(cell: str, what: str, where: str, hint: str = "") -> float:
    """Return the number in a cell; raise MeasurementError if the cell holds no finite number.

    ``what`` and ``where`` name the cell and the file in the message; ``hint`` is appended to it.
    """
    try:
        return number_in(cell)
    except ValueError:
        raise MeasurementError(must_be(what, where, "a finite number", f"'{cell}'",
                                       hint)) from None


TIME_OF_DAY = re.compile(r"([01]?\d|2[0-3]):([0-5]\d):([0-5]\d(?:[.,]\d{1,9})?)")


def look_like_clock(values: Floats) -> bool:
    """Return whether numbers may be times of day, HHMMSS, that are taken for seconds.

    All are whole, of at least 5 digits, and hours, minutes and seconds of a day, and they are of
    more than one minute: within a minute both are the same. A counter of seconds that passes from
    one hundred to the next in steps of up to 40 s has a number that ends on more than 59.
    """
    # Smallest number that is taken for a time of day, 1:00:00: counters of seconds begin below.
    least_clock = 10_000
    known = values[np.isfinite(values)]
    whole = known == np.floor(known)
    if not whole.all() or not known.size or known.min() < least_clock:
        return False
    minutes = known // 100
    return len(np.unique(minutes)) > 1 and bool(
        ((known < 240_000) & (known % 100 < 60) & (minutes % 100 < 60)).all())


def times_from_clock(values: Floats) -> Floats | None:
    """Return times (n,) in s after the first one of numbers HHMMSS; None if they are none."""
    valid = (values >= 0) & (values < 240_000) & (values % 100 < 60) & (values // 100 % 100 < 60)
    if not valid.all():
        return None
    return _over_midnight(values // 10_000 * 3600 + values // 100 % 100 * 60 + values % 100)


def times_from_texts(cells: Sequence[str]) -> Floats | None:
    """Return times (n,) in s after the first one of times of day or ISO stamps.

    None stands for cells that are neither. 14:23 may be hours and minutes, or minutes and seconds.
    """
    found = [TIME_OF_DAY.fullmatch(cell.strip()) for cell in cells]
    if all(found):
        return _over_midnight(np.array([
            int(part[1]) * 3600 + int(part[2]) * 60 + float(part[3].replace(",", "."))
            for part in found if part]))
    try:
        stamps = [datetime.fromisoformat(cell.strip()) for cell in cells]
        first = min(stamps)
        return np.array([(stamp - first) / timedelta(seconds=1) for stamp in stamps])
    except (ValueError, TypeError, OverflowError):  # TypeError: only some have a time zone
        return None


def _over_midnight(times: Floats) -> Floats:
    """Return times of day as times after the first one.

    Midnight has passed where they fall back by more than half a day. Rows that are not in the order
    of time may also go back to the day before.
    """
    steps = np.diff(times, prepend=times[:1])
    days = np.zeros(len(times))
    day = 0
    day_s = 86_400.0
    for row in np.flatnonzero(np.abs(steps) > day_s / 2):
        day = day + 1 if steps[row] < 0 else max(0, day - 1)
        days[row:] = day
    times = times + day_s * days
    return np.asarray(times - times.min())


COMMENTS = "#%!"
"""Characters that begin a comment."""
THOUSANDS = {
    False: re.compile(r"[-+]?\d{1,3}(,\d{3}){1,9}\.\d{1,30}", re.ASCII),
    True: re.compile(r"[-+]?\d{1,3}(\.\d{3}){1,9},\d{1,30}", re.ASCII)}
"""Numbers without and with a decimal comma whose thousands are separated by the other mark."""
GROUPED = re.compile(r"(?<=\d)['\u2019\u00a0\u2009\u202f](?=\d{3}(?!\d))")
"""An apostrophe or a narrow blank before three digits, which separates thousands."""
MISSING = frozenset((
    "", "nan", "+nan", "-nan", "na", "n/a", "#n/a", "#nv", "null", "none", "nil", "-", "--", "---",
    "nan(ind)", "-nan(ind)", "1.#qnan", "-1.#ind", "1.#ind"))
"""Cells in lower case by which programs say that there is no number."""
MARKS = str.maketrans("\uff08\uff09\uff0c\uff1b\uff1a\u2212\u3000", "(),;:- ")
"""Wide brackets, commas and blanks of Chinese and Japanese text, and the typographic minus."""
SIGNATURES = {
    b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip, as NumPy's .npz", b"\x93NUMPY": "NumPy",
    b"MATLAB 5.0 MAT": "MATLAB", b"\x89HDF\r\n\x1a\n": "HDF5", b"%PDF": "PDF", b"\x89PNG": "PNG",
    b"SDDS": "binary SDDS"}
"""First bytes of files that are not text."""
RUN_TOGETHER = re.compile(r"(\.\d+(?:[eEdD][-+]\d+)?)(?=[-+]\d*\.\d)")
"""A number that another one follows without a blank, as in columns of fixed width."""
IN_LISTS = frozenset("0123456789+-.,;eE*^|[]{}() \t")
"""Characters of rows of numbers in the brackets of lists or between bars."""
COMPLEX = re.compile(r"[-+]?[\d.]+([eE][-+]?\d+)?[-+][\d.]+([eE][-+]?\d+)?\s*\*?[ij]")
MAX_LINE = 200
"""Number of characters of a line of a header that are searched."""
MAX_COMMENTS = 2000
"""Largest number of characters of comments that are kept."""

MOST_LINES = 4
"""Most lines of a file over which a reading is looked for."""

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
    if default and not marked:
        _refuse_binary(raw, where)
    try:
        text = raw.decode("utf-16" if marked and default else declared.encoding)
    except LookupError:
        raise MeasurementError(must_be("encoding", where, "one of text (--encoding)",
                                       f"'{declared.encoding}'")) from None
    except ValueError:
        raise MeasurementError(must_be(
            "encoding", where, declared.encoding.removesuffix("-sig").upper(), "other bytes",
            "Is it text? Then name its encoding (--encoding latin-1, utf-16, gbk or "
            "shift_jis).")) from None
    text = text.rstrip("\0\x1a\r\n").translate(MARKS)  # some programs mark the end
    found = [(number, line) for number, line in enumerate(text.splitlines(), 1)
             if line.strip() and number > declared.skip_lines]
    if not found:
        raise MeasurementError(must_be("content", where, "a table of readings", "blank lines"))
    return found


def _refuse_binary(raw: bytes, where: str) -> None:
    """Raise MeasurementError for a file that is not text, whatever its encoding."""
    kind = next((name for start, name in SIGNATURES.items() if raw.startswith(start)), "")
    if kind and (raw[:2000].isascii() and b"\0" not in raw[:2000]):
        kind = ""  # as the ASCII variant of SDDS
    if not kind and raw[:2000].rstrip(b"\0").count(b"\0") < 2:
        return
    raise MeasurementError(must_be(
        "content", where, "text", f"a binary file{f' ({kind})' if kind else ''}",
        "Unpack it, or write it as CSV with a header of names and units; in Python, for a map: "
        "numpy.savetxt('map.csv', table, delimiter=',', comments='', "
        "header='x[m],y[m],z[m],Bx[T],By[T],Bz[T]')."))


def undecorated(line: str) -> str:
    """Return a row of numbers without the brackets, bars and stars that some programs print."""
    line = _without_end(line)
    starred = line.strip().startswith("* ") and line.rstrip().endswith(" *")
    listed = any(mark in line for mark in "|[]{}") and IN_LISTS.issuperset(line)
    if len(line) > MAX_COMMENTS or not (starred or listed):
        return line
    mark = "," if re.search(r"\d,[-+.\d]", line) else " "
    line = re.sub(r"[\])}]\s*[,;]?\s*[\[({]", mark, line)  # between two lists
    numbers = re.sub(r"[\[\](){}|]|(?<!\S)\*(?!\S)", " ", line)
    return " ".join(re.sub(r"[,;]\s", " ", f"{numbers} ").split())


def _without_end(line: str) -> str:
    """Return a row without the one semicolon that ends it, as rows of a matrix in MATLAB."""
    if line.count(";") != 1 or not line.rstrip().endswith(";"):
        return line
    row = line.rstrip(" \t\r;")
    return row if len(re.split(r"[ \t,]+", row.lstrip())) > 2 else line


def text_of_table(raw: bytes, where: str, decimal_comma: bool) -> bytes:
    """Return the content of a file, of a workbook its first sheet with rows of numbers as CSV.

    If others have such rows too, a warning says which was read.

    Raises
    ------
    MeasurementError
        If a workbook cannot be read.
    """
    if workbook_in(raw) is None:
        return raw
    try:
        text, sheet, others = untrusted_files.sheet_text(raw, decimal_comma)
    except ValueError as error:
        raise MeasurementError(must_be(
            "content", where, "an Excel workbook that is whole", f"'{error}'",
            "Save the sheet as CSV.")) from None
    if others:
        names = in_a_row([f"'{printable(other, 60)}'" for other in others[:5]])
        warnings.warn(f"Of {where} the sheet '{printable(sheet, 60)}' is read; {names} would have "
                      "to be saved as CSV.", HalbachWarning, stacklevel=2)
    return text


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
    if '","' in line.replace(" ", ""):  # quoted, so that decimal commas do not matter
        return ","
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


def number_in_cell(cell: str, decimal_comma: bool) -> float:
    """Return the number in a cell, NaN if it says that there is none; else raise ValueError."""
    if cell.lower() in MISSING:
        return np.nan
    if not (cell.isascii() and cell.replace("-", "").replace(".", "").isdigit()) or decimal_comma:
        cell = GROUPED.sub("", cell[:MAX_CELL + 1]).replace("*^", "e")  # as Mathematica writes
        if THOUSANDS[decimal_comma].fullmatch(cell):
            cell = cell.replace("." if decimal_comma else ",", "")
    if decimal_comma:
        if "." in cell:  # 1.234 could be 1234, or a number with a decimal point
            raise ValueError(cell)
        cell = cell.replace(",", ".")
    return number_in(cell)


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
    columns : int
        Number of cells that each row must have.
    delimiter : str or None
        See `delimiter_of`.
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
            joined = _joined(lines, delimiter) if len(rows) == 1 else ""
            raise MeasurementError(must_be(
                f"line {position}", where, f"{columns} values", str(len(cells)),
                joined or _below(lines, declared)
                or "Is the file cut short? Else remove the line, or begin it with #"
                + ("." if position == lines[-1][0] else
                   f"; if the table begins below it, add --skip-lines {position}, if with it, "
                   f"--skip-lines {position - 1}; if cells are separated otherwise, "
                   "--delimiter.")))
        row = [_number_or_none(cell, declared.decimal_comma) for cell in cells]
        for column, value in enumerate(row):
            if value is None:
                texts.setdefault(column, {})[len(rows)] = (position, cells[column])
        rows.append([np.nan if value is None else value for value in row])
    if not rows:
        raise MeasurementError(must_be("content", where, "at least one reading", "none"))
    return np.array(rows), texts


def _joined(lines: Sequence[Line], delimiter: str | None) -> str:
    """Return what to do if rows of some lengths follow each other again and again, else ""."""
    lengths = [len(cells_of(text, delimiter)) for _, text in lines[:3 * MOST_LINES]
               if not is_comment(text)]
    period = next((n for n in range(2, MOST_LINES + 1)
                   if len(lengths) >= 2 * n and lengths == (lengths[:n] * len(lengths))[
                       :len(lengths)]), 0)
    return joining(period, lines[0][0], delimiter) if period else ""


def _below(lines: Sequence[Line], declared: DeclaredFormat) -> str:
    """Return what to do if most rows are equally long, from a line on and not above it, or if
    tables follow each other; else an empty string.
    """
    most_runs = 6  # of equally long rows, above a table or where it is damaged
    rows = [(number, len(cells_of(line, delimiter_of(line, declared))))
            for number, line in lines if not is_comment(line)]
    runs = [list(run) for _, run in groupby(rows, lambda row: row[1])]
    number, count = runs[-1][0]
    if 2 * len(runs[-1]) > len(rows) and all(run[0][1] != count for run in runs[:-1]):
        return (f"From line {number} on all rows have {count} {'value' if count == 1 else 'values'}"
                f": if they are the table, add --skip-lines {number - 1}, and state what is above "
                "them by --columns, --at or --positions.")
    return "" if len(runs) <= most_runs else (
        "If several tables are below each other, write them as one, as CSV with a header as "
        "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T] and a row for each reading.")


def joining(lines: int, first: int, delimiter: str | None) -> str:
    """Return what to do with readings of several lines each; line ``first`` begins the table."""
    mark = {None: " ", "\t": r"\t"}.get(delimiter, delimiter)
    above = f"(head -n {first - 1} FILE; tail -n +{first} FILE | " if first > 1 else ""
    return (f"If each reading stands in {lines} lines, join them: {above}paste -d '{mark}' "
            f"{' '.join('-' * lines)}{') > NEW' if above else ' < FILE > NEW'}.")


def comma_hint(cell: str) -> str:
    """Return what to do with a cell that is nearly a number, else an empty string."""
    cell = cell.strip()
    if len(cell) > MAX_CELL:
        return ""
    if re.fullmatch(r"[-+]?(\d+\.\d*|\.\d+)[-+]\d{1,3}", cell):
        return (r"Write exponents with their letter, as in 1.2e-05: sed -E "
                r"'s/([0-9.])([-+][0-9])/\1e\2/g' FILE > NEW.")
    if re.fullmatch(r"[-+]?[\d.'\u2019\u00a0\u2009\u202f]*,\d+([eE][-+]?\d+)?", cell):
        return "If its comma is a decimal comma, add --decimal-comma."
    if re.fullmatch(r"[-+\d.,eE]+\s*(\u00b1|\+/?-).*", cell):
        return ("Write the number alone, and its standard deviation in a column of its own, "
                "sigma_Bx.")
    if re.fullmatch(r"[-+]?[\d.]*\d([eE][-+]?\d+)?\s*[^\W\d_]{1,5}", cell):
        return "Write the number alone, and its unit in the header, as in Bx[mT]."
    if COMPLEX.fullmatch(cell):
        return "Write real parts alone, in COMSOL as real(mf.Bx)."
    return ""
