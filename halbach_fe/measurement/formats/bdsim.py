"""Import and export of field maps of BDSIM (``bdsim3d``).

The file has keys ``nx> 5``, ``xmin> -2.0`` ..., a line ``! X Y Z Fx Fy Fz``, and rows in cm and T.
The x coordinate changes fastest, which is BDSIM's ``loopOrder> xyzt``. BDSIM's loader takes the
grid from the keys and assigns the values by the order of the rows. Source: BDSIM's manual, Field
Map File Formats.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.formats import columns
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.grid import Grid
from halbach_fe.measurement.formats.names import ColumnName
from halbach_fe.measurement.formats.table import ForeignTable
from halbach_fe.measurement.formats.text import Line, is_comment, lines_of, uncommented
from halbach_fe.study.types import COMPONENTS

PER_M = 100.0
"""Centimetres per metre."""
KEY = re.compile(r"\s*(n[xyzt]|[xyzt](?:min|max)|loopOrder)>\s*(\S{1,30})\s*")
NAMES = {"X": ("x", "cm"), "Y": ("y", "cm"), "Z": ("z", "cm"), "Fx": ("Bx", "T"),
         "Fy": ("By", "T"), "Fz": ("Bz", "T")}
MAX_LINE = 200
"""Number of characters of a line of the header that are searched."""


def is_bdsim(lines: Sequence[Line]) -> bool:
    """Return whether the first lines that are no comments are keys of BDSIM."""
    first = [line[:MAX_LINE] for _, line in lines[:20] if not is_comment(line)]
    return bool(first) and bool(KEY.fullmatch(first[0]))


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read a map in cm and T, of one, two or three coordinates.

    Raises
    ------
    MeasurementError
        If the header names other columns, or another number of points than follow.
    """
    lines = lines_of(raw, declared, where)
    keys = {found[1]: found[2] for _, line in lines if (found := KEY.fullmatch(line[:MAX_LINE]))}
    rest = [line for line in lines if not KEY.fullmatch(line[1][:MAX_LINE])]
    header = next((uncommented(line).split() for _, line in rest
                   if line.lstrip().startswith("!")), [])
    table = columns.read_lines(rest, declared, where)
    if not set(header) <= set(NAMES) or len(header) != table.values.shape[1]:
        raise MeasurementError(must_be(
            "header", where, "a line ! X Y Z Fx Fy Fz, of a field that does not change in time",
            " ".join(header)[:60] or "none"))
    try:
        count = int(np.prod([int(keys[name][:9]) for name in ("nx", "ny", "nz") if name in keys]))
    except ValueError:
        count = 0
    if count != len(table.values):
        raise MeasurementError(must_be("content", where, f"{count} points, as its keys say",
                                       str(len(table.values)), "Is the file cut short?"))
    return replace(table, columns=tuple(ColumnName(name, *NAMES[name]) for name in header))


def lines(grid: Grid) -> Iterator[str]:
    """Yield the lines of the file."""
    for name, axis in zip(COMPONENTS, grid.axes, strict=True):
        yield f"n{name}> {len(axis)}"
        yield f"{name}min> {PER_M * float(axis[0])!r}"
        yield f"{name}max> {PER_M * float(axis[-1])!r}"
    yield "loopOrder> xyzt"
    yield "! X Y Z Fx Fy Fz"
    xs, ys, zs = (axis.tolist() for axis in grid.axes)
    for k, z in enumerate(zs):
        for j, y in enumerate(ys):
            for x, field in zip(xs, grid.field[:, j, k].tolist(), strict=True):
                yield " ".join(repr(value) for value in (PER_M * x, PER_M * y, PER_M * z, *field))
