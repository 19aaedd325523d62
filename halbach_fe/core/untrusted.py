"""Files that libraries read for us, and what these must not do with files of unknown origin.

Whatever a library raises becomes ValueError with one line; what it prints or warns of is dropped.
HDF5 files can name other files to take data from, and can promise any amount of data: both are
refused before anything is read. No such file holds code: nothing here unpickles.
"""

from __future__ import annotations

import contextlib
import io
import re
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import meshio
import numpy as np
import xarray as xr
from numpy.typing import NDArray

SMALL = 1 << 26
"""Bytes of data that any file may promise."""

MOST_COMPRESSED = 100
"""Times a file's size, of data in it, beyond `SMALL`. Ours are not compressed at all."""

_ALONE = threading.RLock()
"""Where output goes, and whether there are warnings, is one thing for all threads."""

MAX_OBJECTS = 10_000
"""Of an HDF5 file; groups may contain one another without end."""


def read_dataset(path: Path, group: str | None = None) -> xr.Dataset:
    """Labelled data of an HDF5 file, or one of its groups, in memory.

    Raises
    ------
    OSError
        If there is no such file.
    ValueError
        If it is damaged, or refused as `open_hdf5` says.
    """
    with path.open("rb") as file, open_hdf5(file):
        pass
    with _refusing(), xr.open_dataset(path, group=group, engine="h5netcdf",
                                      phony_dims="sort") as opened:
        return opened.load()


def finite_array(data: xr.DataArray, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Values of just this shape, all of them finite; ValueError for any others."""
    values = np.asarray(data.values, float)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"it must be {shape} finite numbers")
    return values


@contextlib.contextmanager
def open_hdf5(file: BinaryIO) -> Iterator[Any]:
    """Open an HDF5 file.

    Raises
    ------
    ValueError
        If they are damaged, take data from other files (external links, external storage, virtual
        datasets), hold objects that are no text, or promise more than a file of this size can hold.
    """
    with _refusing():
        size = _check_heaps(file)
        opened = h5py.File(file, "r")
    with opened, np.errstate(all="ignore"):
        with _refusing():
            _check(opened, max(SMALL, MOST_COMPRESSED * size))
        yield opened


def read_mesh(path: Path) -> meshio.Mesh:
    """A file that meshio reads.

    Raises
    ------
    ValueError
        If meshio does not, or ends the program, as it does for some.
    """
    with _refusing():
        return meshio.read(path)


def _check_heaps(file: BinaryIO) -> int:
    """Refuse heaps in which HDF5 2.0 would go round for ever; return the size of the file.

    A heap is a chain of objects, each with index and length in 16 bytes before it; one of index 0
    is free space, its length that of all (HDF5 File Format Specification, III.E).
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
    if file.id.get_create_plist().get_sizes() != (8, 8):
        raise ValueError("its addresses are not of eight bytes")
    waiting, found, promised = [file], 0, 0
    while waiting:
        group = waiting.pop()
        for name in group:
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.SoftLink):  # what it is another name of comes by itself
                continue
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"`{name}` is in another file")
            node = group[name]
            found += 1
            if found > MAX_OBJECTS:
                raise ValueError(f"it holds more than {MAX_OBJECTS} objects")
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
    """Refuse what is neither numbers nor text: fields that overlap crash the HDF5 library."""
    if h5py.check_string_dtype(kind) is None and (kind.kind not in "biufcS" or (
            kind.itemsize > (16 if kind.kind == "c" else 8))):
        raise ValueError(f"`{name}` holds neither numbers nor text")


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """Turn what a library does with a bad file into one ValueError."""
    silent = io.StringIO()
    try:
        with (_ALONE, warnings.catch_warnings(), contextlib.redirect_stdout(silent),
              contextlib.redirect_stderr(silent)):
            warnings.simplefilter("ignore")
            yield
    except MemoryError:
        raise
    except SystemExit:  # meshio's way to say so
        raise ValueError("damaged") from None
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise ValueError(reason) from None
