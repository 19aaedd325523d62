"""Numbers to engrave: digits of seven bars, which any cutter or printer can make."""

from __future__ import annotations

import numpy as np

from halbach_fe.geometry.prism import Prism, rectangle

SEGMENTS = {"0": "abcdef", "1": "bc", "2": "abged", "3": "abgcd", "4": "fgbc", "5": "afgcd",
            "6": "afgedc", "7": "abc", "8": "abcdefg", "9": "abcdfg"}
"""Which of seven bars a digit consists of, from the upper one clockwise; the last is the middle."""

BARS = {"a": (0.25, 0.94, False), "b": (0.5, 0.72, True), "c": (0.5, 0.28, True),
        "d": (0.25, 0.06, False), "e": (0.0, 0.28, True), "f": (0.0, 0.72, True),
        "g": (0.25, 0.5, False)}
"""Middle of each bar, relative to the height of a digit, and whether it is upright."""

LENGTH, WIDTH, PITCH = 0.3, 0.12, 0.8
"""Size of a bar, and distance of two digits, relative to their height."""


def digits(
    text: str, height: float, radius: float, angle: float, bottom: float, top: float
) -> tuple[Prism, ...]:
    """Return the bars of a number whose upper side is away from the z axis.

    Parameters
    ----------
    text : str
    height : float, in m
    radius, angle : float, in m and rad
        Its middle.
    bottom, top : float, in m
        Limits of z.
    """
    out = np.array([np.cos(angle), np.sin(angle)])
    axes = np.column_stack([[out[1], -out[0]], out])
    lying = rectangle(LENGTH * height, WIDTH * height)
    standing = rectangle(WIDTH * height, LENGTH * height)
    found = []
    for place, digit in enumerate(text):
        left = PITCH * (place - (len(text) - 1) / 2) - 0.25
        for x, y, upright in (BARS[bar] for bar in SEGMENTS[digit]):
            middle = radius * out + height * (axes @ [left + x, y - 0.5])
            found.append(Prism(standing if upright else lying, bottom, top, axes, middle))
    return tuple(found)
