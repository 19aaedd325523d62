"""Safe reading of HDF5 files and meshes of unknown origin, and atomic writing of HDF5.

The libraries h5py, xarray and meshio parse these files. Any exception that they raise becomes a
ValueError of one line; their output and warnings are suppressed. An HDF5 file can refer to data in
other files, and can declare far more data than it holds: both are refused before data is read. None
of these functions executes code from a file (no unpickling).

Stored results are used again: a posterior by `halbach-fe multipoles`, a response matrix and Markov
chains by the next run. HDF5 does not notice a changed bit in its data, so such a file holds a
checksum of its content (`with_checksum`), which is verified when it is read (`read_hdf5`).
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import re
import threading
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import meshio
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.files import atomic
from halbach_fe.core.installation import import_extra

_OUTPUT_LOCK = threading.RLock()
"""Held while output and warnings are suppressed, because both are global to the process."""


def read_dataset(path: Path, group: str | None = None) -> xr.Dataset:
    """Read the labelled data of an HDF5 file, or of one of its groups, into memory.

    The file is read once, so that what is checked is what is used.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If the file is damaged, or refused for a reason that `open_hdf5` lists.
    """
    content = io.BytesIO(path.read_bytes())
    with open_hdf5(content):
        pass
    content.seek(0)
    with _refusing(), xr.open_dataset(content, group=group, engine="h5netcdf",
                                      phony_dims="sort") as opened:
        return opened.load()


NO_VALUE = re.compile(rb'<c r="([A-Z]{1,3}\d{1,7})"(?![^>]*t="str")[^>]*>\s*'
                      rb'<f[^>]*(?:/>|>[^<]*</f>)\s*(?:<v\s*/>|<v></v>)?\s*</c>')
"""A cell of a workbook with a formula of a number and without its value when it was saved."""


def sheet_text(raw: bytes, decimal_comma: bool) -> tuple[bytes, str, list[str]]:
    """Return a sheet of an Excel workbook (.xlsx) as CSV in UTF-8, its name, and those of others.

    It is the first one with two rows of numbers, else the first with cells; the others are all
    that have such rows too, or a formula without a value. Cells are separated by semicolons;
    numbers have a ``decimal_comma``, if those that are texts have one. Formulas have the values
    that the workbook was saved with.

    Raises
    ------
    ExtraMissingError
        If openpyxl, which reads it, is not installed.
    ValueError
        If the file is damaged, larger than 200 million cells or bytes, or the sheet has a formula
        without a value.
    """
    max_sheet = 200_000_000  # size in bytes of the largest unpacked workbook that is read
    openpyxl = import_extra("openpyxl", "spreadsheet",
                            "A workbook that is not saved as CSV needs the package openpyxl")
    with _refusing():
        with zipfile.ZipFile(io.BytesIO(raw)) as packed:
            if sum(part.file_size for part in packed.infolist()) > max_sheet:
                raise ValueError(f"it unpacks to more than {max_sheet} bytes")
            without_value = {name: found[1].decode() for name in packed.namelist()
                             if name.startswith("xl/worksheets/")
                             and (found := NO_VALUE.search(packed.read(name)))}
        book = openpyxl.load_workbook(io.BytesIO(raw), read_only=True, data_only=True)
        first: tuple[bytes, str, str] | None = None
        chosen: tuple[bytes, str, str] | None = None
        others = []
        for sheet in book.worksheets:
            formula = without_value.get(sheet._worksheet_path.lstrip("/"), "")
            values = list(sheet.iter_rows(values_only=True))
            rows = [["" if cell is None else str(cell).replace(".", ",")
                     if decimal_comma and isinstance(cell, float) else str(cell)
                     for cell in row] for row in values]
            width = max((n for row in rows for n, cell in enumerate(row, 1) if cell), default=0)
            of_numbers = sum(sum(isinstance(cell, int | float) for cell in row) > 1
                             for row in values) > 1
            if formula or (of_numbers and chosen):
                others.append(sheet.title)
            if not (width or formula) or (of_numbers and chosen):
                continue
            text = io.StringIO()
            csv.writer(text, delimiter=";", lineterminator="\n").writerows(
                [*row, *[""] * width][:width] for row in rows if any(row))
            this = text.getvalue().encode(), str(sheet.title), formula
            if first is None or (formula and not first[2]):  # numbers may be in these alone
                first = this
            chosen = chosen or (this if of_numbers else None)
        if first is None:
            raise ValueError("it has no sheet with cells")
        content, title, formula = chosen or first
        if formula:
            raise ValueError(f"the formula in {formula} has no value")
    return content, title, [other for other in others if other != title]


def finite_array(data: xr.DataArray, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return values as floats; raise ValueError if their shape differs or one is not finite."""
    values = np.asarray(data.values, float)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"it must be {shape} finite numbers")
    return values


@contextlib.contextmanager
def open_hdf5(file: BinaryIO) -> Iterator[Any]:
    """Open an HDF5 file as an `h5py.File` after checking that it is safe to read.

    Raises
    ------
    ValueError
        If the file is damaged, takes data from other files (external links, external storage,
        virtual datasets), holds data that are neither numbers nor text, or declares more data
        than a file of its size can hold.
    """
    with _refusing():
        size = _check_heaps(file)
        opened = h5py.File(file, "r")
    # size of the uncompressed data that an HDF5 file of any size may declare
    always_allowed_bytes = 1 << 26
    # largest ratio of declared data to the file's size, if it is more than that.
    # Files that halbach-fe writes are not compressed at all.
    max_compression_ratio = 100
    with opened, np.errstate(all="ignore"):
        with _refusing():
            _check(opened, max(always_allowed_bytes, max_compression_ratio * size))
        yield opened


GMSH_TYPES = {1: ("line", [0, 1]), 3: ("quad", [0, 1, 2, 3]), 8: ("line3", [0, 1, 2]),
              9: ("triangle6", [0, 1, 2, 3, 4, 5]), 11: ("tetra10", [0, 1, 2, 3, 4, 5, 6, 7, 9, 8])}
"""meshio's name and order of the nodes, by Gmsh's number of a type of elements."""


def read_mesh(path: Path) -> meshio.Mesh:
    """Read a mesh or table file: Gmsh's binary meshes as arrays, all else with meshio.

    Raises
    ------
    ValueError
        If meshio cannot read the file. (It calls `sys.exit` for some damaged files.)
    """
    with _refusing():
        mesh = _binary_mesh(path.read_bytes()) if path.suffix == ".msh" else None
        return mesh or meshio.read(path)


def _binary_mesh(raw: bytes) -> meshio.Mesh | None:
    """Read a mesh in format MSH 2.2; return None if anything is not as Gmsh writes it.

    Gmsh writes a header before every element, and meshio reads as many small arrays.
    """
    start = re.match(rb"\$MeshFormat\n2\.2 1 8\n\x01\0{3}\n\$EndMeshFormat\n"
                     rb"\$Nodes\n(\d{1,9})\n", raw)
    node = np.dtype([("number", "<i4"), ("x_m", "<f8", (3,))])
    end = start.end() + int(start[1]) * node.itemsize if start else 0
    middle = re.compile(rb"\n\$EndNodes\n\$Elements\n(\d{1,9})\n").match(raw, end)
    if not start or not middle:
        return None
    nodes = np.frombuffer(raw, node, int(start[1]), start.end())
    cells: list[tuple[str, NDArray[np.int32]]] = []
    tags, left, place = [], int(middle[1]), middle.end()
    while left > 0:
        rows = _rows_alike(np.frombuffer(raw, "<i4", (len(raw) - place) // 4, place), left)
        if rows is None or len(cells) == len(GMSH_TYPES):
            return None
        kind, order = GMSH_TYPES[int(rows[0, 0])]
        cells.append((kind, rows[:, -len(order):][:, order] - 1))
        tags.append(rows[:, 4])
        left, place = left - len(rows), place + rows.nbytes
    if (not cells or not raw.startswith(b"\n$EndElements", place)
            or not np.array_equal(nodes["number"], np.arange(1, len(nodes) + 1))
            or any(data.min() < 0 or data.max() >= len(nodes) for _, data in cells)):
        return None
    return meshio.Mesh(np.ascontiguousarray(nodes["x_m"]), cells,
                       cell_data={"gmsh:physical": tags})


def _rows_alike(words: NDArray[np.int32], most: int) -> NDArray[np.int32] | None:
    """Return the first elements of one type, (n, 3 + 1 + tags + nodes); None if there are none.

    Every element is a row of its type, 1, the number of its tags, its number, tags, and nodes.
    """
    if len(words) < 3 or int(words[0]) not in GMSH_TYPES or words[1] != 1 or not 1 <= words[2] < 9:
        return None
    width = 4 + int(words[2]) + len(GMSH_TYPES[int(words[0])][1])
    rows = words[:min(most, len(words) // width) * width].reshape(-1, width)
    other = (rows[:, :3] != words[:3]).any(axis=1)
    return rows[:int(np.argmax(other))] if other.any() else rows if len(rows) else None


def _check_heaps(file: BinaryIO) -> int:
    """Refuse global heaps on which HDF5 2.0 would loop for ever; return the size of the file.

    A global heap is a sequence of objects, each after a header of 16 bytes with its index and
    length. The object of index 0 is the free space; its length includes the header (HDF5 File
    Format Specification, III.E), so that a length below 16 never moves a reader forward.
    """
    raw = file.read()
    for heap in re.finditer(rb"GCOL\x01\0{3}", raw):
        place, end = heap.end() + 8, heap.start() + int.from_bytes(
            raw[heap.end():heap.end() + 8], "little")
        while place + 16 <= min(end, len(raw)):
            free = raw[place:place + 2] == b"\0\0"
            length = int.from_bytes(raw[place + 8:place + 16], "little")
            if free and length < 16:
                raise ValueError("it has a heap without end")
            place += length if free else 16 + -(-length // 8) * 8
    return len(raw)


def _check(file: Any, limit: int) -> None:
    """Raise ValueError if an open file is unsafe, or declares more than ``limit`` bytes of data."""
    if file.id.get_create_plist().get_sizes() != (8, 8):
        raise ValueError("its addresses are not of eight bytes")
    waiting, found, promised = [file], 0, 0
    # largest number of groups and datasets of an HDF5 file: groups can contain one another in an
    # endless cycle
    max_objects = 10_000
    while waiting:
        group = waiting.pop()
        for name in group:
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.SoftLink):  # an alias: its target is visited by its own name
                continue
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"`{name}` is in another file")
            node = group[name]
            found += 1
            if found > max_objects:
                raise ValueError(f"it holds more than {max_objects} objects")
            if isinstance(node, h5py.Group):
                waiting.append(node)
            elif isinstance(node, h5py.Dataset):
                if node.external or node.is_virtual:
                    raise ValueError(f"`{name}` takes its data from another file")
                _check_kind(node.dtype, name)
                promised += (node.size or 0) * max(1, node.dtype.itemsize)
                if promised > limit:
                    raise ValueError(f"`{name}` would be {promised:.2g} bytes, in a file too small "
                                     "for that")


def _check_kind(kind: np.dtype[Any], name: str) -> None:
    """Refuse types other than numbers and text: overlapping compound fields crash HDF5."""
    if h5py.check_string_dtype(kind) is None and (kind.kind not in "biufcS" or (
            kind.itemsize > (16 if kind.kind == "c" else 8))):
        raise ValueError(f"`{name}` holds neither numbers nor text")


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """Turn any exception of a library into a ValueError of one line, and suppress its output."""
    silent = io.StringIO()
    try:
        with (_OUTPUT_LOCK, warnings.catch_warnings(), contextlib.redirect_stdout(silent),
              contextlib.redirect_stderr(silent)):
            warnings.simplefilter("ignore")
            yield
    except MemoryError:
        raise
    except SystemExit:  # meshio ends the program on some damaged files
        raise ValueError("damaged") from None
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise ValueError(reason) from None


CHECKSUM = "content_sha256"
"""Attribute that holds the checksum, see `checksum`."""


class ChangedContentError(ValueError):
    """The content of a stored file is not what was written."""


def write_hdf5(data: xr.Dataset, path: Path) -> None:
    """Write labelled data as an HDF5 file atomically; raise OutputError on failure."""
    with atomic(path) as temporary:
        temporary.write_bytes(hdf5_bytes(data))


def with_checksum(data: xr.Dataset) -> xr.Dataset:
    """Return labelled data with their checksum as an attribute."""
    return data.assign_attrs({CHECKSUM: checksum(data)})


def read_hdf5(path: Path, group: str | None = None) -> xr.Dataset:
    """Read labelled data that were stored with their checksum, or one group of them.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ChangedContentError
        If the content differs from its checksum, or has none (older versions wrote none).
    ValueError
        If the file is damaged, or refused for a reason that `open_hdf5` lists.
    """
    data = read_dataset(path, group)
    stored = data.attrs.pop(CHECKSUM, None)
    if stored is None:
        raise ChangedContentError("it has no checksum, like files of older versions")
    if stored != checksum(data):
        raise ChangedContentError("its content differs from its checksum")
    return data


def checksum(data: xr.Dataset) -> str:
    """Return the SHA-256 of names, dimensions, attributes and values of labelled data."""
    digest = hashlib.sha256(_attributes(data.attrs))
    for name in sorted(map(str, data.variables)):
        variable = data.variables[name]
        values = np.ascontiguousarray(variable.values)
        text = values.dtype.kind in "OSUT"
        digest.update(json.dumps([
            name, variable.dims, values.shape, "text" if text else values.dtype.name]).encode())
        digest.update(_attributes(variable.attrs))
        digest.update(json.dumps(values.astype(str).tolist()).encode() if text else
                      values.astype(values.dtype.newbyteorder("<"), copy=False).reshape(-1).view(
                          np.uint8).data)
    return digest.hexdigest()


def _attributes(attributes: dict[str, object]) -> bytes:
    """Return attributes as bytes, the same for Python's values and for those that HDF5 returns."""
    plain = {str(key): np.asarray(value).tolist() for key, value in attributes.items()}
    return json.dumps(plain, sort_keys=True).encode()


def hdf5_bytes(data: xr.Dataset) -> bytes:
    """Return the HDF5 file in memory: the HDF5 library crashes if the disk fills up under it."""
    buffer = io.BytesIO()
    data.to_netcdf(buffer, engine="h5netcdf")
    return buffer.getvalue()
