"""A line of measurement, or a whole map, that was taken far from where it claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class WrongLineEffect(InstrumentEffect):
    """The mapper is displaced by centimetres, not by the millimetres of `mapper_translation`."""

    name = "wrong_line"
    title = "wrong line of measurement"
    parameters = (
        Parameter("x", "m", 2e-2), Parameter("y", "m", 2e-2), Parameter("z", "m", 2e-2))
    is_divisible = False  # along one axis it would be no other cause than a displaced mapper

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.asarray(np.moveaxis(nominal.gradient, 2, 0))

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"translation_m": added(instrument.translation_m, values)}


EFFECTS = (WrongLineEffect(),)
