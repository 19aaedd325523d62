"""Symmetry of the array: blocks that are images of a source block, and turns of equal blocks.

The field of a source block, solved once, serves all its copies. F(x) is the matrix that maps the
magnetization of a block to B at x. Magnetization and B are axial vectors. The field matrix of a
block rotated by R is therefore ``F'(x) = R F(R^-1 x) R^T``, and of a block reflected by S in a
plane ``F'(x) = S F(S x) S``: the sign of axial vectors under reflection cancels.

`symmetry_images` returns the turns by which a magnet is turned onto itself, so that no field map
tells its blocks apart.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Outline, at_heights, points_on
from halbach_fe.study.external_keys import External

_HASH_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd numbers with well-mixed bits, which combine three rounded coordinates to a hash."""


@dataclass(frozen=True)
class SymmetryImage:
    """The reflection and rotation that map a source block to one of its copies."""

    source: int
    """Number of the source block."""
    turn: float = 0.0
    """Rotation about z, after the reflection. In rad."""
    mirrored: bool = False
    """Whether the source is reflected in the plane z = 0."""

    def to_source(self, points: Floats) -> Floats:
        """Return points (n, 3) moved by the inverse map, from the copy to the source."""
        found = points @ rotation_about_z(self.turn)
        return found * [1, 1, -1] if self.mirrored else found

    def from_source(self, field: Floats) -> Floats:
        """Return the field of the copy from the field of the source at the `to_source` points.

        ``field`` (..., 3, k): B per unit of magnetization along the first k axes (x, y in a
        cross-section).
        """
        size = field.shape[-1]
        turn = rotation_about_z(self.turn)
        if self.mirrored:
            sign = np.array([1.0, 1.0, -1.0])
            field = field * sign[:, None] * sign[:size]
        return np.asarray(turn @ field @ turn[:size, :size].T)


def unique_points(points: Floats) -> tuple[Floats, Ints]:
    """Return the distinct points (u, 3), and the index (n,) among them of each point (n, 3)."""
    grid_m = 1e-12  # grid in m that coordinates are rounded to before points are compared
    grid = np.round(points / grid_m).astype(np.int64)
    with np.errstate(over="ignore"):  # sorting one hash is faster than sorting three coordinates
        key = (grid.astype(np.uint64) * _HASH_FACTORS).sum(axis=1)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    found = points[first]
    if np.abs(found[inverse] - points).max(initial=0) > 2 * grid_m:  # two points share a hash
        found, inverse = np.unique(grid, axis=0, return_inverse=True)
        return found * grid_m, inverse.reshape(-1)
    return found, inverse.reshape(-1)


@dataclass(frozen=True)
class Symmetry:
    """The blocks of a study as images of a few source blocks."""

    images: tuple[SymmetryImage, ...]
    """One image per block, in the order of the blocks."""

    @cached_property
    def sources(self) -> tuple[int, ...]:
        """Numbers of the source blocks, whose fields have to be computed, in ascending order."""
        return tuple(sorted({image.source for image in self.images}))

    def source_points(self, points: Floats) -> tuple[Floats, list[Ints]]:
        """Return the points at which the fields of the source blocks are needed.

        The fields of all blocks at ``points`` follow from them, see `SymmetryImage.from_source`.

        Returns
        -------
        union : ndarray, shape (u, 3), in m
            The distinct points over all images.
        index : list of ndarray of int, shape (n,)
            For each block, which of them are the `SymmetryImage.to_source` of ``points``.
        """
        distinct = list(dict.fromkeys((image.turn, image.mirrored) for image in self.images))
        seen = [SymmetryImage(0, *motion).to_source(points) for motion in distinct]
        union, inverse = unique_points(np.vstack(seen))
        index = dict(zip(distinct, inverse.reshape(len(distinct), len(points)), strict=True))
        return union, [index[image.turn, image.mirrored] for image in self.images]


def no_symmetry(magnet: Magnet) -> Symmetry:
    """Return the trivial symmetry, in which every block is its own source."""
    return Symmetry(tuple(SymmetryImage(number) for number in range(len(magnet.blocks))))


def symmetry_of(magnet: Magnet) -> Symmetry:
    """Return the symmetry under rotations about z by whole blocks and reflection in z = 0.

    The shapes and permeabilities of the blocks decide, and whether coaxial iron is its own mirror
    image; their magnetizations may differ, because fields are computed per unit of magnetization.
    Rings that differ, free blocks and poles of iron have no symmetry here.
    """
    if not magnet.array.is_uniform or not magnet.iron_is_axisymmetric:
        return no_symmetry(magnet)
    blocks = magnet.blocks
    slots, rings = magnet.array.blocks_per_ring, magnet.array.rings
    tensors = np.array([b.recoil_tensor for b in blocks]).reshape(rings, slots, 3, 3)
    outlines = [block.outline for block in blocks[:slots]]
    pitch = 2 * np.pi / slots
    period = next(k for k in range(1, slots + 1) if slots % k == 0 and _is_periodic(
        outlines, tensors, k, pitch))
    ends = np.array([(body.inner_radius, body.outer_radius, body.z_min, body.z_max)
                     for body in magnet.iron]).reshape(-1, 4)
    mirror = magnet.dimension == 3 and _equal(tensors, tensors[::-1]) and (
        not len(ends) or _coincide(ends, ends[:, [0, 1, 3, 2]] * [1, 1, -1, -1]))
    images = []
    for number in range(len(blocks)):
        ring, slot = divmod(number, slots)
        mirrored = mirror and 2 * ring >= rings
        source = (rings - 1 - ring if mirrored else ring) * slots + slot % period
        images.append(SymmetryImage(source, (slot - slot % period) * pitch, mirrored))
    return Symmetry(tuple(images))


def _is_periodic(outlines: list[Outline], tensors: Floats, step: int, pitch: float) -> bool:
    """Tell whether a rotation by ``step`` slots maps all shapes and permeabilities onto themselves.

    ``pitch`` is the angle in rad between neighbouring slots.
    """
    space = rotation_about_z(step * pitch)
    if not _equal(np.roll(space @ tensors @ space.T, step, axis=1), tensors):
        return False
    turn = space[:2, :2]
    return all(_coincide(_ends(outline) @ turn.T, _ends(other))
               for outline, other in zip(outlines, outlines[step:] + outlines[:step], strict=True))


def _equal(tensors: Floats, others: Floats) -> bool:
    """Tell whether permeability tensors agree up to the rounding of their rotations."""
    return bool(np.abs(tensors - others).max() < 1e-12)


def _ends(outline: Outline) -> Floats:
    return np.array([edge.start for edge in outline])


def _coincide(corners: Floats, others: Floats) -> bool:
    """Tell whether two sets of points (n, d) in m are the same but for the rounding of turns."""
    return distance_apart(corners, others) < 1e-9


def distance_apart(corners: Floats, others: Floats) -> float:
    """Return how far two sets of points (n, d) in m are apart, in any order."""
    distance = np.linalg.norm(corners[:, None] - others[None], axis=2)
    return float(max(distance.min(axis=0).max(), distance.min(axis=1).max()))


def block_images(magnet: Magnet, turn: Floats, sign: int = 1) -> tuple[int, ...] | None:
    """Return the number from 0 of the equal block onto which each block is turned.

    ``turn`` (3, 3) is a rotation about the origin of the magnet. With a ``sign`` of -1 the turned
    block must have the reversed magnetization of the one that is there. None if a block has no
    equal one there. Magnets with iron or fields from outside, cross-sections and blocks of uneven
    magnetization are never said to be equal to themselves after a turn.
    """
    blocks = magnet.blocks
    if (magnet.iron or magnet.dimension == 2 or magnet.external != External() or any(
            block.gradient or block.corner_loss for block in blocks)):
        return None
    corners = [corners_of(block) for block in blocks]
    moments = np.array([block.polarization for block in blocks])
    middles = np.array([each.mean(axis=0) for each in corners])
    found = []
    # distance of corners in m, and difference of remanences in T, up to which blocks are equal:
    # more than the rounding of any study, and less than any deviation that is given
    same_m, same_T = 1e-7, 1e-7
    for number, block in enumerate(blocks):
        there = int(np.linalg.norm(middles - turn @ middles[number], axis=1).argmin())
        if (distance_apart(corners[number] @ turn.T, corners[there]) > same_m
                or np.abs(sign * turn @ moments[number] - moments[there]).max() > same_T
                or _permeabilities(block) != _permeabilities(blocks[there])):
            return None
        found.append(there)
    return tuple(found)


def symmetry_images(magnet: Magnet) -> list[tuple[int, ...]]:
    """Return what `block_images` says of every turn that brings the magnet onto itself.

    Turns by right angles are tried, and those that bring a ring of blocks onto itself, alone and
    with half a turn about x.
    """
    turns = [each for each in Rotation.create_group("O").as_matrix() if np.trace(each) < 2.9]
    count = max(Counter(block.ring for block in magnet.blocks).values(), default=0)
    most_in_ring = 64  # number of blocks of a ring up to which turns from block to block are tried
    if count <= most_in_ring:
        for number in range(count):
            about_z = Rotation.from_euler("z", 2 * np.pi * number / count)
            turns += [about_z.as_matrix(), (about_z * Rotation.from_euler(
                "x", np.pi)).as_matrix()][not number:]
    images = dict.fromkeys(image for turn in turns if (image := block_images(magnet, turn)))
    return list(images)


def _permeabilities(block: MagnetBlock) -> tuple[float, float]:
    """Return the relative permeabilities of a block."""
    return block.recoil_permeability, block.recoil_permeability_across


@lru_cache(maxsize=4096)
def corners_of(block: MagnetBlock) -> Floats:
    """Return points (n, 3) in m on the edges of a block; of an infinite one, at |z| of 1 m."""
    ends = (-1.0, 1.0) if np.isinf(block.z_max) else (block.z_min, block.z_max)
    corners = block.from_frame(at_heights(points_on(block.outline), *ends))
    corners.flags.writeable = False
    return corners
