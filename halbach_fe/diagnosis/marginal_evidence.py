"""The evidence of missing effects, with the magnetizations of the blocks integrated out.

Readings are ``r = H (p - mu_0) + J theta + noise``, where r is their residual from the prior mean,
p ~ N(mu_0, C_0) are the magnetizations and theta ~ N(m, s^2) the amplitudes of the effects whose
signatures are the columns of J. With p integrated out, r has the covariance
``S = Sigma + H C_0 H'``. The log evidence of any set of effects then follows from

    A = J' S^-1 J,    b = J' S^-1 r,    c = r' S^-1 r

as a determinant and a quadratic form (C. M. Bishop, Pattern Recognition and Machine Learning, eq.
2.115; the Woodbury identity for S). Amplitudes are in units of their prior standard deviation. One
product with S^-1 therefore serves the comparison of thousands of signatures.

The same S gives leave-one-out residuals, and chi-squared of groups of readings given all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as linalg
from scipy import special

from halbach_fe.core.arrays import Floats, Ints, slices
from halbach_fe.stats.gaussian import false_discovery_rates


@dataclass(frozen=True)
class Fit:
    """The posterior of the amplitudes of a set of effects."""

    log_evidence: float
    """Log evidence of the set over that of no effect."""
    mean: Floats
    covariance: Floats
    """Posterior mean and covariance of the amplitudes, in units of their prior standard deviation.
    Shape (k,) and (k, k)."""


@dataclass(frozen=True)
class Evidence:
    """The sufficient statistics of readings for a set of signatures, the blocks integrated out.

    Conditioning on a few of thousands of columns changes the matrix A by a product of low rank.
    Only its factor is kept, so that it costs as much as the columns and not as their square. The
    matrix A is ``(information - absorbed' absorbed) / temperature``.
    """

    information: Floats
    """The matrix A of the module's docstring before any columns were integrated out. Use `part`.
    Shape (k, k)."""
    score: Floats
    """The vector b of the module's docstring. Shape (k,)."""
    chi2: float
    """The scalar c of the module's docstring. Its expectation is the number of readings if no
    effect is missing."""
    readings: int
    """Number of readings."""
    prior: Floats
    """Prior precisions of the amplitudes, in units of their usual prior standard deviation: 1
    unless widened. Shape (k,)."""
    absorbed: Floats
    """Information that columns which were integrated out have taken, one row for each of them.
    Shape (d, k)."""
    temperature: float = 1.0
    """Variance of the noise over the stated one."""

    @classmethod
    def of(cls, information: Floats, score: Floats, chi2: float, readings: int) -> Evidence:
        """Return the evidence of columns of which none is integrated out."""
        count = len(score)
        return cls(information, score, chi2, readings, np.ones(count), np.zeros((0, count)))

    def part(self, index: Ints) -> Floats:
        """Return the rows and columns of A of some signatures."""
        absorbed = self.absorbed[:, index]
        return (self.information[np.ix_(index, index)] - absorbed.T @ absorbed) / self.temperature

    def rows(self, index: Ints) -> Floats:
        """Return the rows of A of some signatures, without a copy of all of A."""
        return (self.information[index]
                - self.absorbed[:, index].T @ self.absorbed) / self.temperature

    def fit(self, chosen: Sequence[int]) -> Fit:
        """Return the posterior of the amplitudes of a set of columns, whose prior mean is 0."""
        index = np.asarray(chosen, int)
        if not len(index):
            return Fit(0.0, np.zeros(0), np.zeros((0, 0)))
        precision = self.part(index) + np.diag(self.prior[index])
        factor = linalg.cho_factor(precision, lower=True)
        mean = linalg.cho_solve(factor, self.score[index])
        size = float(np.log(np.diag(factor[0])).sum() - np.log(self.prior[index]).sum() / 2)
        return Fit(float(self.score[index] @ mean / 2) - size, mean,
                   linalg.cho_solve(factor, np.eye(len(index))))

    def explained(self, chosen: Sequence[int]) -> float:
        """Return the part of chi-squared that columns account for together, at any amplitudes."""
        index = np.asarray(chosen, int)
        score = self.score[index]
        return float(score @ np.linalg.lstsq(self.part(index), score)[0])

    def given(self, chosen: Sequence[int]) -> Evidence:
        """Return the evidence with the amplitudes of a set of columns integrated out."""
        index = np.asarray(chosen, int)
        if not len(index):
            return self
        precision = self.part(index) + np.diag(self.prior[index])
        return self.beside(linalg.cholesky(precision, lower=True), self.rows(index),
                           self.score[index])

    def beside(self, root: Floats, cross: Floats, score: Floats) -> Evidence:
        """Return the evidence with the amplitudes of other columns integrated out.

        Parameters
        ----------
        root : ndarray, shape (d, d)
            The lower Cholesky factor of the matrix A of these columns, plus their prior precisions
            on its diagonal.
        cross : ndarray, shape (d, k)
            Their rows of the matrix A.
        score : ndarray, shape (d,)
            Their vector b.
        """
        taken, own = (linalg.solve_triangular(root, part, lower=True) for part in (cross, score))
        return replace(
            self, score=self.score - own @ taken, chi2=self.chi2 - float(own @ own),
            absorbed=np.vstack([self.absorbed, np.sqrt(self.temperature) * taken]))

    def only(self, chosen: Sequence[int]) -> Evidence:
        """Return the evidence of a subset of the columns."""
        index = np.asarray(chosen, int)
        return replace(self, information=self.part(index), score=self.score[index],
                       prior=self.prior[index], absorbed=np.zeros((0, len(index))),
                       temperature=1.0)

    def shifted(self, column: int) -> Evidence:
        """Return the evidence of the readings less one signature at amplitude 1."""
        row = self.rows(np.array([column]))[0]
        return replace(self, score=self.score - row,
                       chi2=self.chi2 - 2 * self.score[column] + row[column])

    def tempered(self, factor: float) -> Evidence:
        """Return the evidence if the variance of the noise is larger by a factor."""
        return replace(self, temperature=factor * self.temperature, score=self.score / factor,
                       chi2=self.chi2 / factor)

    def widened(self, chosen: Sequence[int], width: float | Floats) -> Evidence:
        """Return the evidence with another prior standard deviation for a set of columns.

        ``width``, of all or of each (k,), is in units of the usual prior standard deviation of
        these columns.
        """
        prior = self.prior.copy()
        prior[np.asarray(chosen, int)] = np.asarray(width, float)**-2
        return replace(self, prior=prior)

    def log_evidences(self, groups: Sequence[Sequence[int]]) -> Floats:
        """Return the log evidence of every group of columns by itself, over that of no effect."""
        found = np.empty(len(groups))
        sizes: dict[int, list[int]] = {}
        for number, group in enumerate(groups):
            sizes.setdefault(len(group), []).append(number)
        for size, members in sizes.items():
            index = np.array([groups[number] for number in members])
            prior = self.prior[index]
            taken = self.absorbed[:, index]  # (d, groups, size)
            precision = (self.information[index[:, :, None], index[:, None, :]]
                         - np.einsum("dgi,dgj->gij", taken, taken)) / self.temperature + (
                prior[:, :, None] * np.eye(size))
            score = self.score[index]
            mean = np.linalg.solve(precision, score[:, :, None])[:, :, 0]
            found[members] = (np.einsum("gk,gk->g", score, mean) + np.log(prior).sum(axis=1)
                              - np.linalg.slogdet(precision)[1]) / 2
        return found


@dataclass(frozen=True)
class Marginal:
    """The readings with the blocks integrated out, for products with S^-1."""

    whitened: Floats
    """Sigma^-1/2 H L, with L a factor of C_0. Shape (n, m)."""
    factor: tuple[Floats, bool]
    """Cholesky factor of 1 + whitened' whitened."""

    @classmethod
    def of(cls, whitened: Floats) -> Marginal:
        """Build it from the whitened response (n, m) of the readings to whitened parameters."""
        product = np.eye(whitened.shape[1])
        for part in _rows(len(whitened)):
            product += whitened[part].T @ whitened[part]
        return cls(whitened, linalg.cho_factor(product, lower=True))

    def evidence(
        self, signatures: Floats, residual: Floats, absorbed: Floats | None = None
    ) -> Evidence:
        """Return the evidence of whitened signatures (n, k) at amplitude 1 for a whitened residual
        (n,).

        ``absorbed`` (m, k + 1) is `absorbed` of signatures and residual, if it is known already.
        """
        half = self.absorbed(np.column_stack([signatures, residual])
                             ) if absorbed is None else absorbed
        taken, of_residual = half[:, :-1], half[:, -1]
        information = -taken.T @ taken
        for part in _rows(len(signatures)):
            information += signatures[part].T @ signatures[part]
        return Evidence.of(information, signatures.T @ residual - taken.T @ of_residual,
                           float(residual @ residual - of_residual @ of_residual),
                           len(signatures))

    def absorbed(self, columns: Floats) -> Floats:
        """Return what the blocks absorb of whitened columns (n, k), as (m, k).

        For two columns a and b the product ``a' S^-1 b`` is ``a' b - absorbed(a)' absorbed(b)``.
        """
        cross = np.zeros((self.whitened.shape[1], columns.shape[1]))
        for part in _rows(len(columns)):
            cross += self.whitened[part].T @ columns[part]
        return np.asarray(linalg.solve_triangular(self.factor[0], cross, lower=True))

    def remove(self, columns: Floats) -> Floats:
        """Return whitened S^-1 times whitened columns (n, k): the part that the blocks cannot
        absorb.
        """
        absorbed = linalg.cho_solve(self.factor, self.whitened.T @ columns)
        return np.asarray(columns - self.whitened @ absorbed)


def with_fewer_columns(root: Floats) -> Floats:
    """Return a factor (n, min(n, m)) of the covariance ``root root'``, for ``root`` (n, m).

    Thousands of blocks have many times as many parameters as there are readings.
    """
    rows, columns = root.shape
    if columns <= rows:
        return root
    return np.asarray(linalg.qr(root.T, mode="r", check_finite=False)[0][:rows].T)


def _rows(count: int) -> list[slice]:
    """Return slices of rows, so few that the memory of a product over them is bounded."""
    # Number of rows that products over all readings take at a time, to bound their memory.
    rows_at_once = 8192
    return slices(count, rows_at_once)


DISCOVERIES = 0.01
"""False discovery rate among the groups that are reported to disagree with the model."""


@dataclass(frozen=True)
class ResidualGroup:
    """The residual of a group of readings, such as those in a window of z."""

    kind: str
    name: str
    """Kind and name of the group, for example ``z`` and ``-0.10 ... 0.00 m``."""
    readings: int
    """Number of readings."""
    chi2_per_reading: float
    """Chi-squared per reading; its expectation is 1."""
    p: float
    """Probability of a larger chi-squared by chance, adjusted for the number of groups (Benjamini
    and Hochberg)."""

    @property
    def disagrees(self) -> bool:
        """Whether the group disagrees with the model at the false discovery rate `DISCOVERIES`."""
        return self.p < DISCOVERIES


def loo_residuals(marginal: Marginal, residual: Floats) -> Floats:
    """Return the standardized leave-one-out residual (n,) of each reading.

    It is ``(S^-1 r)_i / sqrt((S^-1)_ii)`` of the whitened readings with the blocks integrated out,
    and is standard normal if no effect is missing.
    """
    kept = linalg.solve_triangular(marginal.factor[0], marginal.whitened.T, lower=True)
    own = 1 - np.einsum("ij,ij->j", kept, kept)
    return np.asarray(marginal.remove(residual[:, None])[:, 0] / np.sqrt(np.maximum(own, 1e-12)))


def _solve_less_product(half: Floats, right: Floats) -> Floats:
    """Return the solution x (n,) of (1 - half half') x = right, for ``half`` of shape (n, k).

    The system has the smaller one of both dimensions: (1 - h h')^-1 = 1 + h (1 - h' h)^-1 h'.
    """
    rows, columns = half.shape
    if rows <= columns:
        return _solve_semidefinite(np.eye(rows) - half @ half.T, right)
    return right + half @ _solve_semidefinite(np.eye(columns) - half.T @ half, half.T @ right)


def _solve_semidefinite(matrix: Floats, right: Floats) -> Floats:
    """Return the solution x (n,) of a positive semidefinite system, the smallest of several."""
    # Smallest eigenvalue of a matrix, relative to its largest one, that is more than rounding.
    singular = 1e-10
    try:
        factor = linalg.cho_factor(matrix, lower=True)
    except linalg.LinAlgError:
        pass
    else:
        size = np.diag(factor[0])
        if size.min()**2 > singular * size.max()**2:
            return np.asarray(linalg.cho_solve(factor, right))
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=singular)[0])


def residual_groups(
    marginal: Marginal, residual: Floats, memberships: dict[str, list[str]]
) -> list[ResidualGroup]:
    """Return chi-squared of groups of readings under their predictive distribution.

    The readings of a group are predicted jointly by all readings outside of the group.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Whitened residual of the readings.
    memberships : dict
        For each kind of group, the name of the group to which each reading belongs.
    """
    found: list[tuple[str, str, int, float, float]] = []
    half = linalg.solve_triangular(marginal.factor[0], marginal.whitened.T, lower=True).T
    kept = marginal.remove(residual[:, None])[:, 0]  # S^-1 r
    for kind, names in memberships.items():
        of = np.array(names)
        for name in dict.fromkeys(names):
            rows = np.flatnonzero(of == name)
            # the group given all others has precision P, the block 1 - half half' of S^-1
            score = kept[rows]
            chi2 = float(score @ _solve_less_product(half[rows], score))  # (S^-1 r)' P^-1 (S^-1 r)
            found.append((kind, name, len(rows), chi2 / len(rows),
                          float(special.chdtrc(len(rows), chi2))))
    adjusted = false_discovery_rates(np.array([group[-1] for group in found]))
    return [ResidualGroup(*group[:4], float(p)) for group, p in zip(found, adjusted, strict=True)]
