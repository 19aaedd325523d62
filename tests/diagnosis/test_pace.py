"""A diagnosis whose time is up."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.pace import Pace
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
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
