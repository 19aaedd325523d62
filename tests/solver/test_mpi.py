"""GetDP in several MPI processes gives what one process gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.core.errors import GetDPError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.getdp import CONJUGATE_GRADIENTS, run
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.study.reader import parse_study
from tests.conftest import circle

POINTS = circle(0.07, 8)
COARSE = {"array__rings": 1, "array__blocks_per_ring": 8, "mesh__block_size_m": 0.06,
          "mesh__meridian_size_m": 0.02}
ROUNDING = 1e-9
"""Of the largest field: sums in another order, 1.4e-11 of the solution measured with edge elements
of a conditioned gauge; conjugate gradients stop at 1e-10 of the residual."""


def difference(study, session, **other):
    one = solve_nominal(build_magnet(study), POINTS, session)
    two = solve_nominal(build_magnet(study), POINTS, replace(session, processes=2, **other))
    logs = list(session.folder.glob("getdp-*/getdp.log"))
    assert logs
    assert all("2 nodes" in log.read_text() for log in logs)
    return np.abs(two - one).max() / np.abs(one).max()


@pytest.mark.parametrize("route", ["edge_elements", "scalar_potential", "azimuthal_modes"])
def test_3d(short_dipole, session, route):
    study = short_dipole(solver__route=route, solver__edge_order=1, **COARSE)
    assert difference(study, session) < ROUNDING


def test_2d_with_saturating_iron(dipole, session):
    """Newton's method, whose matrix changes at every step."""
    study = dipole(mesh__block_size_m=0.03, iron_ring={
        "inner_radius_m": 0.19, "outer_radius_m": 0.2,
        "curve": {"kind": "steel", "name": "aisi_1010"}})
    assert difference(study, session) < ROUNDING


def iterating(getdp, job, *rest):
    return run(getdp, replace(job, options=CONJUGATE_GRADIENTS), *rest)


def test_conjugate_gradients(short_dipole, session):
    """Whose preconditioner knows only its own process's unknowns."""
    study = short_dipole(solver__route="scalar_potential", **COARSE)
    assert difference(study, replace(session, run=iterating)) < 1e-7  # see ITERATED_TOLERANCE


def test_another_problem_shows(dipole, session):
    """The control: what is compared is not blind."""
    def other(getdp, job, *rest):
        numbers = {**job.numbers, "VACUUM": 0}
        return run(getdp, replace(job, numbers=numbers), *rest)

    study = parse_study(dipole(mesh__block_size_m=0.03).model_dump(mode="json", exclude_none=True))
    assert difference(study, session, run=other) > 1e-4


def test_an_mpirun_that_is_none(dipole, session, tmp_path, monkeypatch):
    """One of another MPI starts runs that know nothing of each other, in one folder."""
    fake = tmp_path / "bin" / "mpirun"
    fake.parent.mkdir()
    fake.write_text('#!/bin/sh\nshift 2\nexec "$@"\n')
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", str(fake.parent), prepend=":")
    with pytest.raises(GetDPError, match="did not run in the 2 MPI processes"):
        solve_nominal(build_magnet(dipole()), POINTS, replace(session, processes=2))


def test_no_mpirun(dipole, session, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(GetDPError, match=r"`mpirun` was not found \(Debian: openmpi-bin\)"):
        solve_nominal(build_magnet(dipole()), POINTS, replace(session, processes=2))
