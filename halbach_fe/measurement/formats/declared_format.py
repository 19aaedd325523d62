"""Statements of the user about a file of another program that does not contain them itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from numbers import Real
from pathlib import Path
from typing import Any, ClassVar, Self

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.files import as_path
from halbach_fe.core.interface import check_options
from halbach_fe.measurement.formats.units import ANGLES, KINDS, kind_of, unit_symbol

FORMATS = ("columns", "opera", "comsol", "openpmd", "g4beamline", "bdsim", "srw", "fluka",
           "paraview")
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
    """

    unused: ClassVar[tuple[str, ...]] = ()
    """Statements that say nothing about such a file."""
    length_unit: str = ""
    field_unit: str = ""
    angle_unit: str = ""
    """Unit of all columns of this kind."""
    columns: tuple[str, ...] = ()
    """Name of each column; ``-`` for a column to ignore."""
    component: str = ""
    """Component x, y or z of a column that is named just B; ``abs`` if it is |B|, ``unknown`` if
    nobody knows it."""
    at: dict[str, float] = field(default_factory=dict)
    """Constant coordinates, for which the file has no column. In m."""
    origin_m: tuple[float, float, float] | None = None
    """Position of the file's origin, in m along the magnet's axes."""
    decimal_comma: bool = False
    """Whether numbers have a decimal comma (0,5 is one half)."""
    encoding: str = "utf-8-sig"
    """Encoding of a text file."""
    skip_lines: int = 0
    """Number of lines at the beginning that are not read."""
    delimiter: str = ""
    """One of `DELIMITERS`."""
    positions: Path | None = None
    """A table of x, y and z with a row for each reading of a file that has none."""

    def unit_of(self, kind: str) -> str:
        """Return the unit of all columns of a kind, of `units.KINDS`; empty if none is stated."""
        return str(getattr(self, f"{kind}_unit", ""))

    @classmethod
    def of(cls, given: Mapping[str, object], where: str) -> Self:
        """Return the statements of a user of the Python interface.

        Raises
        ------
        StudyError
            If one has another name, kind or value.
        """
        path = given.get("positions")
        given = {**given} | ({"positions": as_path(path)} if isinstance(path, str) else {})
        check_options(given, cls, where, *cls.unused)
        stated: dict[str, Any] = {
            name: tuple(value) if isinstance(value, Iterable) and not isinstance(
                value, str | Mapping) else value for name, value in given.items()}
        found = cls(**stated)
        for name, wanted in found._wrong().items():
            raise StudyError(must_be(name, where, wanted, repr(given[name])))
        return replace(found, length_unit=unit_symbol(found.length_unit),
                       field_unit=unit_symbol(found.field_unit))

    def _wrong(self) -> dict[str, str]:
        """Return what each statement must be that has a value of no meaning."""
        wrong = {f"{kind}_unit": f"one of {', '.join(KINDS[kind])}, or a factor and one of them"
                 for kind, unit in (("length", self.length_unit), ("field", self.field_unit))
                 if unit and kind_of(unit) != kind}
        for name, value, known in (
                ("angle_unit", self.angle_unit, ANGLES), ("delimiter", self.delimiter, DELIMITERS),
                ("component", self.component, (*"xyz", "abs", UNKNOWN))):
            if value and value not in known:
                wrong[name] = f"one of {', '.join(known)}"
        if not {*self.at} <= {*"xyzr"} or not _finite([*self.at.values()], len(self.at)):
            wrong["at"] = "finite numbers in m by x, y, z or r"
        if self.origin_m is not None and not _finite(self.origin_m, 3):
            wrong["origin_m"] = "three finite numbers in m"
        if self.skip_lines < 0 or self.skip_lines != int(self.skip_lines):
            wrong["skip_lines"] = "a whole number of at least 0"
        return wrong


def _finite(values: Sequence[object], count: int) -> bool:
    """Tell whether values are so many finite numbers."""
    return len(values) == count and all(
        isinstance(one, Real) and isfinite(one) for one in values)
