"""The search of a map's pose in a magnet among all rotations by right angles, from nothing.

A pose is where the middle of the map lies, in m, and a rotation vector, which turns it about that
middle from the axes of the map to those of the magnet.

The field is that of the nominal blocks and of neighbouring magnets, in vacuum: their places are
those beside this magnet, in whatever pose the map is.

For a line of readings along the magnet, the field is computed once along many lines parallel to the
magnet's axis. The readings are compared with all of them, in both directions and at all shifts
along the axis. What looks most alike is improved by least squares, in which the step of the
readings is free too: their positions may have been read in a wrong scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, Ints, box_middle, spread
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.progress import Pace
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.field_map import UNDIRECTED_COLUMN
from halbach_fe.measurement.map_check import WORTH_TRYING
from halbach_fe.measurement.probe_law import DIFFERENCE_M
from halbach_fe.solver.exact_block_field import neighbour_field
from halbach_fe.solver.separate_blocks import field_in_vacuum

SAME_M, SAME_RAD = 1e-3, 0.02
"""Candidates that differ by less are one: in m, and in rad."""

LONGEST_M, LONGEST_RAD = 5e-3, 0.05
"""Longest step of a fit, along a direction and about it."""

Field = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns B (n, 3) in T."""


@dataclass(frozen=True)
class Shown:
    """A field, and how a map shows it: by components, or as |B| in place of Bx."""

    field: Field
    total: bool = False

    def __call__(self, places: Floats) -> Floats:
        """Return B (n, 3) in T at places (n, 3) in m."""
        return self.field(places)

    def along(self, field: Floats, matrix: Floats) -> Floats:
        """Return what a map shows of B (..., n, 3), turned by a matrix from its axes."""
        if not self.total:
            return np.asarray(field @ matrix)
        size = np.zeros(field.shape)
        size[..., 0] = np.linalg.norm(field, axis=-1)
        return size


def right_angles() -> list[Floats]:
    """Return the 24 rotation matrices that bring axes to axes."""
    found = [np.eye(3)[list(order)] * np.array(signs)[:, None] for order in permutations(range(3))
             for signs in product((1.0, -1.0), repeat=3)]
    proper = [matrix for matrix in found if np.linalg.det(matrix) > 0]
    return sorted(proper, key=lambda matrix: -float(np.trace(matrix)))


def misfit_of(
    field: Floats, readings: Floats, training: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the rms in T of readings less a field times the best positive factor, and it."""
    seen = np.where(training, field, 0.0)
    power = float(np.sum(seen**2))
    factor = max(0.0, float(np.sum(seen * readings)) / power) if power else 0.0
    return float(np.sqrt(np.sum((readings - factor * seen)**2) / training.sum())), factor


def same_pose(first: Floats, second: Floats) -> bool:
    """Tell whether two poses put the middle of the map in the same place and turn it alike."""
    one, other = (Rotation.from_rotvec(pose[3:]) for pose in (first, second))
    return bool(np.linalg.norm(first[:3] - second[:3]) < SAME_M
                and (one * other.inv()).magnitude() < SAME_RAD)


def share_of(step: Floats) -> float:
    """Return the part of a step (6 or more,) of a pose that is not too long."""
    longest = max(np.abs(step[:3]).max() / LONGEST_M, np.abs(step[3:6]).max() / LONGEST_RAD)
    return float(1 / max(1.0, longest))


def moved_by(pose: Floats, step: Floats) -> Floats:
    """Return a pose (6,) after a shift in m and a turn in rad about the magnet's axes, (6,)."""
    turned = Rotation.from_rotvec(step[3:]) * Rotation.from_rotvec(pose[3:])
    return np.concatenate([pose[:3] + step[:3], turned.as_rotvec()])


COARSE_POINTS, MIDDLE_POINTS = 60, 150
"""Numbers of points of the map that are used to search, and to improve candidates."""

STEP = 0.4
"""Step of the translations along the axis, in units of the bore's radius."""

CANDIDATES = 2
"""Largest number of candidates of every rotation that are improved."""

UNEXPLAINED = 0.5
"""Share of the field, in rms, that the nominal blocks may leave in the best pose."""

SUSPICIOUS, MIRRORED = 0.03, 2.0
"""Share of the field, in rms, from which the mirror image of the magnet is tried, and factor by
which its best pose must be better for the map to be that of the mirror image. Errors of blocks
leave 0.01 of the field."""

MIRROR = np.array([1.0, 1.0, -1.0])
"""Factors of the coordinates of a mirror image. A magnetic field is an axial vector: those of its
components are the opposite."""

NARROW = 0.02
"""Width up to which a map lies on a line, in units of the bore's radius."""

ITERATIONS = 12
"""Largest number of steps of the improvement of a candidate."""


def coarse_poses(
    magnet: Magnet, points: Floats, readings: Floats, training: NDArray[np.bool_],
    across_m: float = np.inf, pace: Pace | None = None, total: bool = False,
) -> list[Floats]:
    """Return poses (6,), the best first: where the map's middle lies in m, and a rotation vector.

    The middle is that of `box_middle`, so that a turn does not move the map.

    Parameters
    ----------
    points, readings : ndarray, shape (n, 3)
        In m and T; NaN for components that were not measured.
    training : ndarray of bool, shape (n, 3)
        The readings that may be used.
    across_m : float, optional
        Prior standard deviation of the middle's distance from the axis along x and y.
    pace : Pace, optional
        Reports how many places and candidates are left, and the time.
    total : bool
        Whether the map is of |B|, which then stands in place of Bx.
    """
    # The same of a map on a line, and of one of |B|, which is the same in twice as many poses. On a
    # line a component that is even in x, y and z, as in an ideal dipole, is the same on four lines
    # in two directions.
    most_of_a_line = 8
    most_poses = 4  # largest number of poses that are fitted with the magnet's own model
    # Candidates are kept whose rms residual is below this multiple of the smallest.
    nearly_as_good = 1.5
    rows = np.flatnonzero(training.any(axis=1))
    used = np.where(training, readings, 0.0)
    if not len(rows) or not used.any():
        raise MeasurementError(must_be("map", "registration", "of some field", "zero everywhere"))
    points = points - box_middle(points)
    line = line_of(points[rows], NARROW * magnet.bore_radius)
    pace = pace or Pace(lambda _: None)
    own = field_in_vacuum(magnet.blocks)
    # of other sources trial poses may put points into windings, where there is no field to compare
    vacuum = Shown(lambda places: own(places) + sum(
        neighbour_field(magnet, one, places) for one in magnet.external.neighbours), total)
    improved = _searched(magnet, vacuum, points, used, training, pace, line, across_m)
    best = improved[0][0]
    size = float(np.sqrt(np.sum(used[rows]**2) / training.sum()))
    if line is None and best > SUSPICIOUS * size:  # a line is its own mirror image
        mirrored = _searched(magnet, vacuum, points * MIRROR, used if total else -used * MIRROR,
                             training, pace)[0][0]
        if mirrored < best / MIRRORED:
            raise MeasurementError(must_be(
                "map", "registration", "that of the study's magnet",
                f"that of its mirror image, of which some pose leaves {mirrored / size:.1%} of the "
                f"field unexplained, and of the magnet at least {best / size:.1%}",
                "A position axis of the map counts backwards, or the study's angles do."))
    if best > UNEXPLAINED * size:
        raise MeasurementError(must_be(
            "map", "registration", "one that some pose of the magnet explains",
            f"{best / size:.0%} of its field unexplained in the best one",
            _after_no_pose(int(training.any(axis=0).sum()), total)))
    most = most_poses if line is None and not total else most_of_a_line
    return [pose for misfit, pose in improved if misfit <= nearly_as_good * best][:most]


def _after_no_pose(components: int, total: bool) -> str:
    """Say what to do with a map of so many components, or of |B|, that no pose explains."""
    if total:
        return ("Look at the places in the file and their unit; if they are right, it is the map "
                "of another magnet.")
    if components > 1:
        return ("Check the axes and signs of its columns with halbach-fe check; if they pass, it "
                "is the map of another magnet.")
    return (f"Name its column {UNDIRECTED_COLUMN}, and register finds which component it is; if "
            "that does not help, it is the map of another magnet.")


def _searched(
    magnet: Magnet, vacuum: Shown, points: Floats, used: Floats, training: NDArray[np.bool_],
    pace: Pace,
    line: Floats | None = None, across_m: float = np.inf,
) -> list[tuple[float, Floats]]:
    """Return the rms residuals in T of poses, and these, the best first.

    Points (n, 3) in m are about their middle; ``used`` (n, 3) are the readings, 0 where they may
    not be used; ``line`` (3,) is the direction of the line on which they lie, if they do.
    """
    improved = [] if line is None else poses_along(
        magnet, vacuum, points, used, training, line, across_m, pace)
    rotations = [matrix for matrix in right_angles()
                 if line is None or not along_the_axis(matrix, line)]
    scores = _scores(magnet, vacuum, points, used, training, rotations, pace)
    improved += _all_improved(magnet, vacuum, points, used, training, _worth_trying(
        scores, improved[0][0] if improved else np.inf), pace)
    if not improved:
        raise MeasurementError(must_be(
            "map", "registration", "one that fits into the bore, or beside the magnet",
            f"points over {', '.join(f'{1e3 * size:.0f}' for size in np.ptp(points, axis=0))} mm, "
            "which lie inside blocks in every likely pose",
            "Check its unit of length, and the study's radii."))
    return sorted(improved, key=lambda each: each[0])


def _chosen(training: NDArray[np.bool_], count: int) -> Ints:
    """Return at most so many rows throughout the scan that have readings."""
    return spread(np.flatnonzero(training.any(axis=1)), count)


def _scores(
    magnet: Magnet, vacuum: Shown, points: Floats, used: Floats, training: NDArray[np.bool_],
    rotations: Sequence[Floats], pace: Pace,
) -> list[tuple[float, Floats, Floats]]:
    """Return misfits in T of places (3,) on the axis in m, and of rotations, the best first."""
    rows, few = np.flatnonzero(training.any(axis=1)), _chosen(training, COARSE_POINTS)
    axis = np.array([*magnet.middle_m[:2], 0.0])
    reach = magnet.half_length + float(np.linalg.norm(np.ptp(points[rows], axis=0)))
    steps = max(3, int(np.ceil(2 * reach / (STEP * magnet.bore_radius))))
    scores = []
    pace.begin("search of the pose, rotations by right angles compared")
    for number, matrix in enumerate(rotations):
        pace.advance(number, len(rotations))
        turned = points[few] @ matrix.T
        shifts = np.linspace(-reach, reach, steps)[:, None] * [0, 0, 1] + axis
        places = turned[None] + shifts[:, None]
        inside = magnet.contains(places.reshape(-1, 3)).reshape(len(shifts), -1).any(axis=1)
        shifts, places = shifts[~inside], places[~inside]
        if not len(shifts):
            continue
        fields = vacuum(places.reshape(-1, 3)).reshape(len(shifts), -1, 3)
        fields = vacuum.along(fields, matrix)
        scores += [(misfit_of(field, used[few], training[few])[0], shift, matrix)
                   for shift, field in zip(shifts, fields, strict=True)]
    return sorted(scores, key=lambda each: each[0])


def _worth_trying(
    scores: Sequence[tuple[float, Floats, Floats]], known: float
) -> list[tuple[Floats, Floats]]:
    """Return places and rotations that are improved, of scores with the best first.

    ``known`` is the misfit in T of the best pose that is known already.
    """
    tried: dict[bytes, int] = {}
    found = []
    for rough, place, matrix in scores:
        key = matrix.tobytes()
        tried[key] = tried.get(key, 0) + 1
        if rough <= WORTH_TRYING * min(scores[0][0], known) and tried[key] <= CANDIDATES:
            found.append((place, matrix))
    return found


def _all_improved(
    magnet: Magnet, vacuum: Shown, points: Floats, used: Floats, training: NDArray[np.bool_],
    worth: Sequence[tuple[Floats, Floats]], pace: Pace,
) -> list[tuple[float, Floats]]:
    """Return misfits in T and different poses (6,) to which least squares leads from some."""
    more = _chosen(training, MIDDLE_POINTS)
    improved: list[tuple[float, Floats]] = []
    pace.begin("search of the pose, candidates improved")
    for number, (place, matrix) in enumerate(worth):
        pace.advance(number, len(worth))
        pose = np.concatenate([place, Rotation.from_matrix(matrix).as_rotvec()])
        misfit, pose = _improved(magnet, vacuum, pose, points[more], used[more], training[more])
        if misfit is not None and not any(same_pose(pose, other) for _, other in improved):
            improved.append((misfit, pose))
    return improved


def _improved(
    magnet: Magnet, vacuum: Shown, pose: Floats, points: Floats, readings: Floats,
    training: NDArray[np.bool_]
) -> tuple[float | None, Floats]:
    """Return the rms and the pose (6,) of a fit to nominal blocks in vacuum; None in no air."""
    def fields(poses: Sequence[Floats]) -> list[Floats]:
        """Return the field (n, 3) along the map's axes at every pose, computed together."""
        turns = [Rotation.from_rotvec(each[3:]).as_matrix() for each in poses]
        places = [points @ matrix.T + each[:3] for matrix, each in zip(turns, poses, strict=True)]
        return [vacuum.along(field, matrix) for field, matrix in zip(
            np.split(vacuum(np.concatenate(places)), len(poses)), turns, strict=True)]

    (field,) = fields([pose])
    misfit, factor = misfit_of(field, readings, training)
    sizes = np.repeat([DIFFERENCE_M, DIFFERENCE_M / magnet.bore_radius], 3)
    for _ in range(ITERATIONS):
        around = fields([moved_by(pose, step) for step in np.diag(sizes)])
        columns = [factor * (each - field) / size for each, size in zip(around, sizes, strict=True)]
        design = np.stack([*columns, field], axis=-1)[training]
        step = np.linalg.lstsq(design, (readings - factor * field)[training], rcond=None)[0][:6]
        step *= share_of(step)
        for _ in range(4):
            other = moved_by(pose, step)
            (tried,) = fields([other])
            score = misfit_of(tried, readings, training)
            if score[0] < misfit:
                break
            step = step / 2
        else:
            break
        ended = score[0] > 0.999 * misfit
        pose, field, (misfit, factor) = other, tried, score
        if ended:
            break
    turn = Rotation.from_rotvec(pose[3:])
    inside = magnet.contains(turn.apply(points) + pose[:3])
    return (None if inside.any() else misfit), pose


RADII, ANGLES = (0.0, 0.35, 0.7), 8
"""Distances of the lines from the axis, in units of the bore's radius, and angles beside it. The
field changes little over a third of the bore, but on the axis it has no gradient across: from there
least squares would not find the way."""

STEP_OF_A_LINE = 0.2
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
        misfit, pose = _improved_line(magnet, vacuum, place, matrix, points, used, seen, across_m)
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
        step = STEP_OF_A_LINE * magnet.bore_radius
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
    return np.asarray(starts[allowed] + magnet.middle_m[:2])


def _improved_line(
    magnet: Magnet, vacuum: Shown, place: Floats, matrix: Floats, points: Floats, used: Floats,
    seen: NDArray[np.bool_], across_m: float,
) -> tuple[float | None, Floats]:
    """Return misfit and pose (6,) after least squares over place and scale; None in no air."""
    stretch_sd = 0.05  # prior standard deviation of the scale of the positions
    size = float(np.sqrt(np.sum(used**2) / seen.sum()))
    scales = np.array([magnet.bore_radius] * 3 + [1.0])
    axis = np.array([*magnet.middle_m[:2], 0.0])

    def places(parameters: Floats) -> Floats:
        return points @ matrix.T * (1 + parameters[3]) + parameters[:3] + axis

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

    start = np.append(place - axis, 0.0) / scales
    bound = 0.97 * magnet.bore_radius / np.sqrt(2) / scales[0]
    low = np.array([-bound, -bound, -np.inf, -4 * stretch_sd])
    found = least_squares(residual, start, derivative, bounds=(low, -low), max_nfev=MOST_STEPS)
    parameters = found.x * scales
    pose = np.concatenate([
        parameters[:3] + axis, Rotation.from_matrix(matrix).as_rotvec()])
    if magnet.contains(places(parameters)).any():
        return None, pose
    return misfit_of(
        vacuum.along(vacuum(places(parameters)), matrix), used, seen)[0], pose
