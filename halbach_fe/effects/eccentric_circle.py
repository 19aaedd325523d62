"""Circles whose radius varies once around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.blocks import Floats
from halbach_fe.effects.base import InstrumentEffect, Parameter, Place, added
from halbach_fe.instrument import run_out
from halbach_fe.scene import Scene
from halbach_fe.study import Instrument


class EccentricCircle(InstrumentEffect):
    """The radius is larger by ``x cos phi + y sin phi``, while the angle is right: half of what a
    translation of the mapper does.
    """

    name = "eccentric_circle"
    title = "eccentric circles"
    parameters = (Parameter("x", "m", 1e-3), Parameter("y", "m", 1e-3))

    def signature(self, scene: Scene, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.array([scene.displaced(one) for one in run_out(scene.points)])

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"eccentricity_m": added(instrument.eccentricity_m, values)}


EFFECTS = (EccentricCircle(),)
