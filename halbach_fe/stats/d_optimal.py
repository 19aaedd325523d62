"""D-optimal choice of the positions that are most informative about the parameters.

The information gain of a linear-Gaussian measurement is the mutual information between parameters
and readings, ``1/2 log det(I + G G^T)`` nats, where G = Sigma^-1/2 H L is the whitened response of
the readings to the whitened parameters (D-optimality; K. Chaloner, I. Verdinelli, Statist. Sci. 10
(1995) 273). The gain does not depend on the values of the readings, so that it is known before the
measurement. The gain is submodular; a greedy choice, position by position, therefore reaches at
least 1 - 1/e of the largest possible gain (A. Krause et al., J. Mach. Learn. Res. 9 (2008) 235).
"""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats, Ints


def information(design: Floats) -> float:
    """Return the information gain in nats of readings with whitened response (n, m)."""
    small = design @ design.T if len(design) < design.shape[1] else design.T @ design
    return float(np.linalg.slogdet(np.eye(len(small)) + small)[1]) / 2


def greedy(design: Floats, count: int) -> tuple[Ints, Floats]:
    """Choose positions one by one, each for the largest additional information gain.

    Parameters
    ----------
    design : ndarray, shape (positions, k, m)
        Whitened response of the k readings that are taken at each position.
    count : int
        Number of positions to choose; each is chosen at most once.

    Returns
    -------
    chosen : ndarray, shape (count,)
        Indices of the chosen positions, in the order of their choice.
    gain : ndarray, shape (count,)
        Information gain in nats of the positions chosen up to and including each.
    """
    size = design.shape[1]
    covariance = np.eye(design.shape[2])
    # covariance of the noise-free readings at each position, given the positions chosen so far
    predicted = np.einsum("pkm,plm->pkl", design, design)
    chosen: list[int] = []
    gains: list[float] = []
    for _ in range(count):
        gain = np.linalg.slogdet(np.eye(size) + predicted)[1] / 2
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        gains.append((gains[-1] if gains else 0.0) + float(gain[best]))
        chosen.append(best)
        root = np.linalg.cholesky(np.eye(size) + predicted[best])
        reduction = np.linalg.solve(root, design[best] @ covariance).T  # (m, k)
        covariance -= reduction @ reduction.T
        reduction_at = design @ reduction
        predicted -= reduction_at @ reduction_at.transpose(0, 2, 1)
    return np.array(chosen), np.array(gains)
