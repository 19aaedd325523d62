"""Blocks that stand too far out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.model import Study


class RadialGapEffect(Effect):
    """Displacement of all blocks away from the axis."""

    name = "radial_gap"
    title = "common radial displacement of the blocks"
    kind = "field"
    parameters = (Parameter("gap", "m", 2e-4, least=0.0),)  # inwards they would meet

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        total = np.zeros_like(scene.points)
        for number, block in enumerate(scene.blocks):
            outwards = block.middle * [1.0, 1.0, 0.0]
            total += scene.moved(number, outwards / np.linalg.norm(outwards))
        return total[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            displacement_m=(float(values[0]), 0.0, 0.0))])


EFFECTS = (RadialGapEffect(),)
