"""What the signature of an effect is made of: fields of the nominal magnet at a map's points.

Blocks are taken in vacuum: permeability and iron change a signature by a few per cent, which
matters little to a search, and nothing to the effect once it is in the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.solver.external_field import external_field
from halbach_fe.solver.vacuum_field import block_gradients, unit_fields
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study


@dataclass(frozen=True)
class NominalFields:
    """A study and the points of a map of it.

    Attributes
    ----------
    study : Study
    points : ndarray, shape (n, 3), in m
    time : ndarray, shape (n,)
        Of each reading, from 0 to 1.
    solve : callable
        Study to the field (n, 3) in T of its nominal magnet at the points, by finite elements.
    known : ndarray, shape (blocks, D), in A/m, or None
        Magnetizations as they were measured before the magnet was built; None: the nominal ones.
    """

    study: Study
    points: Floats
    time: Floats
    solve: Callable[[Study], Floats]
    known: Floats | None = field(default=None, kw_only=True)

    @cached_property
    def magnet(self) -> Magnet:
        """The study's magnet."""
        return build_magnet(self.study)

    @property
    def blocks(self) -> tuple[MagnetBlock, ...]:
        """The study's blocks."""
        return self.magnet.blocks

    @cached_property
    def unit_fields(self) -> Floats:
        """B (blocks, n, 3, 3) in T of each block for a remanence of 1 T along x, y, z."""
        return np.array(list(unit_fields(self.blocks, self.points)))

    @cached_property
    def block_fields(self) -> Floats:
        """B (blocks, n, 3) in T of each nominal block."""
        return np.array([unit @ (np.array(block.easy_axis) * block.remanence)
                         for block, unit in zip(self.blocks, self.unit_fields, strict=True)])

    @cached_property
    def block_gradients(self) -> Floats:
        """Derivatives (blocks, n, 3, 3) in T/m of component c of each block's B along j."""
        return np.array(list(block_gradients(self.blocks, self.points)))

    @cached_property
    def field(self) -> Floats:
        """B (n, 3) in T of the nominal magnet and of what else the study has."""
        return np.asarray(self.block_fields.sum(axis=0) + external_field(self.magnet, self.points))

    @cached_property
    def gradient(self) -> Floats:
        """Derivatives (n, 3, 3) in T/m of component c of the nominal magnet's B along j."""
        return np.asarray(self.block_gradients.sum(axis=0))

    @cached_property
    def solved(self) -> Floats:
        """B (n, 3) in T of the nominal magnet by finite elements."""
        return self.solve(self.study)

    def known_field(self, number: int) -> Floats:
        """B (n, 3) in T of a block as it was measured; what is there or not as a whole must be
        known better than a tolerance.
        """
        return self.field_with(number, self.magnetizations[number])

    @cached_property
    def magnetizations(self) -> Floats:
        """Of the blocks, as measured or else nominal, (blocks, D) in A/m."""
        size = self.study.dimension
        return np.array([block.magnetization[:size] for block in self.blocks]
                        ) if self.known is None else self.known

    def field_with(self, number: int, magnetization: Floats) -> Floats:
        """B (n, 3) in T of a block with a magnetization (D,) in A/m."""
        block, size = self.blocks[number], len(magnetization)
        return np.asarray(self.unit_fields[number, :, :, :size] @ (
            MU_0 * block.recoil_tensor[:size, :size] @ magnetization))

    def block_fields_of(self, study: Study) -> Floats:
        """B (blocks, n, 3) in T of each nominal block of another study."""
        blocks = build_magnet(study).blocks
        return np.array([unit @ (np.array(block.easy_axis) * block.remanence)
                         for block, unit in zip(blocks, unit_fields(blocks, self.points),
                                                strict=True)])

    @cached_property
    def gradient_fields(self) -> Floats:
        """Change of B (blocks, n, 3) in T per unit of the magnetization gradient of each block."""
        array = self.study.array
        uneven = array.with_(
            exceptions=(*array.exceptions, BlockException(magnetization_gradient=1.0)))
        study = self.study.with_(array=uneven)
        return np.asarray(self.block_fields_of(study) - self.block_fields)

    def moved(self, block: int, shift: Floats) -> Floats:
        """Change of B (n, 3) in T/m when a block moves along ``shift`` (3,)."""
        return np.asarray(-self.block_gradients[block] @ shift)

    def turned(self, block: int, axis: Floats, about: Floats) -> Floats:
        """Change of B (n, 3) in T/rad when a block turns about an axis (3,) through a point."""
        around = np.cross(axis, self.points - about)
        return np.asarray(np.cross(axis, self.block_fields[block])
                          - np.einsum("ncj,nj->nc", self.block_gradients[block], around))

    def displaced(self, displacement: Floats) -> Floats:
        """Change of B (n, 3) in T when the points move by (n, 3) in m."""
        return np.asarray(np.einsum("ncj,nj->nc", self.gradient, displacement))
