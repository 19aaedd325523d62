"""Reciprocity: what block A does to block B is what B does to A; and so for readings."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp_files import read_solutions, read_unknowns
from halbach_fe.solver.interpolation import locate, probes_of
from halbach_fe.solver.magnetostatics import (
    CROSS_SECTION,
    SCALAR_POTENTIAL,
    SOLUTIONS_FILE,
    RunRequest,
    edge_elements,
    fill_run_folder,
)
from halbach_fe.solver.mesh import build_mesh, verify_mesh
from tests.conftest import circle

IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}
POINTS = circle(0.06, 5, 0.013)


def dumped(study, formulation, blocks, session):
    """Mesh, located points, unknowns, right-hand sides and solutions of GetDP; its folder."""
    folder = session.folder / "run"
    folder.mkdir(parents=True)
    mesh = verify_mesh(build_mesh(build_magnet(study), session.folder))
    located = locate(mesh, POINTS)
    count = 1 + study.dimension * len(blocks)
    job = fill_run_folder(build_magnet(study), mesh, probes_of(mesh, located.cells)[1], folder,
                          formulation, RunRequest(blocks, (0, count - 1)))
    job = dataclasses.replace(job, options=(
        *job.options, "-ksp_view_rhs", "binary:rhs.bin::append",
        "-ksp_view_mat", "binary:matrix.bin"))
    runner.run(session.getdp, job, folder)
    unknowns = read_unknowns(folder / job.problem.replace(".pro", ".pre"), mesh.cell_type)
    right, solutions = (np.array(read_solutions(folder / name, unknowns.count, count), float)
                        for name in ("rhs.bin", SOLUTIONS_FILE))
    return mesh, located, unknowns, right, solutions, folder


def read_matrix(path, size):
    """PETSc's binary sparse matrix."""
    raw = path.read_bytes()
    kind, rows, columns, entries = np.frombuffer(raw[:16], ">i4")
    assert (kind, rows, columns) == (1211216, size, size)
    lengths = np.frombuffer(raw, ">i4", rows, 16).astype(int)
    index = np.frombuffer(raw, ">i4", entries, 16 + 4 * rows).astype(int)
    values = np.frombuffer(raw, ">f8", entries, 16 + 4 * (rows + entries)).astype(float)
    return sparse.csr_array((values, index, np.concatenate([[0], np.cumsum(lengths)])),
                            shape=(size, size))


@pytest.mark.parametrize(("formulation", "tolerance"), [
    (edge_elements(1), 1e-9), (edge_elements(2), 1e-9), (SCALAR_POTENTIAL, 1e-8)],
    ids=["edges-1", "edges-2", "potential"])
def test_mutual_energies_of_blocks_are_symmetric(short_dipole, session, formulation, tolerance):
    """Direct solvers to rounding, conjugate gradients to their tolerance."""
    study = short_dipole(iron_ring=IRON, mesh__block_size_m=0.05, mesh__growth=2.5)
    *_, right, solutions, _ = dumped(study, formulation, [0, 21], session)
    mutual = right[1:] @ solutions[1:].T
    scale = np.abs(np.diag(mutual)).max()
    assert np.abs(mutual - mutual.T).max() < tolerance * scale
    assert np.abs(mutual[:3, 3:]).max() > 1e-4 * scale  # there is something to compare
    wrong = right[1:] @ np.roll(solutions[1:], 1, axis=0).T  # negative control
    assert np.abs(wrong - wrong.T).max() > 0.1 * scale


def test_adjoint_of_the_readings(dipole, session):
    """<w, E K^-1 f> = <f, K^-T E' w>, with GetDP's matrix but another solver for the adjoint."""
    study = dipole(iron_ring=IRON)
    mesh, located, unknowns, right, solutions, folder = dumped(
        study, CROSS_SECTION, [3], session)
    matrix = read_matrix(folder / "matrix.bin", unknowns.count)
    assert abs(matrix - matrix.T).max() < 1e-12 * abs(matrix).max()
    operator = CROSS_SECTION.flux_density(mesh, located, unknowns)[0]
    weights = np.random.default_rng(3).standard_normal(len(POINTS))
    adjoint = spsolve(matrix.T.tocsc(), operator.T @ weights)
    for f, x in zip(right, solutions, strict=True):
        forward = weights @ (operator @ x)
        assert forward == pytest.approx(f @ adjoint, rel=1e-8)
        assert forward != pytest.approx(f @ np.roll(adjoint, 1), rel=1e-2)  # negative control
