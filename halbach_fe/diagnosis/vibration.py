"""Positions that shake: noise in proportion to the gradient, of unknown size.

It is no mean shift, so no signature shows it; the noise with it explains the readings better than
that without, or worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy import special
from scipy.optimize import minimize_scalar

from halbach_fe.blocks import Floats
from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.inference.noise import Noise

AMPLITUDES_M = np.geomspace(2e-5, 5e-4, 8)
"""Standard deviations of a position that are tried, equally likely."""


@dataclass(frozen=True)
class Vibration:
    """How well uncertain positions explain a residual.

    Attributes
    ----------
    log_bayes_factor : float
        Over the noise without, averaged over the amplitude.
    sd_m : float
        The likeliest standard deviation of a position, along each axis.
    """

    log_bayes_factor: float
    sd_m: float


def judge_vibration(
    root: Floats, residual: Floats, noise: Noise, displacement: sparse.csr_array
) -> Vibration:
    """Compare noise with and without vibration.

    Parameters
    ----------
    root : ndarray, shape (n, m)
        H L: what the blocks may do to the readings, in T.
    residual : ndarray, shape (n,)
        Readings less what the model foretells, in T.
    noise : Noise
        Without vibration.
    displacement : sparse array, shape (n, k)
        Change of the readings in T/m as each point moves along each axis.
    """
    moved = displacement @ displacement.T

    def log_evidence(sd: float) -> float:
        total = Noise(sparse.csr_array(noise.covariance + sd**2 * moved))
        marginal = Marginal.of(total.whiten(root))
        whitened = total.whiten(residual)
        chi2 = float(whitened @ marginal.remove(whitened[:, None])[:, 0])
        return -chi2 / 2 - total.log_size - float(
            np.log(np.diag(marginal.factor[0])).sum())

    found = np.array([log_evidence(sd) for sd in AMPLITUDES_M]) - log_evidence(0.0)
    best = int(np.argmax(found))
    near = np.log(AMPLITUDES_M[[max(best - 1, 0), min(best + 1, len(found) - 1)]])
    likeliest = minimize_scalar(lambda one: -log_evidence(np.exp(one)), bounds=tuple(near),
                                method="bounded", options={"xatol": 1e-2})
    return Vibration(float(special.logsumexp(found) - np.log(len(found))),
                     float(np.exp(likeliest.x)))
