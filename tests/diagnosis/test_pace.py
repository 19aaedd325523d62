"""A diagnosis whose time is up."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.progress import Pace
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect, Parameter
from halbach_fe.measurement.field_map import field_map, points_of
from tests.diagnosis.campaign import STUDY, measured


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


class Slow(Effect):
    """Takes all the time that there is for a signature, which is 0."""

    name = "a_slow_one"
    title = "what has to be solved"
    kind = "field"
    parameters = (Parameter("amount", "1", 1.0),)

    def __init__(self, is_solved):
        self.is_solved, self.done = is_solved, False

    def signature(self, nominal, place):
        self.done = True
        return np.zeros((1, *nominal.points.shape))

    def apply(self, study, place, values):
        return study


@pytest.mark.parametrize("is_solved", [False, True])
def test_what_has_to_be_solved_is_compared_last(session, generator, monkeypatch, is_solved):
    """It is the first by its name; were it the first in time, there would be none for the others,
    as there is none if it does not say that it has to be solved.
    """
    slow, data = Slow(is_solved), measured(STUDY, generator)
    data = field_map(points_of(data), np.add(data["B_T"].values, [4e-4, 0.0, 0.0]))
    some = [effect for effect in catalogue() if effect.name in ("gain_x", "offset_x", "z_scale")]
    monkeypatch.setattr(Pace, "is_over", property(lambda _: slow.done))
    found = diagnose(STUDY, data, session, effects=[slow, *some])
    assert found.uncompared == (0 if is_solved else 3)
    assert [one.hypothesis.effect.name for one in found.identified] == ["offset_x"] * is_solved
