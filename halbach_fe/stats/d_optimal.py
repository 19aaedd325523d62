"""Choice of the positions that are most informative about parameters, or about values of interest.

The information gain of a linear-Gaussian measurement is the mutual information between parameters
and readings, ``1/2 log det(I + G G^T)`` nats, where G = Sigma^-1/2 H L is the whitened response of
the readings to the whitened parameters (D-optimality; K. Chaloner, I. Verdinelli, Statist. Sci. 10
(1995) 273). The gain does not depend on the values of the readings, so that it is known before the
measurement. The gain is submodular; a greedy choice, position by position, therefore reaches at
least 1 - 1/e of the largest possible gain (A. Krause et al., J. Mach. Learn. Res. 9 (2008) 235).

If only some linear functions of the parameters matter, the sum of their variances is made small
instead (A-optimality). With the roots V of their covariance and C of that of the parameters given
the positions chosen so far, a position with the response G takes ``tr(V C G^T (I + G C G^T)^-1 G C
V^T)`` off it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from halbach_fe.core.arrays import Floats, Ints


def information(design: Floats) -> float:
    """Return the information gain in nats of readings with whitened response (n, m)."""
    small = design @ design.T if len(design) < design.shape[1] else design.T @ design
    return float(np.linalg.slogdet(np.eye(len(small)) + small)[1]) / 2


def variance_left(design: Floats, values: Floats) -> float:
    """Return the sum of the variances of values after readings with whitened response (n, m).

    ``values`` (v, m) is the root of their covariance before the readings, in terms of the same
    whitened parameters.
    """
    if len(design) < design.shape[1]:
        cross = values @ design.T
        fall = np.linalg.solve(np.eye(len(design)) + design @ design.T, cross.T)
        return float(np.sum(values**2) - np.sum(cross * fall.T))
    inner = np.eye(design.shape[1]) + design.T @ design
    return float(np.sum(values * np.linalg.solve(inner, values.T).T))


@dataclass(frozen=True)
class Choice:
    """Positions in the order of their choice, and what they tell.

    Attributes
    ----------
    chosen : ndarray of int, shape (count,)
        Indices of the positions.
    gain : ndarray, shape (count,)
        Information gain in nats of the positions chosen up to and including each.
    fall : ndarray, shape (count,)
        What they take off the sum of the variances of the values of interest; 0 without such.
    """

    chosen: Ints
    gain: Floats
    fall: Floats


def greedy(design: Floats, count: int, values: Floats | None = None) -> Choice:
    """Choose positions one by one, each for the largest gain of information or fall of variance.

    Parameters
    ----------
    design : ndarray, shape (positions, k, m)
        Whitened response of the k readings that are taken at each position.
    count : int
        Number of positions to choose; each is chosen at most once.
    values : ndarray, shape (v, m), optional
        Root of the covariance of the values whose variances are to fall, in terms of the same
        whitened parameters. Without it, the information about all parameters counts.
    """
    size = design.shape[1]
    covariance = np.eye(design.shape[2])
    # covariance of the noise-free readings at each position, given the positions chosen so far
    predicted = np.einsum("pkm,plm->pkl", design, design)
    root = np.zeros((0, design.shape[2])) if values is None else values
    cross = np.einsum("vm,pkm->pvk", root, design)
    chosen: list[int] = []
    gains, falls = np.zeros(count), np.zeros(count)
    for number in range(count):
        spread = np.eye(size) + predicted
        gain = np.linalg.slogdet(spread)[1] / 2
        fall = np.einsum("pvk,pkv->p", cross, np.linalg.solve(spread, cross.swapaxes(1, 2)))
        score = gain.copy() if values is None else fall.copy()
        score[chosen] = -np.inf
        best = int(np.argmax(score))
        gains[number], falls[number] = gain[best], fall[best]
        chosen.append(best)
        reduction = np.linalg.solve(  # (m, k)
            np.linalg.cholesky(spread[best]), design[best] @ covariance).T
        covariance -= reduction @ reduction.T
        reduction_at = design @ reduction
        predicted -= reduction_at @ reduction_at.transpose(0, 2, 1)
        cross -= np.einsum("vj,pkj->pvk", root @ reduction, reduction_at)
    return Choice(np.array(chosen), np.cumsum(gains), np.cumsum(falls))
