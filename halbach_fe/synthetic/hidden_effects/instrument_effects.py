"""The mapper and its Hall probe with all their faults, and the effects that hide these.

A map records the nominal points, where the probe should have been. A fault of position means that
the field is read at another point, while the recorded point stays the nominal one.

The instrument that a study states makes a map, too. That is written from the words of
`halbach_fe.study.measurement_keys.Instrument` and shares no formula with
`halbach_fe.measurement.probe_law`, which corrects a map for it.

Gross errors are a wrong magnet or place of measurement, and a wrongly recorded map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.positions import motion
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.types import COMPONENTS, Axes
from halbach_fe.synthetic.hidden_effects.effect_types import (
    METRES,
    Check,
    Draw,
    HiddenEffect,
    Need,
    Refused,
    Site,
    Values,
    draw_direction,
    draw_length,
    draw_number,
    log_uniform,
    parameters,
    signed_log_uniform,
)
from halbach_fe.synthetic.shapes import Vector
from halbach_fe.synthetic.true_magnet import ZERO_VECTOR, Ball, TrueMagnet, vector

IDEAL_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class FaultyInstrument:
    """Faults of a mapper; the default has none. Lengths are in m, angles in rad, fields in T."""

    translation: Vector = ZERO_VECTOR
    rotation: Vector = ZERO_VECTOR
    """Displacement and rotation vector (about the origin) of the whole mapper, the axes of the
    probe included, along the magnet's axes."""
    z_scale: float = 0.0
    radius_scale: float = 0.0
    """The true z or radius is the recorded one times 1 plus this number."""
    radius_error: float = 0.0
    """Length that is added to the true radius; on the axis it points along x."""
    run_out: tuple[float, float] = (0.0, 0.0)
    """Amplitude d and angle phi_0 of a radius that varies as r + d cos(phi - phi_0)."""
    sag: Vector = ZERO_VECTOR
    """Sag of the arm's far end towards -y, and the z of its near and far end. The arm sags with the
    square of the distance from its near end."""
    vibration: float = 0.0
    """Standard deviation of the probe's position along each axis."""
    lag: float = 0.0
    """Distance by which the probe is behind on its way along a line. Where a line begins the stage
    has stopped."""
    sensors: tuple[Vector, Vector, Vector] = (ZERO_VECTOR, ZERO_VECTOR, ZERO_VECTOR)
    """Displacements of the sensors of B_x, B_y and B_z, along the mapper's axes."""
    axes: tuple[Vector, Vector, Vector] = IDEAL_AXES
    """``axes[i][j]`` is the sensitivity of sensor i to component j."""
    planar_hall: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0
    """Coefficients in 1/T, 1/T and 1/T^2. Sensor i adds planar_hall times the product of the two
    other components, and quadratic times the square and cubic times the third power of its
    reading."""
    gain: Vector = ZERO_VECTOR
    offset: Vector = ZERO_VECTOR
    """A sensor shows (1 + gain) times its reading, plus the offset."""
    drift: float = 0.0
    """Growth of all readings from the first to the last point of the map, linear in time."""
    gain_drift: float = 0.0
    """Growth of all sensitivities, or of the field of a magnet that gets colder, as a fraction."""
    memory: tuple[float, float] = (0.0, 0.0)
    """Fraction of every reading that comes from those before, and number of rows within which these
    are forgotten; 0 if it is the last one alone."""
    outliers: tuple[float, float] = (0.0, 0.0)
    """Fraction of the readings that are outliers, and their typical deviation."""
    reversed_z: bool = False
    """Whether the probe is at -z when z is recorded."""
    order: tuple[int, int, int] = (0, 1, 2)
    signs: Vector = (1.0, 1.0, 1.0)
    """Number of the sensor that is recorded as each component, and the sign it is given."""
    length_unit: float = 1.0
    field_unit: float = 1.0
    """Recorded number per metre and per tesla, such as 1000 for a record in mm or mT."""

    def places(self, points: Floats, generator: np.random.Generator) -> Floats:
        """Return the true positions of the three sensors, (3, n, 3) in m.

        ``points`` (n, 3) in m are the nominal ones.
        """
        x, y, z = points.T
        radius, angle = np.hypot(x, y), np.arctan2(y, x)
        swing, phase = self.run_out
        outward = (self.radius_scale * radius + self.radius_error
                   + swing * np.cos(angle - phase))
        depth, start, end = self.sag
        along = (z - start) / (end - start) if depth and end > start else np.zeros(len(z))
        height = -z if self.reversed_z else z
        probe = np.column_stack([
            x + outward * np.cos(angle),
            y + outward * np.sin(angle) - depth * along**2,
            (1 + self.z_scale) * height]) - self.lag * _way(points)
        turn = Rotation.from_rotvec(self.rotation)
        shaken = self.vibration * generator.standard_normal(points.shape)
        return np.array([turn.apply(probe + sensor) + self.translation + shaken
                         for sensor in self.sensors])

    def readings(self, fields: Floats, time: Floats, generator: np.random.Generator) -> Floats:
        """Return the readings of the three sensors, (n, 3) in T, without noise.

        Parameters
        ----------
        fields : ndarray, shape (3, n, 3), in T
            B at the positions of each sensor, along the magnet's axes.
        time : ndarray, shape (n,)
            Time of each reading, from 0 at the first of the map to 1 at its last.
        """
        turn = Rotation.from_rotvec(self.rotation).as_matrix()
        columns = []
        for sensor, field in enumerate(fields @ turn):
            shown = field @ self.axes[sensor]
            shown += self.planar_hall * np.prod(np.delete(field, sensor, axis=1), axis=1)
            shown += self.quadratic * shown**2 + self.cubic * shown**3
            grown = 1 + self.gain[sensor] + self.gain_drift * time
            columns.append(grown * shown + self.offset[sensor])
        fraction, size = self.outliers
        shown = _remembering(np.column_stack(columns), time, *self.memory)
        is_outlier = generator.random(shown.shape) < fraction
        jump = size * generator.uniform(0.5, 1.5, shown.shape) * generator.choice(
            [-1.0, 1.0], shown.shape)
        return np.asarray(shown + self.drift * time[:, None] + np.where(is_outlier, jump, 0.0))

    def record(self, points: Floats, readings: Floats) -> tuple[Floats, Floats]:
        """Return points (n, 3) in m and readings (n, 3) in T as they are recorded.

        Units, the order of the components and their signs are those of the record.
        """
        return (points * self.length_unit,
                readings[:, self.order] * self.signs * self.field_unit)


def _way(points: Floats) -> Floats:
    """Return the direction (n, 3) in which a stage came to each point; 0 where a line begins.

    Points go on in a line if the next step has nearly the same direction as the last one.
    """
    step = np.diff(points, axis=0)
    way = step / np.maximum(np.linalg.norm(step, axis=1), np.finfo(float).tiny)[:, None]
    goes_on = np.sum(way[1:] * way[:-1], axis=1) > np.cos(np.pi / 3)
    in_line = np.append(False, goes_on) | np.append(goes_on, False)
    return np.vstack([np.zeros((1, 3)), way * in_line[:, None]])


def _remembering(readings: Floats, time: Floats, fraction: float, rows: float) -> Floats:
    """Return readings (n, 3) as a slow instrument shows them, which starts at the first reading.

    What it remembers approaches the readings by the part ``1 - exp(-1 / rows)`` from row to row. A
    second map, at times beyond 1, starts anew.
    """
    if not fraction:
        return readings
    kept = np.exp(-1 / rows) if rows else 0.0
    shown, memory = readings.copy(), readings[0]
    for row in range(1, len(readings)):
        memory = kept * memory + (1 - kept) * readings[row - 1]
        if time[row] > 1 >= time[row - 1]:
            memory = readings[row]
        shown[row] += fraction * (memory - readings[row])
    return shown


def stated_places(instrument: Instrument, points: Floats) -> Floats:
    """Return where the three sensors (3, n, 3) in m are when a map says ``points`` (n, 3) in m."""
    x, y, z = points.T
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    swing = (instrument.eccentricity_m[0] * np.cos(angle)
             + instrument.eccentricity_m[1] * np.sin(angle))
    radius = ((1 + instrument.radius_scale) * radius + instrument.radius_offset_m
              + np.where(radius > 0, swing, 0.0))
    length = z.max() - z.min()
    sag = instrument.arm_sag_m * ((z - z.min()) / length) ** 2 if length else 0.0
    probe = np.column_stack([radius * np.cos(angle), radius * np.sin(angle) - sag,
                             (1 + instrument.z_scale) * z])
    if instrument.lag_m:
        probe = probe - instrument.lag_m * motion(points)
    turn = Rotation.from_rotvec(instrument.rotation_rad)
    return np.array([turn.apply(probe + sensor) + instrument.translation_m
                     for sensor in instrument.sensor_position_m])


def stated_readings(instrument: Instrument, fields: Floats, time: Floats) -> Floats:
    """Return what the sensors show, (n, 3) in T.

    Parameters
    ----------
    fields : ndarray, shape (3, n, 3), in T
        B at the place of each sensor, along the axes of the magnet.
    time : ndarray, shape (n,)
        From 0 at the first reading of the map to 1 at the last.
    """
    turn = Rotation.from_rotvec(instrument.rotation_rad).inv()
    shown = []
    for sensor, (name, field) in enumerate(zip(COMPONENTS, fields, strict=True)):
        seen = turn.apply(field).T
        own, (first, second) = seen[sensor], np.delete(seen, sensor, axis=0)
        value = ((1 + instrument.gain[sensor]) * own
                 + instrument.planar_hall_per_T[sensor] * first * second
                 + instrument.quadratic_per_T[sensor] * own**2
                 + instrument.cubic_per_T2[sensor] * own**3
                 + instrument.offset_T[sensor] + instrument.drift_T[sensor] * time
                 + instrument.gain_drift * time * own)
        for pair, part in instrument.crosstalk.items():
            if pair[0] == name:
                value = value + part * seen[COMPONENTS.index(pair[1])]
        shown.append(_slow(instrument, value))
    return np.column_stack(shown)


def _slow(instrument: Instrument, readings: Floats) -> Floats:
    """Return what a slow instrument shows (n,) of readings (n,) in the order of the scan."""
    fall = np.exp(-1 / instrument.memory_rows) if instrument.memory_rows else 0.0
    earlier = readings[0]  # as if the first reading had always been there
    shown = []
    for before, reading in zip(np.append(readings[:1], readings), readings, strict=False):
        earlier = fall * earlier + (1 - fall) * before
        shown.append((1 - instrument.memory) * reading + instrument.memory * earlier)
    return np.array(shown)


def columns(axes: Axes, vectors: Floats, unit: float) -> Floats:
    """Return vectors (n, 3) along the magnet's axes as columns of a file along its own ``axes``."""
    found = [vectors[:, COMPONENTS.index(axis[-1])] * (-1 if axis[0] == "-" else 1)
             for axis in axes]
    return np.column_stack(found) / unit


Apply = Callable[..., FaultyInstrument]
"""Function of an instrument, the site and the values that returns the instrument with them."""


def _plus(fault: str, *entry: int) -> Apply:
    """Return the effect that adds its values to a fault, or to one entry of it."""
    def apply(instrument: FaultyInstrument, site: Site, *values: float) -> FaultyInstrument:
        total = np.array(getattr(instrument, fault), float)
        total[entry] += values if total[entry].ndim else values[0]
        return replace(instrument, **{fault: _tuples(total.tolist())})
    return apply


def _tuples(values: Any) -> Any:
    return tuple(map(_tuples, values)) if isinstance(values, list) else values


def _set(fault: str) -> Apply:
    """Return the effect that sets a fault to its values."""
    return lambda instrument, site, *values: replace(
        instrument, **{fault: values if len(values) > 1 else values[0]})


def _turned(axis: int) -> Apply:
    """Return the effect that turns the mapper about the origin, together with the probe."""
    def apply(instrument: FaultyInstrument, site: Site, angle: float) -> FaultyInstrument:
        turn = Rotation.from_rotvec(angle * np.eye(3)[axis])
        return replace(
            instrument, translation=vector(turn.apply(instrument.translation)),
            rotation=vector((turn * Rotation.from_rotvec(instrument.rotation)).as_rotvec()))
    return apply


def _sagging(instrument: FaultyInstrument, site: Site, distance: float) -> FaultyInstrument:
    """Let the arm sag at its far end, that of the largest z."""
    return replace(instrument, sag=(instrument.sag[0] + distance, site.z_min, site.z_max))


def _draw_vector(low: float, high: float) -> Draw:
    """Return a function that draws a vector in m, its length between limits that are scaled."""
    def draw(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
        amount = site.scale * log_uniform(generator, low, high)
        return tuple(amount * value for value in draw_direction(generator, site.dimension))

    return draw


def _fault(name: str, stated: str, draw: Draw, apply: Apply, *needs: Need,
           **limits: Any) -> HiddenEffect:
    """Return an effect of the instrument, whose parameters are stated as in `parameters`."""
    return HiddenEffect(name, "instrument", parameters(stated, **limits), draw, instrument=apply,
                        needs=needs)


NUMBERED = tuple(enumerate(COMPONENTS))
STRETCH = {"fraction": (-0.5, 1.0)}

FAULTS = (
    *(_fault(f"gain_{name}", "fraction", draw_number(5e-4, 1e-2), _plus("gain", sensor), name,
             fraction=(-0.9, 10.0)) for sensor, name in NUMBERED),
    *(_fault(f"offset_{name}", "value T", draw_number(5e-5, 1e-3), _plus("offset", sensor), name)
      for sensor, name in NUMBERED),
    *(_fault(f"sensor_position_{name}", "x m, y m, z m", _draw_vector(3e-4, 3e-3),
             _plus("sensors", sensor), name) for sensor, name in NUMBERED),
    # a sensor picks up a fraction of another component
    *(_fault(f"misalignment_{name}{of}", "fraction", draw_number(1e-3, 1e-2),
             _plus("axes", sensor, other), name, "axes", *(("3d",) if of == "z" else ()))
      for sensor, name in NUMBERED for other, of in NUMBERED if sensor != other),
    _fault("planar_hall", "value 1/T", draw_number(1e-3, 1e-2), _plus("planar_hall"), "3d",
           "axes"),
    _fault("quadratic_nonlinearity", "value 1/T", draw_number(1e-3, 1e-2), _plus("quadratic")),
    _fault("cubic_nonlinearity", "value 1/T^2", draw_number(2e-3, 2e-2), _plus("cubic")),
    _fault("mapper_translation", "x m, y m, z m", _draw_vector(2e-4, 2e-3), _plus("translation"),
           x=METRES, y=METRES, z=METRES),
    _fault("mapper_roll", "angle rad", draw_number(5e-4, 5e-3), _turned(2)),
    _fault("mapper_tilt_x", "angle rad", draw_number(5e-4, 5e-3), _turned(0), "3d"),
    _fault("mapper_tilt_y", "angle rad", draw_number(5e-4, 5e-3), _turned(1), "3d"),
    _fault("z_scale", "fraction", draw_number(2e-4, 3e-3), _plus("z_scale"), "3d", **STRETCH),
    _fault("radius_scale", "fraction", draw_number(1e-3, 1e-2), _plus("radius_scale"), "circles",
           **STRETCH),
    _fault("arm_sag", "distance m", draw_length(3e-4, 3e-3, False), _sagging, "3d"),
    _fault("eccentric_circle", "distance m, angle rad",
           lambda site, generator: (site.scale * log_uniform(generator, 2e-4, 2e-3),
                                    float(generator.uniform(-np.pi, np.pi))),
           _set("run_out"), "circles"),
    _fault("drift", "value T", draw_number(1e-4, 1e-3), _plus("drift")),
    _fault("gain_drift", "change", draw_number(5e-4, 5e-3), _plus("gain_drift")),
    _fault("lag", "distance m", draw_length(1e-4, 5e-4, False), _plus("lag"), "3d"),
    _fault("slow_readings", "fraction, rows",
           lambda site, generator: (log_uniform(generator, 1e-3, 1e-2), 0.0), _set("memory"),
           fraction=(-0.5, 0.5), rows=(0.0,)),
    _fault("vibration", "distance m", draw_length(5e-5, 5e-4, False), _set("vibration"),
           distance=(0.0, 0.1)),
    _fault("outliers", "fraction, value T",
           lambda site, generator: (log_uniform(generator, 3e-3, 2e-2),
                                    log_uniform(generator, 1e-3, 1e-2)), _set("outliers"),
           fraction=(0.0, 1.0)))
"""What an instrument may do wrong, see the faults of `FaultyInstrument`."""


def _swapped(instrument: FaultyInstrument, site: Site, *numbers: float) -> FaultyInstrument:
    """Exchange two components, counted from 1."""
    order = list(instrument.order)
    i, j = (int(number) - 1 for number in numbers)
    order[i], order[j] = order[j], order[i]
    return replace(instrument, order=(order[0], order[1], order[2]))


def _draw_swap(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    first, second = sorted(generator.choice(3 if site.dimension == 3 else 2, 2, replace=False))
    return float(first + 1), float(second + 1)


def _sign_flipped(instrument: FaultyInstrument, site: Site, axis: float) -> FaultyInstrument:
    """Record a component, counted from 1, with the wrong sign."""
    signs = np.array(instrument.signs)
    signs[int(axis) - 1] *= -1
    return replace(instrument, signs=vector(signs))


def rotated_by_one_block(magnet: TrueMagnet, site: Site, blocks: float) -> TrueMagnet:
    """Turn the magnet about its axis by the angle of one block, or of several."""
    angle = blocks * 2 * np.pi / site.slots
    # their nominal places as well, so that the mesh of the reaction turns too
    return replace(magnet, bodies=tuple(body.turned(angle) for body in magnet.bodies))


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


def _gross(name: str, stated: str, draw: Draw, apply: Apply, *needs: Need,
           check: Check | None = None, **limits: Any) -> HiddenEffect:
    """Return a gross error of the instrument."""
    return replace(_fault(name, stated, draw, apply, *needs, **limits), group="gross", check=check)


def _of_two_axes(_: Site, values: Values) -> Refused:
    """Refuse an axis that is exchanged with itself."""
    return None if values["first"] != values["second"] else (
        "second", "another axis than the first", values["second"])


def _of_a_circle(site: Site, values: Values) -> Refused:
    """Refuse a change by which a circle would have no radius, or a negative one."""
    return None if values["change"] > -site.radius or site.radius == 0 else (
        "change", f"above {-site.radius:g} m, minus the radius of the map", values["change"])


def _of_some_rings(site: Site, values: Values) -> Refused:
    """Refuse to remove all rings: the map would be of no magnet."""
    return None if values["more"] > -site.rings else (
        "more", f"at least {1 - site.rings}, so that a ring is left", values["more"])


def _nothing(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    """Draw the values of an effect without parameters."""
    return ()


GROSS_ERRORS = (
    # on another radius; a line on the axis becomes one beside it
    _gross("wrong_radius", "change m", lambda site, generator: (
        signed_log_uniform(generator, 0.05, 0.2) * (
             site.radius if site.radius > 0 else site.inner),), _plus("radius_error"),
         check=_of_a_circle, change=METRES),
    _gross("swapped_axes", "first, second", _draw_swap, _swapped, "axes", check=_of_two_axes),
    _gross("sign_flipped_axis", "axis", lambda site, generator: (
        float(1 + "xyz".index(generator.choice(site.components))),), _sign_flipped, "axes"),
    _gross("millimetres", "", _nothing, lambda instrument, site: replace(
        instrument, length_unit=1000.0)),
    _gross("millitesla", "", _nothing, lambda instrument, site: replace(
        instrument, field_unit=1000.0)),
    # measured from the other end, with the probe's axes as they should be
    _gross("reversed_z", "", _nothing, lambda instrument, site: replace(
        instrument, reversed_z=not instrument.reversed_z), "3d"),
    HiddenEffect("rotated_by_one_block", "gross", parameters("blocks"),
                 lambda site, generator: (float(generator.choice([-1.0, 1.0])),),
                 rotated_by_one_block, needs=("equal rings",)),
    HiddenEffect("wrong_ring_count", "gross", parameters("more"),
                 lambda site, generator: (float(generator.choice([-1.0, 1.0]))
                                          if site.rings > 1 else 1.0,),
                 wrong_ring_count, needs=("3d", "equal rings"), check=_of_some_rings),
)

EFFECTS = (*FAULTS, *GROSS_ERRORS)
