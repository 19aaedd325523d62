"""Effects of the mapper: what an instrument may do wrong, one row each.

A row says which key of the study's instrument changes, and how. The signature follows from the law
of the instrument, see `InstrumentEffect.signature`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.diagnosis.effects.base import InstrumentEffect, Parameter, Place
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

MEMORIES = {0.0: "over one row", 3.0: "over 3 rows", 10.0: "over 10 rows", 30.0: "over 30 rows"}
"""Numbers of rows within which a reading is forgotten, the last row alone being 0, and in words."""

Change = Callable[[Instrument, Sequence[float]], Mapping[str, Any]]
"""Function of an instrument and amplitudes that returns the keys that change, with new values."""


@dataclass(frozen=True, eq=False)
class InstrumentRow(InstrumentEffect):
    """An effect of the mapper as data."""

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    change_of: Change
    is_divisible: bool = True
    of_total_field: bool = False

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        return self.change_of(instrument, values)


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
        instrument = study.instrument  # one that states a memory has that one
        return [Place(at_m=(rows,), words=words) for rows, words in MEMORIES.items()
                if not instrument.memory or rows == instrument.memory_rows]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return super().apply(study.with_(instrument=study.instrument.with_(
            memory_rows=place.at_m[0])), place, values)

    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        return {"memory": instrument.memory + float(values[0])}


def _plus(key: str, part: int | None = None) -> Change:
    """Return the change that adds the amplitudes to a key, or to one entry of it."""
    def change(instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        found = np.array(getattr(instrument, key), float)
        here = ... if part is None else part
        found[here] += np.reshape(values, found[here].shape)
        return {key: found.tolist()}
    return change


def _plus_alike(key: str) -> Change:
    """Return the change that adds the amplitude to all three entries of a key."""
    return lambda instrument, values: {
        key: [entry + values[0] for entry in getattr(instrument, key)]}


def _turned(axis: int) -> Change:
    """Return the change that turns the mapper about the magnet's centre, with its sensors."""
    def change(instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        turn = Rotation.from_rotvec(values[0] * np.eye(3)[axis])
        total = turn * Rotation.from_rotvec(instrument.rotation_rad)
        return {"rotation_rad": total.as_rotvec().tolist(),
                "translation_m": turn.apply(instrument.translation_m).tolist()}
    return change


def _picked_up(pair: str) -> Change:
    """Return the change of the fraction of one component in the readings of another sensor."""
    def change(instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        present = {str(key): value for key, value in instrument.crosstalk.items()}
        return {"crosstalk": present | {pair: present.get(pair, 0.0) + values[0]}}
    return change


def _row(name: str, title: str, amplitudes: str, unit: str, sd: float, change: Change,
         **more: Any) -> InstrumentRow:
    """Return an effect whose amplitudes have one prior."""
    return InstrumentRow(name, title, tuple(
        Parameter(amplitude, unit, sd) for amplitude in amplitudes.split()), change, **more)


SENSORS = (
    ("gain", "sensitivity of", "gain", "1", 3e-3, "gain"),
    ("offset", "zero of", "offset", "T", 1e-4, "offset_T"),
    ("quadratic_nonlinearity", "quadratic non-linearity of", "coefficient", "1/T", 3e-3,
     "quadratic_per_T"),
    ("cubic_nonlinearity", "cubic non-linearity of", "coefficient", "1/T^2", 5e-3,
     "cubic_per_T2"))
"""What a sensor of a component does wrong, and a probe of |B| as well: name, title, amplitude, unit
and prior standard deviation, and key."""

EFFECTS = (
    _row("mapper_translation", "displacement of the mapper", "x y z", "m", 1e-3,
         _plus("translation_m")),
    # by centimetres; along one axis it would be no other cause than a displaced mapper
    _row("wrong_line", "wrong line of measurement", "x y z", "m", 2e-2, _plus("translation_m"),
         is_divisible=False),
    _row("wrong_radius", "wrong radius of the measurement", "offset", "m", 1e-2,
         _plus("radius_offset_m")),
    # moves the points of a circle along its radius alone, a displaced mapper also along the angle
    _row("eccentric_circle", "eccentric circles", "x y", "m", 1e-3, _plus("eccentricity_m")),
    _row("z_scale", "scale of the mapper along z", "scale", "1", 5e-4, _plus("z_scale")),
    _row("radius_scale", "length of the mapper's arm", "scale", "1", 5e-3,
         _plus("radius_scale")),
    # towards -y, with the square of the distance from the end at the smallest z
    _row("arm_sag", "sag of the mapper's arm", "sag", "m", 5e-4, _plus("arm_sag_m")),
    # in lines that all go one way it is a shift of the map but for the first point of each
    _row("lag", "lag of the readings behind the stage", "distance", "m", 3e-4, _plus("lag_m")),
    _row("drift", "drift of the zeros during the scan", "x y z", "T", 1e-4, _plus("drift_T")),
    # a magnet of NdFeB that gets warmer by a degree has lost a part in a thousand
    _row("gain_drift", "drift of the readings in proportion to the field, as of a warming magnet",
         "change", "1", 1e-3, _plus("gain_drift")),
    *(_row(name, f"mapper turned about {COMPONENTS[axis]}", "angle", "rad", 2e-3, _turned(axis))
      for axis, name in enumerate(("mapper_tilt_x", "mapper_tilt_y", "mapper_roll"))),
    *(_row(f"{name}_{COMPONENTS[axis]}", f"{title} the B{COMPONENTS[axis]} sensor", amplitudes,
           unit, sd, _plus(key, axis))
      for name, title, amplitudes, unit, sd, key in (
          *SENSORS, ("planar_hall", "planar Hall effect of", "coefficient", "1/T", 5e-3,
                     "planar_hall_per_T")) for axis in range(3)),
    *(_row(f"sensor_position_{COMPONENTS[axis]}", f"place of the B{COMPONENTS[axis]} sensor in the "
           "probe", "x y z", "m", 1e-3, _plus("sensor_position_m", axis)) for axis in range(3)),
    *(_row(f"{name}_of_magnitude", f"{title} the probe of |B|", amplitude, unit, sd,
           _plus_alike(key), of_total_field=True)
      for name, title, amplitude, unit, sd, key in (
          *SENSORS, ("drift", "drift of the zero of", "change", "T", 1e-4, "drift_T"))),
    *(_row(f"misalignment_{sensor}{other}", f"B{sensor} sensor tilted towards {other}",
           "crosstalk", "rad", 2e-3, _picked_up(sensor + other))
      for sensor in COMPONENTS for other in COMPONENTS if sensor != other),
    SlowReadingsEffect())
