"""What samples of blocks tell about the others: mean, covariance, and whether they look normal."""

from __future__ import annotations

import numpy as np
import scipy.special as special

from halbach_fe.core.arrays import Floats
from halbach_fe.stats.gaussian import Gaussian, beside, by_block

MIN_TESTED = 8
"""Samples below which the approximation of Anderson and Darling's p-value does not hold."""


def shrunk_covariance(samples: Floats) -> tuple[Floats, float]:
    """Covariance of few samples, drawn towards a multiple of the identity.

    O. Ledoit, M. Wolf, J. Multivariate Anal. 88 (2004) 365, with the samples' own mean taken off
    and the result times n/(n - 1).

    Parameters
    ----------
    samples : ndarray, shape (n, d)

    Returns
    -------
    covariance : ndarray, shape (d, d)
        Positive definite for any n > 1, unless all samples are the same.
    intensity : float
        Weight of the identity, 0 to 1.
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
    """Covariance to expect of a new sample about the true mean, for lack of the true covariance.

    Of n > d + 2 samples it is the sample covariance times (n - 1)/(n - 3), the second moment of
    Student's t: errors over these sd's have an rms of 1, whatever the true covariance. Of fewer it
    is Ledoit and Wolf's, times k/(k - 2) with k = (n - 1)(1 + intensity (d - 1)) the degrees of
    freedom that the variances rest on; the rms is then 1 on average over the components, but
    between 0.4 and 1.5 for single ones if their true sd's differ by a factor of five (simulated).

    Parameters
    ----------
    samples : ndarray, shape (n, d)
        At least 3.

    Returns
    -------
    covariance : ndarray, shape (d, d)
    intensity : float
        Ledoit and Wolf's, 0 where the sample covariance is used.
    """
    count, size = samples.shape
    if count > size + 2:
        covariance, intensity = np.atleast_2d(np.cov(samples.T)), 0.0
    else:
        covariance, intensity = shrunk_covariance(samples)
    freedom = (count - 1) * (1 + intensity * (size - 1))
    # 3 samples that shrink hardly: 2 degrees of freedom, whose t has no variance
    return covariance * freedom / max(freedom - 2, 0.5), intensity


def measured_prior(
    mean: Floats, own: Floats, shared: Floats, mounting_sd: float, common_mode_sd: float
) -> Gaussian:
    """Normal distribution of all magnetizations, of what varies from block to block and what not.

    Parameters
    ----------
    mean : ndarray, shape (blocks, d), in A/m
    own : ndarray, shape (blocks, d, d), in A^2/m^2
        Covariance of what each block has for itself, positive definite.
    shared : ndarray, shape (blocks, d, s), in A/m
        Columns that several blocks have in common; s may be 0.
    mounting_sd : float
        In rad, of the turn t of every block about each axis when it is mounted: t x M has the
        covariance ``mounting_sd^2 (|M|^2 - M M^T)``.
    common_mode_sd : float
        Fraction of the magnetization shared by all, of the coil's calibration.
    """
    outer = np.einsum("bi,bj->bij", mean, mean)
    across = np.sum(mean**2, axis=1)[:, None, None] * np.eye(mean.shape[1]) - outer
    roots = np.linalg.cholesky(own + mounting_sd**2 * across)
    return Gaussian(mean.ravel(), beside(
        by_block(roots), shared.reshape(mean.size, -1), common_mode_sd * mean.reshape(-1, 1)))


def anderson_darling(samples: Floats) -> tuple[float, float]:
    """Test normality of samples (n,) whose mean and variance are not known.

    Returns
    -------
    statistic : float
        A^2 (1 + 0.75/n + 2.25/n^2).
    p : float
        Approximation of M. A. Stephens in R. B. D'Agostino, M. A. Stephens (eds.),
        Goodness-of-Fit Techniques (1986), table 4.9. NaN for fewer than `MIN_TESTED` samples, or
        samples that are all the same.

    (scipy.stats.anderson tells the p-value between 0.01 and 0.15 only, too little for Holm.)
    """
    count = len(samples)
    if count < MIN_TESTED or np.ptp(samples) == 0:
        return np.nan, np.nan
    z = np.sort((samples - samples.mean()) / samples.std(ddof=1))
    odd = 2 * np.arange(count) + 1
    a2 = -count - np.mean(odd * (special.log_ndtr(z) + special.log_ndtr(-z[::-1])))
    a = float(a2 * (1 + 0.75 / count + 2.25 / count**2))
    if a >= 0.6:
        # the parabola turns up again at 153; far below the smallest p that matters
        return a, float(np.exp(1.2937 - 5.709 * min(a, 100) + 0.0186 * min(a, 100) ** 2))
    if a > 0.34:
        return a, float(np.exp(0.9177 - 4.279 * a - 1.38 * a**2))
    if a > 0.2:
        return a, float(1 - np.exp(-8.318 + 42.796 * a - 59.938 * a**2))
    return a, float(1 - np.exp(-13.436 + 101.14 * a - 223.73 * a**2))


def holm(p: Floats) -> Floats:
    """p-values (n,) adjusted for their number; NaN are no tests.

    S. Holm, Scand. J. Statist. 6 (1979) 65: the chance that any true hypothesis has an adjusted
    value below alpha is at most alpha.
    """
    adjusted = np.full(p.shape, np.nan)
    tests = np.flatnonzero(~np.isnan(p))
    order = tests[np.argsort(p[tests])]
    steps = p[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted
