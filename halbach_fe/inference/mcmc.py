"""Markov chains that sample the posterior of a magnet with saturating iron.

The target is the posterior of the finite-element model itself: every likelihood is a non-linear
solve of the condensed model. Most moves are proposed from Laplace's approximation at the mode.
Every tenth move is proposed from the prior, to reach tails that the approximation may lack. Some
draws are compared with GetDP's own Newton method before the result is returned, and chains that are
too short are refused. The chains are stored chunk by chunk, so that an interrupted run continues
where it stopped.
"""

from __future__ import annotations

import hashlib
import io
import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachWarning, SamplingError, StudyError, must_be
from halbach_fe.core.files import atomic, write_text
from halbach_fe.core.installation import code_digest
from halbach_fe.core.untrusted_files import read_hdf5, with_checksum
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.result import InferenceResult, Prediction
from halbach_fe.measurement.campaign_maps import refuse_open_instruments, refuse_uncertain
from halbach_fe.response.nonlinear import NonlinearModel, compare_with_newton, nonlinear_model
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.posteriors import (
    Chain,
    ConvergenceDiagnostics,
    Posterior,
    Proposal,
    assess_convergence,
    laplace,
    prior_reference,
    require_convergence,
    sample,
)

LAPLACE_STEPS = (1.0, 1.0, 0.6, 1.0, 1.0, 0.3, 1.0, 1.0, 0.6)
"""Step sizes of the moves that are proposed from Laplace's approximation, in turn. Long steps suit
the region where the posterior is nearly normal. Short steps lead a chain out of the tails, where
long ones are never accepted."""

PRIOR_STEP = 0.1
"""Step size of the moves that are proposed from the prior."""

Map = Callable[..., Iterable[Any]]
"""Type of `map`, and of the method ``map`` of a `concurrent.futures.Executor`."""


@dataclass(frozen=True)
class SampledPosterior:
    """Draws of the posterior, with diagnostics of their quality."""

    draws: Floats
    """Shape (chains, draws, parameters), in A/m."""
    parameters: tuple[str, ...]
    """Names of the parameters."""
    accepted: float
    """Fraction of the proposals that were accepted."""
    solves: int
    """Number of likelihoods that the chains and the search for the mode evaluated, including those
    of interrupted runs."""
    agreement_T: float
    """Largest difference from GetDP's Newton method in any reading, of magnetizations drawn from
    the prior and from the posterior."""
    diagnostics: ConvergenceDiagnostics
    prediction: Prediction
    """Prediction of all readings, including the held-out ones."""

    @property
    def mean(self) -> Floats:
        """Posterior mean (parameters,) in A/m."""
        return self.draws.mean(axis=(0, 1))

    @property
    def sd(self) -> Floats:
        """Posterior standard deviation (parameters,) in A/m."""
        return self.draws.std(axis=(0, 1))


def sample_posterior(
    update: InferenceResult, session: Session, draws: int, chains: int = 4, seed: int = 1,
    effective: float = 400.0, say: Callable[[str], None] = lambda text: None,
    mapped: Map = map,
) -> SampledPosterior:
    """Sample the posterior of an update whose iron has an H(B) curve.

    Parameters
    ----------
    update : InferenceResult
        The inference with linearized iron, whose readings, noise and prior are used.
    session : Session
        Its folder receives the chains and the runs of GetDP.
    draws : int
        Number of draws of each chain, of which the first tenth is discarded.
    chains : int
        Number of chains.
    seed : int
        Seed of the random numbers of the chains.
    effective : float
        Number of effective samples that every parameter must reach.
    say : callable, optional
        Called with a line of text about each step, to report progress.
    mapped : callable
        Calls a function for every chain, like `map`. The method ``map`` of an executor runs the
        chains in parallel, with the same result.

    Raises
    ------
    StudyError
        If the study cannot be sampled, see `check_sampling`.
    SamplingError
        If the mode is not found, or the chains are too short.
    GetDPError
        If the condensed model does not agree with GetDP.
    """
    min_draws = 20  # smallest accepted number of draws of each chain
    smallest_tolerance_t = 1e-9  # smallest tolerance of a solve in T
    # Approximate error of the log likelihood that stopping a solve early may cause. If n readings
    # deviate by about a standard deviation each, every reading may be wrong by this fraction of its
    # standard deviation divided by n.
    likelihood_error = 1e-2
    predicted_draws = 200  # number of draws for which all readings are predicted
    verified_draws = 3  # number of draws that are compared with GetDP's Newton method
    # Spread of the starting points of the chains, in standard deviations of Laplace's
    # approximation. R-hat detects chains that have not converged only if the starting points are
    # overdispersed.
    overdispersed = 2.0
    chunk = 250  # number of draws of every chain between two stored states
    if draws < min_draws:
        raise SamplingError(f"Input draws must be at least {min_draws} of each chain; instead "
                            f"received {draws}. About 1500 are usual.")
    check_sampling(update.magnet)
    root = np.asarray(update.prior.root)
    # without the coordinates of what is no parameter of the blocks, such as the solver's error
    prior = Gaussian(update.prior.mean, root[:, root.any(axis=0)])
    model = nonlinear_model(update.magnet, update.observation, session,
                            np.random.default_rng(seed), prior)
    train = ~update.held_out
    errors = update.noise.with_independent_errors(model.error).subset(train)
    tolerance = max(smallest_tolerance_t,
                    likelihood_error * errors.uniform_error_scale / len(errors))
    target = Posterior(_Readings(model, tolerance, train), update.readings[train], errors, prior)
    reference, _ = laplace(target, lambda p: model.jacobian(p)[train])
    generators = [np.random.default_rng(part)
                  for part in np.random.SeedSequence(seed).spawn(chains)]
    moves = [Proposal(reference, step) for step in LAPLACE_STEPS] + [
        Proposal(prior_reference(prior), PRIOR_STEP)]
    say(f"mode found; {chains} chains of {draws} draws")
    path = session.folder / "chains.nc"
    runs = [_Run(generator, reference.to_z(
        overdispersed * generator.standard_normal(len(reference.centre))))
        for generator in generators]
    key = _key(update, model, chains, seed)
    target.solves += _resume(path, key, runs, len(model.parameters))
    while len(runs[0].samples) < draws:
        steps = [(target, moves, min(chunk, draws - len(run.samples)), run.generator, run.last,
                  len(run.samples)) for run in runs]
        for run, (chain, generator, solves) in zip(
                runs, mapped(_advance, *zip(*steps, strict=True)), strict=True):
            run.append(chain, generator)
            target.solves += solves
        _store(path, key, runs, model.parameters, target.solves)
        say(f"{len(runs[0].samples)} of {draws} draws")
    kept = np.array([run.samples[draws // 10:draws] for run in runs])
    diagnostics = _assessed(kept, model.parameters, update.prior.sd > 0, effective)
    flat = kept.reshape(-1, kept.shape[2])
    chosen = flat[np.linspace(0, len(flat) - 1, predicted_draws).astype(int)]
    predicted = model(chosen, tolerance)
    spread = (predicted - predicted.mean(axis=0)) / np.sqrt(len(predicted))
    verified = chosen[np.linspace(0, len(chosen) - 1, verified_draws).astype(int)]
    agreement = compare_with_newton(model, update.magnet, update.observation, session, verified)
    return SampledPosterior(
        kept, model.parameters, float(np.mean([run.accepted for run in runs])),
        target.solves, max(agreement, model.agreement_T), diagnostics,
        Prediction(predicted.mean(axis=0), predicted.std(axis=0), lambda rows: spread[:, rows].T,
                   len(spread)))


def check_sampling(magnet: Magnet) -> None:
    """Refuse a magnet whose non-linear model needs a mesh that it cannot have, or of which more is
    open than the blocks, which alone are parameters of the model: an instrument, amplitudes, or the
    blocks of neighbours.

    Raises
    ------
    StudyError
        If a 3D array does not consist of equal rings, which the mesh of the model takes them to be,
        or the study has neighbours, open instruments or uncertain amplitudes.
    """
    refuse_open_instruments(magnet.study, "--samples")
    refuse_uncertain(magnet.study, "--samples")
    if magnet.external.neighbours:
        raise StudyError(must_be(
            "`external.neighbours`", f"study {magnet.name}", "left out, to sample the posterior "
            "(--samples)", f"{len(magnet.external.neighbours)} of them",
            "Leave --samples out: the posterior with linearized iron has what the blocks of "
            "neighbours deviate, which the chains do not."))
    if magnet.dimension == 3 and not magnet.array.is_uniform:
        raise StudyError(
            f"Input `array` of study {magnet.name} must consist of equal rings to sample the "
            "posterior (--samples); instead it has rings of their own or free blocks. Leave "
            "--samples out: the posterior with linearized iron is checked against the non-linear "
            "field.")


def _assessed(
    samples: Floats, names: Sequence[str], free: NDArray[np.bool_], effective: float
) -> ConvergenceDiagnostics:
    """Return the diagnostics of samples (chains, draws, m) that have converged.

    Parameters that are not ``free`` (m,), those of missing blocks, are known exactly.

    SamplingError if the free parameters have not converged.
    """
    found = assess_convergence(samples[:, :, free])
    require_convergence(found, [name for name, one in zip(names, free, strict=True) if one],
                        effective)

    def whole(values: Floats, constant: float) -> Floats:
        every = np.full(len(free), constant)
        every[free] = values
        return every

    return replace(found, r_hat=whole(found.r_hat, 1.0), bulk=whole(found.bulk, found.samples),
                   tail=whole(found.tail, found.samples), mcse=whole(found.mcse, 0.0))


@dataclass(frozen=True)
class _Readings:
    """The map from magnetizations to the training readings; unlike a closure it can be pickled."""

    model: NonlinearModel
    tolerance_T: float
    train: NDArray[np.bool_]

    def __call__(self, magnetization: Floats) -> Floats:
        return self.model(magnetization, self.tolerance_T)[self.train]


def _advance(
    target: Posterior, moves: Sequence[Proposal], count: int, generator: np.random.Generator,
    last: Floats, first: int,
) -> tuple[Chain, np.random.Generator, int]:
    """Return the next steps of a chain, its generator after them, and the number of solves.

    The function runs in this process or in a worker on any machine, so that it returns the changed
    generator.
    """
    own = replace(target)  # a copy, whose number of solves starts at zero
    return sample(own, moves, count, generator, last, first=first), generator, own.solves


@dataclass
class _Run:
    """The state of a chain between two chunks."""

    generator: np.random.Generator
    last: Floats
    """Last point of the chain, in the whitened coordinates of `Chain`."""
    samples: Floats = field(default_factory=lambda: np.empty((0, 0)))
    """Shape (draws, parameters), in A/m."""
    accepted: float = 0.0
    """Fraction of the proposals that were accepted so far."""

    def append(self, chain: Chain, generator: np.random.Generator) -> None:
        """Append the steps of a chain, and keep the generator in the state after them."""
        self.generator = generator
        before = len(self.samples)
        self.samples = np.vstack([self.samples, chain.samples]) if before else chain.samples
        total = len(self.samples)
        self.accepted += (chain.accepted - self.accepted) * (total - before) / total
        self.last = chain.last


def _key(update: InferenceResult, model: NonlinearModel, chains: int, seed: int) -> str:
    """Return a digest of everything that the chains depend on, except their length."""
    digest = hashlib.sha256(f"{chains} {seed}".encode() + code_digest(__name__))
    iron = model.condensed
    noise = update.noise.covariance
    for part in (update.readings, noise.data, noise.indices, noise.indptr, update.held_out,
                 update.prior.mean, update.prior.root, model.error, model.offset, iron.linear,
                 iron.readings, iron.potential, iron.weights, iron.stiffness.data,
                 iron.gradient.data, iron.law.squares, iron.law.values):
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def _store(
    path: Path, key: str, runs: list[_Run], parameters: tuple[str, ...], solves: int
) -> None:
    """Store the chains in a NetCDF file with the layout that ArviZ reads.

    The group ``posterior`` has the dimensions chain and draw. The group ``state`` has what is
    needed to continue.
    """
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
    content = io.BytesIO()  # in memory: the HDF5 library crashes if the disk fills up under it
    with_checksum(posterior).to_netcdf(content, group="posterior", engine="h5netcdf")
    with_checksum(state).to_netcdf(content, group="state", engine="h5netcdf", mode="a")
    with atomic(path) as temporary:
        temporary.write_bytes(content.getvalue())


def _resume(path: Path, key: str, runs: list[_Run], parameters: int) -> int:
    """Continue the stored chains of an interrupted run; return the number of its solves.

    The stored chains are ignored, and 0 is returned, if they belong to other inputs or the file is
    missing or damaged, which causes a warning.
    """
    count = len(runs)
    try:
        state = read_hdf5(path, "state")
        if state.attrs["key"] != key:
            return 0
        solves = int(state.attrs["solves"])
        last = untrusted_files.finite_array(state["last"], (count, len(runs[0].last)))
        accepted = untrusted_files.finite_array(state["accepted"], (count,))
        stored = read_hdf5(path, "posterior")["magnetization"]
        samples = untrusted_files.finite_array(stored, (count, stored.shape[1], parameters))
        generators = [np.random.default_rng() for _ in runs]
        states = json.loads(state.attrs["generators"])
        for generator, generator_state in zip(generators, states, strict=True):
            generator.bit_generator.state = generator_state
    except FileNotFoundError:
        return 0
    except MemoryError:
        raise
    except Exception as error:  # a file that is damaged in any way is treated as missing
        warnings.warn(f"The stored chains {path} cannot be used ({error}); sampling starts anew.",
                      HalbachWarning, stacklevel=2)
        return 0
    for number, run in enumerate(runs):
        run.last, run.samples, run.accepted = last[number], samples[number], float(accepted[number])
        run.generator.bit_generator.state = generators[number].bit_generator.state
    return solves


def sampled_summary(sampled: SampledPosterior) -> dict[str, object]:
    """Return the main figures of the samples as plain data, the content of sampled.json."""
    return {
        "chains": sampled.draws.shape[0], "draws": sampled.draws.shape[1],
        "solves": sampled.solves, "accepted": sampled.accepted,
        "largest_r_hat": float(sampled.diagnostics.r_hat.max()),
        "smallest_bulk_ess": float(sampled.diagnostics.bulk.min()),
        "smallest_tail_ess": float(sampled.diagnostics.tail.min()),
        "largest_mcse_over_sd": float(np.divide(
            sampled.diagnostics.mcse, sampled.sd, np.zeros_like(sampled.sd),
            where=sampled.diagnostics.mcse > 0).max()),
        "agreement_with_getdp_T": sampled.agreement_T,
    }


def write_sampled(sampled: SampledPosterior, folder: Path) -> None:
    """Write sampled.json, and sampled.csv with a row per parameter; the draws are in chains.nc."""
    text = json.dumps(sampled_summary(sampled), indent=1, allow_nan=False)
    write_text(folder / "sampled.json", text + "\n")
    columns = (sampled.parameters, sampled.mean, sampled.sd, sampled.diagnostics.r_hat,
               sampled.diagnostics.bulk, sampled.diagnostics.tail, sampled.diagnostics.mcse)
    rows = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    write_text(folder / "sampled.csv", "\n".join([
        "parameter,mean_A_per_m,sd_A_per_m,r_hat,bulk_ess,tail_ess,mcse_A_per_m", *rows, ""]))


def with_samples(update: InferenceResult, sampled: SampledPosterior) -> InferenceResult:
    """Return an inference with its posterior and predictions replaced by those of samples.

    The new posterior is the normal distribution with the mean and covariance of the samples.
    """
    flat = sampled.draws.reshape(-1, sampled.draws.shape[2])
    root = (flat - flat.mean(axis=0)).T / np.sqrt(len(flat) - 1)
    values, vectors = np.linalg.eigh(root @ root.T)
    from_samples = replace(update.posterior, mean=sampled.mean,
                           root=vectors * np.sqrt(np.maximum(values, 0)))
    return replace(update, kind="samples", posterior=from_samples, bent_iron="",
                   prediction_posterior=sampled.prediction, prediction_field=None)
