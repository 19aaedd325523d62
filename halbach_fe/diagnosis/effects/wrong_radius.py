"""Circles whose radius is not the one that the map states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.measurement.instrument import radial_direction
from halbach_fe.study.measurement import Instrument


class WrongRadiusEffect(InstrumentEffect):
    """The probe is farther from the axis by the same distance at every point, of centimetres."""

    name = "wrong_radius"
    title = "wrong radius of the measurement"
    parameters = (Parameter("offset", "m", 1e-2),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return nominal.change_at_displaced_points(radial_direction(nominal.points))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"radius_offset_m": instrument.radius_offset_m + values[0]}


EFFECTS = (WrongRadiusEffect(),)
