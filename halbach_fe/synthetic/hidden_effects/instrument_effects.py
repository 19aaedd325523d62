"""Hidden effects of the mapper and its probe."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.study.types import COMPONENTS, Component
from halbach_fe.synthetic.faulty_instrument import FaultyInstrument
from halbach_fe.synthetic.hidden_effects.effect_types import (
    Draw,
    HiddenEffect,
    HiddenParameter,
    Site,
    draw_direction,
    draw_length,
    draw_number,
    log_uniform,
)
from halbach_fe.synthetic.true_magnet import Vector, vector


def _with(values: Vector, index: int, more: float) -> Vector:
    """Return three numbers, of which that at ``index`` is increased by ``more``."""
    return vector(np.array(values) + more * np.eye(3)[index])


def _turned(instrument: FaultyInstrument, rotation: tuple[float, ...]) -> FaultyInstrument:
    """Return the mapper turned by a further rotation vector about the origin."""
    turn = Rotation.from_rotvec(rotation)
    return replace(
        instrument, translation=vector(turn.apply(instrument.translation)),
        rotation=vector((turn * Rotation.from_rotvec(instrument.rotation)).as_rotvec()))


def _gain(sensor: int, name: Component) -> HiddenEffect:
    """Return the effect that a sensor has a relative error of its sensitivity."""
    def apply(instrument: FaultyInstrument, site: Site, fraction: float) -> FaultyInstrument:
        return replace(instrument, gain=_with(instrument.gain, sensor, fraction))

    return HiddenEffect(f"gain_{name}", "instrument",
                        (HiddenParameter("fraction", least=-0.9, most=10.0),),
                        draw_number(5e-4, 1e-2), instrument=apply, needs=(name,))


def _offset(sensor: int, name: Component) -> HiddenEffect:
    """Return the effect that a sensor has an offset."""
    def apply(instrument: FaultyInstrument, site: Site, value: float) -> FaultyInstrument:
        return replace(instrument, offset=_with(instrument.offset, sensor, value))

    return HiddenEffect(f"offset_{name}", "instrument", (HiddenParameter("value", "T"),),
                        draw_number(5e-5, 1e-3), instrument=apply, needs=(name,))


def _misalignment(sensor: int, other: int) -> HiddenEffect:
    """Return the effect that a sensor picks up a fraction of another component."""
    def apply(instrument: FaultyInstrument, site: Site, fraction: float) -> FaultyInstrument:
        axes = list(instrument.axes)
        axes[sensor] = _with(axes[sensor], other, fraction)
        return replace(instrument, axes=(axes[0], axes[1], axes[2]))

    name, of = COMPONENTS[sensor], COMPONENTS[other]
    return HiddenEffect(f"misalignment_{name}{of}", "instrument", (HiddenParameter("fraction"),),
                        draw_number(1e-3, 1e-2), instrument=apply,
                        needs=(name, "3d") if of == "z" else (name,))


def _sensor_position(sensor: int, name: Component) -> HiddenEffect:
    """Return the effect that a sensor is displaced in the probe."""
    def apply(instrument: FaultyInstrument, site: Site, x: float, y: float,
              z: float) -> FaultyInstrument:
        sensors = list(instrument.sensors)
        sensors[sensor] = vector(np.add(sensors[sensor], (x, y, z)))
        return replace(instrument, sensors=(sensors[0], sensors[1], sensors[2]))

    return HiddenEffect(f"sensor_position_{name}", "instrument",
                        tuple(HiddenParameter(axis, "m") for axis in "xyz"),
                        _draw_vector(3e-4, 3e-3), instrument=apply, needs=(name,))


def _draw_vector(low: float, high: float) -> Draw:
    """Return a function that draws a vector in m, its length between limits that are scaled."""
    def draw(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
        amount = site.scale * log_uniform(generator, low, high)
        return tuple(amount * value for value in draw_direction(generator, site.dimension))

    return draw


def planar_hall(instrument: FaultyInstrument, site: Site, value: float) -> FaultyInstrument:
    """Add to every sensor the product of the two components in its plane."""
    return replace(instrument, planar_hall=instrument.planar_hall + value)


def quadratic_nonlinearity(instrument: FaultyInstrument, site: Site,
                           value: float) -> FaultyInstrument:
    """Add to every sensor the square of its reading."""
    return replace(instrument, quadratic=instrument.quadratic + value)


def cubic_nonlinearity(instrument: FaultyInstrument, site: Site, value: float) -> FaultyInstrument:
    """Add to every sensor the third power of its reading."""
    return replace(instrument, cubic=instrument.cubic + value)


def mapper_translation(
    instrument: FaultyInstrument, site: Site, x: float, y: float, z: float
) -> FaultyInstrument:
    """Displace the mapper."""
    return replace(instrument, translation=vector(np.add(instrument.translation, (x, y, z))))


def mapper_roll(instrument: FaultyInstrument, site: Site, angle: float) -> FaultyInstrument:
    """Turn the mapper about z, together with the probe."""
    return _turned(instrument, (0.0, 0.0, angle))


def mapper_tilt_x(instrument: FaultyInstrument, site: Site, angle: float) -> FaultyInstrument:
    """Turn the mapper about x, together with the probe."""
    return _turned(instrument, (angle, 0.0, 0.0))


def mapper_tilt_y(instrument: FaultyInstrument, site: Site, angle: float) -> FaultyInstrument:
    """Turn the mapper about y, together with the probe."""
    return _turned(instrument, (0.0, angle, 0.0))


def z_scale(instrument: FaultyInstrument, site: Site, fraction: float) -> FaultyInstrument:
    """Increase all true z by a fraction."""
    return replace(instrument, z_scale=instrument.z_scale + fraction)


def radius_scale(instrument: FaultyInstrument, site: Site, fraction: float) -> FaultyInstrument:
    """Increase all true radii by a fraction."""
    return replace(instrument, radius_scale=instrument.radius_scale + fraction)


def arm_sag(instrument: FaultyInstrument, site: Site, distance: float) -> FaultyInstrument:
    """Let the arm sag at its far end, that of the largest z."""
    return replace(instrument, sag=(instrument.sag[0] + distance, site.z_min, site.z_max))


def eccentric_circle(
    instrument: FaultyInstrument, site: Site, distance: float, angle: float
) -> FaultyInstrument:
    """Let the radius be r + d cos(phi - angle), while phi is right; d is the ``distance``."""
    return replace(instrument, run_out=(distance, angle))


def drift(instrument: FaultyInstrument, site: Site, value: float) -> FaultyInstrument:
    """Let all readings grow with time, by ``value`` in T over the map."""
    return replace(instrument, drift=instrument.drift + value)


def lag(instrument: FaultyInstrument, site: Site, distance: float) -> FaultyInstrument:
    """Read the field behind where the stage is on its way."""
    return replace(instrument, lag=instrument.lag + distance)


def slow_readings(instrument: FaultyInstrument, site: Site, fraction: float,
                  rows: float) -> FaultyInstrument:
    """Let every reading contain a fraction of those before, forgotten within some ``rows``."""
    return replace(instrument, memory=(fraction, rows))


def vibration(instrument: FaultyInstrument, site: Site, distance: float) -> FaultyInstrument:
    """Displace the probe at random at each point; ``distance`` is the standard deviation."""
    return replace(instrument, vibration=distance)


def outliers(instrument: FaultyInstrument, site: Site, fraction: float,
             value: float) -> FaultyInstrument:
    """Change a fraction of the readings by 0.5 to 1.5 times ``value``, with either sign."""
    return replace(instrument, outliers=(fraction, value))


def _effects() -> Iterator[HiddenEffect]:
    for make in (_gain, _offset, _sensor_position):
        for sensor, name in enumerate(COMPONENTS):
            yield make(sensor, name)
    for sensor in range(3):
        for other in range(3):
            if sensor != other:
                yield _misalignment(sensor, other)
    angle = (HiddenParameter("angle", "rad"),)
    stretch = (HiddenParameter("fraction", least=-0.5, most=1.0),)
    yield HiddenEffect("planar_hall", "instrument", (HiddenParameter("value", "1/T"),),
                       draw_number(1e-3, 1e-2), instrument=planar_hall, needs=("3d",))
    yield HiddenEffect("quadratic_nonlinearity", "instrument", (HiddenParameter("value", "1/T"),),
                       draw_number(1e-3, 1e-2), instrument=quadratic_nonlinearity)
    yield HiddenEffect("cubic_nonlinearity", "instrument", (HiddenParameter("value", "1/T^2"),),
                       draw_number(2e-3, 2e-2), instrument=cubic_nonlinearity)
    yield HiddenEffect("mapper_translation", "instrument",
                       tuple(HiddenParameter(axis, "m") for axis in "xyz"),
                       _draw_vector(2e-4, 2e-3), instrument=mapper_translation)
    yield HiddenEffect("mapper_roll", "instrument", angle, draw_number(5e-4, 5e-3),
                       instrument=mapper_roll)
    for name, tilt in (("x", mapper_tilt_x), ("y", mapper_tilt_y)):
        yield HiddenEffect(f"mapper_tilt_{name}", "instrument", angle, draw_number(5e-4, 5e-3),
                           instrument=tilt, needs=("3d",))
    yield HiddenEffect("z_scale", "instrument", stretch,
                       draw_number(2e-4, 3e-3), instrument=z_scale, needs=("3d",))
    yield HiddenEffect("radius_scale", "instrument", stretch,
                       draw_number(1e-3, 1e-2), instrument=radius_scale, needs=("circles",))
    yield HiddenEffect("arm_sag", "instrument", (HiddenParameter("distance", "m"),),
                       draw_length(3e-4, 3e-3, False), instrument=arm_sag, needs=("3d",))
    yield HiddenEffect("eccentric_circle", "instrument",
                       (HiddenParameter("distance", "m"), HiddenParameter("angle", "rad")),
                       lambda site, generator: (site.scale * log_uniform(generator, 2e-4, 2e-3),
                                                float(generator.uniform(-np.pi, np.pi))),
                       instrument=eccentric_circle, needs=("circles",))
    yield HiddenEffect("drift", "instrument", (HiddenParameter("value", "T"),),
                       draw_number(1e-4, 1e-3), instrument=drift)
    yield HiddenEffect("lag", "instrument", (HiddenParameter("distance", "m"),),
                       draw_length(1e-4, 5e-4, False), instrument=lag, needs=("3d",))
    yield HiddenEffect("slow_readings", "instrument",
                       (HiddenParameter("fraction", least=-0.5, most=0.5),
                        HiddenParameter("rows", least=0.0)),
                       lambda site, generator: (log_uniform(generator, 1e-3, 1e-2), 0.0),
                       instrument=slow_readings)
    yield HiddenEffect("vibration", "instrument", (HiddenParameter("distance", "m", 0.0, 0.1),),
                       draw_length(5e-5, 5e-4, False), instrument=vibration)
    yield HiddenEffect("outliers", "instrument",
                       (HiddenParameter("fraction", least=0.0, most=1.0),
                        HiddenParameter("value", "T")),
                       lambda site, generator: (log_uniform(generator, 3e-3, 2e-2),
                                                log_uniform(generator, 1e-3, 1e-2)),
                       instrument=outliers)


EFFECTS = tuple(_effects())
