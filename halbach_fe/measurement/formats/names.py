"""Quantity and unit of a column from its name: ``X [mm]``, ``x(mm)``, ``Bx/mT``, ``mf.Bx (T)``."""

from __future__ import annotations

import re
from dataclasses import dataclass

from halbach_fe.measurement.formats.units import states_no_unit, unit_symbol

POSITIONS = ("x", "y", "z", "r", "phi")
FIELDS = ("Bx", "By", "Bz", "Br", "Bphi")
TOTAL = "Babs"
"""The magnitude |B|, as a quantity of its own."""
KNOWN = (*POSITIONS, *FIELDS, "B", TOTAL)
"""Quantities of columns; B is a single component, or the magnitude beside its components."""
MOVES = ("dx", "dy", "dz")
STATED = (*MOVES, "t")
"""Quantities that only the user can state: moves of a stage from reading to reading, and the time.
"""

ALIASES = {name.lower(): name for name in KNOWN} | {
    "xpos": "x", "ypos": "y", "zpos": "z", "posx": "x", "posy": "y", "posz": "z",
    "rho": "r", "radius": "r", "theta": "phi", "azimuth": "phi", "angle": "phi",
    "|b|": TOTAL, "bmod": TOTAL, "modb": TOTAL, "bnorm": TOTAL, "normb": TOTAL, "bmag": TOTAL,
    "btot": TOTAL, "btotal": TOTAL, "b0abs": TOTAL,
    "brho": "Br", "btheta": "Bphi", "field": "B", "fluxdensity": "B"}

MAX_NAME = 60
BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*)[\])]\s*")
PREFIX = re.compile(r"[a-z]\w*\.")  # of mf.Bx; -mf.Bx keeps its sign and is not recognized as Bx


@dataclass(frozen=True)
class ColumnName:
    """The name of a column.

    Attributes
    ----------
    text : str
        Name as the file spells it.
    quantity : str
        One of `KNOWN` and `STATED`; empty if the name is not recognized.
    unit : str
        Text of the unit as the file spells it; may be empty.
    """

    text: str
    quantity: str = ""
    unit: str = ""


def parse(text: str, stated: bool = False) -> ColumnName:
    """Return quantity and unit of the name of a column, which the user may have ``stated``."""
    text = text.strip().strip('"').strip()
    if len(text) > MAX_NAME:
        return ColumnName(f"{text[:MAX_NAME]}...")
    base, unit = _split(text)
    key = re.sub(r"[\s_]", "", PREFIX.sub("", base.lower(), count=1))
    more = key if stated and key in STATED else ""
    return ColumnName(text, ALIASES.get(key, more), unit.strip())


def _split(text: str) -> tuple[str, str]:
    """Split a name into the quantity and the unit, which is empty if the name has none."""
    if found := BRACKETS.fullmatch(text):
        return found[1], found[2]
    for mark in ("/", "_", ","):
        base, _, unit = text.rpartition(mark)
        if base and unit_symbol(unit):
            return base, unit
    return text, ""


def is_units(cells: list[str]) -> bool:
    """Return whether all cells of a line are units, as in the line below some headers."""
    units = [cell.strip().strip("[]()") for cell in cells]
    return any(unit_symbol(unit) for unit in units) and all(
        unit_symbol(unit) or states_no_unit(unit) for unit in units)
