"""Non-linear iron in a cross-section: the condensed engine against GetDP's Newton method."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import ngsolve
import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.discretization_error import reading_errors
from halbach_fe.response.nonlinear import newton_readings, nonlinear_model
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.magnetostatics import CROSS_SECTION, RunRequest, fill_run_folder
from halbach_fe.solver.mesh import build_mesh, verify_mesh
from halbach_fe.solver.routes import choose_route, finite_element_part, vacuum_part
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import nominal_prior
from halbach_fe.study.model import Study
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.true_magnet import FroehlichLaw, law_of
from tests.oracles import dipole_of, ngsolve_model, ngsolve_nonlinear
from tests.support.memory import Weighed, own_peak

STUDIES = Path(__file__).parent.parent / "studies"
STUDY, FASER_IRON = STUDIES / "sensitivity" / "study.toml", STUDIES / "faser" / "iron.toml"
SAMPLES, HARD = 180, 20
"""Magnetizations compared with GetDP: from the prior, and with random directions in all blocks,
which saturate the iron, from a cold start."""

LOOPED, ALONE = 20, 3
"""Solves timed in one GetDP process, and in one each."""

MANY = 18_000
LOOP_TOLERANCE = 1e-8  # of GetDP's residual, as one would choose for speed
ENGINE_TOLERANCE_T = 1e-9


def getdp_seconds(study: Study, samples: np.ndarray, folder: Path) -> float:
    """Wall time of one GetDP process that solves samples (k, blocks, 3) in A/m, starting each from
    the one before with full Newton steps: the fastest way it has.
    """
    mesh = verify_mesh(build_mesh(build_magnet(study), folder))
    started = time.monotonic()
    job = fill_run_folder(build_magnet(study), mesh, np.array([[0.0123, 0.0321, 0.0]]),
                          folder / "run", CROSS_SECTION, RunRequest(samples=samples))
    runner.run(find_getdp(), replace(
        job, resolution="Newton", solutions=None, outputs=("newton_flux_density.txt",),
        numbers={"TOLERANCE": LOOP_TOLERANCE, "LINE_SEARCH": 0}), folder / "run")
    return time.monotonic() - started


def faser(note: Note) -> None:
    """The whole dipole in 3D, in a thin tube that saturates, against NGSolve."""
    study = read_study(FASER_IRON)
    points = points_from(study.observation.positions)
    observation = observe(study, points, np.ones_like(points, bool))
    common.say("FASER dipole in a tube that saturates, in 3D")
    with tempfile.TemporaryDirectory() as name:
        scales = Weighed.of(find_getdp(), Path(name))
        session = Session(scales.getdp, Path(name), jobs=2)
        started = time.monotonic()
        parts = finite_element_part(build_magnet(study), points, session, columns=False)
        stated = reading_errors(build_magnet(study), observation, parts, session)
        part = parts.nominal
        note("nonlinear.faser_3d_seconds", time.monotonic() - started, "s",
             f"error bars included; route {choose_route(build_magnet(study), points)}")
        note("nonlinear.faser_3d_memory_GiB", own_peak() + 2 * scales.peak, "GiB",
             "peak of this process and of two of GetDP's")
    main_field = float(np.abs(vacuum_part(build_magnet(study), points) + part).max())
    common.say("the same by NGSolve")
    assert study.iron_ring is not None
    dipole, iron = dipole_of(study), law_of(study.iron_ring)
    assert isinstance(iron, FroehlichLaw)
    with ngsolve.TaskManager():
        mesh = ngsolve_model.eighth(dipole, 0.02, bore_size=0.04, far=3.0, grading=0.35)
        theirs = ngsolve_nonlinear.potential_reaction(dipole, iron, mesh, 3, points)
    difference = np.abs(observation.apply(part) - observation.apply(theirs))
    note("nonlinear.faser_3d_error", float(difference.max()) / main_field, "of the main field",
         "NGSolve, scalar potential of order 3, curved; fringe included")
    note("nonlinear.faser_3d_stated_error", float(stated.max()) / main_field, "of the main field",
         "largest error bar")
    note("nonlinear.faser_3d_within_bars", float(np.mean(difference <= stated)), "of the readings",
         "NGSolve")


def run(note: Note) -> None:
    """Measure and note."""
    faser(note)
    study = read_study(STUDY)
    points = points_from(study.observation.positions)
    observation = observe(study, points, np.ones_like(points, bool))
    generator = np.random.default_rng(4)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "run").mkdir()
        session = Session(find_getdp(), folder / "model", jobs=2)
        common.say("condensed model of the cross-section")
        started = time.monotonic()
        model = nonlinear_model(build_magnet(study), observation, session, generator)
        note("nonlinear.build_seconds", time.monotonic() - started, "s",
             "error bars and verification included")
        unknowns = verify_mesh(build_mesh(build_magnet(study), folder)).inner.nodes
        note("nonlinear.unknowns", unknowns, "", f"of them {len(model.condensed.potential)} in "
             "the iron")
        prior = nominal_prior(model.nominal, 2, 0.01, 1.0)
        draws = prior.sample(MANY, generator)
        blocks = np.zeros((LOOPED + 1, len(model.nominal) // 2, 3))
        blocks[..., :2] = draws[:LOOPED + 1].reshape(LOOPED + 1, -1, 2)

        common.say("GetDP looping in one process, and in fresh ones")
        first = getdp_seconds(study, blocks[:1], folder)
        loop = (getdp_seconds(study, blocks, folder) - first) / LOOPED
        alone = float(np.mean([getdp_seconds(study, blocks[k:k + 1], folder)
                               for k in range(ALONE)]))
        common.say(f"{MANY} condensed solves")
        started = time.monotonic()
        steps = 0
        for row in draws:
            _, statistics = model.condensed.solve(row, ENGINE_TOLERANCE_T)
            steps += statistics.newton_steps
        total = time.monotonic() - started
        note("nonlinear.seconds_18000", total, "s", f"{MANY} solves to {ENGINE_TOLERANCE_T:g} T, "
             f"{steps} Newton steps in all")
        note("nonlinear.speedup_vs_getdp_loop", loop * MANY / total, "ratio",
             f"per solve; GetDP {loop:.2f} s, warm start, tolerance {LOOP_TOLERANCE:g}")
        note("nonlinear.speedup_vs_process", alone * MANY / total, "ratio",
             f"per solve; a fresh GetDP process takes {alone:.2f} s")
        started = time.monotonic()
        model.jacobian(draws[0])
        note("nonlinear.jacobian_over_newton", (time.monotonic() - started) / loop, "ratio",
             f"all {len(model.nominal)} columns over one Newton solve of GetDP's loop")

        common.say(f"{SAMPLES + HARD} solves compared with GetDP")
        size = float(np.linalg.norm(model.nominal.reshape(-1, 2), axis=1).max())
        hard = size * generator.standard_normal((HARD, len(model.nominal)))
        worst = 0.0
        for part, cold in ((draws[:SAMPLES], False), (hard, True)):
            theirs = newton_readings(build_magnet(study), observation, replace(
                session, folder=folder / "compared"), part, cold)
            worst = max(worst, float(np.abs(model(part) - theirs).max()))
        note("nonlinear.engine_error_T", worst, "T", f"largest difference at {len(observation)} "
             f"readings of {SAMPLES} draws of the prior and {HARD} saturated ones, cold, to "
             "GetDP's Newton method")
