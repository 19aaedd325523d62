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

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.formats import delimited_table
from halbach_fe.measurement.formats.conversion import ForeignTable
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.grid import Grid
from halbach_fe.measurement.formats.names import ColumnName
from halbach_fe.measurement.tables import MAX_LINE, Line, is_comment, lines_of, uncommented
from halbach_fe.study.types import COMPONENTS

PER_M = 100.0
"""Centimetres per metre."""
KEY = re.compile(r"\s*(n[xyzt]|[xyzt](?:min|max)|loopOrder)>\s*(\S{1,30})\s*")
NAMES = {"X": ("x", "cm"), "Y": ("y", "cm"), "Z": ("z", "cm"), "Fx": ("Bx", "T"),
         "Fy": ("By", "T"), "Fz": ("Bz", "T")}
NEAR = 0.01
"""Largest distance of a column's coordinate from that of the keys, in steps of the grid: columns
are printed with few digits."""


def is_bdsim(lines: Sequence[Line]) -> bool:
    """Return whether the first lines that are no comments are keys of BDSIM."""
    first = [line[:MAX_LINE] for _, line in lines[:20] if not is_comment(line)]
    return bool(first) and bool(KEY.fullmatch(first[0]))


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read a map in cm and T, of one, two or three coordinates.

    Raises
    ------
    MeasurementError
        If the header names other columns, or another number of points than follow, or if the keys
        describe another grid than the columns.
    """
    lines = lines_of(raw, declared, where)
    keys = {found[1]: found[2] for _, line in lines if (found := KEY.fullmatch(line[:MAX_LINE]))}
    rest = [line for line in lines if not KEY.fullmatch(line[1][:MAX_LINE])]
    header = next((uncommented(line).split() for _, line in rest
                   if line.lstrip().startswith("!")), [])
    table = delimited_table.read_lines(rest, declared, where)
    if not set(header) <= set(NAMES) or len(header) != table.values.shape[1]:
        raise MeasurementError(must_be(
            "header", where, "a line ! X Y Z Fx Fy Fz, of a field that does not change in time",
            " ".join(header)[:60] or "none"))
    try:
        counts = [int(keys[name][:9]) for name in ("nx", "ny", "nz") if name in keys]
        count = int(np.prod(counts)) if min(counts, default=1) > 0 else 0
    except ValueError:
        count = 0
    if count != len(table.values):
        raise MeasurementError(must_be("content", where, f"{count} points, as its keys say",
                                       str(len(table.values)), "Is the file cut short?"))
    columns_of_file = tuple(ColumnName(name, *NAMES[name]) for name in header)
    remarks = _compare_grids(keys, header, table.values, where)
    return replace(table, columns=columns_of_file, remarks=table.remarks + remarks)


def _compare_grids(
    keys: dict[str, str], header: Sequence[str], values: Floats, where: str
) -> tuple[str, ...]:
    """Compare the grid of the keys, which BDSIM uses, with the columns, which are read here.

    Returns
    -------
    tuple of str
        What the user should know if the rows are in another order than BDSIM takes them.

    Raises
    ------
    MeasurementError
        If the coordinates of the columns are not those of the keys.
    """
    axes = {}
    for axis in "xyz":
        column = axis.upper()
        if column not in header or not {f"n{axis}", f"{axis}min", f"{axis}max"} <= keys.keys():
            continue
        try:
            low, high = float(keys[f"{axis}min"]), float(keys[f"{axis}max"])
        except ValueError:
            low = high = np.nan
        found, count = values[:, header.index(column)], int(keys[f"n{axis}"][:9])
        near = NEAR * (abs(high - low) / max(count - 1, 1) or 1.0)
        if not max(abs(found.min() - low), abs(found.max() - high)) <= near:
            raise MeasurementError(must_be(
                f"column {column}", where, f"from {keys[f'{axis}min']} to {keys[f'{axis}max']} cm, "
                f"as its keys {axis}min and {axis}max say", f"{found.min():g} to {found.max():g}",
                "BDSIM goes by the keys; correct them, or the column."))
        axes[column] = np.linspace(low, high, count), near
    order = list(axes) if "loopOrder" not in keys or keys["loopOrder"][:1] == "x" else [*axes][::-1]
    grids = np.meshgrid(*(axes[column][0] for column in order[::-1]), indexing="ij")
    for column, grid in zip(order[::-1], grids, strict=True):
        found = values[:, header.index(column)]
        if grid.size == len(found) and np.any(np.abs(grid.ravel() - found) > axes[column][1]):
            return ("The rows are not in the order that the file's loopOrder says (default: xyzt, "
                    "x changes fastest): BDSIM, which goes by the order, reads another field than "
                    "this map, which goes by the columns X, Y, Z.",)
    return ()


def lines(grid: Grid) -> Iterator[str]:
    """Yield the lines of the file."""
    for name, axis in zip(COMPONENTS, grid.axes, strict=True):
        yield f"n{name}> {len(axis)}"
        yield f"{name}min> {PER_M * float(axis[0])!r}"
        yield f"{name}max> {PER_M * float(axis[-1])!r}"
    yield "loopOrder> xyzt"
    yield "! X Y Z Fx Fy Fz"
    yield from grid.rows(PER_M, x_fastest=True)
