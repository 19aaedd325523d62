"""Import of field maps in foreign formats, with the probe's calibration, and export to others.

Makers of probes deliver a table of calibration with two columns for each sensor: fields, and the
error of the reading in per cent of it, positive where the sensor reads too much. Readings are
corrected before the axes of the probe are turned into those of the magnet, by linear interpolation.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, OutputError, StudyError, must_be, printable
from halbach_fe.core.files import atomic, file_bytes
from halbach_fe.measurement.field_map import (
    POSITION_COLUMNS,
    TO_METRES,
    TOTAL_COLUMN,
    TOTAL_SIGMA_COLUMN,
    checked_readings,
    doubt_of_metres,
    labelled_map,
    read_map,
    save_map,
    warn_of_left_out,
    warn_of_millimetres,
    with_total_field,
)
from halbach_fe.measurement.formats import comsol, delimited_table, g4beamline, openpmd, paraview
from halbach_fe.measurement.formats.columns_to_map import ForeignTable, ImportedMap, to_map
from halbach_fe.measurement.formats.declared_format import FORMATS, DeclaredFormat
from halbach_fe.measurement.formats.grid_formats import (
    Grid,
    bdsim_lines,
    geant4_lines,
    grid_of,
    is_bdsim,
    is_fluka,
    is_opera,
    is_srw,
    read_bdsim,
    read_fluka,
    read_opera,
    read_srw,
)
from halbach_fe.measurement.formats.units import FIELDS, LENGTHS, in_si, unit_symbol
from halbach_fe.measurement.text_tables import Line, csv_table, finite, lines_of, text_of_table
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.types import COMPONENTS, look_like_mm

READERS: dict[str, Callable[[bytes, DeclaredFormat, str], ForeignTable]] = dict(zip(
    FORMATS, (delimited_table.read, read_opera, comsol.read, openpmd.read, g4beamline.read,
              read_bdsim, read_srw, read_fluka, paraview.read), strict=True))
"""Readers of foreign formats by name; each gets the file's content, the user's declarations and the
file's name for messages."""
RECOGNIZED: dict[str, Callable[[Sequence[Line]], bool]] = {
    "comsol": comsol.is_comsol, "g4beamline": g4beamline.is_g4beamline, "bdsim": is_bdsim,
    "srw": is_srw, "fluka": is_fluka, "opera": is_opera}
"""Whether the first lines of a file are of a format."""
GRIDS: dict[str, Callable[[Grid], bytes]] = {
    "openpmd": openpmd.content, "bdsim": lambda grid: _joined(bdsim_lines(grid)),
    "geant4": lambda grid: _joined(geant4_lines(grid))}
"""Writers of the formats that need a regular grid."""
SUFFIXES = {"csv": (".csv",), "vtu": (".vtu",), "openpmd": (".h5", ".hdf5")}
"""Suffixes of the formats that have a usual one."""
WRITERS = (*GRIDS, "csv", "vtu")
"""Names of the formats to which a map can be exported."""
CONVERTED = {"imported_length_unit": "length_unit_m", "imported_field_unit": "flux_density_unit_T"}
"""Attributes of an imported map with the units from which it was converted, and the keys of an
instrument that state units of maps."""
MAX_NAME = 255
"""Largest number of characters of a file name in the attributes of an imported map."""


def import_map(path: Path, declared: DeclaredFormat, name: str = "") -> ImportedMap:
    """Read a map in a foreign format.

    Parameters
    ----------
    declared : DeclaredFormat
        Statements of the user about the file.
    name : str
        Name of the format, one of `READERS`; by default it is recognized from the content.

    Raises
    ------
    MeasurementError
        If the file cannot be read as a map. The message names the file, and says how to correct it
        or which options to add.
    """
    where = f"map {path}"
    raw = text_of_table(file_bytes(path, where, workbooks=True), where, declared.decimal_comma)
    if not name and (own := _own(path, raw, declared)) is not None:
        return _with_doubt(own, declared)
    name = name or format_of(raw, declared, where)
    if declared.decimal_comma and name in ("opera", "openpmd", "paraview"):
        raise MeasurementError(must_be("format", where, "one in which numbers may have a decimal "
                                       "comma (--decimal-comma)", name, "Remove the option."))
    table = READERS[name](raw, declared, where)
    if declared.positions is not None:
        table = with_positions(table, declared.positions, declared.length_unit)
    found = to_map(table, declared)
    data = checked_readings(found.data, path)
    data.attrs |= {"imported_from": printable(path.name, MAX_NAME), "imported_as": name,
                   "imported_sha256": hashlib.sha256(raw).hexdigest()} | {
        name: units[0] for name, units in zip(CONVERTED, (found.length_units, found.field_units),
                                              strict=True) if len(units) == 1}
    return _with_doubt(replace(found, data=data, format=name), declared)


def refuse_units_twice(data: xr.Dataset, instrument: Instrument, path: Path | str) -> None:
    """Refuse a study's units for a map that was converted from units of its own by `import_map`.

    Factors that are the size of no unit remain: they correct what a file says.

    Raises
    ------
    StudyError
        If both say a unit.
    """
    for (name, key), (option, known) in zip(CONVERTED.items(), (
            ("length", LENGTHS), ("field", FIELDS)), strict=True):
        size, unit = getattr(instrument, key), unit_symbol(str(data.attrs.get(name, "")))
        if unit not in ("", "m", "T") and size != 1 and np.isclose(
                size, [float(each) for each in known.values()], atol=0).any():
            raise StudyError(must_be(
                f"`instrument.{key}`", "the study", f"left out for map {path}, which was converted "
                f"from {unit}, as its header or --{option}-unit says", f"{size:g}, by which it "
                "would be converted again", "Remove the key. If the file is wrong about its unit, "
                "state another by --columns, as in x[mm],y[mm],z[mm],Bx[mT]."))


def _with_doubt(file: ImportedMap, declared: DeclaredFormat) -> ImportedMap:
    """Return the file, with a remark if its points lie where few magnets have a field."""
    units, is_own = file.length_units, file.format not in READERS
    by_option = np.array([declared.at.get(axis, 0.0) for axis in COMPONENTS])
    by_option[0] += declared.at.get("r", 0.0)
    by_option += 0.0 if declared.origin_m is None else np.array(declared.origin_m)
    of_file = bool(units) and not look_like_mm(by_option[None])[0]
    stated = units[0] if of_file and not is_own and not declared.length_unit else ""
    doubt = doubt_of_metres(file.data, stated)
    if not doubt:
        return file
    advice = [TO_METRES if is_own else "--columns can name another, as in x[mm]" if stated else
              "Then give --length-unit mm"] if of_file else []
    advice += (["--origin-m is in m"] if declared.origin_m is not None else
               ["--at is in m"] if declared.at else [])
    remark = f"{doubt} {'; and '.join(advice)}."
    return replace(file, remarks=(*file.remarks, remark))


def with_positions(table: ForeignTable, path: Path, length_unit: str) -> ForeignTable:
    """Return a table of readings with the columns x, y and z of a file of positions.

    The user may state the ``length_unit`` of those that have none.

    Raises
    ------
    MeasurementError
        If the file has no x, y and z with their units, or another number of rows.
    """
    where = f"table of positions {path}"
    found = delimited_table.read(file_bytes(path, where), DeclaredFormat(), where)
    order = [[column.quantity for column in found.columns].index(name) for name in COMPONENTS
             if name in [column.quantity for column in found.columns]]
    if len(order) < len(COMPONENTS) or not all(
            unit_symbol(found.columns[number].unit or length_unit) for number in order):
        raise MeasurementError(must_be("header", where, "with x, y and z and their units, as in "
                                       "x[mm],y[mm],z[mm], or by --length-unit", ",".join(
                                           column.text for column in found.columns
                                           if column.text)[:60] or "none"))
    if len(found.values) != len(table.values):
        raise MeasurementError(must_be("content", where, f"{len(table.values)} rows, one for each "
                                       f"reading of {table.where}", str(len(found.values))))
    return replace(table, columns=(*table.columns, *(found.columns[n] for n in order)),
                   values=np.hstack([table.values, found.values[:, order]]),
                   added=table.added + len(order))


def _own(path: Path, raw: bytes, declared: DeclaredFormat) -> ImportedMap | None:
    """Return a map in halbach-fe's own HDF5 or VTU, moved to the stated origin; None for others.

    MeasurementError if it cannot be read, or the user states what the file says otherwise.
    """
    own_vtu = path.suffix == ".vtu" and (b'"B_T"' in raw or not paraview.is_paraview(raw))
    if not own_vtu and not (raw.startswith(openpmd.SIGNATURE) and openpmd.is_map(raw)):
        return None
    data = read_map(path)
    stated = replace(declared, origin_m=None, encoding=DeclaredFormat.encoding,
                     length_unit="" if declared.length_unit == "m" else declared.length_unit,
                     field_unit="" if declared.field_unit == "T" else declared.field_unit)
    if stated != DeclaredFormat():
        raise MeasurementError(must_be(
            "options of the format", f"map {path}", "left out, since the map is halbach-fe's own, "
            "in m and T and with named columns", "given", "Only --origin-m can be stated."))
    if declared.origin_m is not None:
        data = data.assign_coords({
            name: data[name] + shift for name, shift in zip(POSITION_COLUMNS, declared.origin_m,
                                                            strict=True)})
    return ImportedMap(data, ("m",), ("T",), (), 0, False, format="halbach-fe")


def format_of(raw: bytes, declared: DeclaredFormat, where: str) -> str:
    """Return the name in `READERS` of the format of a file, recognized by its first lines."""
    if raw.startswith(openpmd.SIGNATURE):
        return "openpmd"
    if paraview.is_paraview(raw):
        return "paraview"
    lines = lines_of(raw, declared, where)
    return next((name for name, of in RECOGNIZED.items() if of(lines)), "columns")


def export_map(data: xr.Dataset, name: str, path: Path) -> None:
    """Write a map in one of the formats `WRITERS`.

    The file is written atomically: it is either complete, or not there.

    Raises
    ------
    MeasurementError
        If the map is not labelled as `read_map` does, or the format needs a regular grid and its
        points do not form one.
    OutputError
        If the file cannot be written, or has the suffix of another format.
    """
    if path.suffix not in SUFFIXES.get(name, (path.suffix,)):
        raise OutputError(must_be("suffix", f"output {path}", " or ".join(SUFFIXES[name]),
                                  f"'{path.suffix}'"))
    where = f"map {data.encoding['source']}" if "source" in data.encoding else "map"
    data = labelled_map(data, where)
    warn_of_millimetres(data)
    others = {suffix for each in ("vtu", "openpmd") for suffix in SUFFIXES[each]}
    if name not in SUFFIXES and path.suffix in others:
        raise OutputError(must_be("suffix", f"output {path}", f"one of text, as {name} is",
                                  f"'{path.suffix}', that of another format"))
    if name not in GRIDS:
        save_map(data, path)
        return
    content = GRIDS[name](grid_of(data, where))
    warn_of_left_out(data, ("B_T",), path)
    with atomic(path) as temporary:
        temporary.write_bytes(content)


def _joined(lines: Iterable[str]) -> bytes:
    """Return lines of text as the content of a file."""
    return "\n".join([*lines, ""]).encode()


HEADER = "Bx (T),%err Bx,By (T),%err By,Bz (T),%err Bz"
"""Header of a table; a sensor that the map does not have may be missing."""

_FIELD = re.compile(r"B([xyz])\s*(?:_|\(|\[)\s*(\w+)\s*[)\]]?", re.IGNORECASE)
_ERROR = re.compile(r"%\s*err\w*\s*B([xyz])|B([xyz])_error_percent", re.IGNORECASE)


@dataclass(frozen=True)
class Calibration:
    """The errors of a probe's sensors."""

    name: str
    sha256: str
    """Name of the file, and digest of its content."""
    sensors: dict[str, tuple[Floats, Floats]]
    """For x, y and z: fields in T, ascending, and relative errors of the reading there."""

    def corrected(self, data: xr.Dataset, where: str) -> xr.Dataset:
        """Return a map, in T along the axes of the probe, with its readings corrected.

        Of them |B| too, where it is their length but for rounding; else another probe has read it.

        Raises
        ------
        MeasurementError
            If the table lacks a sensor that the map has, or its range.
        """
        field = np.array(data["B_T"].values, float)
        # part of a table's range by which readings may exceed it; they have the error of its end
        beyond = 0.05
        for number, axis in enumerate(COMPONENTS):
            shown = field[:, number]
            if np.isnan(shown).all():
                continue
            if axis not in self.sensors:
                raise MeasurementError(must_be(
                    "columns", self.name, f"those of every sensor of {where}, as B{axis}",
                    f"those of {', '.join('B' + name for name in self.sensors) or 'none'}",
                    f"A header is {HEADER}."))
            at, error = self.sensors[axis]
            low, high = at[0] - beyond * np.ptp(at), at[-1] + beyond * np.ptp(at)
            if np.nanmin(shown) < low or np.nanmax(shown) > high:
                raise MeasurementError(must_be(
                    f"fields of B{axis}", self.name,
                    f"from {np.nanmin(shown):.4g} to {np.nanmax(shown):.4g} T, as in {where}",
                    f"{at[0]:.4g} to {at[-1]:.4g} T",
                    "Use a calibration with that range, or check the unit of the map."))
            field[:, number] = shown / (1 + np.interp(shown, at, error))
        if TOTAL_COLUMN in data and _is_length(data[TOTAL_COLUMN].values, data["B_T"].values):
            sigma = data.get(TOTAL_SIGMA_COLUMN)
            data = with_total_field(data, np.linalg.norm(field, axis=1),
                                    None if sigma is None else sigma.values)
        return data.assign(B_T=(data["B_T"].dims, field, data["B_T"].attrs)).assign_attrs(
            calibrated_by=self.name, calibration_sha256=self.sha256)


def _is_length(total: Floats, field: Floats) -> bool:
    """Tell whether numbers (n,) are the lengths of vectors (n, 3), as far as both are rounded."""
    def step(values: Floats) -> float:
        return next((10.0 ** -digits for digits in range(sys.float_info.dig) if np.allclose(
            np.round(values, digits), values, rtol=1e-12, atol=0, equal_nan=True)), 0.0)

    length = np.linalg.norm(field, axis=1)
    off = 1e-12 * length + step(total) / 2 + np.sqrt(3) * step(field) / 2
    known = np.isfinite(total)
    return bool(known.any() and (np.abs(total - length) <= off)[known].all())


def read_calibration(path: Path) -> Calibration:
    """Read a table of calibration from a CSV file, with a header such as `HEADER`.

    Raises
    ------
    MeasurementError
        If the file is no such table.
    """
    largest_percent = 50.0  # errors above this are no calibration, but another column or unit
    # largest number of characters of a file's or column's name in a message
    longest_name = 80
    where = printable(path.name, longest_name)
    raw = file_bytes(path, where)
    _, header, rows = csv_table(raw, where, f"A header is {HEADER}.")
    fields, errors = {}, {}
    for number, name in enumerate(header):
        if found := _ERROR.fullmatch(name.strip()):
            errors[(found[1] or found[2]).lower()] = number
        elif (found := _FIELD.fullmatch(name.strip())) and (unit := unit_symbol(found[2])):
            fields[found[1].lower()] = number, unit
        else:
            raise MeasurementError(must_be("column", where, f"one of a header like {HEADER}",
                                           printable(name, longest_name), "Rename or remove it."))
    if not fields or fields.keys() != errors.keys() or len(fields) + len(errors) < len(header):
        raise MeasurementError(must_be(
            "columns", where, "one field and one error for every sensor", ", ".join(header),
            f"A header is {HEADER}."))
    values = np.array([[finite(cell, f"column {name} on line {line}", where)
                        for name, cell in zip(header, cells, strict=True)]
                       for line, cells in rows])
    sensors = {}
    for axis, (column, unit) in fields.items():
        order = np.argsort(values[:, column])
        at, error = in_si(values[order, column], unit), values[order, errors[axis]]
        if len(at) < 2 or not np.diff(at).min() > 0:
            raise MeasurementError(must_be(
                f"fields of B{axis}", where, "two or more different values", "repeated values"
                if len(at) > 1 else "a single one"))
        if np.abs(error).max() > largest_percent:
            raise MeasurementError(must_be(
                f"errors of B{axis}", where, f"at most {largest_percent:g} %",
                f"{error[np.abs(error).argmax()]:g} %", "Is this column in per cent?"))
        sensors[axis] = at, error / 100
    return Calibration(where, hashlib.sha256(raw).hexdigest(), sensors)
