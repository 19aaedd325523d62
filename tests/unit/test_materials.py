"""Magnetization curves: tables refused by name, and laws that are what they are made from."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from halbach_fe import materials
from halbach_fe.materials import MU_0
from halbach_fe.observation import observe
from halbach_fe.response import _key
from halbach_fe.solve import Workshop
from tests.conftest import circle


def test_a_curve_that_bends_at_its_first_point_has_a_start():
    """Three points tell PCHIP a slope of zero at the origin, an infinite permeability."""
    H, B = np.array([100.0, 1e3, 5e3, 2e4]), np.array([1.0, 1.2, 1.5, 1.8])
    curve = materials.table_curve(H, B)
    first = B[0] / (MU_0 * H[0])
    assert first <= curve.initial <= first / materials.LEAST_START
    # the control: where PCHIP's slope is sound, it stays
    B = np.linspace(0, 1.5, 7)
    H = 200 * B * np.exp(B)
    slope = float(PchipInterpolator(B, H).derivative()(0.0))
    assert slope > materials.LEAST_START * H[1] / B[1]
    assert materials.table_curve(H, B).initial == pytest.approx(1 / (MU_0 * slope), rel=1e-12)


@pytest.mark.parametrize("law", ["reluctivity", "permeability"])
def test_any_argument_is_answered_without_a_warning(law):
    """From zero to the largest number; warnings are errors here."""
    law = getattr(materials.froehlich_kennelly(5000, 2.1), law)
    squares = np.array([0.0, 5e-324, 1e-250, 1.0, law.squares[-1], 1e100, 1e250,
                        np.finfo(float).max])
    for found in (law.coefficient(squares), law.slope(squares), law.differential(squares)):
        assert np.isfinite(found).all()
    np.testing.assert_allclose(law.coefficient(squares)[[0, -1]], [law.values[0], law.limit])
    np.testing.assert_allclose(law.differential(squares)[[0, -1]], [law.values[0], law.limit])


def test_a_stored_response_is_that_of_the_steels_numbers(dipole, tmp_path, monkeypatch, getdp):
    """Another table under the same name is another material."""
    study = dipole(iron_ring={"inner_radius_m": 0.2, "outer_radius_m": 0.24,
                              "curve": {"kind": "steel", "name": "aisi_1010"}})
    points = circle(0.05, 4)
    workshop = Workshop(getdp, tmp_path)

    def key():
        return _key(study, observe(study, points, np.ones_like(points, bool)), workshop)

    shipped = key()
    assert key() == shipped
    text = materials.steels()["aisi_1010"].read_text()
    other = tmp_path / "aisi_1010.csv"
    monkeypatch.setattr(materials, "steels", lambda: {"aisi_1010": other})
    other.write_text(text)
    assert key() == shipped
    other.write_text(text.replace("238.7,", "238.8,"))
    assert key() != shipped
