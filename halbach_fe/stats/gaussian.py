"""Normal distributions: of block magnetizations by roots of their covariances, and of the noise.

A root of a covariance C, also called a covariance factor, is any matrix L (m, k) with C = L L'.

The noise of readings has mean 0. Readings of the same point, or of the same circle, may be
correlated; readings of different points or circles are not. Its covariance Sigma is therefore
sparse: up to the order of the readings it is block-diagonal, and each block has its own Cholesky
factor. Whitening by ``W = L^-1``, so that ``W Sigma W' = I``, is cheap.

Of small samples, as of the blocks of a delivery, the covariance is shrunk, and tests tell whether
they are normal; p-values of many tests are adjusted for their number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import scipy.linalg as linalg
import scipy.sparse as sparse
import scipy.special as special
from numpy.typing import DTypeLike, NDArray
from scipy.sparse.csgraph import connected_components

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.errors import MeasurementError, StudyError, must_be
from halbach_fe.core.numbers import check_number

Numbers = TypeVar("Numbers", NDArray[np.float64], NDArray[np.complex128])


@dataclass(frozen=True)
class CovarianceFactor:
    """A root L = outer (I - V diag(1 - remaining) V') of a covariance, stored by its parts.

    For a prior L is its outer root, which is sparse: small diagonal blocks for the independent
    deviations of the magnet's blocks, and a few dense columns for the deviations that blocks share.
    A posterior keeps the outer root of its prior. Along each orthonormal direction V the readings
    reduce the standard deviation to the fraction ``remaining``; in all orthogonal directions it is
    unchanged. There may be far fewer readings, and so directions, than parameters.
    """

    outer: Floats | sparse.csr_array
    """Shape (m, k)."""
    directions: Floats
    """V, with orthonormal columns; r = 0 for a prior. Shape (k, r)."""
    remaining: Floats
    """Fraction of the standard deviation that remains along each direction. Shape (r,)."""

    __array_ufunc__ = None  # numpy leaves `array @ factor` to __rmatmul__

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns (m, k)."""
        rows, columns = self.outer.shape
        return int(rows), int(columns)

    def __matmul__(self, values: Floats) -> Floats:
        """Return L times values (k,) or (k, n)."""
        removed = ((1 - self.remaining) * (values.T @ self.directions)).T
        return np.asarray(self.outer @ (values - self.directions @ removed))

    def __rmatmul__(self, matrix: Numbers) -> Numbers:
        """Return a matrix (n, m) times L."""
        if np.iscomplexobj(matrix):  # avoids complex copies of the directions
            return (matrix.real @ self) + 1j * (matrix.imag @ self)
        return self._contracted(matrix @ self.outer)

    def variances(self, matrix: Floats | sparse.csr_array | None = None) -> Floats:
        """Return the variances (n,) of the products of a matrix (n, m) with the parameters.

        They are the sums of squares of the rows of the matrix times L. Without a matrix they are
        the variances (m,) of the parameters themselves. If the matrix is sparse, or there is none,
        the rounding error is 1e-15 of the variance by the outer root alone.
        """
        rows = self.outer if matrix is None else matrix @ self.outer
        along = np.asarray(rows @ self.directions)
        coordinates, directions = self.directions.shape
        if directions == coordinates:
            orthogonal: Floats | float = 0.0
        elif isinstance(rows, np.ndarray):
            orthogonal = _row_square_sums(rows - along @ self.directions.T)
        else:  # avoids the difference, a dense array of all pairs of parameters
            orthogonal = np.maximum(0, _row_square_sums(rows) - _row_square_sums(along))
        return np.asarray(orthogonal + _row_square_sums(along * self.remaining))

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> Floats:
        """Return L as a dense array."""
        outer = self.outer if isinstance(self.outer, np.ndarray) else self.outer.toarray()
        return np.asarray(self._contracted(outer), dtype)

    def _contracted(self, rows: Numbers) -> Numbers:
        """Return rows (n, k) times I - V diag(1 - remaining) V'."""
        if not self.remaining.size:
            return rows
        return rows - ((rows @ self.directions) * (1 - self.remaining)) @ self.directions.T


def _row_square_sums(rows: Floats | sparse.csr_array) -> Floats:
    """Return the sums of squares (n,) of rows (n, k)."""
    if isinstance(rows, np.ndarray):
        return np.einsum("ij,ij->i", rows, rows)
    return np.asarray(rows.power(2).sum(axis=1)).ravel()


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution, given by its mean and a root of its covariance."""

    mean: Floats
    """Shape (m,)."""
    root: Floats | CovarianceFactor
    """Covariance = root @ root.T, with any k. For both types ``matrix @ root`` and ``root @
    values`` are arrays, and ``np.asarray(root)`` is the root as a dense array. Shape (m, k)."""
    beside: Gaussian | None = None
    """Other parameters (b,) that are known together with these, such as those of the blocks of
    neighbours: the columns of its root (b, k) belong to the same independent variables."""

    @property
    def stacked(self) -> Gaussian:
        """All parameters (m + b,): these, followed by those beside."""
        if self.beside is None:
            return self
        mean, root, other = np.append(self.mean, self.beside.mean), self.root, self.beside.root
        if not (isinstance(root, CovarianceFactor) and isinstance(other, CovarianceFactor)):
            return Gaussian(mean, np.vstack([np.asarray(root), np.asarray(other)]))
        return Gaussian(mean, replace(root, outer=sparse.csr_array(sparse.vstack(
            [sparse.csr_array(root.outer), sparse.csr_array(other.outer)]))))

    def split(self, count: int, beside: int) -> Gaussian:
        """Return the first ``count`` parameters, with so many beside that follow them."""
        def part(rows: slice) -> Gaussian:
            root = self.root
            return Gaussian(self.mean[rows], replace(root, outer=root.outer[rows])
                            if isinstance(root, CovarianceFactor) else root[rows])

        return replace(part(slice(count)), beside=part(
            slice(count, count + beside)) if beside else None)

    def with_beside(self, other: Gaussian) -> Gaussian:
        """Return these parameters with others beside, which are independent of them."""
        root = self.root if isinstance(self.root, CovarianceFactor) else stacked_root(self.root)
        outer = sparse.block_diag([sparse.csr_array(root.outer),
                                   sparse.csr_array(root_matrix(other.root))], format="csr")
        directions = np.vstack([
            root.directions, np.zeros((other.root.shape[1], len(root.remaining)))])
        return Gaussian(np.append(self.mean, other.mean), CovarianceFactor(
            sparse.csr_array(outer), directions, root.remaining)).split(
                len(self.mean), len(other.mean))

    def products(self, matrix: Numbers, of_beside: Numbers | None) -> tuple[Numbers, Numbers]:
        """Return mean (n,) and root (n, k) of the products of a matrix (n, m) with these parameters
        and of another (n, b) with those beside, if both are known.
        """
        mean, root = matrix @ self.mean, matrix @ self.root
        if self.beside is None or of_beside is None:
            return mean, root
        return mean + of_beside @ self.beside.mean, root + of_beside @ self.beside.root

    @property
    def covariance(self) -> Floats:
        """Covariance matrix, shape (m, m)."""
        root = np.asarray(self.root)
        return root @ root.T

    @property
    def sd(self) -> Floats:
        """Marginal standard deviations, shape (m,)."""
        return np.sqrt(self.root.variances() if isinstance(self.root, CovarianceFactor)
                       else _row_square_sums(self.root))

    def sd_of(self, matrix: Floats | sparse.csr_array) -> Floats:
        """Return the standard deviations (n,) of the products of a matrix (n, m) with the
        parameters.
        """
        return np.sqrt(self.root.variances(matrix) if isinstance(self.root, CovarianceFactor)
                       else _row_square_sums(matrix @ self.root))

    def sample(self, count: int, generator: np.random.Generator) -> Floats:
        """Draw ``count`` samples, shape (count, m), by a generator such as
        ``numpy.random.default_rng(1)``.

        Raises
        ------
        StudyError
            If they are none.
        """
        check_number("count", "sample", count, 0, whole=True)
        if not isinstance(generator, np.random.Generator):
            raise StudyError(must_be("generator", "sample", "a random generator",
                                     f"a {type(generator).__name__}",
                                     "Give numpy.random.default_rng(1)."))
        draws = generator.standard_normal((count, self.root.shape[1]))
        return self.mean + np.asarray(self.root @ draws.T).T


def correlated_values(mean: Floats, covariance: Floats, normals: Floats) -> Floats:
    """Return samples (count, m) of a normal distribution from standard normal numbers of the same
    shape.
    """
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(mean + normals * np.sqrt(np.maximum(values, 0)) @ vectors.T)


def nominal_prior(
    nominal: Floats, dimension: int, magnitude_sd: float, direction_sd_deg: float,
    shared_sds: Floats | float = 0.0,
) -> Gaussian:
    """Return a prior about the nominal magnetizations.

    Every block deviates independently in magnitude (along its easy axis) and in direction (across
    the axis); in addition the magnitudes share relative deviations: all of them one, the common
    mode, or those of each grade one.

    Parameters
    ----------
    nominal : ndarray, shape (blocks * dimension,), in A/m
        Nominal magnetizations, block by block.
    dimension : int
        Number of components of a magnetization, 2 or 3.
    magnitude_sd : float
        Standard deviation of each block's own magnitude, as a fraction of the nominal one.
    direction_sd_deg : float
        Standard deviation of the angle about each axis across the easy axis, in degrees. The angle
        is assumed small, so that the deviation is the magnetization times the angle in rad.
    shared_sds : float or ndarray, shape (blocks, k)
        Standard deviation of the common mode, or of each of k independent deviations in every
        block, as fractions of the nominal magnetization.
    """
    roots = np.zeros((nominal.size // dimension, dimension, dimension))
    for root, vector in zip(roots, nominal.reshape(-1, dimension), strict=True):
        magnitude = float(np.linalg.norm(vector))
        if magnitude == 0:
            continue  # a place without a block has no magnetization, and no uncertainty
        axis = (vector / magnitude)[:, None]
        across = linalg.null_space(axis.T)
        root[:] = magnitude * np.hstack(
            [magnitude_sd * axis, np.radians(direction_sd_deg) * across])
    independent = block_diagonal_root(roots)
    shared = np.atleast_2d(shared_sds)
    columns = nominal.reshape(-1, dimension, 1) * shared[:, None, :]
    return Gaussian(nominal, stacked_root(independent, columns.reshape(nominal.size, -1))
                    if shared.any() else independent)


def block_diagonal_root(roots: Floats) -> CovarianceFactor:
    """Return the block-diagonal root of independent blocks with roots (blocks, d, k)."""
    number = np.arange(len(roots) + 1)
    return _sparse_root(sparse.bsr_array((roots, number[:-1], number)))


def stacked_root(*roots: Floats | sparse.csr_array | CovarianceFactor) -> CovarianceFactor:
    """Return a sparse root of the sum of covariances, whose roots (m, k_i) it holds side by side.

    With [L_1 L_2 ...] as the root the covariance is L_1 L_1' + L_2 L_2' + ...
    """
    return _sparse_root(sparse.hstack([sparse.csr_array(root_matrix(root)) for root in roots]))


def with_independent(prior: Gaussian, mean: Floats, sd: Floats) -> Gaussian:
    """Return a distribution of the same parameters and, after them, of independent ones (k,)."""
    root = sparse.block_diag([sparse.csr_array(root_matrix(prior.root)), sparse.diags_array(sd)])
    other = prior.beside
    return Gaussian(
        np.concatenate([prior.mean, mean]), stacked_root(root),
        None if other is None else Gaussian(other.mean, stacked_root(
            other.root, sparse.csr_array((len(other.mean), len(sd))))))


def root_matrix(root: Floats | sparse.csr_array | CovarianceFactor) -> Floats | sparse.csr_array:
    """Return a root as a single matrix, which for a prior is its sparse outer root."""
    if not isinstance(root, CovarianceFactor):
        return root
    return np.asarray(root) if root.remaining.size else root.outer


def largest_directions(matrix: Floats, smallest: float) -> Floats:
    """Return the right singular vectors (k, r) of a matrix (n, k) of values above ``smallest``.

    They are eigenvectors of the smaller Gram matrix. Of a large one, of which few values are so
    large, a subspace is iterated that is larger (N. Halko, P. G. Martinsson, J. A. Tropp, SIAM Rev.
    53 (2011) 217), until it has values that are too small.
    """
    wide = len(matrix) < matrix.shape[1]
    gram = matrix @ matrix.T if wide else matrix.T @ matrix
    most, turns = len(gram) // 3, 2  # size up to which the subspace takes less time; iterations
    # With two iterations and values below half of the smallest one in the subspace, the largest
    # part of a wanted direction outside of it was 6e-3 of the smallest value: 434 of 3637.
    size, spare = max(64, len(gram) // 6), 0.5
    generator = np.random.default_rng(0)
    while size <= most:
        basis = generator.standard_normal((len(gram), size))
        for _ in range(turns):
            basis = np.linalg.qr(gram @ basis)[0]
        squares, inside = np.linalg.eigh(basis.T @ gram @ basis)
        if squares[0] < (spare * smallest)**2:
            vectors = basis @ inside
            break
        size *= 2
    else:
        squares, vectors = np.linalg.eigh(gram)
    kept = squares > smallest**2
    found = vectors[:, kept]
    # small values of a Gram matrix have vectors that its rounding has turned towards each other
    return np.asarray(np.linalg.qr(matrix.T @ found)[0] if wide else found)


def remounted_root(
    root: Floats | CovarianceFactor, turns: Floats, sources: Ints
) -> CovarianceFactor:
    """Return the root after blocks were moved to other places and turned.

    Parameters
    ----------
    root : ndarray or CovarianceFactor, shape (blocks * d, k)
        Root of the magnetizations before the move.
    turns : ndarray, shape (blocks, d, d)
        For each place, the rotation matrix of the block that is mounted there.
    sources : ndarray of int, shape (blocks,)
        For each place, the place from which its block comes.
    """
    moved = sparse.bsr_array((turns, sources, np.arange(len(turns) + 1)))
    return _sparse_root(moved @ stacked_root(root).outer)


def _sparse_root(outer: sparse.sparray) -> CovarianceFactor:
    """Return a sparse matrix as a root that no readings have reduced."""
    return CovarianceFactor(sparse.csr_array(outer), np.zeros((outer.shape[1], 0)), np.zeros(0))


def rotation_roots(vectors: Floats, sd: float) -> Floats:
    """Return roots (n, d, axes) of the covariances that small random rotations give vectors.

    Parameters
    ----------
    vectors : ndarray, shape (n, d), in A/m
        Magnetizations of blocks. In a cross-section (d = 2) blocks rotate about z only, else about
        x, y and z.
    sd : float
        Standard deviation of the rotation about each axis, in rad.
    """
    vectors_3d = np.zeros((len(vectors), 3))
    vectors_3d[:, :vectors.shape[1]] = vectors
    axes = np.eye(3)[2:] if vectors.shape[1] == 2 else np.eye(3)
    changes = np.cross(axes, vectors_3d[:, None])  # (n, axes, 3)
    return np.asarray(sd * changes[:, :, :vectors.shape[1]].swapaxes(1, 2))


def by_readings_alone(
    prior: Gaussian, posterior: Gaussian, directions: Floats
) -> tuple[Floats, Floats]:
    """Return the changes (k,) from the prior mean along unit vectors (k, m), and their standard
    deviations, that an update would find if nothing had been known before along one of them.

    A wide prior along ``u`` takes ``q q^T / (u.q)`` from the inverse covariance of the posterior,
    with ``q`` the product of the inverse covariance of the prior and ``u`` (Sherman and Morrison).
    The standard deviation is huge where the readings say nothing. What the prior has as exact stays
    so; it is infinite if that is a part of ``u``.
    """
    ridge = 1e-12  # of variances, which makes exact combinations of parameters definite
    sd = prior.sd
    scale = np.where(sd > 0, sd, 1.0)
    covariance = prior.covariance / np.outer(scale, scale)
    scaled = directions.T / scale[:, None]
    known = np.linalg.solve(covariance + ridge * np.eye(len(sd)), scaled)
    is_exact = np.abs(covariance @ known - scaled).max(axis=0) > 1e-6 * np.abs(scaled).max(axis=0)
    known /= scale[:, None]
    spread = posterior.covariance @ known
    along, own = np.sum(directions.T * known, axis=0), np.sum(directions.T * spread, axis=0)
    # below rounding the readings leave the prior as it was
    told = np.maximum(along - np.sum(known * spread, axis=0), 1e-12 * along)
    change = posterior.mean - prior.mean
    with np.errstate(divide="ignore", invalid="ignore"):
        pull = own / told
        return (np.where(is_exact, 0.0, directions @ change + pull * (change @ known)),
                np.where(is_exact, np.inf,
                         np.sqrt(posterior.sd_of(directions) ** 2 + pull * own)))


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
                raise _covariance_error(
                    "positive definite", "a singular or indefinite matrix, as if the noise of a "
                    "reading were the sum of others", "Is sigma far too small beside what the "
                    "gradient of the field makes of noise.position_sd_m?")
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


def _covariance_error(expected: str, received: str, advice: str = "") -> MeasurementError:
    """Return the error that says how a covariance must be, and what was received."""
    return MeasurementError(must_be("covariance", "the noise", expected, received, advice))


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
