"""CSV tables with attributes in their comments; errors name the file, the line and the cell.

Also times of readings: numbers in a unit, times of day (14:23:59, 142359) and ISO stamps.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be, not_utf8
from halbach_fe.core.numbers import WITH_COMMAS, other_separator
from halbach_fe.core.numbers import parse_number as number_in


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
