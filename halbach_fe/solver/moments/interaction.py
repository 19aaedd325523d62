"""The field that polarized cells produce in each other and at points, without dense matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.threads import in_threads, share_out
from halbach_fe.solver.exact_block_field import matrix_of
from halbach_fe.solver.moments import kernels
from halbach_fe.solver.moments.cells import Cells, gauss_nodes

READING_DEGREE = 12
"""Degree of the expansions at points, where an error is not multiplied by chi. In the bore of 96
cubes the error was 3e-4 of the reaction, and 6e-4 with degree 8."""

QUADRATURES = ((8, True), (4, False), (3, False), (3, False), (2, False))
"""Gauss nodes per direction for the mean of the field of a near cell, and whether they are graded
towards the faces: touching cells of one block, of two blocks, close ones of two blocks, other ones
of one block, of two blocks. A block's own permeability makes its own cells matter most."""

MOST_KEPT = 10_000_000
"""Largest number of near pairs whose matrices at 8 nodes are kept: 1 GB."""


@dataclass(frozen=True)
class Clusters:
    """A tree of clusters, see `halbach_fe.solver.moments.kernels.build`."""

    order: Ints
    limits: Ints
    children: Ints
    centres: Floats
    radii: Floats

    @classmethod
    def of(cls, places: Floats, sizes: Floats) -> Clusters:
        """Build the tree of items at places (n, 3) in m and with radii (n,) in m."""
        return cls(*kernels.build(np.ascontiguousarray(places), np.ascontiguousarray(sizes)))

    def __len__(self) -> int:
        return len(self.limits)

    def item(self, cluster: Ints) -> Ints:
        """Return the items of clusters that have a single one."""
        return self.order[self.limits[cluster, 0]]


@dataclass(frozen=True)
class Neighbours:
    """Which sources every target has: ``sources[starts[t]:starts[t + 1]]``."""

    starts: Ints
    sources: Ints

    @classmethod
    def of(cls, targets: Ints, sources: Ints, count: int) -> Neighbours:
        """Sort pairs by their targets, of which there are ``count``."""
        order = np.argsort(targets, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(targets, minlength=count))])
        return cls(starts, sources[order].astype(np.int64))

    @property
    def targets(self) -> Ints:
        """The target (n,) of every pair."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))

    def shares(self, parts: int) -> list[tuple[int, int]]:
        """Return ranges of targets with about the same number of pairs."""
        ends = np.searchsorted(self.starts, np.linspace(0, self.starts[-1], parts + 1)[1:-1])
        limits = [0, *ends.tolist(), len(self.starts) - 1]
        return [(a, b) for a, b in pairwise(limits) if b > a]


@dataclass(frozen=True)
class Interaction:
    """The field of cells, each uniformly polarized, in all cells."""

    cells: Cells
    opening: float = 0.6
    """Two clusters interact by expansions if the sum of their radii is at most this fraction of
    their distance. With 0 all interactions are exact."""
    degree: int = 6  # the reaction of 96 cubes differs by less than 1e-5 from exact sums
    reading_degree: int = READING_DEGREE
    """Degrees of the expansions between cells, and at points."""

    @cached_property
    def arrays(self) -> tuple[Any, ...]:
        """What compiled functions need of the cells."""
        cells = self.cells
        return cells.centre, cells.axes, cells.vertices, cells.half, cells.cuboid

    @cached_property
    def clusters(self) -> Clusters:
        """The tree of the cells."""
        return Clusters.of(self.cells.centre, self.cells.radius)

    @cached_property
    def _pairs(self) -> tuple[Neighbours, Neighbours]:
        """Clusters that are far from each other, and cells that are near to each other."""
        return self._pairs_with(self.clusters, self.opening)

    def _pairs_with(self, targets: Clusters, opening: float) -> tuple[Neighbours, Neighbours]:
        own = self.clusters
        far, close = kernels.pairs(targets.children, targets.centres, targets.radii, own.children,
                                own.centres, own.radii, opening)
        items = (targets.item(close[:, 0]), own.item(close[:, 1]))
        return (Neighbours.of(far[:, 0], far[:, 1], len(targets)),
                Neighbours.of(*items, len(targets.order)))

    @property
    def near_pairs(self) -> int:
        """Number of pairs of cells that are near to each other, which most of the memory is for."""
        own = self.clusters
        _, close = kernels.pairs(own.children, own.centres, own.radii, own.children, own.centres,
                              own.radii, self.opening)
        return len(close)

    @cached_property
    def _kinds(self) -> tuple[Ints, Ints, Ints]:
        """Congruent near pairs, which have equal matrices along the axes of their targets.

        They are the first pair (k,) of every kind, the kind (n,) of every pair, and which of
        `QUADRATURES` takes the mean for every kind, (k,).
        """
        cells, close = self.cells, self._pairs[1]
        targets, sources = close.targets, close.sources
        # distances of two cells, in units of the sum of their radii, below which they count as
        # touching or close
        touching, near_ratio = 1.0, 1.4
        is_near = [kernels.touching(targets, sources, cells.centre, cells.radius, ratio)
                   for ratio in (touching, touching + 1e-6, near_ratio)]
        quadrature = np.where(
            cells.block[targets] == cells.block[sources], np.where(is_near[1], 0, 3),
            np.where(is_near[0], 1, np.where(is_near[2], 2, 4)))
        alike = 1e-8  # largest difference of congruent pairs of cells, relative to the largest cell
        scale = alike * float(cells.radius.max())
        shapes = np.unique(np.round(np.hstack([
            cells.vertices.reshape(len(cells), -1) / scale, cells.half[:, None] / scale,
            cells.cuboid[:, None]])), axis=0, return_inverse=True)[1].ravel()
        keys = np.zeros(len(targets), np.uint64)
        multipliers = iter(np.random.default_rng(0).integers(
            1, 2**63, 15, dtype=np.uint64) * np.uint64(2) + np.uint64(1))

        def distinguish(values: Floats | Ints) -> None:
            """Add whole numbers (n,) to the keys, which are equal for equal numbers."""
            mixed = (keys ^ np.round(values).astype(np.int64).astype(np.uint64)) * next(multipliers)
            np.bitwise_xor(mixed, mixed >> np.uint64(31), out=keys)

        for values in (shapes[targets], shapes[sources], quadrature):
            distinguish(values)
        offset = cells.centre[sources] - cells.centre[targets]
        for i in range(3):
            distinguish(np.einsum("nj,nj->n", cells.axes[targets, :, i], offset) / scale)
            for j in range(3):
                distinguish(np.einsum("nk,nk->n", cells.axes[targets, :, i],
                                      cells.axes[sources, :, j]) / alike)
        _, first, kinds = np.unique(keys, return_index=True, return_inverse=True)
        return first, kinds.ravel(), quadrature[first]

    @cached_property
    def _matrices(self) -> Floats:
        """Means (n, 6) over the targets of the field matrices of all near pairs."""
        close, (first, kinds, quadrature) = self._pairs[1], self._kinds
        targets, sources = close.targets, close.sources
        of_kinds = np.empty((len(first), 6))
        for number, (nodes, is_graded) in enumerate(QUADRATURES):
            chosen = np.flatnonzero(quadrature == number)
            pairs = first[chosen]
            of_kinds[chosen] = self._means(targets[pairs], sources[pairs], nodes, is_graded)
        turned = self._in_frames(targets[first], of_kinds)
        found = np.empty((len(targets), 6))
        in_threads(lambda first, last: kernels.turn_to_magnet(
            targets, kinds, first, last, self.cells.axes, turned, found), share_out(len(targets)))
        return found

    def _in_frames(self, targets: Ints, matrices: Floats) -> Floats:
        """Return matrices (n, ..., 6) along the axes of cells (n,) instead of the magnet's."""
        axes = self.cells.axes[targets].reshape(len(targets), *[1] * (matrices.ndim - 2), 3, 3)
        inside = np.swapaxes(axes, -1, -2) @ matrix_of(matrices) @ axes
        return np.ascontiguousarray(six_of(inside).reshape(matrices.shape))

    def _means(self, targets: Ints, sources: Ints, divisions: int, graded: bool = False) -> Floats:
        """Return means (n, 6) of field matrices by ``divisions`` Gauss nodes per direction."""
        cells, found = self.cells, np.empty((len(targets), 6))
        some, place = np.unique(targets, return_inverse=True)
        local, weights = gauss_nodes(cells.vertices[some], cells.half[some], divisions, graded)
        nodes = cells.centre[some, None] + local @ np.swapaxes(cells.axes[some], 1, 2)
        in_threads(lambda first, last: kernels.mean_matrices(
            place, sources, first, last, self.arrays, nodes, weights, found),
            share_out(len(targets)))
        return found

    def _moments(self, dipoles: Floats, degree: int) -> tuple[Floats, Floats]:
        """Return the real and the imaginary parts of the moments of all clusters."""
        own = self.clusters
        moments = np.empty((len(own), (degree + 1) ** 2), complex)
        kernels.gather(own.order, own.limits, own.children, own.centres, self.cells.nodes, dipoles,
                    degree, moments)
        return moments.real.copy(), moments.imag.copy()

    def _far(self, dipoles: Floats, degree: int) -> Floats:
        """Return the field (n, q, 3) of far clusters at the nodes of every cell."""
        return self._far_at(self._pairs[0], self.clusters, self.cells.nodes,
                            lambda: self._moments(dipoles, degree), degree)

    def _far_at(self, far: Neighbours, targets: Clusters, places: Floats,
                moments_of: Callable[[], tuple[Floats, Floats]], degree: int) -> Floats:
        """Return the field (n, q, 3) of far clusters at places (n, q, 3) of target items, from a
        function that returns the moments of clusters.
        """
        found = np.zeros_like(places)
        if not len(far.sources):
            return found
        own = self.clusters
        moments = moments_of()
        expansions = np.empty((len(targets), (degree + 1) ** 2), complex)
        in_threads(lambda first, last: kernels.translate(
            far.starts, far.sources, first, last, targets.centres, own.centres, *moments, degree,
            expansions), far.shares(32))
        kernels.spread(targets.children, targets.centres, degree, expansions)
        in_threads(lambda first, last: kernels.scatter(
            targets.order, targets.limits, targets.children, targets.centres, places, degree,
            expansions, first, last, found), share_out(len(targets)))
        return found

    def dipoles(self, polarization: Floats) -> Floats:
        """Return dipoles (n, q, 3) in T m^3 at the nodes, for a polarization (n, 3) or (n, q, 3).

        The latter is that of the nodes, in T.
        """
        each = polarization if polarization.ndim == 3 else polarization[:, None]
        return np.ascontiguousarray(
            each * (self.cells.weights * self.cells.volume[:, None])[..., None])

    def degree_for(self, ratio: float) -> int:
        """Return the degree that suffices for a correction, ``ratio`` times the whole field.

        The error of expansions was measured to decrease by 0.5 with every degree.
        """
        spare = int(np.log(max(ratio, 1e-12)) / np.log(0.3))
        return int(np.clip(self.degree - spare, 2, self.degree))

    def mean_field(self, polarization: Floats, degree: int | None = None) -> Floats:
        """Return the mean of mu_0 H (n, 3) in T over every cell, for a polarization (n, 3) in T."""
        found = self.cells.mean(self._far(self.dipoles(polarization), degree or self.degree))
        self._add_near_means(polarization, found)
        return found

    def _add_near_means(self, polarization: Floats, found: Floats) -> None:
        """Add the mean of mu_0 H (n, 3) in T of near cells over every cell."""
        close = self._pairs[1]
        in_threads(lambda first, last: kernels.add_means(
            close.starts, close.sources, self._matrices, polarization, first, last, found),
            close.shares(16))

    def mean_field_of_deviations(self, deviations: Floats, degree: int) -> Floats:
        """Return the mean of mu_0 H (n, 3) in T over every cell, of polarizations (n, q, 3) in T.

        Their means over cells must vanish: near cells are treated by reciprocity.
        """
        cells, close, dipoles = self.cells, self._pairs[1], self.dipoles(deviations)
        found = cells.mean(self._far(dipoles, degree))
        in_threads(lambda first, last: kernels.add_of_deviations(
            close.starts, close.sources, first, last, self.arrays, cells.nodes, dipoles,
            cells.volume, found), close.shares(32))
        return found

    def node_field(self, polarization: Floats) -> Floats:
        """Return mu_0 H (n, q, 3) in T at the nodes of every cell."""
        found = self._far(self.dipoles(polarization), self.degree)
        self._add_near_at_nodes(polarization, found)
        return found

    def _add_near_at_nodes(self, polarization: Floats, found: Floats) -> None:
        """Add mu_0 H (n, q, 3) in T of near cells at the nodes of every cell."""
        close = self._pairs[1]
        in_threads(lambda first, last: kernels.add_at_nodes(
            close.starts, close.sources, first, last, self.arrays, self.cells.nodes, polarization,
            found), close.shares(32))

    def field_along(self, along: Floats) -> Callable[[Floats], tuple[Floats, Floats]]:
        """Return a function for a polarization (n, 3) in T that changes from call to call.

        It returns the component of mu_0 H along the unit vectors ``along`` (n, 3) at the nodes,
        (n, q), and the mean of mu_0 H (n, 3), both in T. Matrices of near pairs are kept in single
        precision, which leaves 1e-7 of the field, unless there are more than `MOST_KEPT`.
        """
        cells, close = self.cells, self._pairs[1]
        kept: NDArray[np.float32] | None = None
        if len(close.sources) <= MOST_KEPT:
            targets, (first, kinds, _) = close.targets, self._kinds
            inside = self._in_frames(
                targets[first], self._node_matrices(targets[first], close.sources[first]))
            kept = np.empty((len(targets), cells.weights.shape[1], 3), np.float32)
            in_threads(lambda first, last: kernels.rows_along(
                targets, kinds, first, last, cells.axes, inside, along, kept),
                share_out(len(targets)))

        def field(polarization: Floats) -> tuple[Floats, Floats]:
            at_nodes = self._far(self.dipoles(polarization), self.degree)
            mean = cells.mean(at_nodes)
            self._add_near_means(polarization, mean)
            if kept is None:
                self._add_near_at_nodes(polarization, at_nodes)
                return np.einsum("nqi,ni->nq", at_nodes, along), mean
            component = np.einsum("nqi,ni->nq", at_nodes, along)
            in_threads(lambda first, last: kernels.add_along(
                close.starts, close.sources, kept, polarization, first, last, component),
                close.shares(16))
            return component, mean

        return field

    def panel(self, first: int, last: int) -> Floats:
        """Return the mean field of cells ``first`` to ``last`` in all cells, (3 n, 3 m)."""
        cells = self.cells
        found = np.empty((3 * len(cells), 3 * (last - first)))
        nodes, weights = self._two_nodes
        in_threads(lambda a, b: kernels.far_panel(
            a, b, first, nodes, weights, cells.volume, found),
            [(first + a, first + b) for a, b in share_out(last - first)])
        close = self._pairs[1]
        here = np.flatnonzero((close.sources >= first) & (close.sources < last))
        target, source = close.targets[here], close.sources[here] - first
        found.reshape(len(cells), 3, -1, 3)[target, :, source] = matrix_of(self._matrices[here])
        return found

    @cached_property
    def _two_nodes(self) -> tuple[Floats, Floats]:
        cells = self.cells
        local, weights = gauss_nodes(cells.vertices, cells.half, 2)
        return cells.centre[:, None] + local @ np.swapaxes(cells.axes, 1, 2), weights

    def pairs_within(self, reach: float) -> Neighbours:
        """Return near pairs of cells, up to ``reach`` times the sum of their radii apart."""
        close = self._pairs[1]
        targets = close.targets
        chosen = kernels.touching(
            targets, close.sources, self.cells.centre, self.cells.radius, reach)
        return Neighbours.of(targets[chosen], close.sources[chosen], len(self.cells))

    def node_matrices(self, targets: Ints, sources: Ints) -> Floats:
        """Return the field matrices (n, q, 3, 3) of source cells at the nodes of target cells."""
        return matrix_of(self._node_matrices(targets, sources))

    def _node_matrices(self, targets: Ints, sources: Ints) -> Floats:
        """Return the field matrices (n, q, 6) of source cells at the nodes of target cells."""
        found = np.empty((len(targets), self.cells.weights.shape[1], 6))
        in_threads(lambda first, last: kernels.node_matrices(
            targets, sources, first, last, self.arrays, self.cells.nodes, found),
            share_out(len(targets)))
        return found

    @property
    def _reach(self) -> float:
        """Distance of points from a cell, in radii of it, below which they see its exact parts."""
        if self.opening == 0:
            return np.inf
        exact = self.cells.divisions == 2 and self.reading_degree >= READING_DEGREE
        # distance of points from a cell with 2 nodes per direction, in radii of it, below which
        # they see exact parts of it, if expansions have `READING_DEGREE`. The field of its dipoles
        # is 3e-5 of its polarization off there, and 5e-4 at 1.7 radii; with 3 nodes it is 3e-5 off
        # at 1.7.
        far_reach = 2.5
        return max(far_reach if exact else 0.0, 1 / self.opening)

    def readings(self, points: Floats) -> Floats:
        """Return the field at points (k, 3) in m per polarization of nodes, (k, 3, n, q, 3)."""
        cells = self.cells
        found = np.empty((len(points), 3, *cells.weights.shape, 3))
        weights = cells.weights * cells.volume[:, None]
        in_threads(lambda first, last: kernels.readings_of_cells(
            first, last, points, self._reach, cells.radius, self.arrays, cells.cuts,
            cells.of_parts, cells.nodes, weights, found), share_out(len(points)))
        return found

    def field_at(self, points: Floats, polarization: Floats) -> Floats:
        """Return mu_0 H (n, 3) in T at points (n, 3) in m, for a polarization (cells, q, 3) in T.

        Near cells consist of uniformly polarized parts, one about every node, see `Cells.of_parts`.
        """
        return self.field_function(polarization)(points)

    def field_function(self, polarization: Floats) -> Callable[[Floats], Floats]:
        """Return `field_at` of a polarization as a function of points.

        The moments of clusters, which take most of the time of a few points, are computed once.
        """
        moments = lru_cache(maxsize=1)(
            lambda: self._moments(self.dipoles(polarization), self.reading_degree))
        of_parts = self.cells.of_parts @ polarization

        def field(points: Floats) -> Floats:
            points = np.ascontiguousarray(points, float)
            if not len(points) or not np.any(polarization):
                return np.zeros((len(points), 3))
            targets = Clusters.of(points, np.zeros(len(points)))
            far, close = self._pairs_with(targets, 1 / self._reach)
            found = self._far_at(far, targets, points[:, None], moments,
                                 self.reading_degree)[:, 0]
            in_threads(lambda first, last: kernels.add_of_parts(
                close.starts, close.sources, first, last, self.arrays, self.cells.cuts, points,
                of_parts, found), close.shares(32))
            return found

        return field


def six_of(matrix: Floats) -> Floats:
    """Return the components (n, 6) of symmetric matrices (n, 3, 3)."""
    return matrix.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]]

