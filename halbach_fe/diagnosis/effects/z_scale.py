"""Scale error of the mapper along z."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class ZScaleEffect(InstrumentEffect):
    """The mapper's distances along z have a relative error."""

    name = "z_scale"
    title = "scale of the mapper along z"
    parameters = (Parameter("scale", "1", 5e-4),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return nominal.change_at_displaced_points(nominal.points * [0.0, 0.0, 1.0])[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"z_scale": instrument.z_scale + values[0]}


EFFECTS = (ZScaleEffect(),)
