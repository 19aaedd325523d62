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
from halbach_fe.core.numbers import in_a_row
from halbach_fe.measurement.field_map import (
    MAX_FIELD_T,
    field_map,
    is_placeholder,
    undirected,
    with_total_field,
    without_reading,
)
from halbach_fe.measurement.formats import column_names, units
from halbach_fe.measurement.formats.column_names import ColumnName
from halbach_fe.measurement.formats.declared_format import UNKNOWN, DeclaredFormat
from halbach_fe.measurement.text_tables import (
    Line,
    comma_hint,
    look_like_clock,
    times_from_clock,
    times_from_texts,
)
from halbach_fe.study.types import COMPONENTS, MAX_LENGTH_M, MAX_SIGMA_T, MIN_SIGMA_T

OPTIONS = {"length": "--length-unit m, cm, mm, um or inch",
           "field": "--field-unit T, mT, uT, G, kG or A/m, or a factor, as in '1e-7 T'",
           "angle": "--angle-unit deg or rad",
           "time": "--columns ...t[s], t[min], t[h] or t[hhmmss]"}
MAX_NUMBER = 1e30
"""Largest number that is accepted, in any unit. Larger values are placeholders for missing data, or
would overflow."""
NMR = "1 MHz of protons in water is a field of 0.0234872 T: Babs[0.0234872 T]"
PPM = "ppm of a mean field are no field: write a column of (1 + ppm / 1e6) times that mean"
MOST_NAMES = 12
"""Quantities of a reading that a table has at most; with more columns it is another one."""
PLACEHOLDER = "Where nothing was read, write nan."
MOST_RAD = 4 * np.pi
"""Largest angle of a position, two turns: larger ones are in degrees."""


@dataclass(frozen=True)
class ForeignTable:
    """The columns of a file in a foreign format, in the file's own units and axes."""

    columns: tuple[ColumnName, ...]
    """Names of the columns, with empty texts if the file does not name them."""
    values: Floats
    """In the file's units; NaN if a component was not measured, or a cell is no number.
    Shape (n, columns)."""
    where: str
    """Name of the file in error messages."""
    length_unit: str = ""
    """Unit of lengths that state no unit of their own; empty if the file does not state it."""
    anchor: str = ""
    """The point from which the file measures positions; empty if it is the magnet's centre."""
    comments: str = ""
    """Comments of the file, on a single line."""
    texts: dict[int, dict[int, Line]] = field(default_factory=dict)
    """For each column that is not all numbers: line number and text of the other cells by row."""
    attributes: dict[str, str] = field(default_factory=dict)
    """Attributes of a map in halbach-fe's own columns."""
    remarks: tuple[str, ...] = ()
    """Sentences for the user about what the file says of its numbers."""
    added: int = 0
    """Number of last columns that the rows of the file do not have."""


@dataclass(frozen=True)
class ImportedMap:
    """A map and a summary of how it was read."""

    data: xr.Dataset
    """The map, in m and T along the magnet's axes."""
    length_units: tuple[str, ...]
    field_units: tuple[str, ...]
    """Units of the file's columns."""
    ignored: tuple[str, ...]
    """Columns of the file that are not in the map."""
    dropped: int
    """Number of points without any measured component, which are not in the map."""
    cylindrical: bool
    """Whether the file has Br and Bphi, so that Bx and By are computed."""
    remarks: tuple[str, ...] = ()
    """Sentences for the user about what the file says of its numbers, and what was done with it."""
    format: str = ""
    """Name of the format of the file."""


def to_map(table: ForeignTable, declared: DeclaredFormat) -> ImportedMap:
    """Convert a table to a map, by the statements of the file and the user together.

    Raises
    ------
    MeasurementError
        If information is missing (the message lists all of it), if file and user contradict each
        other, or if the values are too large for a map of a permanent magnet.
    """
    columns = _with_times(_columns(table, declared), table)
    missing: list[str] = []
    used = _used(columns, table, declared, missing)
    _refuse_rows_of_components(used, table)
    missing += _missing(used, columns, table, declared)
    unit_of: dict[str, str] = {}
    for kind in OPTIONS:
        unit_of |= _units(kind, used, columns, table, declared, missing)
    if missing:
        raise MeasurementError(must_be(
            "content", table.where, "complete", f"a file that does not say {'; '.join(missing)}",
            "Give the options; nothing is guessed from the size of the numbers."))
    si = _in_si(used, unit_of, table)
    count = len(table.values)
    si |= {name: np.full(count, value) for name, value in declared.at.items()}
    # a stage that reports its moves starts at the file's origin
    si |= {name[1]: np.cumsum(si[name]) for name in column_names.MOVES if name in si}
    points, flux_density = _cartesian(si, table.where)
    if declared.origin_m is not None:
        points = points + declared.origin_m
    total = si.get(column_names.TOTAL, np.full(count, np.nan))
    read = ~(np.isnan(flux_density).all(axis=1) & np.isnan(total))
    if not read.any():
        empty = _quoted([columns[used[name]].text or name for name in used
                         if name in (*column_names.FIELDS, column_names.TOTAL)])
        raise MeasurementError(must_be(
            "content", table.where, "at least one reading",
            f"{count} rows without a number in {empty}" if count else "none"))
    data = _checked(points[read], flux_density[read], total[read], table.where)
    noise = _noise(si, used, table, columns)
    if noise is not None and not np.isnan(flux_density).all():
        _check_noise(noise, flux_density, used, columns, table.where)
        data["sigma_T"] = (("point", "component"), noise[read], {"units": "T"})
    if column_names.TOTAL in si:
        sigma = si.get(f"sigma_{column_names.TOTAL}", si.get("sigma"))
        data = with_total_field(data, total[read], None if sigma is None else sigma[read])
    if "t" in used:
        seconds = _seconds(used["t"], unit_of["t"], table, columns)
        data["time_s"] = ("point", seconds[read], {"units": "s"})
    if "scan" in used:
        data["scan"] = ("point", np.array(_words(used["scan"], table))[read])
    if table.comments:
        data.attrs["comments"] = table.comments
    data.attrs |= table.attributes
    if declared.component == UNKNOWN:
        data = undirected(data)
    lengths, fields = ({unit for name, unit in unit_of.items() if _kind(name) == kind}
                       for kind in ("length", "field"))
    ignored = tuple(column.text for index, column in enumerate(columns)
                    if index not in used.values() and column.text)
    remarks = (*table.remarks, *_overridden(columns, table, declared),
               *_remarks(columns, used, unit_of, table, declared),
               *([] if read.all() else [without_reading(~read, table.where)]))
    return ImportedMap(data, tuple(sorted(lengths)), tuple(sorted(fields)), ignored,
                       int((~read).sum()), "Br" in si, remarks)


def _in_si(used: dict[str, int], unit_of: dict[str, str], table: ForeignTable) -> dict[str, Floats]:
    """Return all columns that have a unit of `units.KINDS`, but times, in SI units."""
    si = {}
    for name, column in used.items():
        if name in ("t", "scan"):
            continue
        if column in table.texts:
            line, cell = min(table.texts[column].values())
            raise MeasurementError(must_be(f"{name} in line {line}", table.where, "a number",
                                           f"'{cell[:40]}'", comma_hint(cell) or (
                    f"{f'{PLACEHOLDER} ' if name.startswith('B') else ''}If the line is no "
                    f"reading, remove it, or begin it with #.")))
        _refuse_placeholder(table.values[:, column], name, table.where)
        si[name] = units.in_si(table.values[:, column], unit_of[name])
    return si


def _refuse_placeholder(values: Floats, name: str, where: str) -> None:
    """Raise MeasurementError for a number that is none, as 1e30, or 9999 far above all others."""
    size = np.nan_to_num(np.abs(values))
    row = int(np.argmax(size))
    far_above = 3.0  # times the next largest number, from which one of nines alone is no reading
    nines = name.startswith("B") and is_placeholder(float(size[row]))
    if size[row] > MAX_NUMBER or (nines and size[row] > far_above * max(
            size[size < size[row]], default=size[row])):
        raise MeasurementError(must_be(
            f"{name} of reading {row + 1}", where,
            "a reading" if nines else f"a reading, below {MAX_NUMBER:g}",
            f"{values[row]:g}, which looks like a placeholder", PLACEHOLDER))


def _refuse_rows_of_components(used: dict[str, int], table: ForeignTable) -> None:
    """Raise MeasurementError for a table that has each component of a reading in a row of its own.

    A column of it holds the names of the components, and the places are repeated; scans along x, y
    and z that are named so have few places in common.
    """
    several = 0.75  # places per row, from which rows are readings at places of their own
    places = np.unique(table.values[:, [used[name] for name in used
                                        if _kind(name) in ("length", "angle")]], axis=0)
    if sum(name in used for name in column_names.FIELDS) > 1 or (
            places.size and len(places) > several * len(table.values)):
        return
    for column, cells in table.texts.items():
        found = {cell.strip().lower() for _, cell in cells.values()}
        if len(cells) == len(table.values) and len(found) > 1 and (
                found <= {"x", "y", "z"} or found <= {"bx", "by", "bz", "babs", "|b|"}):
            raise MeasurementError(must_be(
                f"column {table.columns[column].text or column + 1}", table.where,
                "absent, and each component a column of its own", "the name of a component in each "
                "row", "Write one row for each point, in a spreadsheet by a pivot table, or by "
                "pivot_table of pandas."))


def _noise(
    si: dict[str, Floats], used: dict[str, int], table: ForeignTable, columns: Sequence[ColumnName]
) -> Floats | None:
    """Return the standard deviation (n, 3) in T of each reading; None if no column states it.

    It is NaN where none is stated. That of Bx and By of a probe that reads Br and Bphi follows from
    theirs; it is not stored that Bx and By are then correlated.
    """
    of = {name: si[name] for name in column_names.NOISE if name in si}
    if not of:
        return None
    if "sigma" in of:
        if len(of) > 1:
            raise MeasurementError(must_be(
                "header", table.where, "with one standard deviation for all components, or one "
                "for each", ", ".join(f"'{columns[used[name]].text}'" for name in of),
                "Choose with --columns; - ignores a column."))
        return np.repeat(of["sigma"][:, None], 3, axis=1)
    empty = np.full(len(table.values), np.nan)
    if "Btheta" in used:
        raise MeasurementError(must_be(
            "standard deviations", table.where, "one for all components, where these are Br, "
            "Btheta and Bphi", ", ".join(f"'{columns[used[name]].text}'" for name in of),
            "Name one column sigma in --columns, and ignore the others by -."))
    if {"sigma_Br", "sigma_Bphi"} & set(of):
        radial, around = of.get("sigma_Br", empty), of.get("sigma_Bphi", empty)
        angle = si["phi"] if "phi" in si else np.arctan2(si["y"], si["x"])
        cos2, sin2 = np.cos(angle)**2, np.sin(angle)**2
        across = (np.sqrt(cos2 * radial**2 + sin2 * around**2),
                  np.sqrt(sin2 * radial**2 + cos2 * around**2))
        return np.column_stack([*across, of.get("sigma_Bz", empty)])
    return np.column_stack([of.get(f"sigma_B{name}", empty) for name in COMPONENTS])


def _check_noise(
    noise: Floats, flux_density: Floats, used: dict[str, int], columns: Sequence[ColumnName],
    where: str
) -> None:
    """Raise MeasurementError if a reading has no standard deviation, or an absurd one."""
    stated = ", ".join(f"'{columns[used[name]].text}'"
                       for name in column_names.NOISE if name in used)
    of_readings = ~np.isnan(flux_density)
    good = (noise >= MIN_SIGMA_T) & (noise <= MAX_SIGMA_T)
    bad = of_readings & ~good
    if bad.any():
        row, component = np.argwhere(bad)[0]
        value = noise[row, component]
        if np.isnan(noise[:, component]).all():
            raise MeasurementError(must_be(
                "standard deviations", where,
                f"stated of every component that is read, but B{COMPONENTS[component]} has none",
                f"those in {stated} alone",
                "If they hold for all components, name one column sigma in --columns; "
                "otherwise ignore them by - in their place, and state [noise] in the study."))
        raise MeasurementError(must_be(
            f"standard deviation of B{COMPONENTS[component]} in reading {row + 1}", where,
            f"from {MIN_SIGMA_T:g} to {MAX_SIGMA_T:g} T (from {stated})",
            "none" if np.isnan(value) else f"{value:g} T",
            "If the column is no standard deviation, leave it out: - in its place in --columns."))


def _seconds(
    column: int, unit: str, table: ForeignTable, columns: Sequence[ColumnName]
) -> Floats:
    """Return the times (n,) in s of a column of numbers, times of day or ISO stamps."""
    name, values = columns[column].text or "t", table.values[:, column]
    if column in table.texts:
        cells = table.texts[column]
        found = None if len(cells) < len(values) else times_from_texts(
            [cells[row][1] for row in range(len(values))])
        if found is None:
            line, cell = min(cells.values())
            raise MeasurementError(must_be(
                f"time '{name}' in line {line}", table.where, "like all others a number, a time "
                "of day HH:MM:SS, or a stamp 2024-05-31T14:23:59", f"'{cell[:40]}'",
                "Correct it, or ignore the column: - in --columns."))
        return found
    bad = ~(np.abs(values) <= MAX_NUMBER)
    if bad.any():
        raise MeasurementError(must_be(
            f"time '{name}' of reading {int(np.argmax(bad)) + 1}", table.where,
            f"a number below {MAX_NUMBER:g}", "none" if np.isnan(values[bad][0]) else "more",
            "Correct it, or ignore the column: - in --columns."))
    if units.CLOCK.fullmatch(unit):
        found = times_from_clock(values)
        if found is None:
            raise MeasurementError(must_be(f"time '{name}'", table.where, "times of day HHMMSS",
                                           "a number that is none"))
        return found
    if unit == "s" and look_like_clock(values):
        raise MeasurementError(must_be(
            f"time '{name}'", table.where, "clearly in s", f"{values[0]:.0f} to {values[-1]:.0f}, "
            "which may as well be times of day, HHMMSS",
            "If they are, state t[hhmmss] in --columns; if not, subtract the first of them."))
    return units.in_si(values, unit)


def _words(column: int, table: ForeignTable) -> list[str]:
    """Return the cells of a column as text; numbers are written anew."""
    cells = table.texts.get(column, {})
    return [cells[row][1] if row in cells else "" if np.isnan(value) else f"{value:.15g}"
            for row, value in enumerate(table.values[:, column])]


def _remarks(
    columns: Sequence[ColumnName], used: dict[str, int], unit_of: dict[str, str],
    table: ForeignTable, declared: DeclaredFormat
) -> list[str]:
    """Return sentences about columns that were recognized though the user did not state them."""
    plain = [column_names.parse(column.text) for column in columns]
    by_axis = [one.text for one, other in zip(plain, column_names.with_axes(plain), strict=True)
               if one != other]
    said = [f"{_quoted(by_axis)} were read as positions or components, by their axes and units."
            ] if by_axis and not declared.columns else []
    shared = [columns[used[name]].text for name, unit in unit_of.items()
              if name not in column_names.NOISE and not columns[used[name]].unit
              and not declared.unit_of(_kind(name)) and unit != "hhmmss"
              and not (table.length_unit and _kind(name) == "length")]
    if shared:
        said.append(f"{_quoted(shared)} {'was' if len(shared) == 1 else 'were'} read in the unit "
                    "of the column beside.")
    said += ["The columns of H were read as B = mu_0 H, as it is in air."] if any(
        unit.rpartition(" ")[2] in units.H_FIELDS for unit in unit_of.values()) else []
    noise = [name for name in column_names.NOISE if name in used]
    own = any(column.text in ("sigma_T", "sigma_Bx_T", "sigma_By_T", "sigma_Bz_T")
              for column in columns)
    if noise and not declared.columns and not own:
        shown = " and ".join(f"'{columns[used[name]].text}' (in {unit_of[name]})" for name in noise)
        said.append(
            f"{shown} {'was' if len(noise) == 1 else 'were'} read as the standard deviation of "
            + ("all components" if noise == ["sigma"] else "the components in the names")
            + ", which takes the place of the study's noise; if that is wrong, ignore "
            f"{'it' if len(noise) == 1 else 'them'} by - in --columns.")
    if {"sigma_Br", "sigma_Bphi"} & set(noise):
        said.append("The standard deviations of Br and Bphi were turned into those of Bx and By, "
                    "as if errors of Bx and By were independent.")
    if "theta" in used:
        said.append("theta was read as the angle from the z axis, and phi as that about it; if it "
                    "is the other way round, exchange them in --columns.")
    for index, column in enumerate(columns):
        if index in used.values() or not column.text or (
                declared.columns and declared.columns[index].strip() == "-"):
            continue
        values = table.values[:, index]
        if column_names.is_imaginary(column.text) and np.nan_to_num(values).any():
            said.append(f"'{column.text}' is not zero, up to {np.nanmax(np.abs(values)):.4g}: of a "
                        "field that changes in time only the real part was read.")
        elif column_names.is_time(column):
            why = "their unit is not stated"
            if "t" in used:
                said.append(f"The times in '{column.text}' are not used: those in "
                            f"'{columns[used['t']].text}' are.")
                continue
            if table.texts.get(index):
                why = "they are neither times of day HH:MM:SS nor stamps 2024-05-31T14:23:59"
            elif look_like_clock(values):
                why += " (they look like HHMMSS)"
            said.append(f"The times in '{column.text}' are not used, as {why}: state "
                        "t[s], t[min], t[h] or t[hhmmss] in its place in --columns.")
        elif column_names.noise_of(column.text, column.text.lower()) in column_names.POSITIONS:
            said.append(f"The uncertainty of positions in '{column.text}' is not used: "
                        "state noise.position_sd_m in the study.")
    return said


def _with_times(columns: Sequence[ColumnName], table: ForeignTable) -> tuple[ColumnName, ...]:
    """Return the columns, of which one of times of day or stamps is a time without a unit.

    It is the first of them, if no other column is the time.
    """
    if any(column.quantity == "t" for column in columns):
        return tuple(columns)
    for index, column in enumerate(columns):
        cells = table.texts.get(index, {})
        if column_names.is_time(column) and len(cells) == len(table.values) and times_from_texts(
                [cell for _, cell in cells.values()]) is not None:
            return (*columns[:index], replace(column, quantity="t"), *columns[index + 1:])
    return tuple(columns)


def _columns(table: ForeignTable, declared: DeclaredFormat) -> tuple[ColumnName, ...]:
    """Return the file's columns with the names and units that the user states instead."""
    if not declared.columns:
        signed = [column.text for column in table.columns if column_names.is_signed(column.text)
                  and column_names.parse(column.text.replace("-", "", 1)).quantity]
        if signed:
            raise MeasurementError(must_be(
                "header", table.where, "made of positions and components", f"{_quoted(signed)}, "
                "with a minus before it", "Change the sign of these numbers and remove the minus; "
                "if it means nothing, name all columns by --columns (- ignores a column)."))
        return _of_h(column_names.with_polar(table.columns, declared.at))
    count = len(table.columns) - table.added
    more = declared.columns[count:]  # delimiters at the ends of lines have no column in the table
    if len(declared.columns) < count or any(text != "-" for text in more):
        raise MeasurementError(must_be(
            "--columns", table.where, f"of {count} columns, as the file has",
            f"{len(declared.columns)}", "Name each column; - ignores a column."))
    found = []
    own = column_names.with_polar(
        [ColumnName("") if text == "-" else column_names.parse(text, stated=True)
         for text in declared.columns], declared.at)
    for text, stated, column in zip(declared.columns, own, table.columns[:count], strict=False):
        if text != "-" and not stated.quantity:
            raise MeasurementError(must_be(
                "--columns", table.where,
                f"made of {', '.join((*column_names.KNOWN, *column_names.STATED))} and -",
                f"'{text}'"))
        found.append(ColumnName(column.text or stated.text, stated.quantity,
                                stated.unit or column.unit))
    return _of_h((*found, *table.columns[count:]))


def _overridden(
    columns: Sequence[ColumnName], table: ForeignTable, declared: DeclaredFormat
) -> list[str]:
    """Return sentences about what --columns states otherwise than the header."""
    found = []
    for text, column, own in zip(declared.columns, columns, table.columns, strict=False):
        name = own.quantity not in ("", *column_names.OTHERS, column.quantity) and text != "-"
        unit = units.unit_symbol(own.unit)
        if (name and own.quantity != "B") or (column.quantity and unit and unit
                                              != units.unit_symbol(column.unit)):
            found.append(f"'{own.text}' of the header was read as {text}, as --columns says.")
    return found


def _of_h(columns: Sequence[ColumnName]) -> tuple[ColumnName, ...]:
    """Return the columns, those of H as of B if there is no other B."""
    of_b = any(column.quantity in (*column_names.FIELDS, "B", column_names.TOTAL)
               for column in columns)
    return tuple(replace(column, quantity="" if of_b else f"B{column.quantity[1:]}")
                 if column.quantity.startswith("H") else column for column in columns)


def _used(
    columns: Sequence[ColumnName], table: ForeignTable, declared: DeclaredFormat,
    missing: list[str]
) -> dict[str, int]:
    """Return the index of the column of each quantity that the map uses.

    Quantities of several columns are added to the descriptions in ``missing``.
    """
    used: dict[str, int] = {}
    again: dict[str, list[str]] = {}
    for index, column in enumerate(columns):
        if not column.quantity:
            continue
        if column.quantity in used and column.quantity == "phi":
            raise MeasurementError(must_be(
                "positions", table.where, "x, y, z or r, phi, z or r, theta, phi", "r with two "
                f"angles, '{columns[used['phi']].text}' and '{column.text}'",
                "Name the angle from the z axis theta, and that about it phi, in --columns."))
        if column.quantity in used:
            again.setdefault(column.quantity, [columns[used[column.quantity]].text]).append(
                column.text)
            continue
        used[column.quantity] = index
    missing += [f"its one column {name}: {' or '.join(map(repr, texts[:3]))}"
                f"{f' or {len(texts) - 3} more' if len(texts) > 3 else ''} (--columns, - to "
                "ignore a column)" for name, texts in again.items()]
    components = [name for name in column_names.FIELDS if name in used]
    if declared.component and used:
        name = f"B{'z' if declared.component == UNKNOWN else declared.component}"  # Bx, Babs
        if "B" not in used or components:
            raise _contradiction(table, "header", ", ".join(components) or "no column B",
                                 f"--component {declared.component}")
        used[name] = used.pop("B")
    elif components and "B" in used:  # beside its components, B is the magnitude
        magnitude = used.pop("B")
        if len(components) == 3:
            used.setdefault(column_names.TOTAL, magnitude)
    if components and column_names.TOTAL in used and not (
            units.unit_symbol(columns[used[column_names.TOTAL]].unit) or declared.field_unit):
        del used[column_names.TOTAL]  # it is not needed
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
        return _without_names(columns, table, declared)
    latitude = [column.text for column in columns if column_names.is_latitude(column)]
    if (hint := _of_field(used, columns)) is None and latitude and not (
            {"x", "y", "z", "theta"} & set(used)):
        hint = (f"the angle from the z axis: '{latitude[0]}' counts from the plane z = 0 (replace "
                "it by a column theta of 90 degrees less it, beside r and phi; a component along "
                "growing latitude is -Btheta)")
    wanted = ("r", "theta", "phi") if "theta" in used else (
        "r", "phi", "z") if {"r", "phi"} & set(used) else ("x", "y", "z")
    absent = [name for name in wanted if name not in used and name not in declared.at
              and f"d{name}" not in used]
    if hint is None and absent == ["phi"]:
        hint = ("phi (--columns); if the field has rotational symmetry, state its half-plane: x "
                "for r and Bx for Br in --columns, and --at y=0")
    if hint is not None:
        return [hint]
    unknown = _unknown(columns)
    places = "" if not absent else f"{', '.join(absent)} ({_by_option(absent)}" + (
        f", as nothing is known of {_quoted(unknown)}"
        if unknown and not declared.columns else "") + ")"
    anchor = "" if not table.anchor or declared.origin_m is not None else (
        f"where {table.anchor} is along the magnet's axes (--origin-m=X,Y,Z)")
    return [*filter(None, (places, _without_components(used, columns, declared),
                           _without_other_polar_components(used), anchor))]


def _unknown(columns: Sequence[ColumnName]) -> list[str]:
    """Return the names of columns that say nothing."""
    return [column.text for column in columns if column.text and not column.quantity]


def _without_names(
    columns: Sequence[ColumnName], table: ForeignTable, declared: DeclaredFormat
) -> list[str]:
    """Return what is missing in a file none of whose columns is known."""
    unknown = _unknown(columns)
    few, many = len(columns) <= len(COMPONENTS), len(columns) > MOST_NAMES and not unknown
    return [f"what its {len(columns)} columns "
            f"{f'({_quoted(unknown)}) ' if unknown else ''}are "
            "(--columns x,y,z,Bx,By,Bz, - to ignore a column"
            + ("; of points on a line, as --columns z,Bz and --at x=0,y=0; if there are no "
               f"positions, --columns {','.join(column_names.FIELDS[:len(columns)])} and "
               "--positions TABLE" if few else "")
            + ("; if every quantity has a row of its own, make it a column, in a spreadsheet "
               "by Paste Special, Transpose, or by numpy.transpose"
               if _is_transposed(table) else "")
            + ("; if it is a matrix over two axes, write a row x, y, B for each of its cells"
               if many or _is_matrix(table.values) else "")
            + ")"] + [
        f"the unit of {what} ({OPTIONS[kind]})" for kind, what, said in (
            ("length", "positions", declared.length_unit or table.length_unit),
            ("field", "B", declared.field_unit)) if not said]


def _without_components(
    used: dict[str, int], columns: Sequence[ColumnName], declared: DeclaredFormat
) -> str:
    """Return what does not say which components of B were read; empty if all is known."""
    if "B" in used:
        return ("which component B is (--component x, y or z), whether it is |B| (--component "
                "abs), or that nobody knows (--component unknown: halbach-fe register then tries "
                "all three)")
    if unread := _unread_components(used, columns, declared):
        return unread
    if {*column_names.FIELDS, column_names.TOTAL} & set(used):
        return ""
    unknown = _unknown(columns)
    return ("which columns are Bx, By or Bz, Babs for |B|, or B for a component that nobody "
            "knows, with --component unknown (--columns"
            + (f", instead of {_quoted(unknown)}" if unknown else "")
            + (f"; {NMR}" if any("hz" in text.lower() for text in unknown) else "")
            + (f"; {PPM}" if any("ppm" in column.text.lower() for column in columns) else "")
            + ")")


def _without_other_polar_components(used: dict[str, int]) -> str:
    """Return the components along r, theta and phi that are not there beside others of these."""
    whole = ["Br", *(["Btheta"] if "theta" in used else []), "Bphi"]
    half = [name for name in whole if name not in used]
    if not half or half == whole:
        return ""
    rest = " and ".join(name for name in whole if name in used)
    return f"{' and '.join(half)}, without which {rest} is no Bx or By (--columns)"


def _unread_components(
    used: dict[str, int], columns: Sequence[ColumnName], declared: DeclaredFormat
) -> str:
    """Return what to do where unknown columns in a unit of the field may be the components that the
    known ones lack; empty if there are no such, or if the user names the columns.
    """
    lacking = [name for name in column_names.FIELDS[:3] if name not in used]
    unknown = [column.text for column in columns if not column.quantity
               and units.kind_of(column_names.split_unit(column.text)[1]) == "field"]
    if declared.columns or not 0 < len(lacking) < len(COMPONENTS) or len(unknown) != len(lacking):
        return ""
    return (f"whether {_quoted(unknown)} {'is' if len(lacking) == 1 else 'are'} "
            f"{in_a_row(lacking)} (--columns; - ignores a column)")


def _quoted(texts: Sequence[str]) -> str:
    """Return the first `MOST_NAMES` texts in quotes."""
    more = [f"{len(texts) - MOST_NAMES} more"] if len(texts) > MOST_NAMES else []
    return in_a_row([f"'{text}'" for text in texts[:MOST_NAMES]] + more)


def _is_matrix(values: Floats) -> bool:
    """Return whether the first row and column of numbers (n, m) grow or fall all along."""
    fewest = 3  # cells of an axis
    return min(values.shape) >= fewest and all(
        np.all(steps > 0) or np.all(steps < 0)
        for steps in (np.diff(values[0, 1:]), np.diff(values[1:, 0])))


def _is_transposed(table: ForeignTable) -> bool:
    """Return whether the rows may be quantities: they are few, or begin with the names of some."""
    named = [column_names.parse(cell).quantity for _, cell in table.texts.get(0, {}).values()]
    rows, columns = table.values.shape
    return sum(map(bool, named)) > 1 or (rows <= MOST_NAMES and columns > 2 * MOST_NAMES)


def _of_field(used: dict[str, int], columns: Sequence[ColumnName]) -> str | None:
    """Return what to do with x, y and z beside no field: in logs of meters they are the field."""
    kinds = {_kind(name) for name in used}
    if not {"x", "y", "z"} <= set(used) or "field" in kinds or any(
            units.kind_of(columns[used[name]].unit) for name in "xyz"):
        return None
    stated = ["-"] * len(columns)
    for name in "xyz":
        stated[used[name]] = f"B{name}[T]"
    magnitude = any(column.text.lower() in column_names.MAGNITUDES for column in columns)
    return ("whether x, y and z are positions, so that there is no field"
            f" (--columns), or {'rather, beside a magnitude, ' if magnitude else ''}the field, so "
            f"that there are no positions (--columns={','.join(stated)}, with the unit, and "
            "--positions TABLE: x, y and z of every row; or --at x=0,y=0,z=0)")


def _by_option(absent: Sequence[str]) -> str:
    """Return the options that provide absent coordinates."""
    if "phi" in absent:
        return "--columns"
    if "r" in absent:
        return f"--at {','.join(f'{name}=0.01' for name in absent)} in m, or --columns"
    if len(absent) == len(COMPONENTS):
        return "--positions TABLE with a row x, y, z for each reading, or --columns"
    return f"--at {','.join(f'{name}=0' for name in absent)} in m, or --columns"


def _units(
    kind: str, used: dict[str, int], columns: Sequence[ColumnName], table: ForeignTable,
    declared: DeclaredFormat, missing: list[str]
) -> dict[str, str]:
    """Return the unit of each column of a kind, one of `units.KINDS`.

    Columns without a unit are added to the descriptions in ``missing``.
    """
    found: dict[str, str] = {}
    unknown = []
    foreign: dict[str, list[str]] = {}
    option = declared.unit_of(kind)
    own = sorted((name for name in used if _kind(name) == kind),
                 key=lambda name: name in column_names.NOISE)
    if option and not own and not missing:
        raise _contradiction(table, "header", f"no column of this kind ({kind})",
                             f"--{kind}-unit {option}")
    shared = "" if kind == "length" and table.length_unit else _unit_of_all(
        columns, {used[name] for name in own if name not in column_names.NOISE})
    for name in own:
        text = columns[used[name]].unit or ("" if name in column_names.NOISE else shared)
        if units.states_no_unit(text):
            text = table.length_unit if kind == "length" else ""
        if kind == "time":
            written = used[name] in table.texts or units.CLOCK.fullmatch(text) or (
                column_names.is_clock(columns[used[name]]))
            if written:  # as times of day or stamps, whatever unit the header names
                found[name] = "hhmmss"
                continue
        unit = text if kind == "time" and text in units.TIMES else units.unit_symbol(text)
        if not units.states_no_unit(text) and (not unit or (
                kind != "time" and units.kind_of(unit) != kind)):
            foreign.setdefault(text, []).append(name)
            continue
        if unit and option and unit != option and name not in column_names.NOISE:
            raise _contradiction(table, f"unit of {name}", unit, f"--{kind}-unit {option}")
        of = found.get(name.removeprefix("sigma_")) or next(
            (found[other] for other in column_names.FIELDS if other in found), "")
        # noise is in the unit of its reading
        if unit or (of and name in column_names.NOISE) or option:
            found[name] = unit or (of if name in column_names.NOISE else "") or option
        else:
            unknown.append(name)
    missing += [f"the unit of {', '.join(of)}, as '{text[:20]}' is none of "
                f"{', '.join(units.KINDS[kind])} (--columns ...{of[0]}[{_stated(text, kind)})"
                for text, of in foreign.items()]
    if unknown:
        missing.append(f"the unit of {', '.join(unknown)} ({OPTIONS[kind]})")
    return found


def _unit_of_all(columns: Sequence[ColumnName], own: set[int]) -> str:
    """Return the unit that one of the columns ``own`` of a kind states for all, or an empty text.

    It is the first or the last one of columns beside each other, as in Bx, By, Bz [mT].
    """
    first, last = min(own, default=0), max(own, default=0)
    stated = {index: columns[index].unit for index in own if columns[index].unit}
    beside = last - first + 1 == len(own)
    return next(iter(stated.values())) if beside and len(stated) == 1 and (
        {first, last} & stated.keys()) else ""


def _stated(text: str, kind: str) -> str:
    """Return how to state a unit in place of another ``text``, which may be a factor, with the
    bracket that ends it.
    """
    one = next(iter(units.KINDS[kind]))
    if units.unit_symbol(f"{text} {one}"):
        return f"{text} {one}]"
    return f"{one}]" if kind in ("time", "angle") else (
        f"N {one}], with the size N of this unit in {one}")


def _kind(name: str) -> str:
    """Return the kind of unit of a quantity, one of `units.KINDS`."""
    if name in ("theta", "phi", "t", "scan"):
        return {"t": "time", "scan": ""}.get(name, "angle")
    return "length" if name in (*column_names.POSITIONS, *column_names.MOVES) else "field"


def _cartesian(si: dict[str, Floats], where: str) -> tuple[Floats, Floats]:
    """Return points (n, 3) in m and B (n, 3) in T from columns in m, rad and T."""
    si = _cylindrical(si, where) if "theta" in si else si
    if "r" in si:
        if {"x", "y"} & set(si):
            raise _both("positions", "x, y, z or r, phi, z", where)
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
                                       "at a finite position", "an empty or infinite coordinate",
                                       "If the row is no reading, remove it."))
    empty = np.full(len(points), np.nan)
    if "Br" not in si:
        return points, np.column_stack([si.get(name, empty) for name in ("Bx", "By", "Bz")])
    if {"Bx", "By"} & set(si):
        raise _both("components", "Bx, By or Br, Bphi", where)
    if "r" not in si and not np.hypot(points[:, 0], points[:, 1]).all():
        raise MeasurementError(must_be(
            "Br and Bphi", where, "at points off the axis", "some on it, where they have no "
            "direction", "Give r and phi, or leave those points out."))
    cos, sin = np.cos(angle), np.sin(angle)
    return points, np.column_stack([si["Br"] * cos - si["Bphi"] * sin,
                                    si["Br"] * sin + si["Bphi"] * cos, si.get("Bz", empty)])


def _both(what: str, either: str, where: str) -> MeasurementError:
    """Return the error of a file that has two of what excludes each other."""
    return MeasurementError(must_be(what, where, f"either {either}", "both",
                                    "Leave some out with --columns and -."))


def _cylindrical(si: dict[str, Floats], where: str) -> dict[str, Floats]:
    """Return columns of spherical coordinates as those of cylindrical ones."""
    angle = si["theta"]
    if {"x", "y", "z"} & set(si):
        raise _both("positions", "x, y, z or r, theta, phi", where)
    if not (np.nanmin(angle) >= 0 and np.nanmax(angle) <= np.pi * (1 + 1e-6)):
        raise MeasurementError(must_be(
            "theta", where, "from 0 to 180 degrees, the angle from the z axis",
            f"{np.degrees(np.nanmin(angle)):.4g} to {np.degrees(np.nanmax(angle)):.4g} degrees",
            "If it is the angle about z, exchange theta and phi, and Btheta and Bphi, in "
            "--columns; the unit of both is that of their names, or --angle-unit."))
    cos, sin = np.cos(angle), np.sin(angle)
    turned = {name: si[name] for name in si if name != "theta"} | {
        "r": si["r"] * sin, "z": si["r"] * cos}
    if "Btheta" in si:
        if {"Bx", "By", "Bz"} & set(si):
            raise _both("components", "Bx, By, Bz or Br, Btheta, Bphi", where)
        turned |= {"Br": si["Br"] * sin + si["Btheta"] * cos,
                   "Bz": si["Br"] * cos - si["Btheta"] * sin}
    return turned


def _checked(points: Floats, flux_density: Floats, total: Floats, where: str) -> xr.Dataset:
    """Return the map without |B| ``total`` (n,) in T.

    MeasurementError if values are too large for a permanent magnet.
    """
    largest = float(np.nanmax(np.abs(np.column_stack([flux_density, total]))))
    farthest = float(np.abs(points).max())
    if not largest <= MAX_FIELD_T:
        raise MeasurementError(must_be("flux densities", where, f"below {MAX_FIELD_T:g} T",
                                       f"{largest:g} T", f"Is the unit right? {PLACEHOLDER}"))
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
    return tuple(column if column.unit else replace(
        column_names.parse(f"{column.text} [{unit.strip().strip('[]()')}]"), text=column.text)
        for column, unit in zip(columns, units_below, strict=True))
