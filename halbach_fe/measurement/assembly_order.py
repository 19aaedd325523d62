"""The order in which blocks are inserted into a magnet, as a CSV table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.files import as_path, file_bytes
from halbach_fe.measurement.tables import csv_table

COLUMN = "block"
"""The column of the names; any other column is ignored."""


def read_order(path: str | Path, blocks: Sequence[str]) -> tuple[str, ...]:
    """Read the names of blocks, one per row, from the column ``block`` of a CSV file.

    forces.csv, with its rows in another order, is such a table.

    Parameters
    ----------
    path : str or Path
    blocks : sequence of str
        Names of all blocks, each of which the table has to name once.

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
