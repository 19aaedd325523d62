"""Progress of a long search: the part that is done, the time that is left, and its limit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

Progress = Callable[[int, int], None]
"""Takes the numbers of finished and of all parts of a step."""

Say = Callable[[str], None]
"""Takes a line of text."""


def quiet(*_: object) -> None:
    """Say and show nothing."""


QUIET_S = 10.0
"""Time in s between two lines about the progress of one step."""


@dataclass
class Pace:
    """Reports the progress of the step under way, and tells when the time is up."""

    say: Say
    """Takes a line of text."""
    show: Progress | None = None
    """Takes the numbers of finished and of all parts of a step, for a progress bar."""
    limit_s: float | None = None
    """Time limit in s from the beginning."""
    clock: Callable[[], float] = time.monotonic
    """Returns the time in s."""
    _step: str = ""
    _begun: float = field(init=False)
    _step_begun: float = field(init=False)
    _said: float = field(init=False)
    _total: int = field(init=False, default=0)
    _first: int = field(init=False, default=0)
    _done: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self._begun = self._step_begun = self._said = self.clock()

    @property
    def is_over(self) -> bool:
        """Whether the time limit has passed."""
        return self.limit_s is not None and self.clock() - self._begun >= self.limit_s

    def begin(self, step: str) -> None:
        """Begin a step, whose name the lines about its progress start with."""
        self._step, self._step_begun = step, self.clock()
        self._said, self._total, self._first, self._done = self._step_begun, 0, 0, 0

    def advance(self, done: int, total: int) -> None:
        """Report that parts of the step are done, with the time left at the pace so far."""
        if self.show is not None:
            self.show(done, total)
        now = self.clock()
        # part of a step that must be done before its pace foretells the time left: the first part
        # often prepares what all others use
        foretold_share = 0.01
        # a step may count anew, from 0 or from 1
        if not done or done < self._done or self._total not in (0, total):
            self._step_begun, self._first = now, done
        elif done < total and now - self._said >= QUIET_S:
            left = (now - self._step_begun) * (total - done) / max(done - self._first, 1)
            foretold = (f", about {duration(left)} left of this step"
                        if done >= foretold_share * total else "")
            self.say(f"{self._step}: {done} of {total}{foretold}")
            self._said = now
        self._total, self._done = total, done


def duration(seconds: float) -> str:
    """Return a duration in s, min or h, whichever is read most easily."""
    minute_s, hour_s = 60.0, 3600.0
    if seconds < minute_s:
        return f"{seconds:.0f} s"
    if seconds < hour_s:
        return f"{seconds / minute_s:.0f} min"
    return f"{seconds / hour_s:.1f} h"
