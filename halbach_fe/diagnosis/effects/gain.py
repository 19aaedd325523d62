"""Gain error of a sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added, along
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS


class GainEffect(InstrumentEffect):
    """The sensor of one component has a relative error of its sensitivity."""

    parameters = (Parameter("gain", "1", 3e-3),)

    def __init__(self, axis: str) -> None:
        self.axis = axis
        self.title = f"sensitivity of the B{axis} sensor"  # type: ignore[misc]
        self.name = f"gain_{axis}"  # type: ignore[misc]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.asarray(nominal.field * along(self.axis, 1.0))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"gain": added(instrument.gain, along(self.axis, values[0]))}


EFFECTS = tuple(GainEffect(axis) for axis in COMPONENTS)
