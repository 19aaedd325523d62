"""Slots into which blocks can be moved, and the rotations that leave a block's shape unchanged.

A sector or a trapezoid can be turned by 180 degrees about its radial axis. A cuboid can be turned
by 180 degrees about each of its axes, and by 90 degrees about an axis across which the two sides
are equal. A block fits a slot if it has the slot's shape, and its nominal magnetization points in
the direction that the design requires there, after the block is moved to the slot (in the
orientation of its shape there) and turned by one of these rotations.

The "own axes" of a block are the axes of its shape: radial (or along the design magnetization),
transverse and along z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import as_meant, mountings, properties, rotation_deg

LARGEST_ANGLE = np.radians(2.0)
"""Largest angle in rad between the nominal magnetization of a block that fits a slot and the
direction that the design requires there. Rotations in the exceptions of a study are smaller. The
effect of a move on the field is computed from the inferred magnetizations, whatever this angle
is."""

SAME_SIZE = 1e-6
"""Relative difference up to which two sides of a cuboid count as equal."""


@dataclass(frozen=True)
class Mounts:
    """Slots of a magnet, and the data that decide which blocks fit them."""

    places: tuple[tuple[int, int], ...]
    """Ring and slot of each slot, both counted from 1. As (ring, slot)."""
    frames: Floats
    """Rotations from the own axes of a slot's shape to the axes of the magnet.
    Shape (slots, 3, 3)."""
    turns: Floats
    """Rotations of a block, in its own axes, that leave some shape unchanged. The first is the
    identity. Shape (turns, 3, 3)."""
    allowed: Bools
    """Which of them leave the shape of the block in a slot unchanged. Shape (turns, slots)."""
    designed: Floats
    """Directions of the design magnetization of each slot, in own axes. Shape (slots, 3)."""
    current: Floats
    """Directions of the nominal magnetization of the block that is in each slot now, in own axes; 0
    where the block is missing. Shape (slots, 3)."""
    kinds: Ints
    current_kinds: Ints
    """Kind of block that the design requires in each slot, and kind of the block that is there now.
    Blocks of the same shape, remanence and recoil permeabilities are of the same kind.
    Shape (slots,)."""

    def fits(self, directions: Floats, kinds: Ints) -> Bools:
        """Return which blocks fit which slots, shape (turns, slots, blocks).

        Parameters
        ----------
        directions : ndarray, shape (blocks, 3)
            Directions of the nominal magnetizations of the blocks, in own axes.
        kinds : ndarray of int, shape (blocks,)
        """
        same_kind = self.kinds[:, None] == kinds
        return np.array([
            same_kind & allowed[:, None]
            & (self.designed @ turn @ directions.T > np.cos(LARGEST_ANGLE))
            for turn, allowed in zip(self.turns, self.allowed, strict=True)])

    def carried(self, to: int, turn: int) -> Floats:
        """Return the rotation (3, 3) from the own axes of a moved block to those of the magnet.

        ``to`` is the number of the slot, ``turn`` that of the turn (see `turns`).
        """
        return np.asarray(self.frames[to] @ self.turns[turn])

    def turn_deg(self, turn: int) -> tuple[float, float, float]:
        """Return a turn as a rotation vector along the block's own axes, in degrees."""
        return rotation_deg(self.turns[turn])


def mounts_of(magnet: Magnet) -> Mounts:
    """Return the slots of a magnet with its present blocks."""
    meant, built = as_meant(magnet).blocks, magnet.blocks
    frames = np.array([block.shape_axes for block in meant])
    shapes, own_turns = _shapes(meant)
    kinds = _kinds(meant, shapes)
    sources = np.array([source for source, _ in mountings(magnet)])
    cube = (1.0, 1.0, 1.0)  # sides of a cube, which all other blocks' turns leave unchanged as well
    every = shape_turns(cube)
    found = np.array([[any(np.array_equal(turn, own) for own in turns) for turns in own_turns]
                      for turn in every])
    some = found.any(axis=1)
    return Mounts(
        tuple(block.place for block in meant), frames, every[some],
        found[some][:, shapes], _directions(meant, frames), _directions(built, frames),
        kinds, kinds[sources])


def shape_turns(sides: tuple[float, float, float] | None) -> Floats:
    """Return the rotations (n, 3, 3) that leave a shape unchanged; the first is the identity.

    ``sides``: sides of a cuboid; None for a shape whose inner and outer face differ, such as a
    sector.
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


def _shapes(blocks: Sequence[MagnetBlock]) -> tuple[Ints, list[Floats]]:
    """Return equal numbers for blocks of equal shape, (blocks,), and the turns of each shape."""
    known: list[tuple[Floats, tuple[bool, ...]]] = []
    numbers, turns = np.empty(len(blocks), int), []
    for place, block in enumerate(blocks):
        corners, arcs = _corners(block), tuple(edge.arc for edge in block.outline)
        number = next((number for number, (other, others) in enumerate(known) if arcs == others
                       and np.allclose(corners, other, 0, SAME_SIZE * np.ptp(corners[:-1]))),
                      len(known))
        if number == len(known):
            known.append((corners, arcs))
            turns.append(_turns_of(corners, any(arcs)))
        numbers[place] = number
    return numbers, turns


def _corners(block: MagnetBlock) -> Floats:
    """Return the corners (n + 1, 2) of a block's outline in its own axes, about their mean, in m.

    The last row is its length along z; a block of a cross-section is longer than it is wide.
    """
    corners = np.array([[*edge.start, 0.0] for edge in block.outline])
    if block.label is None:
        corners = corners @ block.shape_axes
    corners -= corners.mean(axis=0)
    length = 2 * float(np.ptp(corners)) if np.isinf(block.z_max) else block.z_max - block.z_min
    return np.vstack([corners[:, :2], [length, 0.0]])


def _turns_of(corners: Floats, arcs: bool) -> Floats:
    """Return the turns (n, 3, 3) that leave a shape unchanged, from its `_corners`."""
    outline, length = corners[:-1], float(corners[-1, 0])
    tolerance = SAME_SIZE * float(np.ptp(outline))
    half = np.abs(outline).max(axis=0)
    if len(outline) == 4 and not arcs and np.allclose(np.abs(outline), half, 0, tolerance):
        return shape_turns((2 * float(half[0]), 2 * float(half[1]), length))
    mirrored = outline * [1.0, -1.0]
    if all(np.linalg.norm(outline - corner, axis=1).min() < tolerance for corner in mirrored):
        return shape_turns(None)
    return np.eye(3)[None]


def _directions(blocks: Sequence[MagnetBlock], frames: Floats) -> Floats:
    """Return directions of the nominal magnetizations in own axes; 0 for missing blocks."""
    vectors = np.array([block.magnetization for block in blocks])
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.einsum("nji,nj->ni", frames, vectors / np.where(size > 0, size, 1.0))


def _kinds(blocks: Sequence[MagnetBlock], shapes: Ints) -> Ints:
    """Return equal numbers for blocks of equal shape, remanence and recoil permeabilities."""
    kinds = [(shape, *(float(f"{value:.9g}") for value in properties(block)[:3]))
             for block, shape in zip(blocks, shapes.tolist(), strict=True)]
    numbers = {kind: number for number, kind in enumerate(dict.fromkeys(kinds))}
    return np.array([numbers[kind] for kind in kinds])
