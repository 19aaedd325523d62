"""Readings of a probe that moves while it reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.measurement.scan_lines import goes_both_ways, motion
from halbach_fe.study.measurement import Instrument


class LagEffect(InstrumentEffect):
    """Positions are read later than the field, or the drive has play.

    The parameter is the distance by which the probe was behind where the map says, along its way.
    """

    name = "lag"
    title = "lag of the readings behind the stage"
    parameters = (Parameter("distance", "m", 3e-4),)

    def can_show(self, points: Floats) -> bool:
        """See `Effect.can_show`. In lines that all go one way, it is a shift or turn of the map."""
        return goes_both_ways(points)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        way = motion(nominal.points) if nominal.way is None else nominal.way
        return nominal.change_at_displaced_points(-way)[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"lag_m": instrument.lag_m + values[0]}


EFFECTS = (LagEffect(),)
