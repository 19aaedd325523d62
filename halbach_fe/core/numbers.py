"""Numbers as text files have them."""

from __future__ import annotations

import math
import re

MAX_CELL = 60
"""Characters; no number has more, and patterns are slow on longer ones."""

NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d{1,4})?", re.ASCII)
"""As programs print them, Fortran's D included."""


def parse_number(cell: str) -> float:
    """The number in a cell.

    Raises
    ------
    ValueError
        If it is none, or not finite; also for ``1_000`` and digits of other scripts, which Python
        would take.
    """
    if len(cell) > MAX_CELL or not NUMBER.fullmatch(cell):
        raise ValueError(cell)
    value = float(cell.replace("D", "e").replace("d", "e"))
    if not math.isfinite(value):
        raise ValueError(cell)
    return value
