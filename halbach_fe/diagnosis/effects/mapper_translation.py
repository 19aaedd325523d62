"""Displacement of the mapper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class MapperTranslationEffect(InstrumentEffect):
    """The origin of the mapper is displaced from that of the magnet."""

    name = "mapper_translation"
    title = "displacement of the mapper"
    parameters = (
        Parameter("x", "m", 1e-3), Parameter("y", "m", 1e-3), Parameter("z", "m", 1e-3),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.asarray(np.moveaxis(nominal.gradient, 2, 0))

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"translation_m": added(instrument.translation_m, values)}


EFFECTS = (MapperTranslationEffect(),)
