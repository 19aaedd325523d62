"""When a cause is named: quadrupoles by magpylib, whose truth no model of the fit computes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from halbach_fe.diagnosis import diagnose as module
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effect_comparison import (
    Search,
    amplitudes,
    with_further_causes,
    with_rivals,
)
from halbach_fe.diagnosis.effect_selection import Candidate, SelectedEffect
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis, Place
from halbach_fe.diagnosis.marginal_evidence import Evidence
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.probe_law import with_memory, without_memory
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.response import response_matrix as module_of_response
from halbach_fe.study.external_keys import Neighbour
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.reader import parse_study
from tests.conftest import circle
from tests.diagnosis.campaign import drawn, field
from tests.support.cuboids import DOCUMENT, NOISE_T

STUDY = parse_study(DOCUMENT | {
    "array": DOCUMENT["array"] | {"multipole_order": 2}, "inference": {"held_out": {"every": 4}}})
POINTS = np.vstack([circle(radius, 10, z, 0.1) for z in np.linspace(-0.14, 0.14, 9)
                    for radius in (0.04, 0.07)])
ALONG_Z = ("mapper_translation", "magnet_shifted", "ring_gap", "length", "z_scale", "gain_z",
           "wrong_line")


def some(*names):
    return [effect for effect in catalogue() if effect.name in names]


def map_of(readings, generator):
    return field_map(POINTS, readings + NOISE_T * generator.standard_normal(readings.shape))


def names_of(found):
    return [effect.hypothesis.effect.name for effect in found.identified]


def rings(polarizations, shifts):
    """B (n, 3) in T of rings that are displaced along z by lengths in m."""
    total = 0.0
    for number, shift in enumerate(shifts, start=1):
        own = [block.ring == number for block in build_magnet(STUDY).blocks]
        total = total + field(STUDY, polarizations * np.array(own)[:, None], POINTS - [0, 0, shift])
    return total


@pytest.mark.parametrize(("shifts", "named"), [
    ((-1e-3,) * 3, "mapper_translation"), ((-4e-4, 0.0, 0.0), "ring_gap")], ids=["all", "one"])
def test_what_moves_along_z_together_is_no_gap(session, generator, shifts, named):
    """A mapper 1 mm off: its x and y are exactly 0, and the magnet may have moved instead. Where
    one ring is away from the others, there is a gap.
    """
    data = map_of(rings(drawn(STUDY, generator), shifts), generator)
    found = diagnose(STUDY, data, session, effects=some(*ALONG_Z))
    assert names_of(found) == [named]
    effect, = found.identified
    others = set(effect.selection.effects) - {named}
    if named == "ring_gap":
        assert effect.hypothesis.place.ring == 1
        assert effect.values[0] == pytest.approx(4e-4, abs=4 * effect.sd[0])
        assert others == set()
        assert answer(found).trust.startswith("Yes")
        return
    assert others == {"magnet_shifted"}
    np.testing.assert_array_equal(effect.values[:2], 0)
    np.testing.assert_array_equal(effect.sd[:2], 0)
    assert effect.values[2] == pytest.approx(1e-3, abs=4 * effect.sd[2])
    assert "all blocks displaced along z together" in answer(found).trust
    assert not answer(found).trust.startswith("Yes")


def slow(readings, part):
    """What an instrument shows that covers all but a part of the way to every reading."""
    shown = [readings[0]]
    for reading in readings[1:]:
        shown.append(reading + part * (shown[-1] - reading))
    return np.array(shown)


@pytest.mark.parametrize("rows", [0.0, 3.0])
def test_the_memory_of_an_instrument(generator, rows):
    """Row by row, of rows that are not in the order of the scan and some readings missing."""
    readings, part, kept = generator.standard_normal((12, 3)), 0.3, np.exp(-1 / 3) if rows else 0.0
    mean, expected = readings[0], [readings[0]]
    for before, reading in pairwise(readings):
        mean = kept * mean + (1 - kept) * before
        expected.append((1 - part) * reading + part * mean)
    order = generator.permutation(12)
    instrument = Instrument(memory=part, memory_rows=rows)
    shown = with_memory(instrument, readings[order], order / 11)
    np.testing.assert_allclose(shown, np.array(expected)[order], atol=1e-12)
    np.testing.assert_allclose(without_memory(instrument, shown, order / 11), readings[order],
                               atol=1e-12)
    assert np.abs(shown - readings[order]).max() > 0.1
    missing = np.where(np.arange(12)[:, None] == 5, np.nan, readings)
    found = with_memory(instrument, missing, np.arange(12.0))
    np.testing.assert_allclose(np.delete(found, 5, axis=0), with_memory(
        instrument, np.delete(readings, 5, axis=0), np.arange(11.0)))
    assert np.isnan(found[5]).all()


SLOW = ("slow_readings", "inner_radius", "ferromagnetic_object", "mapper_translation", "lag",
        "gain_x", "gain_y", "mapper_roll", "eccentric_circle", "ring_gap")


@pytest.mark.parametrize("part", [1.5e-3, 0.0])
def test_a_slow_instrument_is_named(session, generator, part):
    data = map_of(slow(field(STUDY, drawn(STUDY, generator), POINTS), part), generator)
    found = diagnose(STUDY, data, session, effects=some(*SLOW))
    assert found.unknown is None
    if not part:  # the negative control
        assert names_of(found) == []
        return
    assert names_of(found) == ["slow_readings"]
    effect, = found.identified
    assert effect.values == pytest.approx([part], abs=4 * effect.sd[0])
    assert effect.sd[0] < part / 10
    assert answer(found).sound
    update = infer(build_magnet(found.study), data, session)
    assert update.prior_conflict < update.conflict_limit


def test_a_slow_instrument_outside_the_catalogue_is_unknown(session, generator):
    """Effects that resemble it are not named together in its place, or are not believed."""
    data = map_of(slow(field(STUDY, drawn(STUDY, generator), POINTS), 1.5e-3), generator)
    found = diagnose(STUDY, data, session, effects=some(*SLOW[1:]))
    told = answer(found)
    assert not told.sound
    assert names_of(found) == []
    assert found.unknown is not None
    assert found.unknown.kind != "field"


@pytest.mark.parametrize("there", [False, True])
def test_an_effect_that_predicts_worse_than_none_is_no_answer(
    session, generator, monkeypatch, there
):
    """A search that puts a gain of -5 % into the model, whether the map has it or not."""
    polarizations = drawn(STUDY, generator)
    true, shown = field(STUDY, polarizations, POINTS), np.array([0.95, 1, 1])
    gained = map_of(true * shown, generator)
    wrong = diagnose(STUDY, gained, session, effects=some("gain_x")).identified
    assert wrong[0].values == pytest.approx([-0.05], abs=0.01)
    for name in ("named_effects", "identify_effects"):
        monkeypatch.setattr(module, name, lambda *given: wrong)
    found = diagnose(STUDY, gained if there else map_of(true, generator), session,
                     effects=some("gain_x"))
    told = answer(found)
    assert found.after.prior_conflict < found.after.conflict_limit
    assert told.sound == there
    assert names_of(found) == ["gain_x"] * there  # the negative control
    assert (found.answer == found.rounds) == there
    assert ("Nothing that was compared explains the map" in told.said) != there


def test_bars_contain_that_a_part_may_not_be_zero():
    """Amplitude y shows little and looks like x: it is 0 in the likeliest part of half of the draws
    in which it is not, and then x is wrong by 25 of the bars of that part, which are the control.
    """
    generator = np.random.default_rng(1)
    columns = np.array([[100.0, 50.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 100.0]])
    effect = next(one for one in catalogue() if one.name == "sensor_position_x")
    candidate = Candidate(effect.name, "", (0, 1, 2), parts=((0, 2), (0, 1, 2)))
    found = []
    for draw in range(1000):
        true = generator.standard_normal(3) * [1, draw % 2, 1]  # both parts are equally probable
        residual = columns @ true + generator.standard_normal(3)
        search = Search((Hypothesis(effect, Place()),), (candidate,), Evidence.of(
            columns.T @ columns, columns.T @ residual, residual @ residual, 3), *[None] * 7)
        first = amplitudes(search, [SelectedEffect(candidate, 9.0, 9.0, ())])
        off = first[0].values[0] / effect.parameters[0].sd - true[0]
        found.append([off / (each[0].sd[0] / effect.parameters[0].sd)
                      for each in (first, with_rivals(search, first))])
    likeliest, every = np.sqrt(np.mean(np.square(found), axis=0))
    assert 0.85 < every < 1.15  # 0.02 by chance, and half of the prior is that of large amplitudes
    assert likeliest > 5


def test_bars_contain_that_a_cause_may_be_missing_which_nothing_shows():
    """A misalignment that looks like the named gain and is there in a tenth of the draws: without
    it in the bars, which is the control, the gain is off by 50 of them in these draws.
    """
    generator = np.random.default_rng(2)
    columns = np.array([[100.0, 50.0], [0.0, 1.0]])
    effects = [next(one for one in catalogue() if one.name == name)
               for name in ("gain_x", "misalignment_xy")]
    candidates = tuple(Candidate(one.name, "", (number,)) for number, one in enumerate(effects))
    found = []
    for draw in range(1000):
        true = generator.standard_normal(2) * [1, draw % 10 == 0]
        residual = columns @ true + generator.standard_normal(2)
        search = Search(tuple(Hypothesis(one, Place()) for one in effects), candidates,
                        Evidence.of(columns.T @ columns, columns.T @ residual,
                                    residual @ residual, 2), *[None] * 7)
        first = amplitudes(search, [SelectedEffect(candidates[0], 9.0, 9.0, ())])
        off = first[0].values[0] / effects[0].parameters[0].sd - true[0]
        found.append([off / (each[0].sd[0] / effects[0].parameters[0].sd) for each in (
            first, with_further_causes(search, first, np.array([0.0, 0.1])))])
    alone, mixed = np.sqrt(np.mean(np.square(found), axis=0))
    assert 0.75 < mixed < 1.2  # wide amplitudes have half of the prior, and are not drawn
    assert alone > 5


def test_blocks_of_a_neighbour_deviate(session, monkeypatch):
    """Truth by magpylib, with a neighbour whose blocks deviate: the update is as sure as it may be.
    As if they were nominal, which is the control, it is far off.
    """
    generator, middle = np.random.default_rng(3), 0.26
    true, other = drawn(STUDY, generator), drawn(STUDY, generator)
    away = field(STUDY, other, POINTS - [0.0, 0.0, middle])
    shown = field(STUDY, true, POINTS) + away
    data = field_map(POINTS, shown + NOISE_T * generator.standard_normal(shown.shape))
    stated = STUDY.with_(external__neighbours=(Neighbour(z_m=middle),))

    def chi2(folder):
        result = infer(build_magnet(stated), data, session.within(folder))
        off = true.ravel() / MU_0 - result.posterior.mean
        return off @ np.linalg.solve(result.posterior.covariance, off) / len(off)

    assert chi2("known") < 1.5  # of 36 to 108 magnetizations, whose sd is below 0.25
    monkeypatch.setattr(
        module_of_response, "neighbour_columns", lambda magnet, points, session: np.zeros(
            (*points.shape, len(magnet.nominal_magnetization))))
    assert chi2("nominal") > 3
