"""Effects on single blocks: lost magnetization, displacements, rotations, gradients, corners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    blocks_at,
    can_be_uneven,
    changed,
    each_block,
    each_ring,
    with_exceptions,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class BlockMissingEffect(Effect):
    """One block is missing."""

    name = "block_missing"
    title = "missing block"
    kind = "field"
    parameters = (Parameter("there", "1", 1.0),)
    is_binary = True
    applied_in_full = True
    factor = 0.0  # by which the block's magnetization is multiplied

    def places(self, study: Study) -> Sequence[Place]:
        return each_block(study)

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        (block,) = blocks_at(nominal, place)
        return {block: (self.factor - 1) * nominal.magnetizations[block]}

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        (block,) = blocks_at(nominal, place)
        return (self.factor - 1) * nominal.measured_block_field(block)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, magnetization_factor=self.factor)])


class BlockFlippedEffect(BlockMissingEffect):
    """One block has the opposite magnetization."""

    name = "block_flipped"
    title = "block with its magnetization reversed"
    factor = -1.0


class BlockDemagnetizedEffect(Effect):
    """One block has lost a fraction of its magnetization.

    The prior standard deviation is far larger than a block's own tolerance, which belongs to the
    prior of the magnetizations.
    """

    name = "block_demagnetized"
    title = "demagnetized block"
    kind = "field"
    parameters = (Parameter("loss", "1", 0.1),)

    def places(self, study: Study) -> Sequence[Place]:
        return each_block(study)

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        return {number: -nominal.magnetizations[number] for number in blocks_at(nominal, place)}

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return -nominal.block_fields[blocks_at(nominal, place)].sum(axis=0)[None]

    def derivative(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.derivative`: the loss is relative to the block without it, which may be
        reversed by another effect.
        """
        left = 1.0 - values[0]
        if left:
            return self.signature(nominal, place) / left
        return -np.sum([nominal.intact_blocks[number].remanence * (
            nominal.unit_fields[number] @ np.array(nominal.blocks[number].easy_axis))
            for number in blocks_at(nominal, place)], axis=0)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot or None,
            magnetization_factor=1.0 - float(values[0]))])


class RingDemagnetizedEffect(BlockDemagnetizedEffect):
    """All blocks of a ring are weaker by the same fraction: of another batch or grade, or warmer.

    The remanences of two grades that follow each other differ by 3 to 4 %.
    """

    name = "ring_demagnetized"
    title = "ring of weaker blocks"
    parameters = (Parameter("loss", "1", 0.03),)

    def places(self, study: Study) -> Sequence[Place]:
        """Return several rings: of one alone, it is what all blocks share."""
        return rings if len(rings := each_ring(study)) > 1 else []


class BlockDisplacedEffect(Effect):
    """One block is displaced along its own axes: radially, azimuthally and axially."""

    name = "block_displaced"
    title = "displacement of a block"
    kind = "field"
    parameters = (
        Parameter("radial", "m", 2e-4), Parameter("azimuthal", "m", 2e-4),
        Parameter("axial", "m", 2e-4))

    def places(self, study: Study) -> Sequence[Place]:
        return each_block(study)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        (block,) = blocks_at(nominal, place)
        axes = rotation_matrix((0.0, 0.0, np.radians(nominal.blocks[block].angle_deg)))
        return np.array([nominal.block_translation_derivative(block, axis) for axis in axes.T])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        radial, azimuthal, axial = map(float, values)
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, displacement_m=(radial, azimuthal, axial))])


class BlockTurnedEffect(Effect):
    """One block is rotated with its magnetization, about its own axes through its centre."""

    name = "block_turned"
    title = "rotation of a block"
    kind = "field"
    parameters = (
        Parameter("radial", "rad", 0.02), Parameter("azimuthal", "rad", 0.02),
        Parameter("axial", "rad", 0.02))

    def places(self, study: Study) -> Sequence[Place]:
        return each_block(study)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        (block,) = blocks_at(nominal, place)
        axes = rotation_matrix((0.0, 0.0, np.radians(nominal.blocks[block].angle_deg)))
        middle = nominal.blocks[block].middle
        return np.array([nominal.block_rotation_derivative(block, axis, middle) for axis in axes.T])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        radial, azimuthal, axial = np.degrees(values).tolist()
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, rotation_deg=(radial, azimuthal, axial))])


class MagnetizationGradientEffect(Effect):
    """The outer half of the blocks is stronger than the inner one, in all blocks or in one.

    The parameter is the difference as a fraction of the mean.
    """

    name = "magnetization_gradient"
    title = "magnetization gradient inside the blocks"
    kind = "field"
    parameters = (Parameter("gradient", "1", 0.02),)

    def places(self, study: Study) -> Sequence[Place]:
        blocks = build_magnet(study).blocks
        uneven = {(block.ring, block.slot) for block in blocks if can_be_uneven(block)}
        each = [place for place in each_block(study) if (place.ring, place.slot) in uneven]
        return [Place(), *each] if len(uneven) == len(blocks) else each

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        per_unit = nominal.gradient_fields
        return np.asarray(per_unit[blocks_at(nominal, place)].sum(axis=0))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return with_exceptions(study, [BlockException(
            ring=place.ring or None, slot=place.slot or None,
            magnetization_gradient=float(values[0]))])


class CornersDemagnetizedEffect(Effect):
    """Both inner corners of all blocks have lost a fraction of their magnetization.

    The study's ``inner_corner_loss`` defines the size of a corner.
    """

    name = "corners_demagnetized"
    title = "demagnetized corners at the bore"
    kind = "field"
    parameters = (Parameter("loss", "1", 0.1),)

    def places(self, study: Study) -> Sequence[Place]:
        return [Place()] if all(map(can_be_uneven, build_magnet(study).blocks)) else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return changed(nominal, self.apply(nominal.study, place, [0.5]))[None] / 0.5

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        # the last exception that applies to all blocks sets the loss the study has already
        present = next((exception.inner_corner_loss
                        for exception in reversed(study.array.exceptions)
                        if exception.inner_corner_loss is not None
                        and not (exception.ring or exception.slot)), 0.0)
        return with_exceptions(study, [BlockException(
            inner_corner_loss=present + float(values[0]))])


EFFECTS = (BlockMissingEffect(), BlockFlippedEffect(), BlockDemagnetizedEffect(),
           RingDemagnetizedEffect(), BlockDisplacedEffect(), BlockTurnedEffect(),
           MagnetizationGradientEffect(), CornersDemagnetizedEffect())
