"""Blocks that stand for others: against solves of every block, and what must not be reduced."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.symmetry import SymmetryImage, no_symmetry, symmetry_of, unique_points
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver.routes import choose_route, finite_element_part
from tests.conftest import circle

IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}
POINTS = np.vstack([circle(0.05, 5, z, 0.2 + z) for z in (-0.12, 0.03, 0.1)])


NEAR_AXIS = np.vstack([circle(0.02, 5, z, 0.2 + z) for z in (-0.12, 0.03, 0.1)])
"""Points that need half of the azimuthal modes."""


def fields(study, session, points=POINTS):
    parts = finite_element_part(build_magnet(study), points, session)
    return np.array(
        [parts.block(number, slice(None)) for number in range(len(build_magnet(study).blocks))])


@pytest.mark.parametrize("rings", [2, 3])
def test_modes_reduced_equal_unreduced(short_dipole, session, rings):
    """The half-plane's mesh is its own mirror image, so that only rounding is left."""
    changes = {"array__rings": rings, "array__blocks_per_ring": 8, "iron_ring": IRON,
               "mesh__meridian_size_m": 0.03}
    reduced = fields(short_dipole(**changes), session, NEAR_AXIS)
    plain = fields(short_dipole(solver__symmetry=False, **changes), session, NEAR_AXIS)
    assert np.abs(reduced - plain).max() < 1e-12 * np.abs(plain).max()
    # negative control: rings counted from the other end
    mirrored = plain.reshape(rings, 8, *plain.shape[1:])[::-1].reshape(plain.shape)
    assert np.abs(reduced - mirrored).max() > 0.1 * np.abs(plain).max()


def test_iron_at_one_end(short_dipole, session):
    """The columns of the rings differ: they were those of the mirror image, and did not add up."""
    disc = {"kind": "tube", "inner_radius_m": 0.06, "outer_radius_m": 0.19, "length_m": 0.02,
            "z_m": 0.11}
    changes = {"array__blocks_per_ring": 8, "mesh__meridian_size_m": 0.03,
               "iron": {"relative_permeability": 500.0, "bodies": [disc]}}
    reduced = fields(short_dipole(**changes), session, NEAR_AXIS)
    plain = fields(short_dipole(solver__symmetry=False, **changes), session, NEAR_AXIS)
    assert np.abs(reduced - plain).max() < 1e-12 * np.abs(plain).max()


@pytest.mark.parametrize("block", [{"shape": "trapezoid", "side_gap_m": 0.002}])
def test_3d_reduced_agree_with_unreduced(short_dipole, session, block):
    """On a mesh without symmetry they agree to its error: measured 8 % of the largest reaction of
    a block, 6 % rms on these coarse elements. Axes exchanged are 49 % away, wrong places and signs
    99 % and more.
    """
    changes = {"array__block": block, "array__recoil_permeability": 1.2,
               "array__blocks_per_ring": 6, "mesh__block_size_m": 0.05, "mesh__growth": 2.5,
               "solver__route": "scalar_potential"}
    reduced = fields(short_dipole(**changes), session)
    plain = fields(short_dipole(solver__symmetry=False, **changes), session)
    scale = np.abs(plain).max()
    assert np.abs(reduced - plain).max() < 0.2 * scale
    assert np.sqrt(np.mean((reduced - plain) ** 2)) < 0.15 * np.sqrt(np.mean(plain**2))
    for wrong in (-plain, np.roll(plain, 1, axis=0), plain.swapaxes(2, 3),
                  plain.reshape(2, 6, *plain.shape[1:])[::-1].reshape(plain.shape)):
        assert np.sqrt(np.mean((reduced - wrong) ** 2)) > 0.45 * np.sqrt(np.mean(plain**2))


def test_lowest_order_on_a_coarse_mesh_is_not_taken_for_a_wrong_column(short_dipole, session):
    """Edge elements of order 1, placed by symmetry, miss the array by 11 % here."""
    study = short_dipole(solver__method="direct", mesh__growth=3.0)
    built = response_matrix(build_magnet(study),
                            observe(study, POINTS, np.ones(POINTS.shape, bool)), session)
    assert 0.05 < built.superposition_error < 0.25


def test_what_is_a_symmetry(short_dipole):
    def count(**changes):
        return len(symmetry_of(build_magnet(short_dipole(array__rings=3, **changes))).sources)

    assert count() == 2  # one slot, of the outer and the middle ring
    assert len(no_symmetry(build_magnet(short_dipole(array__rings=3))).sources) == 48
    # cubes that follow the magnetization turn twice as fast: the same again after four slots
    cubes = {"shape": "cuboid", "width_m": 0.03, "orientation": "magnetization"}
    assert count(array__block=cubes, array__outer_radius_m=0.134) == 4 * 2
    bars = cubes | {"width_m": 0.02}
    assert count(array__block=bars, array__outer_radius_m=0.134) == 8 * 2
    # another remanence is no other material; another permeability is
    assert count(array__exceptions=[{"ring": 1, "slot": 4, "remanence_T": 1.2}]) == 2
    odd = {"slot": 4, "recoil_permeability": 1.3}
    assert count(array__exceptions=[odd | {"ring": 1}]) == 48
    assert count(array__exceptions=[odd | {"ring": 2}]) == 16 * 2
    assert count(array__exceptions=[{"ring": 1, "recoil_permeability": 1.3}]) == 3
    # a disc at one end makes the ends unlike, and two that are alike do not
    disc = {"kind": "tube", "inner_radius_m": 0.02, "outer_radius_m": 0.19, "length_m": 0.01}
    for places, expected in ((0.2,), 3), ((-0.2, 0.2), 2), ((0.0,), 2), ((-0.21, 0.2), 3):
        bore = {"outer_radius_m": 0.1} if 0.0 in places else {}
        assert count(iron={"relative_permeability": 500.0, "bodies": [
            disc | bore | {"z_m": z} for z in places]}) == expected


def test_blocks_of_other_permeability_are_separate(short_dipole):
    odd = {"ring": 1, "slot": 4, "recoil_permeability": 1.3}
    assert choose_route(build_magnet(short_dipole(array__exceptions=[odd])),
                        POINTS) == "moments"
    ring = {"ring": 1, "recoil_permeability": 1.3}
    assert choose_route(build_magnet(short_dipole(array__exceptions=[ring])),
                        POINTS) == "azimuthal_modes"


def test_an_exceptional_ring_in_modes_and_in_3d(short_dipole, session):
    """One ring of mu_r 1.4: its reaction by two routes, measured 3.2 % apart on this coarse mesh,
    and not that of the ordinary array, 69 % away.
    """
    changes = {"array__exceptions": [{"ring": 1, "recoil_permeability": 1.4, "remanence_T": 0.9}],
               "array__blocks_per_ring": 8, "mesh__growth": 1.8, "mesh__block_size_m": 0.04}

    def nominal(**more):
        return finite_element_part(build_magnet(short_dipole(**changes | more)), POINTS, session,
                                   columns=False).nominal

    modes, solid = nominal(), nominal(solver__route="scalar_potential")
    scale = np.sqrt(np.mean(modes**2))
    assert np.sqrt(np.mean((modes - solid) ** 2)) < 0.06 * scale
    ordinary = nominal(array__exceptions=[])
    assert np.sqrt(np.mean((modes - ordinary) ** 2)) > 0.5 * scale


def test_placements_compose(generator):
    """There and back; and the field of a dipole, turned and mirrored, is that of the other one."""
    points = generator.standard_normal((7, 3))

    def dipole_field(where, moment):
        r = np.linalg.norm(where, axis=1)[:, None]
        return 3 * where * (where @ moment)[:, None] / r**5 - moment / r**3

    def unit(where):
        return np.stack([dipole_field(where, axis) for axis in np.eye(3)], axis=2)

    home = np.array([0.3, 0.1, 0.2])
    for placement in (SymmetryImage(0, 0.7), SymmetryImage(0, 0.0, True),
                      SymmetryImage(0, 2.1, True)):
        moved = np.array([home])
        moved = moved * [1, 1, -1] if placement.mirrored else moved
        c, s = np.cos(placement.turn), np.sin(placement.turn)
        moved = moved @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
        expected = unit(points - moved)
        found = placement.from_source(unit(placement.to_source(points) - home))
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_unique_points(generator):
    points = generator.standard_normal((50, 3))
    twice = np.vstack([points, points[::-1] + 1e-14])
    found, inverse = unique_points(twice)
    assert len(found) <= 60  # rounding may part a few
    np.testing.assert_allclose(found[inverse], twice, atol=2e-12)
    assert len(unique_points(points + 1e-9)[0]) == 50


def test_separate_blocks_react_as_on_a_mesh(short_dipole, session):
    """Gaps between blocks, which no mode can have: moments of the nominal array and of single
    blocks agree with a 3D mesh up to its error, measured 1.9 % and 6.5 % rms. Eight blocks leave
    half of the narrow gaps to be meshed, and have columns twice as far from one another.
    """
    changes = {"array__rings": 1, "array__ring_length_m": 0.1, "array__blocks_per_ring": 8,
               "array__block__angular_gap_deg": 2.0, "array__recoil_permeability": 1.1,
               "mesh": {"block_size_m": 0.035, "layers_per_ring": 3, "growth": 1.8}}
    parts = finite_element_part(build_magnet(short_dipole(**changes)), POINTS, session)
    whole = finite_element_part(build_magnet(short_dipole(
        **changes, solver__route="scalar_potential")), POINTS, session)

    def rms(field):
        return np.sqrt(np.mean(field**2))

    assert rms(parts.nominal - whole.nominal) < 0.06 * rms(whole.nominal)
    ours, theirs = (np.array([one.block(number, slice(None)) for number in range(8)])
                    for one in (parts, whole))
    assert rms(ours - theirs) < 0.15 * rms(theirs)
    assert rms(ours - np.roll(theirs, 1, axis=0)) > 0.5 * rms(theirs)  # negative control


@pytest.mark.parametrize("across", [None, 1.12])
def test_a_turned_block_adds_up_too(short_dipole, session, across):
    """It has a remanence along z, which is part of the nominal array; 1.7e-4 without. Moments have
    a single cell for the column of a block, measured 5e-3.
    """
    changes = {"mesh__meridian_size_m": 0.03, "array__blocks_per_ring": 8}  # any mesh adds up
    if across is not None:
        changes["array__recoil_permeability_across"] = across
    study = short_dipole(array__exceptions=[
        {"ring": 1, "slot": 5, "rotation_deg": [0.3, 0.2, 1.0]}], **changes)
    built = response_matrix(build_magnet(study),
                            observe(study, NEAR_AXIS, np.ones(NEAR_AXIS.shape, bool)), session)
    assert built.superposition_error < (1e-10 if across is None else 2e-2)
