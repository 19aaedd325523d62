"""A magnet that is warmer on one side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.effects.temperature import coefficient
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import Magnet, build_magnet
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
        weights = coefficient(nominal.study) * centres / _outer_radius(nominal.magnet)
        return np.einsum("bk,bnc->knc", weights, nominal.block_fields)

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        magnet, exceptions = build_magnet(study), []
        blocks, radius = magnet.blocks, _outer_radius(magnet)
        uniform = study.array.is_uniform  # then one exception serves a slot of all rings
        for block in blocks[:study.array.blocks_per_ring] if uniform else blocks:
            middle = block.middle[:2] / radius
            exceptions.append(BlockException(
                ring=None if uniform else block.ring, slot=block.slot, magnetization_factor=float(
                    1.0 + coefficient(study) * (middle @ np.asarray(values)))))
        return with_exceptions(study, exceptions)


def _outer_radius(magnet: Magnet) -> float:
    """Return the outer radius of the blocks in m."""
    array = magnet.array
    return array.outer_radius_m if array.is_uniform else magnet.array_outer_radius


EFFECTS = (TemperatureGradientEffect(),)
