"""Sensors that are not perpendicular to each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, along
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS


class MisalignmentEffect(InstrumentEffect):
    """The sensor of one component picks up a small fraction of another component.

    ``misalignment_zx`` is the fraction of Bx in the reading of the z sensor.
    """

    parameters = (Parameter("crosstalk", "rad", 2e-3),)

    def __init__(self, sensor: str, component: str) -> None:
        self.sensor, self.component = sensor, component
        self.title = f"B{sensor} sensor tilted towards {component}"  # type: ignore[misc]
        self.name = f"misalignment_{sensor}{component}"  # type: ignore[misc]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        picked_up = nominal.field[:, COMPONENTS.index(self.component)]
        return np.asarray(picked_up[:, None] * along(self.sensor, 1.0))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        name = self.sensor + self.component
        present = {str(key): value for key, value in instrument.crosstalk.items()}
        return {"crosstalk": present | {name: present.get(name, 0.0) + values[0]}}


EFFECTS = tuple(MisalignmentEffect(sensor, component)
                for sensor in COMPONENTS for component in COMPONENTS if sensor != component)
