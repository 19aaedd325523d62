"""The sentences that begin the page of an inference, beside the numbers that they are about."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.result import HELD_OUT, Amplitudes, InferenceResult, Stretch, far_in_words
from halbach_fe.report.inference_answer import answer
from halbach_fe.report.inference_page import score_table, term_table
from halbach_fe.report.words import flux_density, ppm
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.conftest import changed
from tests.support import cuboids


@pytest.fixture(scope="module")
def campaign():
    return simulate_campaign(parse_study(cuboids.DOCUMENT), 4)


def answered(campaign, session, **changes):
    study = parse_study(changed(cuboids.DOCUMENT, **changes))
    result = infer(build_magnet(study), campaign.readings, session)
    return result, answer(result)


def test_the_numbers_are_those_of_the_prediction(campaign, session):
    held_out = {"scan_lines_every": 5}
    result, said = answered(campaign, session, inference={"held_out": held_out})
    unseen = result.held_out
    off = 1e6 * np.sqrt(np.mean((result.readings - result.prediction_posterior.mean)[unseen]**2))
    assert f"predicts {unseen.sum()} readings that were held out" in said.said
    assert f"to {off:#.3g}\u00a0µT rms".replace(".\u00a0", "\u00a0") in said.said
    # 5 % of some hundred readings: 95 ± 3 %
    (share,) = re.findall(r"holds ([\d.]+)", said.said)
    assert 85 < float(share) <= 100
    ring, slot, value, sd = re.search(
        r"most ring (\d+), slot (\d+) by ([-+][\d.]+)\s±\s([\d.]+)", said.said).groups()
    block = result.magnet.number_of(int(ring), int(slot))
    nominal = result.by_block(result.response.nominal)[block]
    found = result.by_block(result.posterior.mean)[block]
    along = 100 * (found @ nominal / (nominal @ nominal) - 1)
    assert float(value) == pytest.approx(along, abs=0.05)
    assert 0 < float(sd) < 1.5  # the prior's is 1.4 %
    assert "Model and readings agree" in said.trust
    assert re.match(r"The strongest component .* mT\. The updated magnet predicts", said.said)
    assert said.sound


def test_without_a_test_it_says_so(campaign, session):
    _, said = answered(campaign, session)
    assert "No reading was held out" in said.trust


def test_another_magnet_is_to_be_diagnosed(campaign, session):
    _, said = answered(campaign, session, array__ring_length_m=0.066)
    assert "halbach-fe diagnose" in said.command
    assert not said.sound
    assert said.said.startswith("Model and measurement disagree")
    assert "agree:" not in said.trust


def test_noise_that_is_stated_too_large_is_no_disagreement(campaign, session):
    """The step finds the noise; a model that lacks something is no reason for it."""
    result, said = answered(campaign, session, noise={"regions": [
        {"name": "all", "sigma_T": 1e3 * cuboids.NOISE_T}]})
    assert result.disagreement == result.too_near
    assert said.said.startswith("Model and measurement agree better than the stated noise allows")
    assert "halbach-fe check" in said.command
    assert "else read the probe repeatedly" in said.step  # of coarse maps it does not tell
    assert not said.sound


@pytest.mark.parametrize(("from_m", "to_m", "said"), [
    (-0.0141, -0.0141, "x = −14 mm"), (-1e-5, 1e-5, "x = 0 mm"), (-0.02, 0.01, "x = −20 to 10 mm")])
def test_where_a_stretch_is(from_m, to_m, said):
    """On one plane of circles "x = −14 to −14 mm" was said, and "−0 to −0"."""
    assert Stretch("x", from_m, to_m, 3, 1e-5, 1e-6).where == said


def test_few_readings_are_near_the_model_by_chance(campaign, session):
    """A single reading was said to have too much noise in a quarter of all maps: chi-squared of one
    degree of freedom is below a tenth with that probability. Control: far nearer than chance.
    """
    result, _ = answered(campaign, session)
    few = np.ones(len(result.held_out), bool)
    for readings, chi2, said in ((1, 0.02, False), (3, 0.05, False), (3, 1e-6, True),
                                 (9, 1e-3, True), (200, 0.09, True)):
        held_out = few.copy()
        held_out[:readings] = False
        one = replace(result, prior_conflict=chi2)
        vars(one).update(held_out=held_out, noise_ratio=np.nan)  # the other measure of the noise
        assert bool(one.too_near) == said


def test_the_table_has_the_chi2_of_the_answer(campaign, session):
    """In the row of all training readings, whether there are several noise regions or one."""
    regions = [{"name": name, "sigma_T": cuboids.NOISE_T} | limits for name, limits in (
        ("end", {"z_max_m": -0.05}), ("rest", {"z_min_m": -0.05}))]
    for noise, count in (({}, 1), ({"noise__regions": regions}, 3)):
        result, said = answered(campaign, session, **noise)
        *others, last = score_table(result)
        assert len(others) == count - 1
        value = last["chi²/reading, before"]
        assert f"before the update is {value}," in said.trust
        # the control: the mean square of the residuals after the update is less
        left = result.standardized(result.prediction_posterior)[~result.held_out]
        assert f"{np.mean(left**2):.3g}" != value
        assert last["readings"] == f"{len(left)}\u00a0training"
        assert last["chi²/reading, after"] == "–"


def test_answer_and_table_have_the_same_numbers(campaign, session):
    """With the same unit and digits; numbers that end with 0 too."""
    result, said = answered(campaign, session)
    part = HELD_OUT if result.held_out.any() else "training"
    row = next(row for row in score_table(result) if part in row["readings"].replace("\u00a0", " "))
    for column in ("before, rms", "after, rms"):
        assert row[column] in said.said
    assert flux_density(1.1e-3, zeros=True) == "1.10\u00a0mT"
    assert flux_density(1.1e-4, zeros=True) == "110\u00a0µT"
    assert flux_density(0.0, zeros=True) == "0\u00a0mT"
    assert flux_density(6.1e-6) == "6.1\u00a0µT"
    assert [ppm(value) for value in (999.4, 999.6, 1030.0)] == ["999", "1\u202f000", "1\u202f030"]


@pytest.mark.parametrize(("change", "key", "told"), [
    (9.0, "array.exceptions[1].shift_m[3]", False), (-11.0, "array.exceptions[1].shift_m[3]", True),
    (-11.0, "external.coils[1].current_A", False)])  # the field is linear in a current
def test_amplitudes_that_were_moved_far(change, key, told):
    found = SimpleNamespace(names=("gap", "other"), change=np.array([change, 1.0]), sd=np.ones(2))
    study = SimpleNamespace(uncertain=[
        SimpleNamespace(name=name, change={key: 1.0}) for name in found.names])
    names = InferenceResult.far_amplitudes.fget(SimpleNamespace(amplitudes=found, study=study))
    assert names == (("gap",) if told else ())
    assert ("moved gap by more than 10 error bars" in far_in_words(names)) == told
    assert InferenceResult.far_amplitudes.fget(SimpleNamespace(amplitudes=None)) == ()


@pytest.mark.parametrize(("name", "key", "said"), [
    ("temperature.difference_K", "array.remanence_T", "-2.5000 ± 1.0000 K"),
    ("2. temperature.difference_K", "array.remanence_T", "-2.5000 ± 1.0000 K"),
    ("ring_shifted r01.x_m", "array.exceptions[1].shift_m[1]", "-2500.0000 ± 1000.0000 mm"),
    ("ring_tilted r01.x_rad", "array.exceptions[1].tilt_rad[1]", "-2500.0000 ± 1000.0000 mrad"),
    ("drift.x_T", "instrument.drift_T[1]", "-2500.0000 ± 1000.0000 mT"),
    ("ferromagnetic_object.x_A_m2", "external.dipoles[1].moment_A_m2[1]", "-2.5000 ± 1.0000 A m²"),
    ("planar_hall_x.coefficient_1/T", "instrument.planar_hall_per_T[1]",
     "-250.0000 ± 100.0000 %/T"),
    ("cubic_nonlinearity_x.coefficient_1/T^2", "instrument.cubic_per_T2[1]",
     "-250.0000 ± 100.0000 %/T²"),
    ("gain_x.gain", "instrument.gain[1]", "-250.0000 ± 100.0000 %"),
    # names of one's own, without a unit: that of the key
    ("current", "external.coils[1].current_A", "-2.5000 ± 1.0000 A"),
    ("oven", "demagnetization.temperature_C", "-2.5000 ± 1.0000 °C"),
    ("turned", "array.angle_deg", "-2.5000 ± 1.0000 °"),
    ("glue", "array.exceptions[1].shift_m[3]", "-2500.0000 ± 1000.0000 mm"),
    ("coercivity", "array.normal_coercivity_A_per_m", "-0.0025 ± 0.0010 kA/m"),
    ("slope", "array.remanence_coefficient_per_K", "-250.0000 ± 100.0000 %/K"),
    ("all", "array.magnetization_factor", "-250.0000 ± 100.0000 %")])
def test_amplitudes_have_the_unit_of_their_key(name, key, said):
    """By the unit at the end of the name, otherwise of the number that changes as they do."""
    def table(change):
        found = Amplitudes((name,), *(np.array([value]) for value in (-2.5, 1.0, 10.0)))
        return term_table(SimpleNamespace(
            terms=None, amplitudes=found, study=SimpleNamespace(
                uncertain=[SimpleNamespace(name=name, change=change)])))[0]

    row = table({key: 1.0})
    assert row["change from the study"] == said
    assert row["known before"].endswith(said.rpartition("0 ")[2])
    assert not re.search("_|/T|m2", row["term"])
    if "." not in name:  # a share of another change
        assert table({key: 3e-4})["change from the study"].endswith(" %")
