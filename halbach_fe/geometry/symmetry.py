"""Symmetry of the array: blocks that are rotated or reflected copies of a source block.

The field of a source block, solved once, serves all its copies. F(x) is the matrix
that maps the magnetization of a block to B at x. Magnetization and B are axial vectors. The field
matrix of a block rotated by R is therefore ``F'(x) = R F(R^-1 x) R^T``, and of a block reflected
by S in a plane ``F'(x) = S F(S x) S``: the sign of axial vectors under reflection cancels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Outline

_ROUNDING = 1e-12
"""Grid in m that coordinates are rounded to before points are compared."""

_HASH_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd numbers with well-mixed bits, which combine three rounded coordinates to a hash."""


@dataclass(frozen=True)
class SymmetryImage:
    """The reflection and rotation that map a source block to one of its copies.

    Attributes
    ----------
    source : int
        Number of the source block.
    turn : float, in rad
        Rotation about z, after the reflection.
    mirrored : bool
        Whether the source is reflected in the plane z = 0.
    """

    source: int
    turn: float = 0.0
    mirrored: bool = False

    def to_source(self, points: Floats) -> Floats:
        """Return points (n, 3) moved by the inverse map, from the copy to the source."""
        found = points @ rotation_about_z(self.turn)
        return found * [1, 1, -1] if self.mirrored else found

    def from_source(self, field: Floats) -> Floats:
        """Return the field of the copy from the field of the source at the `to_source` points.

        Parameters
        ----------
        field : ndarray, shape (..., 3, k)
            B per unit of magnetization along the first k axes (x, y in a cross-section).
        """
        size = field.shape[-1]
        turn = rotation_about_z(self.turn)
        if self.mirrored:
            sign = np.array([1.0, 1.0, -1.0])
            field = field * sign[:, None] * sign[:size]
        return np.asarray(turn @ field @ turn[:size, :size].T)


def rotation_about_z(angle: float) -> Floats:
    """Return the matrix (3, 3) of a rotation about z by ``angle`` rad."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])


def unique_points(points: Floats) -> tuple[Floats, Ints]:
    """Return the distinct points (u, 3), and the index (n,) among them of each point (n, 3)."""
    grid = np.round(points / _ROUNDING).astype(np.int64)
    with np.errstate(over="ignore"):  # sorting one hash is faster than sorting three coordinates
        key = (grid.astype(np.uint64) * _HASH_FACTORS).sum(axis=1)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    found = points[first]
    if np.abs(found[inverse] - points).max(initial=0) > 2 * _ROUNDING:  # two points share a hash
        found, inverse = np.unique(grid, axis=0, return_inverse=True)
        return found * _ROUNDING, inverse.reshape(-1)
    return found, inverse.reshape(-1)


@dataclass(frozen=True)
class Symmetry:
    """The blocks of a study as images of a few source blocks.

    Attributes
    ----------
    images : tuple of SymmetryImage
        One image per block, in the order of the blocks.
    """

    images: tuple[SymmetryImage, ...]

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

    The shapes and permeabilities of the blocks decide; their magnetizations may differ, because
    fields are computed per unit of magnetization. Rings that differ, free blocks and poles of iron
    have no symmetry here.
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
    mirror = magnet.dimension == 3 and _equal(tensors, tensors[::-1])
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
    return all(_same_shape(_corners(outline) @ turn.T, _corners(other))
               for outline, other in zip(outlines, outlines[step:] + outlines[:step], strict=True))


def _equal(tensors: Floats, others: Floats) -> bool:
    """Tell whether permeability tensors agree up to the rounding of their rotations."""
    return bool(np.abs(tensors - others).max() < 1e-12)


def _corners(outline: Outline) -> Floats:
    return np.array([edge.start for edge in outline])


def _same_shape(corners: Floats, others: Floats) -> bool:
    """Tell whether two sets of corners (n, 2) in m are the same in any order."""
    distance = np.linalg.norm(corners[:, None] - others[None], axis=2)
    return bool((distance.min(axis=0) < 1e-9).all() and (distance.min(axis=1) < 1e-9).all())
