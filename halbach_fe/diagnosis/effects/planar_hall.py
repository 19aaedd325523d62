"""Planar Hall effect of a sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added, along
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS


class PlanarHallEffect(InstrumentEffect):
    """The reading of one sensor has an additional term in the product of the other components."""

    parameters = (Parameter("coefficient", "1/T", 5e-3),)

    def __init__(self, axis: str) -> None:
        self.axis = axis
        self.title = f"planar Hall effect of the B{axis} sensor"  # type: ignore[misc]
        self.name = f"planar_hall_{axis}"  # type: ignore[misc]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        first, second = (nominal.field[:, j] for j in range(3) if COMPONENTS[j] != self.axis)
        return np.asarray((first * second)[:, None] * along(self.axis, 1.0))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"planar_hall_per_T": added(
            instrument.planar_hall_per_T, along(self.axis, values[0]))}


EFFECTS = tuple(PlanarHallEffect(axis) for axis in COMPONENTS)
