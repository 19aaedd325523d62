"""Import of tables of blocks as people have them: own names of columns, mm, degrees, J in mT.

A table with positions becomes one of free blocks (`halbach_fe.study.free_blocks`), any other one of
measured blocks (`halbach_fe.measurement.block_table`). The strength of a block may be its moment,
its polarization J, its magnetization M, or its remanence B_r. A coil measures the moment of a lone
block, m = V M = V J / mu_0, in its own demagnetizing field; that is not that of its B_r, see
`remanence_per_polarization`. The J and M of free blocks are those of programs, where J = B_r. As
for maps, nothing is guessed, and one message lists all that is missing.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError, must_be, printable
from halbach_fe.core.files import file_bytes
from halbach_fe.core.numbers import MU_0, in_a_row
from halbach_fe.geometry.array_layout import nominal_free_blocks
from halbach_fe.measurement.block_table import REMANENT, BlockTable
from halbach_fe.measurement.formats import column_names, units
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.probe_law import to_magnet_axes
from halbach_fe.measurement.text_tables import (
    Line,
    cells_of,
    comma_hint,
    delimiter_of,
    is_comment,
    lines_of,
    number_in_cell,
    text_of_table,
    uncommented,
)
from halbach_fe.solver.exact_block_field import remanence_per_polarization
from halbach_fe.study.array_keys import Array
from halbach_fe.study.free_blocks import COLUMNS as FREE_COLUMNS
from halbach_fe.study.free_blocks import (
    REMANENCE_VECTOR,
    SIZES,
    FreeBlocks,
    outline_of,
    validated_blocks,
)
from halbach_fe.study.types import COMPONENTS

TEXTS = ("serial", "type", "ring", "slot", "shape", "material")
VECTORS = {
    "moment": "moment", "polarization": "field", "magnetization": "field", "remanence": "field"}
"""Kind of the unit of each strength."""
_WORDS = {
    "serial": "serial serialno serialnumber id blockid magnetid magnet block label name no nr "
              "number index",
    "type": "type kind blocktype class", "ring": "ring layer ringno", "slot": "slot slotno place",
    "shape": "shape geometry form", "material": "material grade", "volume": "volume vol v",
    "temperature": "temperature temp t", "sigma": "sigma sd std stdev uncertainty error",
    "moment": "moment magneticmoment m dipolemoment",
    "polarization": "j polarization", "magnetization": "magnetization mag",
    "remanence": "br remanence",
    "sides": "sides corners", "angle": "angle openingangle sectorangle",
    "radius": "radius", "inner_radius": "innerradius rin ri r1", "outer_radius":
    "outerradius rout ro r2", "inner_width": "innerwidth", "outer_width": "outerwidth"}
WORDS = {word: name for name, words in _WORDS.items() for word in words.split()} | {
    spelling.format(axis): f"{name}_{axis}" for axis in COMPONENTS for name, spellings in {
        "at": ("{}", "x{}", "pos{}", "{}pos", "position{}", "center{}", "centre{}", "{}center",
               "{}centre", "{}c"),
        "size": ("size{}", "{}size", "d{}", "l{}", "dim{}", "length{}"),
        "rotation": ("rotation{}", "rot{}", "{}rot", "r{}", "rotvec{}"),
        "moment": ("m{}", "moment{}"), "polarization": ("j{}", "polarization{}"),
        "remanence": ("br{}", "remanence{}", "b{}"),
        "magnetization": ("magnetization{}", "mag{}")}.items() for spelling in spellings} | {
    "length": "size_x", "width": "size_y", "height": "size_z", "thickness": "size_z"}
"""Quantities by the names of columns, without spaces and marks, in lower case."""
WITHOUT_AXIS = ("length", "width")
"""Names of edges that do not say their axis; height and thickness are along z."""
DIRECTION = re.compile(r"(?:mag(?:neti[sz]ation)?|easy|j|m)?(?:direction|dir|axis|u|n|e)[xyz]")
"""Names, without spaces and marks, of columns of a direction beside a length of J."""
TURN = re.compile(
    r"(?i)\W*(?:rot(?:at(?:ion(?:al)?|ed))?|turn(?:ed)?|angles?|phi|theta|euler|roll|pitch|yaw|"
    r"tilt(?:ed)?|azimuth(?:al)?|orient(?:ation|ed)?)(?:[xyz]|angles?|deg|rad|vec)*(?:m(?:ag)?)?"
    r"(?:about.*|[\W\d_].*)?")
"""Names of columns that say how a block lies; a rotor and the turns of a coil do not."""
LENGTHS = ("radius", "inner_radius", "outer_radius", "inner_width", "outer_width", "outline")
NUMBERS = ("recoil_permeability", "recoil_permeability_across", "magnetization_gradient",
           "inner_corner_loss")
"""Numbers without a unit, which are named as in a table of free blocks."""
KIND = {"volume": "volume", "angle": "angle", "sigma": "moment"} | dict.fromkeys(
    LENGTHS, "length") | {
    f"{name}_{axis}": kind for axis in COMPONENTS for name, kind in (
        ("at", "length"), ("size", "length"), ("rotation", "angle"), *VECTORS.items())} | VECTORS
"""Kinds of the units of quantities that have one."""
STATED = re.compile(r"([-+]?[\d.,]+(?:[eE][-+]?\d+)?)\s*(.*)")
"""A number and its unit, with a blank between them or without: people write 0.2% and 12cm^3."""
KELVIN = ("K", "kelvin")
TEMPERATURES = ("C", "\u00b0C", "degC", "Celsius", "celsius", *KELVIN)
"""Units of temperatures; C if none is stated."""
QUANTITIES = (*TEXTS, "temperature", "sides", *NUMBERS, *KIND)


@dataclass(frozen=True)
class DeclaredBlocks(DeclaredFormat):
    """Statements of the user about a table of blocks."""

    axes: tuple[str, str, str] = ("x", "y", "z")
    """Axis of the block (x radial, y azimuthal, z along the magnet; of a free block those of the
    magnet) along which each component of the strength lies, as ``-y``."""
    along_block: bool = False
    """Whether components of the strength of free blocks lie along the block's own axes."""
    fixed: Mapping[str, str] = field(default_factory=dict)
    """Value and unit of quantities for which the table has no column, such as ``12 cm^3``."""
    unused: ClassVar[tuple[str, ...]] = ("component", "at", "origin_m", "positions")

    def _wrong(self) -> dict[str, str]:
        """Return what each statement must be that has a value of no meaning."""
        wrong = super()._wrong()
        if sorted(one.removeprefix("-") for one in self.axes) != sorted(COMPONENTS):
            wrong["axes"] = "x, y and z in some order, with a minus or without"
        if not {*self.fixed} <= {*QUANTITIES} or not all(
                isinstance(text, str) and text.strip() for text in self.fixed.values()):
            wrong["fixed"] = f"a dict such as {{'volume': '12 cm^3'}} of {', '.join(QUANTITIES)}"
        return wrong


@dataclass(frozen=True)
class _Table:
    """Cells by quantity, unit of each, and numbers of the lines; SI values on demand.

    ``named`` are the columns by quantity as the table names them, of those that no user has named.
    """

    cells: dict[str, list[str]]
    unit: dict[str, str]
    lines: tuple[int, ...]
    where: str
    decimal_comma: bool
    unknown: tuple[str, ...]
    named: dict[str, str]

    def __contains__(self, name: object) -> bool:
        return name in self.cells

    def numbers(self, name: str) -> Floats:
        """Return the numbers (n,) of a quantity in the unit of its column; NaN where empty."""
        return np.array([_number(cell, name, line, self) for cell, line in zip(
            self.cells[name], self.lines, strict=True)])

    def si(self, name: str) -> Floats:
        """Return the numbers (n,) of a quantity in SI units, angles in rad; NaN where empty."""
        found = self.numbers(name)
        return units.in_si(found, self.unit[name]) if name in KIND else found

    def vector(self, name: str) -> Floats:
        """Return the vectors (n, 3) of a strength, that along x if it has a single column."""
        if name in self.cells:
            return np.outer(self.si(name), [1.0, 0.0, 0.0])
        return np.column_stack([self.si(f"{name}_{axis}") for axis in COMPONENTS])


def import_blocks(path: Path, declared: DeclaredBlocks) -> BlockTable | FreeBlocks:
    """Read a table of blocks in own columns and units, text or a workbook.

    Raises
    ------
    MeasurementError
        If something is missing (one message lists all of it), a cell is not what it must be, or a
        table with positions makes no free blocks.
    """
    where = f"table of blocks {path}"
    raw = text_of_table(file_bytes(path, where, workbooks=True), where, declared.decimal_comma)
    table = _table(lines_of(raw, declared, where), declared, where)
    free = any(f"at_{axis}" in table for axis in COMPONENTS)
    missing = _missing(table, free)
    if missing:
        raise MeasurementError(must_be(
            "content", where, "complete", f"a table that does not say {'; '.join(missing)}",
            "A column can be named by --columns, and what all blocks share be given by one --fixed "
            "NAME=VALUE,NAME=VALUE; nothing is guessed."))
    if declared.along_block and not free:
        raise MeasurementError(must_be(
            "--along-block", where, "beside positions, which free blocks have", "alone",
            "Leave it out: measured moments lie along the block's own axes."))
    if unread := _unread(table, free):
        warnings.warn(f"Of {where} these are not read: {', '.join(unread)}. "
                      f"{'Free' if free else 'Measured'} blocks have no such quantity, or it "
                      "follows from the others; --columns can name it otherwise.", HalbachWarning,
                      stacklevel=2)
    if free:
        return _free_blocks(table, declared)
    digest = hashlib.sha256(raw).hexdigest()
    return _measured_blocks(table, declared, {
        "imported_from": printable(path.name, 255), "imported_sha256": digest})


def _table(lines: Sequence[Line], declared: DeclaredBlocks, where: str) -> _Table:
    """Return the cells of a table, whose header is the first line that names two quantities."""
    delimiter = _delimiter(lines, declared)
    rows = [(number, cells_of(uncommented(line) if is_comment(line) else line, delimiter),
             is_comment(line)) for number, line in lines]
    start = next((n for n, (_, cells, _) in enumerate(rows)
                  if sum(bool(quantity_of(cell)[0]) for cell in cells) > 1), -1)
    own = rows[start][1] if start >= 0 else []
    body = [(number, cells) for number, cells, comment in rows[start + 1:] if not comment]
    below = [cell.strip("[]() ") for cell in body[0][1]] if body else []
    if column_names.is_units(["" if unit in TEMPERATURES else unit for unit in below]):
        body = body[1:]
    else:
        below = []
    header = _header(own, below, declared, where)
    for number, cells in body:
        if len(cells) != len(header):
            raise MeasurementError(must_be(
                f"line {number}", where, f"of {len(header)} cells, as the header", str(len(cells)),
                "Remove it, or begin it with #; if the table begins below it, name the columns by "
                f"--columns, and add --skip-lines {number}."))
    if not body:
        raise MeasurementError(must_be("content", where, "at least one block", "none"))
    table, unit = _columns(header, [cells for _, cells in body], declared, where)
    unknown = [] if declared.columns else [
        text.strip() for text, (name, _) in zip(own, header, strict=False)
        if not name and text.strip()]
    named = {} if declared.columns else {
        name: text.strip() for text, (name, _) in zip(own, header, strict=False) if name}
    return _Table(table, _with_stated(unit, declared, where), tuple(number for number, _ in body),
                  where, declared.decimal_comma, tuple(unknown), named)


def _delimiter(lines: Sequence[Line], declared: DeclaredBlocks) -> str | None:
    """Return what separates the cells: of the line of most marks, or of one that names two
    quantities, as outlines have semicolons among commas.
    """
    found = delimiter_of(max((line for _, line in lines), key=lambda one: sum(
        one.count(mark) for mark in ",;\t")), declared)
    first = 100  # lines, below which there is no header
    for _, line in lines[:first]:
        own = delimiter_of(line, declared)
        if sum(bool(quantity_of(cell)[0]) for cell in cells_of(uncommented(line), own)) > 1:
            return own
    return found


def _header(
    own: Sequence[str], below: Sequence[str], declared: DeclaredBlocks, where: str
) -> list[tuple[str, str]]:
    """Return the quantity and the unit of each column, empty texts if they are not known.

    The table has its ``own`` names, or none, and units ``below`` them, or none; those of the user
    take their place, but what they leave open the table says.
    """
    if not own and not declared.columns:
        raise MeasurementError(must_be("header", where, f"made of {', '.join(QUANTITIES)}",
                                       "no line that names two of them",
                                       "State the columns by --columns; if it is no table, write "
                                       "it as CSV with a header."))
    header = [quantity_of(text) if text != "-" else ("", "") for text in declared.columns or own]
    if unknown := [text for text, (name, _) in zip(declared.columns, header, strict=False)
                   if text != "-" and not name]:
        raise MeasurementError(must_be("--columns", where, f"made of {', '.join(QUANTITIES)} and -",
                                       f"'{unknown[0]}'"))
    for (name, unit), other in zip([quantity_of(text) for text in own], below, strict=False):
        if unit and other and not _same_unit(name, unit, other):
            raise MeasurementError(must_be(
                f"unit of {name}", where, "the same in the header and in the line of units below",
                f"'{unit[:20]}' and '{other[:20]}'", "Remove the wrong one."))
    for said in ([column_names.split_unit(text)[1].strip() for text in own], below):
        if len(said) == len(header):
            header = [(name, unit or other)
                      for (name, unit), other in zip(header, said, strict=True)]
    return header


def _same_unit(name: str, one: str, other: str) -> bool:
    """Tell whether two texts are one unit of a quantity."""
    if name == "temperature":
        return (one in KELVIN) == (other in KELVIN)
    return name not in KIND or _symbol(one) == _symbol(other)


def _columns(
    header: Sequence[tuple[str, str]], body: Sequence[Sequence[str]], declared: DeclaredBlocks,
    where: str
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Return cells and unit of each quantity, of the table or as the user states for all blocks."""
    cells: dict[str, list[str]] = {}
    unit: dict[str, str] = {}
    for column, (name, said) in enumerate(header):
        if name and name in cells:
            raise MeasurementError(must_be("header", where, f"with one column {name}", "two",
                                           "Choose one with --columns; - ignores a column."))
        if name:
            cells[name], unit[name] = [row[column] for row in body], said
    for name, text in declared.fixed.items():
        if name in cells:
            raise MeasurementError(must_be(
                f"--fixed {name}", where, "what the table does not say", "a value beside a column "
                "of it", "Leave it out, or ignore the column by - in --columns."))
        found = STATED.fullmatch(text)
        value, said = found.groups() if found else text.partition(" ")[::2]
        value = value.replace(".", ",") if declared.decimal_comma else value
        cells[name] = [value if name in KIND or name == "temperature" else text] * len(body)
        unit[name] = said
    return cells, unit


def _with_stated(
    unit: dict[str, str], declared: DeclaredBlocks, where: str
) -> dict[str, str]:
    """Return the units by their symbols, those that the user states of a kind where none is."""
    for kind in ("length", "field", "angle"):
        said = declared.unit_of(kind)
        own = {_symbol(one) for name, one in unit.items() if KIND.get(name) == kind}
        if said and "" not in own and own != {_symbol(said)}:
            raise MeasurementError(must_be(
                f"--{kind}-unit", where, "of a column that does not state its unit itself",
                f"'{said}', which no column needs", "Leave it out."))
    return {name: _symbol(said) or declared.unit_of(KIND.get(name, ""))
            for name, said in unit.items()}


def _symbol(text: str) -> str:
    """Return the symbol of a unit, or the text if it is none."""
    return units.unit_symbol(text) or text


def quantity_of(text: str) -> tuple[str, str]:
    """Return the quantity and the unit of the name of a column; empty texts if it is unknown."""
    text = text.strip().strip('"')[:column_names.MAX_NAME]
    base, unit = column_names.split_unit(text)
    if not unit and "_" in text:  # moment_A_m2
        parts = text.split("_")
        for n in range(1, len(parts)):
            if units.unit_symbol(" ".join(parts[n:])) or parts[n:] in (["C"], ["K"], ["degC"]):
                base, unit = "_".join(parts[:n]), " ".join(parts[n:])
                break
    key = "" if column_names.is_signed(base) else re.sub(r"[\s_.|-]", "", base.lower())
    name = base if base in QUANTITIES else WORDS.get(key, "")
    if name.startswith("moment") and units.kind_of(unit) == "field":
        name = name.replace("moment", "magnetization")  # Mx in A/m
    return name, unit.strip()


def _number(cell: str, name: str, line: int, table: _Table) -> float:
    """Return the number in a cell; NaN if it is empty."""
    try:
        return number_in_cell(cell, table.decimal_comma)
    except ValueError:
        raise MeasurementError(must_be(f"{name} in line {line}", table.where, "a number",
                                       f"'{cell[:40]}'", comma_hint(cell))) from None


def _strength(table: _Table) -> str:
    """Return which strength a table has; empty if it has none."""
    return next((name for name in VECTORS if name in table or all(
        f"{name}_{axis}" in table for axis in COMPONENTS)), "")


def _missing(table: _Table, free: bool) -> list[str]:
    """Return what the table does not say."""
    strength = _strength(table)
    sizes = all(f"size_{axis}" in table for axis in COMPONENTS)
    of_moment = strength == "moment"
    polar = "at_x" not in table and any(
        column_names.parse(text).quantity in ("r", "phi") for text in table.unknown)
    places = [f"at_{axis}" for axis in COMPONENTS if f"at_{axis}" not in table]
    wanted = [
        (not free and "serial" not in table,
         "the serial or name of each block (a column serial)"),
        (not strength and "material" not in table,
         "its strength (columns moment_x, moment_y, moment_z, or polarization_x ..., "
         "magnetization_x ..., or remanence_x ...)"),
        (not free and strength in table.cells,
         f"the direction of its {strength} (a length alone does not: columns {strength}_x, "
         f"{strength}_y, {strength}_z along the axes of the block)"),
        *((free, f"{name[-1]} of each block (a column {name})") for name in places),
        (free and polar, "x and y of its angle (x = r cos(phi), y = r sin(phi))"),
        *((True, text) for text in (_unclear(table) if free else [])),
        (free and "shape" not in table,
         f"the shape (--fixed shape=cuboid, or one of {', '.join(SIZES)})"),
        (not free and "sigma" not in table,
         "the standard deviation of a moment (a column sigma, or --fixed 'sigma=0.001 A m^2' or "
         "'sigma=0.2 %')"),
        (not free and "type" not in table and not {"ring", "slot"} <= set(table.cells),
         "ring and slot, or the type of the blocks (--fixed type=1)"),
        (bool(strength) and of_moment == free and "volume" not in table and not sizes,
         "the volume (a column, or --fixed 'volume=12 cm^3')"),
        (free and of_moment and not {"material", "recoil_permeability"} & table.cells.keys(),
         "the recoil permeability, without which a moment is no remanence (a column, or --fixed "
         "recoil_permeability=1.05)")]
    return [text for lacks, text in wanted if lacks] + _without_unit(table)


def _unclear(table: _Table) -> list[str]:
    """Return what the names of columns leave open of how free blocks lie."""
    turns = [name for name in table.cells if name.startswith("rotation_")]
    several = len(turns) > 1 and (np.count_nonzero(np.nan_to_num(np.column_stack(
        [table.numbers(name) for name in turns])), axis=1) > 1).any()
    said = [text for name in turns
            if column_names.split_unit(text := table.named.get(name, name))[0] != name
            and "rotvec" not in text.lower()] if several else []
    sizes = [text for name, text in table.named.items() if name in ("size_x", "size_y")
             and column_names.split_unit(text)[0].lower().strip() in WITHOUT_AXIS]
    other = [text for text in table.unknown if "at_x" in table and (
        (kind := units.kind_of(column_names.split_unit(text)[1])) == "angle"
        or (not kind and TURN.fullmatch(column_names.split_unit(text)[0])))]
    found = []
    if said:
        found.append(
            f"whether {_quoted(said)}, of which several are not zero, are a rotation vector "
            "(rotation_x, rotation_y, rotation_z in --columns) or turns one after the other (a "
            "vector of these, if x, y, z is their order: scipy's Rotation.from_euler('xyz', "
            "angles, degrees=True).as_rotvec(degrees=True))")
    if sizes:
        found.append(f"along which axes {_quoted(sizes)} lie (size_x, size_y, size_z in --columns)")
    bases = {text: column_names.split_unit(text)[0].lower() for text in table.unknown}
    along = [text for text, base in bases.items() if _strength(table) in table.cells
             and DIRECTION.fullmatch(re.sub(r"[\W_]", "", base))]
    if along:
        strength = _strength(table)
        found.append(f"{strength}_x, {strength}_y, {strength}_z: the products of its {strength}, "
                     f"which alone is along x of the block, and {_quoted(along)}")
    across = [text for text, base in bases.items() if base.strip().startswith("diam")]
    if across and "radius" not in table:
        found.append(f"the radius, half of {_quoted(across)} (radius[0.5 mm], if that is in mm, in "
                     "--columns)")
    if other:
        found.append(f"how a block is turned by {_quoted(other)} (rotation_z in --columns, if that "
                     "is about z; - if it is not)")
    return found


def _quoted(texts: Sequence[str]) -> str:
    """Return texts in quotes, in a row."""
    return in_a_row([f"'{text}'" for text in texts])


def _without_unit(table: _Table) -> list[str]:
    """Return which quantities have no unit, or one that is not known."""
    of: dict[tuple[str, str], list[str]] = {}
    for name, unit in table.unit.items():
        kind = KIND.get(name, "")
        if name == "temperature":
            if unit and unit not in TEMPERATURES:
                of.setdefault((name, unit), []).append(name)
        elif kind and units.kind_of(unit) != kind and not (name == "sigma" and unit in (
                "%", *units.FIELDS)):
            of.setdefault((kind, unit), []).append(name)
    return [f"the unit of {', '.join(named)} (one of "
            f"{', '.join(TEMPERATURES if kind == 'temperature' else units.KINDS[kind])}"
            + (f", not '{unit[:20]}'" if unit else "")
            + (f": --{kind}-unit, or in the header" if kind in ("length", "field", "angle")
               and not unit else "; of J or M, as of Radia, name them polarization_x or "
               "magnetization_x ... in --columns" if kind == "moment" and not unit else "") + ")"
            for (kind, unit), named in of.items()]


def _unread(table: _Table, free: bool) -> list[str]:
    """Return the columns, and the values that all blocks share, that make no difference."""
    strength = _strength(table)
    read = {strength, *(f"{strength}_{axis}" for axis in COMPONENTS if strength not in table),
            "serial", "type", "ring", "slot"}
    sizes = {f"size_{axis}" for axis in COMPONENTS}
    if free:
        read |= {"shape", "material", "sides", *NUMBERS} | {
            name for name, kind in KIND.items() if kind in ("length", "angle")}
        read |= {"volume"} if strength == "moment" else set()
    else:
        read |= {"sigma", "temperature", "volume"} | (set() if "volume" in table else sizes)
    return [*table.unknown, *(name for name in table.cells if name not in read)]


def _volume(table: _Table) -> Floats:
    """Return the volumes (n,) in m^3, of the sizes if there is no column; NaN if neither is."""
    if "volume" in table:
        return table.si("volume")
    sizes = [table.si(f"size_{axis}") for axis in COMPONENTS if f"size_{axis}" in table]
    return np.asarray(np.prod(sizes, axis=0)) if len(sizes) == len(COMPONENTS) else np.full(
        len(table.lines), np.nan)


def _measured_blocks(
    table: _Table, declared: DeclaredBlocks, attributes: Mapping[str, str]
) -> BlockTable:
    """Return the table of measured blocks, whose shape, and moment of B_r, the study has."""
    strength = _strength(table)
    vectors = to_magnet_axes(declared.axes, table.vector(strength))
    volume = _volume(table)
    moment = vectors if strength == "moment" else vectors * (volume / MU_0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):  # zero is refused below
        _check_strength(moment * (MU_0 / volume)[:, None], strength, table)
    if table.unit["sigma"] == "%":
        sigma = table.numbers("sigma") / 100 * np.linalg.norm(moment, axis=1)
    else:
        sigma = table.si("sigma")
        if table.unit["sigma"] in units.FIELDS:
            sigma = sigma * volume / MU_0
    count = len(table.lines)
    place = {name: np.array([0 if not cell else _whole(cell, name, line, table)
                             for cell, line in zip(table.cells[name], table.lines, strict=True)])
             if name in table else np.zeros(count, int) for name in ("ring", "slot")}
    temperature = table.si("temperature") if "temperature" in table else np.full(count, np.nan)
    if table.unit.get("temperature") in KELVIN:
        temperature = temperature - 273.15
    return BlockTable(tuple(table.cells["serial"]), tuple(table.cells.get("type", [""] * count)),
                      place["ring"], place["slot"], moment, sigma, volume, temperature,
                      {**attributes, **(REMANENT if strength == "remanence" else {})}, table.where)


def _check_strength(polarization: Floats, strength: str, table: _Table) -> None:
    """Raise MeasurementError for polarizations (n, 3) in T that no magnet has; NaN is unknown."""
    most_T = 10.0  # no material has a quarter of it, and mT or kG taken for T are beyond
    size = np.linalg.norm(polarization, axis=1)
    size[~np.isfinite(size)] = 0.0  # without a volume, which is refused later
    if (size > most_T).any():
        row = int(np.argmax(size > most_T))
        raise MeasurementError(must_be(
            f"{strength} in line {table.lines[row]}", table.where,
            f"a polarization below {most_T:g} T", f"one of {size[row]:.4g} T",
            "Are the units of its columns, and of the volume, right?"))


def _whole(cell: str, name: str, line: int, table: _Table) -> int:
    """Return the whole number from 1 in a cell; workbooks write 3 as 3.0."""
    value = _number(cell, name, line, table)
    if not (value >= 1 and value == int(value)):
        raise MeasurementError(must_be(f"{name} in line {line}", table.where,
                                       "a whole number from 1", f"'{cell[:40]}'"))
    return int(value)


def _outlines(table: _Table) -> Iterator[tuple[tuple[float, ...], ...] | None]:
    """Yield the corners in m of each block, None where the cell is empty."""
    for cell, line in zip(table.cells["outline"], table.lines, strict=True):
        try:
            corners = outline_of(cell.replace(",", ".") if table.decimal_comma else cell
                                 ) if cell else None
        except ValueError:
            raise MeasurementError(must_be(
                f"outline in line {line}", table.where, "corners as `x y; x y; x y`",
                f"'{cell[:40]}'")) from None
        unit = table.unit["outline"]
        yield corners and tuple(
            tuple(np.round(units.in_si(np.array(corner), unit), 12).tolist()) for corner in corners)


def _less_whole_turns(turns: dict[str, Floats]) -> dict[str, Floats]:
    """Return the components (n,) in rad of rotation vectors, without whole turns of 360 degrees."""
    squares = [np.nan_to_num(one)**2 for one in turns.values()]
    size = np.sqrt(np.sum(squares, axis=0))
    left = np.where(size > 2 * np.pi, np.mod(size, 2 * np.pi) / np.maximum(size, 1.0), 1.0)
    return {name: left * one for name, one in turns.items()}


def _free_blocks(table: _Table, declared: DeclaredBlocks) -> FreeBlocks:
    """Return the table of free blocks."""
    numbers = [str(number) for number, _ in enumerate(table.lines, 1)]  # names, if there are none
    columns: dict[str, list[object]] = {"name": [
        re.sub(r"[^A-Za-z0-9_-]", "-", cell) for cell in table.cells.get("serial", numbers)]}
    for name in ("type", "shape", "material"):
        if name in table:
            columns[name] = [cell or None for cell in table.cells[name]]
    for name in ("ring", "slot", "sides"):
        if name in table:
            columns[name] = [_whole(cell, name, line, table) if cell else None for cell, line in
                             zip(table.cells[name], table.lines, strict=True)]
    turns = _less_whole_turns({name: table.si(name) for name in table.cells
                               if name.startswith("rotation_")})
    for name in table.cells:
        own = name.removeprefix("at_") if name.startswith("at_") else name
        own, values = (f"{own}_deg", np.degrees) if KIND.get(name) == "angle" else (
            own if name in NUMBERS else f"{own}_m", np.asarray)
        if name == "outline":
            columns[own] = [*_outlines(table)]
        elif own in FREE_COLUMNS:
            si = turns[name] if name in turns else table.si(name)
            columns[own] = [None if np.isnan(value) else value
                            for value in np.round(values(si), 12).tolist()]
    strength = _strength(table)
    if strength:
        vectors = table.vector(strength)
        if strength == "moment":
            vectors = vectors * (MU_0 / _volume(table))[:, None]
        if strength in table:
            if declared.along_block or declared.axes != COMPONENTS:
                raise MeasurementError(must_be(
                    "--axes and --along-block", table.where, "of a strength of three components",
                    f"beside a single column of it, {strength}, which is along the block's own x",
                    "Leave them out."))
            columns["remanence_T"] = vectors[:, 0].tolist()
        else:
            vectors = to_magnet_axes(declared.axes, vectors)
            if declared.along_block:
                turn = np.column_stack([turns.get(f"rotation_{axis}", np.zeros(len(vectors)))
                                        for axis in COMPONENTS])
                vectors = Rotation.from_rotvec(np.nan_to_num(turn)).apply(vectors)
            for axis, values in zip(COMPONENTS, vectors.T, strict=True):
                columns[f"remanence_{axis}_T"] = values.tolist()
    try:
        found = validated_blocks(columns, table.where)
        return _of_lone_blocks(found) if strength == "moment" else found
    except StudyError as error:
        raise MeasurementError(str(error)) from None


def _of_lone_blocks(table: FreeBlocks) -> FreeBlocks:
    """Return blocks with the B_r that each has, if it has the J of ``table`` on its own."""
    blocks = nominal_free_blocks(Array.model_validate({"free_blocks": table}), 3)
    remanences = [factor @ block.polarization for block, factor in zip(
        blocks, remanence_per_polarization(blocks), strict=True)]
    return table.model_copy(update={"remanence_T": (), **dict(zip(
        REMANENCE_VECTOR, zip(*np.array(remanences).tolist(), strict=True), strict=True))})
