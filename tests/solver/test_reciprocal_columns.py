"""Columns by reciprocity against those of solves for blocks, and when they are taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.core.errors import GetDPError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.symmetry import unique_points
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.response.resource_estimate import decisive_points
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver import iron_modes, routes
from halbach_fe.solver.azimuthal_modes import meridian_points, solve_modes
from halbach_fe.solver.getdp_cache import Cache
from halbach_fe.solver.iron_modes import angle_integrals, reciprocal_gradients, saves_solves
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from tests.conftest import changed, circle

IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}
POINTS = np.vstack([circle(0.05, 5, z, 0.2 + z) for z in (-0.12, 0.0, 0.05)]
                   + [[[0.0, 0.0, 0.03]], circle(0.09, 3, 0.01)])
"""On circles and on the axis, between grid lines and beside the blocks."""


@pytest.fixture
def magnet_of(short_dipole):
    """Magnets that azimuthal modes solve, with changes to the study; ``tables`` are its rings."""
    def magnet(tables=None, **changes):
        study = short_dipole(
            **{"mesh__meridian_size_m": 0.03, "solver__route": "azimuthal_modes"} | changes)
        if tables is None:
            return build_magnet(study)
        document = study.model_dump(mode="json", exclude_unset=True)
        del document["array"]["rings"]
        return build_magnet(parse_study(changed(document, array__ring=tables)))

    return magnet


@pytest.mark.parametrize("changes", [
    {"iron_ring": IRON}, {"array__recoil_permeability": 1.1, "solver__method": "direct"},
    {"tables": [{}, {"recoil_permeability": 1.3, "blocks_per_ring": 8}]}],
    ids=["iron", "direct", "unequal rings"])
def test_columns_equal_those_of_blocks(magnet_of, session, changes):
    """The discrete problem is the same: only rounding remains. Blocks exchanged are the control."""
    magnet, blocks = magnet_of(**changes), [0, 5, 16, 22]
    forward = solve_modes(magnet, POINTS, blocks, session, highest=4)
    found = solve_modes(magnet, POINTS, blocks, session, 4, reciprocal_gradients)
    scale = np.abs(forward[1:]).max()
    assert np.abs(found - forward).max() < 1e-10 * scale
    assert np.abs(np.roll(found[1:], 3, axis=0) - forward[1:]).max() > 0.1 * scale


def test_the_response_takes_them(magnet_of, session, monkeypatch, tmp_path):
    """They are taken where they save solves, and add up to the nominal array that GetDP solves for.

    Rounding only. Control: the columns of other modes do not add up, and are refused.
    """
    magnet = magnet_of(iron_ring=IRON)
    session = replace(session, cache=Cache(tmp_path / "cache"))  # solves for the array once
    points = POINTS[:16] * [0.3, 0.3, 1]  # near the axis few modes matter
    observation = observe(magnet.study, points, np.ones((len(points), 3), bool))
    forward = response_matrix(magnet, observation, session.within("forward"))
    monkeypatch.setattr(iron_modes, "SAVED_SOLVES", -1000)
    taken = []

    def gradients(case, session, shift=0):
        taken.append(len(case.meridian))
        found = reciprocal_gradients(case, session)
        return {m: found[max(0, m - shift)] for m in found}

    monkeypatch.setattr(routes, "reciprocal_gradients", gradients)
    found = response_matrix(magnet, observation, session.within("reciprocal"))
    assert taken == [7]  # four (r, z), mirrored in z, of which that of z = 0 is its own image
    assert found.superposition_error < 1e-9
    assert np.abs(found.matrix - forward.matrix).max() < 1e-10 * np.abs(forward.matrix).max()
    np.testing.assert_allclose(found.error, forward.error, rtol=1e-6)
    monkeypatch.setattr(routes, "reciprocal_gradients",
                        lambda case, session: gradients(case, session, shift=1))
    with pytest.raises(GetDPError, match="do not add up"):
        response_matrix(magnet, observation, session.within("wrong"))


def test_when_they_save_solves(magnet_of):
    """Many rings and few places; neither with few rings nor with a place for every reading."""
    long, blocks = magnet_of(array__rings=200), range(0, 1600, 16)
    scattered = np.random.default_rng(3).uniform(-0.05, 0.05, (300, 3))
    assert saves_solves(long, POINTS, blocks)
    assert not saves_solves(long, scattered, blocks)
    assert not saves_solves(long, POINTS, blocks[:8])
    assert not saves_solves(magnet_of(), POINTS, range(32))


def test_an_estimate_takes_the_same_way(magnet_of):
    """Its few points decide as the map does: all places of a few, and enough of many."""
    long, blocks = magnet_of(array__rings=200), range(0, 3200, 16)
    scattered = np.random.default_rng(3).uniform(-0.05, 0.05, (300, 3))
    few = decisive_points(long, POINTS).points
    assert len(unique_points(meridian_points(long, few))[0]) == 5
    assert saves_solves(long, few, blocks)
    assert not saves_solves(long, decisive_points(long, scattered).points, blocks)


def test_a_matrix_of_other_materials_is_refused(magnet_of, session, monkeypatch):
    """Negative control of the comparison with GetDP's matrix: elements without their iron."""
    materials = iron_modes._materials

    def without_iron(case):
        ring, permeability = materials(case)
        return ring, np.minimum(permeability, 2.0)

    monkeypatch.setattr(iron_modes, "_materials", without_iron)
    with pytest.raises(GetDPError, match="matrix differs"):
        solve_modes(magnet_of(iron_ring=IRON), POINTS, [0], session, 1, reciprocal_gradients)


@pytest.mark.parametrize("mode", [0, 1, 2, 7])
def test_integrals_over_the_angle_of_a_block(mode):
    """Against a quadrature; the weights of pro/azimuthal_modes.pro."""
    half = np.array([np.pi / 16, 0.3])
    nodes, weights = np.polynomial.legendre.leggauss(40)
    t = half[:, None] * nodes
    for found, values in zip(angle_integrals(mode, half), (
            np.cos(t) * np.cos(mode * t), np.sin(t) * np.sin(mode * t), np.cos(mode * t)),
            strict=True):
        np.testing.assert_allclose(found, half * (values @ weights), atol=1e-14)


def test_a_dry_run_counts_their_solves(magnet_of):
    """Three per place and mode, in two materials, and none for blocks; nothing is started."""
    session = Session.counting(1)
    solve_modes(magnet_of(), POINTS, [0], session, 4, reciprocal_gradients)
    counted = [size for _, sizes in session.counter.batches for size in sizes]
    assert [size.solves for size in counted[-2:]] == [3 * 5 * 5] * 2
    assert len(counted) == 4  # and the nominal array, whose mode 1 has two parts
