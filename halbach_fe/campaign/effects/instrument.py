"""Effects on the mapper and its probe."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.campaign.bodies import Vector, vector
from halbach_fe.campaign.effects.kinds import (
    Draw,
    Effect,
    Parameter,
    Site,
    direction,
    length,
    number,
    size,
)
from halbach_fe.campaign.instrument import Instrument
from halbach_fe.study import COMPONENTS, Component


def _with(values: Vector, index: int, more: float) -> Vector:
    """Three numbers, one of them larger."""
    return vector(np.array(values) + more * np.eye(3)[index])


def _turned(instrument: Instrument, rotation: tuple[float, ...]) -> Instrument:
    """The mapper turned once more, about the origin."""
    turn = Rotation.from_rotvec(rotation)
    return replace(
        instrument, translation=vector(turn.apply(instrument.translation)),
        rotation=vector((turn * Rotation.from_rotvec(instrument.rotation)).as_rotvec()))


def _gain(sensor: int, name: Component) -> Effect:
    def apply(instrument: Instrument, site: Site, fraction: float) -> Instrument:
        return replace(instrument, gain=_with(instrument.gain, sensor, fraction))

    return Effect(f"gain_{name}", "instrument", (Parameter("fraction"),), number(5e-4, 1e-2),
                  instrument=apply, needs=(name,))


def _offset(sensor: int, name: Component) -> Effect:
    def apply(instrument: Instrument, site: Site, value: float) -> Instrument:
        return replace(instrument, offset=_with(instrument.offset, sensor, value))

    return Effect(f"offset_{name}", "instrument", (Parameter("value", "T"),), number(5e-5, 1e-3),
                  instrument=apply, needs=(name,))


def _misalignment(sensor: int, other: int) -> Effect:
    """The sensor picks up some of another component."""
    def apply(instrument: Instrument, site: Site, fraction: float) -> Instrument:
        axes = list(instrument.axes)
        axes[sensor] = _with(axes[sensor], other, fraction)
        return replace(instrument, axes=(axes[0], axes[1], axes[2]))

    name, of = COMPONENTS[sensor], COMPONENTS[other]
    return Effect(f"misalignment_{name}{of}", "instrument", (Parameter("fraction"),),
                  number(1e-3, 1e-2), instrument=apply,
                  needs=(name, "3d") if of == "z" else (name,))


def _sensor_position(sensor: int, name: Component) -> Effect:
    def apply(instrument: Instrument, site: Site, x: float, y: float, z: float) -> Instrument:
        sensors = list(instrument.sensors)
        sensors[sensor] = vector(np.add(sensors[sensor], (x, y, z)))
        return replace(instrument, sensors=(sensors[0], sensors[1], sensors[2]))

    return Effect(f"sensor_position_{name}", "instrument",
                  tuple(Parameter(axis, "m") for axis in "xyz"), _draw_vector(3e-4, 3e-3),
                  instrument=apply, needs=(name,))


def _draw_vector(low: float, high: float) -> Draw:
    def draw(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
        amount = site.scale * size(generator, low, high)
        return tuple(amount * value for value in direction(generator, site.dimension))

    return draw


def planar_hall(instrument: Instrument, site: Site, value: float) -> Instrument:
    """Every sensor adds the product of the two components in its plane."""
    return replace(instrument, planar_hall=instrument.planar_hall + value)


def quadratic_nonlinearity(instrument: Instrument, site: Site, value: float) -> Instrument:
    """Every sensor adds the square of its reading."""
    return replace(instrument, quadratic=instrument.quadratic + value)


def cubic_nonlinearity(instrument: Instrument, site: Site, value: float) -> Instrument:
    """Every sensor adds the third power of its reading."""
    return replace(instrument, cubic=instrument.cubic + value)


def mapper_translation(
    instrument: Instrument, site: Site, x: float, y: float, z: float
) -> Instrument:
    """The mapper stands elsewhere."""
    return replace(instrument, translation=vector(np.add(instrument.translation, (x, y, z))))


def mapper_roll(instrument: Instrument, site: Site, angle: float) -> Instrument:
    """The mapper is turned about z, the probe with it."""
    return _turned(instrument, (0.0, 0.0, angle))


def mapper_tilt_x(instrument: Instrument, site: Site, angle: float) -> Instrument:
    """The mapper is turned about x."""
    return _turned(instrument, (angle, 0.0, 0.0))


def mapper_tilt_y(instrument: Instrument, site: Site, angle: float) -> Instrument:
    """The mapper is turned about y."""
    return _turned(instrument, (0.0, angle, 0.0))


def z_scale(instrument: Instrument, site: Site, fraction: float) -> Instrument:
    """A metre along z is longer."""
    return replace(instrument, z_scale=instrument.z_scale + fraction)


def radius_scale(instrument: Instrument, site: Site, fraction: float) -> Instrument:
    """Radii are larger."""
    return replace(instrument, radius_scale=instrument.radius_scale + fraction)


def arm_sag(instrument: Instrument, site: Site, distance: float) -> Instrument:
    """The arm hangs down at its far end, that of the largest z."""
    return replace(instrument, sag=(instrument.sag[0] + distance, site.z_min, site.z_max))


def eccentric_circle(
    instrument: Instrument, site: Site, distance: float, angle: float
) -> Instrument:
    """The radius is r + d cos(phi - angle), phi being right."""
    return replace(instrument, run_out=(distance, angle))


def drift(instrument: Instrument, site: Site, value: float) -> Instrument:
    """All readings grow with time, by this over the map."""
    return replace(instrument, drift=instrument.drift + value)


def vibration(instrument: Instrument, site: Site, distance: float) -> Instrument:
    """The probe is elsewhere at each point."""
    return replace(instrument, vibration=distance)


def outliers(instrument: Instrument, site: Site, fraction: float, value: float) -> Instrument:
    """Some readings are off, by half to one and a half of the value."""
    return replace(instrument, outliers=(fraction, value))


def _effects() -> Iterator[Effect]:
    for make in (_gain, _offset, _sensor_position):
        for sensor, name in enumerate(COMPONENTS):
            yield make(sensor, name)
    for sensor in range(3):
        for other in range(3):
            if sensor != other:
                yield _misalignment(sensor, other)
    angle = (Parameter("angle", "rad"),)
    yield Effect("planar_hall", "instrument", (Parameter("value", "1/T"),), number(1e-3, 1e-2),
                 instrument=planar_hall, needs=("3d",))
    yield Effect("quadratic_nonlinearity", "instrument", (Parameter("value", "1/T"),),
                 number(1e-3, 1e-2), instrument=quadratic_nonlinearity)
    yield Effect("cubic_nonlinearity", "instrument", (Parameter("value", "1/T^2"),),
                 number(2e-3, 2e-2), instrument=cubic_nonlinearity)
    yield Effect("mapper_translation", "instrument",
                 tuple(Parameter(axis, "m") for axis in "xyz"), _draw_vector(2e-4, 2e-3),
                 instrument=mapper_translation)
    yield Effect("mapper_roll", "instrument", angle, number(5e-4, 5e-3), instrument=mapper_roll)
    for name, tilt in (("x", mapper_tilt_x), ("y", mapper_tilt_y)):
        yield Effect(f"mapper_tilt_{name}", "instrument", angle, number(5e-4, 5e-3),
                     instrument=tilt, needs=("3d",))
    yield Effect("z_scale", "instrument", (Parameter("fraction"),), number(2e-4, 3e-3),
                 instrument=z_scale, needs=("3d",))
    yield Effect("radius_scale", "instrument", (Parameter("fraction"),), number(1e-3, 1e-2),
                 instrument=radius_scale, needs=("circles",))
    yield Effect("arm_sag", "instrument", (Parameter("distance", "m"),),
                 length(3e-4, 3e-3, False), instrument=arm_sag, needs=("3d",))
    yield Effect("eccentric_circle", "instrument",
                 (Parameter("distance", "m"), Parameter("angle", "rad")),
                 lambda site, generator: (site.scale * size(generator, 2e-4, 2e-3),
                                          float(generator.uniform(-np.pi, np.pi))),
                 instrument=eccentric_circle, needs=("circles",))
    yield Effect("drift", "instrument", (Parameter("value", "T"),), number(1e-4, 1e-3),
                 instrument=drift)
    yield Effect("vibration", "instrument", (Parameter("distance", "m"),),
                 length(5e-5, 5e-4, False), instrument=vibration)
    yield Effect("outliers", "instrument", (Parameter("fraction"), Parameter("value", "T")),
                 lambda site, generator: (size(generator, 3e-3, 2e-2),
                                          size(generator, 1e-3, 1e-2)), instrument=outliers)


EFFECTS = tuple(_effects())
