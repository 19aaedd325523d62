"""Stored results: what was written is read, and nothing else."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import xarray as xr

from halbach_fe.core.untrusted_files import (
    ChangedContentError,
    read_hdf5,
    with_checksum,
    write_hdf5,
)


def stored() -> xr.Dataset:
    return xr.Dataset(
        {"H": (("reading", "parameter"), np.array([[1e-9, np.nan], [-0.0, np.inf]]),
               {"units": "T m/A"}),
         "column": ("parameter", np.array([3, 4], np.int32)),
         "held_out": ("reading", np.array([True, False])), "scalar": 2.5},
        coords={"parameter": ["r01s01.Mx", "r01s01.My"]},
        attrs={"key": "abc", "solves": 7, "error": 1e-17, "list": [1.0, 2.0]})


def test_what_was_written_is_read(tmp_path):
    write_hdf5(with_checksum(stored()), tmp_path / "a.h5")
    found = read_hdf5(tmp_path / "a.h5")
    assert found.attrs["key"] == "abc"
    np.testing.assert_array_equal(found["H"], stored()["H"])
    # and once more, from what was read
    write_hdf5(with_checksum(found), tmp_path / "b.h5")
    xr.testing.assert_identical(read_hdf5(tmp_path / "b.h5"), found)


@pytest.mark.parametrize("change", [
    lambda file: file["H"].write_direct(np.array([[1.0000000000000002e-9, np.nan], [0.0, np.inf]])),
    lambda file: file["H"].__setitem__((1, 0), 0.0),  # -0.0 became 0.0: one bit
    lambda file: file["column"].__setitem__(0, 5),
    lambda file: file["held_out"].__setitem__(0, False),
    lambda file: file["parameter"].__setitem__(0, "r01s02.Mx"),
    lambda file: file.attrs.__setitem__("key", "abd"),
    lambda file: file["H"].attrs.__setitem__("units", "T"),
    lambda file: file.attrs.__delitem__("content_sha256"),
], ids=["value", "sign", "integer", "truth", "text", "attribute", "unit", "no checksum"])
def test_every_change_is_noticed(tmp_path, change):
    path = tmp_path / "a.h5"
    write_hdf5(with_checksum(stored()), path)
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(ChangedContentError, match="checksum"):
        read_hdf5(path)
