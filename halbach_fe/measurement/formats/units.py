"""Units of lengths, flux densities and angles, as files and options spell them.

A unit must be stated explicitly, in a known spelling. It is never guessed from the size of the
numbers. A factor may stand before it: ``1e-7 T``. A, Oe and their multiples are units of H: in air,
where maps are, B is mu_0 H.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from fractions import Fraction
from typing import TYPE_CHECKING

from halbach_fe.core.numbers import MU_0

if TYPE_CHECKING:  # the help of the command line lists the units, and does without numpy
    from halbach_fe.core.arrays import Floats

LENGTHS = {"m": Fraction(1), "cm": Fraction(1, 100), "mm": Fraction(1, 1000),
           "um": Fraction(1, 1_000_000), "inch": Fraction(254, 10_000)}
H_FIELDS = {"A/m": Fraction(MU_0), "kA/m": Fraction(1000 * MU_0), "Oe": Fraction(1, 10_000),
            "kOe": Fraction(1, 10)}
"""Units of H; a column of H is read as that of B in air."""
FIELDS = {"T": Fraction(1), "mT": Fraction(1, 1000), "uT": Fraction(1, 1_000_000),
          "nT": Fraction(1, 1_000_000_000), "G": Fraction(1, 10_000), "kG": Fraction(1, 10),
          "mG": Fraction(1, 10_000_000)} | H_FIELDS
ANGLES = ("deg", "rad")
VOLUMES = {"m^3": Fraction(1), "cm^3": Fraction(1, 10**6), "mm^3": Fraction(1, 10**9)}
MOMENTS = {"Am^2": Fraction(1), "mAm^2": Fraction(1, 1000), "emu": Fraction(1, 1000)}
"""Units of tables of blocks."""
TIMES = {"s": Fraction(1), "min": Fraction(60), "h": Fraction(3600), "ms": Fraction(1, 1000)}
KINDS: dict[str, Collection[str]] = {
    "length": LENGTHS, "field": FIELDS, "angle": ANGLES, "time": TIMES,
    "volume": VOLUMES, "moment": MOMENTS}
"""Units by the kind of quantity."""
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
    "kgauss": "kG", "kgs": "kG", "milligauss": "mG", "mgauss": "mG", "nanotesla": "nT",
    "teslas": "T",
    "microteslas": "uT", "utesla": "uT", "mtesla": "mT", "gs": "G", "oersted": "Oe", "oe": "Oe",
    "koe": "kOe", "a/m": "A/m", "ka/m": "kA/m", "am-1": "A/m", "wb/m2": "T", "vs/m2": "T",
    "n/am": "T", "n/(am)": "T", "m3": "m^3", "cm3": "cm^3", "cc": "cm^3", "ml": "cm^3",
    "mm3": "mm^3", "am2": "Am^2", "j/t": "Am^2", "mam2": "mAm^2", "emu": "emu",
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "rad": "rad", "radian": "rad",
    "radians": "rad", "м": "m", "см": "cm", "мм": "mm", "мкм": "um", "тл": "T", "мтл": "mT",
    "мктл": "uT", "гс": "G", "кгс": "kG", "米": "m", "厘米": "cm", "毫米": "mm", "特斯拉": "T",
    "毫特": "mT", "毫特斯拉": "mT", "高斯": "G"}
EXACT = {"T": "T", "mT": "mT", "uT": "uT", "µT": "uT", "μT": "uT", "nT": "nT", "G": "G",
         "kG": "kG", "mG": "mG"}

MARKS = re.compile(r"[\s.*·⋅^_{}]|\*\*")
"""What spellings of one unit differ in: V.s/m^2, V*s/m2, Vs/m²."""
SCALED = re.compile(r"(\d{1,20}(?:\.\d{0,20})?(?:[eE][-+]?\d{1,2})?)\s*[*x·]?\s*([^\d\s].*)")
"""A factor before a unit."""
POWER = re.compile(r"10(?:\^|\*\*)\{?([-+]?\d{1,2})\}?|10([⁻⁺]?[⁰¹²³⁴⁵⁶⁷⁸⁹]{1,2})")
"""A power of ten as a factor: 10^-4, 10⁻⁴."""
RAISED = str.maketrans("⁻⁺⁰¹²³⁴⁵⁶⁷⁸⁹", "-+0123456789")

SILENT = re.compile(r"(?i)-?|lengu|fluxu|\+?1(\.0*)?(e[-+]?0+)?")
"""Texts in the place of a unit that state none: Opera's LENGU and FLUXU, a dash, or a factor of
1."""


def unit_symbol(text: str) -> str:
    """Return the symbol of a unit from its spelling, or an empty string if it is unknown.

    The symbols are the keys of `LENGTHS` and `FIELDS`, deg and rad; a factor precedes its unit,
    as in ``1e-07 T``.
    """
    max_unit = 40  # largest number of characters of a unit
    text = text.strip()
    if len(text) > max_unit:
        return ""
    if power := POWER.match(text):
        text = f"1e{power[1] or power[2].translate(RAISED)}{text[power.end():]}"
    if scaled := SCALED.fullmatch(text):
        unit, factor = unit_symbol(scaled[2]), float(scaled[1])
        return f"{factor:.12g} {unit}" if unit and unit not in ANGLES and factor > 0 else ""
    return EXACT.get(text) or WORDS.get(text.lower()) or WORDS.get(
        MARKS.sub("", text.lower()).replace("²", "2").replace("³", "3").replace(
            "⁻¹", "-1"), "")


def kind_of(text: str) -> str:
    """Return the kind of a unit, one of `KINDS`, in any spelling; empty if it is none."""
    unit = (unit_symbol(text) or text).rpartition(" ")[2]
    return next((kind for kind, members in KINDS.items() if unit in members), "")


def states_no_unit(text: str) -> bool:
    """Return whether a text in the place of a unit states no unit; see `SILENT`."""
    return bool(SILENT.fullmatch(text.strip()))


def in_si(values: Floats, unit: str) -> Floats:
    """Convert values in a unit to m, T, rad or s.

    If the factor is a power of ten, the result is rounded only once.
    """
    if unit in ANGLES:
        return values * (math.pi / 180) if unit == "deg" else values
    own, _, unit = unit.rpartition(" ")
    factor = (LENGTHS | FIELDS | TIMES | VOLUMES | MOMENTS)[unit] * (Fraction(own) if own else 1)
    return values * float(factor.numerator) / float(factor.denominator)
