"""The search of a map's pose in a magnet among all rotations by right angles, from nothing.

A pose is where the middle of the map lies, in m, and a rotation vector, which turns it about that
middle from the axes of the map to those of the magnet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.campaign import middle_of
from halbach_fe.solver.separate_blocks import field_in_vacuum

COARSE_POINTS, MIDDLE_POINTS = 60, 150
"""Numbers of points of the map that are used to search, and to improve candidates."""

STEP = 0.4
"""Step of the translations along the axis, in units of the bore's radius."""

CANDIDATES, WORTH_TRYING = 2, 3.0
"""Largest number of candidates of every rotation that are improved, and multiple of the smallest
rms residual up to which they are."""

NEARLY_AS_GOOD = 1.5
"""Candidates are kept whose rms residual is below this multiple of the smallest."""

UNEXPLAINED = 0.5
"""Share of the field, in rms, that the nominal blocks may leave in the best pose."""

SUSPICIOUS, MIRRORED = 0.03, 2.0
"""Share of the field, in rms, from which the mirror image of the magnet is tried, and factor by
which its best pose must be better for the map to be that of the mirror image. Errors of blocks
leave 0.01 of the field."""

MIRROR = np.array([1.0, 1.0, -1.0])
"""Factors of the coordinates of a mirror image. A magnetic field is an axial vector: those of its
components are the opposite."""

SAME_M, SAME_RAD = 1e-3, 0.02
"""Candidates that differ by less are one: in m, and in rad."""

MOST_POSES = 4
"""Largest number of poses that are fitted with the magnet's own model."""

LONGEST_M, LONGEST_RAD = 5e-3, 0.05
"""Longest step of a fit, along a direction and about it."""

ITERATIONS = 12
"""Largest number of steps of the improvement of a candidate."""

DIFFERENCE_M = 2e-4
"""Step of finite differences."""

Field = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns B (n, 3) in T."""


def right_angles() -> list[Floats]:
    """Return the 24 rotation matrices that bring axes to axes."""
    found = [np.eye(3)[list(order)] * np.array(signs)[:, None] for order in permutations(range(3))
             for signs in product((1.0, -1.0), repeat=3)]
    proper = [matrix for matrix in found if np.linalg.det(matrix) > 0]
    return sorted(proper, key=lambda matrix: -float(np.trace(matrix)))


def coarse_poses(
    magnet: Magnet, points: Floats, readings: Floats, training: NDArray[np.bool_]
) -> list[Floats]:
    """Return poses (6,), the best first: where the map's middle lies in m, and a rotation vector.

    The middle is that of `middle_of`, so that a turn does not move the map.

    Parameters
    ----------
    magnet : Magnet
    points, readings : ndarray, shape (n, 3)
        In m and T; NaN for components that were not measured.
    training : ndarray of bool, shape (n, 3)
        The readings that may be used.
    """
    rows = np.flatnonzero(training.any(axis=1))
    used = np.where(training, readings, 0.0)
    if not len(rows) or not used.any():
        raise MeasurementError(must_be("map", "registration", "of some field", "zero everywhere"))
    points = points - middle_of(points)
    improved = _searched(magnet, points, used, training, rows)
    best = improved[0][0]
    size = float(np.sqrt(np.sum(used[rows]**2) / training.sum()))
    if best > SUSPICIOUS * size:
        mirrored = _searched(magnet, points * MIRROR, -used * MIRROR, training, rows)[0][0]
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
            "Check the axes and signs of its columns with halbach-fe check."))
    return [pose for misfit, pose in improved if misfit <= NEARLY_AS_GOOD * best][:MOST_POSES]


def _searched(
    magnet: Magnet, points: Floats, used: Floats, training: NDArray[np.bool_], rows: Ints
) -> list[tuple[float, Floats]]:
    """Return the rms residuals in T of poses, and these, the best first.

    Points (n, 3) in m are about their middle; ``rows`` are those with readings that may be used,
    and ``used`` (n, 3) the readings, 0 where they may not.
    """
    few, more = (rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int)]
                 for count in (COARSE_POINTS, MIDDLE_POINTS))
    reach = magnet.half_length + float(np.linalg.norm(np.ptp(points[rows], axis=0)))
    steps = max(3, int(np.ceil(2 * reach / (STEP * magnet.bore_radius))))
    shifts = np.linspace(-reach, reach, steps)
    scores, vacuum = [], field_in_vacuum(magnet.blocks)
    for matrix in right_angles():
        turned = points[few] @ matrix.T
        places = (turned[None] + np.outer(shifts, [0, 0, 1])[:, None]).reshape(-1, 3)
        inside = np.any(magnet.contains(places).reshape(len(shifts), -1), axis=1).tolist()
        fields = vacuum(places).reshape(len(shifts), -1, 3) @ matrix
        for shift, field, hit in zip(shifts, fields, inside, strict=True):
            if not hit:
                scores.append((_misfit(field, used[few], training[few])[0], shift, matrix))
    if not scores:
        raise MeasurementError(must_be(
            "map", "registration", "one that fits into the bore, or beside the magnet",
            f"points over {', '.join(f'{1e3 * size:.0f}' for size in np.ptp(points, axis=0))} mm",
            "Check its unit of length, and the study's radii."))
    scores.sort(key=lambda each: each[0])
    improved: list[tuple[float, Floats]] = []
    tried: dict[bytes, int] = {}
    for rough, shift, matrix in scores:
        key = matrix.tobytes()
        tried[key] = tried.get(key, 0) + 1
        if rough > WORTH_TRYING * scores[0][0] or tried[key] > CANDIDATES:
            continue
        pose = np.concatenate([[0.0, 0.0, shift], Rotation.from_matrix(matrix).as_rotvec()])
        misfit, pose = _improved(magnet, vacuum, pose, points[more], used[more], training[more])
        if misfit is not None and not any(_same(pose, other) for _, other in improved):
            improved.append((misfit, pose))
    if not improved:
        raise MeasurementError(must_be("map", "registration", "one that fits into the bore",
                                       "points inside blocks in every likely pose"))
    return sorted(improved, key=lambda each: each[0])


def _misfit(
    field: Floats, readings: Floats, training: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the rms in T of readings less a field times the best positive factor, and it."""
    seen = np.where(training, field, 0.0)
    power = float(np.sum(seen**2))
    factor = max(0.0, float(np.sum(seen * readings)) / power) if power else 0.0
    return float(np.sqrt(np.sum((readings - factor * seen)**2) / training.sum())), factor


def _improved(
    magnet: Magnet, vacuum: Field, pose: Floats, points: Floats, readings: Floats,
    training: NDArray[np.bool_]
) -> tuple[float | None, Floats]:
    """Return the rms and the pose (6,) of a fit to nominal blocks in vacuum; None in no air."""
    def fields(poses: Sequence[Floats]) -> list[Floats]:
        """Return the field (n, 3) along the map's axes at every pose, computed together."""
        turns = [Rotation.from_rotvec(each[3:]).as_matrix() for each in poses]
        places = [points @ matrix.T + each[:3] for matrix, each in zip(turns, poses, strict=True)]
        return [field @ matrix for field, matrix in zip(
            np.split(vacuum(np.concatenate(places)), len(poses)), turns, strict=True)]

    (field,) = fields([pose])
    misfit, factor = _misfit(field, readings, training)
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
            score = _misfit(tried, readings, training)
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


def _same(first: Floats, second: Floats) -> bool:
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
