"""Export of three-dimensional field maps for BDSIM (``bdsim3d``).

The file has keys ``nx> 5``, ``xmin> -2.0`` ..., a line ``! X Y Z Fx Fy Fz``, and rows in cm and T.
The x coordinate changes fastest, which is BDSIM's ``loopOrder> xyzt``. BDSIM's loader takes the
grid from the keys and assigns the values by the order of the rows. Source: BDSIM's manual, Field
Map File Formats.
"""

from __future__ import annotations

from collections.abc import Iterator

from halbach_fe.measurement.formats.grid import Grid
from halbach_fe.study.types import COMPONENTS

PER_M = 100.0
"""Centimetres per metre."""


def lines(grid: Grid) -> Iterator[str]:
    """Yield the lines of the file."""
    for name, axis in zip(COMPONENTS, grid.axes, strict=True):
        yield f"n{name}> {len(axis)}"
        yield f"{name}min> {PER_M * float(axis[0])!r}"
        yield f"{name}max> {PER_M * float(axis[-1])!r}"
    yield "loopOrder> xyzt"
    yield "! X Y Z Fx Fy Fz"
    xs, ys, zs = (axis.tolist() for axis in grid.axes)
    for k, z in enumerate(zs):
        for j, y in enumerate(ys):
            for x, field in zip(xs, grid.field[:, j, k].tolist(), strict=True):
                yield " ".join(repr(value) for value in (PER_M * x, PER_M * y, PER_M * z, *field))
