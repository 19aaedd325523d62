"""A block that is upside down."""

from __future__ import annotations

from halbach_fe.effects.block_missing import BlockMissing


class BlockFlipped(BlockMissing):
    """One block magnetized the other way."""

    name = "block_flipped"
    title = "block mounted upside down"
    factor = -1.0


EFFECTS = (BlockFlipped(),)
