"""Quantity and unit of a column from its name: ``X [mm]``, ``x(mm)``, ``Bx/mT``, ``mf.Bx (T)``."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from halbach_fe.measurement.formats.units import (
    CLOCK,
    H_FIELDS,
    TIMES,
    kind_of,
    states_no_unit,
    unit_symbol,
)

POSITIONS = ("x", "y", "z", "r", "phi")
FIELDS = ("Bx", "By", "Bz", "Br", "Bphi")
CARTESIAN = (*POSITIONS[:3], *FIELDS[:3])
TOTAL = "Babs"
"""The magnitude |B|, as a quantity of its own."""
KNOWN = (*POSITIONS, *FIELDS, "B", TOTAL)
"""Quantities of columns; B is a single component, or the magnitude beside its components."""
POLAR = {"theta": "theta", "btheta": "Btheta"}
"""Quantities of these names in spherical coordinates r, theta, phi."""
MOVES = ("dx", "dy", "dz")
NOISE = ("sigma", *(f"sigma_{name}" for name in (*FIELDS, TOTAL)))
"""Standard deviations: of all components of a reading, or of one."""
OTHERS = ("t", "scan", *NOISE)
"""What a reading has beside its position and field: time, name of the scan, noise."""
STATED = (*MOVES, *OTHERS)
"""Quantities that only the user can state, the moves of a stage from reading to reading, and those
that are recognized, but for which the user may state another."""

ALIASES = {name.lower(): name for name in KNOWN} | {
    "xpos": "x", "ypos": "y", "zpos": "z", "posx": "x", "posy": "y", "posz": "z",
    "rho": "r", "radius": "r", "theta": "phi", "azimuth": "phi", "angle": "phi",
    "|b|": TOTAL, "bmod": TOTAL, "modb": TOTAL, "bnorm": TOTAL, "normb": TOTAL, "bmag": TOTAL,
    "btot": TOTAL, "btotal": TOTAL, "b0abs": TOTAL, "magb": TOTAL,
    "brho": "Br", "btheta": "Bphi", "field": "B", "fluxdensity": "B", "magneticfield": "B",
    "magneticfieldreading": "B", "fieldreading": "B", "b0": "B", "nmrfield": TOTAL} | {
    spelling.format(axis): name for axis, name in zip("xyz", FIELDS[:3], strict=True)
    for spelling in ("b0{}", "b{}re", "reb{}", "b{}real", "b{}mean", "meanb{}", "b{}avg", *(
        around.format(word) for word in (
            "field", "bfield", "mag", "magneticfield", "fluxdensity", "magneticfluxdensity",
            "component", "feld", "magnetfeld", "flussdichte", "champ", "induction", "磁场",
            "磁場", "磁感应强度", "磁束密度")
        for around in ("{}{{}}", "{{}}{}", "{}b{{}}", "b{{}}{}")))} | {
    around.format(word).format(axis): axis for axis in "xyz" for word in (
        "position", "coord", "coordinate", "stage", "probe", "point", "points", "location", "lage",
        "koordinate", "coordonnée", "坐标", "座標", "位置") for around in ("{}{{}}", "{{}}{}")} | {
    f"{of}:{number}": name for of, each in (("points", "xyz"), ("b", FIELDS[:3]))
    for number, name in enumerate(each)}
"""Quantities by the names of columns, without blanks and in lower case, in several languages."""
MAGNITUDES = frozenset(("magnitude", "mag", "total", "vectorsum"))
"""Names of |B| beside columns x, y and z of a field."""

TIME_NAMES = frozenset(("t", "time", "times", "timestamp", "timeofday", "clock", "datetime",
                        "elapsed", "elapsedtime"))
"""Names of columns of times, without spaces and in lower case."""
TEMPERATURES = frozenset(("c", "degc", "celsius", "k", "kelvin", "f", "degf"))
"""Units of a column T that is a temperature."""
NOISE_WORDS = frozenset((
    "sigma", "σ", "sd", "std", "stdev", "stddev", "err", "error", "unc", "uncertainty", "noise"))
"""Words in the name of a column that say that it is a standard deviation."""
TWO_WORDS = re.compile(r"(?:std|standard)[\s_.]+dev(?:iation)?\b\.?")
NO_AXIS = NOISE_WORDS | {"offset", "shift", "step", "size", "delta", "difference", "residual",
                         "gradient", "grad", "background", "rms"}
"""Words of a name that is no position or component, though an axis is among them."""
GLUED = re.compile(r"(?:sigma|σ|std|stdev|err|error|unc|noise|delta|d|u)(b|b[xyzr]|bphi)"
                   r"|(b|b[xyzr]|bphi)(?:sigma|std|stdev|err|error|unc|noise)")
"""Names that join such a word and a component without a space: dBx, sigmaBx, Bxerr."""
IMAGINARY = re.compile(r"(?:im|imag)\(?[bh][xyz]\)?|[bh][xyz](?:im|imag)")
"""Names of imaginary parts: BxIm of CST, imag(Bx)."""
OF_FIELD = re.compile(r"\((B\w{0,4})\)")
"""The component in brackets in sigma(Bx)."""

AXIS = re.compile(r"(?i)(?<![^\W\d_])b?([xyz])(?![^\W\d_])")
"""An axis among the words of a name, as in Campo X, B smoothed x or Ch-Y."""
TEX = str.maketrans({"\u1d67": "y"} | dict.fromkeys("$\\{}"))
"""Marks of TeX in names, and the letter that stands for a lowered y, which Unicode lacks."""
MAX_NAME = 60
BRACKETS = re.compile(r"(.*?)\s*[\[(<]([^\[\]()<>]*)[\])>]\s*")
PREFIX = re.compile(r"[a-z]\w*\.")  # of mf.Bx
SIGNED = re.compile(r"\W{0,3}-\s*[^\W\d]")
"""A name with a minus before it, as -Bx: the quantity with its sign changed."""
DIFFERENCE = re.compile(r"(?i)[^\W\d_]\w*\s*-\s*<?b(?![xyz]\b)")
"""A name with a field after a minus, as Bx-B0: a difference to another field."""


@dataclass(frozen=True)
class ColumnName:
    """The name of a column."""

    text: str
    """Name as the file spells it."""
    quantity: str = ""
    """One of `KNOWN`, `OTHERS` and, if stated, `MOVES`; Hx to Hphi of a column of H; empty if the
    name is not recognized."""
    unit: str = ""
    """Text of the unit as the file spells it; may be empty."""


def in_units(quantities: Sequence[str], length: str) -> tuple[ColumnName, ...]:
    """Return columns that are named after their quantity: positions, and components of B."""
    return tuple(ColumnName(name, name, "T" if name.startswith("B") else length)
                 for name in quantities)


@lru_cache(maxsize=1024)  # lines of many words are read as headers too
def parse(text: str, stated: bool = False) -> ColumnName:
    """Return quantity and unit of the name of a column, which the user may have ``stated``."""
    text = text.strip().strip('"').strip()
    if len(text) > MAX_NAME:
        return ColumnName(f"{text[:MAX_NAME]}...")
    base, unit = split_unit(OF_FIELD.sub(r"_\1", text) if "(B" in text else text)
    base = unicodedata.normalize("NFKC", base.translate(TEX))  # lowered letters become plain ones
    key = _key(base)
    quantity = "" if is_signed(base) else (
        _measured(key, unit_symbol(unit)) or _other_quantity(base, key, unit.strip()) or (
            key if stated and key in STATED else ""))
    return ColumnName(text, quantity, unit.strip())


def is_signed(text: str) -> bool:
    """Return whether the name of a column begins with a minus, so that its numbers are negated."""
    return bool(SIGNED.match(text))


def _measured(key: str, unit: str) -> str:
    """Return which position or field a name is: x in T is Bx, and Hx in A/m is Hx."""
    of_h = f"b{key[1:]}"
    if unit.rpartition(" ")[2] in H_FIELDS and key.startswith("h") and ALIASES.get(of_h) in FIELDS:
        return f"H{ALIASES[of_h][1:]}"
    quantity = ALIASES.get(key, "")
    return f"B{quantity}" if quantity in POSITIONS and kind_of(unit) == "field" else quantity


def _key(base: str) -> str:
    """Return a name without spaces, in lower case, and without the physics of mf.Bx.

    B.x is Bx, and no x of something.
    """
    joined = re.sub(r"[\s_.\-]", "", base.lower())
    return joined if joined in ALIASES else re.sub(
        r"[\s_]", "", PREFIX.sub("", base.lower(), count=1))


def _other_quantity(base: str, key: str, unit: str) -> str:
    """Return which of `OTHERS` a name is, or an empty string; a time must have its unit."""
    if key == "scan":
        return "scan"
    if key in TIME_NAMES:
        return "t" if unit in TIMES or CLOCK.fullmatch(unit) else ""
    if key == "hhmmss":
        return "t"
    of = noise_of(base, key)
    if of in POSITIONS and kind_of(unit) == "field":
        of = f"B{of}"  # as x in T is Bx
    return "" if of is None or of in POSITIONS else f"sigma_{of}".removesuffix("_B")


def noise_of(base: str, key: str) -> str | None:
    """Return the quantity whose standard deviation a name is; None if it is none.

    It is B if the name does not say which component.
    """
    if glued := GLUED.fullmatch(key):
        return ALIASES[glued[1] or glued[2]]
    words = _words(base)
    rest = [word for word in words if word not in NOISE_WORDS]
    if len(rest) == len(words):
        return None
    return ALIASES.get(_key(split_unit("_".join(rest))[0])) if rest else "B"


def _words(base: str) -> list[str]:
    """Return the words of a name in lower case, of which a standard deviation is one, std."""
    return re.split(r"[\s_]+", TWO_WORDS.sub("std", base.lower().strip()))


def with_polar(
    columns: Sequence[ColumnName], constant: Collection[str]
) -> tuple[ColumnName, ...]:
    """Return the columns, of which theta beside phi is the angle from the z axis, and Btheta the
    component along it. Without phi theta is the angle about z.

    Coordinates of the file may be ``constant``; r may be missing, if x, y and z are no columns.
    """
    keys = [_key(split_unit(column.text)[0]) for column in columns]
    there = {*constant, *(column.quantity for column in columns)}
    if not {"theta", "phi"} <= {*keys} or ("r" not in there and {"x", "y", "z"} & there):
        return tuple(columns)
    return tuple(replace(column, quantity=POLAR[key]) if key in POLAR else column
                 for key, column in zip(keys, columns, strict=True))


def is_latitude(column: ColumnName) -> bool:
    """Return whether the name of a column is that of an angle from the plane z = 0."""
    return _key(split_unit(column.text)[0]) in ("latitude", "lat", "elevation")


def with_axes(columns: Sequence[ColumnName]) -> tuple[ColumnName, ...]:
    """Return the columns, of which unknown ones are known by an axis among their words.

    Those in a unit of length are positions, those in one of the field components, in whatever
    language the words are: Posición x (mm). There must be one for each of x, y and z, and no known
    column of the kind.
    """
    known = {column.quantity for column in columns}
    renamed = list(columns)
    for kind, quantities in (("length", POSITIONS), ("field", (*FIELDS, "B"))):
        found = []
        for index, column in enumerate(columns):
            base, unit = split_unit(column.text)
            axes = AXIS.findall(base)
            of_kind = not column.quantity and kind_of(unit) == kind and not (
                is_signed(base) or DIFFERENCE.search(base))
            if of_kind and len(axes) == 1 and not NO_AXIS & set(_words(base)):
                found.append((axes[0].lower(), index, unit))
        if sorted(axis for axis, *_ in found) == ["x", "y", "z"] and not known & set(quantities):
            for axis, index, unit in found:
                renamed[index] = replace(columns[index], unit=unit, quantity=(
                    axis if kind == "length" else f"B{axis}"))
    return tuple(renamed)


def is_imaginary(text: str) -> bool:
    """Return whether the name of a column is that of the imaginary part of a component."""
    return bool(IMAGINARY.fullmatch(_key(split_unit(text)[0])))


def is_clock(column: ColumnName) -> bool:
    """Return whether the name of a column says that it holds times of day as numbers."""
    return _key(column.text) == "hhmmss"


def is_time(column: ColumnName) -> bool:
    """Return whether the name of a column is that of a time, with or without a unit.

    T in a unit of temperature is a temperature.
    """
    name, unit = split_unit(column.text)
    return _key(name) in TIME_NAMES and unit.strip(" °").lower() not in TEMPERATURES


def split_unit(text: str) -> tuple[str, str]:
    """Split a name into the quantity and the unit, which is empty if the name has none."""
    if found := BRACKETS.fullmatch(text):
        return found[1].rstrip("/ "), found[2]  # Hx/(kA/m), as ISO 80000 writes it
    for mark in ("_", ",", " in ", " ", "/"):  # of Hx_kA/m the unit is not m
        base, _, unit = text.rpartition(mark)
        if base and (unit_symbol(unit) or (
                _key(base) in TIME_NAMES and (unit in TIMES or CLOCK.fullmatch(unit)))):
            return base.rstrip("/ "), unit
    return text, ""


def is_units(cells: list[str]) -> bool:
    """Return whether all cells of a line are units, as in the line below some headers."""
    units = [cell.strip().strip("[]()") for cell in cells]
    return any(unit_symbol(unit) for unit in units) and all(
        unit_symbol(unit) or states_no_unit(unit) for unit in units)
