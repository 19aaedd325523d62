"""Where readings disagree with what prior and noise foretell of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as linalg
from scipy import stats
from scipy.stats import false_discovery_control

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Marginal

DISCOVERIES = 0.01
"""False discovery rate among the groups of readings that are called in disagreement."""


@dataclass(frozen=True)
class ResidualGroup:
    """Readings that belong together, as those of a z window.

    Attributes
    ----------
    kind, name : str
        As ``z`` and ``-0.10 ... 0.00 m``.
    readings : int
    chi2_per_reading : float
        Expected 1.
    p : float
        Chance of more, adjusted for the number of groups (Benjamini and Hochberg).
    """

    kind: str
    name: str
    readings: int
    chi2_per_reading: float
    p: float

    @property
    def disagrees(self) -> bool:
        """Whether chance is no explanation."""
        return self.p < DISCOVERIES


def loo_residuals(marginal: Marginal, residual: Floats) -> Floats:
    """Standardized residual (n,) of each reading from what all the others foretell of it.

    The leave-one-out identity ``(S^-1 r)_i / sqrt((S^-1)_ii)``, of whitened readings with the
    blocks integrated out; normal if nothing is missing.
    """
    kept = linalg.solve_triangular(marginal.factor[0], marginal.whitened.T, lower=True)
    own = 1 - np.einsum("ij,ij->j", kept, kept)
    return np.asarray(marginal.remove(residual[:, None])[:, 0] / np.sqrt(np.maximum(own, 1e-12)))


def residual_groups(
    marginal: Marginal, residual: Floats, memberships: dict[str, list[str]]
) -> list[ResidualGroup]:
    """Chi-squared of groups of readings under their joint predictive distribution.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Whitened.
    memberships : dict
        By kind of group, the group of each reading.
    """
    found: list[tuple[str, str, int, float, float]] = []
    half = linalg.solve_triangular(marginal.factor[0], marginal.whitened.T, lower=True).T
    kept = marginal.remove(residual[:, None])[:, 0]  # S^-1 r
    for kind, names in memberships.items():
        of = np.array(names)
        for name in dict.fromkeys(names):
            rows = np.flatnonzero(of == name)
            # predictive residual of the group given the others: precision P = (S^-1) of its rows,
            # chi2 = (S^-1 r)' P^-1 (S^-1 r); P = 1 - half half'
            part = half[rows]
            inner = np.eye(part.shape[1]) - part.T @ part
            score = kept[rows]
            solved = score + part @ np.linalg.lstsq(inner, part.T @ score, rcond=1e-10)[0]
            chi2 = float(score @ solved)
            found.append((kind, name, len(rows), chi2 / len(rows),
                          float(stats.chi2.sf(chi2, len(rows)))))
    adjusted = false_discovery_control([one[-1] for one in found]) if found else []
    return [ResidualGroup(*one[:4], float(p)) for one, p in zip(found, adjusted, strict=True)]
