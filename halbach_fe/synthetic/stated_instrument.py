"""The instrument that a study states, as it makes a map: the way back from the field to the file.

It is written from the words of `halbach_fe.study.measurement.Instrument` and shares no formula with
`halbach_fe.measurement.instrument`, which corrects a map for it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.scan_lines import motion
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS, Axes


def places(instrument: Instrument, points: Floats) -> Floats:
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


def values(instrument: Instrument, fields: Floats, time: Floats) -> Floats:
    """Return what the sensors show, (n, 3) in T.

    Parameters
    ----------
    instrument : Instrument
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
                 + instrument.offset_T[sensor] + instrument.drift_T[sensor] * time)
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
