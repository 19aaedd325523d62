"""Calibration of a three-axis probe against a reference: the error of each sensor over the field.

Makers of probes deliver a table with two columns for each sensor: fields, and the error of the
reading in per cent of it, positive where the sensor reads too much. Readings are corrected before
the axes of the probe are turned into those of the magnet, by linear interpolation.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be, printable
from halbach_fe.core.files import file_bytes
from halbach_fe.measurement.formats.units import in_si, unit_symbol
from halbach_fe.measurement.tables import csv_table, finite
from halbach_fe.study.types import COMPONENTS

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
        return data.assign(B_T=(data["B_T"].dims, field, data["B_T"].attrs)).assign_attrs(
            calibrated_by=self.name, calibration_sha256=self.sha256)


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
