"""A sensor that is displaced from the probe's reference point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added, along
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS


class SensorPositionEffect(InstrumentEffect):
    """The sensor of one component is displaced from the probe's reference point."""

    parameters = (
        Parameter("x", "m", 1e-3), Parameter("y", "m", 1e-3), Parameter("z", "m", 1e-3),)

    def __init__(self, axis: str) -> None:
        self.axis = axis
        self.title = f"place of the B{axis} sensor in the probe"  # type: ignore[misc]
        self.name = f"sensor_position_{axis}"  # type: ignore[misc]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        change = np.moveaxis(nominal.gradient, 2, 0)  # first axis: direction of displacement
        return np.asarray(change * along(self.axis, 1.0))

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        positions = tuple(added(position, values) if name == self.axis else position
                          for name, position in zip(COMPONENTS, instrument.sensor_position_m,
                                                    strict=True))
        return {"sensor_position_m": positions}


EFFECTS = tuple(SensorPositionEffect(axis) for axis in COMPONENTS)
