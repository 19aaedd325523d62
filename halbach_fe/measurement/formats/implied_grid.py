"""Import of maps whose rows have no positions, since a header describes their grid.

Of SRW, ten comments above the columns Bx, By and Bz in m and T, where x changes fastest::

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
from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.names import ColumnName
from halbach_fe.measurement.formats.table import ForeignTable
from halbach_fe.measurement.formats.text import (
    Line,
    comments_of,
    delimiter_of,
    is_comment,
    lines_of,
    number_in_cell,
    rows_of,
)
from halbach_fe.study.types import COMPONENTS

STATEMENT = re.compile(r"#\s*([-+.\deE]{1,30})\s*#?\s*(initial|step of|number of points vs)\s+"
                       r"([XYZ])\b.{0,40}")
KEYS = ("initial", "step of", "number of points vs")
CARD, GRID_3D, WIDTH = "MGNCREAT", 300.0, 10
CARDS = re.compile(r"(?i)\s*(MGNCREAT|MGNDATA)\b")
MAX_LINE = 200
"""Number of characters of a line of the header that are searched."""


def format_of(lines: Sequence[Line]) -> str | None:
    """Return which of both formats the first lines are of, or None."""
    first = [line[:MAX_LINE] for _, line in lines[:20]]
    if sum(bool(STATEMENT.match(line)) for line in first) >= len(KEYS):
        return "srw"
    return "fluka" if any(line.upper().startswith(CARD) for line in first) else None


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
        np.array([_number(found[key, axis], f"{key} {axis}", where) for axis in "XYZ"])
        for key in KEYS)
    rows = [line for line in lines if not is_comment(line[1])]
    if not rows:
        raise MeasurementError(must_be("content", where, "rows of Bx, By and Bz", "none"))
    values, texts = rows_of(rows, 3, delimiter_of(rows[0][1], declared), declared, where)
    points = _points(start, start + (count - 1) * step, count, len(values), where)
    return ForeignTable(_columns("m"), np.hstack([points, values]), where, texts={
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
    return ForeignTable(_columns("cm"), np.hstack([points, values]), where)


def _what(line: str, free: bool, number: int, where: str) -> Floats:
    """Return the six numbers of a card; empty ones are 0."""
    cells = line.split(",")[1:7] if free or "," in line else [
        line[WIDTH * n:WIDTH * (n + 1)] for n in range(1, 7)]
    return np.array([_number(cell.strip(), f"line {number}", where) if cell.strip() else 0.0
                     for cell in [*cells, *[""] * (6 - len(cells))]])


def _number(text: str, what: str, where: str) -> float:
    """Return a finite number; raise MeasurementError if a text is none."""
    try:
        value = number_in_cell(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise MeasurementError(must_be(what, where, "a number", f"'{text[:40]}'"))
    return value


def _points(first: Floats, last: Floats, count: Floats, rows: int, where: str) -> Floats:
    """Return the points (rows, 3) of a grid, of which x changes fastest."""
    if not (count >= 1).all() or np.prod(count) != rows:
        raise MeasurementError(must_be(
            "content", where, " x ".join(f"{n:g}" for n in count) + " points, as its header says",
            str(rows), "Is the file cut short?"))
    axes = [np.linspace(a, b, int(n)) for a, b, n in zip(first, last, count, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def _columns(length_unit: str) -> tuple[ColumnName, ...]:
    """Return the columns of points and their field in T."""
    return tuple([ColumnName(name, name, length_unit) for name in COMPONENTS]
                 + [ColumnName(f"B{name}", f"B{name}", "T") for name in COMPONENTS])
