"""A block that was mounted the wrong way round."""

from __future__ import annotations

from halbach_fe.diagnosis.effects.block_missing import BlockMissingEffect


class BlockFlippedEffect(BlockMissingEffect):
    """One block has the opposite magnetization."""

    name = "block_flipped"
    title = "block with its magnetization reversed"
    factor = -1.0


EFFECTS = (BlockFlippedEffect(),)
