"""Moments of single blocks, measured before the magnet was assembled, and their CSV file.

Each row is a single block that was measured in a Helmholtz coil. Its moment is given in the axes of
the block at its place in the magnet: x points radially outward through the middle of the block, z
along the magnet's axis, and y azimuthally (z cross x). Ring and slot are counted from 1. If the
place of a block is not known, ``type`` names the type of blocks of the magnet of which it is a
sample. A block that `halbach_fe.sort` turned in its slot has its moment as turned, and the turn in
columns of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.files import as_path, atomic, file_bytes
from halbach_fe.core.interface import typed
from halbach_fe.measurement.text_tables import check_columns, csv_table, finite, write_csv

MOMENT_COLUMNS = ("mx_A_m2", "my_A_m2", "mz_A_m2")
REQUIRED_COLUMNS = ("serial", *MOMENT_COLUMNS, "sigma_A_m2")
COLUMNS = ("serial", "type", "ring", "slot", *REQUIRED_COLUMNS[1:], "volume_m3", "temperature_C")
TURN_COLUMNS = ("turn_x_deg", "turn_y_deg", "turn_z_deg")
REMANENT = {"moments": "B_r V / mu_0"}
"""Attribute of a table whose moments are not those that a coil measures of lone blocks."""


@dataclass(frozen=True)
class BlockTable:
    """Measured blocks; all arrays have one row per block.

    Attributes
    ----------
    serial, type : tuple of str
        Serial number, unique in the table, and type of each block; the type may be empty if the
        place is known, since it follows from the place.
    ring, slot : ndarray of int, shape (n,)
        Place in the magnet, counted from 1; both 0 if the place is not known.
    moment : ndarray, shape (n, 3), in A m^2
        Magnetic moment of the lone block, in the axes of the block at its place in the magnet; B_r
        times the volume by mu_0 if ``attributes`` have `REMANENT`.
    sigma : ndarray, shape (n,), in A m^2
        Standard deviation of each component of the moment, independent from block to block.
    volume : ndarray, shape (n,), in m^3
        NaN if the volume is not known.
    temperature : ndarray, shape (n,), in degrees Celsius
        Temperature at the measurement, NaN if it is not known.
    attributes : mapping
        Provenance, as free text by key, and `REMANENT`.
    source : str
        Name of the table in error messages.
    turn_deg : ndarray, shape (n, 3), in degrees, or None
        Rotation vector along its own axes by which each block is turned in its slot from how it
        was measured; the moment is that of the turned block. None if no block is turned.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> table = hf.read_blocks("blocks.csv")
    >>> table.moment.shape, table.places[0]
    ((16, 3), (1, 1))
    """

    serial: tuple[str, ...]
    type: tuple[str, ...]
    ring: Ints
    slot: Ints
    moment: Floats
    sigma: Floats
    volume: Floats
    temperature: Floats
    attributes: Mapping[str, str] = field(default_factory=dict)
    source: str = "block table"
    turn_deg: Floats | None = None

    def __len__(self) -> int:
        return len(self.serial)

    @property
    def places(self) -> list[tuple[int, int]]:
        """Ring and slot of every block, (0, 0) if its place is not known."""
        return list(zip(self.ring.tolist(), self.slot.tolist(), strict=True))

    def __post_init__(self) -> None:
        for name in ("moment", "sigma", "volume", "temperature", "ring", "slot", "turn_deg"):
            if (given := getattr(self, name)) is not None:  # lists are taken, too
                object.__setattr__(self, name, np.asarray(given))
        _check(self)


@typed
def read_blocks(path: str | Path) -> BlockTable:
    """Read and validate a table of measured blocks.

    The header names the columns of `COLUMNS` in any order. The columns ring, slot, volume_m3 and
    temperature_C may be missing or have empty cells, type too if ring and slot are given, and so
    may those of `TURN_COLUMNS`, which say how a block is turned in its slot. Lines
    ``# key: value`` are attributes.

    Parameters
    ----------
    path : str or Path
        A CSV file with one row per block.

    Returns
    -------
    BlockTable

    Raises
    ------
    MeasurementError
        If the table is invalid. The message names the file and the line, and says how to correct
        it.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> len(hf.read_blocks("blocks.csv"))
    16
    """
    path = as_path(path)
    where = f"block table {path}"
    attributes, header, rows = csv_table(file_bytes(path, where), where)
    foreign = ("A table in other columns or units, such as mA m^2, is converted by `halbach-fe "
               "import-blocks`.")
    check_columns(header, (*COLUMNS, *TURN_COLUMNS), where, f"Rename or remove it. {foreign}")
    missing = [name for name in REQUIRED_COLUMNS if name not in header]
    if missing:
        raise MeasurementError(must_be("header", where, f"complete with {', '.join(missing)}",
                                       ",".join(header), foreign))
    lines = [(number, dict(zip(header, cells, strict=True))) for number, cells in rows]

    def numbers(name: str, empty: float | None = None) -> Floats:
        return np.array([
            empty if empty is not None and not row.get(name)
            else finite(row[name], f"{name} in line {number}", where) for number, row in lines])

    for number, row in lines:
        serial = row["serial"]
        if not serial or serial.startswith("#"):  # `write_blocks` would make it a comment
            raise MeasurementError(must_be(f"serial in line {number}", where,
                                           "given, and not begin with #",
                                           f"'{serial}'" if serial else "an empty cell"))
    turns = np.column_stack([
        numbers(name, 0.0) if name in header else np.zeros(len(lines)) for name in TURN_COLUMNS])
    return BlockTable(
        tuple(row["serial"] for _, row in lines), tuple(row.get("type", "") for _, row in lines),
        _whole(numbers("ring", 0.0), "ring", lines, where),
        _whole(numbers("slot", 0.0), "slot", lines, where),
        np.column_stack([numbers(name) for name in MOMENT_COLUMNS]), numbers("sigma_A_m2"),
        numbers("volume_m3", np.nan), numbers("temperature_C", np.nan), attributes, where,
        turns if turns.any() else None)


def write_blocks(table: BlockTable, path: Path) -> None:
    """Write a table that `read_blocks` can read.

    The file is written atomically: it is either complete, or not there.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    columns = {
        "serial": table.serial, "type": table.type, "ring": [n or "" for n in table.ring.tolist()],
        "slot": [n or "" for n in table.slot.tolist()],
        **dict(zip(MOMENT_COLUMNS, table.moment.T, strict=True)), "sigma_A_m2": table.sigma,
        "volume_m3": table.volume, "temperature_C": table.temperature} | (
        {} if table.turn_deg is None else dict(zip(TURN_COLUMNS, table.turn_deg.T, strict=True)))
    with atomic(path) as temporary:
        write_csv(columns, table.attributes, temporary)


def _whole(
    values: Floats, name: str, lines: Sequence[tuple[int, Mapping[str, str]]], where: str
) -> Ints:
    """Return ring or slot numbers as integers from 1, or 0 for an empty cell; check their range."""
    max_place = 100_000  # largest number of a ring or slot
    for value, (number, row) in zip(values, lines, strict=True):
        if row.get(name) and not (1 <= value <= max_place and value == int(value)):
            raise MeasurementError(must_be(f"{name} in line {number}", where,
                                           f"a whole number from 1 to {max_place}", row[name]))
    return values.astype(int)


def _check(table: BlockTable) -> None:
    """Raise MeasurementError for the first invalid entry of a table."""
    # Largest moment in A m^2. Larger values are unphysical, and their squares may overflow.
    max_moment = 1e12
    # Smallest standard deviation of a moment, relative to the moment: no coil is as exact, and the
    # square of a far smaller one is zero.
    smallest_sigma = 1e-9
    if not len(table):
        raise MeasurementError(must_be("content", table.source, "at least one block", "none"))
    turned = () if table.turn_deg is None else ("turn_deg",)
    for name in ("type", "ring", "slot", "moment", "sigma", "volume", "temperature", *turned):
        wanted = (len(table), 3) if name in ("moment", "turn_deg") else (len(table),)
        if (found := np.shape(getattr(table, name))) != wanted:
            raise MeasurementError(must_be(name, table.source, f"of the shape {wanted}", found))

    def refuse(number: int, what: str, expected: str, received: object, hint: str = "") -> None:
        raise MeasurementError(must_be(f"{what} of block {table.serial[number]}", table.source,
                                       expected, received, hint))

    given = np.abs(np.column_stack([table.moment, table.sigma]))
    for number in np.flatnonzero(~(given <= max_moment).all(axis=1)).tolist():
        if not np.isfinite(given[number]).all():
            refuse(number, "moment and sigma", "finite numbers", "an infinite or missing value")
        refuse(number, "moment and sigma", f"below {max_moment:g} A m^2",
               f"{given[number].max():g}")
    size = np.linalg.norm(table.moment, axis=1)
    # range of temperatures at which moments are measured: from liquid nitrogen to far above any
    # laboratory, but below room temperature in kelvin
    coldest_C, hottest_C = -200.0, 200.0
    for number in range(len(table)):
        if table.turn_deg is not None and not np.linalg.norm(table.turn_deg[number]) <= 360.0:
            refuse(number, "turn_deg", "a rotation vector of at most 360°",
                   str(table.turn_deg[number]))
        if not table.sigma[number] > 0:
            refuse(number, "sigma_A_m2", "positive", f"{table.sigma[number]:g}")
        if table.sigma[number] >= size[number]:
            refuse(number, "sigma_A_m2", f"below the moment of {size[number]:g} A m^2",
                   f"{table.sigma[number]:g}", "Are both in A m^2?")
        if table.volume[number] <= 0:  # False for NaN, an unknown volume
            refuse(number, "volume_m3", "positive", f"{table.volume[number]:g}",
                   "Leave it empty if it is not known.")
        if np.isinf(table.volume[number]):
            refuse(number, "volume_m3", "a finite number", "an infinite value")
        if not np.isnan(table.temperature[number]) and not (
                coldest_C <= table.temperature[number] <= hottest_C):
            refuse(number, "temperature_C", f"from {coldest_C:g} to {hottest_C:g} °C",
                   f"{table.temperature[number]:g}", "Is it in kelvin?")
        if table.sigma[number] < smallest_sigma * size[number]:
            refuse(number, "sigma_A_m2", f"at least {smallest_sigma:g} of the moment of "
                   f"{size[number]:g} A m^2", f"{table.sigma[number]:g}")
        if not (table.type[number] or table.ring[number]):
            refuse(number, "type", "given, or its ring and slot", "neither")
        if (table.ring[number] > 0) != (table.slot[number] > 0):
            refuse(number, "place", "ring and slot together", "only one of the two",
                   "Leave both empty if the place is not known.")
    serials: set[str] = set()
    blocks: dict[tuple[int, int], str] = {}
    for number, (serial, place) in enumerate(zip(table.serial, table.places, strict=True)):
        if serial in serials:
            refuse(number, "serial", "unique to one block", "that of an earlier row",
                   "Remove a row.")
        if place[0] and place in blocks:
            refuse(number, "place", "unique to one block",
                   f"ring {place[0]}, slot {place[1]}, where block {blocks[place]} is")
        serials.add(serial)
        blocks[place] = serial


COLUMN = "block"
"""The column of the names; any other column is ignored."""


def read_order(path: str | Path, blocks: Sequence[str]) -> tuple[str, ...]:
    """Read the names of blocks, one per row, from the column ``block`` of a CSV file.

    forces.csv, with its rows in another order, is such a table.

    ``blocks``: names of all blocks, each of which the table has to name once.

    Raises
    ------
    MeasurementError
        If the table is invalid, or does not name every block once.
    """
    path = as_path(path)
    where = f"order of assembly {path}"
    _, header, rows = csv_table(file_bytes(path, where), where,
                                f"Begin with the line {COLUMN}.")
    if COLUMN not in header:
        raise MeasurementError(must_be("header", where, f"a table with the column {COLUMN}",
                                       ",".join(header)))
    known, lines = set(blocks), dict[str, int]()
    for number, cells in rows:
        name = cells[header.index(COLUMN)]
        if name not in known:
            raise MeasurementError(must_be(
                f"{COLUMN} in line {number}", where, "one of the blocks of the magnet",
                f"'{name}'", f"Their names are like {blocks[0]}."))
        if name in lines:
            raise MeasurementError(must_be(
                f"{COLUMN} in line {number}", where, "a block of its own",
                f"{name}, which is in line {lines[name]} too", "Remove a row."))
        lines[name] = number
    missing = [name for name in blocks if name not in lines]
    if missing:
        raise MeasurementError(must_be(
            "content", where, f"all {len(blocks)} blocks of the magnet",
            f"{len(lines)}, without {missing[0]}"))
    return tuple(lines)
