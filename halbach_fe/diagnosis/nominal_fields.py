"""Fields of the nominal magnet at a map's points, from which effects build their signatures.

Except for `NominalFields.finite_element_field` all fields are those of blocks in vacuum:
permeability and iron change a signature by a few per cent. That matters little to the search for
effects, and not at all to an effect that was found, because it is then applied to the study and
solved in full.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.campaign_readings import unit_vectors
from halbach_fe.measurement.probe_law import (
    nonlinear_part,
    sensor_matrix,
    sensor_positions,
    with_memory,
)
from halbach_fe.solver.exact_block_field import (
    block_gradients,
    external_field,
    external_gradient,
    unit_fields,
)
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study


@dataclass(frozen=True)
class NominalFields:
    """The nominal magnet of a study, and its field at the points of a map.

    Fields are computed when they are first asked for, and kept.
    """

    study: Study
    points: Floats
    """Positions of the probe along the magnet's axes. Shape (n, 3), in m."""
    time: Floats
    """When each point was read, from 0 at the first reading of the map to 1 at the last.
    Shape (n,)."""
    solve: Callable[[Study], Floats]
    """Function of a study that returns the field (n, 3) in T of its nominal magnet at the points,
    by finite elements."""
    solve_iron: Callable[[Study, bool], Floats | None] = field(
        default=lambda study, few_modes: None, kw_only=True)
    """Function of a study that returns the change (n, 3) in T that its iron makes to the field of
    blocks in vacuum, or None if `solve` takes no longer; and of whether few modes suffice, see
    `halbach_fe.solver.routes.iron_change`."""
    measured_magnetizations: Floats | None = field(default=None, kw_only=True)
    """Magnetizations that are expected from measurements of the single blocks, in D dimensions;
    None to use the nominal ones. Shape (blocks, D), in A/m."""
    stated: Floats | None = field(default=None, kw_only=True)
    """The points as the map states them; None if they are where the probe was.
    Shape (n, 3), in m."""
    of_total_field: bool = field(default=False, kw_only=True)
    """Whether the map is of |B| alone."""
    way: Floats | None = field(default=None, kw_only=True)
    """Unit vectors along which the stage came to each point, see
    `halbach_fe.measurement.positions.motion`; None if the points are all of a map, in its order.
    Shape (n, 3)."""
    _gradients: dict[int, Floats] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def magnet(self) -> Magnet:
        """The magnet of the study."""
        return build_magnet(self.study)

    @property
    def blocks(self) -> tuple[MagnetBlock, ...]:
        """The blocks of the study's magnet."""
        return self.magnet.blocks

    @cached_property
    def unit_fields(self) -> Floats:
        """B of each block for a remanence of 1 T along x, y and z.

        Shape (blocks, n, 3, 3), in T; the last axis is the direction of the remanence.
        """
        return np.array(list(unit_fields(self.blocks, self.points)))

    @cached_property
    def block_fields(self) -> Floats:
        """B of each nominal block, (blocks, n, 3) in T."""
        return np.array([unit @ block.polarization
                         for block, unit in zip(self.blocks, self.unit_fields, strict=True)])

    @cached_property
    def block_gradients(self) -> Floats:
        """Gradient of B of each nominal block, (blocks, n, 3, 3) in T/m.

        Element ``[b, i, c, j]`` is the derivative of component c along direction j.
        """
        return np.array(list(block_gradients(self.blocks, self.points)))

    def block_gradient(self, block: int) -> Floats:
        """Return the gradient of B of block number ``block``, (n, 3, 3) in T/m."""
        if block not in self._gradients:
            # number of blocks whose gradients are computed one by one. If more are asked for, those
            # of all blocks will be needed.
            few_blocks = 10
            if "block_gradients" in vars(self) or len(self._gradients) == few_blocks:
                return np.asarray(self.block_gradients[block])
            self._gradients[block] = next(block_gradients([self.blocks[block]], self.points))
        return self._gradients[block]

    @cached_property
    def field(self) -> Floats:
        """B of the nominal magnet and of the study's external sources, (n, 3) in T."""
        return np.asarray(self.block_fields.sum(axis=0) + external_field(self.magnet, self.points))

    @cached_property
    def gradient(self) -> Floats:
        """Gradient of B of the nominal magnet and of external sources, (n, 3, 3) in T/m.

        Element ``[i, c, j]`` is the derivative of component c along direction j.
        """
        return np.asarray(
            self.block_gradients.sum(axis=0) + external_gradient(self.magnet, self.points))

    @cached_property
    def finite_element_field(self) -> Floats:
        """B of the nominal magnet by finite elements, (n, 3) in T."""
        return self.solve(self.study)

    def change_by_iron(self, study: Study, few_modes: bool = False) -> Floats:
        """Return the change (n, 3) in T of B that the iron of another study makes to this one."""
        quick = self.solve_iron(study, few_modes)
        return self.solve(study) - self.finite_element_field if quick is None else quick

    @cached_property
    def magnetizations(self) -> Floats:
        """Magnetizations of the blocks, measured or else nominal, (blocks, D) in A/m.

        A missing or reversed block changes the field by as much as the block contributes. The
        nominal magnetization would leave an error of the order of the block's tolerance in such a
        signature.
        """
        size = self.study.dimension
        return np.array([block.magnetization[:size] for block in self.blocks]
                        ) if self.measured_magnetizations is None else self.measured_magnetizations

    def field_with(self, number: int, magnetization: Floats) -> Floats:
        """Return B (n, 3) in T of block ``number`` with a magnetization (D,) in A/m."""
        block, size = self.blocks[number], len(magnetization)
        return np.asarray(self.unit_fields[number, :, :, :size] @ (
            MU_0 * block.recoil_tensor[:size, :size] @ magnetization))

    def fields_of(self, blocks: Sequence[MagnetBlock]) -> Floats:
        """Return B (blocks, n, 3) in T of each of some blocks."""
        return np.array([unit @ block.polarization
                         for block, unit in zip(blocks, unit_fields(blocks, self.points),
                                                strict=True)]).reshape(-1, *self.points.shape)

    @cached_property
    def gradient_fields(self) -> Floats:
        """Change of B per unit of each block's magnetization gradient, (blocks, n, 3) in T."""
        uneven = [replace(block, gradient=block.gradient + 1) if len(block.outline) == 4 else block
                  for block in self.blocks]
        return np.asarray(self.fields_of(uneven) - self.block_fields)

    def block_translation_derivative(self, block: int, direction: Floats) -> Floats:
        """Return the derivative of B (n, 3) in T/m when block number ``block`` moves.

        ``direction`` (3,) need not be a unit vector: the derivative is per unit of the factor by
        which it is multiplied.
        """
        return np.asarray(-self.block_gradient(block) @ direction)

    def block_rotation_derivative(
        self, block: int, axis: Floats, centre: Floats
    ) -> Floats:
        """Return the derivative of B (n, 3) in T/rad when block number ``block`` turns.

        The rotation axis has the direction ``axis`` (3,), and passes through the point ``centre``
        (3,) in m. The derivative is per unit of the factor by which ``axis`` is multiplied. The
        magnetization turns with the block.
        """
        around = np.cross(axis, self.points - centre)
        return np.asarray(np.cross(axis, self.block_fields[block])
                          - np.einsum("ncj,nj->nc", self.block_gradient(block), around))

    def shown(self, instrument: Instrument) -> Floats:
        """Return the values (n, 3) in T of the map by an instrument, near where the probe was.

        The field is linear about the points. Of a map of |B| the law of the probe is that of a
        single number, which is given along the field.
        """
        stated = self.points if self.stated is None else self.stated
        away = sensor_positions(instrument, stated, self.way) - self.points[:, None]
        field = self.field[:, None] + np.einsum("ncj,nsj->nsc", self.gradient, away)
        linear = np.einsum("sc,nsc->ns", sensor_matrix(instrument), field)
        along = np.ones(1)
        if self.of_total_field:
            along = unit_vectors(linear)
            linear = np.repeat(np.sum(along * linear, axis=1)[:, None], 3, axis=1)
        return along * with_memory(
            instrument, linear + nonlinear_part(instrument, linear, self.time), self.time)
