"""Leave-one-out residuals, and chi-squared of groups of readings given all other readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as linalg
from scipy import special

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.stats.small_samples import false_discovery_rates

DISCOVERIES = 0.01
"""False discovery rate among the groups that are reported to disagree with the model."""


@dataclass(frozen=True)
class ResidualGroup:
    """The residual of a group of readings, such as those in a window of z.

    Attributes
    ----------
    kind, name : str
        Kind and name of the group, for example ``z`` and ``-0.10 ... 0.00 m``.
    readings : int
        Number of readings.
    chi2_per_reading : float
        Chi-squared per reading; its expectation is 1.
    p : float
        Probability of a larger chi-squared by chance, adjusted for the number of groups (Benjamini
        and Hochberg).
    """

    kind: str
    name: str
    readings: int
    chi2_per_reading: float
    p: float

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
    marginal : Marginal
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
