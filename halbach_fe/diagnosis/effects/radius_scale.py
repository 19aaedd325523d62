"""Scale error of the mapper's radial distances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class RadiusScaleEffect(InstrumentEffect):
    """The mapper's distances from the axis have a relative error, as of an arm too long."""

    name = "radius_scale"
    title = "length of the mapper's arm"
    parameters = (Parameter("scale", "1", 5e-3),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return nominal.change_at_displaced_points(nominal.points * [1.0, 1.0, 0.0])[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"radius_scale": (1 + instrument.radius_scale) * (1 + values[0]) - 1}


EFFECTS = (RadiusScaleEffect(),)
