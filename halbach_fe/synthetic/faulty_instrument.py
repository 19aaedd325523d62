"""The mapper and its Hall probe with all their faults: from the field to the recorded map.

A map records the nominal points, where the probe should have been. A fault of position means that
the field is read at another point, while the recorded point stays the nominal one.

The instrument that a study states makes a map, too. That is written from the words of
`halbach_fe.study.measurement.Instrument` and shares no formula with
`halbach_fe.measurement.instrument`, which corrects a map for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.positions import motion
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS, Axes
from halbach_fe.synthetic.shapes import Vector
from halbach_fe.synthetic.true_magnet import ZERO_VECTOR

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
        along = (z - start) / (end - start) if depth else np.zeros(len(z))
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
