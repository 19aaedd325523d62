"""Where to measure: positions that tell most about the parameters.

The gain of a linear-Gaussian measurement is the mutual information between parameters and readings,
``1/2 log det(I + G G^T)`` nats with G = Sigma^-1/2 H L the readings' response to the whitened
prior: D-optimality (K. Chaloner, I. Verdinelli, Statist. Sci. 10 (1995) 273). It does not depend on
what will be read. Taking the best position one after another reaches at least 1 - 1/e of the best
choice, since the gain is submodular (A. Krause et al., J. Mach. Learn. Res. 9 (2008) 235).
"""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats, Ints


def information(design: Floats) -> float:
    """Expected information gain in nats of readings with whitened response (n, m)."""
    small = design @ design.T if len(design) < design.shape[1] else design.T @ design
    return float(np.linalg.slogdet(np.eye(len(small)) + small)[1]) / 2


def greedy(design: Floats, count: int) -> tuple[Ints, Floats]:
    """Choose positions one after another, each for the largest gain.

    Parameters
    ----------
    design : ndarray, shape (positions, k, m)
        Whitened response of the k readings that are taken at each position.
    count : int
        Positions to choose, each at most once.

    Returns
    -------
    chosen : ndarray, shape (count,)
        In the order of their choice.
    gain : ndarray, shape (count,)
        Expected information in nats of all chosen so far.
    """
    size = design.shape[1]
    covariance = np.eye(design.shape[2])
    # of the readings at each position, given those chosen so far
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
        learnt = np.linalg.solve(root, design[best] @ covariance).T  # (m, k)
        covariance -= learnt @ learnt.T
        seen = design @ learnt
        predicted -= seen @ seen.transpose(0, 2, 1)
    return np.array(chosen), np.array(gains)
