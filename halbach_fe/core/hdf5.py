"""Atomic writing of labelled data as HDF5."""

from __future__ import annotations

import io
from pathlib import Path

import xarray as xr

from halbach_fe.core.files import _write_bytes, atomic


def write_hdf5(data: xr.Dataset, path: Path) -> None:
    """Write labelled data as an HDF5 file atomically; raise OutputError on failure."""
    with atomic(path) as temporary:
        _write_bytes(_hdf5(data), temporary)


def _hdf5(data: xr.Dataset) -> bytes:
    """Return the HDF5 file in memory: the HDF5 library crashes if the disk fills up under it."""
    buffer = io.BytesIO()
    data.to_netcdf(buffer, engine="h5netcdf")
    return buffer.getvalue()
