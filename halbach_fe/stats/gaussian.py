"""Normal distributions of the block magnetizations, by a root of their covariance; the prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import scipy.linalg as linalg
import scipy.sparse as sparse
from numpy.typing import DTypeLike, NDArray

from halbach_fe.core.arrays import Floats, Ints

Numbers = TypeVar("Numbers", NDArray[np.float64], NDArray[np.complex128])


@dataclass(frozen=True)
class Root:
    """A root L = outer (I - V diag(1 - left) V') of a covariance, never multiplied out.

    The outer root of a prior is sparse: what every block has for itself, and a few columns that
    all share. Readings, of which there may be far fewer than parameters, leave ``left`` of the
    standard deviation along each of some orthonormal directions V, and all of it across them.

    Attributes
    ----------
    outer : ndarray or sparse array, shape (m, k)
    directions : ndarray, shape (k, r)
        V.
    left : ndarray, shape (r,)
    """

    outer: Floats | sparse.csr_array
    directions: Floats
    left: Floats

    __array_ufunc__ = None  # numpy leaves `array @ root` to this class

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns (m, k)."""
        rows, columns = self.outer.shape
        return int(rows), int(columns)

    def __matmul__(self, values: Floats) -> Floats:
        """L times values (k,) or (k, n)."""
        taken = ((1 - self.left) * (values.T @ self.directions)).T
        return np.asarray(self.outer @ (values - self.directions @ taken))

    def __rmatmul__(self, matrix: Numbers) -> Numbers:
        """A matrix (n, m) times L."""
        if np.iscomplexobj(matrix):  # without complex copies of the directions
            return (matrix.real @ self) + 1j * (matrix.imag @ self)
        return self._contracted(matrix @ self.outer)

    def variances(self, matrix: Floats | sparse.csr_array | None = None) -> Floats:
        """Sums of squares of the rows of a matrix (n, m) times L, (n,); without one those of L.

        Those of a sparse matrix, or of L itself, to 1e-15 of what they were by the outer root.
        """
        seen = self.outer if matrix is None else matrix @ self.outer
        along = np.asarray(seen @ self.directions)
        rows, columns = self.directions.shape
        if columns == rows:
            across: Floats | float = 0.0
        elif isinstance(seen, np.ndarray):
            across = _squares(seen - along @ self.directions.T)
        else:  # as many as parameters: the difference would be an array of all pairs of them
            across = np.maximum(0, _squares(seen) - _squares(along))
        return np.asarray(across + _squares(along * self.left))

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> Floats:
        """L as an array."""
        outer = self.outer if isinstance(self.outer, np.ndarray) else self.outer.toarray()
        return np.asarray(self._contracted(outer), dtype)

    def _contracted(self, rows: Numbers) -> Numbers:
        """Rows (n, k) times I - V diag(1 - left) V'."""
        if not self.left.size:
            return rows
        return rows - ((rows @ self.directions) * (1 - self.left)) @ self.directions.T


def _squares(rows: Floats | sparse.csr_array) -> Floats:
    """Sums of squares (n,) of rows (n, k)."""
    if isinstance(rows, np.ndarray):
        return np.einsum("ij,ij->i", rows, rows)
    return np.asarray(rows.power(2).sum(axis=1)).ravel()


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution, by its mean and a square root of its covariance.

    Attributes
    ----------
    mean : ndarray, shape (m,)
    root : ndarray or Root, shape (m, k)
        Covariance = root @ root.T; any k. ``matrix @ root`` and ``root @ values`` are those of
        either, and so is ``np.asarray(root)``.
    """

    mean: Floats
    root: Floats | Root

    @property
    def covariance(self) -> Floats:
        """Shape (m, m)."""
        root = np.asarray(self.root)
        return root @ root.T

    @property
    def sd(self) -> Floats:
        """Marginal standard deviations, shape (m,)."""
        return np.sqrt(self.root.variances() if isinstance(self.root, Root)
                       else _squares(self.root))

    def sd_of(self, matrix: Floats | sparse.csr_array) -> Floats:
        """Standard deviations (n,) of the products of a matrix (n, m) with the parameters."""
        return np.sqrt(self.root.variances(matrix) if isinstance(self.root, Root)
                       else _squares(matrix @ self.root))

    def sample(self, count: int, generator: np.random.Generator) -> Floats:
        """Draw ``count`` samples, shape (count, m)."""
        draws = generator.standard_normal((count, self.root.shape[1]))
        return self.mean + np.asarray(self.root @ draws.T).T


def nominal_prior(
    nominal: Floats, dimension: int, magnitude_sd: float, direction_sd_deg: float,
    common_mode_sd: float = 0.0,
) -> Gaussian:
    """Independent deviations of every block along and across its easy axis, and a common mode.

    Parameters
    ----------
    nominal : ndarray, shape (blocks * dimension,), in A/m
        Nominal magnetizations, block by block.
    magnitude_sd, common_mode_sd : float
        Fractions of the nominal magnetization, independent by block and shared by all.
    direction_sd_deg : float
        Of each direction across the easy axis; a small angle, so the deviation is M times it.
    """
    roots = np.zeros((nominal.size // dimension, dimension, dimension))
    for root, vector in zip(roots, nominal.reshape(-1, dimension), strict=True):
        magnitude = float(np.linalg.norm(vector))
        if magnitude == 0:
            continue  # a block that is missing is known not to be there
        axis = (vector / magnitude)[:, None]
        across = linalg.null_space(axis.T)
        root[:] = magnitude * np.hstack(
            [magnitude_sd * axis, np.radians(direction_sd_deg) * across])
    own = by_block(roots)
    return Gaussian(nominal, beside(own, common_mode_sd * nominal[:, None])
                    if common_mode_sd > 0 else own)


def by_block(roots: Floats) -> Root:
    """Root of what every block has for itself, roots (blocks, d, k) of its covariance."""
    number = np.arange(len(roots) + 1)
    return _sparse(sparse.bsr_array((roots, number[:-1], number)))


def beside(*roots: Floats | sparse.csr_array | Root) -> Root:
    """Sparse root (m, k) of the sum of the covariances that several roots are of."""
    return _sparse(sparse.hstack([entries(one) for one in roots]))


def entries(root: Floats | sparse.csr_array | Root) -> Floats | sparse.csr_array:
    """A root as one matrix, sparse if it is that of a prior."""
    if not isinstance(root, Root):
        return root
    return np.asarray(root) if root.left.size else root.outer


def mounted(root: Floats | Root, turns: Floats, sources: Ints) -> Root:
    """Root of the magnetizations of blocks that come from other places, each turned.

    Parameters
    ----------
    turns : ndarray, shape (blocks, d, d)
    sources : ndarray of int, shape (blocks,)
        Of each place, whose block is there now.
    """
    moved = sparse.bsr_array((turns, sources, np.arange(len(turns) + 1)))
    return _sparse(moved @ beside(root).outer)


def _sparse(outer: sparse.sparray) -> Root:
    return Root(sparse.csr_array(outer), np.zeros((outer.shape[1], 0)), np.zeros(0))


def rotated(vectors: Floats, sd: float) -> Floats:
    """What turns of blocks do to their magnetizations: roots (n, d, axes) of the covariance.

    Parameters
    ----------
    vectors : ndarray, shape (n, d), in A/m
        In a cross-section (d = 2) blocks turn about z only.
    sd : float
        Of the turn about each axis, in rad.
    """
    whole = np.zeros((len(vectors), 3))
    whole[:, :vectors.shape[1]] = vectors
    axes = np.eye(3)[2:] if vectors.shape[1] == 2 else np.eye(3)
    changes = np.cross(axes, whole[:, None])  # (n, axes, 3)
    return np.asarray(sd * changes[:, :, :vectors.shape[1]].swapaxes(1, 2))
