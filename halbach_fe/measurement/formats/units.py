"""Units as files and options spell them.

A unit counts only if it is spelt out; what cannot be told from its spelling is refused, and never
guessed from the size of the numbers.
"""

from __future__ import annotations

import re
from fractions import Fraction

import numpy as np

from halbach_fe.core.arrays import Floats

LENGTHS = {"m": Fraction(1), "cm": Fraction(1, 100), "mm": Fraction(1, 1000),
           "um": Fraction(1, 1_000_000), "inch": Fraction(254, 10_000)}
FIELDS = {"T": Fraction(1), "mT": Fraction(1, 1000), "uT": Fraction(1, 1_000_000),
          "G": Fraction(1, 10_000), "kG": Fraction(1, 10)}
ANGLES = ("deg", "rad")

# Lower-case spellings. T and G are not here: mT is not MT, and t and g are tonne and gram.
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
"""What stands in the place of a unit and is none: Opera's LENGU and FLUXU, a factor."""


def symbol(text: str) -> str:
    """The symbol of a spelling: m, cm, mm, um, inch, T, mT, uT, G, kG, deg or rad; or nothing."""
    text = text.strip()
    return EXACT.get(text) or WORDS.get(text.lower(), "")


def is_silent(text: str) -> bool:
    """Whether it says nothing of a unit."""
    return bool(SILENT.fullmatch(text.strip()))


def in_si(values: Floats, unit: str) -> Floats:
    """Values in m, T or rad; one rounding where the factor is a power of ten."""
    if unit in ANGLES:
        return np.deg2rad(values) if unit == "deg" else values
    factor = LENGTHS[unit] if unit in LENGTHS else FIELDS[unit]
    return np.asarray(values * float(factor.numerator) / float(factor.denominator))
