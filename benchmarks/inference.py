"""The posteriors: time of the linear one, and effective samples of the non-linear one."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.mcmc import sample_posterior
from halbach_fe.measurement.field_map import read_map
from halbach_fe.response.nonlinear import nonlinear_model
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.session import Session
from halbach_fe.stats import posteriors
from halbach_fe.stats.gaussian import Gaussian, independent_noise, nominal_prior
from halbach_fe.stats.posteriors import (
    Posterior,
    Proposal,
    assess_convergence,
    prior_reference,
    sample,
)
from halbach_fe.study.reader import read_study

STUDIES = Path(__file__).parent.parent / "studies"
REPEATS = 5
PCN_STEP, PCN_STEPS = 1 / 80, 18_000  # the paper's
DRAWS = 1500


def posterior_time(note: Note) -> None:
    """576 parameters from 28 080 readings, over the product that it cannot avoid.

    The time depends on sizes, not on numbers: these are random.
    """
    generator = np.random.default_rng(1)
    blocks = build_magnet(read_study(STUDIES / "faser" / "campaign.toml")).blocks
    nominal = np.concatenate([block.magnetization for block in blocks])
    matrix = 1e-9 * generator.standard_normal((28_080, len(nominal)))
    prior = nominal_prior(nominal, 3, 0.01, 1.0, 0.02)
    sigma = np.full(len(matrix), 5e-5)
    readings = matrix @ prior.sample(1, generator)[0]
    times: list[tuple[float, float]] = []
    for _ in range(REPEATS):
        started = time.monotonic()
        whitened = matrix / sigma[:, None]
        whitened.T @ whitened
        middle = time.monotonic()
        posteriors.update(matrix, readings, independent_noise(sigma), prior)
        times.append((middle - started, time.monotonic() - middle))
    product, all_ = np.min(times, axis=0)
    note("inference.posterior_time_over_gram", all_ / product, "ratio",
         f"whitening and numpy's product in one piece: {product:.2f} s")


def linear_errors(note: Note) -> None:
    """The paper's linear case from B: errors of all magnetizations over their sd."""
    folder = STUDIES / "linear-3d"
    study, field = read_study(folder / "study.toml"), read_map(folder / "field.h5")
    assert study.noise is not None
    sigma = study.noise.regions[0].sigma_T
    noise = sigma * np.random.default_rng(1).standard_normal(field["B_T"].shape)
    truth = np.loadtxt(folder / "truth.csv", delimiter=",", skiprows=1).ravel()
    with tempfile.TemporaryDirectory() as name:
        update = infer(build_magnet(study), field.assign(B_T=field["B_T"] + noise),
                       Session(find_getdp(), Path(name), jobs=2))
    z = (update.posterior.mean - truth) / update.posterior.sd
    note("inference.linear_z_rms", float(np.sqrt(np.mean(z**2))), "",
         f"{len(truth)} parameters from {len(update.readings)} readings of magpylib and NGSolve")


def nonlinear(note: Note) -> None:
    """The paper's non-linear case, with the truth drawn from its prior; and the paper's sampler."""
    folder = STUDIES / "nonlinear-2d"
    study = read_study(folder / "study.toml")
    table = np.genfromtxt(folder / "fig3_nonlinear_2d_dM.csv", delimiter=",", names=True)
    nominal = np.concatenate([block.magnetization[:2] for block in build_magnet(study).blocks])
    mean = table["prior_mean_A_per_m"].reshape(2, -1).T.ravel()
    sd = np.abs(table["prior_edge_1_A_per_m"] - table["prior_edge_2_A_per_m"]) / 2
    prior = Gaussian(nominal + mean, np.diag(sd.reshape(2, -1).T.ravel()))
    truth = np.loadtxt(folder / "truth-drawn.csv", delimiter=",", skiprows=1).ravel()
    with tempfile.TemporaryDirectory() as name:
        session = Session(find_getdp(), Path(name), jobs=2)
        started = time.monotonic()
        update = infer(build_magnet(study), read_map(folder / "map-drawn.csv"), session,
                       prior=prior)
        found = sample_posterior(update, session, DRAWS, say=common.say)
        note("inference.nonlinear_seconds", time.monotonic() - started, "s",
             f"all of it: 4 chains of {DRAWS} draws, {found.solves} solves")
        note("inference.nonlinear_z_rms", float(np.sqrt(np.mean(
            ((found.mean - truth) / found.sd) ** 2))), "", "the paper: 1.40")
        note("inference.nonlinear_min_ess", float(found.diagnostics.bulk.min()),
             "effective samples", "worst of 32 parameters")
        note("inference.nonlinear_max_rhat", float(found.diagnostics.r_hat.max()), "", "")
        model = nonlinear_model(build_magnet(study), update.observation, replace(
            session, folder=session.folder / "pcn"), np.random.default_rng(1))
        target = Posterior(lambda p: model(p, 1e-7), update.readings,
                           update.noise.with_independent_errors(model.error), prior)
        common.say(f"the paper's sampler, {PCN_STEPS} steps")
        generator = np.random.default_rng(2)
        chain = sample(target, [Proposal(prior_reference(prior), PCN_STEP)], PCN_STEPS, generator,
                       np.zeros(prior.root.shape[1]))
        theirs = assess_convergence(chain.samples[None]).bulk.min() / PCN_STEPS
        note("inference.ess_per_solve_over_pcn",
             float(found.diagnostics.bulk.min()) / found.solves / theirs, "ratio",
             f"pCN with s = 1/80, {PCN_STEPS} steps from the prior's mean: "
             f"{theirs * PCN_STEPS:.1f} effective samples, an estimate that favours it")


def run(note: Note) -> None:
    """Measure and note."""
    posterior_time(note)
    linear_errors(note)
    nonlinear(note)
