"""Maps whose stage has another scale along an axis than they state, by magpylib.

Such a map was read as one of a probe with other gains: +0.7 % of Bz where z was 1 % too long.
"""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.measurement import map_check
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.map_check import check_map
from halbach_fe.report.map_check_page import STRETCHED, answer, sentences
from tests.support import cube_dipole
from tests.support.hard_maps import quadrupole, serpentine
from tests.support.short_dipole import truth

NOISE = 1e-4
"""Noise relative to the median field."""
PERFECT = np.zeros(3)
OF_BZ = np.array([0.0, 0.0, 0.01])
GAIN, SCALE = "gain of Bz relative to that of |B|", "scale of the stage along z"


def lines(across, along):
    return serpentine(across, across, along, lambda point: np.array([True]))


def magnet_of(kind):
    """A magnet of magpylib with errors of its blocks, and the points of a map."""
    generator = np.random.default_rng(0)
    if kind == "dipole":  # from within the bore to 50 mm before it
        return truth(generator), lines(0.005 * np.arange(-2, 3), 0.006 * np.arange(4, 14))
    if kind == "quadrupole":
        return quadrupole(generator)[0].__self__, lines(
            0.004 * np.arange(-3, 4), 0.006 * np.arange(-2, 7))
    return cube_dipole.cubes(generator), lines(
        0.008 * np.arange(-3, 4), 0.008 * np.arange(-5, 6))


KINDS = ["dipole", "quadrupole", "cubes"]


def mapped(kind, scale=PERFECT, gain=PERFECT):
    """A map of a stage that states places which are ``1 + scale`` times the true ones, from the
    middle of the map, by a probe of some gains; and what a perfect probe reads where it states.
    """
    magnet, points = magnet_of(kind)
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    read = magnet.getB(middle + (points - middle) / (1 + scale)) * (1 + gain)
    noise = NOISE * np.median(np.linalg.norm(read, axis=1))
    read += noise * np.random.default_rng(7).standard_normal(read.shape)
    return field_map(points, read), magnet.getB(points)


def found(check):
    return {term.name: term for term in check.terms if term.found}


def share_of_bz(field):
    return float(np.mean(field[:, 2]**2) / np.mean(np.sum(field**2, axis=1)))


def off(values, truth_T):
    return float(np.sqrt(np.mean((values - truth_T)**2)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_stage_that_is_one_per_cent_too_long_is_no_gain(kind):
    """It is found as what it is, nothing beside it, and the corrected map is that of the magnet."""
    data, ideal = mapped(kind, scale=OF_BZ)
    check = check_map(data)
    (term,) = found(check).values()
    assert term.name == SCALE
    assert abs(term.value - 100 * (1 / 1.01 - 1)) < 2 * term.sd
    assert not any(each.rivals for each in check.terms)
    # 2 to 5 % of the error were left
    assert off(check.corrected_T, ideal) < 0.1 * off(data["B_T"].values, ideal)
    assert STRETCHED in sentences(check)
    assert "corrected_map.csv, without the scale of the stage" in answer(check).step


@pytest.mark.parametrize("kind", KINDS)
def test_a_third_of_a_per_cent_is_found_or_told_beside_what_does_the_same(kind):
    """No gain is found, and where the map does not tell, nothing is corrected."""
    data, ideal = mapped(kind, scale=0.3 * OF_BZ)
    check = check_map(data)
    (term,) = (each for each in check.terms if each.name == SCALE)
    assert found(check).keys() <= {SCALE}
    assert abs(term.value - 100 * (1 / 1.003 - 1)) < 2 * term.sd
    read = off(data["B_T"].values, ideal)
    if term.found:
        assert off(check.corrected_T, ideal) < 0.2 * read
    else:
        assert GAIN in term.rivals
        assert off(check.corrected_T, ideal) == pytest.approx(read, rel=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_a_gain_is_found_as_one(kind):
    """The bar holds it; the control is a perfect probe on a perfect stage."""
    data, ideal = mapped(kind, gain=OF_BZ)
    check = check_map(data)
    assert {name.partition(" ")[0] for name in found(check)} == {"gain"}
    term = found(check)[GAIN]
    assert abs(term.value - (1 - share_of_bz(ideal))) < 2 * term.sd
    assert STRETCHED not in sentences(check)
    control = check_map(mapped(kind)[0])
    assert not found(control)
    assert not any(each.rivals for each in control.terms)


@pytest.mark.parametrize("contained", [True, False])
def test_bars_of_gains_contain_what_a_stage_may_be_off(monkeypatch, contained):
    """A stage 0.1 % too long, beside a gain of 1 %; the control leaves it out of the bar."""
    if not contained:
        monkeypatch.setattr(map_check, "_beside_likes", lambda _, terms: terms)
    data, ideal = mapped("dipole", scale=0.1 * OF_BZ, gain=OF_BZ)
    term = found(check_map(data))[GAIN]
    assert (abs(term.value - (1 - share_of_bz(ideal))) < 2 * term.sd) == contained


def test_a_map_of_two_components_tells_no_scale():
    """Their gains are not asked, and one that is off must not be taken for a scale."""
    data, _ = mapped("quadrupole", gain=OF_BZ)
    data["B_T"][:, 1] = np.nan
    assert not found(check_map(data))
