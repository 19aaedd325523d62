"""Circles of another radius than the map says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.measurement.instrument import outward
from halbach_fe.study.measurement import Instrument


class WrongRadiusEffect(InstrumentEffect):
    """The probe farther from the axis by the same at every point; no small effect."""

    name = "wrong_radius"
    title = "wrong radius of the measurement"
    parameters = (Parameter("offset", "m", 1e-2),)

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return scene.displaced(outward(scene.points))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"radius_offset_m": instrument.radius_offset_m + values[0]}


EFFECTS = (WrongRadiusEffect(),)
