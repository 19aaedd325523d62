"""A missing block."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
        """See `Effect.places`."""
        return each_block(study)

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        """See `Effect.magnetization_change`."""
        (block,) = blocks_at(nominal, place)
        return {block: (self.factor - 1) * nominal.magnetizations[block]}

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        (block,) = blocks_at(nominal, place)
        return (self.factor - 1) * nominal.measured_block_field(block)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, magnetization_factor=self.factor)])


EFFECTS = (BlockMissingEffect(),)
