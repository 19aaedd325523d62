"""Reaction of the recoil permeability of separate blocks, and their losses, by moments.

Inside a block ``B = mu_0 mu_r H + B_r``, so that its polarization is ``J = B_r + chi mu_0 H`` with
``chi = mu_r - 1``, and mu_0 H is the field of the polarization of all blocks in vacuum. The
reaction is the field of ``J - B_r``.

Every block is divided into cells, often a single one. Three steps follow one another:

1. Galerkin's method for polarizations that are uniform in every cell: the means over cells of both
   sides agree. The fixed point is found by damped iteration.
2. The field of these at the nodes of every cell gives a polarization that differs from node to
   node (I. H. Sloan, Math. Comp. 30 (1976) 758, the iterated solution). To first order in chi it is
   exact at the nodes.
3. The field of its deviations from the means changes the means, again by Galerkin's method.
   By reciprocity that field is an integral of the deviations times the field of a uniform cell,
   which is what makes step 3 accurate to second order in chi.

The moment of a single cube, of mu_r = 1.05 and in one cell, is found with an error of 2e-3 of its
reaction by 2 nodes per direction, 3e-4 by 3 and 4e-5 by 4; without step 3 the error is 4e-3, and
still 1e-3 with 64 cells.

`reaction_columns` computes the reaction of every single block, per tesla of remanence, for the
response matrix.

**Losses of remanence.** A block that is driven past the knee of its demagnetization curve keeps a
part of its remanence only, and the loss changes the field that the others are in. In every cell the
polarization along the easy axis u is ``J = B_r p(h) + chi h`` with ``h = mu_0 H . u``, and ``p(h) =
tanh((h + h_c) / (2 w))``: nearly 1 above the knee, 0.9 at it, and 0 at ``-h_c``, for ``h_c = mu_0
H_cJ`` and a width w that follows from the squareness ``H_k / H_cJ``. This is the major branch of
the hysteresis loop on which magnets are that have been saturated and then assembled; nothing has
driven them back since.

The equations are those above with that J in place of a constant remanence. Newton's method solves
them, each step by GMRES. The operator ``J - p(H(J))`` is monotone, since p grows with H and the
field of polarized cells opposes them.

Losses lie along the edges of blocks, in layers that are thinner than a cell, and p is steep there.
That of the mean of h over a cell is too small a loss, and the mean of p at nodes of the cell is too
large a one if the cell is polarized uniformly: what is lost at one node raises h there. Therefore J
about a node may differ by d from the mean of its cell, and h is less by `TUBE` times d. The means
of J make the field that the nodes are in.

In one ring of 12 cuboids with coercivities of 0.63 to 0.73 T and squarenesses of 0.8 and 0.9,
relative to the field of the losses extrapolated from 6 and 8 cells a side: 3 cells a side leave a
difference of 0.03 to 0.10 of it, rms, and 4 cells as much. The law of the mean leaves 0.17 to 1.01
with 3 cells, 0.10 to 0.72 with 4 and 0.03 to 0.22 with 8. What is left is mostly too large a loss,
which finer cells do not cure: by up to 0.12 of the field near one or two cubes, and by a third of
the mean loss where that is less than a hundredth of the remanence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import LinearOperator, gmres
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints, of_length, slices
from halbach_fe.core.errors import HalbachError
from halbach_fe.core.progress import Progress
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.solver.exact_block_field import unit_fields
from halbach_fe.solver.moments.cells import Cells, cells_of
from halbach_fe.solver.moments.interaction import Interaction, Neighbours
from halbach_fe.study.materials import MU_0, Demagnetization
from halbach_fe.study.model import CELLS_PER_SIDE

MAX_STEPS = 100
"""Largest number of steps. Each reduces the error by chi/(2 + chi) or more, a third for chi = 1."""

ERROR_SHARE = {0.9: 0.7, 1.6: 0.2}
"""Error bar, relative to the change that half as many cells per side make, by the distance from the
centre of the nearest cell in radii of its circumscribed sphere; between them it is interpolated.

Over random magnets of cuboids, trapezoids, hexagons, cylinders and L-shaped prisms, with chi from
0.05 to 0.5, and a ring of long bars, the error was at most 0.36 of the change in 68 % of readings
nearer than 0.9 radii and 1.0 in 95 %; 0.18 and 0.63 up to 1.2 radii, 0.11 and 0.31 up to 1.6, and
0.05 and 0.24 beyond.
"""

Applied = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns mu_0 H (n, 3) in T of other sources there."""


@dataclass(frozen=True)
class Moments:
    """Polarized blocks."""

    interaction: Interaction
    """The cells, and the sums over them."""
    induced: Floats
    """Polarization ``J - B_r`` about every node of the cells. Shape (cells, q, 3), in T."""
    blocks: int
    """Number of blocks, of which some may have no cells."""
    steps: int
    """Steps of the iteration."""
    susceptibility: float
    """The largest one of any cell, by which the error grows."""

    @property
    def cells(self) -> Cells:
        """The cells of the blocks."""
        return self.interaction.cells

    def reaction(self, points: Floats, degree: int | None = None) -> Floats:
        """Return the field (n, 3) in T of the induced polarization at points (n, 3) in m.

        It is to be added to the field of the blocks' remanence in vacuum. Inside a block it is the
        part of mu_0 H. ``degree`` is that of the expansions, by default `READING_DEGREE`.
        """
        interaction = self.interaction if degree is None else replace(
            self.interaction, reading_degree=degree)
        return interaction.field_at(points, self.induced)

    def block_moments(self) -> Floats:
        """Return mu_0 times the induced moment of every block, (blocks, 3) in T m^3."""
        cells = self.cells
        total = np.zeros((self.blocks, 3))
        np.add.at(total, cells.block, self.interaction.dipoles(self.induced).sum(axis=1))
        return total


@dataclass(frozen=True)
class System:
    """Cells of blocks with their materials; it can be solved again and again with other fields."""

    interaction: Interaction
    remanence: Floats
    """Shape (cells, 3), in T."""
    susceptibility: Floats
    """Recoil permeability less 1. Shape (cells, 3, 3)."""
    blocks: int
    """Number of blocks. Those that have neither remanence nor susceptibility have no cells."""

    @classmethod
    def of(cls, blocks: Sequence[MagnetBlock], cells_per_side: int | None = None,
           divisions: int = 2) -> System:
        """Divide blocks into cells; see `halbach_fe.solver.moments.cells.cells_of`.

        Raises
        ------
        ValueError
            If a block is infinitely long.
        """
        if any(np.isinf(block.z_max - block.z_min) for block in blocks):
            raise ValueError("the method of moments needs blocks of finite length")
        remanence = np.array([block.polarization for block in blocks])
        tensors = np.array([block.recoil_tensor for block in blocks]) - np.eye(3)
        there = [number for number in range(len(blocks))
                 if np.any(remanence[number]) or np.any(tensors[number])]
        interaction = _interaction(tuple(_shape(blocks[number]) for number in there), tuple(there),
                                   cells_per_side or CELLS_PER_SIDE, divisions)
        owner = interaction.cells.block
        return cls(interaction, remanence[owner], tensors[owner], len(blocks))

    def solve(self, applied: Applied | None = None) -> Moments:
        """Return the polarization of the blocks in their own field and an applied one."""
        cells, interaction = self.interaction.cells, self.interaction
        outer = _at_nodes(applied, cells)
        mean_outer = cells.mean(outer)
        scale = float(np.abs(self.remanence).max(initial=0.0) + np.abs(mean_outer).max(initial=0.0))
        if scale == 0:
            return Moments(interaction, outer, self.blocks, 0, self.largest_susceptibility)
        uniform, steps = self._self_consistent(self.remanence + self._respond(mean_outer), scale)
        deviation = self._respond(interaction.node_field(uniform) + outer)
        deviation -= cells.mean(deviation)[:, None]
        share = interaction.degree_for(np.abs(deviation).max(initial=0.0) / scale)
        correction, more = self._self_consistent(
            self._respond(interaction.mean_field_of_deviations(deviation, share)), scale)
        induced = deviation + (uniform + correction - self.remanence)[:, None]
        return Moments(interaction, induced, self.blocks, steps + more,
                       self.largest_susceptibility)

    @property
    def largest_susceptibility(self) -> float:
        """Largest susceptibility of any cell along any direction."""
        return float(np.linalg.norm(self.susceptibility, ord=2, axis=(1, 2)).max(initial=0.0))

    def _respond(self, field: Floats) -> Floats:
        """Return the polarization that a field (cells, ..., 3) in T induces."""
        return np.einsum("nij,n...j->n...i", self.susceptibility, field)

    def _self_consistent(self, sources: Floats, scale: float) -> tuple[Floats, int]:
        """Return the uniform polarizations J = sources + chi H(J), and the number of steps.

        The eigenvalues of -H(J)/J are between 0 and 1, hence the damping: the error decreases by
        chi/(2 + chi) a step. ``scale`` in T is what the tolerance relates to.
        """
        damping, polarization = 2 / (2 + self.largest_susceptibility), sources
        field, step = np.zeros_like(sources), sources
        # largest change of a polarization, relative to the largest remanence, that ends the
        # iteration. The reaction is some 1e-2 of the remanence, so that the error is 1e-6 of it.
        tolerance = 1e-8
        for count in range(1, MAX_STEPS + 1):
            size = float(np.abs(step).max(initial=0.0)) / scale
            field = field + self.interaction.mean_field(step, self.interaction.degree_for(size))
            step = damping * (sources + self._respond(field) - polarization)
            polarization = polarization + step
            if np.abs(step).max(initial=0.0) <= tolerance * scale:
                return polarization, count
        raise HalbachError(
            f"The polarization of the blocks does not settle in {MAX_STEPS} steps: the last "
            f"changed it by {np.abs(step).max() / scale:.1e} of the remanence. Please report this "
            "with the study.")


def _at_nodes(applied: Applied | None, cells: Cells) -> Floats:
    """Return an applied field at the nodes of cells, like them (cells, nodes, 3), in T."""
    return np.zeros_like(cells.nodes) if applied is None else applied(
        cells.nodes.reshape(-1, 3)).reshape(cells.nodes.shape)


def _shape(block: MagnetBlock) -> MagnetBlock:
    """Return a block of the same shape in the same place, of no particular material."""
    return replace(block, easy_axis=(0.0, 0.0, 1.0), remanence=1.0, recoil_permeability=1.0,
                   recoil_permeability_across=1.0, gradient=0.0)


@lru_cache(maxsize=2)  # fits of materials solve the same cells again and again
def _interaction(blocks: tuple[MagnetBlock, ...], numbers: tuple[int, ...], cells_per_side: int,
                 divisions: int) -> Interaction:
    """Return the cells of blocks with the given numbers."""
    cells = cells_of(blocks, cells_per_side, divisions)
    return Interaction(replace(cells, block=np.array(numbers, int)[cells.block]))


def solve_moments(
    blocks: Sequence[MagnetBlock], *, cells_per_side: int | None = None, divisions: int = 2,
    applied: Applied | None = None,
) -> Moments:
    """Return the polarization that the blocks' own field and an applied one induce in them.

    Parameters
    ----------
    blocks : sequence of MagnetBlock
        Of finite length, in their true places; they may touch. Each counts as uniformly magnetized.
    cells_per_side : int, optional
        See `cells_of`; default 2, eight cells for a cube.
    divisions : int
        Nodes per direction in every cell.
    applied : callable, optional
        mu_0 H of other sources, such as iron.
    """
    return System.of(blocks, cells_per_side, divisions).solve(applied)


def refinement(blocks: Sequence[MagnetBlock],
               cells_per_side: int | None = None) -> tuple[System, System]:
    """Return blocks in cells, and in half as many along each side; a single cell, also in two."""
    cells = cells_per_side or CELLS_PER_SIDE
    return System.of(blocks, cells), System.of(blocks, cells // 2 if cells > 1 else 2)


def field_with_errors(fine: Moments, coarse: Moments, points: Floats) -> tuple[Floats, Floats]:
    """Return the reaction and its error, both (n, 3) in T, at points (n, 3) in m.

    ``fine`` and ``coarse`` are the solutions of both systems of `refinement`. The error is along
    their difference. Its length, a share of that of the difference (`ERROR_SHARE`), is the error
    bar in any direction.
    """
    field, other = fine.reaction(points), coarse.reaction(points)
    change, size = (np.linalg.norm(value, axis=1) for value in (field - other, field))
    larger = min((fine.cells, coarse.cells), key=len)
    share = np.interp(_distances(larger, points), list(ERROR_SHARE), list(ERROR_SHARE.values()))
    floor = 5e-4  # smallest error bar relative to the reaction, for the expansions of far clusters
    # with larger susceptibilities cells converge more slowly. Of 60 random stacks of one to three
    # cuboids, against 8 cells a side, 0.95 of the readings 3 mm and more away were within 1.0 bars
    # without this for chi = 0.3, 1.7 for 0.5, 2.2 for 0.75 and 3.7 for 1
    slower = 1 + fine.susceptibility**2
    # and the change may vanish, hence the floor: of 36 rings of 8 to 16 sectors or trapezoids that
    # touch, of chi = 0.05 to 0.2, 0.96 of the readings were within two bars with this, 0.81 without
    less_sure = 20 * fine.susceptibility
    bar = slower * share * change + (1 + less_sure) * floor * size
    return field, of_length(field - other, bar)


def field_within(
    moments: Moments, number: int, block: MagnetBlock, points: Floats, sources: Applied,
) -> tuple[Floats, Floats]:
    """Return mu_0 H and its error bar, both (n, 3) in T, at points (n, 3) in m inside a block.

    ``number`` is that of the block in ``moments``, and ``sources`` returns mu_0 H of all remanences
    and of iron. `Moments.reaction` has charges on the faces of the cells of this block. Here its
    polarization is its mean and, to first order in chi, the deviation ``D`` that the field of that
    mean makes. The field of ``D`` is that of a block with the ``D`` of the point throughout, in
    closed form, and the sum over Gauss nodes of what the others differ from it, which vanishes
    where the kernel is singular. The bar is the change by half as many nodes a side, plus chi times
    the field of ``D``, as large as what the next order would add.
    """
    cells, chi = moments.cells, block.recoil_tensor - np.eye(3)
    own, mean = cells.block == number, cells.mean(moments.induced)
    induced = moments.induced.copy()
    induced[own] = np.average(mean[own], axis=0, weights=cells.volume[own])
    others = moments.interaction.field_function(induced)

    def deviation(places: Floats) -> tuple[Floats, Floats]:
        """Return mu_0 H of the means, and the polarization that it makes."""
        field = sources(places) + others(places)
        return field, field @ chi.T

    first, here = deviation(points)
    unit = next(iter(unit_fields([block], points)))
    per_side, divisions, of_deviation = 6, 3, []
    for cells_per_side in (per_side, per_side // 2):
        grid = cells_of([block], cells_per_side, divisions)
        nodes, volume = grid.nodes.reshape(-1, 3), (grid.weights * grid.volume[:, None]).ravel()
        there = deviation(nodes)[1]
        average = np.average(there, axis=0, weights=volume)
        of_deviation.append(np.einsum("nij,nj->ni", unit, here - average)
                            + _spheres_less(points, here, nodes, there, volume))
    field, coarse = of_deviation
    second = np.linalg.norm(field, axis=1) * np.linalg.norm(chi, ord=2)
    bar = np.linalg.norm(field - coarse, axis=1) + second
    return first + field, np.repeat(bar[:, None], 3, axis=1)


def _spheres_less(
    points: Floats, here: Floats, nodes: Floats, there: Floats, volume: Floats
) -> Floats:
    """Return mu_0 H (n, 3) in T of spheres about nodes (m, 3) in m, of volumes (m,) in m^3.

    Their polarization is ``there`` (m, 3) in T, less ``here`` (n, 3) in T at the points (n, 3).
    """
    found, radius = np.empty_like(points), np.cbrt(3 * volume / (4 * np.pi))
    for row, (point, own) in enumerate(zip(points, here, strict=True)):
        apart, change = point - nodes, there - own
        distance = np.linalg.norm(apart, axis=1)
        far = distance > radius  # elsewhere the point is in the sphere, whose field is uniform
        apart, distance = apart[far], distance[far]
        along = 3 * np.einsum("mi,mi->m", change[far], apart) / distance**5
        field = along[:, None] * apart - change[far] / distance[:, None]**3
        found[row] = volume[far] @ field / (4 * np.pi) - change[~far].sum(axis=0) / 3
    return found


def _distances(cells: Cells, points: Floats) -> Floats:
    """Return the distances (n,) of points (n, 3) in m from the nearest cell, see `ERROR_SHARE`."""
    nearest_cells = 8  # number of nearest centres among which the nearest cell is looked for
    count = min(nearest_cells, len(cells))
    distance, number = KDTree(cells.centre).query(points, np.arange(1, count + 1))
    return np.asarray((distance / cells.radius[number]).min(axis=1))


ENTRIES_AT_ONCE = 40_000_000
"""Largest number of readings times unknowns at a time, 320 MB."""

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
    divisions = 3  # nodes per direction in every cell
    system = System.of(blocks, cells_per_side, divisions)
    found = np.zeros((len(blocks), len(points), 3, 3))
    if np.any(system.susceptibility):
        deviations, extra = _deviations(system)
        panels = _Panels(system, extra, {})
        step = max(1, ENTRIES_AT_ONCE // (9 * len(system.remanence)))
        for part in slices(len(points), step):
            found[:, part] = _columns_at(
                system, np.array(points[part], float), deviations, panels,
                partial(_report_progress, progress, part.start, len(points)))
    return lambda number, some: found[number, some]


def _report_progress(progress: Progress | None, before: int, total: int, done: int) -> None:
    """Report that points are done after others."""
    if progress is not None:
        progress(before + done, total)


@dataclass(frozen=True)
class _Deviations:
    """The polarization at nodes beyond its mean, per polarization of near cells."""

    close: Neighbours
    """Pairs of a cell and the near ones that polarize it."""
    matrices: NDArray[np.float32]
    """In single precision, whose error is 1e-7 of these polarizations. Shape (pairs, q, 3, 3)."""

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
    # distance of cells, in units of the sum of their radii, up to which the field of one makes the
    # polarization of the other vary
    reach = 1.2
    close = system.interaction.pairs_within(reach)
    targets, size = close.targets, 3 * count
    found = np.empty((len(targets), nodes, 3, 3), np.float32)
    extra = csc_array((size, size))
    pairs_at_once = 20_000  # whose matrices are in memory in double precision, 40 MB
    for first, last in close.shares(1 + len(targets) // pairs_at_once):
        some = slice(close.starts[first], close.starts[last])
        target, source = targets[some], close.sources[some]
        starts = close.starts[first:last + 1] - close.starts[first]
        field = system.interaction.node_matrices(target, source)

        def sparse(blocks: Floats, source: Ints = source, starts: Ints = starts) -> Any:
            return bsr_array((blocks.reshape(-1, 3 * nodes, 3), source, starts),
                             (3 * nodes * (len(starts) - 1), size))

        # by reciprocity, as in near.add_of_deviations
        share = (cells.weights * cells.volume[:, None])[target] / cells.volume[source, None]
        means = sparse(field * share[..., None, None])
        field -= np.einsum("pq,pqij->pij", cells.weights[target], field)[:, None]
        field = system.susceptibility[target, None] @ field
        extra = extra + (means.T @ sparse(field)).tocsc()
        found[some] = field
    return _Deviations(close, found), extra


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
        width = 256  # number of source cells whose interactions are in memory at a time
        # largest size in bytes of the interactions that are kept for all steps; larger ones are
        # computed again in each. They are in single precision, whose error is 1e-7 of the
        # reaction's second order.
        kept_bytes = 2**30
        for first in range(0, count, width):
            last = min(first + width, count)
            panel = self.kept.get(first)
            if panel is None:
                panel = (self.system.interaction.panel(first, last)
                         + self.extra[:, 3 * first:3 * last].toarray()).astype(np.float32)
                if 36 * count**2 <= kept_bytes:
                    self.kept[first] = panel
            to[:, 3 * first:3 * last] += short @ panel


def _columns_at(
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
    step = max(1, ENTRIES_AT_ONCE // (9 * interaction.cells.weights.size))
    for first in range(0, len(points), step):
        by_node = interaction.readings(points[first:first + step])
        part = slice(3 * first, 3 * first + 3 * len(by_node))
        start[part] = uniform[part] = by_node.sum(axis=3).reshape(-1, size)
        deviations.add(by_node.reshape(-1, *by_node.shape[2:]), start[part].reshape(-1, count, 3))
        done(first + len(by_node))
    damping, total = 2 / (2 + system.largest_susceptibility), start
    # largest change of a reading per polarization, relative to the largest one, that ends the
    # iteration. Columns describe deviations of a few per cent.
    tolerance = 1e-6
    for _ in range(MAX_STEPS):
        back = np.einsum("rni,nij->rnj", total.reshape(rows, count, 3), chi).reshape(rows, size)
        change = start - total
        panels.add(back, change)
        total = total + damping * change
        if np.abs(change).max() <= tolerance * np.abs(start).max():
            break
    found = np.zeros((system.blocks, rows, 3))
    np.add.at(found, interaction.cells.block, np.moveaxis(
        (total - uniform).reshape(rows, count, 3), 1, 0))
    return found.reshape(system.blocks, len(points), 3, 3)


TUBE = 1 / 2
"""Field within a long tube that is polarized across, relative to its polarization: such tubes are
what is lost along the edges."""


@dataclass(frozen=True)
class KneeLaw:
    """A demagnetization curve with a knee, or those of cells (n,) of several materials."""

    coercivity_T: float | Floats
    """mu_0 H_cJ. Shape () or (n,)."""
    squareness: float
    """Ratio of H_k, where a tenth of the remanence is lost, to H_cJ; below 1."""
    remanence_factor: float | Floats = 1.0
    """Remanence at the temperature of the losses, relative to that stated. Shape () or (n,)."""

    @classmethod
    def of(cls, material: Demagnetization) -> KneeLaw:
        """Return the law of a study's material that has been at its temperature.

        There the blocks are weaker, and so is the field that they are in. The part that is left at
        ``B_r`` with the coercivity ``h_c / (1 + a)`` is that at ``(1 + a) B_r`` with ``h_c``: all
        fields are as much weaker as the remanence, but for those of other sources, which
        `solve_irreversible` divides by ``1 + a``.
        """
        hotter = material.temperature_C - material.reference_temperature_C
        coercivity, remanence = (1 + hotter * each for each in (
            material.coercivity_coefficient_per_K, material.remanence_coefficient_per_K))
        return cls(MU_0 * material.intrinsic_coercivity_A_per_m * coercivity / remanence,
                   material.squareness, remanence)

    def _at(self, field: Floats) -> tuple[Floats, Floats]:
        """Return the coercivity and the width w in T for fields (n, ...) of the cells."""
        # part of the remanence that is left at the knee, by the definition of H_k in IEC 60404-8-1
        at_knee = 0.9
        own = np.asarray(self.coercivity_T)
        own = own.reshape(own.shape + (1,) * (np.ndim(field) - own.ndim))
        return own, own * (1 - self.squareness) / (2 * float(np.arctanh(at_knee)))

    def kept(self, field: Floats) -> Floats:
        """Return the part p of the remanence that is left at mu_0 H . u = ``field``, in T."""
        coercivity, width = self._at(field)
        return np.asarray(np.tanh((field + coercivity) / (2 * width)))

    def slope(self, field: Floats) -> Floats:
        """Return the derivative of `kept` in 1/T."""
        return np.asarray((1 - self.kept(field)**2) / (2 * self._at(field)[1]))

    def kept_in_tubes(self, field: Floats, strength: Floats, mean: Floats) -> tuple[Floats, Floats]:
        """Return the part p that is left where a loss raises the field, and dp / dfield in 1/T.

        They fulfil ``p = kept(field - TUBE (strength p - mean))`` for a remanence ``strength`` and
        a mean polarization ``mean`` of the surroundings along the easy axis, both in T. Arrays of
        all arguments are broadcast.
        """
        least, most = -np.ones(field.shape), np.ones(field.shape)
        bisections = 40  # steps of the bisection for the part of the remanence at a node, to 1e-12
        for _ in range(bisections):
            part = (least + most) / 2
            is_above = part > self.kept(field - TUBE * (strength * part - mean))
            least, most = np.where(is_above, least, part), np.where(is_above, part, most)
        slope = self.slope(field - TUBE * (strength * part - mean))
        return part, slope / (1 + TUBE * strength * slope)


def solve_irreversible(
    system: System, law: KneeLaw, applied: Applied | None = None, *, by_mean: bool = False,
    steady: Applied | None = None,
) -> tuple[Moments, Floats]:
    """Return the polarization of blocks that have lost remanence, and the loss.

    Parameters
    ----------
    system : System
        The cells with the remanence that they had when they were saturated.
    applied : callable, optional
        mu_0 H of other sources, such as iron.
    by_mean : bool
        Whether the loss of a cell is that of the mean field in it, which is too small.
    steady : callable, optional
        The part of ``applied`` whose sources do not weaken as the blocks do in the heat.

    Returns
    -------
    moments : Moments
        The polarization less the original remanence.
    lost : ndarray, shape (cells,), in T
        Mean loss in every cell.

    Raises
    ------
    HalbachError
        If Newton's method does not come to rest.
    """
    interaction, chi, cells = system.interaction, system.susceptibility, system.interaction.cells
    strength = np.linalg.norm(system.remanence, axis=1)
    easy = system.remanence / np.where(strength > 0, strength, 1.0)[:, None]
    outer = _at_nodes(applied, cells)
    outer_mean = cells.mean(outer)
    # what steady sources have more of in the field that takes remanence, along the easy axis
    more = np.einsum("nqi,ni->nq", _at_nodes(steady, cells), easy / np.reshape(
        law.remanence_factor, (-1, 1)) - easy)
    outer_along = np.einsum("nqi,ni->nq", outer, easy) + more

    def kept(along: Floats, polarization: Floats) -> tuple[Floats, Floats]:
        """Return p and dp/dh in 1/T at the nodes (cells, q) in the field along the easy axis."""
        return law.kept_in_tubes(
            along, strength[:, None], np.einsum("ni,ni->n", polarization, easy)[:, None])

    field_of = None if by_mean else interaction.field_along(easy)

    def state(polarization: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the mean field (cells, 3) in T, and the means of p and of dp/dh (cells,)."""
        if field_of is None:
            field = interaction.mean_field(polarization) + outer_mean
            along = np.einsum("ni,ni->n", field, easy) + np.einsum("nq,nq->n", cells.weights, more)
            return field, law.kept(along), law.slope(along)
        along, field = field_of(polarization)
        part, slope = kept(along + outer_along, polarization)
        return (field + outer_mean, np.einsum("nq,nq->n", cells.weights, part),
                np.einsum("nq,nq->n", cells.weights, slope))

    polarization, part, steps = _uniform(system, strength, easy, state, 0.0 if by_mean else TUBE)
    # the polarization about the nodes differs as the field there does; its means stay
    field = interaction.node_field(polarization) + outer
    along = np.einsum("nqi,ni->nq", field, easy) + more
    at_nodes = law.kept(along) if by_mean else kept(along, polarization)[0]
    by_node = np.einsum("nij,nqj->nqi", chi, field) + (
        strength[:, None] * at_nodes)[..., None] * easy[:, None]
    by_node += (polarization - cells.mean(by_node))[:, None]
    return (Moments(interaction, by_node - system.remanence[:, None], system.blocks, steps,
                    system.largest_susceptibility),
            np.asarray(strength * (1 - part)))


def _uniform(
    system: System, strength: Floats, easy: Floats,
    state: Callable[[Floats], tuple[Floats, Floats, Floats]], tube: float
) -> tuple[Floats, Floats, int]:
    """Return the mean polarizations (cells, 3) in T, the mean part (cells,) of the remanence that
    is left, and the number of Newton's steps.

    ``strength`` (cells,) in T and ``easy`` (cells, 3) are amount and direction of the remanence.
    ``state`` takes the polarization (cells, 3) in T and returns the mean of mu_0 H (cells, 3) in T,
    that part, and its derivative by the field in 1/T; by the polarization along the easy axis it is
    ``tube`` times as large.
    """
    interaction, chi = system.interaction, system.susceptibility
    scale = float(strength.max(initial=0.0))

    def residual(polarization: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the residual (cells, 3) in T, the part that is left, and its derivative."""
        field, part, slope = state(polarization)
        return (polarization - (strength * part)[:, None] * easy
                - np.einsum("nij,nj->ni", chi, field)), part, slope

    polarization = system.remanence
    left, part, slope = residual(polarization)
    # largest residual of a polarization, relative to the remanence, that ends Newton's method.
    # Losses are some 10 % where they matter, and the coercivity is hardly known to 1 %.
    tolerance = 1e-4
    # largest number of Newton's steps, and of halvings of one of them
    most_steps, most_halvings = 40, 6
    # residual that ends GMRES, relative to its right-hand side, and its largest number of steps
    gmres_tolerance, gmres_steps = 0.05, 30
    # degree of the expansions within GMRES, whose result only has to point the right way
    degree = 3
    # field of a cell in itself relative to its polarization, for the preconditioner: that of a cube
    own_field = 1 / 3
    for count in range(most_steps):
        size = float(np.linalg.norm(left))
        if np.abs(left).max(initial=0.0) <= tolerance * scale:
            return polarization, part, count
        by_field = (strength * slope)[:, None, None] * (easy[:, :, None] * easy[:, None])
        tangent, own = chi + by_field, np.eye(3) - tube * by_field

        def times(vector: Floats, tangent: Floats = tangent, own: Floats = own) -> Floats:
            step = vector.reshape(-1, 3)
            field = interaction.mean_field(step, degree)
            return np.asarray(np.einsum("nij,nj->ni", own, step)
                              - np.einsum("nij,nj->ni", tangent, field)).ravel()

        inverse = np.asarray(np.linalg.inv(own + own_field * tangent), float)

        def precondition(vector: Floats, inverse: Floats = inverse) -> Floats:
            return np.einsum("nij,nj->ni", inverse, vector.reshape(-1, 3)).ravel()

        unknowns = (left.size, left.size)
        step, _ = gmres(LinearOperator(unknowns, times, dtype=float), -left.ravel(),
                        rtol=gmres_tolerance, restart=gmres_steps, maxiter=1,
                        M=LinearOperator(unknowns, precondition, dtype=float))
        step = step.reshape(-1, 3)
        for halving in range(most_halvings):
            tried = polarization + step / 2**halving
            left, part, slope = residual(tried)
            if np.linalg.norm(left) < size:
                break
        polarization = tried
    raise HalbachError(
        f"The irreversible losses of the blocks do not settle in {most_steps} steps: the last left "
        f"{np.abs(left).max() / scale:.1e} of the remanence. Please report this with the study.")
