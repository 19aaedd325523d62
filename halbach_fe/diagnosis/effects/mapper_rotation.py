"""A mapper that is turned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, added, along
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class MapperRotationEffect(InstrumentEffect):
    """Rotation of the mapper, points and sensors, about the magnet's middle."""

    title = "mapper turned about an axis"
    parameters = (Parameter("angle", "rad", 2e-3),)

    def __init__(self, name: str, axis: str) -> None:
        self.axis = axis
        self.name = name  # type: ignore[misc]

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        axis = np.array(along(self.axis, 1.0))
        moved = scene.displaced(np.cross(axis, scene.points))
        return np.asarray(moved - np.cross(axis, scene.field))[None]  # the sensors turn too

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        return {"rotation_rad": added(instrument.rotation_rad, along(self.axis, values[0]))}


EFFECTS = (MapperRotationEffect("mapper_tilt_x", "x"), MapperRotationEffect("mapper_tilt_y", "y"),
           MapperRotationEffect("mapper_roll", "z"))
