"""Whether chains have converged: rank-normalized split R-hat, effective samples, Monte Carlo error.

A. Vehtari, A. Gelman, D. Simpson, B. Carpenter, P.-C. Buerkner, Bayesian Anal. 16 (2021) 667; by
ArviZ.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import SamplingError

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # ArviZ announces its next version
    import arviz

MAX_R_HAT = 1.01
MIN_EFFECTIVE = 400.0
"""What the paper above asks for before R-hat and the quantiles can be trusted."""


@dataclass(frozen=True)
class ConvergenceDiagnostics:
    """Of every parameter, arrays of shape (m,).

    Attributes
    ----------
    r_hat : ndarray
    bulk, tail : ndarray
        Effective samples for the mean and for the 5 and 95 % quantiles.
    mcse : ndarray
        Monte Carlo standard error of the mean, in the parameter's unit.
    chains, samples : int
        Chains, and samples of all of them.
    """

    r_hat: Floats
    bulk: Floats
    tail: Floats
    mcse: Floats
    chains: int
    samples: int


def assess_convergence(samples: Floats) -> ConvergenceDiagnostics:
    """Diagnostics of samples (chains, draws, m)."""
    data = xr.Dataset({"x": (("chain", "draw", "parameter"), samples)})

    def figure(found: xr.Dataset) -> Floats:
        return np.asarray(found["x"].values, float)

    return ConvergenceDiagnostics(
        figure(arviz.rhat(data)), figure(arviz.ess(data)), figure(arviz.ess(data, method="tail")),
        figure(arviz.mcse(data)), samples.shape[0], samples.shape[0] * samples.shape[1])


def require_convergence(
    found: ConvergenceDiagnostics, names: Sequence[str], effective: float = MIN_EFFECTIVE
) -> None:
    """Refuse chains that are too short.

    Raises
    ------
    SamplingError
        With the worst parameter, its autocorrelation time, and how many samples would do.
    """
    if not all(np.isfinite(one).all() for one in (found.r_hat, found.bulk, found.tail)):
        raise SamplingError(
            f"The chains cannot be judged: {found.samples // found.chains} draws each are too few, "
            "or one does not move at all. Take some hundreds.")
    smallest = np.minimum(found.bulk, found.tail)
    worst = int(np.argmin(smallest))
    if smallest[worst] < effective:
        time = found.samples / smallest[worst]
        raise SamplingError(
            f"The chains are too short: {names[worst]} has {smallest[worst]:.0f} effective samples "
            f"of {found.samples} (autocorrelation time {time:.0f}), where {effective:.0f} are "
            f"needed. Take some {time * effective / found.chains:.0f} draws of each chain, and a "
            "tenth more that is discarded.")
    apart = int(np.argmax(found.r_hat))
    if found.r_hat[apart] > MAX_R_HAT:
        raise SamplingError(
            f"The chains do not agree on {names[apart]}: its R-hat is {found.r_hat[apart]:.3f}, "
            f"where {MAX_R_HAT} is allowed. Take more draws; if that does not help, the posterior "
            "has several modes.")
