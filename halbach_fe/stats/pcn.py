"""Markov chain Monte Carlo sampling of the posterior of a non-linear model.

Proposals are made in coordinates xi in which a Gaussian reference measure is standard normal,
p = m + R xi. With the prior as the reference this is the preconditioned Crank-Nicolson algorithm
(S. L. Cotter et al., Statist. Sci. 28 (2013) 424), centred on the prior's mean. With Laplace's
approximation at the mode it is the generalized algorithm of D. Rudolf, B. Sprungk (Found. Comput.
Math. 18 (2018) 309); a step of 1 makes it an independence sampler. The proposal
``xi' = sqrt(1 - s^2) xi + s eta`` leaves the reference invariant, so that the acceptance
probability depends only on the ratio of the posterior and reference densities.

Convergence of chains is judged by R-hat, rank-normalized and split, effective sample size and Monte
Carlo error. The definitions are those of A. Vehtari, A. Gelman, D. Simpson, B. Carpenter, P.-C.
Buerkner, Bayesian Anal. 16 (2021) 667; ArviZ computes them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg as linalg
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import SamplingError
from halbach_fe.stats.gaussian import Gaussian, NoiseCovariance

Model = Callable[[Floats], Floats]
"""Maps parameters (m,) to readings (n,)."""


@dataclass
class Posterior:
    """The unnormalized posterior of a model, which the chain samples."""

    model: Model
    """Maps parameters (m,) to readings (n,) in T."""
    readings: Floats
    """Shape (n,), in T."""
    noise: NoiseCovariance
    """Noise of the n readings."""
    prior: Gaussian
    """Prior of the m parameters."""
    solves: int = field(default=0, init=False)
    """Number of evaluations of the log likelihood so far; each solves the model once."""

    def log_likelihood(self, parameters: Floats) -> float:
        """Return the log likelihood of parameters (m,), up to a constant."""
        self.solves += 1
        residual = self.noise.whiten(self.model(parameters) - self.readings)
        return -float(residual @ residual) / 2


@dataclass(frozen=True)
class ReferenceMeasure:
    """A Gaussian reference measure in the prior's whitened coordinates z, p = mu_0 + L z.

    ``z = centre + root xi`` is distributed like the reference if xi is standard normal.
    """

    centre: Floats
    """Shape (k,)."""
    root: Floats
    inverse: Floats
    """Square root of the covariance of z, and the inverse of this root. Shape (k, k)."""

    def to_z(self, xi: Floats) -> Floats:
        """Return z (k,) of the reference coordinates xi (k,)."""
        return self.centre + self.root @ xi

    def to_xi(self, z: Floats) -> Floats:
        """Return the reference coordinates xi (k,) of z (k,)."""
        return self.inverse @ (z - self.centre)


def prior_reference(prior: Gaussian) -> ReferenceMeasure:
    """Return the prior as the reference measure."""
    size = prior.root.shape[1]
    return ReferenceMeasure(np.zeros(size), np.eye(size), np.eye(size))


def laplace(
    posterior: Posterior, jacobian: Callable[[Floats], Floats]
) -> tuple[ReferenceMeasure, Floats]:
    """Return Laplace's approximation of the posterior as a reference measure.

    The mode is found by Gauss-Newton steps, which are halved until the posterior density increases;
    the covariance is the inverse of the Gauss-Newton Hessian at the mode.

    ``jacobian``: maps parameters (m,) to the derivatives dq/dp (n, m) of the readings.

    Returns
    -------
    reference : ReferenceMeasure
    mode : ndarray, shape (m,)
        Parameters at the mode.

    Raises
    ------
    SamplingError
        If the mode is not found in 30 steps.
    """
    prior = posterior.prior
    z = np.zeros(prior.root.shape[1])

    def objective(at: Floats) -> float:
        return float(at @ at) / 2 - posterior.log_likelihood(prior.mean + prior.root @ at)

    value = objective(z)
    max_steps = 30  # largest number of Gauss-Newton steps to the mode
    # length of a Gauss-Newton step, in posterior standard deviations, below which the mode counts
    # as found
    mode_tolerance = 1e-3
    for _ in range(max_steps):
        parameters = prior.mean + prior.root @ z
        whitened = posterior.noise.whiten(jacobian(parameters) @ prior.root)
        residual = posterior.noise.whiten(posterior.readings - posterior.model(parameters))
        factor = linalg.cholesky(np.eye(len(z)) + whitened.T @ whitened)  # upper
        step = linalg.cho_solve((factor, False), whitened.T @ residual - z)
        if np.linalg.norm(factor @ step) < mode_tolerance:
            root = linalg.solve_triangular(factor, np.eye(len(z)))
            return ReferenceMeasure(z, root, factor), parameters
        length = 1.0
        while (trial := objective(z + length * step)) > value and length > 1e-6:
            length /= 2
        z, value = z + length * step, min(trial, value)
    raise SamplingError(
        f"The posterior's mode was not found in {max_steps} Gauss-Newton steps: the readings"
        " and the prior disagree, or the noise is understated. Check the study's noise and prior.")


@dataclass(frozen=True)
class Proposal:
    """A proposal that keeps its reference measure, ``xi' = sqrt(1 - s^2) xi + s eta``."""

    reference: ReferenceMeasure
    """Measure in whose coordinates xi the step is taken."""
    step: float
    """Step size s in (0, 1]."""


@dataclass(frozen=True)
class Chain:
    """A Markov chain of samples."""

    samples: Floats
    """Parameters after each step. Shape (steps, m)."""
    accepted: float
    """Fraction of the proposals that were accepted."""
    last: Floats
    """Whitened coordinates z of the last sample, from which the chain can be continued.
    Shape (k,)."""


def sample(
    posterior: Posterior, proposals: Sequence[Proposal], count: int, generator: np.random.Generator,
    start: Floats, first: int = 0,
) -> Chain:
    """Run a Markov chain that uses the proposals in turn; each leaves the posterior invariant.

    Proposals from Laplace's approximation mix fast where the posterior is nearly normal, but the
    approximation may have lighter tails than the posterior. Proposals from the prior should be
    among them: their acceptance weights are bounded, so that the chain reaches the tails too.

    Parameters
    ----------
    posterior : Posterior
        Distribution to sample.
    count : int
        Number of steps; each gives a sample.
    start : ndarray, shape (k,)
        Whitened coordinates z at which the chain starts.
    first : int
        Number of the first step; step i uses the proposal ``i % len(proposals)``.
    """
    prior = posterior.prior

    def parameters_at(z: Floats) -> Floats:
        return np.asarray(prior.mean + prior.root @ z)

    z = start
    value = posterior.log_likelihood(parameters_at(z))
    samples = np.empty((count, len(prior.mean)))
    accepted = 0
    for number in range(count):
        proposal = proposals[(first + number) % len(proposals)]
        xi = proposal.reference.to_xi(z)
        xi_new = (np.sqrt(1 - proposal.step**2) * xi
                  + proposal.step * generator.standard_normal(len(xi)))
        z_new = proposal.reference.to_z(xi_new)
        # log of the ratio of prior and reference densities: proposed minus current value
        weight = float(z @ z - z_new @ z_new - xi @ xi + xi_new @ xi_new) / 2
        value_new = posterior.log_likelihood(parameters_at(z_new))
        if np.log(generator.uniform()) < weight + value_new - value:
            z, value = z_new, value_new
            accepted += 1
        samples[number] = parameters_at(z)
    return Chain(samples, accepted / max(count, 1), z)


MAX_R_HAT = 1.01
MIN_EFFECTIVE = 400.0
"""Limits that the paper cited above recommends: the largest R-hat, and the smallest effective
sample size with which R-hat and the quantiles can be trusted."""


@dataclass(frozen=True)
class ConvergenceDiagnostics:
    """Convergence diagnostics of each of m parameters."""

    r_hat: Floats
    """Rank-normalized split R-hat. Shape (m,)."""
    bulk: Floats
    tail: Floats
    """Effective sample sizes for the mean, and for the 5 and 95 % quantiles. Shape (m,)."""
    mcse: Floats
    """Monte Carlo standard error of the mean, in the parameter's unit. Shape (m,)."""
    chains: int
    samples: int
    """Number of chains, and of the samples of all chains together."""


def assess_convergence(samples: Floats) -> ConvergenceDiagnostics:
    """Return the diagnostics of samples (chains, draws, m)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ArviZ warns on import of its next version
        import arviz  # here, as that takes seconds, which processes of single chains can do without

    data = xr.Dataset({"x": (("chain", "draw", "parameter"), samples)})

    def figure(found: xr.Dataset) -> Floats:
        return np.asarray(found["x"].values, float)

    return ConvergenceDiagnostics(
        figure(arviz.rhat(data)), figure(arviz.ess(data)), figure(arviz.ess(data, method="tail")),
        figure(arviz.mcse(data)), samples.shape[0], samples.shape[0] * samples.shape[1])


def require_convergence(
    found: ConvergenceDiagnostics, names: Sequence[str], effective: float = MIN_EFFECTIVE
) -> None:
    """Check that the chains are long enough and agree with each other.

    Parameters
    ----------
    names : sequence of str
        Names of the parameters, for the error message.
    effective : float
        Smallest effective sample size that is accepted.

    Raises
    ------
    SamplingError
        If the chains are too short or disagree. The message names the worst
        parameter and, for chains that are too short, its autocorrelation time and the number of
        draws that would suffice.
    """
    if not all(np.isfinite(values).all() for values in (found.r_hat, found.bulk, found.tail)):
        raise SamplingError(
            f"The convergence of the chains cannot be judged: {found.samples // found.chains} "
            "draws per chain are too few, or a chain never accepted a proposal. Take several "
            "hundred draws per chain.")
    smallest = np.minimum(found.bulk, found.tail)
    worst = int(np.argmin(smallest))
    if smallest[worst] < effective:
        time = found.samples / smallest[worst]
        raise SamplingError(
            f"The chains are too short: {names[worst]} has {smallest[worst]:.0f} effective samples "
            f"of {found.samples} (autocorrelation time {time:.0f}), where {effective:.0f} are "
            f"needed. Take about {2 * time * effective / found.chains:.0f} draws per chain, and a "
            "tenth more as burn-in.")  # twice: short chains hardly know their autocorrelation time
    apart = int(np.argmax(found.r_hat))
    if found.r_hat[apart] > MAX_R_HAT:
        raise SamplingError(
            f"The chains do not agree on {names[apart]}: its R-hat is {found.r_hat[apart]:.3f}, "
            f"where at most {MAX_R_HAT} is allowed. Take "
            f"{2 * found.samples // found.chains} draws per chain; if that does not help, the "
            "posterior probably has several modes.")
