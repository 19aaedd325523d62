"""The terms of an instrument as numbers that a fit can change: pose, and parameters of the probe.

A vector (30,) holds the changes of all terms: shift of the map's middle and turn about it, along
the magnet's axes, then crosstalk, gains, offsets, places of the sensors, and drift. Of the places
of the sensors only differences count: what all sensors have in common is a shift of the map.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.instrument import sensor_matrix, sensor_positions
from halbach_fe.study.inference import InstrumentSd
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS

CROSSTALK = ("xy", "xz", "yx", "yz", "zx", "zy")

NAMES = (*(f"translation_{axis}_m" for axis in COMPONENTS),
         *(f"rotation_{axis}_rad" for axis in COMPONENTS),
         *(f"crosstalk_{pair}" for pair in CROSSTALK),
         *(f"gain_{axis}" for axis in COMPONENTS),
         *(f"offset_{axis}_T" for axis in COMPONENTS),
         *(f"sensor_{sensor}_{axis}_m" for sensor in COMPONENTS for axis in COMPONENTS),
         *(f"drift_{axis}_T" for axis in COMPONENTS))
"""Names of all terms, in their order."""

POSE, PROBE, STEADY = slice(0, 6), slice(6, 30), slice(0, 27)
"""Terms of the pose, of the probe, and all but those that change with time."""

OFFSETS, SENSORS, DRIFTS = slice(15, 18), slice(18, 27), slice(27, 30)

APART = np.eye(3) - 1 / 3
"""Takes their mean from the places of three sensors."""

SMALL = 1e-5
"""Step of finite differences."""

DIFFERENCE_M = 2e-4
"""Step of finite differences for the gradient of the field."""


def prior_sd(settings: InstrumentSd) -> Floats:
    """Return the prior standard deviations (30,) of all terms.

    What three uncertain places of sensors have in common adds to the shift of the map.
    """
    shift = np.hypot(settings.translation_m, settings.sensor_position_m / np.sqrt(3))
    return np.repeat([shift, settings.rotation_rad, settings.crosstalk,
                      settings.gain, settings.offset_T, settings.sensor_position_m,
                      settings.drift_T], [3, 3, 6, 3, 3, 9, 3])


def with_terms(instrument: Instrument, middle: Floats, changes: Floats) -> Instrument:
    """Return an instrument after changes (30,) of its terms.

    Parameters
    ----------
    middle : ndarray, shape (3,), in m
        The point of the map that the shift moves and the turn leaves in its place.
    changes : ndarray, shape (30,)

    Raises
    ------
    StudyError
        If the terms become larger than an instrument may have.
    """
    before = Rotation.from_rotvec(instrument.rotation_rad)
    after = Rotation.from_rotvec(changes[3:6]) * before
    origin = (before.apply(middle) + instrument.translation_m + changes[:3] - after.apply(middle))
    given = {str(name): value for name, value in instrument.crosstalk.items()}
    crosstalk = {name: given.get(name, 0.0) + float(value)
                 for name, value in zip(CROSSTALK, changes[6:12], strict=True)}
    gain, offset, drift = (tuple((np.array(own) + changes[part]).tolist()) for own, part in (
        (instrument.gain, slice(12, 15)), (instrument.offset_T, OFFSETS),
        (instrument.drift_T, DRIFTS)))
    sensors = np.array(instrument.sensor_position_m) + APART @ changes[SENSORS].reshape(3, 3)
    return instrument.with_(
        translation_m=tuple(origin.tolist()), rotation_rad=tuple(after.as_rotvec().tolist()),
        crosstalk=crosstalk, gain=gain, offset_T=offset, drift_T=drift,
        sensor_position_m=tuple(map(tuple, sensors.tolist())))


def sensors_apart(covariance: Floats) -> Floats:
    """Return a covariance (p, p), whose first terms are those of `STEADY`, with the places of
    sensors from the mean of all.
    """
    matrix = np.eye(len(covariance))
    matrix[SENSORS, SENSORS] = np.kron(APART, np.eye(3))
    return np.asarray(matrix @ covariance @ matrix.T)


def field_at_sensors(
    field: Callable[[Floats], Floats], sensors: Floats
) -> tuple[Floats, Floats]:
    """Return B (n, 3, 3) in T and its gradient (n, 3, 3, 3) in T/m at sensors (n, 3, 3) in m.

    The axes are point of the map, sensor, component of B, and direction. Between sensors that are
    close together the field is taken for linear.
    """
    # Distance of the sensors from their mean up to which the field is linear between them: in a
    # gradient that changes by 1 T/m in 1 mm, the error is 0.05 mT.
    close_m = 3e-4
    count = len(sensors)
    middle = sensors.mean(axis=1)
    apart = bool(np.abs(sensors - middle[:, None]).max() > close_m)
    places = sensors.reshape(-1, 3) if apart else middle
    steps = DIFFERENCE_M * np.eye(3)
    fields = field(np.concatenate([places, *(
        places + sign * step for step in steps for sign in (1, -1))]))
    here, around = fields[:len(places)], fields[len(places):].reshape(3, 2, -1, 3)
    gradient = np.moveaxis(around[:, 0] - around[:, 1], 0, -1) / (2 * DIFFERENCE_M)
    if not apart:
        here, gradient = np.repeat(here, 3, axis=0), np.repeat(gradient, 3, axis=0)
        here = here + np.einsum("nck,nk->nc", gradient, (sensors - middle[:, None]).reshape(-1, 3))
    return here.reshape(count, 3, 3), gradient.reshape(count, 3, 3, 3)


def seen(matrix: Floats, at_sensors: Floats) -> Floats:
    """Return values (n, 3) of a map of B (n, 3, 3) at the sensors, by a sensor matrix (3, 3)."""
    return np.einsum("ij,nij->ni", matrix, at_sensors)


def by_terms(
    instrument: Instrument, points: Floats, middle: Floats, time: Floats, field: Floats,
    gradient: Floats, terms: slice = slice(None)
) -> Floats:
    """Return the derivatives (n, 3, terms) of a map's values by the terms of its instrument.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
        Points as the map states them.
    middle : ndarray, shape (3,), in m
        See `with_terms`.
    time : ndarray, shape (n,)
        See `halbach_fe.measurement.instrument.map_time`.
    field, gradient : ndarray, shapes (n, 3, 3) and (n, 3, 3, 3)
        See `field_at_sensors`.
    terms : slice
        Of the 30 terms those that are wanted.
    """
    matrix, sensors = sensor_matrix(instrument), sensor_positions(instrument, points)
    here = seen(matrix, field)
    columns = []
    for step in SMALL * np.eye(len(NAMES))[terms]:
        other = with_terms(instrument, middle, step)
        moved = sensor_positions(other, points) - sensors
        there = seen(sensor_matrix(other), field + np.einsum("nsck,nsk->nsc", gradient, moved))
        columns.append((there - here + step[OFFSETS] + np.outer(time, step[DRIFTS])) / SMALL)
    return np.stack(columns, axis=-1)
