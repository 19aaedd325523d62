"""What a column is, by its name: ``X [mm]``, ``x(mm)``, ``Bx/mT``, ``Bx_T``, ``mf.Bx (T)``."""

from __future__ import annotations

import re
from dataclasses import dataclass

from halbach_fe.measurement.formats.units import is_silent, symbol

POSITIONS = ("x", "y", "z", "r", "phi")
FIELDS = ("Bx", "By", "Bz", "Br", "Bphi")
KNOWN = (*POSITIONS, *FIELDS, "B")

ALIASES = {name.lower(): name for name in KNOWN} | {
    "xpos": "x", "ypos": "y", "zpos": "z", "posx": "x", "posy": "y", "posz": "z",
    "rho": "r", "radius": "r", "theta": "phi", "azimuth": "phi", "angle": "phi",
    "brho": "Br", "btheta": "Bphi", "field": "B", "fluxdensity": "B"}

MAX_NAME = 60
BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*)[\])]\s*")
PREFIX = re.compile(r"[a-z]\w*\.")  # mf.Bx; of -mf.Bx the sign stays, and it is no Bx


@dataclass(frozen=True)
class Name:
    """A column: as the file names it, the quantity (of `KNOWN`, or nothing) and the unit's text."""

    text: str
    quantity: str = ""
    unit: str = ""


def parse(text: str) -> Name:
    """Tell quantity and unit of a name."""
    text = text.strip().strip('"').strip()
    if len(text) > MAX_NAME:
        return Name(f"{text[:MAX_NAME]}...")
    base, unit = _split(text)
    key = re.sub(r"[\s_]", "", PREFIX.sub("", base.lower(), count=1))
    return Name(text, ALIASES.get(key, ""), unit.strip())


def _split(text: str) -> tuple[str, str]:
    if found := BRACKETS.fullmatch(text):
        return found[1], found[2]
    for mark in ("/", "_", ","):
        base, _, unit = text.rpartition(mark)
        if base and symbol(unit):
            return base, unit
    return text, ""


def is_units(cells: list[str]) -> bool:
    """Whether a line has units and nothing else, as some have below their header."""
    units = [cell.strip().strip("[]()") for cell in cells]
    return any(symbol(unit) for unit in units) and all(
        symbol(unit) or is_silent(unit) for unit in units)
