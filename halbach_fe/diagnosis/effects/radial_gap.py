"""Blocks that are all too far from the axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class RadialGapEffect(Effect):
    """All blocks are displaced radially outwards by the same distance."""

    name = "radial_gap"
    title = "common radial displacement of the blocks"
    kind = "field"
    parameters = (Parameter("gap", "m", 2e-4, minimum=0.0),)  # inwards the blocks would overlap

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        total = np.zeros_like(nominal.points)
        for number, block in enumerate(nominal.blocks):
            angle = np.radians(block.angle_deg)
            outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
            total += nominal.block_translation_derivative(number, outwards)
        return total[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            displacement_m=(float(values[0]), 0.0, 0.0))])


EFFECTS = (RadialGapEffect(),)
