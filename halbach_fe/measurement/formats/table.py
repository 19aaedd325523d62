"""Conversion of a file's columns to a map in m and T along the magnet's axes.

Information that neither the file nor the user states is never guessed. A single error message lists
all missing statements and the options that provide them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.field_map import MAX_FIELD_T, field_map, with_total_field
from halbach_fe.measurement.formats import names, units
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.names import ColumnName
from halbach_fe.measurement.formats.text import Line, comma_hint
from halbach_fe.study.types import MAX_LENGTH_M

OPTIONS = {"length": "--length-unit m, cm, mm, um or inch",
           "field": "--field-unit T, mT, uT, G or kG", "angle": "--angle-unit deg or rad",
           "time": "--columns ...t[s], t[min] or t[h]"}
MAX_NUMBER = 1e30
"""Largest number that is accepted, in any unit. Larger values are placeholders for missing data, or
would overflow."""
MOST_RAD = 4 * np.pi
"""Largest angle of a position, two turns: larger ones are in degrees."""

KINDS = {"length": units.LENGTHS, "field": units.FIELDS, "angle": units.ANGLES,
         "time": units.TIMES}


@dataclass(frozen=True)
class ForeignTable:
    """The columns of a file in a foreign format, in the file's own units and axes.

    Attributes
    ----------
    columns : tuple of Name
        Names of the columns, with empty texts if the file does not name them.
    values : ndarray, shape (n, columns)
        In the file's units; NaN if a component was not measured, or a cell is no number.
    where : str
        Name of the file in error messages.
    length_unit, field_unit : str
        Units of columns that state no unit of their own; empty if the file does not state them.
    anchor : str
        The point from which the file measures positions; empty if it is the magnet's centre.
    comments : str
        Comments of the file, on a single line.
    texts : mapping of int to (int, str)
        For each column that is not all numbers: line number and text of the first other cell.
    """

    columns: tuple[ColumnName, ...]
    values: Floats
    where: str
    length_unit: str = ""
    field_unit: str = ""
    anchor: str = ""
    comments: str = ""
    texts: dict[int, Line] = field(default_factory=dict)


@dataclass(frozen=True)
class ImportedMap:
    """A map and a summary of how it was read.

    Attributes
    ----------
    data : xarray.Dataset
        The map, in m and T along the magnet's axes.
    length_units, field_units : tuple of str
        Units of the file's columns.
    ignored : tuple of str
        Columns of the file that are not in the map.
    dropped : int
        Number of points without any measured component, which are not in the map.
    cylindrical : bool
        Whether the file has Br and Bphi, so that Bx and By are computed.
    """

    data: xr.Dataset
    length_units: tuple[str, ...]
    field_units: tuple[str, ...]
    ignored: tuple[str, ...]
    dropped: int
    cylindrical: bool


def to_map(table: ForeignTable, declared: DeclaredFormat) -> ImportedMap:
    """Convert a table to a map, by the statements of the file and the user together.

    Raises
    ------
    MeasurementError
        If information is missing (the message lists all of it), if file and user contradict each
        other, or if the values are too large for a map of a permanent magnet.
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
                                           f"'{cell[:40]}'", comma_hint(cell) or (
                    "Where nothing was read, write nan." if name.startswith("B") else "")))
        if (np.abs(table.values[:, column]) > MAX_NUMBER).any():
            raise MeasurementError(must_be(name, table.where, f"below {MAX_NUMBER:g}", "more"))
    si = {name: units.in_si(table.values[:, column], unit_of[name])
          for name, column in used.items()}
    count = len(table.values)
    si |= {name: np.full(count, value) for name, value in declared.at.items()}
    # a stage that reports its moves starts at the file's origin
    si |= {name[1]: np.cumsum(si[name]) for name in names.MOVES if name in si}
    points, flux_density = _cartesian(si, table.where)
    if declared.origin_m is not None:
        points = points + declared.origin_m
    total = si.get(names.TOTAL, np.full(count, np.nan))
    blank = np.isnan(flux_density).all(axis=1) & np.isnan(total)
    data = _checked(points[~blank], flux_density[~blank], total[~blank], table.where)
    if names.TOTAL in si:
        data = with_total_field(data, total[~blank])
    if "t" in si:
        data["time_s"] = ("point", si["t"][~blank], {"units": "s"})
    if table.comments:
        data.attrs["comments"] = table.comments
    lengths = {unit for name, unit in unit_of.items() if unit in units.LENGTHS}
    fields = {unit for name, unit in unit_of.items() if unit in units.FIELDS}
    ignored = tuple(column.text for index, column in enumerate(columns)
                    if index not in used.values() and column.text)
    return ImportedMap(data, tuple(sorted(lengths)), tuple(sorted(fields)), ignored,
                       int(blank.sum()), "Br" in si)


def _columns(table: ForeignTable, declared: DeclaredFormat) -> tuple[ColumnName, ...]:
    """Return the file's columns with the names and units that the user states."""
    if not declared.columns:
        return table.columns
    if len(declared.columns) != len(table.columns):
        raise MeasurementError(must_be(
            "--columns", table.where, f"of {len(table.columns)} columns, as the file has",
            f"{len(declared.columns)}", "Name each column; - ignores a column."))
    found = []
    for text, column in zip(declared.columns, table.columns, strict=True):
        stated = ColumnName("") if text == "-" else names.parse(text, stated=True)
        if text != "-" and not stated.quantity:
            raise MeasurementError(must_be(
                "--columns", table.where,
                f"made of {', '.join((*names.KNOWN, *names.STATED))} and -", f"'{text}'"))
        if text != "-" and column.quantity not in ("", stated.quantity) and not (
                column.quantity == "B" and stated.quantity in names.FIELDS):
            raise _contradiction(table, f"column '{column.text}'", column.quantity,
                                 f"--columns {stated.quantity}")
        in_file = units.unit_symbol(column.unit)  # brackets may also hold a remark: Z (stage)
        if in_file and stated.unit and in_file != units.unit_symbol(stated.unit):
            raise _contradiction(table, f"unit of column '{column.text}'", column.unit,
                                 f"--columns {text}")
        found.append(ColumnName(column.text or stated.text, stated.quantity,
                                stated.unit if stated.unit and not in_file else column.unit))
    return tuple(found)


def _used(
    columns: Sequence[ColumnName], table: ForeignTable, declared: DeclaredFormat
) -> dict[str, int]:
    """Return the index of the column of each quantity that the map uses."""
    used: dict[str, int] = {}
    for index, column in enumerate(columns):
        if not column.quantity:
            continue
        if column.quantity in used:
            raise MeasurementError(must_be(
                "header", table.where, f"with one column {column.quantity}",
                f"'{columns[used[column.quantity]].text}' and '{column.text}'",
                "Choose one with --columns; - ignores a column."))
        used[column.quantity] = index
    components = [name for name in names.FIELDS if name in used]
    if declared.component and used:
        name = f"B{declared.component}"  # Bx, or Babs
        if "B" not in used or components:
            raise _contradiction(table, "header", ", ".join(components) or "no column B",
                                 f"--component {declared.component}")
        used[name] = used.pop("B")
    elif components and "B" in used:  # beside its components, B is the magnitude
        magnitude = used.pop("B")
        if len(components) == 3:
            used.setdefault(names.TOTAL, magnitude)
    if components and names.TOTAL in used and not (
            units.unit_symbol(columns[used[names.TOTAL]].unit) or declared.field_unit
            or table.field_unit):
        del used[names.TOTAL]  # it is not needed
    for name in declared.at:
        if name in used:
            raise _contradiction(table, "header", f"a column {name}",
                                 f"--at {name}={declared.at[name]:g}")
    return used


def _missing(
    used: dict[str, int], columns: Sequence[ColumnName], table: ForeignTable,
    declared: DeclaredFormat
) -> list[str]:
    """Return descriptions of the information that file and user do not state, except units."""
    if not any(column.quantity for column in columns):
        shown = ", ".join(f"'{column.text}'" for column in columns if column.text)
        return [f"what its {len(columns)} columns {f'({shown}) ' if shown else ''}are "
                "(--columns x,y,z,Bx,By,Bz, - to ignore a column)"] + [
            f"the unit of {what} ({OPTIONS[kind]})" for kind, what, said in (
                ("length", "positions", declared.length_unit or table.length_unit),
                ("field", "B", declared.field_unit or table.field_unit)) if not said]
    missing = []
    wanted = ("r", "phi", "z") if {"r", "phi"} & set(used) else ("x", "y", "z")
    absent = [name for name in wanted if name not in used and name not in declared.at
              and f"d{name}" not in used]
    if absent:
        missing.append(f"{', '.join(absent)} ({_by_option(absent)})")
    if "B" in used:
        missing.append("which component B is (--component x, y or z), or whether it is |B| "
                       "(--component abs)")
    elif not {*names.FIELDS, names.TOTAL} & set(used):
        missing.append("which columns are Bx, By or Bz, or Babs for |B| (--columns)")
    half = {"Br", "Bphi"} - set(used)
    if len(half) == 1:
        missing.append(f"{half.pop()}, without which the other is no Bx or By (--columns)")
    if table.anchor and declared.origin_m is None:
        missing.append(f"where {table.anchor} is along the magnet's axes (--origin-m=X,Y,Z)")
    return missing


def _by_option(absent: Sequence[str]) -> str:
    """Return the options that provide absent coordinates."""
    if "r" in absent or "phi" in absent:
        return "--columns"
    return f"--at {','.join(f'{name}=0' for name in absent)} in m, or --columns"


def _units(
    kind: str, used: dict[str, int], table: ForeignTable, declared: DeclaredFormat,
    missing: list[str]
) -> dict[str, str]:
    """Return the unit of each column of a kind, one of `KINDS`.

    Columns without a unit are added to the descriptions in ``missing``.
    """
    found, unknown = {}, []
    option = {"length": declared.length_unit, "field": declared.field_unit,
              "angle": declared.angle_unit, "time": ""}[kind]
    common = {"length": table.length_unit, "field": table.field_unit}.get(kind, "")
    columns = _columns(table, declared)
    own = [name for name in used if _kind(name) == kind]
    if option and not own and not missing:
        raise _contradiction(table, "header", f"no column of this kind ({kind})",
                             f"--{kind}-unit {option}")
    for name in own:
        text = columns[used[name]].unit
        if units.states_no_unit(text):
            text = common
        unit = text if kind == "time" and text in units.TIMES else units.unit_symbol(text)
        if not units.states_no_unit(text) and unit not in KINDS[kind]:
            raise MeasurementError(must_be(
                f"unit of {name}", table.where, f"one of {', '.join(KINDS[kind])}", f"'{text}'"))
        if unit and option and unit != option:
            raise _contradiction(table, f"unit of {name}", unit, f"--{kind}-unit {option}")
        if unit or option:
            found[name] = unit or option
        else:
            unknown.append(name)
    if unknown:
        missing.append(f"the unit of {', '.join(unknown)} ({OPTIONS[kind]})")
    return found


def _kind(name: str) -> str:
    """Return the kind of unit of a quantity, one of `KINDS`."""
    if name in ("phi", "t"):
        return "angle" if name == "phi" else "time"
    return "length" if name in (*names.POSITIONS, *names.MOVES) else "field"


def _cartesian(si: dict[str, Floats], where: str) -> tuple[Floats, Floats]:
    """Return points (n, 3) in m and B (n, 3) in T from columns in m, rad and T."""
    if "r" in si:
        if {"x", "y"} & set(si):
            raise MeasurementError(must_be("positions", where, "either x, y, z or r, phi, z",
                                           "both", "Leave some out with --columns and -."))
        angle = si["phi"]
        if np.nanmax(np.abs(angle), initial=0.0) > MOST_RAD:
            raise MeasurementError(must_be(
                "phi", where, f"within {MOST_RAD:.3g} rad", f"{np.nanmax(np.abs(angle)):g}",
                "Are they in degrees? Then give --angle-unit deg."))
        points = np.column_stack([si["r"] * np.cos(angle), si["r"] * np.sin(angle), si["z"]])
    else:
        points = np.column_stack([si["x"], si["y"], si["z"]])
        angle = np.arctan2(points[:, 1], points[:, 0])
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise MeasurementError(must_be(f"reading {int(np.argmax(bad)) + 1}", where,
                                       "at a finite position", "an empty or infinite coordinate"))
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


def _checked(points: Floats, flux_density: Floats, total: Floats, where: str) -> xr.Dataset:
    """Return the map without |B| ``total`` (n,) in T.

    Raises
    ------
    MeasurementError
        If values are too large for a permanent magnet.
    """
    if not len(points):
        raise MeasurementError(must_be("content", where, "at least one reading", "none"))
    largest = float(np.nanmax(np.abs(np.column_stack([flux_density, total]))))
    farthest = float(np.abs(points).max())
    if not largest <= MAX_FIELD_T:
        raise MeasurementError(must_be("flux densities", where, f"below {MAX_FIELD_T:g} T",
                                       f"{largest:g} T", "Is the unit right?"))
    if not farthest <= 10 * MAX_LENGTH_M:
        raise MeasurementError(must_be("positions", where, f"within {10 * MAX_LENGTH_M:g} m",
                                       f"{farthest:g} m", "Is the unit right?"))
    return field_map(points, flux_density)


def _contradiction(table: ForeignTable, what: str, file: str, user: str) -> MeasurementError:
    """Return the error for a file and an option that state different things."""
    return MeasurementError(must_be(what, table.where, "the same in the file and the options",
                                    f"{file} in the file and {user}",
                                    "Correct the option, or the file."))


def with_units(columns: Sequence[ColumnName], units_below: Sequence[str]) -> tuple[ColumnName, ...]:
    """Return columns without a unit of their own with the units of a line below the header."""
    return tuple(replace(column, unit=column.unit or unit.strip().strip("[]()"))
                 for column, unit in zip(columns, units_below, strict=True))
