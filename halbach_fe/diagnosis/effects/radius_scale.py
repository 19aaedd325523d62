"""An arm that is too long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class RadiusScaleEffect(InstrumentEffect):
    """Relative error of the mapper's distances from the axis."""

    name = "radius_scale"
    title = "length of the mapper's arm"
    parameters = (Parameter("scale", "1", 5e-3),)

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return scene.displaced(scene.points * [1.0, 1.0, 0.0])[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"radius_scale": (1 + instrument.radius_scale) * (1 + values[0]) - 1}


EFFECTS = (RadiusScaleEffect(),)
