"""P-values of many tests against scipy's; samples of blocks are tested in tests/inference."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import false_discovery_control

from halbach_fe.stats.gaussian import false_discovery_rates


@pytest.mark.parametrize("count", [1, 2, 40])
def test_false_discovery_rates_are_those_of_scipy(generator, count):
    p = generator.uniform(size=count)**3
    np.testing.assert_allclose(false_discovery_rates(p), false_discovery_control(p), rtol=1e-12)
    if count > 2:  # negative control: the values of single tests
        assert np.abs(p - false_discovery_control(p)).max() > 0.01


def test_no_test_has_no_rate():
    assert len(false_discovery_rates(np.zeros(0))) == 0
