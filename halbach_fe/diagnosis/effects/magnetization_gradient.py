"""A magnetization that varies along the thickness of the blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    blocks_at,
    can_be_uneven,
    each_block,
    with_exceptions,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class MagnetizationGradientEffect(Effect):
    """The outer half of the blocks is stronger than the inner one, in all blocks or in one.

    The parameter is the difference as a fraction of the mean.
    """

    name = "magnetization_gradient"
    title = "magnetization gradient inside the blocks"
    kind = "field"
    parameters = (Parameter("gradient", "1", 0.02),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        blocks = build_magnet(study).blocks
        uneven = {(block.ring, block.slot) for block in blocks if can_be_uneven(block)}
        each = [place for place in each_block(study) if (place.ring, place.slot) in uneven]
        return [Place(), *each] if len(uneven) == len(blocks) else each

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        per_unit = nominal.gradient_fields
        return np.asarray(per_unit[blocks_at(nominal, place)].sum(axis=0))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring or None, slot=place.slot or None,
            magnetization_gradient=float(values[0]))])


EFFECTS = (MagnetizationGradientEffect(),)
