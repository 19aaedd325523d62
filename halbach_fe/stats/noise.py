"""Noise of readings: normal with mean 0, independent from reading to reading or correlated in some.

The readings of one point, or of one circle, may be correlated, those of different ones are not. So
the covariance Sigma is sparse: in blocks, each with a Cholesky factor of its own, and whitening by
``W = L^-1``, for which ``W Sigma W' = I``, costs next to nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeasurementError, must_be

Rows = slice | Ints | NDArray[np.bool_]

ASYMMETRY = 1e-9
"""Of the two sd's: how far a covariance may be from symmetric. Products of sparse matrices are
within 1e-15."""

SINGULAR = 1e-12
"""Of its variance: what those before it must leave a reading. Rounding leaves 1e-15 of a singular
matrix; a probe's noise is never 1e-6 of what the readings of a point have in common."""


@dataclass(frozen=True)
class NoiseCovariance:
    """A normal distribution with mean 0.

    Attributes
    ----------
    covariance : sparse array, shape (n, n), in T^2

    Raises
    ------
    MeasurementError
        If it is not symmetric, or not positive definite.
    """

    covariance: sparse.csr_array

    def __post_init__(self) -> None:
        if not np.isfinite(self.covariance.data).all():
            raise _refused("of finite numbers", "an infinite or missing one")
        if not (self.covariance.diagonal() > 0).all():
            raise _refused("of positive variances", f"{self.covariance.diagonal().min():g} T^2")
        if self.independent:
            return
        odd = abs(self.covariance - self.covariance.T).tocoo()
        rows, columns = odd.coords
        if (odd.data > ASYMMETRY * self.sd[rows] * self.sd[columns]).any():
            worst = int(np.argmax(odd.data / (self.sd[rows] * self.sd[columns])))
            raise _refused("symmetric", f"two values for readings {rows[worst] + 1} and "
                           f"{columns[worst] + 1}")
        self._factors  # noqa: B018, refuses what has none

    def __len__(self) -> int:
        return self.covariance.shape[0]

    @cached_property
    def sd(self) -> Floats:
        """Marginal standard deviations (n,) in T."""
        return np.sqrt(self.covariance.diagonal())

    @cached_property
    def independent(self) -> bool:
        """Whether no reading is correlated with another."""
        return bool(self.covariance.nnz == len(self))

    @cached_property
    def _factors(self) -> tuple[sparse.csr_array, sparse.csr_array]:
        """L, with L L' = Sigma, and its inverse."""
        if self.independent:
            return sparse.diags_array(self.sd).tocsr(), sparse.diags_array(1 / self.sd).tocsr()
        parts = []
        for index, blocks in _blocks(self.covariance):
            scale = self.sd[index]
            try:
                lower = np.linalg.cholesky(blocks / (scale[:, :, None] * scale[:, None, :]))
                left = np.einsum("kii->ki", lower) ** 2
            except np.linalg.LinAlgError:
                left = np.zeros(1)
            if left.min() < SINGULAR:
                raise _refused("positive definite", "a singular or indefinite one, as of a "
                               "reading that is the sum of others")
            parts.append((index, scale[:, :, None] * lower,
                          np.linalg.inv(lower) / scale[:, None, :]))
        rows = np.concatenate([np.repeat(index, index.shape[1], axis=1).ravel()
                               for index, *_ in parts])
        columns = np.concatenate([np.tile(index, index.shape[1]).ravel() for index, *_ in parts])

        def joined(which: int) -> sparse.csr_array:
            values = np.concatenate([part[which].ravel() for part in parts])
            used = values != 0  # of triangles
            return sparse.csr_array((values[used], (rows[used], columns[used])),
                                    shape=self.covariance.shape)

        return joined(1), joined(2)

    @property
    def whitening(self) -> sparse.csr_array:
        """W, sparse."""
        return self._factors[1]

    @property
    def log_size(self) -> float:
        """Logarithm of the root of the determinant."""
        return float(np.log(self._factors[0].diagonal()).sum())

    @property
    def finest(self) -> float:
        """What all readings may be off by, in T, for none of them whitened to be off by more than
        1; of independent ones the smallest standard deviation.
        """
        return float(1 / abs(self._factors[1]).sum(axis=1).max())

    def whiten(self, values: Floats, rows: Rows = slice(None)) -> Floats:
        """W times values (n,) or (n, k), or some rows of that."""
        if not self.independent:
            return np.asarray(self._factors[1][rows] @ values)
        sd = self.sd[rows]
        return np.asarray(values[rows] / (sd if values.ndim == 1 else sd[:, None]))

    def sample(self, generator: np.random.Generator) -> Floats:
        """Draw the noise of all readings once, (n,) in T."""
        return np.asarray(self._factors[0] @ generator.standard_normal(len(self)))

    def part(self, rows: Rows) -> NoiseCovariance:
        """The noise of some readings."""
        return NoiseCovariance(self.covariance[rows][:, rows])

    def given(self, rows: Rows, seen: Rows) -> tuple[sparse.csr_array, NoiseCovariance]:
        """Matrix R (rows, seen) that foretells the noise of some readings from that of others, and
        the noise of the first that remains: what R does not foretell is independent of the seen.
        """
        cross = self.covariance[rows][:, seen]
        if not cross.nnz:
            return cross, self.part(rows)
        white = self.part(seen)._factors[1]
        half = cross @ white.T
        return half @ white, NoiseCovariance(self.covariance[rows][:, rows] - half @ half.T)

    def beside(self, other: NoiseCovariance) -> NoiseCovariance:
        """The noise of these readings and others, which are independent of them."""
        return NoiseCovariance(
            sparse.csr_array(sparse.block_diag([self.covariance, other.covariance])))

    def plus(self, sd: Floats) -> NoiseCovariance:
        """Add independent errors with standard deviations (n,) in T, which may be 0."""
        return NoiseCovariance(sparse.csr_array(self.covariance + sparse.diags_array(sd**2)))


def independent(sd: Floats) -> NoiseCovariance:
    """Noise of independent readings with standard deviations (n,) in T.

    Raises
    ------
    MeasurementError
        If one is not positive.
    """
    if not (np.isfinite(sd) & (sd > 0)).all():
        number = int(np.argmin(np.isfinite(sd) & (sd > 0)))
        raise MeasurementError(must_be(f"standard deviation of reading {number + 1}", "the noise",
                                       "a positive number", f"{sd[number]:g}"))
    return NoiseCovariance(sparse.csr_array(sparse.diags_array(np.asarray(sd, float) ** 2)))


def _refused(expected: str, received: str) -> MeasurementError:
    return MeasurementError(must_be("covariance", "the noise", expected, received))


def _blocks(covariance: sparse.csr_array) -> Iterator[tuple[Ints, Floats]]:
    """Indices (k, b) of all sets of b readings that are correlated, and their covariances (k, b,
    b); by size.
    """
    _, label = connected_components(covariance, directed=False)
    sizes = np.bincount(label)
    order = np.argsort(label, kind="stable")
    first = np.cumsum(sizes) - sizes
    place = np.empty(len(label), int)  # within its set
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
