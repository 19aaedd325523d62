"""The posterior of a linear model with Gaussian prior and noise, in closed form.

The parameters are p = mu_0 + L z with z ~ N(0, I), where L is a square root of the prior's
covariance. The whitened readings are ``y = W z + e`` with e ~ N(0, I). The posterior follows from
the singular value decomposition W = U s V': along each direction of V (a column of V) the
posterior standard deviation is ``1/sqrt(1 + s^2)`` of the prior's, and in all orthogonal
directions it equals the prior's (C. M. Bishop, Pattern Recognition and Machine Learning,
eq. 2.117, in whitened coordinates). No covariance is inverted, the prior covariance C_0 may be
singular, and at most as many directions are stored as there are readings.

W need not fit into memory: its rows are computed in blocks. With more readings than parameters,
the Gram matrix W'W is accumulated, and V are its eigenvectors. Rows are kept instead of W'W in two
cases: with fewer readings than parameters, and with readings so exact that the rounding errors of
W'W would change the posterior. QR decompositions then compress the rows to a square root of the
information matrix with no more rows than parameters (G. J. Bierman, Factorization Methods for
Discrete Sequential Estimation, 1977). If even this root is too large, as with tens of thousands of
parameters, those combinations of readings are discarded that carry almost no information about
the parameters; see `NEGLIGIBLE`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg as linalg
import scipy.sparse as sparse

from halbach_fe.core.arrays import Floats, Ints, slices
from halbach_fe.stats.gaussian import (
    CovarianceFactor,
    Gaussian,
    NoiseCovariance,
    root_matrix,
    stacked_root,
)

READINGS_AT_ONCE = 2048
"""Largest number of rows that are whitened at a time, so that memory does not grow with the number
of readings. Larger parts would be allocated anew by the system each time, which takes as long as
their products."""

NUMBERS_AT_ONCE = 2**24
"""Largest number of entries of one block of rows (128 MB). With many parameters a block therefore
has fewer than `READINGS_AT_ONCE` rows."""

WORST_CONDITION = 1e10
"""Largest condition number of the precision of z, I + W'W, for which the Gram matrix W'W is used.
At this limit the rounding of W'W moves the posterior by about 1e-6 of its standard deviation."""

NUMBERS_HELD = 2**26
"""Largest number of entries (512 MB) of W'W, or of the rows that are collected before they are
compressed. At most as many rows as parameters are needed, so that with fewer than 8000 parameters
no information is discarded."""

NEGLIGIBLE = 1e-4
"""Singular values of W up to which a combination of readings may be discarded. The prior alone
predicts such a combination to 1e-4 of its noise, and discarding one changes the posterior variance
by 1e-8 of itself. The changes add up over all blocks; `LinearPosterior.discarded_information`
reports their sum."""


class Rows(Protocol):
    """A matrix (n, m) whose rows can be read by index: an array, or a matrix stored in a file."""

    def __len__(self) -> int: ...
    def __getitem__(self, rows: Ints, /) -> Floats: ...


@dataclass(frozen=True)
class LinearPosterior:
    """The posterior of the parameters of a linear model."""

    distribution: Gaussian
    """Posterior distribution. Its root has as many columns as the prior's."""
    log_evidence: float
    """Log evidence: logarithm of the probability density of the readings under prior and noise."""
    parameters_learnt: float
    """Effective number of parameters that the readings determine: the trace of I - S^-1, where S is
    the posterior precision of z (D. J. C. MacKay, Neural Comput. 4 (1992) 415)."""
    prior_conflict: float
    """Chi-squared per reading, ``r' (Sigma + H C_0 H')^-1 r / n``, of the residuals r of the
    prior's prediction. If prior, model and noise are right, its expectation is 1 and its standard
    deviation sqrt(2/n)."""
    discarded_information: float
    """Upper bound of the relative change of the posterior variance of any combination of parameters
    because negligible combinations of readings were discarded; 0 if none were."""


@dataclass(frozen=True)
class Information:
    """The information of readings y = W z + e, e ~ N(0, I), about z, where W = U diag(s) V'."""

    directions: Floats
    """V. Shape (k, r)."""
    values: Floats
    """Singular values s. Shape (r,)."""
    projected: Floats
    """V' W' y. Shape (r,)."""
    chi2: float
    """y' (I + W W')^-1 y."""
    discarded: float = 0.0
    """Sum of the squares of the singular values that were discarded as negligible."""


def update(
    matrix: Rows, readings: Floats, noise: NoiseCovariance, prior: Gaussian,
    rows: Ints | None = None
) -> LinearPosterior:
    """Update a prior with readings q = H p + noise.

    Parameters
    ----------
    matrix : ndarray or Rows, shape (n, m)
        H. With ``rows``, a matrix that also has rows of other readings.
    readings : ndarray, shape (n,)
        q.
    noise : NoiseCovariance
        Noise of the n readings.
    prior : Gaussian
        Prior of the m parameters p.
    rows : ndarray of int, shape (n,), optional
        Rows of ``matrix`` that belong to the n readings. Default: all rows, in their order.
    """
    def response_and_residual(indices: Ints) -> Floats:
        response = _selected(matrix, indices if rows is None else rows[indices])
        return np.column_stack([response, readings[indices] - response @ prior.mean])

    columns = len(prior.mean) + 1
    found = information_of(lambda: whitened_row_blocks(response_and_residual, noise, columns),
                           (len(readings), columns), prior.root)
    values = found.values
    remaining = 1 / np.sqrt(1 + values**2)
    shift = found.directions @ (found.projected / (1 + values**2))
    log_normalization = float(-np.log(remaining).sum() + noise.log_sqrt_determinant
                              + len(readings) / 2 * np.log(2 * np.pi))
    return LinearPosterior(
        Gaussian(prior.mean + prior.root @ shift, CovarianceFactor(
            root_matrix(prior.root), found.directions, remaining)),
        -found.chi2 / 2 - log_normalization, float(np.sum(values**2 / (1 + values**2))),
        found.chi2 / len(readings), found.discarded)


def posterior(matrix: Floats, readings: Floats, noise: NoiseCovariance,
              prior: Gaussian) -> Gaussian:
    """Return only the posterior distribution of `update`."""
    return update(matrix, readings, noise, prior).distribution


def contraction(prior_sd: Floats, posterior_sd: Floats) -> Floats:
    """Return the posterior contraction 1 - trace(C_1) / trace(C_0) of each block, (blocks,).

    C_0 and C_1 are the prior and posterior covariances of the components of a block's
    magnetization, whose standard deviations are given, (blocks, components) each. The contraction
    is 0 if the readings carry no information about the block, and 1 if they determine it
    completely. It is NaN for a block without prior uncertainty: a missing block.
    """
    before, now = ((sd**2).sum(axis=1) for sd in (prior_sd, posterior_sd))
    return np.asarray(1 - now / np.where(before > 0, before, np.nan))


def whitened_row_blocks(
    rows: Callable[[Ints], Floats], noise: NoiseCovariance, columns: int
) -> Iterator[Floats]:
    """Yield the whitened rows of a matrix in blocks (c, k).

    A whitened reading is a combination of all readings whose noise is correlated with it. Each
    block asks for all rows that its whitened readings combine, wherever these rows are; correlated
    readings may therefore belong to different blocks.

    Parameters
    ----------
    rows : callable
        Returns the rows (c, k) of the matrix with given indices (c,).
    noise : NoiseCovariance
        Noise of all readings.
    columns : int
        Number of columns k of the matrix.
    """
    for block in row_slices(len(noise), columns):
        weights = noise.whitening[block]
        needed, place = np.unique(weights.indices, return_inverse=True)
        shape = weights.shape[0], len(needed)
        if shape[0] == shape[1] == weights.nnz and (np.diff(place) == 1).all():
            yield rows(needed) * weights.data[:, None]  # independent noise
        else:
            yield np.asarray(sparse.csr_array((weights.data, place, weights.indptr), shape=shape)
                             @ rows(needed))


def _selected(matrix: Rows, indices: Ints) -> Floats:
    """Return the rows of a matrix with given indices, without a copy of consecutive ones."""
    if isinstance(matrix, np.ndarray) and (np.diff(indices) == 1).all():
        return matrix[indices[0]:indices[-1] + 1]
    return matrix[indices]


def row_slices(count: int, columns: int, most: int | None = None) -> list[slice]:
    """Return slices that divide the rows of a matrix (count, columns) into blocks.

    A block has at most ``most`` rows (default: `READINGS_AT_ONCE`) and, unless it is a single row,
    at most `NUMBERS_AT_ONCE` entries.
    """
    step = min(most or READINGS_AT_ONCE, max(1, NUMBERS_AT_ONCE // max(1, columns)))
    return slices(count, step)


def information_of(
    blocks: Callable[[], Iterable[Floats]], shape: tuple[int, int],
    root: Floats | CovarianceFactor
) -> Information:
    """Return the information of whitened readings y = A L z + e about z.

    Parameters
    ----------
    blocks : callable
        Returns the rows of [A y] in consecutive blocks (c, m + 1). It is called a second time if
        the Gram matrix turns out to be too badly conditioned.
    shape : tuple of int
        Number of rows in all blocks together, and of columns: (n, m + 1).
    root : ndarray or CovarianceFactor, shape (m, k)
        L; the response to the whitened parameters is W = A L.
    """
    rows, columns = shape
    if rows > columns and columns**2 <= NUMBERS_HELD:
        found = _information_by_product(blocks(), columns, root)
        if found.values.max(initial=0) ** 2 < WORST_CONDITION:
            return found
    return _information_by_rows(
        np.column_stack([block[:, :-1] @ root, block[:, -1]]) for block in blocks())


def _information_by_product(
    blocks: Iterable[Floats], columns: int, root: Floats | CovarianceFactor
) -> Information:
    """Return the information from the eigenvectors of the Gram matrix W'W."""
    product = np.zeros((columns, columns))
    for block in blocks:
        product += block.T @ block
    # by numpy as the products are: scipy's threads would compete with those that just multiplied
    squares, directions = np.linalg.eigh((product[:-1, :-1] @ root).T @ root)
    squares, projected = np.maximum(squares, 0), directions.T @ (product[-1, :-1] @ root)
    return Information(directions, np.sqrt(squares), projected,
                       float(product[-1, -1] - np.sum(projected**2 / (1 + squares))))


def _information_by_rows(blocks: Iterable[Floats]) -> Information:
    """Return the information from the rows [W y], compressed whenever they need too much memory."""
    waiting: list[Floats] = []
    rows, chi2_outside, discarded = 0, 0.0, 0.0
    limit = 0
    for block in blocks:
        waiting.append(block)
        rows += len(block)
        columns = block.shape[1]
        enough = max(columns, READINGS_AT_ONCE)
        limit = max(limit, min(enough, max(1, NUMBERS_HELD // columns)))
        if rows <= limit:
            continue
        held = np.vstack(waiting)
        if enough * columns <= NUMBERS_HELD:
            held = np.asarray(np.linalg.qr(held, mode="r"))
        else:
            held, removed = _without_negligible(held)
            chi2_outside, discarded = chi2_outside + removed[0], discarded + removed[1]
            limit = max(limit, 2 * len(held))
        waiting, rows = [held], len(held)
    held = np.vstack(waiting)
    u, values, directions = linalg.svd(held[:, :-1], full_matrices=False, check_finite=False)
    within = u.T @ held[:, -1]  # y along the columns of U; the remainder has W = 0
    chi2_outside += float(np.sum((held[:, -1] - u @ within) ** 2))
    return Information(directions.T, values, values * within,
                       chi2_outside + float(np.sum(within**2 / (1 + values**2))), discarded)


def _without_negligible(held: Floats) -> tuple[Floats, tuple[float, float]]:
    """Remove the combinations of rows [W y] with negligible singular values of W.

    Returns
    -------
    kept : ndarray, shape (c, k + 1)
        The remaining combinations.
    removed : tuple of float
        Of the removed combinations: the sum of squares of y, and an upper bound of the sum of the
        squared singular values of W.
    """
    squares, vectors = linalg.eigh(held[:, :-1] @ held[:, :-1].T)
    kept = squares > NEGLIGIBLE**2
    gone = vectors[:, ~kept].T @ held[:, -1]
    rounding = np.finfo(float).eps * squares.max(initial=0)  # error of the small eigenvalues
    return vectors[:, kept].T @ held, (float(gone @ gone), float(
        np.maximum(squares[~kept], rounding).sum()))


def predict(matrix: Rows, parameters: Gaussian) -> tuple[Floats, Floats]:
    """Return mean and standard deviation (n,) of the noise-free readings H p."""
    mean, sd = np.empty(len(matrix)), np.empty(len(matrix))
    for block in row_slices(len(matrix), len(parameters.mean)):
        rows = matrix[np.arange(block.start, block.stop)]
        mean[block], sd[block] = rows @ parameters.mean, parameters.sd_of(rows)
    return mean, sd


def whitened(
    residual: Floats, noise: NoiseCovariance, root: Callable[[Ints], Floats], columns: int
) -> Floats:
    """Return residuals (n,), whitened by the covariance of noise and prediction together.

    If the model is right, the whitened residuals are independent and standard normal.

    A covariance ``Sigma + R R'`` can be whitened by any root of its inverse. Here the residuals are
    first whitened by the noise (W), and then by the symmetric root ``(I + A A')^-1/2`` with
    A = W R. The symmetric root changes each noise-whitened residual least, so that a whitened
    residual can still be attributed to its reading. It is applied by the singular values of A,
    which costs as much as one update, whatever the number of readings.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Measured minus predicted readings. The readings must not have been used in the fit, since
        residuals of training readings are smaller than this covariance says.
    noise : NoiseCovariance
        Noise of the n readings.
    root : callable
        Returns the rows (c, columns) with given indices (c,) of R, a root of the covariance of the
        prediction.
    columns : int
        Number of columns of R.
    """
    by_noise = noise.whiten(residual)
    if not columns:
        return by_noise
    found = information_of(lambda: (
        np.column_stack([block, by_noise[place]]) for place, block in zip(
            row_slices(len(by_noise), columns), whitened_row_blocks(root, noise, columns),
            strict=True)),
        (len(by_noise), columns + 1), stacked_root(sparse.eye_array(columns, format="csr")))
    size = np.sqrt(1 + found.values**2)
    # projected * (1 - 1/size) / values^2, in a form that is finite for singular values of 0
    toward = found.directions @ (found.projected / (size * (1 + size)))
    return by_noise - np.concatenate([
        block @ toward for block in whitened_row_blocks(root, noise, columns)])
