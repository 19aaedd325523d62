"""A block that has lost magnetization."""

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
from halbach_fe.geometry.mounting import as_meant
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.model import Study


class BlockDemagnetizedEffect(Effect):
    """One block weaker by far more than its own tolerance."""

    name = "block_demagnetized"
    title = "demagnetized block"
    kind = "field"
    parameters = (Parameter("loss", "1", 0.1),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return each_block(study)

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        (number,) = blocks_at(scene, place)
        block = scene.blocks[number]
        whole = as_meant(scene.magnet).blocks[number].remanence  # whatever it has lost already
        return -whole * (scene.unit_fields[number] @ np.array(block.easy_axis))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, magnetization_factor=1.0 - float(values[0]))])


EFFECTS = (BlockDemagnetizedEffect(),)
