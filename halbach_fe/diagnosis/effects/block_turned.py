"""A block that is rotated from its nominal orientation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    blocks_at,
    each_block,
    with_exceptions,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class BlockTurnedEffect(Effect):
    """One block is rotated with its magnetization, about its own axes through its centre."""

    name = "block_turned"
    title = "rotation of a block"
    kind = "field"
    parameters = (
        Parameter("radial", "rad", 0.02), Parameter("azimuthal", "rad", 0.02),
        Parameter("axial", "rad", 0.02))

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return each_block(study)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        (block,) = blocks_at(nominal, place)
        axes = rotation_matrix((0.0, 0.0, np.radians(nominal.blocks[block].angle_deg)))
        middle = nominal.blocks[block].middle
        return np.array([nominal.block_rotation_derivative(block, axis, middle) for axis in axes.T])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        radial, azimuthal, axial = np.degrees(values).tolist()
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, rotation_deg=(radial, azimuthal, axial))])


EFFECTS = (BlockTurnedEffect(),)
