"""Axes that are not perpendicular."""

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
    """One sensor sees a little of another component."""

    title = "sensors that are not perpendicular"
    parameters = (Parameter("crosstalk", "rad", 2e-3),)

    def __init__(self, seer: str, seen: str) -> None:
        self.seer, self.seen = seer, seen
        self.name = f"misalignment_{seer}{seen}"  # type: ignore[misc]

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        seen = scene.field[:, COMPONENTS.index(self.seen)]
        return np.asarray(seen[:, None] * along(self.seer, 1.0))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        name = self.seer + self.seen
        there = {str(key): value for key, value in instrument.crosstalk.items()}
        return {"crosstalk": there | {name: there.get(name, 0.0) + values[0]}}


EFFECTS = tuple(MisalignmentEffect(one, other) for one in COMPONENTS for other in COMPONENTS
                if one != other)
