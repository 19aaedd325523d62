"""Quantities as people read them: with a unit that suits their size."""

from __future__ import annotations

import numpy as np

from halbach_fe.diagnosis.summary import EMPTY_CELL, block_in_words
from halbach_fe.geometry.blocks import MagnetBlock

SMALL_T = 1e-4
"""Flux density below which texts and tables give it in µT."""


def flux_density(value: float) -> str:
    """Format a flux density in T as mT, or as µT if it is small."""
    if np.isnan(value):
        return EMPTY_CELL
    size, unit = (1e3 * value, "mT") if abs(value) >= SMALL_T else (1e6 * value, "µT")
    return f"{size:.3g}\u00a0{unit}"


def place_of(block: MagnetBlock) -> str:
    """Describe a block by its own label, or else by ring and slot."""
    return block_in_words(block.ring, block.slot, block.label or "")


def fraction(value: float) -> str:
    """Format a fraction in percent, with one decimal."""
    return f"{100 * value:.1f}\u00a0%"
