"""The places that blocks were mounted at, and the rotation of their magnetizations with them."""

from __future__ import annotations

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.array_layout import exceptions_of, magnetization_factor
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import Magnet


def mountings(magnet: Magnet) -> list[tuple[int, Floats]]:
    """Return by block its intended place, and how its magnetization follows from the one there.

    Returns
    -------
    list of (int, ndarray)
        Number of the place (from 0, in the order of `Magnet.blocks`) that the block was made for,
        and the matrix (3, 3) that turns the magnetization it would have there into the
        magnetization that it has where it is mounted. The matrix is 0 for a missing block.
    """
    array, found = magnet.array, []
    for block in magnet.blocks:
        ring, slot = block.mounted_from or (block.ring, block.slot)
        number = magnet.number_of(ring, slot)
        turn = rotation_matrix(block.rotation_rad) @ block.carried_from(magnet.blocks[number])
        factor = magnetization_factor(exceptions_of(array, block.ring, block.slot))
        found.append((number, factor * turn))
    return found


def as_meant(magnet: Magnet) -> Magnet:
    """Return the magnet with every block present, unrotated, and in the slot it was made for."""
    meant = {"mounted_from": None, "magnetization_factor": 1.0, "rotation_deg": (0.0, 0.0, 0.0),
             "twist_deg": 0.0}
    return magnet.with_(array__exceptions=tuple(
        exception.with_(**meant) for exception in magnet.array.exceptions))
