"""The reaction of every single block, per tesla of remanence, for the response matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.pace import Progress
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.solver.moments.interaction import Neighbours
from halbach_fe.solver.moments.solve import MAX_STEPS, System

PANEL = 256
"""Number of source cells whose interactions are in memory at a time."""

TOLERANCE = 1e-6
"""Largest change of a reading per polarization, relative to the largest one, that ends the
iteration. Columns describe deviations of a few per cent."""

AT_ONCE = 40_000_000
"""Largest number of readings times unknowns at a time, 320 MB."""

KEPT = 2**30
"""Largest size in bytes of the interactions that are kept for all steps; larger ones are computed
again in each. They are in single precision, whose error is 1e-7 of the reaction's second order."""

REACH = 1.2
"""Distance of cells, in units of the sum of their radii, up to which the field of one makes the
polarization of the other vary."""

NODES = 3
"""Nodes per direction in every cell."""

Columns = Callable[[int, Ints | slice], Floats]
"""Takes the number of a block and indices (k,) of points or a slice, and returns the reaction
(k, 3, 3) in T per T: component ``[:, c, j]`` of B for a remanence along j."""


def reaction_columns(
    blocks: Sequence[MagnetBlock], points: Floats, cells_per_side: int = 1,
    progress: Progress | None = None,
) -> Columns:
    """Compute the reaction of the magnet to every single block, at points (n, 3) in m.

    The equations are those of `halbach_fe.solver.moments.solve`, but within a cell the polarization
    varies only as the field of near cells does. The readings are propagated back through the
    interactions, so that the cost is proportional to the readings and to the square of the number
    of cells. There is one cell a block by default: the sum over the blocks was then within 5e-3 of
    the reaction that finer cells find, for rings of sectors that touch, and 3e-4 for 4000 cubes.

    ``progress`` is called with the numbers of points that are done and of all points.
    """
    system = System.of(blocks, cells_per_side, NODES)
    found = np.zeros((len(blocks), len(points), 3, 3))
    if np.any(system.susceptibility):
        deviations, extra = _deviations(system)
        panels = _Panels(system, extra, {})
        step = max(1, AT_ONCE // (9 * len(system.remanence)))
        for first in range(0, len(points), step):
            part = slice(first, first + step)
            found[:, part] = _some(
                system, np.array(points[part], float), deviations, panels,
                partial(_advance, progress, first, len(points)))
    return lambda number, some: found[number, some]


def _advance(progress: Progress | None, before: int, total: int, done: int) -> None:
    """Report that points are done after others."""
    if progress is not None:
        progress(before + done, total)


@dataclass(frozen=True)
class _Deviations:
    """The polarization at nodes beyond its mean, per polarization of near cells.

    Attributes
    ----------
    close : Neighbours
        Pairs of a cell and the near ones that polarize it.
    matrices : ndarray, shape (pairs, q, 3, 3)
    """

    close: Neighbours
    matrices: Floats

    def add(self, by_node: Floats, to: Floats) -> None:
        """Add readings per polarization of the cells, by those per polarization of the nodes.

        The latter are rows (r, n, q, 3), the former (r, n, 3).
        """
        starts, rows = self.close.starts.tolist(), len(by_node)
        for target, (first, last) in enumerate(pairwise(starts)):
            matrix = np.moveaxis(self.matrices[first:last], 0, 2).reshape(-1, 3 * (last - first))
            # a cell has each of its near cells once
            to[:, self.close.sources[first:last]] += (
                by_node[:, target].reshape(rows, -1) @ matrix).reshape(rows, -1, 3)


def _deviations(system: System) -> tuple[_Deviations, Any]:
    """Return what the field of near cells makes of polarizations beyond uniform ones.

    With it comes the mean field of these deviations over near cells per polarization of the cells,
    a sparse array (3 n, 3 n).
    """
    cells = system.interaction.cells
    count, nodes = cells.weights.shape
    close, field = system.interaction.near_node_matrices(REACH)
    targets, shape = close.targets, (3 * nodes * count, 3 * count)

    def sparse(blocks: Floats) -> Any:
        return bsr_array((blocks.reshape(-1, 3 * nodes, 3), close.sources, close.starts), shape)

    # by reciprocity, as in near.add_of_deviations
    share = (cells.weights * cells.volume[:, None])[targets] / cells.volume[close.sources, None]
    means = sparse(field * share[..., None, None])
    field -= np.einsum("pq,pqij->pij", cells.weights[targets], field)[:, None]
    matrices = system.susceptibility[targets, None] @ field
    return _Deviations(close, matrices), (means.T @ sparse(matrices)).tocsc()


@dataclass(frozen=True)
class _Panels:
    """The mean field of cells in all cells, for a part of the sources at a time.

    ``extra`` is that of the deviations within near cells, see `_deviations`.
    """

    system: System
    extra: Any
    kept: dict[int, NDArray[np.float32]]

    def add(self, rows: Floats, to: Floats) -> None:
        """Add the product of rows (r, 3 n) and the matrix to rows of the same shape."""
        count, short = len(self.system.remanence), rows.astype(np.float32)
        for first in range(0, count, PANEL):
            last = min(first + PANEL, count)
            panel = self.kept.get(first)
            if panel is None:
                panel = (self.system.interaction.panel(first, last)
                         + self.extra[:, 3 * first:3 * last].toarray()).astype(np.float32)
                if 36 * count**2 <= KEPT:
                    self.kept[first] = panel
            to[:, 3 * first:3 * last] += short @ panel


def _some(
    system: System, points: Floats, deviations: _Deviations, panels: _Panels,
    done: Callable[[int], object],
) -> Floats:
    """Return the columns (blocks, k, 3, 3) for some points (k, 3) in m.

    ``done`` is called with the number of points whose readings are known.
    """
    interaction, chi = system.interaction, system.susceptibility
    count = len(chi)
    rows, size = 3 * len(points), 3 * count
    uniform, start = np.empty((rows, size)), np.empty((rows, size))
    step = max(1, AT_ONCE // (9 * interaction.cells.weights.size))
    for first in range(0, len(points), step):
        by_node = interaction.readings(points[first:first + step])
        part = slice(3 * first, 3 * first + 3 * len(by_node))
        start[part] = uniform[part] = by_node.sum(axis=3).reshape(-1, size)
        deviations.add(by_node.reshape(-1, *by_node.shape[2:]), start[part].reshape(-1, count, 3))
        done(first + len(by_node))
    damping, total = 2 / (2 + system.largest_susceptibility), start
    for _ in range(MAX_STEPS):
        back = np.einsum("rni,nij->rnj", total.reshape(rows, count, 3), chi).reshape(rows, size)
        change = start - total
        panels.add(back, change)
        total = total + damping * change
        if np.abs(change).max() <= TOLERANCE * np.abs(start).max():
            break
    found = np.zeros((system.blocks, rows, 3))
    np.add.at(found, interaction.cells.block, np.moveaxis(
        (total - uniform).reshape(rows, count, 3), 1, 0))
    return found.reshape(system.blocks, len(points), 3, 3)
