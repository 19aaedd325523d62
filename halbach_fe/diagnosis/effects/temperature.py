"""A magnet that is warmer or colder than its reference temperature."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study

TYPICAL_COEFFICIENT_PER_K = -1e-3
"""Temperature coefficient of the remanence of NdFeB; that of SmCo is about a third of it."""


def coefficient(study: Study) -> float:
    """Return the relative change of the remanence per kelvin.

    That is the coefficient of the study's prior, or a typical one if the study has none.
    """
    return study.prior.temperature_coefficient_per_K or TYPICAL_COEFFICIENT_PER_K


class TemperatureEffect(Effect):
    """The temperature of the whole magnet differs, which scales all magnetizations alike."""

    name = "temperature"
    title = "temperature of the magnet"
    kind = "field"
    parameters = (Parameter("difference", "K", 10.0),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return coefficient(nominal.study) * nominal.block_fields.sum(axis=0)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            magnetization_factor=1.0 + coefficient(study) * float(values[0]))])


EFFECTS = (TemperatureEffect(),)
