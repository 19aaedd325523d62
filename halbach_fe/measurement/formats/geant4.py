"""Field maps for Geant4's PurgMagTabulatedField3D (examples/advanced/purging_magnet).

A table of Opera in metres and tesla: a blank line, the three counts, a line for each column, and
0; z changes fastest. The reader ends the header at the first line whose second character is 0,
reads lines into 256 characters, and wants a seventh column, the permeability, which it ignores: it
is that of vacuum everywhere. Units stand in the header for other readers. Source: its .cc file
and PurgMag3D.TABLE.
"""

from __future__ import annotations

from collections.abc import Iterator

from halbach_fe.measurement.formats.grid import Grid
from halbach_fe.study.materials import MU_0

HEADER = (" 1 X [METRE]", " 2 Y [METRE]", " 3 Z [METRE]", " 4 BX [TESLA]", " 5 BY [TESLA]",
          " 6 BZ [TESLA]", " 7 BMOD/HMOD", " 0 [METRE]")


def lines(grid: Grid) -> Iterator[str]:
    """Lines of the file."""
    yield ""
    nx, ny, nz = grid.shape
    yield f" {nx} {ny} {nz} "  # without the last space the reader would look at an old line
    yield from HEADER
    xs, ys, zs = (axis.tolist() for axis in grid.axes)
    for i, x in enumerate(xs):
        for j, y in enumerate(ys):
            for z, field in zip(zs, grid.field[i, j].tolist(), strict=True):
                yield " ".join(repr(value) for value in (x, y, z, *field, MU_0))
