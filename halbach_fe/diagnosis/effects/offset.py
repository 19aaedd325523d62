"""Offset of a sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added, along
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS


class OffsetEffect(InstrumentEffect):
    """The sensor of one component has a constant offset."""

    parameters = (Parameter("offset", "T", 1e-4),)

    def __init__(self, axis: str) -> None:
        self.axis = axis
        self.title = f"zero of the B{axis} sensor"  # type: ignore[misc]
        self.name = f"offset_{axis}"  # type: ignore[misc]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.asarray(np.ones_like(nominal.field) * along(self.axis, 1.0))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"offset_T": added(instrument.offset_T, along(self.axis, values[0]))}


EFFECTS = tuple(OffsetEffect(axis) for axis in COMPONENTS)
