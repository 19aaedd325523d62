"""Numerical causes come before physical ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.summary import diagnosis_summary, other_findings
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map
from halbach_fe.report import diagnosis_answer
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed, circle

SIGMA = 3e-5
POINTS = np.vstack([circle(radius, 40, 0.0) for radius in (0.05, 0.08)])


def found(session, generator, method, gain=0.0):
    """Diagnose an exact field, by the coarse mesh alone or as what reacts only."""
    study = parse_study(changed(
        DIPOLE, array__recoil_permeability=1.0, solver={"method": method},
        noise={"regions": [{"name": "all", "sigma_T": SIGMA}]},
        prior={"magnitude_sd": 0.002, "direction_sd_deg": 0.1, "common_mode_sd": 0.002}))
    blocks = [replace(one, remanence=one.remanence * (1 + 0.002 * generator.standard_normal()))
              for one in build_magnet(study).blocks]
    readings = field_of(blocks, POINTS) + SIGMA * generator.standard_normal(POINTS.shape)
    readings[:, 0] *= 1 + gain
    return diagnose(study, field_map(POINTS, readings), session)


def test_a_coarse_mesh_is_no_effect(session, generator):
    diagnosis = found(session, generator, "direct")
    assert (diagnosis.identified, diagnosis.unknown, diagnosis.rounds) == ((), None, 1)
    assert diagnosis.solver_error.chi2_noise > diagnosis.before.conflict_limit
    assert diagnosis.solver_error.largest_over_noise > 1
    assert diagnosis_summary(diagnosis)["verdict"] == "numerical"
    assert [one.name for one in other_findings(diagnosis)] == ["solver_error"]
    assert answer(diagnosis).said.startswith("The solver's own error explains the misfit")
    assert answer(diagnosis).step.startswith("Take a smaller mesh.block_size_m (now ")
    assert ", or move `open_boundary` outwards, and diagnose again" in answer(diagnosis).step
    # blocks by moments have cells, and no boundary
    cubes = build_magnet(parse_study(changed(
        DIPOLE, dimension=3, array__ring_length_m=0.05, solver={"route": "moments"})))
    moved = replace(diagnosis, before=replace(diagnosis.before, magnet=cubes))
    assert diagnosis_answer._next(moved)[0] == (
        "Take a larger mesh.cells_per_side (now 2), and diagnose again.")


@pytest.mark.parametrize(("method", "gain"), [("reaction", 0.0), ("direct", 0.1)])
def test_what_the_mesh_does_not_explain(session, generator, method, gain):
    """Negative controls: no misfit, and one that is larger than the error of the mesh."""
    diagnosis = found(session, generator, method, gain)
    assert diagnosis.solver_error is None
    assert bool(gain) == (diagnosis.before.prior_conflict > diagnosis.before.conflict_limit)
    assert bool(gain) == bool(diagnosis.identified or diagnosis.unknown)
