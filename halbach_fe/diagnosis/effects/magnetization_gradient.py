"""Blocks magnetized unevenly."""

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
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.model import Study


class MagnetizationGradientEffect(Effect):
    """Outer halves stronger than inner ones, in all blocks or in one."""

    name = "magnetization_gradient"
    title = "magnetization gradient inside the blocks"
    kind = "field"
    parameters = (Parameter("gradient", "1", 0.02),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return [Place(), *each_block(study)]

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        per_unit = scene.gradient_fields
        chosen = blocks_at(scene, place)
        return np.asarray(per_unit[chosen].sum(axis=0))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring or None, slot=place.slot or None,
            magnetization_gradient=float(values[0]))])


EFFECTS = (MagnetizationGradientEffect(),)
