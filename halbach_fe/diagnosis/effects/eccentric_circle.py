"""Circles whose radius varies once per turn, while the angles are right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.measurement.instrument import eccentricity_shift
from halbach_fe.study.measurement import Instrument


class EccentricCircleEffect(InstrumentEffect):
    """The radius at the angle phi is larger by ``x cos phi + y sin phi``.

    A translation of the mapper by (x, y) has the same effect on the radius, and a further one on
    the angle, which is right here.
    """

    name = "eccentric_circle"
    title = "eccentric circles"
    parameters = (Parameter("x", "m", 1e-3), Parameter("y", "m", 1e-3))

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.array([nominal.change_at_displaced_points(shift)
                         for shift in eccentricity_shift(nominal.points)])

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"eccentricity_m": added(instrument.eccentricity_m, values)}


EFFECTS = (EccentricCircleEffect(),)
