"""Numbers and tables in text files, and numbers that a user gives to a function."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

from halbach_fe.core.errors import StudyError, must_be

if TYPE_CHECKING:
    from numpy.typing import NDArray

MU_0 = 4e-7 * math.pi
"""Vacuum permeability in T m/A. The value before 2019; it differs from the measured value by
1.3e-10 (relative)."""

MAD_TO_SD = 1.4826
"""Standard deviation of normal numbers over the median of their magnitudes."""

LIMIT_UNITS = 1e-6, 1e6
"""Smallest and largest limit of unwanted multipoles in units of 1e-4 of the main one: from 1e-10 of
it, below all errors, to a hundred times it."""

LIMIT_PPM = 1e-4, 1e6
"""Smallest and largest limit of the rms deviation of a field, in ppm of its mean: from below the
noise of all instruments to as much as the field itself."""

HIGHEST_ORDER = 100
"""Highest order of a multipole. Higher orders are negligible in the bore."""

HIGHEST_DEGREE = 20
"""Highest degree of a spherical harmonic: those in the bore fall with a power of the radius, and
points on the sphere grow with the square of the degree."""

EMPTY_CELL = "–"
"""Text of a table's cell without an entry."""

DENSITY = 1000, 20000
"""Smallest and largest density of a magnet in kg/m^3; 7.5 is one in g/cm^3."""

DRAWS = 20, 1_000_000
"""Smallest and largest number of magnets that are drawn. Fewer have no quantiles of 5 and 95 %; the
most determine a share of 1 % to 1 % of itself, and need 1 GB for 100 multipoles."""

ACROSS = 2, 100
"""Fewest and most cells across a block. A single one has its middle in that of the block, where the
margin is largest; their number in a block grows with the third power."""

MAX_CELL = 60
"""Most characters of a cell that is parsed: no number is longer, and matching the pattern is slow
on long text."""

NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d{1,4})?", re.ASCII)
"""Decimal numbers as programs print them, including Fortran's exponent letter D."""
WITHOUT_LETTER = re.compile(r"([-+]?\d*\.\d+)([-+]\d{3})", re.ASCII)
"""A number of Fortran whose exponent of three digits leaves no place for the letter."""


def decimals(value: float, digits: int = 3) -> str:
    """Return a number for people: so many significant digits, no exponent, thousands apart.

    It is "0" below 1e-6.
    """
    tiny = 1e-6  # size below which a number that is shown to people is zero
    if abs(value) < tiny:
        return "0"
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text
    return f"{float(text):,.0f}".replace(",", "\u202f") if abs(value) > 1 else f"{value:.7f}"


def in_a_row(names: Sequence[str]) -> str:
    """Return names in words: one, two and three."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def first_of(texts: Sequence[str], most: int, by: str = ", ") -> str:
    """Return the first of some texts, and how many more there are.

    Examples
    --------
    >>> first_of(["one", "two", "three"], 2), first_of(["one", "two"], 2)
    ('one, two and 1 more', 'one, two')
    """
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return f"{by.join(texts[:most])}{more}"


def parse_number(cell: str) -> float:
    """Return the finite number in a cell of a table.

    Raises
    ------
    ValueError
        If the cell holds no number, or an infinite one. ``1_000`` and digits of other scripts are
        refused as well, although Python's `float` accepts them.
    """
    if len(cell) <= MAX_CELL and (without := WITHOUT_LETTER.fullmatch(cell)):
        cell = f"{without[1]}e{without[2]}"
    if len(cell) > MAX_CELL or not NUMBER.fullmatch(cell):
        raise ValueError(cell)
    value = float(cell.replace("D", "e").replace("d", "e"))
    if not math.isfinite(value):
        raise ValueError(cell)
    return value


def check_number(
    name: str, function: str, value: object, low: float = -math.inf, high: float = math.inf,
    whole: bool = False,
) -> None:
    """Check a number that a user gives to a function of the Python interface.

    Raises
    ------
    StudyError
        If it is no finite number from ``low`` to ``high``, or a ``whole`` one is not.
    """
    if getattr(value, "shape", None) == () and hasattr(value, "dtype"):  # an array of one number
        value = value.item()  # type: ignore[attr-defined]
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if whole and not isinstance(value, Integral):
        number = math.nan
    if not (math.isfinite(number) and low <= number <= high):
        limits = (f" from {low:g} to {high:g}" if math.isfinite(low) and math.isfinite(high) else
                  f" of at least {low:g}" if math.isfinite(low) else "")
        raise StudyError(must_be(name, function, f"a {'whole' if whole else 'finite'} number"
                                 + limits, repr(value) if isinstance(value, str) else value))


WITH_COMMAS = "Separate columns by commas, and write decimals with points."
"""What to do about a table with other separators."""


def csv_text(columns: Mapping[str, NDArray[Any] | Sequence[object]]) -> str:
    """Return columns of equal length, by name, as CSV; numbers read back to the last bit.

    Examples
    --------
    >>> import numpy as np
    >>> print(csv_text({"label": ["Bx", "By"], "value_T": np.array([0.1, 1e-9])}), end="")
    label,value_T
    Bx,0.1
    By,1e-09
    """
    import numpy as np  # which --help does not need

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(np.asarray(column).tolist() for column in columns.values()),
                         strict=True))
    return text.getvalue()


def numbered_lines(text: str) -> list[tuple[int, str]]:
    """Return lines with their numbers; those that are empty or begin with # are left out."""
    return [(number, line) for number, line in enumerate(text.splitlines(), start=1)
            if line.strip() and not line.lstrip().startswith("#")]


def other_separator(header: str) -> str | None:
    """Return what separates the names in a header that has no commas; None if nothing does."""
    for character, name in ((";", "semicolons"), ("\t", "tabs")):
        if "," not in header and character in header.strip():
            return name
    return None
