"""Samples of the posterior of a non-linear model.

The chain lives in coordinates xi in which a Gaussian reference is white, p = m + R xi: the prior,
which gives the preconditioned Crank-Nicolson algorithm (S. L. Cotter et al., Statist. Sci. 28
(2013) 424), centred on the prior's mean; or Laplace's approximation at the mode, which gives its
generalized form (D. Rudolf, B. Sprungk, Found. Comput. Math. 18 (2018) 309), with step 1 an
independence sampler. The proposal ``xi' = sqrt(1 - s^2) xi + s eta`` leaves the reference
invariant, so that only target over reference decides whether it is accepted.

With a surrogate a proposal is screened by the cheap model first, and only what passes is solved
for; the second decision corrects the first, and the target stays the exact one (J. A. Christen,
C. Fox, J. Comput. Graph. Statist. 14 (2005) 795).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg as linalg

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import SamplingError
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.noise import NoiseCovariance

Model = Callable[[Floats], Floats]
"""Parameters (m,) to readings (n,)."""

MAX_GAUSS_NEWTON = 30
MODE_TOLERANCE = 1e-3
"""Of a posterior standard deviation: how far the mode may be off."""


@dataclass
class Posterior:
    """The posterior of a model, up to a constant; counts the model's solves.

    Attributes
    ----------
    model : callable
        Parameters (m,) to readings (n,) in T.
    readings : ndarray, shape (n,)
    noise : Noise
    prior : Gaussian
    """

    model: Model
    readings: Floats
    noise: NoiseCovariance
    prior: Gaussian
    solves: int = field(default=0, init=False)

    def log_likelihood(self, parameters: Floats) -> float:
        """Without the constant."""
        self.solves += 1
        residual = self.noise.whiten(self.model(parameters) - self.readings)
        return -float(residual @ residual) / 2


@dataclass(frozen=True)
class ReferenceMeasure:
    """A Gaussian in the prior's own coordinates z, p = mu_0 + L z: z = centre + root xi.

    Attributes
    ----------
    centre : ndarray, shape (k,)
    root, inverse : ndarray, shape (k, k)
    """

    centre: Floats
    root: Floats
    inverse: Floats

    def place(self, xi: Floats) -> Floats:
        """z of xi."""
        return self.centre + self.root @ xi

    def white(self, z: Floats) -> Floats:
        """xi of z."""
        return self.inverse @ (z - self.centre)


def prior_reference(prior: Gaussian) -> ReferenceMeasure:
    """The prior itself."""
    size = prior.root.shape[1]
    return ReferenceMeasure(np.zeros(size), np.eye(size), np.eye(size))


def laplace(
    posterior: Posterior, jacobian: Callable[[Floats], Floats]
) -> tuple[ReferenceMeasure, Floats]:
    """Laplace's approximation: the mode by Gauss-Newton with halved steps, and the curvature there.

    Parameters
    ----------
    jacobian : callable
        Parameters (m,) to dq/dp (n, m).

    Returns
    -------
    reference : Reference
    mode : ndarray, shape (m,)

    Raises
    ------
    SamplingError
        If the mode is not found.
    """
    prior = posterior.prior
    z = np.zeros(prior.root.shape[1])

    def objective(place: Floats) -> float:
        return float(place @ place) / 2 - posterior.log_likelihood(prior.mean + prior.root @ place)

    value = objective(z)
    for _ in range(MAX_GAUSS_NEWTON):
        parameters = prior.mean + prior.root @ z
        whitened = posterior.noise.whiten(jacobian(parameters) @ prior.root)
        residual = posterior.noise.whiten(posterior.readings - posterior.model(parameters))
        factor = linalg.cholesky(np.eye(len(z)) + whitened.T @ whitened)  # upper
        step = linalg.cho_solve((factor, False), whitened.T @ residual - z)
        if np.linalg.norm(factor @ step) < MODE_TOLERANCE:
            root = linalg.solve_triangular(factor, np.eye(len(z)))
            return ReferenceMeasure(z, root, factor), parameters
        length = 1.0
        while (trial := objective(z + length * step)) > value and length > 1e-6:
            length /= 2
        z, value = z + length * step, min(trial, value)
    raise SamplingError(
        f"The posterior's mode was not found in {MAX_GAUSS_NEWTON} Gauss-Newton steps: the readings"
        " and the prior disagree, or the noise is understated. Check the study's noise and prior.")


@dataclass(frozen=True)
class Proposal:
    """A proposal that leaves its reference invariant, ``xi' = sqrt(1 - s^2) xi + s eta``.

    Attributes
    ----------
    reference : Reference
    step : float
        s in (0, 1].
    """

    reference: ReferenceMeasure
    step: float


@dataclass(frozen=True)
class Chain:
    """A chain of samples.

    Attributes
    ----------
    samples : ndarray, shape (steps, m)
        Parameters.
    accepted : float
        Fraction of the proposals.
    last : ndarray, shape (k,)
        z where it ended, to go on from.
    """

    samples: Floats
    accepted: float
    last: Floats


def sample(
    posterior: Posterior, moves: Sequence[Proposal], count: int, generator: np.random.Generator,
    start: Floats, surrogate: Posterior | None = None, first: int = 0,
) -> Chain:
    """Run a chain that takes its moves in turn; each leaves the posterior invariant.

    Laplace's approximation moves fast where the posterior is nearly normal, but its tails may be
    too light; a move of the prior among them, whose weights are bounded, reaches everywhere.

    Parameters
    ----------
    count : int
        Steps, of which each gives a sample.
    start : ndarray, shape (k,)
        z to start from.
    surrogate : Posterior, optional
        Of a cheap model, which screens.
    first : int
        Number of the first step, by which the moves are taken in turn.
    """
    prior = posterior.prior

    def place(z: Floats) -> Floats:
        return np.asarray(prior.mean + prior.root @ z)

    z = start
    value = posterior.log_likelihood(place(z))
    cheap = surrogate.log_likelihood(place(z)) if surrogate else 0.0
    samples = np.empty((count, len(prior.mean)))
    accepted = 0
    for number in range(count):
        move = moves[(first + number) % len(moves)]
        xi = move.reference.white(z)
        xi_there = (np.sqrt(1 - move.step**2) * xi
                    + move.step * generator.standard_normal(len(xi)))
        there = move.reference.place(xi_there)
        # log of prior over reference, there less here
        weight = float(z @ z - there @ there - xi @ xi + xi_there @ xi_there) / 2
        gain, cheap_there = weight, 0.0
        passed = True
        if surrogate is not None:
            cheap_there = surrogate.log_likelihood(place(there))
            screen = weight + cheap_there - cheap
            passed = np.log(generator.uniform()) < screen
            gain = cheap - cheap_there  # what the first decision took for granted
        if passed:
            value_there = posterior.log_likelihood(place(there))
            if np.log(generator.uniform()) < gain + value_there - value:
                z, value, cheap = there, value_there, cheap_there
                accepted += 1
        samples[number] = place(z)
    return Chain(samples, accepted / max(count, 1), z)
