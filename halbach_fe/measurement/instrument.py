"""What a mapper does to the field between magnet and map.

`halbach_fe.study.measurement.Instrument` says what each number means. Units and axes are put right
as the map is read. What is linear in B (where the sensors were, how they were turned, their gains
and crosstalk) belongs to the model of a reading; the rest (offset, drift, non-linearity) is taken
out of the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.measurement.field_map import POSITION_COLUMNS, check_magnitudes, points_of
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.types import COMPONENTS, Axes

ROUNDS = 50
CONVERGED_T = 1e-12


@dataclass(frozen=True)
class Probe:
    """Where a mapper's sensors were, and what they saw of B there.

    Attributes
    ----------
    points : ndarray, shape (n, 3) or (3 n, 3), in m
        Of the probe at each point of the map; with sensors apart, of each sensor, point by point.
    operator : sparse array, shape (3 n, 3 len(points))
        From B there, flattened point by point, to the linear part of the readings (Bx, By, Bz of
        each point of the map).
    """

    points: Floats
    operator: sparse.csr_array


def as_read(instrument: Instrument, data: xr.Dataset) -> xr.Dataset:
    """A map in m and T along the magnet's axes, as the study says that it is to be read.

    Raises
    ------
    MeasurementError
        If its numbers are still those of another unit.
    """
    points = along_axes(instrument.position_axes, points_of(data)) * instrument.length_unit_m
    unit = instrument.flux_density_unit_T
    field = along_axes(instrument.field_axes, data["B_T"].values) * unit
    read = data.assign_coords({name: data[name].copy(data=points[:, axis])
                               for axis, name in enumerate(POSITION_COLUMNS)})
    read = read.assign(B_T=data["B_T"].copy(data=field))
    if "sigma_T" in data:
        sigma = np.abs(along_axes(instrument.field_axes, data["sigma_T"].values)) * unit
        read = read.assign(sigma_T=data["sigma_T"].copy(data=sigma))
    check_magnitudes(read)
    return read


def along_axes(axes: Axes, columns: Floats) -> Floats:
    """Vectors (n, 3) along the magnet's axes, of which ``axes`` are those of the columns (n, 3)."""
    found = np.empty(columns.shape)
    for column, axis in enumerate(axes):
        sign = -1.0 if axis.startswith("-") else 1.0
        found[:, COMPONENTS.index(axis[-1])] = sign * columns[:, column]
    return found


def probe(instrument: Instrument, points: Floats) -> Probe:
    """The probe on a map's points (n, 3) in m."""
    count = len(points)
    positions = probe_positions(instrument, points)
    rows = sensor_matrix(instrument)
    if not np.ptp(positions, axis=1).any():
        return Probe(positions[:, 0], sparse.csr_array(sparse.kron(sparse.eye_array(count), rows)))
    apart = np.zeros((3, 9))  # each sensor reads at its own point
    for axis in range(3):
        apart[axis, 3 * axis:3 * axis + 3] = rows[axis]
    return Probe(positions.reshape(-1, 3),
                 sparse.csr_array(sparse.kron(sparse.eye_array(count), apart)))


def probe_positions(instrument: Instrument, points: Floats) -> Floats:
    """Where each sensor was, (n, 3, 3) in m: by point of the map, sensor, coordinate."""
    stretched = points * [1 + instrument.radius_scale, 1 + instrument.radius_scale,
                          1 + instrument.z_scale]
    if instrument.radius_offset_m:
        stretched += instrument.radius_offset_m * outward(points)
    if any(instrument.eccentricity_m):
        stretched += np.tensordot(instrument.eccentricity_m, run_out(points), 1)
    z = points[:, 2]
    if instrument.arm_sag_m and np.ptp(z) > 0:
        stretched[:, 1] -= instrument.arm_sag_m * ((z - z.min()) / np.ptp(z)) ** 2
    sensors = stretched[:, None] + np.array(instrument.sensor_position_m)
    return np.asarray(sensors @ rotation_matrix(instrument.rotation_rad).T
                      + instrument.translation_m)


def probe_points(instrument: Instrument, points: Floats) -> Floats:
    """Where the middle of the sensors was, (n, 3) in m, at points (n, 3) of a map."""
    return np.asarray(probe_positions(instrument, points).mean(axis=1))


def outward(points: Floats) -> Floats:
    """Unit vectors (n, 3) away from the axis at points (n, 3); along x on it."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(points))])


def run_out(points: Floats) -> Floats:
    """Displacements (2, n, 3) of points (n, 3) on circles per unit of eccentricity along x and y:
    farther out by the cosine or sine of the angle, which is right; none on the axis.
    """
    away = outward(points) * (np.hypot(points[:, 0], points[:, 1]) > 0)[:, None]
    return np.stack([away[:, [0]] * away, away[:, [1]] * away])


def sensor_matrix(instrument: Instrument) -> Floats:
    """From B in the magnet's axes to the linear part of what the three sensors show, (3, 3)."""
    matrix = np.diag(1 + np.array(instrument.gain))
    for name, value in instrument.crosstalk.items():
        matrix[COMPONENTS.index(name[0]), COMPONENTS.index(name[1])] = value
    return matrix @ rotation_matrix(instrument.rotation_rad).T


def remainder(instrument: Instrument, fields: Floats, time: Floats) -> Floats:
    """What sensors show beyond the linear part, (n, 3) in T, of B (n, 3) in T in their own axes;
    time (n,) runs from 0 to 1 over the map.
    """
    others = np.stack([fields[:, 1] * fields[:, 2], fields[:, 0] * fields[:, 2],
                       fields[:, 0] * fields[:, 1]], axis=1)
    return np.asarray(
        others * instrument.planar_hall_per_T + fields**2 * instrument.quadratic_per_T
        + fields**3 * instrument.cubic_per_T2 + instrument.offset_T
        + np.outer(time, instrument.drift_T))


def map_time(data: xr.Dataset) -> Floats:
    """When each reading of a map was taken, (n,), from 0 to 1."""
    count = data.sizes["point"]
    time = (data["time_s"].values if "time_s" in data else np.arange(count)).astype(float)
    return np.asarray((time - time.min()) / (np.ptp(time) or 1.0))


def without_remainder(instrument: Instrument, data: xr.Dataset) -> Floats:
    """A map's readings (n, 3) in T, NaN where there are none, without what is not linear in B.

    Raises
    ------
    MeasurementError
        If a sensor needs a component that the map does not hold, or the law has no inverse.
    """
    shown = np.asarray(data["B_T"].values, float)
    missing = np.isnan(shown)
    _check_components(instrument, missing)
    time = map_time(data)
    linear = instrument.with_(rotation_rad=(0.0, 0.0, 0.0))
    matrix, field = sensor_matrix(linear), np.nan_to_num(shown)
    for _ in range(ROUNDS):
        rest = remainder(instrument, field, time)
        wrong = np.where(missing, 0.0, np.nan_to_num(shown) - field @ matrix.T - rest)
        field = field + wrong  # the law is nearly the identity
        if not np.abs(wrong).max() > CONVERGED_T:
            return shown - rest
    raise MeasurementError(must_be(
        "`instrument`", "study", "a law of the sensors that can be undone",
        "one that does not converge", "Make its terms smaller."))


def _check_components(instrument: Instrument, missing: NDArray[np.bool_]) -> None:
    """The planar Hall effect in a component that was read needs the other two."""
    for axis, name in enumerate(COMPONENTS):
        others = [j for j in range(3) if j != axis]
        if instrument.planar_hall_per_T[axis] and (
                ~missing[:, axis] & missing[:, others].any(axis=1)).any():
            raise MeasurementError(must_be(
                "components", "map", f"all three where B{name} was read, whose planar Hall effect "
                "the study gives", "some missing", "Set instrument.planar_hall_per_T to 0."))
