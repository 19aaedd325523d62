"""Rotation of the mapper about an axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place, along
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.measurement import Instrument


class MapperRotationEffect(InstrumentEffect):
    """The mapper is turned about the magnet's centre, its points and its sensors alike."""

    parameters = (Parameter("angle", "rad", 2e-3),)

    def __init__(self, name: str, axis: str) -> None:
        self.axis = axis
        self.title = f"mapper turned about {axis}"  # type: ignore[misc]
        self.name = name  # type: ignore[misc]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        axis = np.array(along(self.axis, 1.0))
        moved = nominal.change_at_displaced_points(np.cross(axis, nominal.points))
        return np.asarray(moved - np.cross(axis, nominal.field))[None]  # the sensors turn too

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """See `InstrumentEffect.change`."""
        turn = Rotation.from_rotvec(along(self.axis, float(values[0])))
        total = turn * Rotation.from_rotvec(instrument.rotation_rad)
        return {"rotation_rad": tuple(total.as_rotvec().tolist()),
                "translation_m": tuple(turn.apply(instrument.translation_m).tolist())}


EFFECTS = (MapperRotationEffect("mapper_tilt_x", "x"), MapperRotationEffect("mapper_tilt_y", "y"),
           MapperRotationEffect("mapper_roll", "z"))
