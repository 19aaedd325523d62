"""Effects that are judged by a rough signature before they are solved for.

The maps are of the model that fits them, as only the steps of the search are tested. Rough
signatures are compared with exact ones in test_screening.
"""

from __future__ import annotations

import pytest

from halbach_fe.core.progress import Pace
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect, Place
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map
from halbach_fe.solver.exact_block_field import field_of
from tests.diagnosis.campaign import CIRCLES, NOISE_T, STUDY

RADIUS_M = 6e-4


INNER_RADIUS = next(effect for effect in catalogue() if effect.name == "inner_radius")


class SlowInnerRadius(Effect):
    """The inner radius, as if its signature took minutes; it counts how often it is computed."""

    name, title, kind = INNER_RADIUS.name, INNER_RADIUS.title, INNER_RADIUS.kind
    parameters = INNER_RADIUS.parameters
    apply = staticmethod(INNER_RADIUS.apply)
    solved = 0

    def signature(self, nominal, place):
        self.solved += 1
        return INNER_RADIUS.signature(nominal, place)

    def rough_signature(self, nominal, place):
        return -7.0 * INNER_RADIUS.signature(nominal, place) + 1e-4 * nominal.field


def map_with(generator, radius_m=0.0, offset_T=0.0):
    study = INNER_RADIUS.apply(STUDY, Place(), [radius_m])
    noise = NOISE_T * generator.standard_normal(CIRCLES.shape)
    return field_map(CIRCLES, field_of(build_magnet(study).blocks, CIRCLES) + noise
                     + [offset_T, 0.0, 0.0])


def diagnosed(data, session):
    effect = SlowInnerRadius()
    found = diagnose(STUDY, data, session, effects=[
        effect, *(one for one in catalogue() if one.name in ("offset_x", "gain_y"))])
    return effect, found


def names(found):
    return [one.hypothesis.effect.name for one in found.identified]


def test_what_is_missing_is_solved_for(session, generator):
    effect, found = diagnosed(map_with(generator, RADIUS_M), session)
    assert effect.solved > 0
    assert names(found) == ["inner_radius"]
    assert found.identified[0].values == pytest.approx(
        [RADIUS_M], abs=4 * found.identified[0].sd[0])
    assert found.uncompared is None


def test_what_explains_nothing_is_not_solved_for(session, generator):
    """It counts as compared; the control is the test above."""
    effect, found = diagnosed(map_with(generator, offset_T=4e-4), session)
    assert effect.solved == 0
    assert names(found) == ["offset_x"]
    assert found.uncompared is None
    assert "inner_radius" in found.probabilities


@pytest.mark.parametrize(("radius_m", "offset_T", "uncompared", "named"), [
    (RADIUS_M, 0.0, 1, []), (0.0, 4e-4, 0, ["offset_x"])])
def test_what_is_near_is_left_out_if_the_time_is_up(
    session, generator, monkeypatch, radius_m, offset_T, uncompared, named
):
    """The time is up once all signatures are known, and before any is computed again.

    An effect that may be what is missing counts as not compared, and is not named by its rough
    signature; one that explains nothing counts as compared, in the closing round as well.
    """
    computed = []
    rough = SlowInnerRadius.rough_signature

    def last(self, nominal, place):
        computed.append(place)
        return rough(self, nominal, place)

    monkeypatch.setattr(Pace, "is_over", property(lambda _: bool(computed)))
    monkeypatch.setattr(SlowInnerRadius, "rough_signature", last)
    effect = SlowInnerRadius()
    some = [one for one in catalogue() if one.name in ("offset_x", "gain_y")]
    found = diagnose(STUDY, map_with(generator, radius_m, offset_T), session,
                     effects=[*some, effect])
    assert effect.solved == 0
    assert found.uncompared == uncompared
    assert names(found) == named
