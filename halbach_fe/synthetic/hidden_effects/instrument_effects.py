"""Hidden effects of the mapper and its probe, and gross errors.

These are a wrong magnet or place of measurement, and a wrongly recorded map.
"""

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
    signed_log_uniform,
)
from halbach_fe.synthetic.iron import Ball
from halbach_fe.synthetic.shapes import Vector
from halbach_fe.synthetic.true_magnet import Body, TrueMagnet, vector


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
                        needs=(name, "axes", "3d") if of == "z" else (name, "axes"))


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


def gain_drift(instrument: FaultyInstrument, site: Site, change: float) -> FaultyInstrument:
    """Let all readings grow with time in proportion to the field, by a fraction over the map."""
    return replace(instrument, gain_drift=instrument.gain_drift + change)


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
                       draw_number(1e-3, 1e-2), instrument=planar_hall, needs=("3d", "axes"))
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
    yield HiddenEffect("gain_drift", "instrument", (HiddenParameter("change"),),
                       draw_number(5e-4, 5e-3), instrument=gain_drift)
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




NOTHING: tuple[float, ...] = ()
"""Values of an effect without parameters."""


def wrong_radius(instrument: FaultyInstrument, site: Site, more: float) -> FaultyInstrument:
    """Let the probe run on another radius; a line on the axis becomes one beside it."""
    return replace(instrument, radius_error=instrument.radius_error + more)


def swapped_axes(instrument: FaultyInstrument, site: Site, first: float,
                 second: float) -> FaultyInstrument:
    """Exchange two components, counted from 1."""
    order = list(instrument.order)
    i, j = int(first) - 1, int(second) - 1
    order[i], order[j] = order[j], order[i]
    return replace(instrument, order=(order[0], order[1], order[2]))


def _draw_swap(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    first, second = sorted(generator.choice(3 if site.dimension == 3 else 2, 2, replace=False))
    return float(first + 1), float(second + 1)


def sign_flipped_axis(instrument: FaultyInstrument, site: Site, axis: float) -> FaultyInstrument:
    """Record a component, counted from 1, with the wrong sign."""
    signs = np.array(instrument.signs)
    signs[int(axis) - 1] *= -1
    return replace(instrument, signs=vector(signs))


def _draw_axis(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    return (float(1 + "xyz".index(generator.choice(site.components))),)


def millimetres(instrument: FaultyInstrument, site: Site) -> FaultyInstrument:
    """Record positions in mm."""
    return replace(instrument, length_unit=1000.0)


def millitesla(instrument: FaultyInstrument, site: Site) -> FaultyInstrument:
    """Record fields in mT."""
    return replace(instrument, field_unit=1000.0)


def reversed_z(instrument: FaultyInstrument, site: Site) -> FaultyInstrument:
    """Measure the magnet from its other end, with the probe's axes as they should be."""
    return replace(instrument, reversed_z=not instrument.reversed_z)


def rotated_by_one_block(magnet: TrueMagnet, site: Site, blocks: float) -> TrueMagnet:
    """Turn the magnet about its axis by the angle of one block, or of several."""
    angle = blocks * 2 * np.pi / site.slots
    turn = Rotation.from_euler("z", angle)

    def turned(body: Body) -> Body:
        """Turn a body's nominal place as well, so that the mesh of the reaction turns too."""
        return replace(body, angle=body.angle + angle, centre=vector(turn.apply(body.centre)),
                       displacement=vector(turn.apply(body.displacement)),
                       rotation=vector(turn.apply(body.rotation)))

    return replace(magnet, bodies=tuple(turned(body) for body in magnet.bodies))


def wrong_ring_count(magnet: TrueMagnet, site: Site, more: float) -> TrueMagnet:
    """Add ``more`` rings like the last, or remove rings, and centre the magnet at z = 0."""
    last = [body for body in magnet.bodies if body.ring == site.rings]
    first = next(body for body in magnet.bodies if body.ring == 1)
    length = first.shape.length
    pitch = (last[0].centre[2] - first.centre[2]) / (site.rings - 1) if site.rings > 1 else length
    bodies = [body for body in magnet.bodies if body.ring <= site.rings + more]
    for number in range(1, int(more) + 1):
        bodies += [replace(body, ring=site.rings + number,
                           centre=vector(np.add(body.centre, (0, 0, number * pitch))))
                   for body in last]
    iron = magnet.iron and replace(magnet.iron, bodies=tuple(
        body if isinstance(body, Ball) or any(body.turn) else
        replace(body, half_length=body.half_length + more * pitch / 2)
        for body in magnet.iron.bodies))
    return replace(magnet, iron=iron, bodies=tuple(
        replace(body, centre=vector(np.add(body.centre, (0, 0, -more * pitch / 2))))
        for body in bodies))


GROSS_ERRORS = (
    HiddenEffect("wrong_radius", "gross", (HiddenParameter("change", "m"),),
                 lambda site, generator: (signed_log_uniform(generator, 0.05, 0.2) * (
                     site.radius if site.radius > 0 else site.inner),), instrument=wrong_radius),
    HiddenEffect("swapped_axes", "gross", (HiddenParameter("first"), HiddenParameter("second")),
                 _draw_swap, instrument=swapped_axes, needs=("axes",)),
    HiddenEffect("sign_flipped_axis", "gross", (HiddenParameter("axis"),), _draw_axis,
                 instrument=sign_flipped_axis, needs=("axes",)),
    HiddenEffect("millimetres", "gross", (), lambda site, generator: NOTHING,
                 instrument=millimetres),
    HiddenEffect("millitesla", "gross", (), lambda site, generator: NOTHING, instrument=millitesla),
    HiddenEffect("reversed_z", "gross", (), lambda site, generator: NOTHING, instrument=reversed_z,
                 needs=("3d",)),
    HiddenEffect("rotated_by_one_block", "gross", (HiddenParameter("blocks"),),
                 lambda site, generator: (float(generator.choice([-1.0, 1.0])),),
                 rotated_by_one_block, needs=("equal rings",)),
    HiddenEffect("wrong_ring_count", "gross", (HiddenParameter("more"),),
                 lambda site, generator: (float(generator.choice([-1.0, 1.0]))
                                          if site.rings > 1 else 1.0,),
                 wrong_ring_count, needs=("3d", "equal rings")),
)

EFFECTS = (*_effects(), *GROSS_ERRORS)
