"""Sag of the arm that carries the probe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class ArmSagEffect(InstrumentEffect):
    """The arm sags towards -y, with the square of the distance from its end at the smallest z.

    The parameter is the sag at the largest z of the map.
    """

    name = "arm_sag"
    title = "sag of the mapper's arm"
    parameters = (Parameter("sag", "m", 5e-4),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        z = nominal.points[:, 2]
        shape = ((z - z.min()) / (np.ptp(z) or 1.0)) ** 2
        return nominal.change_at_displaced_points(np.outer(shape, [0.0, -1.0, 0.0]))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"arm_sag_m": instrument.arm_sag_m + values[0]}


EFFECTS = (ArmSagEffect(),)
