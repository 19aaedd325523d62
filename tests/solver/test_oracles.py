"""Against NGSolve: another mesher, curved elements of high order, another formulation."""

from __future__ import annotations

from dataclasses import dataclass

import ngsolve
import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.positions import points_from
from halbach_fe.solver.routes import choose_route, finite_element_part
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study, read_study
from tests.conftest import DIPOLE, ROOT, changed, circle
from tests.oracles import dipole_of
from tests.oracles import ngsolve_model as oracle

IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}


@dataclass(frozen=True)
class InVacuum:
    """The FASER dipole with iron, places, NGSolve's mesh, and B there of the sources in vacuum."""

    study: Study
    points: np.ndarray
    mesh: ngsolve.Mesh
    field: np.ndarray


@pytest.fixture(scope="module")
def in_vacuum():
    study = read_study(ROOT / "studies" / "faser" / "campaign.toml")
    points = points_from(study.observation.positions)[::29]
    mesh = oracle.eighth(dipole_of(study), 0.04)
    with ngsolve.TaskManager():
        return InVacuum(study, points, mesh, oracle.vector_potential_field(
            dipole_of(study), mesh, 3, points, real=False, residual=1e-5))


def test_full_array_against_the_vector_potential_in_3d(session, in_vacuum):
    """The whole FASER dipole, fringe included, with mu_r = 1.05 and an iron tube, in units of its
    main field of 0.57 T. Coarse here: 2.6e-4, rms 4e-5; NGSolve's finer meshes and orders bring it
    down to 3.3e-5 (`make benchmark`). `tests/synthetic/test_fields.py` has magnets without iron.
    """
    study, points = in_vacuum.study, in_vacuum.points
    shifted = points + np.array([0, 0, 0.01])
    ours, moved = np.split(finite_element_part(
        build_magnet(study), np.vstack([points, shifted]), session, columns=False).nominal, 2)
    with ngsolve.TaskManager():
        theirs = oracle.vector_potential_field(
            dipole_of(study), in_vacuum.mesh, 3, points, residual=1e-5) - in_vacuum.field
    main_field = 0.57
    assert np.linalg.norm(ours - theirs, axis=1).max() < 7e-4 * main_field
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 1e-4 * main_field
    # negative controls: the wrong sign, and a magnet displaced by a centimetre
    assert np.linalg.norm(ours + theirs, axis=1).max() > 30e-3 * main_field
    assert np.linalg.norm(moved - theirs, axis=1).max() > 1e-3 * main_field


RINGS = {"iron_ring": IRON, "mesh": {"block_size_m": 0.04, "layers_per_ring": 3, "growth": 1.7,
                                    "meridian_size_m": 0.012}}
"""As coarse as the caps of the routes allow; smaller elements halve no error here, but take twice
the time."""
NUMBER = 21
POINTS = np.vstack([circle(0.05, 9, z, 0.2 + z) for z in (-0.12, -0.03, 0.05, 0.11)])


@pytest.fixture(scope="module")
def column():
    """1 T along x of one block of two rings, with iron, by NGSolve."""
    study = parse_study(changed(DIPOLE, dimension=3, array__rings=2, array__ring_length_m=0.08,
                                **RINGS))
    block, dipole = build_magnet(study).blocks[NUMBER], dipole_of(study)
    mesh = oracle.whole(dipole, block.slot - 1, block.z_min, block.z_max, 0.04)
    with ngsolve.TaskManager():
        # a residual of 1e-4 leaves 6e-5 of the reaction
        return oracle.scalar_potential_column(dipole, mesh, 3, (1.0, 0.0, 0.0), POINTS,
                                              residual=1e-4).reaction


@pytest.mark.parametrize(("route", "cap"), [
    ("azimuthal_modes", 0.01), ("scalar_potential", 0.03), ("edge_elements", 0.25)])
def test_a_column_by_every_route_against_ngsolve(short_dipole, session, column, route, cap):
    """The reaction relative to its rms: measured 0.45 %, 1.4 %, 17 %, of which the first
    is in part NGSolve's own.
    """
    study = short_dipole(solver__route=route, **RINGS)
    assert choose_route(build_magnet(study), POINTS) == route
    ours = finite_element_part(build_magnet(study), POINTS, session).block(NUMBER,
                                                                           slice(None))[:, :, 0]
    scale = np.sqrt(np.mean(column**2))
    assert np.sqrt(np.mean((ours - column) ** 2)) < cap * scale
    assert np.sqrt(np.mean((ours + column) ** 2)) > 1.5 * scale  # the wrong sign
