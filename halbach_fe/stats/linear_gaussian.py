"""The posterior of a linear model with Gaussian prior and noise, in closed form.

With p = mu_0 + L z, z ~ N(0, I), and the readings whitened, ``y = W z + e``, e ~ N(0, I), the
posterior follows from the singular values of W = U s V': along each direction of V the readings
leave ``1/sqrt(1 + s^2)`` of the prior's standard deviation, across them all of it (C. M. Bishop,
Pattern Recognition and Machine Learning, eq. 2.117, in whitened coordinates). No covariance is
inverted, C_0 may be singular, and of many parameters only as many directions are kept as there are
readings.

W itself need not fit into memory: it is made a part at a time. Of more readings than parameters the
one product W'W is summed, and its eigenvectors are V. Where readings are so exact that rounding of
the product would matter, and of fewer readings than parameters, rows are kept instead, as a square
root of the information (G. J. Bierman, Factorization Methods for Discrete Sequential Estimation,
1977): no more than there are parameters, by QR. Where that is still too much, as with tens of
thousands of parameters, those combinations of readings are left out that say hardly anything, see
`NEGLIGIBLE`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg as linalg
import scipy.sparse as sparse

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.stats.gaussian import Gaussian, Root, beside, entries
from halbach_fe.stats.noise import NoiseCovariance

READINGS_AT_ONCE = 8192
"""Rows whitened at a time: memory does not grow with the readings."""

NUMBERS_AT_ONCE = 2**24
"""In one part of a matrix, 128 MB: of many parameters fewer rows are taken at a time."""

WORST_CONDITION = 1e10
"""Of the precision of z, I + W'W, for the product: its rounding then moves the posterior by some
1e-6 of its sd."""

NUMBERS_HELD = 2**26
"""In W'W, or in the square root of the information before it is compressed, 512 MB. No more rows
are needed than there are parameters, so that nothing is left out below 8000 of them."""

NEGLIGIBLE = 1e-4
"""Singular values of W that may be left out: an unknown combination of readings is then known to
1e-4 of its noise by the prior alone, and the posterior's variance changes by 1e-8 of itself. What
many parts leave out adds up, and is stated."""


class Rows(Protocol):
    """A matrix (n, m) of which rows can be had: an array, or a file."""

    def __len__(self) -> int: ...
    def __getitem__(self, rows: Ints, /) -> Floats: ...


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
        Effective number of parameters that the readings determine, the trace of I - S^-1, S being
        the precision of z (D. J. C. MacKay, Neural Comput. 4 (1992) 415).
    conflict : float
        How far the readings lie from what prior and noise foretell: mean of chi-squared,
        ``r' (Sigma + H C_0 H')^-1 r / n``, 1 if all is well, with a standard deviation of
        sqrt(2/n).
    left_out : float
        Bound of what was left out: of the change of the variance of any combination of parameters,
        relative to that variance.
    """

    distribution: Gaussian
    log_evidence: float
    learnt: float
    conflict: float
    left_out: float


@dataclass(frozen=True)
class Information:
    """Readings y = W z + e with e ~ N(0, I), by their singular values.

    Attributes
    ----------
    directions : ndarray, shape (k, r)
        V.
    values : ndarray, shape (r,)
        s.
    pulled : ndarray, shape (r,)
        V' W' y.
    chi2 : float
        y' (I + W W')^-1 y.
    left_out : float
        Sum of squares of the singular values that were left out.
    """

    directions: Floats
    values: Floats
    pulled: Floats
    chi2: float
    left_out: float = 0.0


def update(
    matrix: Rows, readings: Floats, noise: NoiseCovariance, prior: Gaussian,
    rows: Ints | None = None
) -> LinearPosterior:
    """Update a prior with readings q = H p + noise.

    Parameters
    ----------
    matrix : ndarray, or what gives rows of it, shape (n, m)
        H.
    readings : ndarray, shape (n,)
        q.
    noise : Noise
        Of the n readings.
    prior : Gaussian
        Of the m parameters.
    rows : ndarray of int, shape (n,), optional
        Of a longer matrix, which belong to the readings.
    """
    def both(some: Ints) -> Floats:
        own = matrix[some if rows is None else rows[some]]
        return np.column_stack([own, readings[some] - own @ prior.mean])

    columns = len(prior.mean) + 1
    found = inform(lambda: whitened_parts(both, noise, columns), (len(readings), columns),
                   prior.root)
    values = found.values
    left = 1 / np.sqrt(1 + values**2)
    shift = found.directions @ (found.pulled / (1 + values**2))
    log_size = float(-np.log(left).sum() + noise.log_size
                     + len(readings) / 2 * np.log(2 * np.pi))
    return LinearPosterior(
        Gaussian(prior.mean + prior.root @ shift, Root(
            entries(prior.root), found.directions, left)),
        -found.chi2 / 2 - log_size, float(np.sum(values**2 / (1 + values**2))),
        found.chi2 / len(readings), found.left_out)


def posterior(matrix: Floats, readings: Floats, noise: NoiseCovariance,
              prior: Gaussian) -> Gaussian:
    """The distribution that `update` finds."""
    return update(matrix, readings, noise, prior).distribution


def contraction(prior: Gaussian, after: Gaussian, size: int) -> Floats:
    """By block of ``size`` parameters, (m / size,): 1 - trace(C_1) / trace(C_0); 0 is nothing
    learnt, 1 everything.
    """
    before, now = ((one.sd**2).reshape(-1, size).sum(axis=1) for one in (prior, after))
    return np.asarray(1 - now / before)


def whitened_parts(
    rows: Callable[[Ints], Floats], noise: NoiseCovariance, columns: int
) -> Iterator[Floats]:
    """The whitened rows of a matrix, a part (c, k) at a time.

    Each part is of whole whitened readings, and takes the rows that go into them, wherever those
    are: so readings whose noise is correlated may lie in different parts.

    Parameters
    ----------
    rows : callable
        Indices (c,) to these rows (c, k) of the matrix.
    columns : int
        k.
    """
    for part in parts_of(len(noise), columns):
        weights = noise.whitening[part]
        needed, place = np.unique(weights.indices, return_inverse=True)
        shape = weights.shape[0], len(needed)
        yield np.asarray(sparse.csr_array((weights.data, place, weights.indptr), shape=shape)
                         @ rows(needed))


def parts_of(count: int, columns: int, most: int | None = None) -> Iterator[slice]:
    """Slices of the rows of a matrix (count, columns), a part at a time, of at most so many rows
    (default: `READINGS_AT_ONCE`).
    """
    step = min(most or READINGS_AT_ONCE, max(1, NUMBERS_AT_ONCE // max(1, columns)))
    return (slice(first, min(first + step, count)) for first in range(0, count, step))


def inform(
    parts: Callable[[], Iterable[Floats]], shape: tuple[int, int], root: Floats | Root
) -> Information:
    """What whitened readings tell.

    Parameters
    ----------
    parts : callable
        Gives the rows of [A y], parts (c, m + 1), one after the other.
    shape : tuple of int
        Of all rows, (n, m + 1).
    root : ndarray or Root, shape (m, k)
        W is A times it.
    """
    rows, columns = shape
    if rows > columns and columns**2 <= NUMBERS_HELD:
        found = _by_product(parts(), columns, root)
        if found.values.max(initial=0) ** 2 < WORST_CONDITION:
            return found
    return _by_rows(np.column_stack([part[:, :-1] @ root, part[:, -1]]) for part in parts())


def _by_product(parts: Iterable[Floats], columns: int, root: Floats | Root) -> Information:
    product = np.zeros((columns, columns))
    for part in parts:
        product += part.T @ part
    squares, directions = linalg.eigh((product[:-1, :-1] @ root).T @ root)
    squares, pulled = np.maximum(squares, 0), directions.T @ (product[-1, :-1] @ root)
    return Information(directions, np.sqrt(squares), pulled,
                       float(product[-1, -1] - np.sum(pulled**2 / (1 + squares))))


def _by_rows(parts: Iterable[Floats]) -> Information:
    waiting: list[Floats] = []
    rows, rest, left_out = 0, 0.0, 0.0
    limit = 0
    for part in parts:
        waiting.append(part)
        rows += len(part)
        columns = part.shape[1]
        enough = max(columns, READINGS_AT_ONCE)
        limit = max(limit, min(enough, max(1, NUMBERS_HELD // columns)))
        if rows <= limit:
            continue
        held = np.vstack(waiting)
        if enough * columns <= NUMBERS_HELD:
            held = np.asarray(np.linalg.qr(held, mode="r"))
        else:
            held, less = _compressed(held)
            rest, left_out = rest + less[0], left_out + less[1]
            limit = max(limit, 2 * len(held))
        waiting, rows = [held], len(held)
    held = np.vstack(waiting)
    u, values, directions = linalg.svd(held[:, :-1], full_matrices=False, check_finite=False)
    seen = u.T @ held[:, -1]
    rest += float(np.sum((held[:, -1] - u @ seen) ** 2))
    return Information(directions.T, values, values * seen,
                       rest + float(np.sum(seen**2 / (1 + values**2))), left_out)


def _compressed(held: Floats) -> tuple[Floats, tuple[float, float]]:
    """Rows [W y] without the combinations that say nothing of z; and of these the sum of squares of
    y, and of the singular values of W.
    """
    squares, vectors = linalg.eigh(held[:, :-1] @ held[:, :-1].T)
    kept = squares > NEGLIGIBLE**2
    gone = vectors[:, ~kept].T @ held[:, -1]
    rounding = np.finfo(float).eps * squares.max(initial=0)  # small ones are known to that
    return vectors[:, kept].T @ held, (float(gone @ gone), float(
        np.maximum(squares[~kept], rounding).sum()))


def predict(matrix: Rows, parameters: Gaussian) -> tuple[Floats, Floats]:
    """Mean and standard deviation (n,) of the noise-free readings H p."""
    mean, sd = np.empty(len(matrix)), np.empty(len(matrix))
    for part in parts_of(len(matrix), len(parameters.mean)):
        rows = matrix[np.arange(part.start, part.stop)]
        mean[part], sd[part] = rows @ parameters.mean, parameters.sd_of(rows)
    return mean, sd


def whitened(
    residual: Floats, noise: NoiseCovariance, root: Callable[[Ints], Floats], columns: int
) -> Floats:
    """Residuals of a prediction, whitened by its covariance and the noise's, (n,): independent and
    standard normal if all is well.

    Of all roots of the inverse of ``Sigma + R R'`` it is, after W, the symmetric one,
    ``(I + A A')^-1/2`` with A = W R: the nearest to the residual that each reading has by itself.
    By the singular values of A it takes the time of one update, however many the readings.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Measured less predicted. Of readings that the model has not seen; those that it was fitted
        to lie nearer.
    noise : Noise
    root : callable
        Indices (c,) to these rows (c, columns) of R, a root of the covariance of the prediction.
    columns : int
    """
    own = noise.whiten(residual)
    if not columns:
        return own
    found = inform(lambda: (np.column_stack([part, own[place]]) for place, part in zip(
        parts_of(len(own), columns), whitened_parts(root, noise, columns), strict=True)),
        (len(own), columns + 1), beside(sparse.eye_array(columns, format="csr")))
    size = np.sqrt(1 + found.values**2)
    # 1/size - 1, over squares
    toward = found.directions @ (found.pulled / (size * (1 + size)))
    return own - np.concatenate([
        part @ toward for part in whitened_parts(root, noise, columns)])
