"""The posterior of a magnet with iron that saturates, by samples.

The target is the finite-element posterior itself: every likelihood is a non-linear solve, by the
condensed engine. Laplace's approximation at the mode proposes; every tenth move is by the prior and
reaches the tails that it may lack. Draws are compared with GetDP's own Newton method before
they are handed out, and chains that are too short are refused. Work is stored chunk by chunk: an
interrupted run goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core import untrusted
from halbach_fe.core.arrays import Floats
from halbach_fe.core.code_digest import code_digest
from halbach_fe.core.errors import OutputError, SamplingError
from halbach_fe.core.files import atomic, write_text
from halbach_fe.inference.result import InferenceResult, Prediction
from halbach_fe.response.nonlinear import NonlinearModel, compare_with_newton, nonlinear_model
from halbach_fe.solver.session import Session
from halbach_fe.stats.convergence import (
    ConvergenceDiagnostics,
    assess_convergence,
    require_convergence,
)
from halbach_fe.stats.pcn import Chain, Posterior, Proposal, laplace, prior_reference, sample

CHUNK = 250
"""Draws of every chain between two stored states."""

LAPLACE_STEPS = (1.0, 1.0, 0.6, 1.0, 1.0, 0.3, 1.0, 1.0, 0.6)
"""Long steps where the posterior is nearly normal; short ones leave the tails, where long ones
are never accepted."""

PRIOR_STEP = 0.1
OVERDISPERSED = 2.0
"""Chains start so many of Laplace's standard deviations away; R-hat is blind otherwise."""

VERIFIED_DRAWS = 3
PREDICTED_DRAWS = 200
LIKELIHOOD_ERROR = 1e-2
"""What stopping a solve early may move the log of the likelihood by, about; n readings that miss by
a standard deviation allow each to be off by this part of it over n."""

SMALLEST_TOLERANCE_T = 1e-9
Map = Callable[..., Iterable[Any]]
"""`map`, or that of a `concurrent.futures.Executor`."""

MIN_DRAWS = 20


@dataclass(frozen=True)
class SampledPosterior:
    """Draws of the posterior, and how good they are.

    Attributes
    ----------
    draws : ndarray, shape (chains, draws, parameters), in A/m
    parameters : tuple of str
    accepted : float
        Fraction of the proposals.
    solves : int
        Likelihoods of the chains and of the search for the mode, interrupted runs included.
    agreement_T : float
        Largest difference to GetDP's Newton method, draws of the posterior included.
    diagnostics : Diagnostics
    prediction : Prediction
        Of all readings, held-out ones too.
    """

    draws: Floats
    parameters: tuple[str, ...]
    accepted: float
    solves: int
    agreement_T: float
    diagnostics: ConvergenceDiagnostics
    prediction: Prediction

    @property
    def mean(self) -> Floats:
        """(parameters,) in A/m."""
        return self.draws.mean(axis=(0, 1))

    @property
    def sd(self) -> Floats:
        """(parameters,) in A/m."""
        return self.draws.std(axis=(0, 1))


def sample_posterior(
    update: InferenceResult, session: Session, draws: int, chains: int = 4, seed: int = 1,
    effective: float = 400.0, say: Callable[[str], None] = lambda text: None,
    mapped: Map = map,
) -> SampledPosterior:
    """Sample the posterior of an update whose iron has an H(B) curve.

    Parameters
    ----------
    update : Update
        The linearized one: its readings, noise and prior are used.
    draws, chains : int
        Draws of each chain, of which the first tenth is discarded; chains.
    effective : float
        Effective samples that every parameter must reach.
    mapped : callable
        Runs a function for every chain like `map`, one after another; that of an executor runs
        them at a time, with the same result.

    Raises
    ------
    SamplingError
        If the mode is not found, or the chains are too short.
    """
    if draws < MIN_DRAWS:
        raise SamplingError(f"Input draws must be at least {MIN_DRAWS} of each chain; instead "
                            f"received {draws}. Some 1500 are usual.")
    model = nonlinear_model(update.magnet, update.observation, session,
                            np.random.default_rng(seed), update.prior)
    train = ~update.held_out
    errors = update.noise.with_independent_errors(model.error).subset(train)
    tolerance = max(SMALLEST_TOLERANCE_T,
                    LIKELIHOOD_ERROR * errors.uniform_error_scale / len(errors))
    target = Posterior(_Readings(model, tolerance, train), update.readings[train], errors,
                       update.prior)
    reference, _ = laplace(target, lambda p: model.jacobian(p)[train])
    generators = [np.random.default_rng(one) for one in np.random.SeedSequence(seed).spawn(chains)]
    moves = [Proposal(reference, step) for step in LAPLACE_STEPS] + [
        Proposal(prior_reference(update.prior), PRIOR_STEP)]
    say(f"mode found; {chains} chains of {draws} draws")
    path = session.folder / "chains.nc"
    runs = [_Run(generator, reference.to_z(
        OVERDISPERSED * generator.standard_normal(len(reference.centre))))
        for generator in generators]
    key = _key(update, model, chains, seed)
    target.solves += _resume(path, key, runs)
    while len(runs[0].samples) < draws:
        steps = [(target, moves, min(CHUNK, draws - len(run.samples)), run.generator, run.last,
                  len(run.samples)) for run in runs]
        for run, (chain, generator, solves) in zip(
                runs, mapped(_advance, *zip(*steps, strict=True)), strict=True):
            run.go_on(chain, generator)
            target.solves += solves
        _store(path, key, runs, model.parameters, target.solves)
        say(f"{len(runs[0].samples)} of {draws} draws")
    kept = np.array([run.samples[draws // 10:draws] for run in runs])
    diagnostics = assess_convergence(kept)
    require_convergence(diagnostics, model.parameters, effective)
    flat = kept.reshape(-1, kept.shape[2])
    chosen = flat[np.linspace(0, len(flat) - 1, PREDICTED_DRAWS).astype(int)]
    predicted = model(chosen, tolerance)
    spread = (predicted - predicted.mean(axis=0)) / np.sqrt(len(predicted))
    some = chosen[np.linspace(0, len(chosen) - 1, VERIFIED_DRAWS).astype(int)]
    agreement = compare_with_newton(model, update.magnet, update.observation, session, some)
    return SampledPosterior(
        kept, model.parameters, float(np.mean([run.accepted for run in runs])),
        target.solves, max(agreement, model.agreement_T), diagnostics,
        Prediction(predicted.mean(axis=0), predicted.std(axis=0), lambda rows: spread[:, rows].T,
                   len(spread)))


@dataclass(frozen=True)
class _Readings:
    """Those that update the model, by magnetization."""

    model: NonlinearModel
    tolerance_T: float
    train: NDArray[np.bool_]

    def __call__(self, magnetization: Floats) -> Floats:
        return self.model(magnetization, self.tolerance_T)[self.train]


def _advance(
    target: Posterior, moves: Sequence[Proposal], count: int, generator: np.random.Generator,
    last: Floats, first: int,
) -> tuple[Chain, np.random.Generator, int]:
    """Some more steps of a chain, on any machine; with its generator and the solves they took."""
    own = replace(target)  # counts from zero
    return sample(own, moves, count, generator, last, first=first), generator, own.solves


@dataclass
class _Run:
    """A chain in the making."""

    generator: np.random.Generator
    last: Floats
    samples: Floats = field(default_factory=lambda: np.empty((0, 0)))
    accepted: float = 0.0

    def go_on(self, chain: Chain, generator: np.random.Generator) -> None:
        """Append; the generator is where the chain left it."""
        self.generator = generator
        before = len(self.samples)
        self.samples = np.vstack([self.samples, chain.samples]) if before else chain.samples
        total = len(self.samples)
        self.accepted += (chain.accepted - self.accepted) * (total - before) / total
        self.last = chain.last


def _key(update: InferenceResult, model: NonlinearModel, chains: int, seed: int) -> str:
    """Digest of all that the chains depend on, but their length."""
    digest = hashlib.sha256(f"{chains} {seed}".encode() + code_digest(__name__))
    iron = model.condensed
    noise = update.noise.covariance
    for part in (update.readings, noise.data, noise.indices, noise.indptr, update.held_out,
                 update.prior.mean, update.prior.root, model.error, iron.linear, iron.readings,
                 iron.potential, iron.weights, iron.stiffness.data, iron.gradient.data,
                 iron.law.squares, iron.law.values):
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def _store(
    path: Path, key: str, runs: list[_Run], parameters: tuple[str, ...], solves: int
) -> None:
    """As ArviZ reads it: group ``posterior``, dimensions chain and draw."""
    posterior = xr.Dataset(
        {"magnetization": (("chain", "draw", "parameter"), np.array([r.samples for r in runs]),
                           {"units": "A/m"})},
        coords={"chain": np.arange(len(runs)), "draw": np.arange(len(runs[0].samples)),
                "parameter": list(parameters)})
    state = xr.Dataset(
        {"last": (("chain", "coordinate"), np.array([r.last for r in runs])),
         "accepted": ("chain", np.array([r.accepted for r in runs]))},
        attrs={"key": key, "solves": solves, "generators": json.dumps(
            [r.generator.bit_generator.state for r in runs])})
    try:
        with atomic(path) as temporary:
            posterior.to_netcdf(temporary, group="posterior", engine="h5netcdf")
            state.to_netcdf(temporary, group="state", engine="h5netcdf", mode="a")
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}.") from None


def _resume(path: Path, key: str, runs: list[_Run]) -> int:
    """Go on from what an interrupted run stored, if it is of the same inputs; its solves."""
    count = len(runs)
    try:
        state = untrusted.read_dataset(path, "state")
        if state.attrs["key"] != key:
            return 0
        solves = int(state.attrs["solves"])
        last = untrusted.finite_array(state["last"], (count, len(runs[0].last)))
        accepted = untrusted.finite_array(state["accepted"], (count,))
        stored = untrusted.read_dataset(path, "posterior")["magnetization"]
        samples = untrusted.finite_array(stored, (count, stored.shape[1], len(runs[0].last)))
        generators = [np.random.default_rng() for _ in runs]
        for generator, words in zip(generators, json.loads(state.attrs["generators"]), strict=True):
            generator.bit_generator.state = words
    except MemoryError:
        raise
    except Exception:  # what is damaged, in whatever way, is as good as nothing
        return 0
    for number, run in enumerate(runs):
        run.last, run.samples, run.accepted = last[number], samples[number], float(accepted[number])
        run.generator.bit_generator.state = generators[number].bit_generator.state
    return solves


def sampled_summary(found: SampledPosterior) -> dict[str, object]:
    """What a script wants to know of the samples."""
    return {
        "chains": found.draws.shape[0], "draws": found.draws.shape[1],
        "solves": found.solves, "accepted": found.accepted,
        "largest_r_hat": float(found.diagnostics.r_hat.max()),
        "smallest_bulk_ess": float(found.diagnostics.bulk.min()),
        "smallest_tail_ess": float(found.diagnostics.tail.min()),
        "largest_mcse_over_sd": float((found.diagnostics.mcse / found.sd).max()),
        "agreement_with_getdp_T": found.agreement_T,
    }


def write_sampled(found: SampledPosterior, folder: Path) -> None:
    """Write sampled.json and sampled.csv, a row a parameter; the draws are in chains.nc."""
    text = json.dumps(sampled_summary(found), indent=1, allow_nan=False)
    write_text(folder / "sampled.json", text + "\n")
    columns = (found.parameters, found.mean, found.sd, found.diagnostics.r_hat,
               found.diagnostics.bulk, found.diagnostics.tail, found.diagnostics.mcse)
    rows = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    write_text(folder / "sampled.csv", "\n".join([
        "parameter,mean_A_per_m,sd_A_per_m,r_hat,bulk_ess,tail_ess,mcse_A_per_m", *rows, ""]))


def with_samples(update: InferenceResult, found: SampledPosterior) -> InferenceResult:
    """The update with the samples' prediction, and their mean and covariance as its posterior."""
    flat = found.draws.reshape(-1, found.draws.shape[2])
    root = (flat - flat.mean(axis=0)).T / np.sqrt(len(flat) - 1)
    values, vectors = np.linalg.eigh(root @ root.T)
    from_samples = replace(update.posterior, mean=found.mean,
                           root=vectors * np.sqrt(np.maximum(values, 0)))
    return replace(update, kind="samples", posterior=from_samples,
                   prediction_posterior=found.prediction)
