"""Regular grids of points: those that export formats need, and those that a header describes.

Rows of the latter have no positions. Of SRW, ten comments above the columns Bx, By and Bz in m and
T, where x changes fastest::

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
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.field_map import points_of, refuse_total_field
from halbach_fe.measurement.formats.conversion import ForeignTable
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.names import CARTESIAN, in_units
from halbach_fe.measurement.tables import (
    MAX_LINE,
    Line,
    comments_of,
    delimiter_of,
    finite,
    is_comment,
    lines_of,
    rows_of,
)
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
