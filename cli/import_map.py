"""Convert a measured map from another file format, to metres, tesla and halbach-fe's own columns.

Reads tables of columns (separated by commas, semicolons, tabs or spaces, with or without a header),
Opera's .table files, text files exported by COMSOL, and openPMD-beamphysics field meshes. Units,
columns and constant coordinates that the file does not state must be given as options; nothing is
guessed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from halbach_fe.cli import common
from halbach_fe.measurement.field_map import points_of, write_map
from halbach_fe.measurement.formats import READERS, ImportedFile, import_map
from halbach_fe.measurement.formats.declared import DeclaredFormat
from halbach_fe.measurement.formats.units import ANGLES, FIELDS, LENGTHS
from halbach_fe.study.types import COMPONENTS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("file", type=Path, metavar="FILE", help="map as it was delivered")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="MAP",
                        help="map to write: .csv, .h5 or .vtu")
    parser.add_argument("--format", choices=READERS, default="",
                        help="format of FILE (default: recognized from its beginning)")
    parser.add_argument("--length-unit", choices=LENGTHS, default="", help="unit of the positions")
    parser.add_argument("--field-unit", choices=FIELDS, default="", help="unit of B")
    parser.add_argument("--angle-unit", choices=ANGLES, default="", help="unit of phi")
    parser.add_argument("--columns", type=names, default=(), metavar="NAME,NAME...",
                        help="content of each column: x, y, z, r, phi, Bx, By, Bz, Br, Bphi, B, "
                        "dx, dy, dz (moves of a stage from reading to reading), t (time), or - "
                        "for a column that is ignored; a unit may follow, as in Bx[mT], t[s]")
    parser.add_argument("--component", choices=COMPONENTS, default="",
                        help="component of the field in a column B")
    parser.add_argument("--at", type=coordinates, default={}, metavar="AXIS=M,...",
                        help="constant coordinates in m that the file does not contain, for "
                        "example x=0,y=0")
    parser.add_argument("--origin-m", type=point, metavar="X,Y,Z",
                        help="position in m of the file's origin, along the magnet's axes; with a "
                        "negative number write --origin-m=-0.5,0,0")
    parser.add_argument("--decimal-comma", action="store_true",
                        help="numbers have a decimal comma, as in 0,5")
    parser.add_argument("--encoding", default=DeclaredFormat.encoding,
                        help="encoding of a text file (default: UTF-8)")
    common.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read the file, convert it, write the map, and print how the file was understood."""
    declared = DeclaredFormat(
        length_unit=arguments.length_unit, field_unit=arguments.field_unit,
        angle_unit=arguments.angle_unit, columns=arguments.columns,
        component=arguments.component, at=arguments.at, origin_m=arguments.origin_m,
        decimal_comma=arguments.decimal_comma, encoding=arguments.encoding)
    imported = import_map(arguments.file, declared, arguments.format)
    write_map(imported.data, arguments.output)
    properties = summary(imported)
    if arguments.json:
        common.print_json(properties | {"map": str(arguments.output)})
    else:
        common.print_table([{"property": key, "value": text(value)}
                            for key, value in properties.items()], f"Read as {imported.format}")
        common.say(f"Map: {arguments.output}")
    return 0


def summary(file: ImportedFile) -> dict[str, object]:
    """Return the properties of the imported map as plain data, for the user to check."""
    points, field = points_of(file.data), file.data["B_T"].values
    measured = [i for i in range(3) if not np.isnan(field[:, i]).all()]
    return {
        "format": file.format, "readings": len(points),
        "components": [COMPONENTS[i] for i in measured],
        "length_units": list(file.imported.length_units),
        "field_units": list(file.imported.field_units),
        "ignored_columns": list(file.imported.ignored),
        "points_without_reading": file.imported.dropped,
        "from_m": points.min(axis=0).tolist(), "to_m": points.max(axis=0).tolist(),
        "min_B_T": [float(np.nanmin(field[:, i])) for i in measured],
        "max_B_T": [float(np.nanmax(field[:, i])) for i in measured]}


def text(value: object) -> str:
    """Return a value as text for the table."""
    if isinstance(value, list):
        return ", ".join(
            f"{element:.6g}" if isinstance(element, float) else str(element) for element in value)
    return str(value)


def names(text: str) -> tuple[str, ...]:
    """Parse a comma-separated list of names of columns."""
    return tuple(name.strip() for name in text.split(","))


def coordinates(text: str) -> dict[str, float]:
    """Parse coordinates such as ``x=0,y=0``."""
    values: dict[str, float] = {}
    for part in text.split(","):
        axis, _, value = part.partition("=")
        if axis.strip() not in COMPONENTS:
            raise argparse.ArgumentTypeError(f"must be like x=0,y=0, not {text}")
        values[axis.strip()] = coordinate(value)
    return values


def point(text: str) -> tuple[float, float, float]:
    """Parse a point ``X,Y,Z``."""
    values = [coordinate(part) for part in text.split(",")]
    if len(values) != 3:
        raise argparse.ArgumentTypeError(f"must be three numbers, not {text}")
    return values[0], values[1], values[2]


def coordinate(text: str) -> float:
    """Parse a finite number."""
    value = float(text)
    if not np.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be finite, not {text}")
    return value
