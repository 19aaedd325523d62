"""A magnet warmer on one side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.effects.temperature import coefficient
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.model import Study


class TemperatureGradientEffect(Effect):
    """Linear temperature across the magnet, from the middle to the outer radius."""

    name = "temperature_gradient"
    title = "temperature gradient across the magnet"
    kind = "field"
    parameters = (Parameter("x", "K", 3.0), Parameter("y", "K", 3.0),)

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        place_of = np.array([block.middle[:2] for block in scene.blocks])
        weights = coefficient(scene.study) * place_of / scene.study.array.outer_radius_m
        return np.einsum("bk,bnc->knc", weights, scene.block_fields)

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        found = []
        for slot in range(1, study.array.blocks_per_ring + 1):
            middle = build_magnet(study).blocks[slot - 1].middle[:2] / study.array.outer_radius_m
            found.append(BlockException(slot=slot, magnetization_factor=float(
                1.0 + coefficient(study) * (middle @ np.asarray(values)))))
        return with_exceptions(study, found)


EFFECTS = (TemperatureGradientEffect(),)
