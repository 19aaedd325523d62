"""Azimuthal modes against the exact field, against edge elements, and against a closed form."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver import azimuthal_modes
from halbach_fe.solver.exact_block_field import field_of, unit_field
from halbach_fe.solver.getdp import run
from halbach_fe.solver.getdp_cache import Cache
from halbach_fe.solver.mesh import build_meridian, verify_mesh
from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
from halbach_fe.solver.routes import choose_route, finite_element_part, solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import MU_0
from tests.conftest import circle

IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}
POINTS = np.vstack([circle(0.05, 7, z, 0.2 + z) for z in (-0.12, -0.03, 0.0, 0.05, 0.11)])
AXIS = np.column_stack([np.zeros((5, 2)), np.linspace(-0.2, 0.2, 5)])


@pytest.fixture
def modes(short_dipole):
    """A study that takes azimuthal modes, with changes."""
    return lambda **changes: short_dipole(
        **{"mesh__meridian_size_m": 0.012, "solver__route": "azimuthal_modes"} | changes)


def columns_in_vacuum(study, points):
    return np.concatenate([np.moveaxis(unit_field(block, points), 2, 0)
                           for block in build_magnet(study).blocks])


@pytest.fixture(scope="module")
def superposed(short_dipole, getdp, tmp_path_factory):
    """Columns of all blocks without permeability, the exact ones, and what the modes were when they
    were superposed: all that `azimuthal_modes._superpose` received.
    """
    study = short_dipole(mesh__meridian_size_m=0.012, solver__route="azimuthal_modes",
                         array__recoil_permeability=1.0, solver__method="direct")
    points, received = np.vstack([POINTS, AXIS]), []
    superpose = azimuthal_modes._superpose

    def recorded(*arguments):
        received[:] = arguments
        return superpose(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(azimuthal_modes, "_superpose", recorded)
        found = azimuthal_modes.solve_modes(
            build_magnet(study), points, range(32),
            Session(getdp, tmp_path_factory.mktemp("columns"), jobs=2))[1:]
    return found, columns_in_vacuum(study, points), received


def test_every_column_against_its_exact_field(superposed):
    """Without permeability B itself, by modes, is the exact field: place, sign, all axes.

    Second-order elements: measured 0.55 % of the largest value of each column, rms 0.06 %.
    """
    found, exact, _ = superposed
    scale = np.abs(exact).max(axis=(1, 2))
    error = np.abs(found - exact).max(axis=(1, 2)) / scale
    assert error.max() < 0.015
    wrong = np.roll(exact, 3, axis=0)  # negative control: neighbours exchanged
    assert (np.abs(found - wrong).max(axis=(1, 2)) / scale).min() > 0.1


def test_runs_of_few_modes_do_the_same(modes, session, monkeypatch):
    """Solutions of many blocks, which would fill the disk, are read a few modes at a time."""
    study = modes(array__recoil_permeability=1.1, mesh__meridian_size_m=0.03)

    def columns():
        return azimuthal_modes.solve_modes(build_magnet(study), POINTS, [0], session, highest=4)

    weights = azimuthal_modes.nominal_waves(build_magnet(study), 4)

    def parts(sources):
        runs = azimuthal_modes.runs_of(weights, 1, (2, 1 + sources))
        assert runs.pop() == ([1], azimuthal_modes.NOMINAL)
        return [part for part, _ in runs]

    assert parts(3) == [[1, 2, 3, 4], [0]]
    together = columns()
    monkeypatch.setattr(azimuthal_modes, "SOLVED_NUMBERS", 6)
    assert parts(3) == [[1, 2], [3, 4], [0]]
    assert parts(15) == [[1], [2], [3], [4], [0]]
    # the same matrices, factorized again
    np.testing.assert_allclose(columns(), together, atol=1e-12 * np.abs(together).max())


def test_single_blocks_are_solved_for_once(modes, session, tmp_path):
    """Whatever the blocks' magnetizations and the points are; other materials are solved anew."""
    names = []

    def counted(getdp, job, folder, *rest):
        names.append(folder.name)
        return run(getdp, job, folder, *rest)

    cached = replace(session, cache=Cache(tmp_path / "cache"), run=counted)

    def solved_again(points, **changes):
        """Return the fields of a block, and how many runs for blocks and for the array began."""
        names.clear()
        study = modes(**{"array__recoil_permeability": 1.1, "mesh__meridian_size_m": 0.03}
                      | changes)
        found = azimuthal_modes.solve_modes(build_magnet(study), points, [0], cached, highest=3)
        of_blocks = sum("blocks" in name for name in names)
        return found, (of_blocks, len(names) - of_blocks)

    first, runs = solved_again(POINTS)
    assert runs == (4, 2)  # modes from 1 and mode 0, real materials and vacuum; the array's mode 1
    weaker = [{"ring": 1, "slot": 3, "remanence_T": 0.9}]
    changed, runs = solved_again(POINTS, array__exceptions=weaker)
    assert runs == (0, 4)  # a single block of another remanence has all modes
    np.testing.assert_array_equal(changed[1:], first[1:])
    assert np.abs(changed[0] - first[0]).max() > 0.01 * np.abs(first[0]).max()
    away, runs = solved_again(POINTS + np.array([0.0, 0.0, 1e-3]))
    assert runs == (0, 0)
    assert np.abs(away - first).max() > 1e-4 * np.abs(first).max()
    assert solved_again(POINTS, array__recoil_permeability=1.2)[1] == (4, 2)


def test_columns_of_a_similar_magnet(modes, session, tmp_path):
    """They save all runs for single blocks, and readings of deviations are as good.

    Blocks that deviate by 1 %, in an iron tube, after a change of the inner radius by 30 um: the
    largest difference was measured to be 1.1e-7 of the largest reading. Controls: without what iron
    and permeability answer it is 6e-4, and a radius that differs by 2 mm is solved for.
    """
    names, points = [], POINTS * [0.4, 0.4, 1.0]  # near the axis few modes suffice

    def counted(getdp, job, folder, *rest):
        names.append(folder.name)
        return run(getdp, job, folder, *rest)

    cached = replace(session, cache=Cache(tmp_path / "cache"), run=counted)

    def response_of(radius, name, similar=None):
        names.clear()
        study = modes(array__inner_radius_m=radius, iron_ring=IRON, mesh__meridian_size_m=0.05)
        magnet = build_magnet(study)
        found = response_matrix(magnet, observe(study, points, np.ones((len(points), 3), bool)),
                                cached.within(name), similar)
        return magnet, found, sum("blocks" in name for name in names)

    first, _, runs = response_of(0.104, "first")
    assert runs == 4
    magnet, found, runs = response_of(0.10403, "second", first)
    assert found.of_similar
    assert runs == 0
    assert response_of(0.10403, "second", first)[1].reused
    _, exact, _ = response_of(0.10403, "exact")
    assert not exact.of_similar

    def readings(response):
        generator = np.random.default_rng(7)
        deviations = response.nominal * 0.01 * generator.standard_normal(len(response.nominal))
        return response.offset + response.matrix @ (response.nominal + deviations)

    scale = np.abs(readings(exact)).max()
    assert np.abs(readings(found) - readings(exact)).max() < 5e-7 * scale
    vacuum = np.concatenate([unit_field(block, points) for block in magnet.blocks], axis=2)
    bare = replace(exact, matrix=vacuum.reshape(exact.matrix.shape) * MU_0 * 1.05)
    bare = replace(bare, offset=exact.offset + (exact.matrix - bare.matrix) @ exact.nominal)
    assert np.abs(readings(bare) - readings(exact)).max() > 3e-4 * scale
    assert (np.abs(found.error - exact.error) < 1e-5 * scale).all()
    _, far, runs = response_of(0.106, "far", first)
    assert not far.of_similar
    assert runs == 4


def test_the_modes_of_the_nominal_array_share_a_run(modes, session, monkeypatch):
    """Of 16 blocks modes 1, 15 and 17 have a remanence; large modes are runs of their own."""
    study = modes(array__recoil_permeability=1.1, mesh__meridian_size_m=0.03)
    points = circle(0.08)
    weights = azimuthal_modes.nominal_waves(build_magnet(study), 20)

    def parts(unknowns):
        return [part for part, _ in azimuthal_modes.runs_of(weights, unknowns)]

    assert parts(1) == [[1, 15, 17]]
    together = solve_nominal(build_magnet(study), points, session)
    monkeypatch.setattr(azimuthal_modes, "SHARED_UNKNOWNS", 2)
    assert parts(1) == [[1, 15], [17]]
    assert parts(3) == [[1], [15], [17]]
    apart = solve_nominal(build_magnet(study), points, session)
    np.testing.assert_allclose(apart, together, atol=1e-12 * np.abs(together).max())


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_a_missing_mode_is_seen(superposed, missing):
    """Negative control: drop one mode of the sum and the columns are wrong."""
    found, exact, (case, nominal, modes, *others) = superposed
    np.testing.assert_array_equal(
        azimuthal_modes._superpose(case, nominal, modes, *others)[1:], found)
    wrong = azimuthal_modes._superpose(
        case, nominal, modes | {missing: 0 * modes[missing]}, *others)[1:]
    assert np.abs(wrong - exact).max() / np.abs(exact).max() > 0.05


@pytest.mark.parametrize(("route", "size", "layers", "growth", "cap"), [
    ("edge_elements", 0.03, 3, 2.0, 0.15), ("scalar_potential", 0.03, 3, 2.0, 0.018)])
def test_reaction_against_3d_routes(modes, session, route, size, layers, growth, cap):
    """Two formulations, two meshes: they agree to what the 3D ones can do. Measured 9 % of the
    reaction rms for edge elements, 1.3 % for the scalar potential; the wrong sign is 200 % away.
    Both solve the same problem, in a box that is small.
    """
    changes = {"mesh__block_size_m": size, "mesh__layers_per_ring": layers, "mesh__growth": growth,
               "open_boundary": {"radius_m": 0.5, "half_length_m": 0.4}}
    fast, slow = modes(**changes), modes(solver__route=route, **changes)
    one = finite_element_part(build_magnet(fast), POINTS, session, columns=False).nominal
    two = finite_element_part(build_magnet(slow), POINTS, session, columns=False).nominal
    scale = np.sqrt(np.mean(one**2))
    assert np.sqrt(np.mean((one - two) ** 2)) < cap * scale
    assert np.sqrt(np.mean((one + two) ** 2)) > 1.5 * scale


@pytest.mark.parametrize("iron", [None, IRON], ids=["air", "iron"])
def test_middle_of_a_long_array_against_closed_form(modes, session, iron):
    """4.8 m long, the ends hardly change the middle: measured 5.2e-5 (air) and 1.5e-5 (iron), along
    z 3e-8. In air half the length has 4 times as much on any mesh: the reaction's moment ends.
    """
    study = modes(array__rings=16, array__ring_length_m=0.3, iron_ring=iron,
                  mesh__meridian_size_m=0.03)
    points = circle(0.07, 9, 0.01)
    tube = None if iron is None else (0.19, 0.2, 1000.0)
    expected = layered_bore_field(ideal_sectors(1, 16, 1.06, np.pi / 2, np.pi), 0.104, 0.1865,
                                  1.05, points[:, :2], tube)
    found = solve_nominal(build_magnet(study), points, session)
    assert np.abs(found[:, :2] - expected).max() < 1.2e-4 * np.abs(expected).max()
    assert np.abs(found[:, 2]).max() < 1e-7 * np.abs(expected).max()


def test_refinement_converges(modes, session):
    """The nominal field with iron on three meshes: each step is at least twice smaller.
    Measured 8.8e-5 and 4.1e-5 of the field.
    """
    fields = [solve_nominal(build_magnet(modes(iron_ring=IRON, mesh__meridian_size_m=size)),
                            POINTS, session)
              for size in (0.04, 0.02, 0.01)]
    steps = [np.abs(b - a).max() for a, b in pairwise(fields)]
    assert steps[1] < steps[0] / 2
    assert steps[1] < 1.2e-4 * np.abs(fields[-1]).max()


def test_superposition_of_rings(modes, session):
    """Columns add up to the nominal array, which was solved with all rings at once."""
    study = modes(iron_ring=IRON, mesh__meridian_size_m=0.03)
    built = response_matrix(build_magnet(study),
                            observe(study, POINTS, np.ones((len(POINTS), 3), bool)), session)
    assert built.superposition_error < 1e-9


def test_ring_gaps_and_turned_arrays(modes, session):
    """A gap between rings is still symmetric; first angles need not be multiples of the pitch.
    Measured 5e-4.
    """
    study = modes(array__ring_gap_m=0.01, array__recoil_permeability=1.0, solver__method="direct",
                  array__first_block_angle_deg=17.0, array__first_magnetization_angle_deg=71.0)
    found = azimuthal_modes.solve_modes(build_magnet(study), POINTS, (), session)[0]
    exact = field_of(build_magnet(study).blocks, POINTS)
    assert np.abs(found - exact).max() < 1.5e-3 * np.abs(exact).max()


@pytest.mark.parametrize("slot", [1, 4, 5])
def test_one_block_of_another_remanence(modes, session, slot):
    """It excites all modes, 0 among them; without permeability B itself is the exact field.
    Measured 3.5e-4 to 7.3e-4.
    """
    study = modes(array__recoil_permeability=1.0, solver__method="direct",
                  array__exceptions=[{"ring": 1, "slot": slot, "remanence_T": 1.9}])
    found = solve_nominal(build_magnet(study), POINTS, session)
    exact = field_of(build_magnet(study).blocks, POINTS)
    ordinary = field_of(build_magnet(modes(array__recoil_permeability=1.0)).blocks, POINTS)
    assert np.abs(found - exact).max() < 2e-3 * np.abs(exact).max()
    assert np.abs(found - ordinary).max() > 0.03 * np.abs(exact).max()


@pytest.mark.parametrize("slot", [2, 4])
def test_columns_add_up_beside_a_block_of_another_remanence(modes, session, slot):
    """The nominal array then has sines, besides cosines, of modes; these took the source of a block
    for their own. Rounding only; the part of the sines is the control.
    """
    study = modes(array__exceptions=[{"ring": 1, "slot": slot, "magnetization_factor": -1.0}])
    magnet = build_magnet(study)
    whole, *columns = azimuthal_modes.solve_modes(magnet, POINTS, range(len(magnet.blocks)),
                                                  session, highest=2)
    remanence = np.concatenate([b.remanence * np.array(b.easy_axis) for b in magnet.blocks])
    scale = np.abs(whole).max()
    assert np.abs(np.tensordot(remanence, columns, 1) - whole).max() < 1e-9 * scale
    ordinary = build_magnet(modes())
    remanence = np.concatenate([b.remanence * np.array(b.easy_axis) for b in ordinary.blocks])
    assert np.abs(np.tensordot(remanence, columns, 1) - whole).max() > 1e-3 * scale


def test_routes_are_chosen_by_symmetry(short_dipole, dipole):
    far = POINTS
    assert choose_route(build_magnet(short_dipole()), far) == "azimuthal_modes"
    assert choose_route(build_magnet(short_dipole(solver__method="direct")), far) == "edge_elements"
    gaps = {"shape": "sector", "angular_gap_deg": 1.0}
    trapezoids = {"shape": "trapezoid"}
    for block in (gaps, trapezoids):
        assert choose_route(build_magnet(short_dipole(array__block=block)),
                            far) == "moments"
        with pytest.raises(StudyError, match=r"solver\.route"):
            choose_route(build_magnet(
                short_dipole(array__block=block, solver__route="azimuthal_modes")), far)
    assert choose_route(build_magnet(dipole()), circle(0.07)) == "cross_section"
    near = circle(0.1035)
    assert choose_route(build_magnet(short_dipole()), near) == "moments"


def test_few_modes_on_the_axis_many_near_the_blocks(short_dipole):
    study = short_dipole()
    counts = [azimuthal_modes.modes_needed(build_magnet(study), circle(r))
              for r in (1e-6, 0.05, 0.075, 0.09)]
    assert counts == sorted(counts)
    assert counts[0] == 1
    assert azimuthal_modes.modes_needed(build_magnet(study), circle(0.4)) < counts[-1]


def test_meridian_mesh_is_verified(short_dipole, tmp_path):
    """Unknowns: nodes off the boundary, and off the axis for modes above 0."""
    study = short_dipole(iron_ring=IRON, mesh__meridian_size_m=0.03)
    mesh = verify_mesh(build_meridian(build_magnet(study), tmp_path))
    assert mesh.axis.nodes > 0
    assert mesh.axis.nodes < mesh.inner.nodes < len(mesh.points)
    assert mesh.radius > 10 * 0.2
    again = build_meridian(build_magnet(study), tmp_path / "again")
    assert again.mesh.read_bytes() == mesh.path.read_bytes()
