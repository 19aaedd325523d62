"""Reliability of stated probabilities: right ones pass, over-confident ones do not."""

from __future__ import annotations

import numpy as np
import pytest

from studies.diagnosis.stated_probabilities import (
    Bin,
    error_if_calibrated,
    expected_calibration_error,
    frequencies,
)

EDGES = (0.0, 0.3, 0.5, 0.7, 0.9, 0.98, 1.001)


def test_two_bins_by_hand():
    bins = frequencies(np.array([0.6, 0.6, 0.95, 0.95, 0.95, 0.95]),
                       np.array([True, False, True, True, True, True]), EDGES)
    assert bins == (Bin(pytest.approx(0.6), 0.5, 2), Bin(pytest.approx(0.95), 1.0, 4))
    assert expected_calibration_error(bins) == pytest.approx((2 * 0.1 + 4 * 0.05) / 6)
    assert np.isnan(expected_calibration_error(()))
    assert np.isnan(error_if_calibrated(np.zeros(0), EDGES, np.random.default_rng(0)))


@pytest.mark.parametrize(("count", "limit"), [(100, 0.15), (4000, 0.03)])
def test_limit_of_the_error_by_chance(generator, count, limit):
    """Right probabilities are above the 95 % limit in 5 % of cases: of 200, 10 +- 3; 4 sigma. The
    limit falls with the number of statements: measured 0.12 and 0.02.
    """
    stated = generator.uniform(0.2, 1, count)
    most = error_if_calibrated(stated, EDGES, generator)
    assert most < limit
    above = sum(expected_calibration_error(frequencies(
        stated, generator.random(count) < stated, EDGES)) > most for _ in range(200))
    assert above < 10 + 4 * 3.1


def test_over_confident_statements_are_above_it(generator):
    """Negative control: the log odds that are stated are three times the true ones."""
    true = generator.uniform(0.5, 0.98, 120)
    odds = (true / (1 - true)) ** 3
    stated = odds / (1 + odds)
    limit = error_if_calibrated(stated, EDGES, generator)
    happened = generator.random(len(true)) < true
    # the stated probabilities are 0.15 too high on average, where the limit is some 0.06
    assert expected_calibration_error(frequencies(stated, happened, EDGES)) > 1.5 * limit
