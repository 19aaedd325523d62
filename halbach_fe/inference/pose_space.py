"""Poses of a map in a magnet: rotations by right angles, steps from one to another, their misfit.

A pose is where the middle of the map lies, in m, and a rotation vector, which turns it about that
middle from the axes of the map to those of the magnet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats

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
