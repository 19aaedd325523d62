"""Labelled data written as HDF5."""

from __future__ import annotations

import io
from pathlib import Path

import xarray as xr

from halbach_fe.core.files import _write_bytes, atomic


def write_hdf5(data: xr.Dataset, path: Path) -> None:
    """Write any labelled data as HDF5, whole or not at all; raise OutputError."""
    with atomic(path) as temporary:
        _write_bytes(_hdf5(data), temporary)


def _hdf5(data: xr.Dataset) -> bytes:
    """HDF5 in memory: the library crashes when a disk fills up under its open file."""
    buffer = io.BytesIO()
    data.to_netcdf(buffer, engine="h5netcdf")
    return buffer.getvalue()
