"""Small files that promise much: ``python -m tests.fuzz.bombs`` reads them with little memory.

Prints what is said against each, as JSON. It is a program of its own since the limit is that of a
process.
"""

from __future__ import annotations

import io
import json
import os
import resource
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import xarray as xr

from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.formats.grid_formats import grid_of
from halbach_fe.measurement.formats.openpmd import content as openpmd_content
from tests.fuzz.contract import BrokenError, refusal
from tests.fuzz.readers import by_name, edge_elements
from tests.measurement.test_import_map import FIELD, POINTS

SECRET = b"root:x:0:0:what no reader may show, 0123456789" * 3
MEMORY = 1 << 29
"""Bytes beside what the program itself has; no file here is larger than 200 kB."""


def hdf5(fill: Callable[[h5py.File], object], **options: object) -> bytes:
    """A map with something else in it."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", **options) as file:
        for name in ("x_m", "y_m", "z_m"):
            file[name] = [0.0, 1.0]
        file["component"] = ["x", "y", "z"]
        fill(file)
    return buffer.getvalue()


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(shape=(2, 3), dtype="f8")
    layout[:] = h5py.VirtualSource("secret.h5", "B_T", shape=(2, 3))
    file.create_virtual_dataset("B_T", layout)


def _cycle(file: h5py.File) -> None:
    file["B_T"] = np.ones((2, 3))
    file["again"] = file["/"]


def _objects(file: h5py.File) -> None:
    file.create_dataset("B_T", (2, 3), h5py.vlen_dtype(np.dtype("f8")))


def _compound(file: h5py.File) -> None:
    """Numbers of two parts; where parts overlap, the HDF5 library writes where it must not."""
    kind = h5py.h5t.create(h5py.h5t.COMPOUND, 16)
    kind.insert(b"r", 0, h5py.h5t.IEEE_F64LE)
    kind.insert(b"i", 8, h5py.h5t.IEEE_F64LE)
    kind.set_size(24)
    h5py.h5d.create(file.id, b"B_T", kind, h5py.h5s.create_simple((2, 3)))


def _promise(file: h5py.File) -> None:
    file.create_dataset("B_T", (10**11, 3), "f8", chunks=(1024, 3))


def _zeros(file: h5py.File) -> None:
    file.create_dataset("B_T", data=np.zeros((3_000_000, 3)), chunks=(100_000, 3),
                        compression="gzip", compression_opts=9)


def _field_mesh(size: int, shape: object) -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.attrs["externalFieldPath"] = "/mesh"
        mesh = file.create_group("mesh")
        mesh.attrs.update({
            "gridGeometry": "rectangular", "eleAnchorPt": "center", "harmonic": 0,
            "axisLabels": ["x", "y", "z"], "gridSize": [size] * 3, "gridSpacing": [1e-3] * 3,
            "gridOriginOffset": [0.0] * 3, "gridLowerBound": [0] * 3})
        record = mesh.create_group("magneticField/x")
        record.attrs.update({"shape": shape, "value": 1.0, "unitSI": 1.0,
                             "unitDimension": [0, 1, -2, -1, 0, 0, 0]})
    return buffer.getvalue()


def laughs(levels: int) -> bytes:
    """The billion laughs."""
    entities = "".join(f'<!ENTITY a{n + 1} "{f"&a{n};" * 10}">' for n in range(levels))
    return (f'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a0 "lol">{entities}]>'
            f'<VTKFile type="UnstructuredGrid">&a{levels};</VTKFile>').encode()


def foreign_entity(target: str) -> bytes:
    """XML that would show another file."""
    return (f'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "{target}">]>'
            '<VTKFile type="UnstructuredGrid">&b;</VTKFile>').encode()


def overlapping() -> bytes:
    """Complex numbers, of which one part is longer than its place: its exponent has another bias.

    Read as they are, they crash the program.
    """
    usual, other = (1023).to_bytes(4, "little"), (1792).to_bytes(4, "little")
    parts = openpmd_content(grid_of(field_map(POINTS, FIELD), "map")).split(usual)
    return usual.join(parts[:-4]) + other + usual.join(parts[-4:])  # that of the z component


def endless() -> bytes:
    """A map with a heap whose free space is nothing long: reading it, HDF5 goes round for ever."""
    sound = hdf5(lambda file: file.attrs.__setitem__("note", "text of any length"))
    place = sound.index(b"GCOL\1\0\0\0") + 16
    return sound[:place] + bytes(16) + sound[place + 16:]


PETSC = np.array([1211214, 2**31 - 1], ">i4").tobytes()
MATRIX = np.array([1211216, 3, 3, 2**31 - 1, 1, 1, 1], ">i4").tobytes()
STUDY = b'name = "a"\ndimension = 3\n'

BOMBS: dict[str, tuple[str, bytes]] = {
    "rows that are not there": ("map (HDF5)", hdf5(_promise)),
    "rows of zeros, compressed": ("map (HDF5)", hdf5(_zeros)),
    "groups in a circle": ("map (HDF5)", hdf5(_cycle)),
    "lists of numbers in each cell": ("map (HDF5)", hdf5(_objects)),
    "a heap without end": ("map (HDF5)", endless()),
    "numbers that overlap": ("import: openpmd", overlapping()),
    "numbers made of parts": ("map (HDF5)", hdf5(_compound)),
    "data of another file": ("map (HDF5)", hdf5(lambda file: file.create_dataset(
        "B_T", (2, 3), "f8", external=[("secret.txt", 0, 48)]))),
    "a link to another file": ("map (HDF5)", hdf5(lambda file: file.__setitem__(
        "B_T", h5py.ExternalLink("secret.h5", "/B_T")))),
    "a view of another file": ("map (HDF5)", hdf5(_virtual)),
    "a posterior that is not there": ("posterior", hdf5(_promise)),
    "a grid of 1e18 points": ("import: openpmd", _field_mesh(1_000_000, [1_000_000] * 3)),
    "a constant of 1e18 points": ("import: openpmd", _field_mesh(10, [1_000_000] * 3)),
    "laughs": ("map (VTU)", laughs(12)),
    "a few laughs": ("map (VTU)", laughs(6)),
    "another file as an entity": ("map (VTU)", foreign_entity("secret.txt")),
    "a vector of 2**31 numbers": ("GetDP: solutions", PETSC),
    "a matrix of 2**31 numbers": ("GetDP: matrix", MATRIX),
    "an unknown of node 1e15": ("GetDP: unknowns of edges", edge_elements().replace(
        b"1 8 0 2 0 0", b"1 1000000000000000 0 2 0 0")),
    "2e9 nodes": ("mesh", b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n2000000000\n1 0 0 0\n"
                          b"$EndNodes\n$Elements\n1\n1 15 2 1 1 1\n$EndElements\n"),
    "1e9 rings": ("study", STUDY + b"array = { rings = 1000000000 }"),
    "levels": ("study", STUDY + b"a = " + b"[" * 50_000),
    "levels of tables": ("study", STUDY + b"a = " + b"{a=" * 50_000),
    "a long integer": ("study", STUDY + b"array = { rings = 0x" + b"f" * 100_000 + b" }"),
    "a grid of 1e5 x 1e5 points": ("import: comsol", b"% Dimension: 3\n% Version: 6\n% Grid\n" + (
        b" ".join(b"%d" % n for n in range(10_000)) + b"\n") * 2 + b"0\n% Data (Bx (T))\n1\n"),
    "a field without end": ("map (CSV)", b"x_m,y_m,z_m,Bx_T\n0,0,0," + b"1" * 200_000),
}


def unguarded(path: Path) -> object:
    """The negative control: as xarray reads by itself."""
    with xr.open_dataset(path, engine="h5netcdf", phony_dims="sort") as data:
        return data.load()


def main() -> int:
    """Read all of them, and those in HDF5 without our guard too."""
    readers = {name: by_name(name) for name, _ in BOMBS.values()}  # with all memory there is
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    found = {}
    with tempfile.TemporaryDirectory() as above:
        folder = Path(above, "folder")
        folder.mkdir()
        os.chdir(folder)
        (folder / "secret.txt").write_bytes(SECRET)
        with h5py.File(folder / "secret.h5", "w") as file:
            file["B_T"] = np.ones((2, 3))
        for name, (reader, content) in BOMBS.items():
            readers[f"{reader}, unguarded"] = replace(readers[reader], read=unguarded)
            controlled = reader == "map (HDF5)" and name != "a heap without end"
            for kind in (reader, f"{reader}, unguarded")[:1 + controlled]:
                try:
                    said = refusal(readers[kind], content, folder)
                except BrokenError as error:
                    said = f"broken: {error.kind}"
                found[name if kind == reader else f"{name}, unguarded"] = said
    sys.stdout.write(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
