"""Blocks that overlap one another or iron, in any pose.

Candidates are pairs of bodies whose bounding spheres overlap. Sectors about the magnet's axis are
compared exactly, in radius, angle and z. All other bodies are split into convex prisms, see
`convex_pieces` and `separating_axes`. These lie inside the true shape, so that neither faces that
touch nor arcs that layers share are ever reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from halbach_fe.core.arrays import Bools, Floats, Ints, box_middle
from halbach_fe.geometry.blocks import MagnetBlock, frames_of, rotation_matrix
from halbach_fe.geometry.convex_pieces import PARALLEL, Prisms, Shape, annulus
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.outline import Outline, along_edges, at_heights
from halbach_fe.geometry.surface import distance_from_prism

ALLOWED_PENETRATION = 1e-6
"""Allowed penetration, as a fraction of the smaller body's size. Positions with nine significant
digits, and the rounding of rotations (1e-15), stay below it."""

SQUEEZED = 0.1
"""The same for blocks that exceptions, or hidden faults, displace or rotate. In a ring without gaps
any displacement makes neighbours overlap a little; a larger overlap cannot be a tolerance of the
assembly."""


def overlapping_blocks(
    blocks: Sequence[MagnetBlock], tolerance: float = ALLOWED_PENETRATION
) -> tuple[int, int, float] | None:
    """Return the first two blocks, by number, that overlap.

    Parameters
    ----------
    blocks : sequence of MagnetBlock
        Infinite blocks may turn about z only.
    tolerance : float
        Penetration that is allowed, as a fraction of the smaller block's size (the smaller one of
        half its width and half its length).

    Returns
    -------
    (int, int, float) or None
        Numbers of the two blocks in the sequence, from 0 and the smaller one first, and how far
        they penetrate one another, in m; for shapes with arcs, a lower bound. None if all are
        apart.

    Raises
    ------
    ValueError
        If an infinite block is tilted.
    """
    return first_overlap(_block_bodies(blocks), None, tolerance) if blocks else None


def block_in_others(
    blocks: Sequence[MagnetBlock], others: Sequence[MagnetBlock],
    tolerance: float = ALLOWED_PENETRATION,
) -> tuple[int, int, float] | None:
    """Return the first of some blocks that overlaps one of others, as `block_in_iron` does."""
    if not (blocks and others):
        return None
    return first_overlap(_block_bodies(blocks), _block_bodies(others), tolerance)


def block_in_iron(
    blocks: Sequence[MagnetBlock], iron: Sequence[IronSolid], tolerance: float = ALLOWED_PENETRATION
) -> tuple[int, int, float] | None:
    """Return the first block, by number, that overlaps a body of iron.

    ``blocks`` and ``tolerance``: see `overlapping_blocks`.

    Returns
    -------
    (int, int, float) or None
        Numbers of the block and of the body of iron in their sequences, from 0, and how far they
        penetrate one another in m, as `overlapping_blocks` returns it.

    Raises
    ------
    ValueError
        If an infinite block is tilted.
    """
    if not (blocks and iron):
        return None
    for number, body in enumerate(iron):
        if body.sphere and (first := _in_sphere(blocks, body, tolerance)) is not None:
            return first[0], number, first[1]
        if body.triangles is not None and (first := _in_triangles(blocks, body, tolerance)):
            return first[0], number, first[1]
    numbers = [number for number, body in enumerate(iron)
               if not body.sphere and body.triangles is None]
    iron = [iron[number] for number in numbers]
    if not iron:
        return None
    shapes = [annulus(body.inner_radius, body.outer_radius) if body.outline is None
              else Shape(body.outline) for body in iron]
    bodies = Bodies(shapes, np.arange(len(iron)),
                     np.array([[body.z_min, body.z_max] for body in iron]),
                     np.array([rotation_matrix(body.turn_rad) for body in iron]),
                     np.array([body.origin_m for body in iron]))
    found = first_overlap(_block_bodies(blocks), bodies, tolerance)
    return None if found is None else (found[0], numbers[found[1]], found[2])


def _in_sphere(
    blocks: Sequence[MagnetBlock], ball: IronSolid, tolerance: float
) -> tuple[int, float] | None:
    """Return the first block that a ball penetrates, and how far in m."""
    for number, block in enumerate(blocks):
        centre = block.to_frame(np.array([ball.origin_m]))
        distance = float(distance_from_prism(block.outline, block.z_min, block.z_max, centre)[0])
        size = min(ball.outer_radius, (block.z_max - block.z_min) / 2)
        if ball.outer_radius - distance > tolerance * size:
            return number, ball.outer_radius - distance
    return None


def _in_triangles(
    blocks: Sequence[MagnetBlock], body: IronSolid, tolerance: float
) -> tuple[int, float] | None:
    """Return the first block that a body of triangles penetrates, and how far in m.

    It is tried at points of the triangles, a sixteenth of the larger block side apart or of large
    triangles farther, and at points of the block that lie a little below its surface.
    """
    corners = np.stack(body.surface, axis=2)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    for number, block in enumerate(blocks):
        outline = np.array([edge.start for edge in block.outline])
        extent = max(*np.ptp(outline, axis=0), block.z_max - block.z_min)
        middle = block.mounted_middle
        if (np.maximum(low - middle, middle - high) > 2 * extent).any():  # far away
            continue
        near = ((corners.min(axis=1) < middle + extent)
                & (corners.max(axis=1) > middle - extent)).all(axis=1)
        parts = int(np.clip(16 * sides[near].max(initial=0.0) / extent, 1, 64))
        share = np.array([(i, j, parts - i - j) for i in range(parts + 1)
                          for j in range(parts + 1 - i)]) / parts
        points = np.einsum("sk,nki->nsi", share, corners[near]).reshape(-1, 3)
        depth = -distance_from_prism(
            block.outline, block.z_min, block.z_max, block.to_frame(points)).min(initial=np.inf)
        allowed = max(tolerance, ALLOWED_PENETRATION)
        if depth > allowed * extent:
            return number, float(depth)
        if body.contains(points_of_block(block, 2 * allowed * extent)).any():
            return number, extent
    return None


def points_of_block(block: MagnetBlock, depth: float = 0.0) -> Floats:
    """Return points (n, 3) in m along the edges of a finite block, ``depth`` m deep, and in its
    middle.
    """
    points = at_heights(along_edges(block.outline, 5), block.z_min, (block.z_min + block.z_max) / 2,
                        block.z_max)
    middle = box_middle(points)
    shrunk = 1 - 2 * depth / np.ptp(points, axis=0).min()
    return block.from_frame(np.vstack([middle + shrunk * (points - middle), middle]))


@dataclass(frozen=True)
class Bodies:
    """Prisms with their poses."""

    shapes: list[Shape]
    shape: Ints
    """Number of every body's shape. Shape (n,)."""
    limits: Floats
    """Smallest and largest z in the body's frame. Shape (n, 2), in m."""
    axes: Floats
    """Axes of the frame, as columns. Shape (n, 3, 3)."""
    position: Floats
    """Origin of the frame. Shape (n, 3), in m."""

    @cached_property
    def infinite(self) -> Bools:
        """Whether bodies are infinitely long, (n,)."""
        return np.asarray(np.isinf(self.limits).any(axis=1))

    @cached_property
    def height(self) -> Floats:
        """Middle of the limits of z, (n,) in m; 0 for infinite bodies."""
        return np.asarray(np.where(self.infinite[:, None], 0.0, self.limits).mean(axis=1))

    @cached_property
    def half_length(self) -> Floats:
        """Half the length, (n,) in m; 0 for infinite bodies."""
        return np.asarray(np.diff(np.where(self.infinite[:, None], 0.0, self.limits))[:, 0] / 2)

    @cached_property
    def reach(self) -> Floats:
        """Radius of the circle around the outline, (n,) in m."""
        return np.array([shape.reach for shape in self.shapes])[self.shape]

    @cached_property
    def size(self) -> Floats:
        """The smaller one of half the width and half the length, (n,) in m."""
        return np.minimum(self.reach, np.where(self.infinite, np.inf, self.half_length))

    @cached_property
    def radius(self) -> Floats:
        """Radius of the bounding sphere, (n,) in m; of infinite bodies, of the cylinder."""
        return np.hypot(self.reach, self.half_length)

    @cached_property
    def centre(self) -> Floats:
        """Centre of the bounding sphere, (n, 3) in m."""
        return self.places(np.arange(len(self.shape)),
                           np.array([shape.centre for shape in self.shapes])[self.shape])

    def places(self, numbers: Ints, points: Floats) -> Floats:
        """Return points (m, 2) at half the length of bodies (m,) in the magnet, (m, 3) in m."""
        local = np.column_stack([points, self.height[numbers]])
        return np.asarray((self.axes[numbers] @ local[:, :, None])[:, :, 0]
                          + self.position[numbers])

    @cached_property
    def polar(self) -> Floats:
        """Ranges of radius, angle and z of sectors about the z axis, (n, 6); NaN for other bodies.

        The columns are the inner and outer radius, the middle and half of the range of angles, and
        the smallest and largest z.
        """
        polar = np.array([shape.polar or (np.nan,) * 4 for shape in self.shapes])[self.shape]
        coaxial = ((np.hypot(*self.position[:, :2].T) <= PARALLEL * self.reach)
                   & (np.abs(self.axes[:, :2, 2]).max(axis=1) <= PARALLEL)
                   & (self.axes[:, 2, 2] > 0))
        turn = np.arctan2(self.axes[:, 1, 0], self.axes[:, 0, 0])
        found = np.column_stack([polar, self.limits + self.position[:, 2:]])
        found[:, 2] += turn
        found[~coaxial | np.isnan(polar[:, 0])] = np.nan
        return found


def _block_bodies(blocks: Sequence[MagnetBlock]) -> Bodies:
    """Return the bodies of blocks."""
    numbers: dict[Outline, int] = {}
    shape = np.array([numbers.setdefault(block.outline, len(numbers)) for block in blocks], int)
    shapes = [Shape(outline) for outline in numbers]
    limits = np.array([(block.z_min, block.z_max) for block in blocks]).reshape(-1, 2)
    infinite = np.isinf(limits[:, 1])
    position, axes = frames_of(blocks)
    tilted = infinite & (np.abs(axes[:, :2, 2]).max(axis=1) > PARALLEL)
    if tilted.any():
        raise ValueError(f"block {blocks[int(np.argmax(tilted))].name} is infinitely long and "
                         "tilted; it may turn about z only")
    return Bodies(shapes, shape, limits, axes, position)


def first_overlap(
    first: Bodies, second: Bodies | None, tolerance: float
) -> tuple[int, int, float] | None:
    """Return the first pair of overlapping bodies; within ``first`` if ``second`` is None.

    Tolerance and result are those of `overlapping_blocks`.
    """
    i, j = _near(first, second)
    other = first if second is None else second
    size = np.minimum(first.size[i], other.size[j])
    allowed, touching = tolerance * size, min(tolerance, ALLOWED_PENETRATION) * size
    exact = ~np.isnan(first.polar[i, 0]) & ~np.isnan(other.polar[j, 0])
    smallest = 2 * min(first.size.min(initial=np.inf), other.size.min(initial=np.inf))

    def pieces(chords: float, pairs: Ints) -> tuple[_Pieces, _Pieces]:
        """Return the pieces of the shapes that take part in pairs; no others are needed."""
        if second is None:
            both = np.concatenate([first.shape[i[pairs]], first.shape[j[pairs]]])
            mine = _Pieces(first, np.unique(both), chords, smallest)
            return mine, mine
        return (_Pieces(first, np.unique(first.shape[i[pairs]]), chords, smallest),
                _Pieces(second, np.unique(second.shape[j[pairs]]), chords, smallest))

    # largest distance between an arc and its chords or tangents, as a fraction of the shape's
    # width. Two such arcs hide an overlap of 8e-5 of the width; larger ones are found.
    chord_error = 4e-5
    mine, others = pieces(chord_error, np.flatnonzero(~exact))
    cost = np.where(exact, 1, mine.effort[first.shape[i]] * others.effort[other.shape[j]])
    pairs_at_once = 20_000  # number of pairs of pieces that are compared at once
    lump = np.cumsum(cost) // pairs_at_once
    # larger values of it, for the depth of bodies that penetrate at all: fewer and larger pieces
    # measure deep overlaps better, since a penetration cannot exceed the width of a piece
    coarse_errors = (1e-3, 3e-2)
    for pairs in np.split(np.arange(len(i)), np.flatnonzero(np.diff(lump)) + 1):
        depth = np.zeros(len(pairs))
        flat = exact[pairs]
        depth[flat] = _polar_depth(first.polar[i[pairs[flat]]], other.polar[j[pairs[flat]]])
        rest = pairs[~flat]
        depth[~flat] = _depth(mine, i[rest], others, j[rest], touching[rest])
        meet = np.flatnonzero(~flat & (depth > touching[pairs]))
        for chords in coarse_errors if len(meet) else ():
            some = pairs[meet]
            a, b = pieces(chords, some)
            depth[meet] = np.maximum(depth[meet], _depth(a, i[some], b, j[some], touching[some]))
        found = np.flatnonzero(depth > allowed[pairs])
        if len(found):
            pair = int(pairs[found[0]])
            return int(i[pair]), int(j[pair]), float(depth[found[0]])
    return None


def _near(first: Bodies, second: Bodies | None) -> tuple[Ints, Ints]:
    """Return the pairs of bodies whose bounding spheres overlap, (m,) and (m,), in their order.

    Trees are built of bodies of similar size, each within a factor of 2, so that a few large ones
    do not make candidates of all small ones.
    """
    other = first if second is None else second
    flat = bool(first.infinite.any() or other.infinite.any())
    axes = 2 if flat else 3
    classes = [[(np.flatnonzero(level == value)) for value in np.unique(level)] for level in (
        np.floor(np.log2(bodies.radius)) for bodies in (first, other))]
    pairs: list[Ints] = []
    for number, mine in enumerate(classes[0]):
        tree = cKDTree(first.centre[mine, :axes])
        largest = first.radius[mine].max()
        for theirs in classes[1] if second is not None else classes[1][:number + 1]:
            distance = largest + other.radius[theirs].max()
            if second is None and theirs is classes[1][number]:
                pairs.append(mine[tree.query_pairs(distance, output_type="ndarray")])
                continue
            found = tree.sparse_distance_matrix(
                cKDTree(other.centre[theirs, :axes]), distance, output_type="ndarray")
            pairs.append(np.column_stack([mine[found["i"]], theirs[found["j"]]]))
    both = np.vstack([np.zeros((0, 2), int), *pairs])
    if second is None:
        both = np.sort(both, axis=1)
    i, j = both.T
    apart = np.linalg.norm(first.centre[i, :axes] - other.centre[j, :axes], axis=1)
    keep = apart < first.radius[i] + other.radius[j]
    if second is not None:  # the sphere around a tube says little
        inner, outer, _, _, low, high = second.polar[j].T
        r, z = np.hypot(*first.centre[i, :2].T), first.centre[i, 2]
        reach = first.radius[i]
        keep &= ~((r + reach <= inner) | (r - reach >= outer)
                  | (~first.infinite[i] & ((z + reach <= low) | (z - reach >= high))))
    i, j = i[keep], j[keep]
    order = np.argsort(i * len(other.shape) + j, kind="stable")
    return i[order], j[order]


def _polar_depth(first: Floats, second: Floats) -> Floats:
    """Return how far sectors about the z axis penetrate, (m,) in m, from rows of `Bodies.polar`.

    It is the smallest one of their overlaps in radius, along the arc and in z.
    """
    a, b = first.T, second.T
    angle = (a[2] - b[2] + np.pi) % (2 * np.pi) - np.pi
    along = (a[3] + b[3] - np.abs(angle)) * np.minimum(a[1], b[1])
    return np.min([a[1] - b[0], b[1] - a[0], along, a[5] - b[4], b[5] - a[4]], axis=0)


class _Pieces:
    """The convex pieces of some shapes of bodies, in arrays of pieces with equal numbers of edges.

    Attributes
    ----------
    bodies : Bodies
    first, count : ndarray, shape (shapes,)
        Number of the first piece of every shape, and how many it has.
    effort : ndarray, shape (shapes,)
        Measure of the time to compare a shape: the more corners, the longer.
    centre, reach : ndarray, shape (pieces, 2) and (pieces,), in m
        Circle around the piece.
    kind, row : ndarray, shape (pieces,)
        Number of the array, and of the row in it.
    arrays : list of (ndarray, ndarray)
        Corners (m, corners, 2) in m, and the different directions of edges (m, directions, 2).
    """

    def __init__(self, bodies: Bodies, needed: Ints, chords: float, smallest: float) -> None:
        self.bodies = bodies
        self.count = np.zeros(len(bodies.shapes), int)
        self.effort = np.zeros(len(bodies.shapes), int)
        kinds: dict[tuple[int, int], int] = {}
        members: list[list[tuple[Floats, Floats]]] = []
        kind, row, circles = [], [], []
        for number in needed.tolist():
            pieces = bodies.shapes[number].pieces(chords, smallest)
            self.count[number] = len(pieces)
            self.effort[number] = sum(1 + len(corners) // 8 for corners, _ in pieces)
            for corners, directions in pieces:
                group = kinds.setdefault((len(corners), len(directions)), len(kinds))
                if group == len(members):
                    members.append([])
                kind.append(group)
                row.append(len(members[group]))
                members[group].append((corners, directions))
                centre = corners.mean(axis=0)
                circles.append((*centre, np.hypot(*(corners - centre).T).max()))
        self.first = np.cumsum(self.count) - self.count
        self.kind, self.row = np.array(kind, int), np.array(row, int)
        values = np.array(circles).reshape(-1, 3)
        self.centre, self.reach = values[:, :2], values[:, 2]
        self.arrays = [(np.array([corners for corners, _ in group]),
                        np.array([directions for _, directions in group])) for group in members]


def _depth(first: _Pieces, i: Ints, second: _Pieces, j: Ints, allowed: Floats) -> Floats:
    """Return how far bodies penetrate, (m,) in m: the most of any two of their pieces.

    Of pairs that are apart it is at most ``allowed`` (m,), the penetrations that are no overlap.
    """
    mine, others = first.bodies, second.bodies
    depth = np.zeros(len(i))
    start, counts = _reachable_pieces(mine, i, others, j, second.count[others.shape[j]])
    total = first.count[mine.shape[i]] * counts
    pair = np.repeat(np.arange(len(i)), total)
    local = np.arange(len(pair)) - np.repeat(np.cumsum(total) - total, total)
    a = first.first[mine.shape[i]][pair] + local // counts[pair]
    b = second.first[others.shape[j]][pair] + (
        start[pair] + local % counts[pair]) % second.count[others.shape[j]][pair]
    if len(pair) > len(i):  # of bodies of one piece it is known that they are near
        apart = mine.places(i[pair], first.centre[a]) - others.places(j[pair], second.centre[b])
        flat = mine.infinite[i[pair]] | others.infinite[j[pair]]
        apart[flat, 2] = 0.0
        near = np.linalg.norm(apart, axis=1) < (
            np.hypot(first.reach[a], mine.half_length[i[pair]])
            + np.hypot(second.reach[b], others.half_length[j[pair]]))
        pair, a, b = pair[near], a[near], b[near]
    for kind_a, (corners_a, directions_a) in enumerate(first.arrays):
        for kind_b, (corners_b, directions_b) in enumerate(second.arrays):
            rows = np.flatnonzero((first.kind[a] == kind_a) & (second.kind[b] == kind_b))
            if not len(rows):
                continue
            one, two, of = first.row[a[rows]], second.row[b[rows]], pair[rows]
            turn = mine.axes[i[of]].swapaxes(1, 2) @ others.axes[j[of]]
            shift = ((others.position[j[of]] - mine.position[i[of]])[:, None]
                     @ mine.axes[i[of]])[:, 0]
            prisms = Prisms(
                corners_a[one], directions_a[one], mine.limits[i[of]], corners_b[two],
                directions_b[two], others.limits[j[of]], turn, shift)
            np.maximum.at(depth, of, prisms.depth(allowed[of]))
    return depth


def _reachable_pieces(first: Bodies, i: Ints, second: Bodies, j: Ints,
                  count: Ints) -> tuple[Ints, Ints]:
    """Return the first piece, and how many, of second bodies that first bodies can touch, (m,).

    Of a tube about the z axis, whose pieces are numbered around it, it is those at the angles of
    the bounding sphere; of all others, every piece.
    """
    start, number = np.zeros(len(i), int), count.copy()
    tubes = np.flatnonzero(second.polar[j, 3] == np.pi)
    x, y, _ = first.centre[i[tubes]].T
    distance, reach = np.hypot(x, y), first.radius[i[tubes]]
    half = np.arcsin(np.clip(reach / np.maximum(distance, reach), 0.0, 1.0))
    half[reach >= distance] = np.pi
    per_angle = count[tubes] / (2 * np.pi)
    angle = np.arctan2(y, x) - (second.polar[j[tubes], 2] - np.pi)
    start[tubes] = np.floor((angle - half) * per_angle).astype(int)
    last = np.floor((angle + half) * per_angle).astype(int)
    number[tubes] = np.minimum(last - start[tubes] + 1, count[tubes])
    return start, number
