"""The law of the probe of a field mapper: how B at its sensors becomes the values of a map.

The numbers of the model are explained in `halbach_fe.study.measurement_keys.Instrument`. They are
applied in three ways:

* Units and axes of the map are converted when it is read (`in_si_and_magnet_axes`).
* Effects that are linear in B (positions, orientation, gains and crosstalk of the sensors) are part
  of the model of a reading (`sensor_model`).
* All other effects (offset, drift, nonlinearity and memory) are subtracted from the map
  (`remove_nonlinear_part`).

A fit changes the terms of an instrument as numbers, in a vector (30,) of their changes: shift of
the map's middle and turn about it, along the magnet's axes, then crosstalk, gains, offsets, places
of the sensors, and drift. Of the places of the sensors only differences count: what all sensors
have in common is a shift of the map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.numbers import in_a_row
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.measurement.field_map import (
    MAX_FIELD_T,
    POSITION_COLUMNS,
    TOTAL_COLUMN,
    TOTAL_COLUMNS,
    check_magnitudes,
    has_times,
    points_of,
    refuse_undirected,
)
from halbach_fe.measurement.positions import motion
from halbach_fe.study.measurement_keys import Instrument, InstrumentSd
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS


@dataclass(frozen=True)
class SensorModel:
    """Positions of a mapper's sensors and their linear response to B, for a map of n points."""

    points: Floats
    """Position of the probe at each point of the map. If its three sensors are apart, the position
    of each sensor, point by point. Shape (n, 3) or (3 n, 3), in m."""
    operator: sparse.csr_array
    """Maps B at ``points``, flattened point by point, to the linear part of the map's values (Bx,
    By, Bz of each point). Shape (3 n, 3 len(points))."""


def in_si_and_magnet_axes(instrument: Instrument, data: xr.Dataset) -> xr.Dataset:
    """Convert a map to m, T and the magnet's axes, by the units and axes that the study states.

    Raises
    ------
    MeasurementError
        If positions or flux densities are so large that they must be in another unit, or nobody
        has said which component the map holds.
    """
    refuse_undirected(data)
    read, unit = by_stated_units(instrument, data), instrument.flux_density_unit_T
    largest = max(float(np.abs(np.nan_to_num(read[name].values)).max())
                  for name in ("B_T", TOTAL_COLUMN) if name in read)
    if unit > 1 and largest > MAX_FIELD_T:  # check_magnitudes would advise another such unit
        raise MeasurementError(must_be(
            "`instrument.flux_density_unit_T`", "the study", "the T in a unit of the map, 0.001 "
            "for mT", f"{unit:g}, with which the map has {largest:.3g} T",
            f"Write {1 / unit:g}, or leave it out if the map is in T."))
    check_magnitudes(read)
    return read


def by_stated_units(instrument: Instrument, data: xr.Dataset) -> xr.Dataset:
    """Convert a map like `in_si_and_magnet_axes`, however large its numbers are."""
    points = to_magnet_axes(instrument.position_axes, points_of(data)) * instrument.length_unit_m
    unit = instrument.flux_density_unit_T
    field = to_magnet_axes(instrument.field_axes, data["B_T"].values) * unit
    read = data.assign_coords({name: data[name].copy(data=points[:, axis])
                               for axis, name in enumerate(POSITION_COLUMNS)})
    read = read.assign(B_T=data["B_T"].copy(data=field))
    if "sigma_T" in data:
        sigma = to_magnet_axes(instrument.field_axes, data["sigma_T"].values) * unit
        sigma *= to_magnet_axes(instrument.field_axes, np.ones(sigma.shape))  # axes have signs
        read = read.assign(sigma_T=data["sigma_T"].copy(data=sigma))
    return read.assign({name: data[name] * unit for name in TOTAL_COLUMNS if name in data})


def to_magnet_axes(axes: Sequence[str], columns: Floats) -> Floats:
    """Convert vectors (n, 3) to the axes of the magnet, or of whatever else names the axes.

    Parameters
    ----------
    axes : sequence of str
        For each column of the vectors, the axis along which it points, such as
        ``("x", "-z", "y")``.
    columns : ndarray, shape (n, 3)
    """
    found = np.empty(columns.shape)
    for column, axis in enumerate(axes):
        sign = -1.0 if axis.startswith("-") else 1.0
        found[:, COMPONENTS.index(axis[-1])] = sign * columns[:, column]
    return found


def sensor_model(instrument: Instrument, points: Floats) -> SensorModel:
    """Return the sensors' positions and linear response for a map's points (n, 3) in m."""
    count = len(points)
    positions = sensor_positions(instrument, points)
    rows = sensor_matrix(instrument)
    if not np.ptp(positions, axis=1).any():
        return SensorModel(positions[:, 0],
                           sparse.csr_array(sparse.kron(sparse.eye_array(count), rows)))
    apart = np.zeros((3, 9))  # each sensor responds to B at its own position
    for axis in range(3):
        apart[axis, 3 * axis:3 * axis + 3] = rows[axis]
    return SensorModel(positions.reshape(-1, 3),
                       sparse.csr_array(sparse.kron(sparse.eye_array(count), apart)))


def sensor_positions(
    instrument: Instrument, points: Floats, way: Floats | None = None
) -> Floats:
    """Return the positions (n, 3, 3) in m of each sensor at the points (n, 3) in m of a map.

    The axes of the result are point of the map, sensor, and coordinate. ``way`` (n, 3) are the
    directions in which the stage came to the points; None if these are all, in their order.
    """
    stretched = points * [1 + instrument.radius_scale, 1 + instrument.radius_scale,
                          1 + instrument.z_scale]
    if instrument.radius_offset_m:
        stretched += instrument.radius_offset_m * radial_direction(points)
    if any(instrument.eccentricity_m):
        stretched += np.tensordot(instrument.eccentricity_m, eccentricity_shift(points), 1)
    z = points[:, 2]
    if instrument.arm_sag_m and np.ptp(z) > 0:
        stretched[:, 1] -= instrument.arm_sag_m * ((z - z.min()) / np.ptp(z)) ** 2
    if instrument.lag_m:
        stretched -= instrument.lag_m * (motion(points) if way is None else way)
    sensors = stretched[:, None] + np.array(instrument.sensor_position_m)
    return np.asarray(sensors @ rotation_matrix(instrument.rotation_rad).T
                      + instrument.translation_m)


def probe_points(instrument: Instrument, points: Floats) -> Floats:
    """Return the mean position (n, 3) in m of the sensors at each of a map's points (n, 3) in m."""
    return np.asarray(sensor_positions(instrument, points).mean(axis=1))


def radial_direction(points: Floats) -> Floats:
    """Return the unit vectors (n, 3) radially outward at points (n, 3); on the axis, along x."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(points))])


def eccentricity_shift(points: Floats) -> Floats:
    """Return the displacements (2, n, 3) of points on circles per unit of eccentricity in x and y.

    The probe moves on an eccentric circle: its distance from the axis changes by the eccentricity
    times the cosine (x) or sine (y) of its angle. Of the points (n, 3), those on the axis are not
    displaced.
    """
    away = radial_direction(points) * (np.hypot(points[:, 0], points[:, 1]) > 0)[:, None]
    return np.stack([away[:, [0]] * away, away[:, [1]] * away])


def turn_of(instrument: Instrument) -> Rotation:
    """Return the turn from the axes that a map states to those of the magnet."""
    return Rotation.from_rotvec(instrument.rotation_rad)


def sensor_matrix(instrument: Instrument) -> Floats:
    """Return the matrix (3, 3) from B in the magnet's axes to the sensors' linear response."""
    matrix = np.diag(1 + np.array(instrument.gain))
    for name, value in instrument.crosstalk.items():
        matrix[COMPONENTS.index(name[0]), COMPONENTS.index(name[1])] = value
    return matrix @ rotation_matrix(instrument.rotation_rad).T


def nonlinear_part(instrument: Instrument, fields: Floats, time: Floats) -> Floats:
    """Return the part (n, 3) in T of the sensors' values that is not linear in B.

    It is the sum of planar Hall effect, quadratic and cubic terms, offset and drifts.

    Parameters
    ----------
    fields : ndarray, shape (n, 3), in T
        B in the sensors' own axes.
    time : ndarray, shape (n,)
        Time of each reading, from 0 at the beginning to 1 at the end of the map; see `map_time`.
    """
    others = np.stack([fields[:, 1] * fields[:, 2], fields[:, 0] * fields[:, 2],
                       fields[:, 0] * fields[:, 1]], axis=1)
    return np.asarray(
        others * instrument.planar_hall_per_T + fields**2 * instrument.quadratic_per_T
        + fields**3 * instrument.cubic_per_T2 + instrument.offset_T
        + np.outer(time, instrument.drift_T) + instrument.gain_drift * time[:, None] * fields)


def with_memory(instrument: Instrument, values: Floats, time: Floats) -> Floats:
    """Return what a slow instrument shows (n, 3) of readings (n, 3), which are in any order.

    Readings that are NaN have no influence on others.
    """
    return _filtered(values, time, *_memory_law(instrument)) if instrument.memory else values


def without_memory(instrument: Instrument, shown: Floats, time: Floats) -> Floats:
    """Return the readings (n, 3) of which a slow instrument shows these; see `with_memory`."""
    if not instrument.memory:
        return shown
    numerator, denominator = _memory_law(instrument)
    return _filtered(shown, time, denominator, numerator)


def _memory_law(instrument: Instrument) -> tuple[list[float], list[float]]:
    """Return the coefficients of the filter from a reading to what a slow instrument shows."""
    part, rows = instrument.memory, instrument.memory_rows
    kept = float(np.exp(-1 / rows)) if rows else 0.0
    return [1 - part, part * (1 - kept) - (1 - part) * kept], [1.0, -kept]


def _filtered(
    values: Floats, time: Floats, numerator: list[float], denominator: list[float]
) -> Floats:
    """Return values (n, 3) after a filter along the time (n,), as if the first had always been."""
    from scipy.signal import lfilter  # half a second of every start, which few commands need

    order = np.argsort(time, kind="stable")
    found = np.full(values.shape, np.nan)
    for axis, column in enumerate(values[order].T):
        rows = np.isfinite(column)
        if rows.any():
            first = column[rows][0]
            found[order[rows], axis] = first + lfilter(
                numerator, denominator, column[rows] - first)
    return found


def map_time(data: xr.Dataset) -> Floats:
    """Return the time (n,) of each point of a map, scaled to run from 0 to 1.

    Without recorded times the points are assumed to have been measured in the order of the map, at
    equal intervals.
    """
    count = data.sizes["point"]
    time = (data["time_s"].values if has_times(data) else np.arange(count)).astype(float)
    return np.asarray((time - time.min()) / (np.ptp(time) or 1.0))


def row_order_note(study: Study) -> str:
    """Say that a lag, memory or drift follows from the order of rows; else nothing."""
    instruments = [study.instrument, *(one.instrument for one in study.maps if one.instrument)]
    named = [what for what, there in (
        ("a lag behind the stage (lag_m)", any(one.lag_m for one in instruments)),
        ("a memory of the reading before", any(one.memory for one in instruments)),
        ("a drift (drift_T)", any(any(one.drift_T) for one in instruments)),
        ("a drift of the gain (gain_drift)", any(one.gain_drift for one in instruments))) if there]
    return (f"The study has {in_a_row(named)}. It counts on rows in the order in which they "
            "were read, unless a column time_s says when: if there is none, or its times are all "
            "the same, a table that was sorted or joined makes it wrong." if named else "")


def remove_nonlinear_part(instrument: Instrument, data: xr.Dataset) -> Floats:
    """Return the values (n, 3) in T of a map without the part that is not linear in B.

    The nonlinear part depends on the field, which is found by fixed-point iteration of the law of
    the sensors. Components that were not measured stay NaN.

    Raises
    ------
    MeasurementError
        If the planar Hall effect needs a component that the map does not hold, or the iteration
        does not converge.
    """
    converged_t = 1e-12  # largest residual in T at which the iteration stops
    time = map_time(data)
    shown = without_memory(instrument, np.asarray(data["B_T"].values, float), time)
    missing = np.isnan(shown)
    check_components(instrument, missing)
    linear = instrument.with_(rotation_rad=(0.0, 0.0, 0.0))
    matrix, field = sensor_matrix(linear), np.nan_to_num(shown)
    # largest number of fixed-point iterations that invert the law of the sensors
    most_rounds = 50
    for _ in range(most_rounds):
        rest = nonlinear_part(instrument, field, time)
        wrong = np.where(missing, 0.0, np.nan_to_num(shown) - field @ matrix.T - rest)
        field = field + wrong  # converges, since the law is nearly the identity
        if not np.abs(wrong).max() > converged_t:
            return shown - rest
    raise MeasurementError(must_be(
        "`instrument`", "study", "a law of the sensors that can be inverted",
        "a law whose inversion does not converge", "Make its nonlinear terms smaller."))


def field_read(instrument: Instrument, data: xr.Dataset) -> Floats:
    """Return B (n, 3) in T of a map, along the magnet's axes, by the law of the sensors; all three
    components are NaN where one was not measured.
    """
    values = remove_nonlinear_part(instrument, data)
    return np.asarray(np.linalg.solve(sensor_matrix(instrument), values.T).T)


def total_without_nonlinear_part(instrument: Instrument, data: xr.Dataset) -> Floats:
    """Return |B| (n,) in T of a map of |B| alone without the part that is not linear in |B|.

    Raises
    ------
    MeasurementError
        If the instrument is no such one, see `check_total_field`.
    """
    check_total_field(instrument)
    same = np.repeat(data[TOTAL_COLUMN].values[:, None], 3, axis=1)  # one law for all three columns
    return np.asarray(remove_nonlinear_part(instrument, data.assign(
        B_T=data["B_T"].copy(data=same)))[:, 0])


def check_total_field(instrument: Instrument) -> None:
    """Raise a MeasurementError if an instrument has terms that no probe of |B| has.

    Its gain, offset, drift and nonlinearity are numbers, and its sensor is in one place.
    """
    for name in ("gain", "offset_T", "drift_T", "quadratic_per_T", "cubic_per_T2",
                 "sensor_position_m"):
        found = getattr(instrument, name)
        if len(set(found)) > 1:
            raise MeasurementError(must_be(
                f"`instrument.{name}`", "a map of |B|",
                "three equal entries, as |B| has one sensor", str(list(found)),
                "State the number of the probe three times."))
    for name in ("crosstalk", "planar_hall_per_T"):
        found = getattr(instrument, name)
        if any(found.values() if isinstance(found, dict) else found):
            raise MeasurementError(must_be(
                f"`instrument.{name}`", "a map of |B|", "left out, as |B| has no axes", str(found)))


def check_components(instrument: Instrument, missing: NDArray[np.bool_]) -> None:
    """Raise a MeasurementError if a planar Hall effect is to be corrected where not all components
    were measured; ``missing`` (n, 3) tells which were not.
    """
    for axis, name in enumerate(COMPONENTS):
        others = [j for j in range(3) if j != axis]
        if instrument.planar_hall_per_T[axis] and (
                ~missing[:, axis] & missing[:, others].any(axis=1)).any():
            raise MeasurementError(must_be(
                "components", "map", f"all three where B{name} was read, since the study states "
                "its planar Hall effect", "some missing", "Set instrument.planar_hall_per_T to 0."))


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

    The axes are point of the map, sensor, component of B, and direction. B has no sources and no
    curl where a probe is, so that its changes along x and y are those along z, too. Between sensors
    that are close together the field is taken for linear.
    """
    # Distance of the sensors from their mean up to which the field is linear between them: in a
    # gradient that changes by 1 T/m in 1 mm, the error is 0.05 mT.
    close_m = 3e-4
    count = len(sensors)
    middle = sensors.mean(axis=1)
    apart = bool(np.abs(sensors - middle[:, None]).max() > close_m)
    places = sensors.reshape(-1, 3) if apart else middle
    along = DIFFERENCE_M * np.eye(3)[:2]
    fields = field(np.concatenate([places, *(
        places + sign * step for step in along for sign in (1, -1))]))
    here, around = fields[:len(places)], fields[len(places):].reshape(2, 2, -1, 3)
    by_x, by_y = (around[:, 0] - around[:, 1]) / (2 * DIFFERENCE_M)
    gradient = np.stack([by_x, by_y, np.column_stack(
        [by_x[:, 2], by_y[:, 2], -by_x[:, 0] - by_y[:, 1]])], axis=-1)
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
        See `halbach_fe.measurement.probe_law.map_time`.
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
