"""Convergence of Markov chains: R-hat, effective sample size and Monte Carlo error.

R-hat is rank-normalized and split. The definitions are those of A. Vehtari, A. Gelman, D. Simpson,
B. Carpenter, P.-C. Buerkner, Bayesian Anal. 16 (2021) 667; ArviZ computes them.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import SamplingError

MAX_R_HAT = 1.01
MIN_EFFECTIVE = 400.0
"""Limits that the paper cited above recommends: the largest R-hat, and the smallest effective
sample size with which R-hat and the quantiles can be trusted."""


@dataclass(frozen=True)
class ConvergenceDiagnostics:
    """Convergence diagnostics of each of m parameters.

    Attributes
    ----------
    r_hat : ndarray, shape (m,)
        Rank-normalized split R-hat.
    bulk, tail : ndarray, shape (m,)
        Effective sample sizes for the mean, and for the 5 and 95 % quantiles.
    mcse : ndarray, shape (m,)
        Monte Carlo standard error of the mean, in the parameter's unit.
    chains, samples : int
        Number of chains, and of the samples of all chains together.
    """

    r_hat: Floats
    bulk: Floats
    tail: Floats
    mcse: Floats
    chains: int
    samples: int


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
    found : ConvergenceDiagnostics
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
            f"needed. Take about {time * effective / found.chains:.0f} draws per chain, and a "
            "tenth more as burn-in.")
    apart = int(np.argmax(found.r_hat))
    if found.r_hat[apart] > MAX_R_HAT:
        raise SamplingError(
            f"The chains do not agree on {names[apart]}: its R-hat is {found.r_hat[apart]:.3f}, "
            f"where at most {MAX_R_HAT} is allowed. Take more draws; if that does not help, the "
            "posterior probably has several modes.")
