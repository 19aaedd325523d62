"""Import and export of static magnetic field meshes of openPMD-beamphysics, in HDF5.

Sources: openPMD-standard, EXT_BeamPhysics, External Mesh Fields; and, where the standard leaves a
point open, the package openpmd-beamphysics. `axisLabels` is the order of the axes of the data (in
older files `gridDataOrder` F means the reversed order); `gridSize`, `gridSpacing`,
`gridOriginOffset` and `gridLowerBound` are always in the order x, y, z. Point i of an axis is at
gridOriginOffset + (gridLowerBound + i) gridSpacing from the anchor. A component that is not in the
file is zero.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import h5py
import numpy as np

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.formats.column_names import in_units
from halbach_fe.measurement.formats.columns_to_map import ForeignTable
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.grid_formats import Grid
from halbach_fe.study.types import COMPONENTS

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file."""
TESLA = (0.0, 1.0, -2.0, -1.0, 0.0, 0.0, 0.0)
"""Unit dimension of a flux density: powers of m, kg, s, A, K, mol and cd."""
AXES: dict[str, tuple[str, ...]] = {"rectangular": COMPONENTS, "cylindrical": ("r", "theta", "z")}
"""Axes of the geometries that are read; theta is in rad."""
MAX_POINTS = 10_000_000
"""Largest number of points that is read. A small file may state any number, for which memory would
be allocated."""
PATH = "/ExternalFieldMesh/%T/"


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read the single field mesh of a file.

    Raises
    ------
    MeasurementError
        If the file has no mesh or several, or the mesh is not that of a static magnetic field on a
        rectangular grid.
    """
    try:
        with untrusted_files.open_hdf5(io.BytesIO(raw)) as file:
            return _table(_only_mesh(file, where), where)
    except MeasurementError:
        raise
    except Exception as error:  # a damaged file makes h5py raise exceptions of any type
        raise MeasurementError(must_be("content", where, "a whole openPMD file",
                                       f"'{(str(error).splitlines() or [''])[0][:200]}'")) from None


def is_map(raw: bytes) -> bool:
    """Return whether an HDF5 file holds a map of halbach-fe, which is no file of openPMD."""
    try:
        with untrusted_files.open_hdf5(io.BytesIO(raw)) as file:
            return "B_T" in file and "externalFieldPath" not in file.attrs
    except Exception:  # a damaged file makes h5py raise exceptions of any type
        return False


def content(grid: Grid) -> bytes:
    """Return the content of a file with the field of a grid, anchored at the magnet's centre."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        _describe(file, {"dataType": "openPMD", "openPMD": "2.0.0",
                         "openPMDextension": "BeamPhysics", "externalFieldPath": PATH})
        mesh = file.create_group(PATH.replace("%T", "01"))
        _describe(mesh, {
            "eleAnchorPt": "center", "gridGeometry": "rectangular", "axisLabels": COMPONENTS,
            "gridLowerBound": np.zeros(3, int), "gridSize": np.array(grid.shape),
            "gridSpacing": grid.spacing, "gridOriginOffset": [axis[0] for axis in grid.axes],
            "harmonic": 0, "fundamentalFrequency": 0.0})
        for index, name in enumerate(COMPONENTS):
            data = mesh.create_dataset(f"magneticField/{name}",
                                       data=grid.field[..., index].astype(complex))
            _describe(data, {"unitSI": 1.0, "unitDimension": TESLA, "unitSymbol": "T"})
    return buffer.getvalue()


def _describe(node: Any, attributes: Mapping[str, Any]) -> None:
    """Set attributes; text is stored as bytes, as openpmd-beamphysics and Bmad do."""
    for key, value in attributes.items():
        array = np.asarray(value)
        node.attrs[key] = array.astype(np.bytes_) if array.dtype.kind == "U" else value


def _only_mesh(file: Any, where: str) -> Any:
    """Return the group of the single field mesh."""
    if "externalFieldPath" not in file.attrs:
        raise MeasurementError(must_be(
            "attribute", where, "`externalFieldPath`, of a field mesh of openPMD-beamphysics",
            "a file without it", "Write other HDF5 as CSV with a row x, y, z, Bx, By, Bz for each "
            "point, by h5py and numpy.savetxt."))
    path = str(_text(file.attrs["externalFieldPath"]))
    base, wild, _ = path.partition("%T")
    names = sorted(file[base]) if wild else [""]
    if len(names) != 1:
        raise MeasurementError(must_be("content", where, "one field mesh", f"{len(names)}"))
    return file[base + names[0]]


def _table(mesh: Any, where: str) -> ForeignTable:
    """Return positions and field of a mesh as a table."""
    attributes = {key: _text(value) for key, value in mesh.attrs.items()}
    _check(attributes, where)
    size = [int(count) for count in _vector(attributes, "gridSize", where)]
    if min(size) < 1 or np.prod([float(count) for count in size]) > MAX_POINTS:
        raise MeasurementError(must_be("`gridSize`", where, f"of 1 to {MAX_POINTS} points",
                                       " x ".join(map(str, size))))
    origin, spacing, lower = (_vector(attributes, name, where) for name in (
        "gridOriginOffset", "gridSpacing", "gridLowerBound"))
    axes = [start + (first + np.arange(count)) * step for start, first, count, step in zip(
        origin, lower, size, spacing, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    labels = tuple(map(str, np.atleast_1d(attributes["axisLabels"])))
    names = AXES[attributes["gridGeometry"]]
    scale = float(attributes.get("fieldScale", 1.0))
    field = np.column_stack([
        scale * _component(mesh["magneticField"], name, names, labels, size, where).ravel()
        for name in names])
    anchor = str(attributes["eleAnchorPt"])
    own = [{"theta": "phi"}.get(name, name) for name in names]
    columns = tuple(replace(column, unit="rad") if column.text == "phi" else column
                    for column in in_units((*own, *(f"B{name}" for name in own)), "m"))
    symmetric = names != COMPONENTS and size[1] == 1
    return ForeignTable(
        columns, np.hstack([points, field]), where,
        anchor="" if anchor == "center"
        else f"the '{anchor[:20]}' of the element, from which it counts,",
        remarks=("The file is of a field with rotational symmetry about z: the map has its points "
                 "once, at the angle of the file.",) if symmetric else ())


def _check(attributes: Mapping[str, Any], where: str) -> None:
    """Raise MeasurementError unless the mesh is a static field on a grid of `AXES`."""
    needed = ("gridGeometry", "eleAnchorPt", "axisLabels", "gridSize", "gridSpacing",
              "gridOriginOffset", "gridLowerBound", "harmonic")
    for name in needed:
        if name not in attributes:
            raise MeasurementError(must_be("attribute", where, f"`{name}`", "a mesh without it"))
    allowed: dict[str, tuple[Any, str]] = {
        "harmonic": (0, "0, a static field"),
        "gridCurvatureRadius": (0, "0, a straight grid"), "RFphase": (0, "0, a static field"),
        "gridUnitSI": (1, "1, in metres")}
    for name, (value, expected) in allowed.items():
        if name in attributes and attributes[name] != value:
            raise MeasurementError(must_be(f"`{name}`", where, expected,
                                           f"{str(attributes[name])[:40]}"))
    geometry = str(attributes["gridGeometry"])
    if geometry not in AXES:
        raise MeasurementError(must_be("`gridGeometry`", where, " or ".join(AXES), geometry[:40]))
    labels = sorted(map(str, np.atleast_1d(attributes["axisLabels"])))
    if labels != sorted(AXES[geometry]):
        raise MeasurementError(must_be(
            "`axisLabels`", where, "{}, {} and {} in some order".format(*AXES[geometry]),
            ", ".join(labels)[:40]))


def _vector(attributes: Mapping[str, Any], name: str, where: str) -> Floats:
    """Return an attribute of three finite numbers."""
    values = np.atleast_1d(np.asarray(attributes[name], float))
    if values.shape != (3,) or not (np.abs(values) < 1e12).all():
        raise MeasurementError(must_be(f"`{name}`", where, "three finite numbers",
                                       f"{attributes[name]}"[:60]))
    return values


def _component(
    record: Any, name: str, names: tuple[str, ...], labels: tuple[str, ...], size: list[int],
    where: str
) -> Floats:
    """Return a component in T along the axes ``names``; zeros if the file does not have it."""
    if name not in record:
        return np.zeros(size)
    node = record[name]
    if tuple(node.attrs["unitDimension"]) != TESLA:
        raise MeasurementError(must_be(f"`unitDimension` of magneticField/{name}", where,
                                       "that of a flux density",
                                       str(tuple(node.attrs["unitDimension"]))[:60]))
    if _text(node.attrs.get("gridDataOrder", "C")) == "F":
        labels = tuple(reversed(names))
    order = [names.index(label) for label in labels]
    expected = tuple(size[axis] for axis in order)
    constant = isinstance(node, h5py.Group)
    shape = tuple(int(count) for count in (node.attrs["shape"] if constant else node.shape))
    if shape != expected:
        raise MeasurementError(must_be(
            f"shape of magneticField/{name}", where,
            f"{expected}, the gridSize along {', '.join(labels)}", f"{shape}"))
    values = np.full(shape, node.attrs["value"]) if constant else np.asarray(node[()])
    if values.dtype.kind == "c":
        if values.imag.any():
            raise MeasurementError(must_be(f"magneticField/{name}", where, "real, a static field",
                                           "complex numbers"))
        values = values.real
    return np.asarray(values.astype(float) * float(node.attrs["unitSI"])).transpose(
        np.argsort(order))


def _text(value: Any) -> Any:
    """Return an attribute with bytes decoded to text, and arrays of size 1 turned into scalars."""
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.ndarray):
        if value.dtype.kind == "S":
            value = np.char.decode(value)
        if value.dtype.kind == "O":
            value = np.array([_text(item) for item in value.ravel()])
        if value.size == 1:
            return value.ravel()[0]
    return value
