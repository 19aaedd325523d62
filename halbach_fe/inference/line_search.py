"""The search of a line of readings along a magnet, on its axis or beside it, from nothing.

The field of the nominal blocks is computed once along many lines parallel to the magnet's axis. The
readings are compared with all of them, in both directions and at all shifts along the axis. What
looks most alike is improved by least squares, in which the step of the readings is free too: their
positions may have been read in a wrong scale.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, spread
from halbach_fe.core.pace import Pace
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.pose_space import Shown, misfit_of, right_angles, same_pose

RADII, ANGLES = (0.0, 0.35, 0.7), 8
"""Distances of the lines from the axis, in units of the bore's radius, and angles beside it. The
field changes little over a third of the bore, but on the axis it has no gradient across: from there
least squares would not find the way."""

STEP = 0.2
"""Distance of the points of the table, and step of the shifts, in units of the bore's radius."""

MOST_STEPS, DIFFERENCE = 8, 1e-4
"""Largest number of steps of the improvement, and step of its finite differences in units of the
bore's radius, and of the scale."""


def line_of(points: Floats, width_m: float) -> Floats | None:
    """Return the direction (3,) of a line on which points (n, 3) lie, or None if they do not.

    ``width_m`` is the largest distance between points across the line that is allowed.
    """
    if len(points) < 3:
        return None
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    along, *across = (centred @ axes.T).T
    if np.ptp(along) == 0 or any(np.ptp(each) > width_m for each in across):
        return None
    return np.asarray(axes[0])


def along_the_axis(matrix: Floats, direction: Floats) -> bool:
    """Tell whether a rotation turns a direction (3,) rather along the magnet's axis than across."""
    return abs(float((matrix @ direction)[2])) > np.sqrt(0.5)


def poses_along(
    magnet: Magnet, vacuum: Shown, points: Floats, readings: Floats, training: NDArray[np.bool_],
    direction: Floats, across_m: float, pace: Pace,
) -> list[tuple[float, Floats]]:
    """Return poses (6,) of a line along the magnet with their misfits in T, the best first.

    Parameters
    ----------
    points, readings : ndarray, shape (n, 3)
        In m and T; the middle of the points is at the origin.
    training : ndarray of bool, shape (n, 3)
        The readings that may be used.
    direction : ndarray, shape (3,)
        Of the line, in the map's coordinates.
    across_m : float
        Prior standard deviation of the line's distance from the axis along x and y.
    """
    most_starts = 12  # largest number of candidates that are improved
    most_readings = 40  # number of readings that are used
    rows = spread(np.flatnonzero(training.any(axis=1)), most_readings)
    points, used, seen = points[rows], np.where(training, readings, 0.0)[rows], training[rows]
    starts = _transverse_starts(magnet, across_m)
    table = _Table.of(magnet, vacuum, starts, float(np.ptp(points @ direction)))
    candidates = []
    for matrix in right_angles():
        turned = points @ matrix.T
        if not along_the_axis(matrix, direction):
            continue
        for line, start in enumerate(starts):
            for shift in table.shifts:
                field = table.field(line, turned[:, 2] + shift)
                if field is not None:
                    candidates.append((misfit_of(vacuum.along(field, matrix), used, seen)[0],
                                       np.append(start, shift), matrix))
    candidates.sort(key=lambda each: each[0])
    chosen: list[tuple[Floats, Floats]] = []
    for _, place, matrix in candidates:
        # the best shift of every line in every direction
        if not any(np.array_equal(matrix, other) and np.array_equal(place[:2], known[:2])
                   for known, other in chosen):
            chosen.append((place, matrix))
        if len(chosen) == most_starts:
            break
    found: list[tuple[float, Floats]] = []
    pace.begin("search of the line, candidates improved")
    for number, (place, matrix) in enumerate(chosen):
        pace.advance(number, len(chosen))
        misfit, pose = _improved(magnet, vacuum, place, matrix, points, used, seen, across_m)
        if misfit is not None and not any(same_pose(pose, other) for _, other in found):
            found.append((misfit, pose))
    return sorted(found, key=lambda each: each[0])


class _Table:
    """The field (lines, n, 3) in T along lines parallel to the magnet's axis."""

    def __init__(self, z: Floats, fields: Floats, free: NDArray[np.bool_], shifts: Floats) -> None:
        self._z, self._fields, self._free, self.shifts = z, fields, free, shifts

    @classmethod
    def of(cls, magnet: Magnet, vacuum: Shown, starts: Floats, length: float) -> _Table:
        reach = magnet.half_length + length
        step = STEP * magnet.bore_radius
        shifts = step * np.arange(-np.ceil(reach / step), np.ceil(reach / step) + 1)
        z = step * np.arange(np.floor(shifts[0] / step - length / step),
                             np.ceil(shifts[-1] / step + length / step) + 1)
        # far from the magnet there is no field to speak of
        z = z[np.abs(z) <= reach + step]
        places = np.concatenate([np.column_stack([np.tile(start, (len(z), 1)), z])
                                 for start in starts])
        free = ~magnet.contains(places)
        fields = np.zeros((len(places), 3))
        fields[free] = vacuum(places[free])
        return cls(z, fields.reshape(len(starts), len(z), 3), free.reshape(len(starts), -1), shifts)

    def field(self, line: int, z: Floats) -> Floats | None:
        """Return B (n, 3) on a line; None if a reading would be in a block, or all far away."""
        if np.abs(z).min() > self._z[-1]:
            return None
        place = (z - self._z[0]) / (self._z[1] - self._z[0])
        inside = (place >= 0) & (place <= len(self._z) - 1)
        low = np.clip(place.astype(int), 0, len(self._z) - 2)
        if not (self._free[line, low] & self._free[line, low + 1]).all():
            return None
        part = np.where(inside, place - low, 0.0)[:, None]
        field = (1 - part) * self._fields[line, low] + part * self._fields[line, low + 1]
        return np.where(inside[:, None], field, 0.0)


def _transverse_starts(magnet: Magnet, across_m: float) -> Floats:
    """Return places (k, 2) in m across the bore, those that the prior allows."""
    angles = 2 * np.pi * (np.arange(ANGLES) + 0.5) / ANGLES
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    starts = np.concatenate([radius * magnet.bore_radius * (ring if radius else ring[:1])
                             for radius in RADII])
    allowed = np.hypot(*starts.T) <= 3 * across_m
    return np.asarray(starts[allowed])


def _improved(
    magnet: Magnet, vacuum: Shown, place: Floats, matrix: Floats, points: Floats, used: Floats,
    seen: NDArray[np.bool_], across_m: float,
) -> tuple[float | None, Floats]:
    """Return misfit and pose (6,) after least squares over place and scale; None in no air."""
    stretch_sd = 0.05  # prior standard deviation of the scale of the positions
    size = float(np.sqrt(np.sum(used**2) / seen.sum()))
    scales = np.array([magnet.bore_radius] * 3 + [1.0])

    def places(parameters: Floats) -> Floats:
        return points @ matrix.T * (1 + parameters[3]) + parameters[:3]

    known: dict[bytes, Floats] = {}

    def residual(scaled: Floats) -> Floats:
        parameters, key = scaled * scales, scaled.tobytes()
        if key not in known:
            known[key] = vacuum(places(parameters))
        field = vacuum.along(known[key], matrix)
        _, factor = misfit_of(field, used, seen)
        left = (used - factor * field)[seen] / size
        weight = 0.01 * np.sqrt(seen.sum())  # one sd of the prior is as bad as 1 % of the field
        return np.concatenate([left, weight * np.append(parameters[:2] / across_m,
                                                        parameters[3] / stretch_sd)])

    def derivative(scaled: Floats) -> Floats:
        """Return the derivatives (n, 4), with the field at all places computed at once."""
        steps = DIFFERENCE * np.eye(4)
        changed = [(scaled + step) * scales for step in steps] + [scaled * scales]
        *around, here = np.split(vacuum(np.concatenate([places(each) for each in changed])), 5)
        known[scaled.tobytes()] = here
        now = residual(scaled)
        for step, field in zip(steps, around, strict=True):
            known[(scaled + step).tobytes()] = field
        return np.column_stack([(residual(scaled + step) - now) / DIFFERENCE for step in steps])

    start = np.append(place, 0.0) / scales
    bound = 0.97 * magnet.bore_radius / np.sqrt(2) / scales[0]
    low = np.array([-bound, -bound, -np.inf, -4 * stretch_sd])
    found = least_squares(residual, start, derivative, bounds=(low, -low), max_nfev=MOST_STEPS)
    parameters = found.x * scales
    pose = np.concatenate([parameters[:3], Rotation.from_matrix(matrix).as_rotvec()])
    if magnet.contains(places(parameters)).any():
        return None, pose
    return misfit_of(
        vacuum.along(vacuum(places(parameters)), matrix), used, seen)[0], pose

