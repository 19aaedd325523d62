"""A block that has lost part of its magnetization."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    blocks_at,
    each_block,
    with_exceptions,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


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
        """See `Effect.places`."""
        return each_block(study)

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        """See `Effect.magnetization_change`."""
        (number,) = blocks_at(nominal, place)
        return {number: -nominal.magnetizations[number]}

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        (number,) = blocks_at(nominal, place)
        return -nominal.block_fields[number][None]

    def derivative(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.derivative`: the loss is relative to the block without it, which may be
        reversed by another effect.
        """
        (number,) = blocks_at(nominal, place)
        left = 1.0 - values[0]
        if left:
            return self.signature(nominal, place) / left
        block = nominal.blocks[number]
        return -nominal.intact_blocks[number].remanence * (
            nominal.unit_fields[number] @ np.array(block.easy_axis))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, magnetization_factor=1.0 - float(values[0]))])


EFFECTS = (BlockDemagnetizedEffect(),)
