"""What the pages of shipped studies say first, which no command of halbach-fe writes."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report.page import write_files
from halbach_fe.stats.gaussian import Gaussian
from studies import magnetizations_page as magnetizations
from studies.calibration import calibration_page as calibration
from studies.diagnosis import sealed_cases_page as sealed_cases
from studies.sensitivity import sensitivity_page as sensitivity
from studies.sensitivity.sensitivity_page import Sensitivity
from tests.support.pages import answer_of, page
from tests.support.results import STUDY

RATES = {
    "naming_rate_single": 0.95, "single_cases": 40, "naming_rate_pairs": 0.9, "pair_cases": 10,
    "false_alarm_rate": 0.0, "clean_cases": 20, "unknown_rate": 1.0, "outside_cases": 12,
    "heldout_recovered_rate": 1.0, "recovered_of": 45, "yes_beside_wrong": 0.0, "cases": 80,
    "axis_coverage": 0.95, "axis_numbers": 200,
    "control_naming_rate_shuffled_labels": 0.05, "control_false_alarm_rate_without_blocks": 0.8}
CASES = [{"case": "000-gain", "hidden": ["gain"], "outside": "", "named": [["gain_x"]],
          "unknown": None, "chi2_before": 40.0, "chi2_after": 1.0}]


def calibrated(**changes):
    """Results of a posterior that is right, and of a control that fails, with changes."""
    row = {"repeats": 300, "p_value": 0.4, "model_error_over_noise": 0.25, "as_expected": True}
    return {"linear": row | changes.get("linear", {}),
            "control: too short": row | {"p_value": 1e-34} | changes.get("control", {})}


def test_calibration_says_whether_error_bars_hold(tmp_path):
    ranks = {name: np.random.default_rng(1).integers(0, 20, (50, 8)) for name in calibrated()}
    write_files(calibration.page(ranks, 19, calibrated()), tmp_path)
    text = page(tmp_path / "calibration.html")
    assert answer_of(tmp_path / "calibration.html")["said"].startswith("Yes: ")
    assert "p = 0.4 of 300 magnets" in text
    assert "1e-34" not in text
    assert calibration.answer(calibrated()).sound


@pytest.mark.parametrize(("changes", "part"), [
    ({"linear": {"as_expected": False, "p_value": 1e-9}}, "said"),
    ({"control": {"as_expected": False, "p_value": 0.3}}, "trust")])
def test_a_calibration_that_is_off_is_a_warning(changes, part):
    found = calibration.answer(calibrated(**changes))
    assert getattr(found, part).startswith("No: ")
    assert not found.sound


def test_sealed_cases_say_how_sure_their_rates_are(tmp_path):
    bins = [{"stated": 0.9, "happened": 1.0, "statements": 20}]
    write_files(sealed_cases.page(STUDY, CASES, RATES, bins, bins, {("gain", ("gain_x",)): 1}),
                tmp_path)
    text = page(tmp_path / "sealed_cases.html")
    said = answer_of(tmp_path / "sealed_cases.html")["said"]
    # Clopper and Pearson's interval for 38 of 40, and 1 - 0.025^(1/20) for 0 of 20
    for number in ("95.0\u00a0% of 40", "83.1\u00a0% to 99.4\u00a0%", "0.0\u00a0% of 20",
                   "16.8\u00a0%"):
        assert number in said
    assert "sensitivity of the Bx sensor" in text
    for code in ("gain_x", "naming_rate", "naming rate"):
        assert code not in text


@pytest.mark.parametrize(("changes", "sound"), [
    ({}, True), ({"naming_rate_single": 0.5}, False), ({"false_alarm_rate": 0.3}, False),
    ({"control_naming_rate_shuffled_labels": 0.6}, False),
    ({"control_false_alarm_rate_without_blocks": 0.0}, False),
    ({"control_false_alarm_rate_without_blocks": float("nan")}, False)])
def test_rates_and_controls_decide_whether_the_diagnosis_is_trusted(changes, sound):
    assert sealed_cases.answer(RATES | changes).sound == sound


@pytest.mark.parametrize(("wrong_by", "sound"), [(1.0, True), (3.0, False)])
def test_magnetizations_whose_error_bars_are_too_small_are_a_warning(tmp_path, wrong_by, sound):
    magnet = build_magnet(STUDY)
    nominal = np.concatenate([block.magnetization[:2] for block in magnet.blocks])
    after = Gaussian(nominal, 500.0 * np.eye(len(nominal)))
    truth = nominal + wrong_by * 500.0 * np.where(np.arange(len(nominal)) % 2, 1, -1)
    known = {"prior": Gaussian(nominal, 1e4 * np.eye(len(nominal))), "posterior": after}
    write_files(magnetizations.page(magnet, known, truth, "test"), tmp_path)
    found = answer_of(tmp_path / "magnetizations.html")
    assert found["trust"].startswith("Yes: " if sound else "No: ")
    assert f"{0.5 * wrong_by:.2g}\u00a0kA/m" in found["said"]
    # independent errors spread by 1 / sqrt(2 n); common ones, which the mean of few has, by more
    assert magnetizations.expected_spread(after) == pytest.approx((2 * len(nominal)) ** -0.5)
    common = Gaussian(nominal, np.ones((len(nominal), 1)))
    assert magnetizations.expected_spread(common) == pytest.approx(0.5**0.5)


def test_sensitivity_says_what_a_block_changes_and_where_to_measure(tmp_path):
    plan = {"points": 12, "study_points": 15, "points_with_the_study_information": 9}
    plans = {"on the circle": plan | {"mean_sd_over_study_with_as_many_points": 0.98,
                                      "points_with_the_study_information": None},
             "anywhere": plan | {"mean_sd_over_study_with_as_many_points": 0.41}}
    axis, angle = np.linspace(-0.1, 0.1, 5), np.linspace(0, 6, 8)
    gain = np.arange(1, 4), np.arange(3.0)
    write_files(sensitivity.page(build_magnet(STUDY), Sensitivity(
        1, axis, axis, np.full((5, 5), 1e-9), angle, np.full((8, 4), 2e-3), np.full((8, 4), 3e-3),
        0.1, {"anywhere": gain}, 8), plans), tmp_path)
    text = page(tmp_path / "sensitivity.html")
    assert "nats" not in text
    first, second = sensitivity.plan_rows(plans)
    assert list(first.values()) == ["on the circle", "12", "more than 12", "98.0\u00a0%"]
    assert list(second.values()) == ["anywhere", "12", "9", "41.0\u00a0%"]
    assert any("the 15 of the circle" in name for name in first)
    said = answer_of(tmp_path / "sensitivity.html")["said"]
    for number in ("2\u00a0mT", "3\u00a0mT", "anywhere", "41.0\u00a0%"):
        assert number in said
