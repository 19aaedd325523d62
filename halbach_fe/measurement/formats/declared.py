"""Statements of the user about a file of another program that does not contain them itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

FORMATS = ("columns", "opera", "comsol", "openpmd", "g4beamline", "bdsim", "srw", "fluka")
"""Names of the formats of other programs that can be read."""

DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "spaces": None}
"""What may separate cells; ``spaces`` are any number of spaces and tabs."""

UNKNOWN = "unknown"
"""The component of a column B of which nobody knows which it is."""


@dataclass(frozen=True)
class DeclaredFormat:
    """Statements of the user about the format of a file.

    An empty value states nothing. ``columns`` take the place of the file's header; any other
    statement must agree with the file if the file contains the same information.

    Attributes
    ----------
    length_unit, field_unit, angle_unit : str
        Unit of all columns of this kind.
    columns : tuple of str
        Name of each column; ``-`` for a column to ignore.
    component : str
        Component x, y or z of a column that is named just B; ``abs`` if it is |B|, ``unknown`` if
        nobody knows it.
    at : mapping of str to float, in m
        Constant coordinates, for which the file has no column.
    origin_m : tuple of float or None
        Position of the file's origin, in m along the magnet's axes.
    decimal_comma : bool
        Whether numbers have a decimal comma (0,5 is one half).
    encoding : str
        Encoding of a text file.
    skip_lines : int
        Number of lines at the beginning that are not read.
    delimiter : str
        One of `DELIMITERS`.
    positions : Path or None
        A table of x, y and z with a row for each reading of a file that has none.
    """

    length_unit: str = ""
    field_unit: str = ""
    angle_unit: str = ""
    columns: tuple[str, ...] = ()
    component: str = ""
    at: dict[str, float] = field(default_factory=dict)
    origin_m: tuple[float, float, float] | None = None
    decimal_comma: bool = False
    encoding: str = "utf-8-sig"
    skip_lines: int = 0
    delimiter: str = ""
    positions: Path | None = None
