"""Small samples of measured blocks, and p-values of many tests."""

from __future__ import annotations

import numpy as np
import scipy.special as special

from halbach_fe.core.arrays import Floats
from halbach_fe.stats.gaussian import Gaussian, block_diagonal_root, stacked_root


def false_discovery_rates(p: Floats) -> Floats:
    """Return p-values (n,) of independent tests, adjusted for their number.

    Of all tests whose adjusted value is at most q, a fraction q is expected to be wrong (Y.
    Benjamini, Y. Hochberg, J. R. Stat. Soc. B 57 (1995) 289). `scipy.stats` has the same, and takes
    most of a second to import.
    """
    order = np.argsort(p)
    adjusted = np.empty(len(p))
    adjusted[order[::-1]] = np.minimum.accumulate(
        (p[order] * len(p) / np.arange(1, len(p) + 1))[::-1])
    return np.minimum(adjusted, 1.0)


def shrunk_covariance(samples: Floats) -> tuple[Floats, float]:
    """Return the covariance of few samples, shrunk towards a multiple of the identity.

    The estimator is that of O. Ledoit, M. Wolf, J. Multivariate Anal. 88 (2004) 365, about the
    sample mean and multiplied by n/(n - 1).

    Parameters
    ----------
    samples : ndarray, shape (n, d)

    Returns
    -------
    covariance : ndarray, shape (d, d)
        Positive definite for any n > 1, unless all samples are equal.
    intensity : float
        Shrinkage intensity: weight of the multiple of the identity, 0 to 1.
    """
    count, size = samples.shape
    centred = samples - samples.mean(axis=0)
    sample = centred.T @ centred / count
    target = np.trace(sample) / size * np.eye(size)
    distance = np.sum((sample - target) ** 2)
    error = np.sum((np.einsum("ni,nj->nij", centred, centred) - sample) ** 2) / count**2
    intensity = 1.0 if distance <= error else float(error / distance)
    shrunk = intensity * target + (1 - intensity) * sample
    return count / (count - 1) * shrunk, intensity


def predictive_covariance(samples: Floats) -> tuple[Floats, float]:
    """Return the covariance of a new sample about the true mean, including its own uncertainty.

    The true covariance is unknown, so that the estimated covariance is widened. For n > d + 2
    samples the result is the sample covariance times (n - 1)/(n - 3), the second moment of
    Student's t distribution: deviations divided by these standard deviations have an rms of 1,
    whatever the true covariance. For fewer samples the result is the shrunk covariance times
    k/(k - 2), where k = (n - 1)(1 + intensity (d - 1)) is the number of degrees of freedom of the
    estimated variances. The rms is then 1 on average over the components; in simulations it was
    between 0.4 and 1.5 for single components whose true standard deviations differed by a factor of
    five.

    ``samples`` (n, d): at least three samples.

    Returns
    -------
    covariance : ndarray, shape (d, d)
    intensity : float
        Shrinkage intensity, see `shrunk_covariance`; 0 if the sample covariance is used.
    """
    count, size = samples.shape
    if count > size + 2:
        covariance, intensity = np.atleast_2d(np.cov(samples.T)), 0.0
    else:
        covariance, intensity = shrunk_covariance(samples)
    freedom = (count - 1) * (1 + intensity * (size - 1))
    # three samples with hardly any shrinkage have 2 degrees of freedom: t has no finite variance
    return covariance * freedom / max(freedom - 2, 0.5), intensity


def measured_prior(
    mean: Floats, own: Floats, shared: Floats, mounting_sd: float, common_mode_sd: float
) -> Gaussian:
    """Return the prior of all magnetizations from the measured blocks.

    The covariance is the sum of the blocks' independent deviations, of deviations that several
    blocks share, of random rotations at mounting, and of a common relative deviation.

    Parameters
    ----------
    mean : ndarray, shape (blocks, d), in A/m
    own : ndarray, shape (blocks, d, d), in A^2/m^2
        Covariance of the independent deviation of each block, positive definite.
    shared : ndarray, shape (blocks, d, s), in A/m
        Root of the covariance of deviations that several blocks share; s may be 0.
    mounting_sd : float
        Standard deviation in rad of the rotation t about each axis at the mounting of a block. The
        change t x M of its magnetization M has the covariance ``mounting_sd^2 (|M|^2 - M M^T)``.
    common_mode_sd : float
        Standard deviation of the relative error of the calibration of the Helmholtz coil, which all
        blocks share.
    """
    outer = np.einsum("bi,bj->bij", mean, mean)
    across = np.sum(mean**2, axis=1)[:, None, None] * np.eye(mean.shape[1]) - outer
    roots = np.linalg.cholesky(own + mounting_sd**2 * across)
    return Gaussian(mean.ravel(), stacked_root(
        block_diagonal_root(roots), shared.reshape(mean.size, -1),
        common_mode_sd * mean.reshape(-1, 1)))


def anderson_darling(samples: Floats) -> tuple[float, float]:
    """Test whether samples (n,) are normally distributed, with unknown mean and variance.

    `scipy.stats.anderson` gives p-values between 0.01 and 0.15 only, which is too narrow a range
    for the correction by `holm`.

    Returns
    -------
    statistic : float
        Anderson-Darling statistic, A^2 (1 + 0.75/n + 2.25/n^2).
    p : float
        p-value, by the approximation of M. A. Stephens in R. B. D'Agostino, M. A. Stephens (eds.),
        Goodness-of-Fit Techniques (1986), table 4.9.

    Both are NaN for fewer than eight samples, and if all samples are equal.
    """
    count = len(samples)
    # smallest sample size for which the approximation of the Anderson-Darling p-value is valid
    fewest = 8
    if count < fewest or np.ptp(samples) == 0:
        return np.nan, np.nan
    z = np.sort((samples - samples.mean()) / samples.std(ddof=1))
    odd = 2 * np.arange(count) + 1
    a2 = -count - np.mean(odd * (special.log_ndtr(z) + special.log_ndtr(-z[::-1])))
    a = float(a2 * (1 + 0.75 / count + 2.25 / count**2))
    if a >= 0.6:
        # the fitted parabola rises again beyond 153; at 100 p is already far below any use
        return a, float(np.exp(1.2937 - 5.709 * min(a, 100) + 0.0186 * min(a, 100) ** 2))
    if a > 0.34:
        return a, float(np.exp(0.9177 - 4.279 * a - 1.38 * a**2))
    if a > 0.2:
        return a, float(1 - np.exp(-8.318 + 42.796 * a - 59.938 * a**2))
    return a, float(1 - np.exp(-13.436 + 101.14 * a - 223.73 * a**2))


def holm(p: Floats) -> Floats:
    """Adjust p-values (n,) for multiple testing by Holm's method; NaN stays NaN and is not counted.

    The probability that any true hypothesis has an adjusted p-value below alpha is at most alpha
    (S. Holm, Scand. J. Statist. 6 (1979) 65).
    """
    adjusted = np.full(p.shape, np.nan)
    tests = np.flatnonzero(~np.isnan(p))
    order = tests[np.argsort(p[tests])]
    steps = p[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted
