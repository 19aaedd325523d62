"""A block that is displaced from its nominal position."""

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


class BlockDisplacedEffect(Effect):
    """One block is displaced along its own axes: radially, azimuthally and axially."""

    name = "block_displaced"
    title = "displacement of a block"
    kind = "field"
    parameters = (
        Parameter("radial", "m", 2e-4), Parameter("azimuthal", "m", 2e-4),
        Parameter("axial", "m", 2e-4))

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return each_block(study)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        (block,) = blocks_at(nominal, place)
        axes = rotation_matrix((0.0, 0.0, np.radians(nominal.blocks[block].angle_deg)))
        return np.array([nominal.block_translation_derivative(block, axis) for axis in axes.T])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        radial, azimuthal, axial = map(float, values)
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, displacement_m=(radial, azimuthal, axial))])


EFFECTS = (BlockDisplacedEffect(),)
