"""Files of free blocks: CSV or HDF5, one row per block, one column per key of `FreeBlocks`.

Error messages do not quote text of a file unless it resembles a column's name, because a study can
name any file on the machine.
"""

from __future__ import annotations

import csv
import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import ValidationError

from halbach_fe.core import untrusted
from halbach_fe.core.errors import OutputError, StudyError, must_be, not_utf8
from halbach_fe.core.files import workbook_in, workbook_sentence, write_text
from halbach_fe.core.numbers import (
    MAX_CELL,
    WITH_COMMAS,
    csv_text,
    numbered_lines,
    other_separator,
    parse_number,
)
from halbach_fe.core.untrusted import write_hdf5
from halbach_fe.study import sentences
from halbach_fe.study.free_blocks import COLUMNS, MAX_BLOCKS, FreeBlocks, RowError

Cell = float | int | str | tuple[tuple[float, ...], ...] | None

TEXTS = ("name", "type", "shape", "material")
WHOLE = ("ring", "slot", "sides")
HDF5 = (".h5", ".hdf5", ".nc")
"""Suffixes of HDF5 files; any other suffix is read as CSV."""

MAX_BYTES = 500_000_000
"""Size of the largest file that is read: `MAX_BLOCKS` rows of all columns in full."""

NUMERIC, OUTLINE = frozenset("0123456789+-.eE"), frozenset("0123456789+-.eE ;")
"""Of these characters, `float` accepts the same as `parse_number`, but for infinity."""


@dataclass(frozen=True)
class _Content:
    """Cells of a file by column; ``rows`` name the rows in messages, by number from 0."""

    cells: dict[str, list[Any]]
    rows: Callable[[int], str]


def read_free_blocks(path: str | Path) -> dict[str, list[Cell]]:
    """Read the columns of a table of free blocks; None stands for empty cells.

    ``path``: a CSV file with a header of names from `halbach_fe.study.free_blocks.COLUMNS` in any
    order, in UTF-8; lines that begin with ``#`` are comments. Or an HDF5 file (suffix .h5, .hdf5 or
    .nc) with a dataset (n,) per column; NaN and empty text stand for empty cells. A cell of
    ``outline_m`` lists corners: ``0 0; 0.01 0; 0 0.02``.

    Raises
    ------
    StudyError
        If the file cannot be read, or a cell holds something else than its column says. The message
        names the file and the line.

    Examples
    --------
    >>> write_free_blocks({
    ...     "name": ["rod"], "shape": ["cylinder"], "x_m": [0.1], "y_m": [0.0], "z_m": [0.0],
    ...     "radius_m": [0.005], "remanence_T": [1.3]}, "rods.csv")
    >>> read_free_blocks("rods.csv")["radius_m"]
    [0.005]
    """
    where = f"table of free blocks {path}"
    return _read(Path(path), where).cells


def free_blocks_of_file(path: Path, where: str = "") -> FreeBlocks:
    """Read and validate a table of free blocks; ``where`` is added to its name in messages.

    Raises
    ------
    StudyError
        As of `read_free_blocks`, or if a block is not possible.
    """
    where = f"table of free blocks {path}{where}"
    content = _read(path, where)
    return _validated(content.cells, where, content.rows)


def write_free_blocks(blocks: FreeBlocks | Mapping[str, Sequence[Any]], path: str | Path) -> None:
    """Write a table that `read_free_blocks` reads to the last bit; the suffix gives its format.

    The file is written atomically: it is either complete, or not there.

    Parameters
    ----------
    blocks : FreeBlocks or mapping of sequence
        The table, or its columns by name. Columns without any value are left out.
    path : str or Path
        A file whose suffix is .csv, .h5, .hdf5 or .nc.

    Raises
    ------
    OutputError
        If the suffix is another one, or the file cannot be written.
    StudyError
        If the columns do not make a table of free blocks.
    """
    path = Path(path)
    where = f"table of free blocks {path}"
    if path.suffix not in (".csv", *HDF5):
        raise OutputError(must_be("suffix", where, f".csv, {', '.join(HDF5)}",
                                  f"'{path.suffix}'"))
    table = validated_blocks(blocks, where)
    columns: dict[str, Sequence[Any]] = {
        column: getattr(table, column) for column in COLUMNS if table.given(column).any()}
    if "outline_m" in columns:
        columns["outline_m"] = [_outline_text(outline) for outline in columns["outline_m"]]
    if path.suffix in HDF5:
        write_hdf5(xr.Dataset({column: ("block", _array(column, values))
                               for column, values in columns.items()}), path)
    else:
        write_text(path, csv_text({column: ["" if value is None else str(value)
                                            for value in values]
                                   for column, values in columns.items()}))


def validated_blocks(columns: FreeBlocks | Mapping[str, Sequence[Any]], where: str) -> FreeBlocks:
    """Return columns, by name, as a table of free blocks; raise StudyError if they are none."""
    return _validated(columns, where, lambda number: f"row {number + 1}")


def _validated(given: object, where: str, rows: Callable[[int], str]) -> FreeBlocks:
    try:
        return FreeBlocks.model_validate(given)
    except ValidationError as error:
        raise StudyError(_sentence(error, rows, where)) from None


def _array(column: str, values: Sequence[Any]) -> NDArray[Any]:
    if column in TEXTS or column == "outline_m":
        return np.array([value or "" for value in values], object)
    if None in values:
        return np.array([np.nan if value is None else value for value in values])
    return np.array(values)


def _read(path: Path, where: str) -> _Content:
    try:
        if not path.is_file() and path.exists() and not path.is_dir():
            raise StudyError(must_be("path", where, "a file", "a device"))  # it might never end
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise StudyError(must_be("size", where, f"at most {MAX_BYTES:.2g} bytes", size))
        content = _hdf5(path, where) if path.suffix in HDF5 else _csv(path.read_bytes(), where)
    except OSError as error:
        raise StudyError(must_be("path", where, "a readable file",
                                 f"'{error.strerror or 'no HDF5 file'}'",
                                 "Give its path from the study's folder.")) from None
    for column, cells in content.cells.items():
        content.cells[column] = _parsed(column, cells, content.rows, where)
    return content


def _csv(raw: bytes, where: str) -> _Content:
    """Return the cells of a CSV file as text, "" where they are empty."""
    if workbook_in(raw) is not None:
        raise StudyError(workbook_sentence(where, raw))
    try:
        text = raw.decode("utf-8-sig")  # spreadsheets write a byte order mark
    except UnicodeDecodeError as error:
        raise StudyError(not_utf8(where, error)) from None
    lines = numbered_lines(text)
    _check_count(len(lines) - 1, where)
    if (separator := other_separator(lines[0][1])) is not None:
        raise StudyError(must_be("header", where, "names that commas separate",
                                 f"names that {separator} separate", WITH_COMMAS))
    numbers = [number for number, _ in lines[1:]]
    rows: list[list[str]] = []
    reader = csv.reader((line for _, line in lines), strict=True)
    try:
        for row in reader:
            rows.append(row)
            if reader.line_num != len(rows):  # a cell that goes on in the next line
                raise csv.Error
    except csv.Error:
        raise StudyError(must_be(f"line {lines[min(len(rows), len(lines) - 1)][0]}", where,
                                 "comma-separated values", "an open quotation mark, or too long a "
                                 "cell")) from None
    header = [name.strip() for name in rows.pop(0)]
    _check_columns(header, where)
    for number, row in zip(numbers, rows, strict=True):
        if len(row) != len(header):
            raise StudyError(must_be(f"line {number}", where, f"of {len(header)} cells, as the "
                                     "header", f"{len(row)} cells"))
    cells = {name: [cell.strip() for cell in column]
             for name, column in zip(header, zip(*rows, strict=True), strict=True)}
    return _Content(cells, lambda number: f"line {numbers[number]}")


def _hdf5(path: Path, where: str) -> _Content:
    """Return the cells of an HDF5 file, numbers or text, "" or NaN where they are empty."""
    try:
        data = untrusted.read_dataset(path)
    except ValueError as error:
        raise StudyError(must_be("content", where, "an HDF5 file of numbers and text",
                                 f"'{error}'")) from None
    _check_columns([str(name) for name in data.variables], where)
    cells, count = {}, next(iter(data.sizes.values()), 0)
    for name, variable in data.variables.items():
        if variable.shape != (count,) or variable.dtype.kind not in "biufOSUT":
            raise StudyError(must_be(f"`{name}`", where, f"{count} numbers or texts",
                                     f"an array {variable.shape} of {variable.dtype}"))
        cells[str(name)] = variable.values.tolist()
    _check_count(count, where)
    return _Content(cells, lambda number: f"row {number + 1}")


def _check_columns(header: Sequence[str], where: str) -> None:
    """Refuse unknown and repeated columns, and tables of something else."""
    if "serial" in header and "mx_A_m2" in header:
        raise StudyError(must_be(
            "header", where, "that of where blocks are", "a table of measured moments",
            "Give it to halbach-fe prior, infer or sort, beside the study of the magnet; "
            "halbach-fe export STUDY --format blocks writes a table of where its blocks are."))
    for number, name in enumerate(header, start=1):
        if name in COLUMNS:
            if header.index(name) < number - 1:
                raise StudyError(must_be("header", where, "without repeated columns", f"'{name}'"))
            continue
        near = [column for column in COLUMNS if name and column.startswith(f"{name}_")] or (
            difflib.get_close_matches(name[:100], COLUMNS, 1, 0.6))
        raise StudyError(must_be(
            f"column {number}", where, "a known column", f"'{name}'" if near else "another name",
            sentences.did_you_mean(near[0], name) if near
            else f"Known columns: {', '.join(COLUMNS)}."))


def _check_count(count: int, where: str) -> None:
    if not 1 <= count <= MAX_BLOCKS:
        raise StudyError(must_be("content", where, f"a header, and 1 to {MAX_BLOCKS} blocks",
                                 max(0, count)))


def _parsed(column: str, cells: list[Any], rows: Callable[[int], str], where: str) -> list[Cell]:
    """Return the values of a column, None where a cell is empty or NaN (not equal to itself)."""
    kind: Callable[[object], Cell] = _text
    expected = "printable text"
    quick: list[Cell] | None = None
    if column == "outline_m":
        kind, expected = outline_of, "corners as `x y; x y; x y`"
    elif column in WHOLE:
        kind, expected = _whole, "a whole number"
    elif column not in TEXTS:
        quick, kind, expected = _numbers(cells), _number, "a finite number"
    elif isinstance(cells[0], str) and "".join(cells).isprintable():
        quick = [cell or None for cell in cells]
    if quick is not None:
        return quick
    found: list[Cell] = []
    for number, cell in enumerate(cells):
        try:
            found.append(None if cell in ("", b"") or cell != cell else kind(cell))
        except ValueError:
            raise StudyError(must_be(f"`{column}` in {rows(number)}", where, expected,
                                     "something else")) from None
    return found


def _numbers(cells: list[Any]) -> list[Cell] | None:
    """Return numbers if all cells are plain ones or empty, else None: ten times faster."""
    try:
        if not isinstance(cells[0], str):
            return None if np.isinf(cells).any() else [
                None if cell != cell else float(cell) for cell in cells]
        if not (NUMERIC.issuperset("".join(cells)) and max(map(len, cells)) <= MAX_CELL):
            return None
        values: list[Cell] = [float(cell) if cell else None for cell in cells]
    except (TypeError, ValueError):
        return None
    return values if np.isfinite([value or 0.0 for value in values]).all() else None


def _number(cell: object) -> float:
    if isinstance(cell, str):
        return parse_number(cell)
    if not isinstance(cell, int | float) or not np.isfinite(cell):
        raise ValueError
    return float(cell)


def _whole(cell: object) -> int:
    value = _number(cell)
    if value != int(value):
        raise ValueError
    return int(value)


def _text(cell: object) -> str:
    text = cell.decode() if isinstance(cell, bytes) else cell
    if not isinstance(text, str) or not text.isprintable():
        raise ValueError
    return text


def outline_of(cell: object) -> tuple[tuple[float, ...], ...]:
    """Return the corners in m that a text lists, `x y; x y; x y`; else raise ValueError."""
    text = _text(cell)
    number = float if OUTLINE.issuperset(text) else parse_number
    corners = tuple(tuple(map(number, corner.split())) for corner in text.split(";"))
    if any(len(corner) != 2 for corner in corners):
        raise ValueError
    return corners


def _outline_text(outline: Iterable[Iterable[float]] | None) -> str | None:
    if outline is None:
        return None
    return "; ".join(" ".join(repr(float(value)) for value in corner) for corner in outline)


def _sentence(error: ValidationError, rows: Callable[[int], str], where: str) -> str:
    """Return one sentence about the first of pydantic's errors."""
    first = error.errors(include_url=False)[0]
    given, ours = first.get("input"), sentences.contradiction(first)
    cause = first.get("ctx", {}).get("error")
    column, place = ([*first["loc"], None, None])[:2]
    what = "content" if column is None else f"`{column}`"
    if isinstance(cause, RowError):
        what = rows(cause.number)
    elif isinstance(place, int):
        what += f" in {rows(place)}"
    if ours is not None:
        return f"Input {what} of {where} must be consistent: {ours}."
    if given is None:
        return must_be(what, where, "given", "nothing")
    if not isinstance(given, int | float):
        return must_be(what, where, sentences.expected(first), sentences.received(given))
    return must_be(what, where, sentences.expected(first), f"{given:g}",
                   sentences.wrong_unit(str(column), given, first.get("ctx", {})))
