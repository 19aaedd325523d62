"""The order in which blocks are inserted into a magnet, as a CSV table."""

from __future__ import annotations

from pathlib import Path

from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.files import as_path, file_bytes
from halbach_fe.measurement.tables import csv_table

COLUMN = "block"
"""The column of the names; any other column is ignored."""


def read_order(path: str | Path) -> tuple[str, ...]:
    """Read the names of blocks, one per row, from the column ``block`` of a CSV file.

    forces.csv, with its rows in another order, is such a table.

    Raises
    ------
    MeasurementError
        If the table is invalid.
    """
    path = as_path(path)
    where = f"order of assembly {path}"
    _, header, rows = csv_table(file_bytes(path, where), where,
                                f"Begin with the line {COLUMN}.")
    if COLUMN not in header:
        raise MeasurementError(must_be("header", where, f"a table with the column {COLUMN}",
                                       ",".join(header)))
    return tuple(cells[header.index(COLUMN)] for _, cells in rows)
