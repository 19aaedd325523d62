"""How blocks can be mounted in other places: the rotations that leave a block's shape as it is.

A sector or a trapezoid can be turned end for end, by 180 degrees about its radial axis; a cuboid
about each of its axes, by 90 degrees where two sides are equal. A block fits a slot if, carried
there in its own axes and turned so, its nominal magnetization points where that slot's should.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.array_layout import facing_angle_deg, position_angle_deg
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.mounting import as_meant, mountings
from halbach_fe.geometry.symmetry import rotation_about_z
from halbach_fe.study.magnet import BlockException

DIRECTION = np.radians(2.0)
"""How far a nominal magnetization may be from where it should point. Exceptions of a study turn
blocks by less; what a move does to the field is computed from the real magnetizations anyway."""

SAME_SIZE = 1e-6
"""Relative difference of a cuboid's sides that are equal."""

EXACT = 1e-9
"""Relative, of matrices that must be the same: rounding leaves 1e-15."""


@dataclass(frozen=True)
class Mounts:
    """Slots, and what fits them.

    Attributes
    ----------
    places : tuple of (ring, slot)
    frames : ndarray, shape (slots, 3, 3)
        From the own axes of a slot's shape to the magnet's.
    turns : ndarray, shape (turns, 3, 3)
        Rotations of a block in its own axes that leave its shape as it is, the first none.
    wanted, there : ndarray, shape (slots, 3)
        Nominal directions in own axes: as designed, and of the block that is there (0 if none is).
    kinds, kinds_there : ndarray of int, shape (slots,)
        Blocks of the same remanence and permeability have the same number.
    """

    places: tuple[tuple[int, int], ...]
    frames: Floats
    turns: Floats
    wanted: Floats
    there: Floats
    kinds: Ints
    kinds_there: Ints

    def fits(self, directions: Floats, kinds: Ints) -> NDArray[np.bool_]:
        """Which blocks fit where, (turns, slots, blocks), by their nominal direction in own axes
        (blocks, 3) and kind (blocks,).
        """
        alike = self.kinds[:, None] == kinds
        return np.array([alike & (self.wanted @ turn @ directions.T > np.cos(DIRECTION))
                         for turn in self.turns])

    def carried(self, to: Ints, turn: Ints) -> Floats:
        """From own axes of a block to the magnet's, (n, 3, 3), in some slots and by some turns."""
        return np.asarray(self.frames[to] @ self.turns[turn])

    def turn_deg(self, turn: int) -> tuple[float, float, float]:
        """A turn as a rotation vector along the block's own axes, in degrees."""
        return rotation_deg(self.turns[turn])


def mounts_of(magnet: Magnet) -> Mounts:
    """Slots of a study as its blocks stand in them."""
    meant, built = as_meant(magnet).blocks, magnet.blocks
    frames = np.array([rotation_about_z(np.radians(facing_angle_deg(magnet.array, block.slot)))
                       for block in meant])
    kinds = _kinds(meant)
    sources = np.array([source for source, _ in mountings(magnet)])
    return Mounts(
        tuple((block.ring, block.slot) for block in meant), frames,
        shape_turns(_sides(magnet)), _directions(meant, frames), _directions(built, frames), kinds,
        kinds[sources])


def shape_turns(sides: tuple[float, float, float] | None) -> Floats:
    """Rotations (n, 3, 3) that leave a cuboid of some sides as it is, or (None) a block with an
    inner and an outer face; the first is none at all.
    """
    turns = Rotation.create_group("O").as_matrix().round()
    if sides is None:
        turns = turns[[np.array_equal(turn, np.diag(np.diag(turn))) and turn[0, 0] == 1
                       for turn in turns]]
    else:
        turned = np.abs(turns) @ np.array(sides)
        turns = turns[np.isclose(turned, sides, SAME_SIZE, 0).all(axis=1)]
    angle = np.linalg.norm(Rotation.from_matrix(turns).as_rotvec(), axis=1)
    return np.asarray(turns[np.argsort(angle, kind="stable")])


def _sides(magnet: Magnet) -> tuple[float, float, float] | None:
    array = magnet.array
    if array.block.shape != "cuboid":
        return None
    # in a cross-section no other side is as long as that along z
    length = array.ring_length_m if magnet.dimension == 3 else None
    return (array.outer_radius_m - array.inner_radius_m, array.block.width_m,
            length or 2 * array.outer_radius_m + array.block.width_m)


def _directions(blocks: Sequence[MagnetBlock], frames: Floats) -> Floats:
    """Of the nominal magnetizations, in own axes; 0 of a block that is missing."""
    vectors = np.array([block.magnetization for block in blocks])
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.einsum("nji,nj->ni", frames, vectors / np.where(size > 0, size, 1.0))


def _kinds(blocks: Sequence[MagnetBlock]) -> Ints:
    kinds = [tuple(float(f"{value:.9g}") for value in _own(block)[:3]) for block in blocks]
    numbers = {kind: number for number, kind in enumerate(dict.fromkeys(kinds))}
    return np.array([numbers[kind] for kind in kinds])


def rotation_deg(turn: Floats) -> tuple[float, float, float]:
    """Rotation vector in degrees of a matrix (3, 3), without rounding errors."""
    x, y, z = (np.degrees(Rotation.from_matrix(turn).as_rotvec()).round(9) + 0.0).tolist()
    return x, y, z


def remounted(magnet: Magnet, moved: Iterable[tuple[int, int, Floats]]) -> Magnet | None:
    """The study with blocks in other places, or None if its exceptions cannot express that.

    Parameters
    ----------
    moved : iterable of (int, int, ndarray)
        Where to and where from (slots counted from 0, ring by ring), and the matrix (3, 3) from
        the magnetization there to the one here, along the magnet's axes.
    """
    array, before, old = magnet.array, mountings(magnet), magnet.blocks
    moved = list(moved)
    exceptions, expected = [], {}
    for to, source, matrix in moved:
        meant, earlier = before[source]
        total = matrix @ earlier
        here, there = (rotation_about_z(np.radians(position_angle_deg(array, old[i].slot)))
                       for i in (to, meant))
        exceptions.append(BlockException(
            ring=old[to].ring, slot=old[to].slot,
            mounted_from=(old[meant].ring, old[meant].slot),
            rotation_deg=rotation_deg(here.T @ total @ there)
            if np.isclose(np.linalg.det(total), 1.0) else (0.0, 0.0, 0.0)))
        expected[to] = source, meant, total
    changed = magnet.with_(array__exceptions=array.exceptions + tuple(exceptions))
    after, new = mountings(changed), changed.blocks
    for to, (source, meant, total) in expected.items():
        same = after[to][0] == meant and np.allclose(after[to][1], total, 0, EXACT)
        if not same or new[to].shift != old[to].shift or not np.allclose(
                _own(new[to]), _own(old[source]), EXACT, 0):
            return None
    return changed


def _own(block: MagnetBlock) -> tuple[float, ...]:
    """What a block takes along."""
    return (block.remanence, block.recoil_permeability, block.recoil_permeability_across,
            block.gradient, block.corner_loss)
