"""Progress within the steps of a search, its time left, and its time limit."""

from __future__ import annotations

import pytest

from halbach_fe.core.progress import Pace, duration


class Clock:
    """Time that passes by itself with every look at it."""

    def __init__(self, step=0.0):
        self.now, self.step = 0.0, step

    def __call__(self):
        self.now += self.step
        return self.now


def test_progress_is_told_with_the_time_left():
    clock, said, shown = Clock(), [], []
    pace = Pace(said.append, lambda *counts: shown.append(counts), clock=clock)
    pace.begin("effects")
    pace.advance(0, 100)
    for done in range(1, 101):
        clock.now += 1.0
        pace.advance(done, 100)
    assert shown[0] == (0, 100)
    assert shown[-1] == (100, 100)
    assert said[0] == "effects: 10 of 100, about 2 min left of this step"
    assert said[-1] == "effects: 90 of 100, about 10 s left of this step"
    assert len(said) == 9
    pace.begin("more effects")
    clock.now += 20.0  # the first prepares what all others use: nothing is foretold from it
    pace.advance(1, 10_000)
    assert said[-1] == "more effects: 1 of 10000"
    clock.now += 1000.0
    for done in range(1, 13):  # a part of the step that counts by itself
        pace.advance(done, 20)
        clock.now += 1.0
    assert said[-1] == "more effects: 12 of 20, about 8 s left of this step"
    clock.now += 1000.0
    for done in range(1, 13):  # another part with as many
        pace.advance(done, 20)
        clock.now += 1.0
    assert said[-1] == "more effects: 12 of 20, about 8 s left of this step"
    assert said[-2] == "more effects: 2 of 20, about 18 s left of this step"  # not the 1000 s
    assert not pace.is_over


def test_the_limit_counts_from_the_beginning():
    clock = Clock()
    pace = Pace(lambda _: None, limit_s=5.0, clock=clock)
    clock.now = 4.9
    pace.begin("a step")
    assert not pace.is_over
    clock.now = 5.0
    assert pace.is_over


@pytest.mark.parametrize(("seconds", "text"), [(2.4, "2 s"), (90.0, "2 min"), (5400.0, "1.5 h")])
def test_durations(seconds, text):
    assert duration(seconds) == text
