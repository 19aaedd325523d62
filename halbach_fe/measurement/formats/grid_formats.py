"""Formats of regular grids: Opera, SRW, FLUKA, BDSIM and Geant4.

**SRW and FLUKA.** Rows have no positions. Of SRW, ten comments above the columns Bx, By and Bz in m
and T, where x changes fastest::

    #Bx [T], By [T], Bz [T] on 3D mesh: inmost loop vs X ..., outmost loop vs Z ...
    #-0.01 #initial X position [m]
    #0.01 #step of X [m]
    #3 #number of points vs X
    ...                                 and the same for Y and Z

Of FLUKA, cards of a three-dimensional Cartesian grid in cm and T, with two points on every card of
data, where x changes fastest; columns are 10 characters wide, or separated by commas below FREE::

    MGNCREAT  , 300.0, , 0.0, 0.0, 0.0, , NAME
    MGNCREAT  , , , , nx, ny, nz, &
    MGNCREAT  , xmin, ymin, zmin, xmax, ymax, zmax, &&
    MGNDATA   , Bx, By, Bz, Bx, By, Bz, NAME

Sources: files that SRW writes and others write for it (uti_io of srwpy), and FLUKA's cards as
NA60+ reads them.

**Opera.** Its TABLE command writes::

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

**Geant4.** Exports are for its PurgMagTabulatedField3D (.cc file of this class, and
PurgMag3D.TABLE): in metres and tesla, with z that changes fastest. Its reader ends the header at
the first line whose second character is 0, and reads lines into a buffer of 256 characters. It
expects a seventh column, the permeability, but ignores it; the export writes that of vacuum. The
units in the header are for other readers.

**BDSIM** (``bdsim3d``). The file has keys ``nx> 5``, ``xmin> -2.0`` ..., a line
``! X Y Z Fx Fy Fz``, and rows in cm and T. The x coordinate changes fastest, which is BDSIM's
``loopOrder> xyzt``. BDSIM's loader takes the grid from the keys and assigns the values by the order
of the rows. Source: BDSIM's manual, Field Map File Formats.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.field_map import points_of, refuse_total_field
from halbach_fe.measurement.formats import column_names, delimited_table
from halbach_fe.measurement.formats.column_names import CARTESIAN, ColumnName, in_units
from halbach_fe.measurement.formats.columns_to_map import ForeignTable
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.text_tables import (
    MAX_LINE,
    Line,
    comments_of,
    delimiter_of,
    finite,
    is_comment,
    lines_of,
    rows_of,
    uncommented,
)
from halbach_fe.study.materials import MU_0
from halbach_fe.study.types import COMPONENTS

TOLERANCE = 1e-3
"""Largest deviation of a coordinate from the regular grid, relative to the grid step. Coordinates
of maps are rounded (for example to 1 um with steps of 1 mm). The field error of such a deviation is
1e-3 of the difference between neighbouring points, less than the error of the linear interpolation
between them."""

HINT = ('A study with observation positions kind = "grid" has such points (start_m, end_m, count); '
        "halbach-fe solve computes its map.")


@dataclass(frozen=True)
class Grid:
    """B on a regular grid of points."""

    axes: tuple[Floats, Floats, Floats]
    """Equally spaced, increasing coordinates along x, y and z. In m."""
    field: Floats
    """Shape (nx, ny, nz, 3), in T."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of points along x, y and z."""
        return len(self.axes[0]), len(self.axes[1]), len(self.axes[2])

    @property
    def spacing(self) -> Floats:
        """Grid steps (3,) in m along x, y and z."""
        return np.array([(axis[-1] - axis[0]) / (len(axis) - 1) for axis in self.axes])

    def rows(self, per_m: float = 1.0, x_fastest: bool = False) -> Iterator[str]:
        """Yield x, y, z, in a unit of which a metre has ``per_m``, and B of each point as text."""
        points = np.stack(np.meshgrid(*(per_m * axis for axis in self.axes), indexing="ij"), -1)
        table = np.concatenate([points, self.field], axis=-1)
        for row in (table.swapaxes(0, 2) if x_fastest else table).reshape(-1, 6).tolist():
            yield " ".join(map(repr, row))


def grid_of(data: xr.Dataset, where: str) -> Grid:
    """Return the grid that the points of a map form; they may come in any order.

    Raises
    ------
    MeasurementError
        If an axis has a single coordinate or unequal steps, if points are missing or repeated, or
        if a component was not measured at a point.
    """
    refuse_total_field(data, "export on a grid")
    points, values = points_of(data), data["B_T"].values
    if np.isnan(values).any():
        row, component = np.argwhere(np.isnan(values))[0]
        raise MeasurementError(must_be("B", where, "known with all components at every point",
                                       f"none of B{COMPONENTS[component]} in reading {row + 1}"))
    found = [_axis(points[:, i], name, where) for i, name in enumerate(COMPONENTS)]
    axes = found[0][0], found[1][0], found[2][0]
    shape = len(axes[0]), len(axes[1]), len(axes[2])
    total = int(np.prod([float(count) for count in shape]))
    expected = f"a full grid, {shape[0]} x {shape[1]} x {shape[2]} = {total} points, each once"
    if total != len(points):
        raise MeasurementError(must_be("points", where, expected, f"{len(points)}", HINT))
    flat = np.ravel_multi_index([index for _, index in found], shape)
    if len(np.unique(flat)) < total:
        raise MeasurementError(must_be("points", where, expected, "some twice and others never",
                                       HINT))
    field = np.empty((total, 3))
    field[flat] = values
    return Grid(axes, field.reshape(*shape, 3))


def _axis(values: Floats, name: str, where: str) -> tuple[Floats, NDArray[np.intp]]:
    """Return equally spaced coordinates, and the index of each value in them."""
    ordered = np.sort(values)
    gaps = np.diff(ordered)
    widest = gaps.max(initial=0.0)
    if widest == 0:
        raise MeasurementError(must_be(f"{name} of the points", where,
                                       "of at least two different values, since programs "
                                       "interpolate between them", f"{values[0]:g} m alone", HINT))
    # on a regular grid each gap is either a step or rounding
    count = 1 + int((gaps > widest / 2).sum())
    axis = np.linspace(ordered[0], ordered[-1], count)
    step = (axis[-1] - axis[0]) / (count - 1)
    index = np.rint((values - axis[0]) / step).astype(np.intp)
    off = np.abs(values - axis[index])
    worst = int(np.argmax(off))
    if off[worst] > TOLERANCE * step:
        raise MeasurementError(must_be(
            f"{name} of the points", where, f"equally spaced within {TOLERANCE:g} of a step, here "
            f"{step:.6g} m", f"{values[worst]:.9g} m, {off[worst]:.3g} m off", HINT))
    return axis, index


STATEMENT = re.compile(r"#\s*([-+.\deE]{1,30})\s*#?\s*(initial|step of|number of points vs)\s+"
                       r"([XYZ])\b.{0,40}")
KEYS = ("initial", "step of", "number of points vs")
CARD, GRID_3D, WIDTH = "MGNCREAT", 300.0, 10
CARDS = re.compile(r"(?i)\s*(MGNCREAT|MGNDATA)\b")


def is_srw(lines: Sequence[Line]) -> bool:
    """Return whether the first lines describe a grid of SRW."""
    return sum(bool(STATEMENT.match(line[:MAX_LINE])) for _, line in lines[:20]) >= len(KEYS)


def is_fluka(lines: Sequence[Line]) -> bool:
    """Return whether one of the first lines is a card of a grid of FLUKA."""
    return any(line.upper().startswith(CARD) for _, line in lines[:20])


def read_srw(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read a map of SRW.

    Raises
    ------
    MeasurementError
        If the header does not describe a grid of as many points as follow.
    """
    lines = lines_of(raw, declared, where)
    found = {(part[2], part[3]): part[1] for _, line in lines
             if is_comment(line) and (part := STATEMENT.match(line[:MAX_LINE]))}
    lost = [f"{key} {axis}" for axis in "XYZ" for key in KEYS if (key, axis) not in found]
    if lost:
        raise MeasurementError(must_be("header", where, f"complete with '#value #{lost[0]} ...'",
                                       "a header without it"))
    start, step, count = (
        np.array([finite(found[key, axis], f"{key} {axis}", where) for axis in "XYZ"])
        for key in KEYS)
    rows = [line for line in lines if not is_comment(line[1])]
    if not rows:
        raise MeasurementError(must_be("content", where, "rows of Bx, By and Bz", "none"))
    values, texts = rows_of(rows, 3, delimiter_of(rows[0][1], declared), declared, where)
    points = _points(start, start + (count - 1) * step, count, len(values), where)
    return ForeignTable(in_units(CARTESIAN, "m"), np.hstack([points, values]), where, texts={
        column + 3: cells for column, cells in texts.items()}, comments=comments_of(lines))


def read_fluka(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read cards of FLUKA.

    Raises
    ------
    MeasurementError
        If they are of another grid than a three-dimensional Cartesian one, of several, or of
        another number of points than follow.
    """
    lines = [(number, line) for number, line in lines_of(raw, declared, where)
             if not line.startswith("*")]
    free = any(line.strip().upper() == "FREE" for _, line in lines)
    cards = [(found[1].upper(), number, line) for number, line in lines
             if (found := CARDS.match(line[:MAX_LINE]))]
    made = [_what(line, free, number, where) for name, number, line in cards if name == CARD]
    kind = f"{made[0][0]:g}" if made else "none"
    if len(made) != 3 or made[0][0] != GRID_3D or any(made[0][1:5]):
        raise MeasurementError(must_be(
            "cards", where, f"three {CARD} of one three-dimensional Cartesian grid, {GRID_3D:g}, "
            "without a symmetry or an offset", f"{len(made)}, the first with {kind}",
            "Export the field on a full grid of one such map."))
    numbers = np.concatenate([[0.0]] + [_what(line, free, number, where)
                                        for name, number, line in cards if name != CARD])[1:]
    count = made[1][3:]
    total = int(np.prod(count))
    # the last card may hold one point and none
    values = numbers.reshape(-1, 3)[:total] if 0 <= len(numbers) - 3 * total <= 3 else (
        numbers.reshape(-1, 3))
    points = _points(made[2][:3], made[2][3:], count, len(values), where)
    return ForeignTable(in_units(CARTESIAN, "cm"), np.hstack([points, values]), where)


def _what(line: str, free: bool, number: int, where: str) -> Floats:
    """Return the six numbers of a card; empty ones are 0."""
    cells = line.split(",")[1:7] if free or "," in line else [
        line[WIDTH * n:WIDTH * (n + 1)] for n in range(1, 7)]
    return np.array([finite(cell.strip(), f"line {number}", where) if cell.strip() else 0.0
                     for cell in [*cells, *[""] * (6 - len(cells))]])


def _points(first: Floats, last: Floats, count: Floats, rows: int, where: str) -> Floats:
    """Return the points (rows, 3) of a grid, of which x changes fastest."""
    if not (count >= 1).all() or np.prod(count) != rows:
        raise MeasurementError(must_be(
            "content", where, " x ".join(f"{n:g}" for n in count) + " points, as its header says",
            str(rows), "Is the file cut short?"))
    return points_on([np.linspace(*ends) for ends in zip(first, last, count.astype(int),
                                                         strict=True)])


def points_on(axes: Sequence[Floats]) -> Floats:
    """Return the points (n, 3) of a grid from its coordinates along x, y, z; x changes fastest."""
    return np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], axis=-1).reshape(-1, 3)


COUNTS = re.compile(r"\s*(\d{1,9})\s+(\d{1,9})\s+(\d{1,9})(\s+\d{1,9})?\s*")
COLUMN = re.compile(r"\s*([1-9]\d?)\s+([A-Za-z][^\s\[]*)\s*(?:\[([^\[\]]*)\])?\s*")
END = re.compile(r"\s*0\s*(?:\[([^\[\]]*)\])?\s*")
EXPORTED = (" 1 X [METRE]", " 2 Y [METRE]", " 3 Z [METRE]", " 4 BX [TESLA]", " 5 BY [TESLA]",
            " 6 BZ [TESLA]", " 7 BMOD/HMOD", " 0 [METRE]")


def is_opera(lines: Sequence[Line]) -> bool:
    """Return whether the first lines are those of an Opera table."""
    first = [line for _, line in lines[:2] if len(line) <= MAX_LINE]
    return len(first) == 2 and bool(COUNTS.fullmatch(first[0])) and bool(COLUMN.fullmatch(first[1]))


def read_opera(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
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
    columns, length_unit, start = _opera_columns(lines, where)
    values, texts = rows_of(lines[start:], len(columns), None, declared, where)
    grid = [int(text) for text in counts.groups()[:3]]
    listed = len(set(grid)) == 1 and len(values) == grid[0]
    if len(values) != grid[0] * grid[1] * grid[2] and not listed:
        raise MeasurementError(must_be(
            "content", where, f"{grid[0]} x {grid[1]} x {grid[2]} points, as its first line says",
            str(len(values)), "Is the file cut short?"))
    return ForeignTable(columns, values, where, length_unit=length_unit, texts=texts)


def _opera_columns(lines: Sequence[Line], where: str) -> tuple[tuple[ColumnName, ...], str, int]:
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
        name = column_names.parse(column[2])
        columns.append(ColumnName(name.text, name.quantity, (column[3] or "").strip()))
    raise MeasurementError(must_be("header", where, "columns and a line 0 after them",
                                   "a header without them"))


def geant4_lines(grid: Grid) -> Iterator[str]:
    """Yield the lines of a file for Geant4."""
    yield ""
    nx, ny, nz = grid.shape
    yield f" {nx} {ny} {nz} "  # without the last space the reader would parse the previous line
    yield from EXPORTED
    for row in grid.rows():
        yield f"{row} {MU_0!r}"


PER_M = 100.0
"""Centimetres per metre."""
KEY = re.compile(r"\s*(n[xyzt]|[xyzt](?:min|max)|loopOrder)>\s*(\S{1,30})\s*")
BDSIM_NAMES = {"X": ("x", "cm"), "Y": ("y", "cm"), "Z": ("z", "cm"), "Fx": ("Bx", "T"),
         "Fy": ("By", "T"), "Fz": ("Bz", "T")}
NEAR = 0.01
"""Largest distance of a column's coordinate from that of the keys, in steps of the grid: columns
are printed with few digits."""


def is_bdsim(lines: Sequence[Line]) -> bool:
    """Return whether the first lines that are no comments are keys of BDSIM."""
    first = [line[:MAX_LINE] for _, line in lines[:20] if not is_comment(line)]
    return bool(first) and bool(KEY.fullmatch(first[0]))


def read_bdsim(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
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
    if not set(header) <= set(BDSIM_NAMES) or len(header) != table.values.shape[1]:
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
    columns_of_file = tuple(ColumnName(name, *BDSIM_NAMES[name]) for name in header)
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


def bdsim_lines(grid: Grid) -> Iterator[str]:
    """Yield the lines of the file."""
    for name, axis in zip(COMPONENTS, grid.axes, strict=True):
        yield f"n{name}> {len(axis)}"
        yield f"{name}min> {PER_M * float(axis[0])!r}"
        yield f"{name}max> {PER_M * float(axis[-1])!r}"
    yield "loopOrder> xyzt"
    yield "! X Y Z Fx Fy Fz"
    yield from grid.rows(PER_M, x_fastest=True)
