"""Simulation-based calibration of the linear posterior, small; the study has all of it."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
from halbach_fe.stats.gaussian import nominal_prior
from halbach_fe.study.reader import read_study
from studies.calibration.truth_ranks import ranks, uniformity
from tests.conftest import ROOT, module_of

BLOCK_SIZE_M = 0.014
"""Coarser than the study's, but the model's error is still below the noise."""


@pytest.fixture(scope="module")
def calibration():
    return module_of("calibration_study", ROOT / "studies" / "calibration" / "run.py")


@pytest.fixture(scope="module")
def study(calibration):
    return read_study(calibration.STUDY).with_(
        mesh__block_size_m=BLOCK_SIZE_M, observation__positions__radius_m=calibration.RADIUS_M)


@pytest.mark.parametrize("permeability", [1.0, 1000.0])
def test_truth_at_any_point(calibration, study, permeability):
    """The series from the circle is the closed form at points within it, to rounding of a sum of
    192 terms; the points' mirror images are the control.
    """
    magnet = build_magnet(study)
    prior_mean = calibration.nominal_magnetizations(magnet)
    points = 0.06 * np.array([[1.0, 0.2, 0], [-0.7, 1.2, 0], [0.0, 0.0, 0]])
    truth = calibration.closed_form_truth(magnet, permeability)
    expected = layered_bore_field(
        ideal_sectors(1, 16, 1.06, np.pi / 2, np.pi), 0.104, 0.1865, 1.05, points[:, :2],
        (0.19, 0.215, permeability))
    np.testing.assert_allclose(truth.field(prior_mean, points)[:, :2], expected, atol=1e-9)
    mirrored = truth.field(prior_mean, points * [1, -1, 1])[:, :2]
    assert np.abs(mirrored - expected).max() > 1e-4


def test_linear_posterior_is_calibrated(calibration, study, session):
    """Truths by the closed form, read at moved points: the ranks are uniform with the noise of
    positions and the error of the mesh in the posterior, and are not without them (the controls).
    The limits are those of the study, whose 500 truths leave more of a margin.
    """
    generator = np.random.default_rng(3)
    prior = nominal_prior(calibration.nominal_magnetizations(build_magnet(study)), 2, 0.01, 1.0)
    cases = calibration.linear_cases(study, session, prior, 150)
    assert sum(case.good for case in cases.values()) == 1
    for case in cases.values():
        _, p_value = uniformity(*ranks(
            prior, case.simulate, case.sampler, case.repeats, generator))
        assert p_value > calibration.PASS if case.good else p_value < calibration.FAIL
