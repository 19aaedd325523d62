"""Options that say what the columns of a map are that is not in halbach-fe's own."""

from __future__ import annotations

import argparse
import math
from functools import partial
from pathlib import Path

from halbach_fe.measurement.formats.declared import DELIMITERS, FORMATS, UNKNOWN, DeclaredFormat
from halbach_fe.measurement.formats.units import (
    ANGLES,
    FIELDS,
    KINDS,
    LENGTHS,
    kind_of,
    unit_symbol,
)

AXES = ("x", "y", "z")


def add_format_arguments(parser: argparse._ActionsContainer) -> None:
    """Add the options that describe a file, to a parser or a group of its options."""
    parser.add_argument("--format", choices=FORMATS, default="",
                        help="format of FILE (default: recognized from its beginning)")
    parser.add_argument("--columns", type=names, default=(), metavar="NAME,NAME...",
                        help="content of each column: x, y, z, r, phi, Bx, By, Bz, Br, Bphi, B, "
                         "Babs (|B|), dx, dy, dz (moves of a stage from reading to reading), t "
                         "(time), scan, sigma or sigma_Bx ... (noise), or - for a column that is "
                         "ignored; a unit may follow, as in Bx[mT], t[s], t[hhmmss], Bx[1e-7 T]. "
                         "They take the place of the file's header")
    parser.add_argument("--positions", type=Path, metavar="TABLE",
                        help="table of x, y and z with a row for each reading of a FILE without "
                        "positions")
    parser.add_argument("--component", choices=(*AXES, "abs", UNKNOWN), default="",
                        help="component of the field in a column B; abs if it is |B|, as of an NMR "
                        "teslameter; unknown, if nobody knows it, for halbach-fe register to find")
    parser.add_argument("--at", type=coordinates, default={}, metavar="AXIS=M,...",
                        help="constant coordinates in m that the file does not contain, for "
                        "example x=0,y=0")
    parser.add_argument("--origin-m", type=point, metavar="X,Y,Z",
                        help="position in m of the file's origin, along the magnet's axes")
    add_table_arguments(parser)


def add_table_arguments(parser: argparse._ActionsContainer) -> None:
    """Add the options that describe any table, of a map or of blocks."""
    for kind, members, what in (("length", LENGTHS, "the positions"), ("field", FIELDS, "B")):
        parser.add_argument(f"--{kind}-unit", type=partial(unit_of, kind), default="",
                            metavar="UNIT", help=f"unit of {what}: {', '.join(members)}; a factor "
                            f"may precede it, as in '10 {next(iter(members))}'")
    parser.add_argument("--angle-unit", choices=ANGLES, default="", help="unit of phi")
    parser.add_argument("--skip-lines", type=_count, default=0, metavar="N",
                        help="number of lines at the beginning of FILE that are not read")
    parser.add_argument("--delimiter", choices=DELIMITERS, default="",
                        help="what separates columns; spaces are any number of spaces and tabs "
                        "(default: recognized)")
    parser.add_argument("--decimal-comma", action="store_true",
                        help="numbers have a decimal comma, as in 0,5")
    parser.add_argument("--encoding", default=DeclaredFormat.encoding,
                        help="encoding of a text file (default: UTF-8)")


def add_map_format_arguments(parser: argparse.ArgumentParser, options: str) -> None:
    """Add the same options to a verb that reads maps, those of ``options``."""
    add_format_arguments(parser.add_argument_group(
        "maps in other columns", f"of {options}, as halbach-fe import-map reads them, in the axes "
        "of the magnet"))


def format_words(arguments: argparse.Namespace) -> list[str]:
    """Return the options that describe the format as words of a command line."""
    found = [f"--{name.replace('_', '-')}={value}" for name in (
        "format", "length_unit", "field_unit", "angle_unit", "component", "skip_lines",
        "delimiter", "positions") if (
            value := getattr(arguments, name, ""))]
    if columns := getattr(arguments, "columns", ()):
        found.append(f"--columns={','.join(columns)}")
    if at := getattr(arguments, "at", {}):
        found.append("--at=" + ",".join(f"{axis}={value!r}" for axis, value in at.items()))
    if (origin := getattr(arguments, "origin_m", None)) is not None:
        found.append("--origin-m=" + ",".join(map(repr, origin)))
    if getattr(arguments, "decimal_comma", False):
        found.append("--decimal-comma")
    if (encoding := getattr(arguments, "encoding", "")) not in ("", DeclaredFormat.encoding):
        found.append(f"--encoding={encoding}")
    return found


def declared_format(arguments: argparse.Namespace) -> DeclaredFormat:
    """Return what the options say."""
    return DeclaredFormat(
        length_unit=arguments.length_unit, field_unit=arguments.field_unit,
        angle_unit=arguments.angle_unit, columns=arguments.columns,
        component=arguments.component, at=arguments.at, origin_m=arguments.origin_m,
        decimal_comma=arguments.decimal_comma, encoding=arguments.encoding,
        skip_lines=arguments.skip_lines, delimiter=arguments.delimiter,
        positions=arguments.positions)


def unit_of(kind: str, text: str) -> str:
    """Parse a unit of a kind of quantity."""
    unit = unit_symbol(text)
    if text and kind_of(unit) != kind:  # argparse parses its default too
        raise argparse.ArgumentTypeError(f"must be one of {', '.join(KINDS[kind])}, or a factor "
                                         f"and one of them, as in '1e-7 T', not {text!r}")
    return unit


def _count(text: str) -> int:
    """Parse a number of lines."""
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"must be a number of lines, not {text!r}")
    return int(text)


def names(text: str) -> tuple[str, ...]:
    """Parse a comma-separated list of names of columns."""
    return tuple(name.strip() for name in text.split(","))


def coordinates(text: str) -> dict[str, float]:
    """Parse coordinates such as ``x=0,y=0``."""
    values: dict[str, float] = {}
    for part in text.split(","):
        axis, _, value = part.partition("=")
        if axis.strip() not in AXES:
            raise argparse.ArgumentTypeError(f"must be like x=0,y=0, not {text}")
        if axis.strip() in values:
            raise argparse.ArgumentTypeError(f"must give {axis.strip()} once, not {text}")
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
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a finite number, not {text!r}")
    return value
