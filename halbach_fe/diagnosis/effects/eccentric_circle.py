"""Circles whose radius varies once around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.measurement.instrument import run_out
from halbach_fe.study.measurement import Instrument


class EccentricCircleEffect(InstrumentEffect):
    """The radius is larger by ``x cos phi + y sin phi``, while the angle is right: half of what a
    translation of the mapper does.
    """

    name = "eccentric_circle"
    title = "eccentric circles"
    parameters = (Parameter("x", "m", 1e-3), Parameter("y", "m", 1e-3))

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.array([scene.displaced(one) for one in run_out(scene.points)])

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"eccentricity_m": added(instrument.eccentricity_m, values)}


EFFECTS = (EccentricCircleEffect(),)
