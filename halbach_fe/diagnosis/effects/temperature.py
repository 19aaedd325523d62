"""A magnet warmer or colder than its reference."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.model import Study

TYPICAL_COEFFICIENT_PER_K = -1e-3
"""Of the remanence of NdFeB; SmCo has a third of it."""


def coefficient(study: Study) -> float:
    """Relative change of the remanence per kelvin."""
    return study.prior.temperature_coefficient_per_K or TYPICAL_COEFFICIENT_PER_K


class TemperatureEffect(Effect):
    """Temperature of the whole magnet, by the coefficient of the study's prior."""

    name = "temperature"
    title = "temperature of the magnet"
    kind = "field"
    parameters = (Parameter("difference", "K", 10.0),)

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return coefficient(scene.study) * scene.block_fields.sum(axis=0)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            magnetization_factor=1.0 + coefficient(study) * float(values[0]))])


EFFECTS = (TemperatureEffect(),)
