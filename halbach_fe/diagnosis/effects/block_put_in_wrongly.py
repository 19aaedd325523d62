"""A block that was put into its slot in another orientation in which it fits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.assembly import AssemblyEffect, Sources
from halbach_fe.diagnosis.effects.base import Place
from halbach_fe.geometry.blocks import MagnetBlock, rotation_matrix
from halbach_fe.geometry.fitting_turns import turns_in_slot
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.study.model import Study

OPPOSITE = -0.999
"""Cosine below which a turn reverses the magnetization, which is the effect of a reversed block."""


class BlockPutInWronglyEffect(AssemblyEffect):
    """One block is turned by a large angle, so that it fits its slot again."""

    name = "block_put_in_wrongly"
    title = "block put in the wrong way"

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return [place for block in build_magnet(study).blocks if block.remanence
                for turn in turns_in_slot(block)
                if (place := _place(block, np.array(turn))) is not None]

    def sources(self, magnet: Magnet, place: Place) -> Sources:
        """See `AssemblyEffect.sources`."""
        number = magnet.number_of(place.ring, place.slot)
        return ((number, number),), Rotation.from_rotvec(np.radians(place.at_m)).as_matrix()


def _place(block: MagnetBlock, turn: Floats) -> Place | None:
    """Return a place whose ``at_m`` are the components of a rotation vector in degrees; None if
    the turn reverses the magnetization.
    """
    easy = np.array(block.easy_axis)
    if easy @ turn @ easy < OPPOSITE:
        return None
    vector = Rotation.from_matrix(turn).as_rotvec(degrees=True)
    vector *= np.sign(vector[np.abs(vector) > 1e-6][-1]) if abs(
        np.linalg.norm(vector) - 180) < 1e-6 else 1.0  # half turns of both signs are the same
    x, y, z = (vector.round(6) + 0.0).tolist()
    return Place(block.ring, block.slot, at_m=(x, y, z), words=(
        f"{block.name}, {_angle_in_words(block, vector)}"))


def _angle_in_words(block: MagnetBlock, vector: Floats) -> str:
    """Describe a rotation vector (3,) in degrees of a block."""
    size = float(np.linalg.norm(vector))
    angle = next((words for known, words in ((90, "a quarter turn"), (180, "half a turn"))
                  if abs(size - known) < 0.1), f"by {size:.0f}°")
    radial = rotation_matrix((0.0, 0.0, np.radians(block.angle_deg))).T @ vector / size
    for axis, name in zip(np.eye(3), ("its radius", "its azimuthal direction", "z"), strict=True):
        if abs(abs(axis @ radial) - 1) < 1e-3:
            return f"{angle} about {'-' if axis @ radial < 0 else ''}{name}"
    x, y, z = vector / size
    return f"{angle} about ({x:.3g}, {y:.3g}, {z:.3g})"


EFFECTS = (BlockPutInWronglyEffect(),)
