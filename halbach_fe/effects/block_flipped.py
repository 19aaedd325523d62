"""A block that is upside down."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.blocks import Floats
from halbach_fe.effects.base import Effect, Parameter, Place, blocks_at, each_block, with_exceptions
from halbach_fe.scene import Scene
from halbach_fe.study import BlockException, Study


class BlockFlipped(Effect):
    """One block magnetized the other way."""

    name = "block_flipped"
    title = "block mounted upside down"
    kind = "field"
    parameters = (Parameter("there", "1", 1.0),)
    certain = True
    discrete = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return each_block(study)

    def signature(self, scene: Scene, place: Place) -> Floats:
        """See `Effect.signature`."""
        (block,) = blocks_at(scene, place)
        return -2 * scene.block_fields[block][None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, magnetization_factor=-1.0)])


EFFECTS = (BlockFlipped(),)
