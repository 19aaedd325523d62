"""Cells of blocks: prisms on quadrilaterals, each with a polarization of its own.

A block with four sides, such as a sector, a trapezoid or a cuboid, is cut along lines between its
inner and its outer face. Any other outline is first cut into convex quadrilaterals. Arcs become
chords whose ends lie farther out than the arc, so that the area is right. The cells of a block have
together its volume and its centroid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from halbach_fe.core.arrays import Bools, Floats, Ints, azimuths_of
from halbach_fe.geometry.blocks import MagnetBlock, frames_of
from halbach_fe.geometry.outline import Edge, Outline, at_heights, outline_centroid

CHORD = np.pi / 6
"""Largest angle in rad of an arc that becomes a chord. A chord of 30 degrees leaves the arc by
1.7 % of its radius on either side, if its area is right."""

MOST_CORNERS = 6
"""Largest number of corners of a convex polygon that is cut at the middles of its sides. A rounder
one is cut from its centroid to every other corner, which makes half as many cells."""


@dataclass(frozen=True)
class Cells:
    """The cells of blocks, in the order of the blocks."""

    block: Ints
    """Number of the block. Shape (n,)."""
    centre: Floats
    """Centroid, which is the origin of the cell's frame. Shape (n, 3), in m."""
    axes: Floats
    """Axes of the frame as columns. Shape (n, 3, 3)."""
    vertices: Floats
    """Corners of the base in the frame, counter-clockwise; two coincide for a triangle.
    Shape (n, 4, 2), in m."""
    half: Floats
    """Half the height. Shape (n,), in m."""
    cuboid: Bools
    """Whether the base is a rectangle along the axes of the frame. Shape (n,)."""
    divisions: int = 2
    """Number of nodes per direction."""

    def __len__(self) -> int:
        return len(self.block)

    @cached_property
    def radius(self) -> Floats:
        """Radius (n,) in m of the sphere about the centre that contains the cell."""
        base = np.sum(self.vertices**2, axis=2).max(axis=1)
        return np.sqrt(base + self.half**2)

    @cached_property
    def volume(self) -> Floats:
        """Volume (n,) in m^3."""
        return 2 * self.half * area_and_centroid(self.vertices)[0]

    @cached_property
    def _local_nodes(self) -> tuple[Floats, Floats]:
        return gauss_nodes(self.vertices, self.half, self.divisions)

    @cached_property
    def nodes(self) -> Floats:
        """Gauss nodes (n, q, 3) in m in every cell, along its own directions."""
        return np.asarray(
            self.centre[:, None] + self._local_nodes[0] @ np.swapaxes(self.axes, 1, 2))

    @cached_property
    def weights(self) -> Floats:
        """Weights (n, q) of the nodes, whose sum over a cell is 1."""
        return self._local_nodes[1]

    @property
    def cuts(self) -> Floats:
        """Limits (g + 1,) of the parts about the nodes along a direction, from 0 to 1."""
        weights = np.polynomial.legendre.leggauss(self.divisions)[1] / 2
        return np.concatenate([[0.0], np.cumsum(weights)])

    @cached_property
    def of_parts(self) -> Floats:
        """Matrix (q, q) from values at the nodes to those of uniform parts about the nodes.

        Parts have the same moments as dipoles at the nodes: in each direction the integrals of the
        value times 1, x, ..., x^(g - 1). Parts with the values of their nodes have 13 % less of the
        second one (g = 2), and the field of a cell would jump where dipoles take their place.
        """
        nodes, weights = np.polynomial.legendre.leggauss(self.divisions)
        powers, limits = np.arange(self.divisions)[:, None], 2 * self.cuts - 1
        of_parts = np.diff(limits**(powers + 1), axis=1) / (powers + 1)
        along = np.linalg.solve(of_parts, weights * nodes**powers)
        return np.asarray(np.kron(np.kron(along, along), along))

    def mean(self, values: Floats) -> Floats:
        """Return the means (n, 3) over the cells of values (n, q, 3) at their nodes."""
        return np.einsum("nq,nqi->ni", self.weights, values)


def gauss_nodes(vertices: Floats, half: Floats, divisions: int,
                graded: bool = False) -> tuple[Floats, Floats]:
    """Return nodes (n, q, 3) in m in the frames of prisms and their relative weights (n, q).

    Nodes are products of Gauss nodes along both directions of the quadrilateral and the height.
    If ``graded``, they are concentrated at the faces by ``t = 3 x^2 - 2 x^3``, which integrates the
    logarithmic singularities at edges more accurately.
    """
    t, weight = np.polynomial.legendre.leggauss(divisions)
    t, weight = (t + 1) / 2, weight / 2
    if graded:
        weight, t = weight * 6 * t * (1 - t), t * t * (3 - 2 * t)
    r, s = (grid.ravel() for grid in np.meshgrid(t, t, indexing="ij"))
    shape = np.array([(1 - r) * (1 - s), r * (1 - s), r * s, (1 - r) * s])
    by_r = np.array([s - 1, 1 - s, s, -s])
    by_s = np.array([r - 1, -r, r, 1 - r])
    base = np.einsum("cq,nci->nqi", shape, vertices)
    along, across = (np.einsum("cq,nci->nqi", d, vertices) for d in (by_r, by_s))
    area = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    area = area * np.outer(weight, weight).ravel()
    area /= area.sum(axis=1, keepdims=True)
    nodes = np.empty((len(vertices), divisions**3, 3))
    nodes[..., :2] = np.repeat(base, divisions, axis=1)
    nodes[..., 2] = np.tile((2 * t - 1) * half[:, None], (1, divisions**2))
    return nodes, np.repeat(area, divisions, axis=1) * np.tile(weight, divisions**2)


def cells_of(blocks: Sequence[MagnetBlock], per_side: int, divisions: int = 2) -> Cells:
    """Divide blocks into cells.

    Parameters
    ----------
    blocks : sequence of MagnetBlock
        Of finite length.
    per_side : int
        Cells along each side of a cube. Blocks that are longer in one direction have more cells
        there: the number along a direction is that of a cube of the same volume, times the ratio of
        the sides, and not less than ``per_side``.
    divisions : int
        Nodes per direction in every cell.
    """
    known: dict[tuple[object, ...], tuple[Floats, ...]] = {}
    number, centres, axes, corners, halves, flags = [], [], [], [], [], []
    for i, (block, position, frame) in enumerate(zip(blocks, *frames_of(blocks), strict=True)):
        key = block.outline, block.z_min, block.z_max
        if key not in known:
            known[key] = _local_cells(block, per_side)
        place, turn, vertices, half, cuboid = known[key]
        number.append(np.full(len(half), i))
        centres.append(place @ frame.T + position)
        axes.append(frame @ turn)
        corners.append(vertices)
        halves.append(half)
        flags.append(cuboid)
    if not number:
        return Cells(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 4, 2)),
                     np.zeros(0), np.zeros(0, bool), divisions)
    return Cells(np.concatenate(number), np.concatenate(centres), np.concatenate(axes),
                 np.concatenate(corners), np.concatenate(halves), np.concatenate(flags), divisions)


def _local_cells(block: MagnetBlock, per_side: int) -> tuple[Floats, ...]:
    """Return centres, axes, vertices, half heights and cuboid flags in the block's frame."""
    height = block.z_max - block.z_min
    size = np.cbrt(block.volume) / per_side
    quads = _scale_to_outline(quadrilaterals(block.outline, size, per_side), block)
    layers = max(per_side, round(height / size))
    levels = block.z_min + height * (np.arange(layers) + 0.5) / layers
    _, middle = area_and_centroid(quads)
    local = quads - middle[:, None]
    sides = np.roll(local, -1, axis=1) - local
    scale = np.abs(local).max(axis=(1, 2))
    cuboid = (np.abs(sides[:, 0] + sides[:, 2]).max(axis=1) < 1e-9 * scale) & (
        np.abs(np.sum(sides[:, 0] * sides[:, 1], axis=1)) < 1e-9 * scale**2)
    # along a side of a cuboid; along a diagonal of others, which no triangle lacks: so the cells of
    # congruent sectors are equal in their frames
    first = np.where(cuboid[:, None], sides[:, 0], local[:, 2] - local[:, 0])
    angle = azimuths_of(first)
    turn = np.zeros((len(quads), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0], turn[:, 0, 1] = np.sin(angle), -np.sin(angle)
    turn[:, 2, 2] = 1.0
    local = np.einsum("nci,nij->ncj", local, turn[:, :2, :2])
    places = at_heights(middle, *levels)
    return (places, np.tile(turn, (layers, 1, 1)), np.tile(local, (layers, 1, 1)),
            np.full(len(places), height / layers / 2), np.tile(cuboid, layers))


def area_and_centroid(polygons: Floats) -> tuple[Floats, Floats]:
    """Return areas (n,) in m^2 and centroids (n, 2) in m of polygons (n, m, 2)."""
    origin = polygons.mean(axis=1, keepdims=True)
    x, y = np.moveaxis(polygons - origin, 2, 0)
    following = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    cross = x * following[1] - following[0] * y
    area = cross.sum(axis=1) / 2
    centroid = np.stack([np.sum((x + following[0]) * cross, axis=1),
                         np.sum((y + following[1]) * cross, axis=1)], axis=1) / 6
    return area, origin[:, 0] + centroid / area[:, None]


def _scale_to_outline(quads: Floats, block: MagnetBlock) -> Floats:
    """Scale and move quadrilaterals (k, 4, 2) to the area and the centroid of an outline."""
    if not any(edge.arc for edge in block.outline):
        return quads
    areas, middles = area_and_centroid(quads)
    middle = areas @ middles / areas.sum()
    return (quads - middle) * np.sqrt(block.area / areas.sum()) + outline_centroid(block.outline)


def quadrilaterals(outline: Outline, size: float, least: int) -> Floats:
    """Cut an outline into convex quadrilaterals (k, 4, 2) of sides of about ``size``, in m.

    A four-sided outline has at least ``least`` of them along either direction; a convex polygon
    that may have a single one is in as few pieces as possible, any other in several.
    """
    grid = _four_sided(outline)
    if grid is not None:
        return _grid(grid, size, least)
    polygon = _polygon(outline, size)
    if not _is_convex(polygon):
        pieces = _merge_triangles(polygon, _triangles(polygon))
    elif least == 1 and len(polygon) <= MOST_CORNERS:
        pieces = _cut_from_corner(polygon)
    else:
        pieces = _cut_from_centroid(polygon)
    return np.concatenate([_grid(_edges(piece), size) for piece in pieces])


def _edges(quad: Floats) -> Outline:
    corners = [(float(x), float(y)) for x, y in quad]
    return tuple(Edge(corners[i], corners[(i + 1) % 4]) for i in range(4))


def _four_sided(outline: Outline) -> Outline | None:
    """Return an outline of four sides, convex between its corners, with any arcs at sides 1 and 3.

    Return None for other outlines.
    """
    if len(outline) != 4 or not _is_convex(np.array([edge.start for edge in outline])):
        return None
    if outline[0].arc or outline[2].arc:
        outline = outline[1:] + outline[:1]
    return None if outline[0].arc or outline[2].arc else outline


def _grid(outline: Outline, size: float, least: int = 1) -> Floats:
    """Cut an outline of four sides along straight lines between its sides 1 and 3."""
    width = max(least, round((outline[1].length + outline[3].length) / 2 / size))
    for edge in (outline[1], outline[3]):
        if edge.arc:
            width = max(width, int(np.ceil(abs(edge.angles[1]) / CHORD - 1e-9)))
    depth = max(least, round((outline[0].length + outline[2].length) / 2 / size))
    t = np.arange(width + 1) / width
    far, near = (edge.at(place)[0] * _bulge(edge, width)
                 for edge, place in ((outline[1], t), (outline[3], 1 - t)))
    share = np.arange(depth + 1)[:, None, None] / depth
    lines = (1 - share) * near + share * far  # (depth + 1, width + 1, 2)
    quads = np.stack([lines[:-1, :-1], lines[1:, :-1], lines[1:, 1:], lines[:-1, 1:]], axis=2)
    return quads.reshape(-1, 4, 2)


def _bulge(edge: Edge, chords: int) -> float:
    """Return the factor of the radius of the ends of an arc's chords that makes the area right."""
    if not edge.arc:
        return 1.0
    angle = abs(edge.angles[1]) / chords
    return float(np.sqrt(angle / np.sin(angle)))


def _polygon(outline: Outline, size: float) -> Floats:
    """Return the corners (m, 2) in m of an outline, with arcs divided into chords."""
    corners = []
    for i, edge in enumerate(outline):
        chords = 1
        if edge.arc:
            chords = max(int(np.ceil(abs(edge.angles[1]) / CHORD - 1e-9)),
                         round(edge.length / size))
        points = edge.at(np.arange(chords) / chords)[0]
        # a corner between an arc and a straight side stays in its place
        points[0 if outline[i - 1].arc else 1:] *= _bulge(edge, chords)
        corners.append(points)
    return np.vstack(corners)


def _cross(a: Floats, b: Floats, c: Floats) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _is_convex(polygon: Floats) -> bool:
    """Tell whether a counter-clockwise polygon (m, 2) has no corner that points inwards."""
    tiny = 1e-9 * float(np.ptp(polygon)) ** 2
    return all(_cross(polygon[i - 2], polygon[i - 1], polygon[i]) > -tiny
               for i in range(len(polygon)))


def _cut_from_centroid(polygon: Floats) -> list[Floats]:
    """Cut a convex polygon (m, 2) into quadrilaterals about its centroid."""
    centre = area_and_centroid(polygon[None])[1][0]
    count = len(polygon)
    if count <= MOST_CORNERS:
        middles = (polygon + np.roll(polygon, -1, axis=0)) / 2
        return [np.array([polygon[i], middles[i], centre, middles[i - 1]]) for i in range(count)]
    pieces = [np.array([centre, polygon[i], polygon[i + 1], polygon[(i + 2) % count]])
              for i in range(0, count - 1, 2)]
    if count % 2:
        pieces.append(np.array([centre, polygon[-1], polygon[0], polygon[0]]))
    return pieces


def _cut_from_corner(polygon: Floats) -> list[Floats]:
    """Cut a convex polygon (m, 2) into as few quadrilaterals as possible, a triangle among them."""
    count = len(polygon)
    return [polygon[[0, i, i + 1, min(i + 2, count - 1)]] for i in range(1, count - 1, 2)]


def _triangles(polygon: Floats) -> list[tuple[int, int, int]]:
    """Return the triangles of a polygon (m, 2), as numbers of its corners, by cutting off ears."""
    left, found = list(range(len(polygon))), []
    while len(left) > 3:
        heights = []
        for place in range(len(left)):
            i, j, k = left[place - 1], left[place], left[(place + 1) % len(left)]
            a, b, c = polygon[i], polygon[j], polygon[k]
            ear = _cross(a, b, c) > 0 and not any(
                _cross(a, b, p) >= 0 and _cross(b, c, p) >= 0 and _cross(c, a, p) >= 0
                for p in polygon[[other for other in left if other not in (i, j, k)]])
            longest = max(np.hypot(*(b - a)), np.hypot(*(c - b)), np.hypot(*(a - c)))
            heights.append(_cross(a, b, c) / longest**2 if ear else -np.inf)
        place = int(np.argmax(heights))  # the ear that is least like a needle
        found.append((left[place - 1], left[place], left[(place + 1) % len(left)]))
        del left[place]
    return [*found, (left[0], left[1], left[2])]


def _merge_triangles(polygon: Floats, triangles: list[tuple[int, int, int]]) -> list[Floats]:
    """Return quadrilaterals of the triangles of a polygon (m, 2).

    Two triangles that share a side become one if it is convex; others are cut in three.
    """
    pieces, left = [], list(triangles)
    while left:
        triangle = left.pop()
        for turned in (triangle[place:] + triangle[:place] for place in range(3)):
            i, j, k = turned
            for other in left:
                if j in other and k in other:
                    opposite = next(corner for corner in other if corner not in (j, k))
                    quad = polygon[[i, j, opposite, k]]
                    if _is_convex(quad):
                        pieces.append(quad)
                        left.remove(other)
                        break
            else:
                continue
            break
        else:
            pieces += _cut_from_centroid(polygon[list(triangle)])
    return pieces
