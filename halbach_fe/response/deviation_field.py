"""The field of the deviations of magnetizations from the nominal ones.

It is exact in vacuum. What permeable blocks and iron answer to deviations is some per cent of a
field that is small itself, up to a quarter near an iron tube. It is neglected, but for what blocks
answer where that is asked for: use the field for error bars and small corrections.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import MagnetBlock, vector
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.response.block_variation import Variations, shared_deviations, vacuum_changes
from halbach_fe.solver.exact_block_field import field_of, unit_fields
from halbach_fe.study.materials import MU_0

Field = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns a field (n, 3) in T."""


@dataclass(frozen=True)
class Deviations:
    """The blocks of a magnet whose magnetizations deviate, and vary within the blocks.

    Attributes
    ----------
    magnet : Magnet
    variations : Variations or None
    """

    magnet: Magnet
    variations: Variations | None

    @classmethod
    def of(cls, magnet: Magnet) -> Deviations:
        """Return those of the study's parameters."""
        return cls(magnet, Variations.of(magnet))

    @property
    def count(self) -> int:
        """The number of parameters."""
        varying = 0 if self.variations is None else len(self.variations.names)
        return (len(self.magnet.parameter_names) + varying
                + len(self.magnet.study.uncertain_of_magnet))

    def field(self, deviations: Floats, points: Floats) -> Floats:
        """Return B (n, 3) in T at points (n, 3) in m outside of the blocks.

        ``deviations`` (parameters,) are those of the magnetizations in A/m, followed by the
        amplitudes of variations and of what is uncertain.
        """
        first = len(self.magnet.parameter_names)
        last = self.count - len(self.magnet.study.uncertain_of_magnet)
        uniform, amplitudes, uncertain = np.split(deviations, [first, last])
        if uncertain.any():
            uniform = uniform - shared_deviations(self.magnet) @ uncertain
        found = field_of(with_magnetizations(self.magnet, uniform), points)
        if uncertain.any():
            found = found + np.tensordot(uncertain, vacuum_changes(self.magnet, points), 1)
        if self.variations is not None:
            found = found + self.variations.field(amplitudes, points)
        return found

    def answered(self, deviations: Floats) -> Field:
        """Return a function of points (n, 3) in m that computes `field` and the answer of permeable
        blocks to it, with one cell a block as in the response matrix.
        """
        blocks = with_magnetizations(
            self.magnet, deviations[:len(self.magnet.parameter_names)])
        if self.magnet.dimension == 2 or not any(
                np.any(block.recoil_tensor != np.eye(3)) for block in blocks):
            return partial(self.field, deviations)
        from halbach_fe.solver.moments.solve import solve_moments  # imports numba

        polarized = solve_moments(blocks, cells_per_side=1)

        def field(points: Floats) -> Floats:
            return self.field(deviations, points) + polarized.reaction(points)

        return field

    def columns(self, points: Floats) -> Floats:
        """Return the matrix (3 n, parameters) from deviations to B at points (n, 3) in m, in T.

        Its rows are Bx, By and Bz of the first point, then those of the second.
        """
        size = self.magnet.dimension
        found = [unit[:, :, :size] @ (MU_0 * block.recoil_tensor[:size, :size])
                 for block, unit in zip(self.magnet.blocks, unit_fields(
                     self.magnet.blocks, points), strict=True)]
        matrix = np.concatenate(found, axis=2).reshape(3 * len(points), -1)
        columns = [matrix]
        if self.variations is not None:
            columns.append(self.variations.fields(points).reshape(3 * len(points), -1))
        if self.magnet.study.uncertain_of_magnet:
            changes = vacuum_changes(self.magnet, points).reshape(-1, 3 * len(points))
            columns.append(changes.T - matrix @ shared_deviations(self.magnet))
        return np.hstack(columns)


def with_magnetizations(magnet: Magnet, values: Floats) -> tuple[MagnetBlock, ...]:
    """Return the blocks of a magnet with magnetizations (parameters,) in A/m.

    The axes of an anisotropic permeability turn with them, by fractions of a degree.
    """
    blocks, size = [], magnet.dimension
    for block, magnetization in zip(magnet.blocks, values.reshape(-1, size), strict=True):
        remanence = MU_0 * block.recoil_tensor[:, :size] @ magnetization
        strength = float(np.linalg.norm(remanence))
        axis = vector(remanence / strength) if strength else block.easy_axis
        blocks.append(replace(block, remanence=strength, easy_axis=axis))
    return tuple(blocks)
