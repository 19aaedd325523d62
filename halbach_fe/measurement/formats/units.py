"""Units of lengths, flux densities and angles, as files and options spell them.

A unit must be stated explicitly, in a known spelling. It is never guessed from the size of the
numbers.
"""

from __future__ import annotations

import math
import re
from fractions import Fraction
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the help of the command line lists the units, and does without numpy
    from halbach_fe.core.arrays import Floats

LENGTHS = {"m": Fraction(1), "cm": Fraction(1, 100), "mm": Fraction(1, 1000),
           "um": Fraction(1, 1_000_000), "inch": Fraction(254, 10_000)}
FIELDS = {"T": Fraction(1), "mT": Fraction(1, 1000), "uT": Fraction(1, 1_000_000),
          "G": Fraction(1, 10_000), "kG": Fraction(1, 10)}
ANGLES = ("deg", "rad")
TIMES = {"s": Fraction(1), "min": Fraction(60), "h": Fraction(3600), "ms": Fraction(1, 1000)}
CLOCK = re.compile(r"(?i)hh:?mm:?ss")
"""The unit of times of day that are written as numbers: 142359 is 14:23:59."""

# Spellings in lower case; upper and lower case are equivalent. T and G are in EXACT instead, since
# mT is not MT, and t and g are tonne and gram.
WORDS = {
    "m": "m", "metre": "m", "metres": "m", "meter": "m", "meters": "m",
    "cm": "cm", "centimetre": "cm", "centimetres": "cm", "centimeter": "cm", "centimeters": "cm",
    "mm": "mm", "millimetre": "mm", "millimetres": "mm", "millimeter": "mm", "millimeters": "mm",
    "um": "um", "µm": "um", "μm": "um", "micron": "um", "microns": "um",
    "in": "inch", "inch": "inch", "inches": "inch",
    "tesla": "T", "millitesla": "mT", "microtesla": "uT", "gauss": "G", "kilogauss": "kG",
    "kgauss": "kG",
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "rad": "rad", "radian": "rad",
    "radians": "rad"}
EXACT = {"T": "T", "mT": "mT", "uT": "uT", "µT": "uT", "μT": "uT", "G": "G", "kG": "kG"}

SILENT = re.compile(r"(?i)-?|lengu|fluxu|[-+]?[\d.]+(e[-+]?\d+)?")
"""Texts in the place of a unit that state none: Opera's LENGU and FLUXU, a dash, or a factor."""


def unit_symbol(text: str) -> str:
    """Return the symbol of a unit from its spelling, or an empty string if it is unknown.

    The symbols are m, cm, mm, um, inch, T, mT, uT, G, kG, deg and rad.
    """
    text = text.strip()
    return EXACT.get(text) or WORDS.get(text.lower(), "")


def states_no_unit(text: str) -> bool:
    """Return whether a text in the place of a unit states no unit; see `SILENT`."""
    return bool(SILENT.fullmatch(text.strip()))


def in_si(values: Floats, unit: str) -> Floats:
    """Convert values in a unit to m, T, rad or s.

    If the factor is a power of ten, the result is rounded only once.
    """
    if unit in ANGLES:
        return values * (math.pi / 180) if unit == "deg" else values
    factor = (LENGTHS | FIELDS | TIMES)[unit]
    return values * float(factor.numerator) / float(factor.denominator)
