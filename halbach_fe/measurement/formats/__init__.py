"""Maps in the formats of others: read as they come, and written for other programs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import xarray as xr

from halbach_fe.core.errors import OutputError, must_be, printable
from halbach_fe.core.files import atomic, file_bytes
from halbach_fe.measurement.field_map import check_readings, write_map
from halbach_fe.measurement.formats import bdsim, columns, comsol, geant4, openpmd, opera
from halbach_fe.measurement.formats.declared import Declared
from halbach_fe.measurement.formats.grid import Grid, grid_of
from halbach_fe.measurement.formats.table import ForeignTable, Imported, to_map
from halbach_fe.measurement.formats.text import lines_of

READERS: dict[str, Callable[[bytes, Declared, str], ForeignTable]] = {
    "columns": columns.read, "opera": opera.read, "comsol": comsol.read, "openpmd": openpmd.read}
GRIDS: dict[str, Callable[[Grid], bytes]] = {
    "openpmd": openpmd.content, "bdsim": lambda grid: _joined(bdsim.lines(grid)),
    "geant4": lambda grid: _joined(geant4.lines(grid))}
SUFFIXES = {"csv": ".csv", "vtu": ".vtu"}
WRITERS = (*GRIDS, *SUFFIXES)
MAX_NAME = 255
"""Characters of a file's name."""


@dataclass(frozen=True)
class ImportedFile:
    """A map that was imported, and in which format it came."""

    imported: Imported
    format: str

    @property
    def data(self) -> xr.Dataset:
        """The map."""
        return self.imported.data


def import_map(path: Path, declared: Declared, name: str = "") -> ImportedFile:
    """Read a map of another format, which its structure tells if ``name`` does not.

    Raises
    ------
    MeasurementError
        With one sentence that names the file, and what to do.
    """
    where = f"map {path}"
    raw = file_bytes(path, where)
    name = name or format_of(raw, declared, where)
    found = to_map(READERS[name](raw, declared, where), declared)
    data = found.data
    check_readings(data, path)
    data.attrs |= {"imported_from": printable(path.name, MAX_NAME), "imported_as": name,
                   "imported_sha256": hashlib.sha256(raw).hexdigest()}
    return ImportedFile(found, name)


def format_of(raw: bytes, declared: Declared, where: str) -> str:
    """Which of `READERS` a file is for, by how it begins."""
    if raw.startswith(openpmd.SIGNATURE):
        return "openpmd"
    lines = lines_of(raw, declared, where)
    if comsol.is_comsol(lines):
        return "comsol"
    return "opera" if opera.is_opera(lines) else "columns"


def export_map(data: xr.Dataset, name: str, path: Path) -> None:
    """Write a map in one of `WRITERS`; the file appears whole or not at all.

    Raises
    ------
    MeasurementError
        If the format needs a regular grid and the map's points make none.
    OutputError
        If the file cannot be written, or has a suffix of another format.
    """
    if name in SUFFIXES:
        if path.suffix != SUFFIXES[name]:
            raise OutputError(must_be("suffix", f"output {path}", SUFFIXES[name],
                                      f"'{path.suffix}'"))
        write_map(data, path)
        return
    where = f"map {data.encoding['source']}" if "source" in data.encoding else "map"
    content = GRIDS[name](grid_of(data, where))
    with atomic(path) as temporary:
        temporary.write_bytes(content)


def _joined(lines: Iterable[str]) -> bytes:
    return "\n".join([*lines, ""]).encode()
