"""The posterior of a linear model with Gaussian prior and noise, in closed form.

With p = mu_0 + L z, z ~ N(0, I), the posterior of z has the precision ``S = I + L' A L``, where
``A = H' Sigma^-1 H`` is the one product that all readings take part in (C. M. Bishop, Pattern
Recognition and Machine Learning, eq. 2.117, in whitened coordinates). The eigenvalues of S are at
least 1, no covariance is inverted, and C_0 may be singular. Where readings are so exact that
rounding of A would matter, the least squares problem of the stacked matrix [Sigma^-1/2 H L; I] is
solved by QR instead, which takes several times longer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as linalg

from halbach_fe.blocks import Floats
from halbach_fe.inference.noise import Noise
from halbach_fe.inference.prior import Gaussian

READINGS_AT_ONCE = 8192
"""Rows whitened at a time: memory does not grow with the readings."""

WORST_CONDITION = 1e10
"""Of S, for its Cholesky factor: rounding then moves the posterior by some 1e-6 of its sd."""


@dataclass(frozen=True)
class LinearPosterior:
    """What readings say of the parameters of a linear model.

    Attributes
    ----------
    distribution : Gaussian
        With a root of as many columns as the prior's.
    log_evidence : float
        Logarithm of the probability density of the readings under prior and noise.
    learnt : float
        Effective number of parameters that the readings determine, the trace of I - S^-1
        (D. J. C. MacKay, Neural Comput. 4 (1992) 415).
    conflict : float
        How far the readings lie from what prior and noise foretell: mean of chi-squared,
        ``r' (Sigma + H C_0 H')^-1 r / n``, 1 if all is well, with a standard deviation of
        sqrt(2/n).
    """

    distribution: Gaussian
    log_evidence: float
    learnt: float
    conflict: float


def update(matrix: Floats, readings: Floats, noise: Noise, prior: Gaussian) -> LinearPosterior:
    """Update a prior with readings q = H p + noise.

    Parameters
    ----------
    matrix : ndarray, shape (n, m)
        H.
    readings : ndarray, shape (n,)
        q.
    noise : Noise
        Of the n readings.
    prior : Gaussian
        Of the m parameters.
    """
    residual = noise.whiten(readings - matrix @ prior.mean)
    product, right = _normal(matrix, residual, noise)
    precision = np.eye(prior.root.shape[1]) + prior.root.T @ product @ prior.root
    if np.abs(precision).sum(axis=0).max() < WORST_CONDITION:
        factor = linalg.cholesky(precision)  # upper
        half = linalg.solve_triangular(factor, prior.root.T @ right, trans="T")
    else:
        whitened = noise.whiten(matrix @ prior.root)
        q, factor = linalg.qr(np.vstack([whitened, np.eye(len(precision))]), mode="economic")
        half = q[:len(readings)].T @ residual
    # cov(z) = (R'R)^-1, so R^-1 is a root of it
    root = linalg.solve_triangular(factor, prior.root.T, trans="T").T
    inverse = linalg.solve_triangular(factor, np.eye(len(factor)))
    chi2 = float(residual @ residual - half @ half)
    log_size = float(np.log(np.abs(np.diag(factor))).sum() + noise.log_size
                     + len(readings) / 2 * np.log(2 * np.pi))
    return LinearPosterior(
        Gaussian(prior.mean + root @ half, root), -chi2 / 2 - log_size,
        len(factor) - float((inverse**2).sum()), chi2 / len(readings))


def posterior(matrix: Floats, readings: Floats, noise: Noise, prior: Gaussian) -> Gaussian:
    """The distribution that `update` finds."""
    return update(matrix, readings, noise, prior).distribution


def contraction(prior: Gaussian, after: Gaussian, size: int) -> Floats:
    """By block of ``size`` parameters, (m / size,): 1 - trace(C_1) / trace(C_0); 0 is nothing
    learnt, 1 everything.
    """
    before, now = ((one.sd**2).reshape(-1, size).sum(axis=1) for one in (prior, after))
    return np.asarray(1 - now / before)


def _normal(matrix: Floats, residual: Floats, noise: Noise) -> tuple[Floats, Floats]:
    """H' Sigma^-1 H (m, m) and H' Sigma^-1/2 r (m,), r being whitened."""
    product = np.zeros((matrix.shape[1], matrix.shape[1]))
    right = np.zeros(matrix.shape[1])
    for first in range(0, len(matrix), READINGS_AT_ONCE):
        part = slice(first, first + READINGS_AT_ONCE)
        whitened = noise.whiten(matrix, part)
        product += whitened.T @ whitened
        right += whitened.T @ residual[part]
    return product, right


def predict(matrix: Floats, parameters: Gaussian) -> tuple[Floats, Floats]:
    """Mean and standard deviation (n,) of the noise-free readings H p."""
    mean, variance = matrix @ parameters.mean, np.empty(len(matrix))
    for first in range(0, len(matrix), READINGS_AT_ONCE):
        root = matrix[first:first + READINGS_AT_ONCE] @ parameters.root
        variance[first:first + READINGS_AT_ONCE] = np.einsum("ij,ij->i", root, root)
    return mean, np.sqrt(variance)


def whitened(residual: Floats, noise: Noise, root: Floats) -> Floats:
    """Residuals of a prediction, whitened by its covariance and the noise's, (n,): independent and
    standard normal if all is well.

    Of all roots of the inverse of ``Sigma + R R'`` it is, after W, the symmetric one,
    ``(I + A A')^-1/2`` with A = W R: the nearest to the residual that each reading has by itself.
    By the eigenvectors of A'A it takes the time of one update, however many the readings.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Measured less predicted. Of readings that the model has not seen; those that it was fitted
        to lie nearer.
    noise : Noise
    root : ndarray, shape (n, k)
        Root of the covariance of the prediction.
    """
    own, spread = noise.whiten(residual), noise.whiten(root)
    squares, vectors = linalg.eigh(spread.T @ spread)
    size = np.sqrt(1 + np.maximum(squares, 0))
    # 1/size - 1, over squares
    return np.asarray(own - spread @ (vectors @ (
        (vectors.T @ (spread.T @ own)) / (size * (1 + size)))))
