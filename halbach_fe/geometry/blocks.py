"""The blocks of an array: where they stand, their shape, their nominal magnetization.

Every block is a prism along z: an outline in the (x, y) plane, of straight edges and arcs about
the z axis, between two z. The mesh, the exact field and the checks of a user's points all start
from the blocks listed here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.outline import Outline, outline_contains, outline_part
from halbach_fe.study.materials import MU_0

CORNER = 1 / 6
"""Share of a block's width and thickness that is a corner."""


@dataclass(frozen=True)
class MagnetBlock:
    """One block; ``ring`` and ``slot`` count from 1. Lengths in m, remanence in T.

    The recoil permeability is relative, along the easy axis and across it. Outline and z limits are
    the block's place; it stands off it by ``shift`` in m, turned by the rotation vector ``turn`` in
    rad about its middle. ``factor``, ``gradient`` and ``corner_loss`` are of its magnetization, see
    `halbach_fe.study.magnet.BlockException`.
    """

    ring: int
    slot: int
    outline: Outline
    z_min: float
    z_max: float
    easy_axis: tuple[float, float, float]
    remanence: float
    recoil_permeability: float
    recoil_permeability_across: float
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gradient: float = 0.0
    corner_loss: float = 0.0
    mounted_from: tuple[int, int] | None = None

    @property
    def in_place(self) -> bool:
        """Whether it stands where it should."""
        return not (any(self.shift) or any(self.turn))

    @property
    def middle(self) -> Floats:
        """Mean of its corners, (3,) in m; z is 0 if it is infinitely long."""
        x, y = np.mean([edge.start for edge in self.outline], axis=0)
        z = 0.0 if np.isinf(self.z_max) else (self.z_min + self.z_max) / 2
        return np.array([x, y, z])

    def to_place(self, points: Floats) -> Floats:
        """Where points (n, 3) in m lie as seen from the block if it stood in its place."""
        return np.asarray((points - self.middle - self.shift) @ rotation_matrix(self.turn)
                          + self.middle)

    def from_place(self, points: Floats) -> Floats:
        """Where points (n, 3) in m lie that `to_place` would put at the given ones."""
        return np.asarray((points - self.middle) @ rotation_matrix(self.turn).T + self.middle
                          + self.shift)

    @cached_property
    def parts(self) -> tuple[tuple[float, MagnetBlock], ...]:
        """The block, or pieces of it, and how much of its magnetization each has."""
        if not (self.gradient or self.corner_loss):
            return ((1.0, self),)
        whole = replace(self, gradient=0.0, corner_loss=0.0)

        def part(*limits: float) -> MagnetBlock:
            return replace(whole, outline=outline_part(self.outline, *limits))

        found = [(1.0, whole)]
        if self.gradient:
            found += [(-self.gradient / 2, part(0.0, 0.5, 0.0, 1.0)),
                      (self.gradient / 2, part(0.5, 1.0, 0.0, 1.0))]
        if self.corner_loss:
            found += [(-self.corner_loss, part(0.0, CORNER, 0.0, CORNER)),
                      (-self.corner_loss, part(0.0, CORNER, 1 - CORNER, 1.0))]
        return tuple(found)

    @property
    def isotropic(self) -> bool:
        """Whether the recoil permeability is the same in all directions."""
        return self.recoil_permeability == self.recoil_permeability_across

    @property
    def recoil_tensor(self) -> Floats:
        """Relative recoil permeability as a tensor, (3, 3)."""
        axis = np.array(self.easy_axis)
        along, across = self.recoil_permeability, self.recoil_permeability_across
        return across * np.eye(3) + (along - across) * np.outer(axis, axis)

    @property
    def name(self) -> str:
        """Label used in regions, parameters and reports."""
        return f"r{self.ring:02d}s{self.slot:02d}"

    @cached_property
    def area(self) -> float:
        """Cross-section in m^2, by Green's theorem (exact: the integrand is a polynomial, or a
        constant on arcs).
        """
        t, weight = np.polynomial.legendre.leggauss(3)
        total = 0.0
        for edge in self.outline:
            points, normals = edge.at((t + 1) / 2)
            total += float(np.sum(weight / 2 * np.einsum("ij,ij->i", points, normals))) / 2
        return total

    @property
    def volume(self) -> float:
        """Volume in m^3."""
        return self.area * (self.z_max - self.z_min)

    @property
    def magnetization(self) -> Floats:
        """Nominal M = B_r / (mu_0 mu_r) of ``nu B = H + M``, (3,) in A/m."""
        return np.array(self.easy_axis) * self.remanence / (MU_0 * self.recoil_permeability)

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m lie inside the block or on its end faces."""
        if not self.in_place:
            points = self.to_place(points)
        inside = (points[:, 2] >= self.z_min) & (points[:, 2] <= self.z_max)
        inside[inside] = outline_contains(self.outline, points[inside, :2])
        return inside


def rotation_matrix(vector: tuple[float, float, float]) -> Floats:
    """Matrix (3, 3) of a rotation vector in rad."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def vector(values: Floats) -> tuple[float, float, float]:
    """Three numbers (3,) as a tuple of plain floats."""
    x, y, z = values.tolist()
    return x, y, z
