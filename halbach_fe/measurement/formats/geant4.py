"""Export of field maps for Geant4's PurgMagTabulatedField3D (examples/advanced/purging_magnet).

The file is an Opera table in metres and tesla: a blank line, the three counts, a line for each
column, a line with 0, and rows in which z changes fastest. Geant4's reader ends the header at the
first line whose second character is 0, and reads lines into a buffer of 256 characters. It expects
a seventh column, the permeability, but ignores it; the export writes that of vacuum. The units in
the header are for other readers. Source: the .cc file of this class, and PurgMag3D.TABLE.
"""

from __future__ import annotations

from collections.abc import Iterator

from halbach_fe.measurement.formats.grid import Grid
from halbach_fe.study.materials import MU_0

HEADER = (" 1 X [METRE]", " 2 Y [METRE]", " 3 Z [METRE]", " 4 BX [TESLA]", " 5 BY [TESLA]",
          " 6 BZ [TESLA]", " 7 BMOD/HMOD", " 0 [METRE]")


def lines(grid: Grid) -> Iterator[str]:
    """Yield the lines of the file."""
    yield ""
    nx, ny, nz = grid.shape
    yield f" {nx} {ny} {nz} "  # without the last space the reader would parse the previous line
    yield from HEADER
    xs, ys, zs = (axis.tolist() for axis in grid.axes)
    for i, x in enumerate(xs):
        for j, y in enumerate(ys):
            for z, field in zip(zs, grid.field[i, j].tolist(), strict=True):
                yield " ".join(repr(value) for value in (x, y, z, *field, MU_0))
