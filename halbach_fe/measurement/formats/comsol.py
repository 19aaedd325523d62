"""Import of text files that COMSOL Multiphysics exports: spreadsheets, grids and sections.

All three begin with lines ``% Key: value`` (Model, Version, Dimension, Nodes, Length unit ...). In
a spreadsheet the last of these comments names the columns, ``% x y z mf.Bx (T)``. A grid has three
rows below ``% Grid``, the coordinates along x, y and z; below each ``% Data`` are the values of an
expression, where a row runs along x, and the rows are ordered by y, then by z. A file of sections
has the parts ``% Coordinates``, ``% Elements`` and ``% Data``, with the values in the order of the
coordinates. The expression is in brackets after Data, or in the comment below it. Sources: COMSOL's
Programming Reference Manual, Data Formats, and exported files.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.formats import column_names, delimited_table
from halbach_fe.measurement.formats.column_names import ColumnName
from halbach_fe.measurement.formats.columns_to_map import ForeignTable
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.grid_formats import points_on
from halbach_fe.measurement.text_tables import (
    Line,
    comments_of,
    delimiter_of,
    lines_of,
    number_in_cell,
    uncommented,
)

KEY = re.compile(r"(Model|Version|Date|Dimension|Nodes|Expressions|Description|Length unit)"
                 r"\s*[:,]\s*(.*)")
SECTION = re.compile(r"(Grid|Coordinates|Elements|Data)\b\s*(?:\((.*)\))?\s*")
MAX_LINE = 2000
"""Number of characters of a comment that are searched."""


def is_comsol(lines: Sequence[Line]) -> bool:
    """Return whether the first lines are those of a COMSOL export."""
    said = [found[1] for _, line in lines[:20] if line.startswith("%")
            and (found := KEY.match(uncommented(line)[:MAX_LINE]))]
    return lines[0][1].startswith("%") and len({"Dimension", "Nodes", "Expressions", "Version",
                                                "Length unit"} & set(said)) > 1


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read a spreadsheet, a grid or a file of sections.

    Raises
    ------
    MeasurementError
        If the file holds several solutions, a grid or sections without exactly three coordinates,
        or another number of points than it states.
    """
    lines = lines_of(raw, declared, where)
    keys = {found[1]: found[2].strip() for _, line in lines if line.startswith("%")
            and (found := KEY.match(uncommented(line)[:MAX_LINE]))}
    _refuse_solutions(lines, where)
    sections = _sections(lines)
    if not sections:
        table = delimited_table.read_lines(lines, declared, where)
    else:
        read_points = {"Grid": _grid_points, "Coordinates": _listed_points}.get(sections[0][0])
        if not read_points:
            raise MeasurementError(must_be("sections", where, "beginning with Grid or Coordinates",
                                           sections[0][0]))
        points = read_points(sections[0][2], len(raw), declared, where)
        table = _with_data(points, sections, declared, where)
    if re.fullmatch(r"\d{1,12}", keys.get("Nodes", "")) and int(keys["Nodes"]) != len(table.values):
        raise MeasurementError(must_be("content", where, f"{keys['Nodes']} points, as its header "
                                       "says", str(len(table.values)), "Is the file cut short?"))
    return replace(table, length_unit=keys.get("Length unit", "").strip('"'),
                   comments=comments_of([line for line in lines if KEY.match(
                       uncommented(line[1])[:MAX_LINE]) and line[1].startswith("%")]))


def _refuse_solutions(lines: Sequence[Line], where: str) -> None:
    """Raise MeasurementError for columns of several solutions, such as ``mf.Bx (T) @ t=0``."""
    for position, line in lines:
        if line.startswith("%") and re.search(r"@ ?[\w.]{1,40} ?=", line[:MAX_LINE]):
            raise MeasurementError(must_be(
                f"line {position}", where, "of one static solution",
                f"'{line[line.index('@'):][:40].strip()}'", "Export a single solution."))


def _sections(lines: Sequence[Line]) -> list[tuple[str, str, list[Line]]]:
    """Return kind, expression and lines of each section; a spreadsheet has no sections."""
    found: list[tuple[str, str, list[Line]]] = []
    for position, line in lines:
        if not line.startswith("%"):
            if found:
                found[-1][2].append((position, line))
        elif section := SECTION.fullmatch(uncommented(line)[:MAX_LINE]):
            found.append((section[1], (section[2] or "").strip(), []))
        elif found and found[-1][0] == "Data" and not found[-1][1] and not found[-1][2]:
            found[-1] = ("Data", uncommented(line), found[-1][2])
    return found


def _grid_points(
    lines: Sequence[Line], limit: int, declared: DeclaredFormat, where: str
) -> Floats:
    """Return the points (n, 3) of a grid from its rows of coordinates; x changes fastest.

    ``limit`` is the number of characters of the file. A grid with more points is refused before
    memory is allocated for it, since the file cannot hold their values.
    """
    axes = [_values([line], declared, where) for line in lines]
    if len(axes) != 3:
        raise _not_three(where, f"{len(axes)} rows")
    if math.prod(map(len, axes)) > limit:
        raise MeasurementError(must_be("content", where, " x ".join(str(len(a)) for a in axes)
                                       + " points, as its grid says", "fewer",
                                       "Is the file cut short?"))
    return points_on(axes)


def _listed_points(
    lines: Sequence[Line], limit: int, declared: DeclaredFormat, where: str
) -> Floats:
    """Return the points (n, 3) that are listed in lines of three coordinates."""
    if not lines:
        raise _not_three(where, "none")
    count = len(_values(lines[:1], declared, where))
    if count != 3:
        raise _not_three(where, f"{count} columns")
    for position, line in lines:
        if len(line.split(delimiter_of(line, declared))) != 3:
            raise MeasurementError(must_be(f"line {position}", where, "3 values", "others",
                                           "Is the file cut short?"))
    return _values(lines, declared, where).reshape(-1, 3)


def _not_three(where: str, received: str) -> MeasurementError:
    """Return the error for points that have not exactly three coordinates."""
    return MeasurementError(must_be("coordinates", where, "x, y and z", received,
                                    "Export the spreadsheet format, which names its columns."))


def _with_data(
    points: Floats, sections: Sequence[tuple[str, str, list[Line]]], declared: DeclaredFormat,
    where: str
) -> ForeignTable:
    """Return the table of the points and of the values in all sections of data."""
    found = [ColumnName(axis, axis) for axis in ("x", "y", "z")]
    values = list(points.T)
    for kind, expression, lines in sections[1:]:
        if kind != "Data":
            continue
        data = _values(lines, declared, where)
        if len(data) != len(points):
            raise MeasurementError(must_be(
                f"data of '{expression[:40]}'", where, f"{len(points)} values, one for each point",
                str(len(data)), "Is the file cut short?"))
        found.append(column_names.parse(expression))
        values.append(data)
    return ForeignTable(tuple(found), np.column_stack(values), where)


def _values(lines: Sequence[Line], declared: DeclaredFormat, where: str) -> Floats:
    """Return all numbers of some lines, in their order."""
    found: list[float] = []
    for position, line in lines:
        delimiter = delimiter_of(line, declared)
        try:
            found += [number_in_cell(cell.strip(), declared.decimal_comma)
                      for cell in line.split(delimiter)]
        except ValueError as error:
            raise MeasurementError(must_be(f"line {position}", where, "made of real numbers",
                                           f"'{str(error)[:40]}'")) from None
    return np.array(found)
