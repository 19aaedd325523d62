"""The search of a map's pose in a magnet among all rotations by right angles, from nothing.

A pose is where the middle of the map lies, in m, and a rotation vector, which turns it about that
middle from the axes of the map to those of the magnet.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, Ints, box_middle, spread
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.pace import Pace
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.line_search import along_the_axis, line_of, poses_along
from halbach_fe.inference.pose_space import (
    Shown,
    misfit_of,
    moved_by,
    right_angles,
    same_pose,
    share_of,
)
from halbach_fe.measurement.field_map import UNDIRECTED_COLUMN
from halbach_fe.solver.separate_blocks import field_in_vacuum

COARSE_POINTS, MIDDLE_POINTS = 60, 150
"""Numbers of points of the map that are used to search, and to improve candidates."""

STEP = 0.4
"""Step of the translations along the axis, in units of the bore's radius."""

CANDIDATES, WORTH_TRYING = 2, 3.0
"""Largest number of candidates of every rotation that are improved, and multiple of the smallest
rms residual up to which they are."""

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

DIFFERENCE_M = 2e-4
"""Step of finite differences."""


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
    vacuum = Shown(field_in_vacuum(magnet.blocks), total)
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
) -> list[tuple[float, float, Floats]]:
    """Return misfits in T of places on the axis in m, and of rotations, the best first."""
    rows, few = np.flatnonzero(training.any(axis=1)), _chosen(training, COARSE_POINTS)
    reach = magnet.half_length + float(np.linalg.norm(np.ptp(points[rows], axis=0)))
    steps = max(3, int(np.ceil(2 * reach / (STEP * magnet.bore_radius))))
    scores = []
    pace.begin("search of the pose, rotations by right angles compared")
    for number, matrix in enumerate(rotations):
        pace.advance(number, len(rotations))
        turned = points[few] @ matrix.T
        shifts = np.linspace(-reach, reach, steps)
        places = turned[None] + np.outer(shifts, [0, 0, 1])[:, None]
        inside = magnet.contains(places.reshape(-1, 3)).reshape(len(shifts), -1).any(axis=1)
        shifts, places = shifts[~inside], places[~inside]
        if not len(shifts):
            continue
        fields = vacuum(places.reshape(-1, 3)).reshape(len(shifts), -1, 3)
        fields = vacuum.along(fields, matrix)
        scores += [(misfit_of(field, used[few], training[few])[0], shift, matrix)
                   for shift, field in zip(shifts.tolist(), fields, strict=True)]
    return sorted(scores, key=lambda each: each[0])


def _worth_trying(
    scores: Sequence[tuple[float, float, Floats]], known: float
) -> list[tuple[float, Floats]]:
    """Return places and rotations that are improved, of scores with the best first.

    ``known`` is the misfit in T of the best pose that is known already.
    """
    tried: dict[bytes, int] = {}
    found = []
    for rough, shift, matrix in scores:
        key = matrix.tobytes()
        tried[key] = tried.get(key, 0) + 1
        if rough <= WORTH_TRYING * min(scores[0][0], known) and tried[key] <= CANDIDATES:
            found.append((shift, matrix))
    return found


def _all_improved(
    magnet: Magnet, vacuum: Shown, points: Floats, used: Floats, training: NDArray[np.bool_],
    worth: Sequence[tuple[float, Floats]], pace: Pace,
) -> list[tuple[float, Floats]]:
    """Return misfits in T and different poses (6,) to which least squares leads from some."""
    more = _chosen(training, MIDDLE_POINTS)
    improved: list[tuple[float, Floats]] = []
    pace.begin("search of the pose, candidates improved")
    for number, (shift, matrix) in enumerate(worth):
        pace.advance(number, len(worth))
        pose = np.concatenate([[0.0, 0.0, shift], Rotation.from_matrix(matrix).as_rotvec()])
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
