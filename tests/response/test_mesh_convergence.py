"""The stated error must cover the true one, where the truth is known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.page import write_report
from halbach_fe.report.verification_page import answer
from halbach_fe.report.words import decimals, flux_density, ppm, relative
from halbach_fe.response.discretization_error import observed_order, refined, verify
from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
from halbach_fe.solver.routes import solve_nominal
from tests.support.pages import page

IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}


@pytest.mark.parametrize("method", ["direct", "reaction"])
@pytest.mark.parametrize("iron", [None, IRON], ids=["air", "iron"])
def test_stated_error_covers_the_true_one(dipole, session, method, iron):
    """In 2D the truth is a closed form. An estimate within a factor of 30 above is of use."""
    study = dipole(iron_ring=iron, solver={"method": method}, mesh__block_size_m=0.016)
    points = points_from(study.observation.positions)
    tube = None if iron is None else (0.19, 0.2, 1000.0)
    expected = layered_bore_field(ideal_sectors(1, 16, 1.06, np.pi / 2, np.pi), 0.104, 0.1865,
                                  1.05, points[:, :2], tube)
    found = solve_nominal(build_magnet(study), points, session)[:, :2]
    true = np.linalg.norm(found - expected, axis=1).max() / np.abs(expected).max()
    stated = verify(build_magnet(study), session)
    assert true < stated.error_pointwise < 30 * true


def test_coarse_meshes_are_told_from_fine_ones(short_dipole, session):
    """Negative control: an estimate that ignored the mesh would not grow with its size."""
    observation = {"quantity": "flux_density", "positions": {
        "kind": "circles", "radius_m": 0.05, "angles": 5, "z_min_m": -0.1, "z_max_m": 0.1,
        "count": 3}}
    study = short_dipole(iron_ring=IRON, mesh__meridian_size_m=0.016, observation=observation)
    fine, coarse = verify(build_magnet(study), session), verify(
        refined(build_magnet(study), 0.4), session)
    assert fine.route == "azimuthal_modes"
    assert coarse.error_pointwise > 3 * fine.error_pointwise
    assert fine.error_pointwise < 1e-3


def test_several_circles_and_regions(dipole, session):
    """Coefficients are those of each circle; regions of a name are one, by component or not."""
    regions = [{"name": "bore", "components": ["x"], "sigma_T": 1e-5},
               {"name": "bore", "sigma_T": 1e-4}]
    study = dipole(iron_ring=IRON, noise={"regions": regions}, observation__components=["x", "y"],
                   observation__positions={"kind": "circles", "radius_m": [0.05, 0.075],
                                           "angles": 12})
    found = verify(build_magnet(study), session).differences[0]
    assert list(found.by_region) == ["bore"]
    assert found.by_region["bore"] == found.pointwise
    assert 0 < found.fourier < found.pointwise


def test_separate_blocks_are_verified_by_their_cells(short_dipole, session):
    """There is no boundary to move, and fewer cells change the field more than more cells do."""
    study = short_dipole(array__block={"shape": "trapezoid", "side_gap_m": 0.002})
    found = verify(build_magnet(study), session)
    assert found.route == "moments"
    assert len(found.differences) == 3
    _, coarser, finer = (difference.pointwise for difference in found.differences)
    assert 0 < finer < coarser < 1e-3
    assert finer < found.error_pointwise < 1e-3


def test_a_3d_mesh_gets_the_dual_route(short_dipole, session):
    """Eight blocks of one ring have every kind of difference, as all arrays in 3D have."""
    study = short_dipole(array__block={"shape": "trapezoid"}, array__rings=1,
                         array__blocks_per_ring=8, mesh__block_size_m=0.06, mesh__growth=2.5,
                         solver__route="scalar_potential")
    found = verify(build_magnet(study), session)
    assert found.route == "scalar_potential"
    assert found.differences[-1].what == "dual route, edge_elements"
    assert 1e-5 < found.differences[-1].pointwise < 0.02


def test_observed_order():
    assert observed_order(1.5**2, 1.0) == pytest.approx(2.0)
    assert observed_order(1.0, 1.0) == 0.5
    assert observed_order(1.0, 3.0) == 0.5
    assert observed_order(1.0, 0.0) == 4.0
    assert observed_order(1e9, 1.0) == 4.0


def test_observed_order_of_three_changes():
    """The line through all of them, unless the last two say that convergence has slowed down."""
    assert observed_order(1.5**4, 1.5**2, 1.0) == pytest.approx(2.0)
    # the last change is small by chance: two points would make it order 3.5 and the error small
    assert observed_order(1.5**4, 1.5**3.5, 1.0) == pytest.approx(2.0)
    assert observed_order(1.5**6, 1.5, 1.0) == pytest.approx(1.0)
    assert observed_order(1.0, 1.5**4, 1.0) == 0.5
    assert observed_order(0.0, 1.5**2, 1.0) == pytest.approx(2.0)  # no coarser mesh
    assert observed_order(0.0, 0.0, 1.0) == 0.5
    assert observed_order(0.0, 0.0, 0.0) == 4.0


def test_verify_from_the_command_line(tmp_path, capsys):
    from tests.cli.test_cli import STUDY
    path, out = tmp_path / "study.toml", tmp_path / "out"
    path.write_text(STUDY)
    assert main(["verify", str(path), "-o", str(out)]) == 0
    shown = capsys.readouterr()
    assert "estimated error" in shown.out
    stored = json.loads((out / "verification.json").read_text())
    assert 0 < stored["error_pointwise"] < 0.1
    text = page(out / "verification.html")
    error, main_field = stored["error_pointwise"], stored["main_field_T"]
    said = f"{flux_density(error * main_field)} at most"
    assert said in text
    assert f"That is {relative(error)} of the largest field" in text
    assert f"{decimals(error * main_field / 1e-4, 2)} times the smallest noise" in text
    assert said in shown.err
    # the largest change of each column is the table's
    table = np.genfromtxt(out / "verification.csv", delimiter=",", skip_header=2)
    assert len(table) == 10
    for one, column in zip(stored["differences"], table[:, 3:].T, strict=True):
        assert column.max() / main_field == pytest.approx(one["pointwise"])
        assert f">{ppm(1e6 * one['pointwise'])}</td>" in text


def test_a_field_without_finite_elements(dipole, session, tmp_path):
    """In vacuum the reaction is nothing: no figure of convergence, and a verdict that says so."""
    study = dipole(array__recoil_permeability=1.0)
    found = verify(build_magnet(study), session)
    assert "exact one of the blocks" in answer(found).said
    write_report(found, tmp_path)
    page(tmp_path / "verification.html")
    assert not (tmp_path / "verification_convergence.png").exists()
    # negative control: a mesh whose refinement does not help is warned of
    stuck = replace(found, order=0.5, error_pointwise=0.01)
    write_report(stuck, tmp_path)
    assert "the mesh should be finer" in page(tmp_path / "verification.html")
