"""Blocks that are others turned or mirrored, so that one solve or integral serves them all.

Magnetization and B are axial vectors: under a rotation R the field of a turned block is
``F'(x) = R F(R^-1 x) R^T`` (F maps its magnetization to B), and under the reflection S in a plane
``F'(x) = S F(S x) S``, the sign of an axial vector cancelling.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Outline

_ROUNDING = 1e-12  # m; coordinates nearer than this are one point
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


@dataclass(frozen=True)
class SymmetryImage:
    """How a block comes from its source: turned about z by ``turn`` rad, after being mirrored in
    the plane z = 0 if ``mirrored``.
    """

    source: int
    turn: float = 0.0
    mirrored: bool = False

    def to_source(self, points: Floats) -> Floats:
        """Where points (n, 3) lie as seen from the source."""
        found = points @ rotation_about_z(self.turn)
        return found * [1, 1, -1] if self.mirrored else found

    def from_source(self, field: Floats) -> Floats:
        """Turn the source's field (..., 3, k), per unit along its k axes, to the block's place.

        With k = 2 the axes are those of the cross-section.
        """
        size = field.shape[-1]
        turn = rotation_about_z(self.turn)
        if self.mirrored:
            sign = np.array([1.0, 1.0, -1.0])
            field = field * sign[:, None] * sign[:size]
        return np.asarray(turn @ field @ turn[:size, :size].T)


def rotation_about_z(angle: float) -> Floats:
    """Rotation about z by ``angle`` rad, (3, 3)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])


def unique_points(points: Floats) -> tuple[Floats, Ints]:
    """Points (u, 3) without repetition, and which of them each of the points (n, 3) is."""
    grid = np.round(points / _ROUNDING).astype(np.int64)
    with np.errstate(over="ignore"):  # a hash: one number sorts faster than three
        key = (grid.astype(np.uint64) * _MIX).sum(axis=1)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    found = points[first]
    if np.abs(found[inverse] - points).max(initial=0) > 2 * _ROUNDING:  # a collision
        found, inverse = np.unique(grid, axis=0, return_inverse=True)
        return found * _ROUNDING, inverse.reshape(-1)
    return found, inverse.reshape(-1)


@dataclass(frozen=True)
class Symmetry:
    """Every block of a study as one of a few sources, placed.

    Attributes
    ----------
    placements : tuple of Placement
        By block.
    """

    placements: tuple[SymmetryImage, ...]

    @cached_property
    def sources(self) -> tuple[int, ...]:
        """Blocks that have to be solved for, in ascending order."""
        return tuple(sorted({placement.source for placement in self.placements}))

    def spread(self, points: Floats) -> tuple[Floats, list[Ints]]:
        """All points as all sources see them, without repetition; and for every placement which
        of them its points are.
        """
        distinct = list(dict.fromkeys((p.turn, p.mirrored) for p in self.placements))
        seen = [SymmetryImage(0, *way).to_source(points) for way in distinct]
        union, inverse = unique_points(np.vstack(seen))
        index = dict(zip(distinct, inverse.reshape(len(distinct), len(points)), strict=True))
        return union, [index[p.turn, p.mirrored] for p in self.placements]


def no_symmetry(magnet: Magnet) -> Symmetry:
    """Every block is its own source."""
    return Symmetry(tuple(SymmetryImage(number) for number in range(len(magnet.blocks))))


def symmetry_of(magnet: Magnet) -> Symmetry:
    """Find the rotations by blocks, and the mirror in z = 0, that leave materials as they are.

    The iron ring and the boundary are symmetric always.
    """
    blocks = magnet.blocks
    slots, rings = magnet.array.blocks_per_ring, magnet.array.rings
    tensors = np.array([b.recoil_tensor for b in blocks]).reshape(rings, slots, 3, 3)
    outlines = [block.outline for block in blocks[:slots]]
    pitch = 2 * np.pi / slots
    period = next(k for k in range(1, slots + 1) if slots % k == 0 and _turns(
        outlines, tensors, k, pitch))
    mirror = magnet.dimension == 3 and _equal(tensors, tensors[::-1])
    placements = []
    for number in range(len(blocks)):
        ring, slot = divmod(number, slots)
        mirrored = mirror and 2 * ring >= rings
        source = (rings - 1 - ring if mirrored else ring) * slots + slot % period
        placements.append(SymmetryImage(source, (slot - slot % period) * pitch, mirrored))
    return Symmetry(tuple(placements))


def _turns(outlines: list[Outline], tensors: Floats, step: int, pitch: float) -> bool:
    """Tell whether a turn by ``step`` blocks leaves shapes and permeabilities as they are."""
    space = rotation_about_z(step * pitch)
    if not _equal(np.roll(space @ tensors @ space.T, step, axis=1), tensors):
        return False
    turn = space[:2, :2]
    return all(_same_shape(_corners(one) @ turn.T, _corners(other))
               for one, other in zip(outlines, outlines[step:] + outlines[:step], strict=True))


@dataclass(frozen=True)
class Frame:
    """A block's own coordinates: x through its middle, from the z axis, at half its height.

    Attributes
    ----------
    angle : float
        Of the block's middle about the z axis, in rad.
    centre : float
        Its z in m; 0 if it is infinitely long.
    shape : tuple
        Equal for congruent blocks.
    even : bool
        Whether the outline is its own mirror image in y.
    """

    angle: float
    centre: float
    shape: tuple[object, ...]
    even: bool

    def local(self, points: Floats) -> tuple[Floats, Floats]:
        """Points (n, 3) in the frame, folded to y, z >= 0 as far as the block is symmetric; and
        the signs (n, 3) that unfold the field.
        """
        found = (points - [0, 0, self.centre]) @ rotation_about_z(self.angle)
        signs = np.ones_like(found)
        for axis in ((1, 2) if self.even else (2,)):
            signs[:, axis] = np.where(found[:, axis] < 0, -1.0, 1.0)
        return found * signs, signs

    def unfold(self, field: Floats, signs: Floats) -> Floats:
        """A field (n, 3, 3) in the frame's quadrant, at the block's place."""
        turn = rotation_about_z(self.angle)
        return np.asarray(turn @ (field * signs[:, :, None] * signs[:, None, :]) @ turn.T)


def frame_of(block: MagnetBlock) -> Frame:
    """The frame of a block."""
    corners = _corners(block.outline)
    middle = corners.mean(axis=0)
    angle = float(np.arctan2(middle[1], middle[0]))
    local = corners @ rotation_about_z(angle)[:2, :2]
    infinite = bool(np.isinf(block.z_max))
    length = np.inf if infinite else float(np.round(block.z_max - block.z_min, 12))
    order = np.lexsort(np.round(local, 9).T)
    shape = (length, tuple(edge.arc for edge in block.outline),
             *np.round(local[order], 9).ravel().tolist())
    return Frame(angle, 0.0 if infinite else (block.z_min + block.z_max) / 2, shape,
                 _same_shape(local * [1, -1], local))


def _equal(one: Floats, other: Floats) -> bool:
    """Tell whether permeabilities are the same but for rounding of their turns."""
    return bool(np.abs(one - other).max() < 1e-12)


def _corners(outline: Outline) -> Floats:
    return np.array([edge.start for edge in outline])


def _same_shape(one: Floats, other: Floats) -> bool:
    """Tell whether two sets of corners (n, 2) are the same, in any order."""
    distance = np.linalg.norm(one[:, None] - other[None], axis=2)
    return bool((distance.min(axis=0) < 1e-9).all() and (distance.min(axis=1) < 1e-9).all())
