"""The noise covariance of readings: normal with mean 0, independent or correlated in small groups.

Readings of the same point, or of the same circle, may be correlated; readings of different points
or circles are not. The covariance Sigma is therefore sparse: up to the order of the readings it is
block-diagonal, and each block has its own Cholesky factor. Whitening by ``W = L^-1``, so that
``W Sigma W' = I``, is cheap.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.errors import MeasurementError, must_be

Rows = slice | Ints | Bools


@dataclass(frozen=True)
class NoiseCovariance:
    """Normally distributed noise of readings, with mean 0 and a sparse covariance.

    Attributes
    ----------
    covariance : sparse array, shape (n, n), in T^2
        Sigma.

    Raises
    ------
    MeasurementError
        If the covariance is not finite, not symmetric, or not positive definite.
    """

    covariance: sparse.csr_array

    def __post_init__(self) -> None:
        if not np.isfinite(self.covariance.data).all():
            raise _covariance_error("of finite numbers", "an infinite or missing value")
        if not (self.covariance.diagonal() > 0).all():
            raise _covariance_error("of positive variances",
                                    f"{self.covariance.diagonal().min():g} T^2")
        if self.independent:
            return
        asymmetry = abs(self.covariance - self.covariance.T).tocoo()
        rows, columns = asymmetry.coords
        # largest asymmetry of a covariance, relative to the product of the two standard deviations.
        # Rounding in products of sparse matrices gives 1e-15.
        largest_asymmetry = 1e-9
        if (asymmetry.data > largest_asymmetry * self.sd[rows] * self.sd[columns]).any():
            worst = int(np.argmax(asymmetry.data / (self.sd[rows] * self.sd[columns])))
            raise _covariance_error("symmetric", "two different values for readings "
                                    f"{rows[worst] + 1} and {columns[worst] + 1}")
        self._factors  # noqa: B018, raises if the covariance has no Cholesky factor

    def __len__(self) -> int:
        return self.covariance.shape[0]

    @cached_property
    def sd(self) -> Floats:
        """Marginal standard deviations (n,) in T."""
        return np.sqrt(self.covariance.diagonal())

    @cached_property
    def independent(self) -> bool:
        """Whether the noise of no two readings is correlated."""
        return bool(self.covariance.nnz == len(self))

    @cached_property
    def _factors(self) -> tuple[sparse.csr_array, sparse.csr_array]:
        """The lower triangular factor L, with L L' = Sigma, and its inverse, both sparse."""
        if self.independent:
            return sparse.diags_array(self.sd).tocsr(), sparse.diags_array(1 / self.sd).tocsr()
        parts = []
        # smallest conditional variance of a reading, given the readings before it in its block,
        # relative to its variance. For a singular covariance rounding leaves about 1e-15. The
        # independent noise of a probe is always more than 1e-6 of the standard deviation that the
        # readings of a point share.
        singular = 1e-12
        for index, blocks in _blocks(self.covariance):
            scale = self.sd[index]
            try:
                lower = np.linalg.cholesky(blocks / (scale[:, :, None] * scale[:, None, :]))
                conditional_variance = np.einsum("kii->ki", lower) ** 2
            except np.linalg.LinAlgError:
                conditional_variance = np.zeros(1)
            if conditional_variance.min() < singular:
                raise _covariance_error("positive definite", "a singular or indefinite matrix, as "
                                        "if the noise of a reading were the sum of others")
            parts.append((index, scale[:, :, None] * lower,
                          np.linalg.inv(lower) / scale[:, None, :]))
        rows = np.concatenate([np.repeat(index, index.shape[1], axis=1).ravel()
                               for index, *_ in parts])
        columns = np.concatenate([np.tile(index, index.shape[1]).ravel() for index, *_ in parts])

        def joined(which: int) -> sparse.csr_array:
            values = np.concatenate([part[which].ravel() for part in parts])
            used = values != 0  # the other triangle is zero
            return sparse.csr_array((values[used], (rows[used], columns[used])),
                                    shape=self.covariance.shape)

        return joined(1), joined(2)

    @property
    def whitening(self) -> sparse.csr_array:
        """The whitening matrix W = L^-1, sparse, shape (n, n)."""
        return self._factors[1]

    @property
    def log_sqrt_determinant(self) -> float:
        """Logarithm of the square root of the determinant of Sigma."""
        return float(np.log(self._factors[0].diagonal()).sum())

    @property
    def uniform_error_scale(self) -> float:
        """Largest e in T such that errors of at most e of every reading change no whitened reading
        by more than 1. For independent noise, e is the smallest standard deviation.
        """
        return float(1 / abs(self._factors[1]).sum(axis=1).max())

    def whiten(self, values: Floats) -> Floats:
        """Return W times values (n,) or (n, k)."""
        if not self.independent:
            return np.asarray(self.whitening @ values)
        return np.asarray(values / (self.sd if values.ndim == 1 else self.sd[:, None]))

    def sample(self, generator: np.random.Generator) -> Floats:
        """Draw one sample of the noise of all readings, (n,) in T."""
        return np.asarray(self._factors[0] @ generator.standard_normal(len(self)))

    def subset(self, rows: Rows) -> NoiseCovariance:
        """Return the (marginal) noise of some of the readings."""
        return NoiseCovariance(self.covariance[rows][:, rows])

    def conditional(self, rows: Rows, seen: Rows) -> tuple[sparse.csr_array, NoiseCovariance]:
        """Condition the noise of some readings on the noise of others.

        ``rows`` and ``seen``: the readings whose noise is predicted, and the disjoint readings
        whose noise is known.

        Returns
        -------
        regression : sparse array, shape (rows, seen)
            R. The conditional mean of the noise of ``rows`` is R times the noise of ``seen``.
        noise : NoiseCovariance
            Conditional covariance, which does not depend on the noise of ``seen``.
        """
        cross = self.covariance[rows][:, seen]
        if not cross.nnz:
            return cross, self.subset(rows)
        white = self.subset(seen)._factors[1]
        half = cross @ white.T
        return half @ white, NoiseCovariance(self.covariance[rows][:, rows] - half @ half.T)

    def stacked_with(self, other: NoiseCovariance) -> NoiseCovariance:
        """Return the noise of these readings followed by others, which are independent of them."""
        return NoiseCovariance(
            sparse.csr_array(sparse.block_diag([self.covariance, other.covariance])))

    def with_independent_errors(self, sd: Floats) -> NoiseCovariance:
        """Return the noise with independent errors added, of standard deviations (n,) in T that may
        be 0.
        """
        return NoiseCovariance(sparse.csr_array(self.covariance + sparse.diags_array(sd**2)))


def independent_noise(sd: Floats) -> NoiseCovariance:
    """Return the noise of independent readings with standard deviations (n,) in T.

    Raises
    ------
    MeasurementError
        If a standard deviation is not a positive, finite number.
    """
    if not (np.isfinite(sd) & (sd > 0)).all():
        number = int(np.argmin(np.isfinite(sd) & (sd > 0)))
        raise MeasurementError(must_be(f"standard deviation of reading {number + 1}", "the noise",
                                       "a positive number", f"{sd[number]:g}"))
    return NoiseCovariance(sparse.csr_array(sparse.diags_array(np.asarray(sd, float) ** 2)))


def _covariance_error(expected: str, received: str) -> MeasurementError:
    """Return the error that says how a covariance must be, and what was received."""
    return MeasurementError(must_be("covariance", "the noise", expected, received))


def _blocks(covariance: sparse.csr_array) -> Iterator[tuple[Ints, Floats]]:
    """Yield the diagonal blocks of a covariance, those of equal size b together.

    Each item holds the indices (k, b) of the readings of k groups, which are correlated within a
    group but not between groups, and the covariances (k, b, b) of the groups.
    """
    _, label = connected_components(covariance, directed=False)
    sizes = np.bincount(label)
    order = np.argsort(label, kind="stable")
    first = np.cumsum(sizes) - sizes
    place = np.empty(len(label), int)  # of each reading within its group
    place[order] = np.arange(len(label)) - first[label[order]]
    entries = covariance.tocoo()
    rows, columns = entries.coords
    for size in np.unique(sizes):
        chosen = np.flatnonzero(sizes == size)
        entry = sizes[label[rows]] == size
        blocks = np.zeros((len(chosen), size, size))
        blocks[np.searchsorted(chosen, label[rows[entry]]), place[rows[entry]],
               place[columns[entry]]] = entries.data[entry]
        yield order[first[chosen][:, None] + np.arange(size)], blocks
