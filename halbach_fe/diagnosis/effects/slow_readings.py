"""Readings that contain a part of those before, as of a slow instrument."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.measurement.instrument import with_memory
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.model import Study

MEMORIES = {0.0: "over one row", 3.0: "over 3 rows", 10.0: "over 10 rows", 30.0: "over 30 rows"}
"""Numbers of rows within which a reading is forgotten, the last row alone being 0, and in words."""


class SlowReadingsEffect(InstrumentEffect):
    """Readings lag behind what came before: filters, settling times and hysteresis.

    The parameter is the fraction of each reading that comes from those before it in the scan.
    Integrators and filters that were given ten time constants leave 5e-5 of the last reading, five
    leave 7e-3. The places are memories of different lengths.
    """

    name = "slow_readings"
    title = "readings that lag behind those before"
    parameters = (Parameter("memory", "1", 2e-3),)
    unique = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`. A study that states a memory has that one."""
        instrument = study.instrument
        return [Place(at_m=(rows,), words=words) for rows, words in MEMORIES.items()
                if not instrument.memory or rows == instrument.memory_rows]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        half = Instrument(memory=0.5, memory_rows=place.at_m[0])  # it is linear in the memory
        return 2 * (with_memory(half, nominal.field, nominal.time) - nominal.field)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return study.with_(instrument=study.instrument.with_(
            **self.change(study.instrument, values), memory_rows=place.at_m[0]))

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"memory": instrument.memory + float(values[0])}


EFFECTS = (SlowReadingsEffect(),)
