"""Import of field tables of Opera, as its TABLE command writes them, and export for Geant4.

::

     5 461 311 2                  three counts, of a grid along x, y and z, and a flag
     1 X [METRE]                  a number, a name and a unit for each column
     ...
     6 BZ [TESLA]
     0                            the end of the header; [METRE] here is the unit of all lengths
     -0.55 -1.1 -0.01 0.5e-4 0.4e-5 -0.2e-2

The first line may be blank. A list of points has its length three times in place of the counts.
Units may be missing, or LENGU and FLUXU, which state no unit. Sources of the layout: the table of
Geant4's example purging_magnet, and the tables that OPAL (tests of SBend3D) and musrSim (its
manual) read.

Exports are for Geant4's PurgMagTabulatedField3D (.cc file of this class, and PurgMag3D.TABLE): in
metres and tesla, with z that changes fastest. Its reader ends the header at the first line whose
second character is 0, and reads lines into a buffer of 256 characters. It expects a seventh column,
the permeability, but ignores it; the export writes that of vacuum. The units in the header are for
other readers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.formats import names
from halbach_fe.measurement.formats.conversion import ForeignTable
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.grid import Grid
from halbach_fe.measurement.formats.names import ColumnName
from halbach_fe.measurement.tables import MAX_LINE, Line, lines_of, rows_of
from halbach_fe.study.materials import MU_0

COUNTS = re.compile(r"\s*(\d{1,9})\s+(\d{1,9})\s+(\d{1,9})(\s+\d{1,9})?\s*")
COLUMN = re.compile(r"\s*([1-9]\d?)\s+([A-Za-z][^\s\[]*)\s*(?:\[([^\[\]]*)\])?\s*")
END = re.compile(r"\s*0\s*(?:\[([^\[\]]*)\])?\s*")
EXPORTED = (" 1 X [METRE]", " 2 Y [METRE]", " 3 Z [METRE]", " 4 BX [TESLA]", " 5 BY [TESLA]",
            " 6 BZ [TESLA]", " 7 BMOD/HMOD", " 0 [METRE]")


def is_opera(lines: Sequence[Line]) -> bool:
    """Return whether the first lines are those of an Opera table."""
    first = [line for _, line in lines[:2] if len(line) <= MAX_LINE]
    return len(first) == 2 and bool(COUNTS.fullmatch(first[0])) and bool(COLUMN.fullmatch(first[1]))


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read an Opera table; its points may come in any order.

    Raises
    ------
    MeasurementError
        If the header is not that of an Opera table, or states another number of points than follow.
    """
    lines = lines_of(raw, declared, where)
    counts = COUNTS.fullmatch(lines[0][1][:MAX_LINE])
    if not counts:
        raise MeasurementError(must_be("first line", where, "the three counts of an Opera table",
                                       f"'{lines[0][1].strip()[:40]}'"))
    columns, length_unit, start = _columns(lines, where)
    values, texts = rows_of(lines[start:], len(columns), None, declared, where)
    grid = [int(text) for text in counts.groups()[:3]]
    listed = len(set(grid)) == 1 and len(values) == grid[0]
    if len(values) != grid[0] * grid[1] * grid[2] and not listed:
        raise MeasurementError(must_be(
            "content", where, f"{grid[0]} x {grid[1]} x {grid[2]} points, as its first line says",
            str(len(values)), "Is the file cut short?"))
    return ForeignTable(columns, values, where, length_unit=length_unit, texts=texts)


def _columns(lines: Sequence[Line], where: str) -> tuple[tuple[ColumnName, ...], str, int]:
    """Return the columns, the unit of all lengths, and the index of the first row."""
    columns: list[ColumnName] = []
    for index, (number, line) in enumerate(lines[1:], 1):
        line = line[:MAX_LINE]
        if end := END.fullmatch(line):
            if not columns:
                break
            return tuple(columns), (end[1] or "").strip(), index + 1
        column = COLUMN.fullmatch(line)
        if not column or int(column[1]) != len(columns) + 1:
            raise MeasurementError(must_be(
                f"line {number}", where, f"column {len(columns) + 1} of the header (number, name, "
                "[unit]), or its end, 0", f"'{line.strip()[:40]}'"))
        name = names.parse(column[2])
        columns.append(ColumnName(name.text, name.quantity, (column[3] or "").strip()))
    raise MeasurementError(must_be("header", where, "columns and a line 0 after them",
                                   "a header without them"))


def lines(grid: Grid) -> Iterator[str]:
    """Yield the lines of a file for Geant4."""
    yield ""
    nx, ny, nz = grid.shape
    yield f" {nx} {ny} {nz} "  # without the last space the reader would parse the previous line
    yield from EXPORTED
    for row in grid.rows():
        yield f"{row} {MU_0!r}"
