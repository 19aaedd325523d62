"""The posterior of a linear model with Gaussian prior and noise, in closed form.

With p = mu_0 + L z, z ~ N(0, I), and whitened data, the posterior of z minimizes
``|G z - r|^2 + |z|^2`` where G = Sigma^-1/2 H L and r = Sigma^-1/2 (q - H mu_0). That is a least
squares problem of the stacked matrix [G; I], solved by QR: its condition number is the square
root of that of the normal equations in the usual formula
``C_1 = (H' Sigma^-1 H + C_0^-1)^-1`` (C. M. Bishop, Pattern Recognition and Machine Learning,
eq. 2.117), no covariance is ever inverted, and C_0 may be singular.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as linalg

from halbach_fe.blocks import Floats
from halbach_fe.inference.prior import Gaussian


def posterior(matrix: Floats, readings: Floats, sigma: Floats, prior: Gaussian) -> Gaussian:
    """Update a prior with readings q = H p + noise.

    Parameters
    ----------
    matrix : ndarray, shape (n, m)
        H.
    readings, sigma : ndarray, shape (n,)
        q and the standard deviation of its independent noise.
    prior : Gaussian
        Of the m parameters.

    Returns
    -------
    Gaussian
        With a root of as many columns as the prior's.
    """
    q, r, residual = _factorize(matrix, readings, sigma, prior)
    z = linalg.solve_triangular(r, q.T @ residual)
    # cov(z) = (R'R)^-1, so R^-1 is a root of it
    root = linalg.solve_triangular(r, prior.root.T, trans="T").T
    return Gaussian(prior.mean + prior.root @ z, root)


def prior_conflict(matrix: Floats, readings: Floats, sigma: Floats, prior: Gaussian) -> float:
    """How far readings lie from what prior and noise foretell: mean of chi-squared, 1 if all is
    well, with a standard deviation of sqrt(2/n).

    This is ``r' (I + G G')^-1 r / n``, the squared Mahalanobis distance from the prior predictive;
    it equals the minimum of the least squares problem, so the QR gives it for nothing.
    """
    q, _, residual = _factorize(matrix, readings, sigma, prior)
    explained = q.T @ residual
    return float((residual @ residual - explained @ explained) / len(readings))


def _factorize(
    matrix: Floats, readings: Floats, sigma: Floats, prior: Gaussian
) -> tuple[Floats, Floats, Floats]:
    """QR of [G; I], Q's rows of G only, and the whitened residual of the prior mean."""
    whitened = (matrix @ prior.root) / sigma[:, None]
    q, r = linalg.qr(np.vstack([whitened, np.eye(prior.root.shape[1])]), mode="economic")
    return q[:len(readings)], r, (readings - matrix @ prior.mean) / sigma


def predict(matrix: Floats, parameters: Gaussian) -> tuple[Floats, Floats]:
    """Mean and standard deviation (n,) of the noise-free readings H p."""
    root = matrix @ parameters.root
    return matrix @ parameters.mean, np.sqrt(np.einsum("ij,ij->i", root, root))


def chi2_per_reading(matrix: Floats, readings: Floats, sigma: Floats, model: Gaussian) -> float:
    """Mean squared error over the variance of prediction and noise, about 1 if all is well.

    For readings that the model has not seen; those that it was fitted to lie nearer.
    """
    mean, sd = predict(matrix, model)
    return float(np.mean((readings - mean) ** 2 / (sd**2 + sigma**2)))
