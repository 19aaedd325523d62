"""Convert a measured map of another make: to metres, tesla and the project's own columns.

Tables of columns (commas, semicolons, tabs or spaces, with a header or without), Opera's .table,
text that COMSOL exports, and openPMD-beamphysics field meshes. What the file does not say (units,
columns, coordinates that are the same everywhere) has to be given; nothing is guessed.
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
                        help="of FILE (default: as it begins)")
    parser.add_argument("--length-unit", choices=LENGTHS, default="", help="of positions")
    parser.add_argument("--field-unit", choices=FIELDS, default="", help="of B")
    parser.add_argument("--angle-unit", choices=ANGLES, default="", help="of phi")
    parser.add_argument("--columns", type=names, default=(), metavar="NAME,NAME...",
                        help="what each column is: x, y, z, r, phi, Bx, By, Bz, Br, Bphi, B, or - "
                        "to leave it out; a unit may follow, Bx[mT]")
    parser.add_argument("--component", choices=COMPONENTS, default="",
                        help="which one a column B is")
    parser.add_argument("--at", type=coordinates, default={}, metavar="AXIS=M,...",
                        help="coordinates in m that the file leaves out, x=0,y=0")
    parser.add_argument("--origin-m", type=point, metavar="X,Y,Z",
                        help="where the file's origin is, along the magnet's axes; write it "
                        "--origin-m=-0.5,0,0")
    parser.add_argument("--decimal-comma", action="store_true", help="0,5 is one half")
    parser.add_argument("--encoding", default=DeclaredFormat.encoding,
                        help="of text (default: UTF-8)")
    common.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read, convert, write, print what was understood."""
    said = DeclaredFormat(
        length_unit=arguments.length_unit, field_unit=arguments.field_unit,
        angle_unit=arguments.angle_unit, columns=arguments.columns,
        component=arguments.component, at=arguments.at, origin_m=arguments.origin_m,
        decimal_comma=arguments.decimal_comma, encoding=arguments.encoding)
    found = import_map(arguments.file, said, arguments.format)
    write_map(found.data, arguments.output)
    shown = summary(found)
    if arguments.json:
        common.print_json(shown | {"map": str(arguments.output)})
    else:
        common.print_table([{"of the map": key, "": text(value)} for key, value in shown.items()],
                           f"Read as {found.format}")
        common.say(f"Map: {arguments.output}")
    return 0


def summary(found: ImportedFile) -> dict[str, object]:
    """What was read, for people to check and for machines."""
    points, field = points_of(found.data), found.data["B_T"].values
    measured = [i for i in range(3) if not np.isnan(field[:, i]).all()]
    return {
        "format": found.format, "readings": len(points),
        "components": [COMPONENTS[i] for i in measured],
        "length_units": list(found.imported.length_units),
        "field_units": list(found.imported.field_units),
        "ignored_columns": list(found.imported.ignored),
        "points_without_reading": found.imported.dropped,
        "from_m": points.min(axis=0).tolist(), "to_m": points.max(axis=0).tolist(),
        "min_B_T": [float(np.nanmin(field[:, i])) for i in measured],
        "max_B_T": [float(np.nanmax(field[:, i])) for i in measured]}


def text(value: object) -> str:
    """A value for the table."""
    if isinstance(value, list):
        return ", ".join(f"{one:.6g}" if isinstance(one, float) else str(one) for one in value)
    return str(value)


def names(text: str) -> tuple[str, ...]:
    """Split names of columns."""
    return tuple(name.strip() for name in text.split(","))


def coordinates(text: str) -> dict[str, float]:
    """Parse x=0,y=0."""
    found: dict[str, float] = {}
    for part in text.split(","):
        axis, _, value = part.partition("=")
        if axis.strip() not in COMPONENTS:
            raise argparse.ArgumentTypeError(f"must be like x=0,y=0, not {text}")
        found[axis.strip()] = coordinate(value)
    return found


def point(text: str) -> tuple[float, float, float]:
    """Parse X,Y,Z."""
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
