"""A magnet that is warmer on one side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.effects.temperature import coefficient
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class TemperatureGradientEffect(Effect):
    """The temperature varies linearly across the magnet.

    The parameters are the differences between the axis and the outer radius, along x and y.
    """

    name = "temperature_gradient"
    title = "temperature gradient across the magnet"
    kind = "field"
    parameters = (Parameter("x", "K", 3.0), Parameter("y", "K", 3.0),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        centres = np.array([block.middle[:2] for block in nominal.blocks])
        weights = coefficient(nominal.study) * centres / nominal.study.array.outer_radius_m
        return np.einsum("bk,bnc->knc", weights, nominal.block_fields)

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        blocks, exceptions = build_magnet(study).blocks, []
        uniform = study.array.is_uniform  # then one exception serves a slot of all rings
        for block in blocks[:study.array.blocks_per_ring] if uniform else blocks:
            middle = block.middle[:2] / study.array.outer_radius_m
            exceptions.append(BlockException(
                ring=None if uniform else block.ring, slot=block.slot, magnetization_factor=float(
                    1.0 + coefficient(study) * (middle @ np.asarray(values)))))
        return with_exceptions(study, exceptions)


EFFECTS = (TemperatureGradientEffect(),)
