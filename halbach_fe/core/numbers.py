"""Parsing of numbers in text files."""

from __future__ import annotations

import math
import re

MAX_CELL = 60
"""Most characters of a cell that is parsed: no number is longer, and matching the pattern is slow
on long text."""

NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d{1,4})?", re.ASCII)
"""Decimal numbers as programs print them, including Fortran's exponent letter D."""


def parse_number(cell: str) -> float:
    """Return the finite number in a cell of a table.

    Raises
    ------
    ValueError
        If the cell holds no number, or an infinite one. ``1_000`` and digits of other scripts are
        refused as well, although Python's `float` accepts them.
    """
    if len(cell) > MAX_CELL or not NUMBER.fullmatch(cell):
        raise ValueError(cell)
    value = float(cell.replace("D", "e").replace("d", "e"))
    if not math.isfinite(value):
        raise ValueError(cell)
    return value
