"""A block that has lost part of its magnetization."""

from __future__ import annotations

from collections.abc import Sequence

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

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        (number,) = blocks_at(nominal, place)
        block = nominal.blocks[number]
        # relative to the intact block, even if the study contains a loss already
        intact = nominal.intact_blocks[number].remanence
        return -intact * (nominal.unit_fields[number] @ np.array(block.easy_axis))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, magnetization_factor=1.0 - float(values[0]))])


EFFECTS = (BlockDemagnetizedEffect(),)
