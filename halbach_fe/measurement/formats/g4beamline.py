"""Import of field maps of G4beamline (BLFieldMap), in mm and T.

::

    param normB=1.0 current=1.0
    grid X0=0 Y0=0 Z0=-20 nX=2 nY=2 nZ=5 dX=10 dY=10 dZ=10
    extendX flip=By,Bz
    data
    0 0 -20 0.1 0.0 0.0

Lines with # or * are comments. The field is ``normB`` times the numbers, at the ``current``. With
``extendX`` it goes on to negative x as in a mirror, where the components after flip are reversed;
``cylinder`` has rows r, z, Br, Bz of a field with rotational symmetry. What follows from a symmetry
is no reading: the map has the points of the file alone, and a sentence says what it covers.
Source: BLFieldMap.hh of G4beamline.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.formats.column_names import CARTESIAN, ColumnName, in_units
from halbach_fe.measurement.formats.columns_to_map import ForeignTable
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.text_tables import (
    Line,
    comments_of,
    delimiter_of,
    finite,
    is_comment,
    lines_of,
    rows_of,
)

COMMAND = re.compile(r"\s*(param|grid|cylinder|time|extend[XYZ]|data)\b(.*)")
ARGUMENT = re.compile(r"(\w{1,20})\s*=\s*([^\s=]{1,60})")
GRID = ("X0", "Y0", "Z0", "nX", "nY", "nZ", "dX", "dY", "dZ", "tolerance")
CYLINDER = ("R0", "Z0", "nR", "nZ", "dR", "dZ", "tolerance")
KNOWN = {"param": ("maxline", "current", "gradient", "normE", "normB"), "grid": GRID,
         "cylinder": CYLINDER, "data": (), **{f"extend{axis}": ("flip",) for axis in "XYZ"}}
"""The arguments of each command."""
COLUMNS = {"grid": CARTESIAN, "cylinder": ("r", "z", "Br", "Bz")}
ELECTRIC = {"grid": ("Ex", "Ey", "Ez"), "cylinder": ("Er", "Ez")}
LENGTH_UNIT = "mm"

MAX_LINE = 300
"""Number of characters of a line of the header that are searched."""


def is_g4beamline(lines: Sequence[Line]) -> bool:
    """Return whether the commands of a grid or cylinder of G4beamline begin the file."""
    for _, line in lines[:100]:
        if _is_comment(line):
            continue
        found = COMMAND.fullmatch(line[:MAX_LINE])
        if not found:
            return False
        if found[1] in COLUMNS:
            return bool(ARGUMENT.search(found[2]))
    return False


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read the points of a map, which may come in any order.

    Raises
    ------
    MeasurementError
        If the map changes in time, is written in blocks, or a point is none of its grid.
    """
    lines = lines_of(raw, declared, where)
    commands, start = _commands(lines, where)
    kind = next(name for name in COLUMNS if name in commands)
    rows = [(number, line) for number, line in lines[start:] if not _is_comment(line)]
    if not rows:
        raise MeasurementError(must_be("content", where, "at least one point below data", "none"))
    delimiter = delimiter_of(rows[0][1], declared)
    wanted = COLUMNS[kind]
    count = len(rows[0][1].split(delimiter))
    if count not in (len(wanted), len(wanted) + len(ELECTRIC[kind])):
        raise MeasurementError(must_be(f"line {rows[0][0]}", where,
                                       f"{', '.join(wanted)}", f"{count} values"))
    values, texts = rows_of(rows, count, delimiter, declared, where)
    scale = finite(commands.get("param", {}).get("normB", "1"), "normB", where)
    columns = in_units(wanted, LENGTH_UNIT)
    fields = [index for index, name in enumerate(wanted) if name.startswith("B")]
    values[:, fields] *= scale
    _check_grid(commands[kind], values, kind, where)
    remarks = _remarks(commands, values, kind, scale)
    if kind == "cylinder":  # the half-plane y = 0
        columns = tuple(replace(column, quantity={"r": "x", "Br": "Bx"}.get(
            column.text, column.text)) for column in (*columns, *in_units("y", LENGTH_UNIT)))
        values = np.column_stack([values[:, :4], np.zeros(len(values))])
    elif count > len(wanted):
        columns += tuple(map(ColumnName, ELECTRIC[kind]))
    return ForeignTable(columns, values, where, comments=comments_of(lines[:start]),
                        texts=texts, remarks=tuple(remarks))


def _is_comment(line: str) -> bool:
    """Return whether a line is a comment."""
    return is_comment(line) or line.lstrip().startswith("*")


def _commands(
    lines: Sequence[Line], where: str
) -> tuple[dict[str, dict[str, str]], int]:
    """Return the arguments of each command, and the index of the line after data."""
    found: dict[str, dict[str, str]] = {}
    for index, (number, line) in enumerate(lines):
        if _is_comment(line):
            continue
        command = COMMAND.fullmatch(line[:MAX_LINE])
        if not command or command[1] == "time" or command[1] in found:
            raise MeasurementError(must_be(
                f"line {number}", where, "param, grid, cylinder, extendX, extendY, extendZ or "
                "data, each once, of a static field given point by point",
                f"'{line.strip()[:40]}'"))
        name, arguments = command[1], dict(ARGUMENT.findall(command[2]))
        rest = ARGUMENT.sub("", command[2]).strip()
        if rest or not set(arguments) <= set(KNOWN[name]):
            raise MeasurementError(must_be(
                f"line {number}", where, f"{name} with {', '.join(KNOWN[name]) or 'no argument'}",
                f"'{line.strip()[:40]}'"))
        found[name] = arguments
        if name == "data":
            if len(set(COLUMNS) & set(found)) == 1:
                return found, index + 1
            break
    raise MeasurementError(must_be("content", where, "a grid or a cylinder, and data below it",
                                   ", ".join(found) or "none"))


def _check_grid(given: dict[str, str], values: Floats, kind: str, where: str) -> None:
    """Raise MeasurementError if a point is not of the grid, of which G4beamline ignores it."""
    tolerance_mm = 0.01  # distance of a point from the grid up to which G4beamline uses it
    tolerance = finite(given.get("tolerance", str(tolerance_mm)), "tolerance", where)
    for column, axis in enumerate("XYZ" if kind == "grid" else "RZ"):
        start = finite(given.get(f"{axis}0", "0"), f"{axis}0", where)
        step = finite(given.get(f"d{axis}", "1"), f"d{axis}", where)
        count = finite(given.get(f"n{axis}", "1"), f"n{axis}", where)
        index = np.rint((values[:, column] - start) / step) if step else np.zeros(len(values))
        off = np.abs(start + step * index - values[:, column]) > max(tolerance, 1e-9)
        bad = off | (index < 0) | (index > count - 1) | np.isnan(values[:, column])
        if bad.any():
            raise MeasurementError(must_be(
                f"{axis} of point {int(np.argmax(bad)) + 1}", where,
                f"one of {count:g} from {start:g} in steps of {step:g} mm, as its {kind} says",
                f"{values[int(np.argmax(bad)), column]:g}"))


def _remarks(
    commands: dict[str, dict[str, str]], values: Floats, kind: str, scale: float
) -> list[str]:
    """Return sentences about what the header says of the numbers."""
    said = []
    if scale != 1:
        said.append(f"The file says normB={scale:g}: its numbers were multiplied by it.")
    current = commands.get("param", {}).get("current", "1")
    if current not in ("1", "1.0"):
        said.append(f"The map is that of the current {current} that the file states; it was not "
                    "scaled to another.")
    sizes = [float(commands[kind].get(f"n{axis}", "1")) for axis in
             ("XYZ" if kind == "grid" else "RZ")]
    if len(values) < np.prod(sizes):
        said.append(f"The file has {len(values)} of the {np.prod(sizes):g} points of its {kind}; "
                    "G4beamline takes the others for zero, this map leaves them out.")
    for axis in "XYZ":
        if f"extend{axis}" in commands:
            said.append(_symmetry(axis, commands[f"extend{axis}"].get("flip", ""), values, kind))
    if kind == "cylinder":
        said.append("The file is of a field with rotational symmetry about z: the map has its "
                    "points once, in the half-plane y = 0 with Bx = Br. What the symmetry says "
                    "of other angles are copies, not readings.")
    return said


def _symmetry(axis: str, flip: str, values: Floats, kind: str) -> str:
    """Return the sentence about a half of the map that the file leaves to a mirror."""
    column = ("X", "Y", "Z").index(axis) if kind == "grid" else 1
    low, high = values[:, column].min(), values[:, column].max()
    reversed_ = [name for name in flip.split(",") if name.startswith("B")]
    name = axis.lower()
    along = f"B{name}" if kind == "grid" else "Bz"
    others = set(COLUMNS[kind]) & {"Bx", "By", "Bz", "Br"} - {along}
    possible = set(reversed_) in ({along}, others)
    return (
        f"The map covers only a part, {name} from {low:g} to {high:g} mm: extend{axis} says that "
        f"at -{name} the field is the same"
        + (f" with {' and '.join(reversed_)} reversed" if reversed_ else "")
        + ". Mirrored values are copies and no readings, so they are not in the map"
        + ("" if possible else
           f"; and no field without sources has this symmetry: either {along} changes its sign "
           f"there, or {' and '.join(sorted(others))}")
        + ".")
