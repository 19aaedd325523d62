"""Which block was mounted where, and how its magnetization turned with it."""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.array_layout import exceptions_of, magnetization_factor, position_angle_deg
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import Magnet


def mountings(magnet: Magnet) -> list[tuple[int, Floats]]:
    """By block: the number of the block that was meant for where this one comes from, and the
    matrix (3, 3) from its magnetization there to the one here (0 for a missing block).
    """
    array, found = magnet.array, []
    for block in magnet.blocks:
        ring, slot = block.mounted_from or (block.ring, block.slot)
        moved = position_angle_deg(array, block.slot) - position_angle_deg(array, slot)
        turn = rotation_matrix(block.turn) @ rotation_matrix((0.0, 0.0, np.radians(moved)))
        factor = magnetization_factor(exceptions_of(array, block.ring, block.slot))
        found.append(((ring - 1) * array.blocks_per_ring + slot - 1, factor * turn))
    return found


def as_meant(magnet: Magnet) -> Magnet:
    """The magnet with every block as it was meant to be mounted."""
    meant = {"mounted_from": None, "magnetization_factor": 1.0, "rotation_deg": (0.0, 0.0, 0.0),
             "twist_deg": 0.0}
    return magnet.with_(array__exceptions=tuple(
        one.with_(**meant) for one in magnet.array.exceptions))
