"""Progress within the steps of a diagnosis, and its time limit."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.pace import Pace, duration
from halbach_fe.measurement.field_map import field_map, points_of
from tests.diagnosis.campaign import STUDY, measured


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
    assert said[0] == "effects: 10 of 100, about 2 min left"
    assert said[-1] == "effects: 90 of 100, about 10 s left"
    assert len(said) == 9
    pace.begin("more effects")
    clock.now += 20.0  # the first prepares what all others use: nothing is foretold from it
    pace.advance(1, 10_000)
    assert said[-1] == "more effects: 1 of 10000"
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


@pytest.mark.parametrize("enough", [False, True])
def test_what_was_found_in_time_is_in_the_model(session, generator, monkeypatch, enough):
    """The clock runs out when two effects are known: the one that was found is kept in full."""
    data = measured(STUDY, generator)
    data = field_map(points_of(data), np.add(data["B_T"].values, [4e-4, 0.0, 0.0]))
    some = [effect for effect in catalogue() if effect.name in ("gain_x", "offset_x", "z_scale")]
    asked = iter(range(10_000))
    monkeypatch.setattr(Pace, "is_over", property(lambda _: not enough and next(asked) >= 2))
    found = diagnose(STUDY, data, session, effects=some)
    assert (found.uncompared is None) == enough
    assert found.uncompared == (None if enough else 1)
    assert [one.hypothesis.effect.name for one in found.identified] == ["offset_x"]
    assert found.study.instrument.offset_T[0] == found.identified[0].values[0]
    assert found.after.prior_conflict < found.after.conflict_limit < found.before.prior_conflict
