"""A sensor that shows a field where there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.blocks import Floats
from halbach_fe.effects.base import InstrumentEffect, Parameter, Place, added, along
from halbach_fe.scene import Scene
from halbach_fe.study import COMPONENTS, Instrument


class Offset(InstrumentEffect):
    """Zero of one axis."""

    title = "zero of a sensor"
    parameters = (Parameter("offset", "T", 1e-4),)

    def __init__(self, axis: str) -> None:
        self.axis = axis
        self.name = f"offset_{axis}"  # type: ignore[misc]

    def signature(self, scene: Scene, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.asarray(np.ones_like(scene.field) * along(self.axis, 1.0))[None]

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"offset_T": added(instrument.offset_T, along(self.axis, values[0]))}


EFFECTS = tuple(Offset(axis) for axis in COMPONENTS)
