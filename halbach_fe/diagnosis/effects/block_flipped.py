"""A block that was mounted upside down."""

from __future__ import annotations

from halbach_fe.diagnosis.effects.block_missing import BlockMissingEffect


class BlockFlippedEffect(BlockMissingEffect):
    """One block has the opposite magnetization."""

    name = "block_flipped"
    title = "block mounted upside down"
    factor = -1.0


EFFECTS = (BlockFlippedEffect(),)
