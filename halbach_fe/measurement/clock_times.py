"""Times of readings: numbers in a unit, times of day (14:23:59, 142359) and ISO stamps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime, timedelta

import numpy as np

from halbach_fe.core.arrays import Floats

DAY_S = 86_400.0
LEAST_CLOCK = 10_000
"""Smallest number that is taken for a time of day, 1:00:00: counters of seconds begin below."""
TIME_OF_DAY = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)(?::([0-5]\d(?:[.,]\d{1,9})?))?")


def look_like_clock(values: Floats) -> bool:
    """Return whether numbers may be times of day, HHMMSS, that are taken for seconds.

    All are whole, of at least 5 digits, and hours, minutes and seconds of a day, and they are of
    more than one minute: within a minute both are the same. A counter of seconds that passes from
    one hundred to the next in steps of up to 40 s has a number that ends on more than 59.
    """
    known = values[np.isfinite(values)]
    whole = known == np.floor(known)
    if not whole.all() or not known.size or known.min() < LEAST_CLOCK:
        return False
    minutes = known // 100
    return len(np.unique(minutes)) > 1 and bool(
        ((known < 240_000) & (known % 100 < 60) & (minutes % 100 < 60)).all())


def from_clock(values: Floats) -> Floats | None:
    """Return times (n,) in s after the first one of numbers HHMMSS; None if they are none."""
    valid = (values >= 0) & (values < 240_000) & (values % 100 < 60) & (values // 100 % 100 < 60)
    if not valid.all():
        return None
    return _over_midnight(values // 10_000 * 3600 + values // 100 % 100 * 60 + values % 100)


def from_texts(cells: Sequence[str]) -> Floats | None:
    """Return times (n,) in s after the first one of times of day or ISO stamps.

    None stands for cells that are neither.
    """
    found = [TIME_OF_DAY.fullmatch(cell.strip()) for cell in cells]
    if all(found):
        return _over_midnight(np.array([
            int(part[1]) * 3600 + int(part[2]) * 60 + float((part[3] or "0").replace(",", "."))
            for part in found if part]))
    try:
        stamps = [datetime.fromisoformat(cell.strip()) for cell in cells]
        first = min(stamps)
        return np.array([(stamp - first) / timedelta(seconds=1) for stamp in stamps])
    except (ValueError, TypeError, OverflowError):  # TypeError: only some have a time zone
        return None


def _over_midnight(times: Floats) -> Floats:
    """Return times of day as times after the first one.

    Midnight has passed where they fall back by more than half a day. Rows that are not in the order
    of time may also go back to the day before.
    """
    steps = np.diff(times, prepend=times[:1])
    days = np.zeros(len(times))
    day = 0
    for row in np.flatnonzero(np.abs(steps) > DAY_S / 2):
        day = day + 1 if steps[row] < 0 else max(0, day - 1)
        days[row:] = day
    times = times + DAY_S * days
    return np.asarray(times - times.min())
