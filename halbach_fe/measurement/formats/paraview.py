"""Import of vectors at points from ParaView's files: legacy VTK, and VTU of other programs.

::

    # vtk DataFile Version 3.0         a title, ASCII or BINARY, and a grid or points
    ...
    POINT_DATA 27
    VECTORS B double                   the name of the vector at each point

Neither format states units. A vector that is named as B is read; of others the user names the
columns x, y, z and three for each vector, in the order of the file.
"""

from __future__ import annotations

import re
import tempfile
from math import prod
from pathlib import Path

import numpy as np

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be, printable
from halbach_fe.measurement.formats.column_names import FIELDS, ColumnName, in_units, split_unit
from halbach_fe.measurement.formats.columns_to_map import ForeignTable
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.study.types import COMPONENTS

LEGACY = b"# vtk DataFile"
XML = re.compile(rb"\s*(?:<\?xml[^>]{0,200}\?>\s*)?<VTKFile\b")
OF_B = re.compile(r"(?i)(?:b|b[ _]?field|(?:magnetic[ _]?)?flux[ _]?density)(?:[ _]e)?")
"""Names of a vector that is B: B, B_field, magnetic flux density (e of Elmer's elements). What is
called magnetic field may be H."""
SIZES = re.compile(
    rb"(?i)\b(?:DIMENSIONS|POINTS|[XYZ]_COORDINATES|CELLS|CELL_TYPES|(?:POINT|CELL)_DATA|"
    rb"\S{1,80}[ \t]{1,8}\d{1,4}(?=[ \t]{1,8}\d{1,30}[ \t]{1,8}[a-z]))"
    rb"[ \t]{1,8}((?:\d{1,18}[ \t]{0,8}){1,3})")
"""Counts that a legacy file states of what it holds, of a grid along its axes; the last are arrays
of its FIELD."""


def is_paraview(raw: bytes) -> bool:
    """Return whether a file begins as a legacy VTK file or as one of VTK's XML formats."""
    return raw.startswith(LEGACY) or bool(XML.match(raw[:400]))


def read(raw: bytes, declared: DeclaredFormat, where: str) -> ForeignTable:
    """Read the points and all vectors at points.

    Raises
    ------
    MeasurementError
        If the file cannot be read, or neither it nor the user says which vector is B.
    """
    try:
        if raw.startswith(LEGACY) and _claimed(raw) > len(raw):  # meshio makes room for all of it
            raise ValueError(len(raw))
        with tempfile.NamedTemporaryFile(suffix=".vtk" if raw.startswith(LEGACY) else ".vtu") as at:
            at.write(raw)
            at.flush()
            mesh = untrusted_files.read_mesh(Path(at.name))
        points = np.asarray(mesh.points, dtype=float)
        vectors: dict[str, Floats] = {
            name: np.asarray(values, dtype=float) for name, values in mesh.point_data.items()
            if np.shape(values) == (len(points), len(COMPONENTS)) == np.shape(points)}
    except (ValueError, TypeError, AttributeError):
        raise MeasurementError(must_be(
            "content", where, "a VTU file, or a legacy VTK file of a grid, that is whole",
            "one that is damaged, or of another kind", "Save it as CSV, in ParaView by Save Data."
        )) from None
    named = [name for name in vectors if OF_B.fullmatch(split_unit(name)[0])]
    if not vectors or (len(named) != 1 and not declared.columns):
        raise MeasurementError(must_be(
            "point data", where, "one vector B", ", ".join(
                f"'{printable(name, 40)}'" for name in vectors) or "no vector",
            "Name x, y, z and three columns for each vector, as --columns x,y,z,-,-,-,Bx,By,Bz."
            if vectors else "Of data in cells ParaView's filter Cell Data to Point Data makes it."))
    columns = [*in_units(COMPONENTS, "")]
    for name in vectors:
        of = FIELDS[:3] if [name] == named else ("",) * 3
        columns += [ColumnName(f"{printable(name, 40)} {axis}", quantity, split_unit(name)[1])
                    for axis, quantity in zip(COMPONENTS, of, strict=True)]
    return ForeignTable(tuple(columns), np.hstack([points, *vectors.values()]), where)


def _claimed(raw: bytes) -> int:
    """Return the largest number of points or cells that a legacy file says to hold."""
    stated = ((found[0], [int(count) for count in found[1].split()])
              for found in SIZES.finditer(raw))
    return max((prod(counts) if text[:1] in b"Dd" else max(counts) for text, counts in stated),
               default=0)
