"""Drift of the sensors' offsets while the map is taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class DriftEffect(InstrumentEffect):
    """The offset of each sensor grows linearly in time.

    The parameters are the changes from the first to the last reading of the map.
    """

    name = "drift"
    title = "drift of the zeros in time"
    parameters = (
        Parameter("x", "T", 1e-4), Parameter("y", "T", 1e-4), Parameter("z", "T", 1e-4),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.asarray(np.eye(3)[:, None, :] * nominal.time[None, :, None])

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"drift_T": added(instrument.drift_T, values)}


EFFECTS = (DriftEffect(),)
