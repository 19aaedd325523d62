"""From columns as a file has them to a map in m and T along the magnet's axes.

What is missing is asked for, all of it at once; nothing is guessed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.field_map import MAX_FIELD_T, field_map
from halbach_fe.measurement.formats import names, units
from halbach_fe.measurement.formats.declared import Declared
from halbach_fe.measurement.formats.names import Name
from halbach_fe.measurement.formats.text import Line, comma_hint
from halbach_fe.study.types import MAX_LENGTH_M

OPTIONS = {"length": "--length-unit m, cm, mm, um or inch",
           "field": "--field-unit T, mT, uT, G or kG", "angle": "--angle-unit deg or rad"}
MAX_NUMBER = 1e30
"""In any unit; larger ones stand for what is missing, or overflow."""
KINDS = {"length": units.LENGTHS, "field": units.FIELDS, "angle": units.ANGLES}


@dataclass(frozen=True)
class ForeignTable:
    """Columns of a file.

    Attributes
    ----------
    columns : tuple of Name
        Empty texts if the file does not name them.
    values : ndarray, shape (n, columns)
        In the file's units; NaN where nothing was measured.
    where : str
        The file, for messages.
    length_unit, field_unit : str
        Of columns that have none of their own; nothing if the file does not say.
    anchor : str
        What the file counts its positions from, if that is not known to be the magnet's centre.
    comments : str
    texts : mapping of int to (int, str)
        Columns that are not all numbers: line and text of the first that is none.
    """

    columns: tuple[Name, ...]
    values: Floats
    where: str
    length_unit: str = ""
    field_unit: str = ""
    anchor: str = ""
    comments: str = ""
    texts: dict[int, Line] = field(default_factory=dict)


@dataclass(frozen=True)
class Imported:
    """A map, and how it was read: units, columns of the file that were left out, and how many
    points had no reading.
    """

    data: xr.Dataset
    length_units: tuple[str, ...]
    field_units: tuple[str, ...]
    ignored: tuple[str, ...]
    dropped: int


def to_map(table: ForeignTable, declared: Declared) -> Imported:
    """Read a table as the file and the user say together.

    Raises
    ------
    MeasurementError
        If something is missing (with all that is), if file and user contradict each other, or if
        the result cannot be a map of a permanent magnet.
    """
    columns = _columns(table, declared)
    used = _used(columns, table, declared)
    missing = _missing(used, columns, table, declared)
    unit_of: dict[str, str] = {}
    for kind in KINDS:
        unit_of |= _units(kind, used, table, declared, missing)
    if missing:
        raise MeasurementError(must_be(
            "content", table.where, "complete", f"a file that does not say {'; '.join(missing)}",
            "Give the options; nothing is guessed from the size of the numbers."))
    for name, column in used.items():
        if column in table.texts:
            line, cell = table.texts[column]
            raise MeasurementError(must_be(f"{name} in line {line}", table.where, "a number",
                                           f"'{cell[:40]}'", comma_hint(cell)))
        if (np.abs(table.values[:, column]) > MAX_NUMBER).any():
            raise MeasurementError(must_be(name, table.where, f"below {MAX_NUMBER:g}", "more"))
    si = {name: units.in_si(table.values[:, column], unit_of[name])
          for name, column in used.items()}
    count = len(table.values)
    si |= {name: np.full(count, value) for name, value in declared.at.items()}
    points, flux_density = _cartesian(si, table.where)
    if declared.origin_m is not None:
        points = points + declared.origin_m
    blank = np.isnan(flux_density).all(axis=1)
    data = _checked(points[~blank], flux_density[~blank], table.where)
    if table.comments:
        data.attrs["comments"] = table.comments
    lengths = {unit for name, unit in unit_of.items() if unit in units.LENGTHS}
    fields = {unit for name, unit in unit_of.items() if unit in units.FIELDS}
    ignored = tuple(column.text for index, column in enumerate(columns)
                    if index not in used.values() and column.text)
    return Imported(data, tuple(sorted(lengths)), tuple(sorted(fields)), ignored,
                    int(blank.sum()))


def _columns(table: ForeignTable, declared: Declared) -> tuple[Name, ...]:
    """The file's columns with what the user says of them."""
    if not declared.columns:
        return table.columns
    if len(declared.columns) != len(table.columns):
        raise MeasurementError(must_be(
            "--columns", table.where, f"of {len(table.columns)} columns, as the file has",
            f"{len(declared.columns)}", "Name each; - leaves one out."))
    found = []
    for text, column in zip(declared.columns, table.columns, strict=True):
        said = Name("") if text == "-" else names.parse(text)
        if text != "-" and not said.quantity:
            raise MeasurementError(must_be(
                "--columns", table.where, f"made of {', '.join(names.KNOWN)} and -", f"'{text}'"))
        if text != "-" and column.quantity not in ("", said.quantity) and not (
                column.quantity == "B" and said.quantity in names.FIELDS):
            raise _contradiction(table, f"column '{column.text}'", column.quantity,
                                 f"--columns {said.quantity}")
        for_unit = (column.unit, said.unit)
        if all(for_unit) and units.symbol(column.unit) != units.symbol(said.unit):
            raise _contradiction(table, f"unit of column '{column.text}'", column.unit,
                                 f"--columns {text}")
        found.append(Name(column.text or said.text, said.quantity, column.unit or said.unit))
    return tuple(found)


def _used(columns: Sequence[Name], table: ForeignTable, declared: Declared) -> dict[str, int]:
    """The column of each quantity that the map takes."""
    used: dict[str, int] = {}
    for index, column in enumerate(columns):
        if not column.quantity:
            continue
        if column.quantity in used:
            raise MeasurementError(must_be(
                "header", table.where, f"with one column {column.quantity}",
                f"'{columns[used[column.quantity]].text}' and '{column.text}'",
                "Say which with --columns; - leaves one out."))
        used[column.quantity] = index
    components = [name for name in names.FIELDS if name in used]
    if declared.component and used:
        name = f"B{declared.component}"
        if "B" not in used or components:
            raise _contradiction(table, "header", ", ".join(components) or "no column B",
                                 f"--component {declared.component}")
        used[name] = used.pop("B")
    elif components:
        used.pop("B", None)  # |B|, beside its components
    for name in declared.at:
        if name in used:
            raise _contradiction(table, "header", f"a column {name}", f"--at {name}=")
    return used


def _missing(
    used: dict[str, int], columns: Sequence[Name], table: ForeignTable, declared: Declared
) -> list[str]:
    """What file and user leave open, except units."""
    if not any(column.quantity for column in columns):
        shown = ", ".join(f"'{column.text}'" for column in columns if column.text)
        return [f"what its {len(columns)} columns {f'({shown}) ' if shown else ''}are "
                "(--columns x,y,z,Bx,By,Bz, - for one to leave out)"] + [
            f"the unit of {what} ({OPTIONS[kind]})" for kind, what, said in (
                ("length", "positions", declared.length_unit or table.length_unit),
                ("field", "B", declared.field_unit or table.field_unit)) if not said]
    missing = []
    wanted = ("r", "phi", "z") if {"r", "phi"} & set(used) else ("x", "y", "z")
    absent = [name for name in wanted if name not in used and name not in declared.at]
    if absent:
        missing.append(f"{', '.join(absent)} ({_by_option(absent)})")
    if "B" in used:
        missing.append("which component B is (--component x, y or z)")
    elif not set(names.FIELDS) & set(used):
        missing.append("which columns are Bx, By or Bz (--columns)")
    half = {"Br", "Bphi"} - set(used)
    if len(half) == 1:
        missing.append(f"{half.pop()}, without which the other is no Bx or By (--columns)")
    if table.anchor and declared.origin_m is None:
        missing.append(f"where {table.anchor} is along the magnet's axes (--origin-m=X,Y,Z)")
    return missing


def _by_option(absent: Sequence[str]) -> str:
    if "r" in absent or "phi" in absent:
        return "--columns"
    return f"--at {','.join(f'{name}=0' for name in absent)} in m, or --columns"


def _units(
    kind: str, used: dict[str, int], table: ForeignTable, declared: Declared, missing: list[str]
) -> dict[str, str]:
    """The unit of each column of a kind; what has none is added to ``missing``."""
    found, open_ = {}, []
    option = {"length": declared.length_unit, "field": declared.field_unit,
              "angle": declared.angle_unit}[kind]
    common = {"length": table.length_unit, "field": table.field_unit, "angle": ""}[kind]
    columns = _columns(table, declared)
    for name in (name for name in used if _kind(name) == kind):
        text = columns[used[name]].unit
        if units.is_silent(text):
            text = common
        unit = units.symbol(text)
        if not units.is_silent(text) and unit not in KINDS[kind]:
            raise MeasurementError(must_be(
                f"unit of {name}", table.where, f"one of {', '.join(KINDS[kind])}", f"'{text}'"))
        if unit and option and unit != option:
            raise _contradiction(table, f"unit of {name}", unit, f"--{kind}-unit {option}")
        if unit or option:
            found[name] = unit or option
        else:
            open_.append(name)
    if open_:
        missing.append(f"the unit of {', '.join(open_)} ({OPTIONS[kind]})")
    return found


def _kind(name: str) -> str:
    return "angle" if name == "phi" else "length" if name in names.POSITIONS else "field"


def _cartesian(si: dict[str, Floats], where: str) -> tuple[Floats, Floats]:
    """Points (n, 3) in m and B (n, 3) in T of columns in m, rad and T."""
    if "r" in si:
        if {"x", "y"} & set(si):
            raise MeasurementError(must_be("positions", where, "either x, y, z or r, phi, z",
                                           "both", "Leave some out with --columns and -."))
        angle = si["phi"]
        points = np.column_stack([si["r"] * np.cos(angle), si["r"] * np.sin(angle), si["z"]])
    else:
        points = np.column_stack([si["x"], si["y"], si["z"]])
        angle = np.arctan2(points[:, 1], points[:, 0])
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise MeasurementError(must_be(f"reading {int(np.argmax(bad)) + 1}", where,
                                       "at a finite position", "an empty or infinite one"))
    empty = np.full(len(points), np.nan)
    if "Br" not in si:
        return points, np.column_stack([si.get(name, empty) for name in ("Bx", "By", "Bz")])
    if {"Bx", "By"} & set(si):
        raise MeasurementError(must_be("components", where, "either Bx, By or Br, Bphi", "both",
                                       "Leave some out with --columns and -."))
    if "r" not in si and not np.hypot(points[:, 0], points[:, 1]).all():
        raise MeasurementError(must_be(
            "Br and Bphi", where, "at points off the axis", "some on it, where they have no "
            "direction", "Give r and phi, or leave those points out."))
    cos, sin = np.cos(angle), np.sin(angle)
    return points, np.column_stack([si["Br"] * cos - si["Bphi"] * sin,
                                    si["Br"] * sin + si["Bphi"] * cos, si.get("Bz", empty)])


def _checked(points: Floats, flux_density: Floats, where: str) -> xr.Dataset:
    """The map; MeasurementError if it is none of a permanent magnet."""
    if not len(points):
        raise MeasurementError(must_be("content", where, "at least one reading", "none"))
    largest, farthest = float(np.nanmax(np.abs(flux_density))), float(np.abs(points).max())
    if not largest <= MAX_FIELD_T:
        raise MeasurementError(must_be("flux densities", where, f"below {MAX_FIELD_T:g} T",
                                       f"{largest:g} T", "Is the unit right?"))
    if not farthest <= 10 * MAX_LENGTH_M:
        raise MeasurementError(must_be("positions", where, f"within {10 * MAX_LENGTH_M:g} m",
                                       f"{farthest:g} m", "Is the unit right?"))
    return field_map(points, flux_density)


def _contradiction(table: ForeignTable, what: str, file: str, user: str) -> MeasurementError:
    return MeasurementError(must_be(what, table.where, "the same in the file and the options",
                                    f"{file} in the file and {user}",
                                    "Correct the option, or the file."))


def named(columns: Sequence[Name], units_below: Sequence[str]) -> tuple[Name, ...]:
    """Columns with the units of a line below the header, where they have none of their own."""
    return tuple(replace(column, unit=column.unit or unit.strip().strip("[]()"))
                 for column, unit in zip(columns, units_below, strict=True))
