"""Quantities as people read them: with a unit that suits their size."""

from __future__ import annotations

import numpy as np

from halbach_fe.core.numbers import EMPTY_CELL
from halbach_fe.core.numbers import decimals as decimals
from halbach_fe.core.numbers import in_a_row as in_a_row
from halbach_fe.geometry.blocks import MagnetBlock, block_in_words
from halbach_fe.study.model import Study

SMALL_T, LARGE_T = 1e-3, 1.0
"""Flux density below which texts and tables give it in µT, and from which they give it in T. A
residual of 120 µT stands beside one of 5 µT without a change of unit."""

ROUNDING = 1e-11
"""Fraction of a field below which its error is the rounding of the computer."""


MOST_PLACES = 4
"""Largest number of blocks that a line names."""

CERTAIN = 100
"""Power of ten beyond which a Bayes factor is not told in detail."""

PERCENT_FROM = 0.01
"""Part of 1 from which it is told in per cent, not in ppm."""

RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")

TO_ONE = "\u00a0:\u00a01"

BAYES_FACTOR_IN_WORDS = ("The Bayes factor of an effect says how many times as probable the "
                         "readings are with it as without it.")


def flux_density(value: float, digits: int = 3, zeros: bool = False) -> str:
    """Format a flux density in T as mT, or as T or µT if it is large or small.

    With ``zeros`` the last digits are there if they are 0 too, as beside numbers that have them.
    """
    if np.isnan(value):
        return EMPTY_CELL
    size, unit = ((value, "T") if abs(value) >= LARGE_T else (1e3 * value, "mT")
                  if abs(value) >= SMALL_T or not value else (1e6 * value, "µT"))
    text = decimals(size, digits)
    if zeros and text != "0":
        text = f"{size:#.{digits}g}".rstrip(".") if abs(size) < 10**digits else text
    return f"{text}\u00a0{unit}"


def with_error(value: float, sd: float) -> str:
    """Return a number and its standard deviation, with two digits of the latter."""
    if not abs(sd) > ROUNDING * abs(value):
        return f"{value:.6g}"
    places = int(np.clip(1 - np.floor(np.log10(sd)), 0, 9))
    rounded = round(value, places) + 0.0  # without a sign where it is 0
    return f"{rounded:.{places}f}\u00a0±\u00a0{sd:.{places}f}"


def ppm(value: float) -> str:
    """Return a number of ppm as text, without an exponent."""
    return (f"{value:,.0f}".replace(",", "\u202f") if abs(value) >= 1000
            else "0" if abs(value) < 1e-3 else f"{value:.3g}")


def relative(share: float) -> str:
    """Return a part of 1 in ppm, or in per cent from 10 000 ppm on."""
    return (f"{decimals(100 * share)}\u00a0%" if abs(share) >= PERCENT_FROM
            else f"{ppm(1e6 * share)}\u00a0ppm")


def probability(share: float) -> str:
    """Return a probability in per cent, without claiming certainty."""
    return ("less than 0.1\u00a0%" if share < 1e-3 else "more than 99.9\u00a0%"
            if share > 0.999 else f"{100 * share:.3g}\u00a0%")


def bayes_factor(log_bayes_factor: float) -> str:
    """Return how many times as probable the readings are with an effect as without it.

    Large factors are powers of ten, and no larger one than `CERTAIN` is claimed.
    """
    if np.isnan(log_bayes_factor):
        return EMPTY_CELL
    power = log_bayes_factor / np.log(10)
    if power >= CERTAIN:
        return f"over 10{str(CERTAIN).translate(RAISED)}{TO_ONE}"
    if power >= 4:
        return f"10{str(int(power)).translate(RAISED)}{TO_ONE}"
    return f"{decimals(float(np.exp(log_bayes_factor)), 2)}{TO_ONE}"


def p_value(value: float) -> str:
    """Return a p-value as text, without an exponent."""
    return "less than 0.0001" if value < 1e-4 else f"{value:.2g}"


def whole(number: int) -> str:
    """Return a whole number with its thousands apart."""
    return f"{number:,}".replace(",", "\u202f") if abs(number) >= 10_000 else str(number)


def share_in_words(share: float, sd: float | None) -> str:
    """Return a share of what was drawn in per cent, with its standard deviation; in words if it is
    none or all, of which the draws tell no standard deviation.
    """
    if share in (0.0, 1.0):
        return "All" if share else "None"
    return f"{with_error(100 * share, 100 * (sd or 0.0))}\u00a0%"


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a number and its noun: 1 move, 2 moves."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def is_fourier(study: Study) -> bool:
    """Whether a reading of the study is a Fourier coefficient of B_r, not a component of B."""
    return study.observation.quantity == "fourier_coefficients"


def faults_in_words(study: Study) -> str:
    """Say which blocks the study has reversed, missing or in places of others; empty if none."""
    found: dict[str, list[str]] = {}
    for one in study.array.exceptions:
        if one.ring is None or one.slot is None:
            continue
        kind = ("missing" if not one.magnetization_factor else "reversed"
                if one.magnetization_factor < 0 else "made for another place"
                if one.mounted_from not in (None, (one.ring, one.slot)) else None)
        if kind:
            found.setdefault(kind, []).append(block_in_words(one.ring, one.slot))
    return "; ".join(
        f"{kind}: " + ("; ".join(places) if len(places) <= MOST_PLACES else f"{len(places)} blocks")
        for kind, places in found.items())


def place_of(block: MagnetBlock) -> str:
    """Describe a block by its own label, or else by ring and slot."""
    return block_in_words(block.ring, block.slot, block.label or "")


def fraction(value: float) -> str:
    """Format a fraction in percent, with one decimal."""
    return f"{100 * value:.1f}\u00a0%"
