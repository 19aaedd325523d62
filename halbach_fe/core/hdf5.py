"""Atomic writing of labelled data as HDF5, and reading of what was written, verified.

Stored results are used again: a posterior by `halbach-fe multipoles`, a response matrix and Markov
chains by the next run. HDF5 does not notice a changed bit in its data, so such a file holds a
checksum of its content (`with_checksum`), which is verified when it is read (`read_hdf5`).
"""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.core import untrusted
from halbach_fe.core.files import _write_bytes, atomic

CHECKSUM = "content_sha256"
"""Attribute that holds the checksum, see `checksum`."""


class ChangedContentError(ValueError):
    """The content of a stored file is not what was written."""


def write_hdf5(data: xr.Dataset, path: Path) -> None:
    """Write labelled data as an HDF5 file atomically; raise OutputError on failure."""
    with atomic(path) as temporary:
        _write_bytes(_hdf5(data), temporary)


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
        If the file is damaged, or refused for a reason that `untrusted.open_hdf5` lists.
    """
    data = untrusted.read_dataset(path, group)
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


def _hdf5(data: xr.Dataset) -> bytes:
    """Return the HDF5 file in memory: the HDF5 library crashes if the disk fills up under it."""
    buffer = io.BytesIO()
    data.to_netcdf(buffer, engine="h5netcdf")
    return buffer.getvalue()
