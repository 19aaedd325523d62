"""Magnetization curves: tables refused by name, and laws that are what they are made from."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe import materials
from halbach_fe.materials import MU_0


def test_a_curve_that_bends_at_its_first_point_has_a_start():
    """Three points tell PCHIP a slope of zero at the origin, an infinite permeability."""
    H, B = np.array([100.0, 1e3, 5e3, 2e4]), np.array([1.0, 1.2, 1.5, 1.8])
    curve = materials.table_curve(H, B)
    first = B[0] / (MU_0 * H[0])
    assert first <= curve.initial <= first / materials.LEAST_START
    # the control: where the slope is sound, it stays PCHIP's
    assert materials.table_curve(H := B * np.exp(B) * 1e3, B).initial == pytest.approx(
        1 / (MU_0 * float(materials.PchipInterpolator(
            np.append(0, B), np.append(0, H)).derivative()(0.0))), rel=1e-12)
