"""Turns by which a magnet is turned onto itself, so that no field map tells its blocks apart."""

from __future__ import annotations

from collections import Counter

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.study.magnet import External

SAME_M, SAME_T = 1e-7, 1e-7
"""Distance of corners in m, and difference of remanences in T, up to which blocks are equal: more
than the rounding of any study, and less than any deviation that is given."""


MOST_IN_RING = 64
"""Number of blocks of a ring up to which turns from block to block are tried."""


def turned_onto(magnet: Magnet, turn: Floats) -> tuple[int, ...] | None:
    """Return the number from 0 of the equal block onto which each block is turned.

    ``turn`` (3, 3) is a rotation about the origin of the magnet. None if a block has no equal one
    there. Magnets with iron or fields from outside, cross-sections and blocks of uneven
    magnetization are never said to be equal to themselves after a turn.
    """
    blocks = magnet.blocks
    if (magnet.iron or magnet.dimension == 2 or magnet.external != External() or any(
            block.gradient or block.corner_loss for block in blocks)):
        return None
    corners = [_corners(block) for block in blocks]
    moments = np.array([block.remanence * np.array(block.easy_axis) for block in blocks])
    middles = np.array([each.mean(axis=0) for each in corners])
    found = []
    for number, block in enumerate(blocks):
        there = int(np.linalg.norm(middles - turn @ middles[number], axis=1).argmin())
        apart = np.linalg.norm((corners[number] @ turn.T)[:, None] - corners[there], axis=2)
        if (max(apart.min(axis=0).max(), apart.min(axis=1).max()) > SAME_M
                or np.abs(turn @ moments[number] - moments[there]).max() > SAME_T
                or _permeabilities(block) != _permeabilities(blocks[there])):
            return None
        found.append(there)
    return tuple(found)


def own_turns(magnet: Magnet) -> list[tuple[int, ...]]:
    """Return what `turned_onto` says of every turn that brings the magnet onto itself.

    Turns by right angles are tried, and those that bring a ring of blocks onto itself, alone and
    with half a turn about x.
    """
    turns = [each for each in Rotation.create_group("O").as_matrix() if np.trace(each) < 2.9]
    count = max(Counter(block.ring for block in magnet.blocks).values(), default=0)
    if count <= MOST_IN_RING:
        for number in range(count):
            about_z = Rotation.from_euler("z", 2 * np.pi * number / count)
            turns += [about_z.as_matrix(), (about_z * Rotation.from_euler(
                "x", np.pi)).as_matrix()][not number:]
    images = dict.fromkeys(image for turn in turns if (image := turned_onto(magnet, turn)))
    return list(images)


def _corners(block: MagnetBlock) -> Floats:
    """Return the corners (n, 3) of a block in m."""
    return np.asarray(block.from_frame(np.array([
        (*edge.start, z) for edge in block.outline for z in (block.z_min, block.z_max)])))


def _permeabilities(block: MagnetBlock) -> tuple[float, float]:
    """Return the relative permeabilities of a block."""
    return block.recoil_permeability, block.recoil_permeability_across
