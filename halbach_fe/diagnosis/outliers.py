"""Single readings that are off by far more than their noise, while their neighbours are not.

Each reading is compared with what all others foretell of it, blocks integrated out, and that
difference with those of its neighbours: whatever a model lacks is smooth, and what is left of it
varies little from one reading to the next, or is rough all around. A second-order polynomial
through the neighbours, robust against other outliers, foretells the difference, and how far they
are from it themselves is the local scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as linalg
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.inference.result import HELD_OUT_MAP, InferenceResult
from halbach_fe.stats.noise import NoiseCovariance
from halbach_fe.study.inference import ExcludedReading
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS, Component

NEIGHBOURS = 24
"""Of the same component; a polynomial of second order has ten coefficients."""

LOCAL = 9.0
"""Times the local scale. That is a median of some 24 numbers: of noise whose level is not known,
one reading in 10^5 is beyond."""

ODDS = 1e-3
"""Prior odds of any reading being off."""

RANGE = 0.1
"""Of the largest reading: an outlier may be off by this much either way, all equally likely."""

FOUND = 5.0
"""Log posterior odds from which a reading is one: beyond some six standard deviations."""

ROBUST = 6
"""Fits of a polynomial: neighbours far from the last one weigh less, as several may be off."""

CAUCHY = 2.385
"""Times the scale, at which a neighbour weighs half (P. W. Holland and R. E. Welsch, Communications
in Statistics A6 (1977) 813)."""

CLOSE = 4
"""Nearest neighbours that are no outliers too, but by chance."""

CHANCE = 1e-4

MAD = 1.4826
"""Standard deviation over the median of the magnitude, of normal numbers."""

PASSES = 6
"""Large outliers hide small ones, by what the blocks make of them."""

MOST = 0.1
"""Fraction of the readings that may be off: if it is more, they are no outliers."""


@dataclass(frozen=True)
class Outlier:
    """A reading that is off.

    Attributes
    ----------
    row : int
        Of the map, from 1.
    component : str
    at_m : tuple of float
        Where the map says that it is.
    off_T, sd_T : float
        Difference from what all readings that are not off foretell, and its standard deviation.
    """

    row: int
    component: Component
    at_m: tuple[float, ...]
    off_T: float
    sd_T: float


def outliers_of(update: InferenceResult) -> tuple[Outlier, ...]:
    """Find readings of a map that are off; none among Fourier coefficients, each of which is made
    of many.
    """
    observation = update.observation
    if (np.diff(observation.analysis.indptr) != 1).any():
        return ()
    own = np.array(update.parts) != HELD_OUT_MAP
    root = update.response.matrix[own] @ update.prior.root
    residual = (update.readings - update.prediction_prior.mean)[own]
    noise, training = update.errors.part(own), ~update.held_out[own]
    labels = [label for label, mine in zip(observation.labels, own, strict=True) if mine]
    off = find_outliers(root, residual, noise, training, labels, observation.positions[own],
                        float(np.abs(update.readings[own]).max()))
    if not off.any():
        return ()
    now = foretold(root, residual, noise, training & ~off)
    point, component = np.divmod(observation.analysis.indices[own], len(COMPONENTS))
    return tuple(
        Outlier(int(point[k]) + 1, COMPONENTS[component[k]],
                tuple(observation.positions[own][k].tolist()), float(now.difference[k]),
                float(now.sd[k])) for k in np.flatnonzero(off))


def excluding(study: Study, outliers: Sequence[Outlier]) -> Study:
    """The study that leaves outliers out."""
    rows: dict[int, list[Component]] = {}
    for one in outliers:
        rows.setdefault(one.row, []).append(one.component)
    inference = study.inference.with_(excluded_readings=(
        *study.inference.excluded_readings,
        *(ExcludedReading(row=row, components=tuple(names)) for row, names in rows.items())))
    return study.with_(inference=inference)


@dataclass(frozen=True)
class Foretold:
    """Readings as all others foretell them: differences (n,) and their standard deviations (n,)."""

    difference: Floats
    sd: Floats


def foretold(
    root: Floats, residual: Floats, noise: NoiseCovariance, used: NDArray[np.bool_]
) -> Foretold:
    """What used readings foretell of every reading, of a used one all others.

    With S the covariance of the used ones, blocks integrated out, the latter is
    ``(S^-1 r)_i / (S^-1)_ii``, of variance ``1 / (S^-1)_ii``.

    Parameters
    ----------
    root : ndarray, shape (n, m)
        H L: what the blocks may do to the readings, in T.
    residual : ndarray, shape (n,)
        Readings less what the model foretells, in T.
    noise : Noise
    used : ndarray of bool, shape (n,)
    """
    some = noise.part(used)
    marginal = Marginal.of(some.whiten(root[used]))
    whitened = some.whiten(residual[used])
    whitening = some.whitening
    half = linalg.solve_triangular(marginal.factor[0], marginal.whitened.T, lower=True)
    seen = whitening.T @ half.T
    precision = np.asarray(whitening.power(2).sum(axis=0)).ravel() - np.einsum(
        "ij,ij->i", seen, seen)
    difference, sd = np.empty(len(residual)), np.empty(len(residual))
    difference[used] = whitening.T @ marginal.remove(whitened[:, None])[:, 0] / precision
    sd[used] = 1 / np.sqrt(precision)
    blocks = linalg.cho_solve(marginal.factor, marginal.whitened.T @ whitened)
    spread = linalg.solve_triangular(marginal.factor[0], root[~used].T, lower=True)
    difference[~used] = residual[~used] - root[~used] @ blocks
    sd[~used] = np.hypot(noise.sd[~used], np.linalg.norm(spread, axis=0))
    return Foretold(difference, sd)


def find_outliers(
    root: Floats, residual: Floats, noise: NoiseCovariance, training: NDArray[np.bool_],
    labels: Sequence[str], positions: Floats, largest: float,
) -> NDArray[np.bool_]:
    """Tell which readings are off.

    Parameters
    ----------
    root, residual, noise
        See `foretold`.
    training : ndarray of bool, shape (n,)
        Readings that foretell others.
    labels : sequence of str
        Component of each.
    positions : ndarray, shape (n, 3), in m
    largest : float
        Largest reading in T.
    """
    neighbourhoods = [_Neighbourhood.of(rows, positions[rows]) for label in dict.fromkeys(labels)
                      if len(rows := np.flatnonzero(np.array(labels) == label)) > NEIGHBOURS / 2]
    off = np.zeros(len(residual), bool)
    for _ in range(PASSES):
        now = foretold(root, residual, noise, training & ~off)
        before = off
        off = np.zeros(len(residual), bool)
        for one in neighbourhoods:
            off[one.rows] = one.odd_ones(now, before[one.rows], largest)
        if (off == before).all() or off.mean() > MOST:
            break
    off &= ~_crowded(off, neighbourhoods)
    return off if off.mean() <= MOST else np.zeros(len(residual), bool)


def _crowded(off: NDArray[np.bool_], neighbourhoods: Sequence[_Neighbourhood]) -> NDArray[np.bool_]:
    """Tell which readings are off together with their neighbours, more often than chance has it:
    something is there.
    """
    beside = np.zeros(len(off), int)
    for one in neighbourhoods:
        beside[one.rows] = off[one.rows[one.nearest[:, :CLOSE]]].sum(axis=1)
    pairs = beside[off].sum()
    expected = CLOSE * off.sum() * off.mean()
    crowded = off & (beside > 0)
    return crowded if stats.poisson.sf(pairs - 1, expected) < CHANCE else np.zeros_like(off)


@dataclass(frozen=True)
class _Neighbourhood:
    """Readings of one component, for each its neighbours, and polynomials at these.

    Attributes
    ----------
    rows : ndarray, shape (k,)
    nearest : ndarray, shape (k, neighbours)
        Numbers within the k.
    terms : ndarray, shape (k, neighbours, 10)
        Of polynomials in the distance from the reading, at which all but the first are 0.
    """

    rows: Ints
    nearest: Ints
    terms: Floats

    @classmethod
    def of(cls, rows: Ints, positions: Floats) -> _Neighbourhood:
        """From positions (k, 3) in m."""
        count = min(NEIGHBOURS, len(rows) - 1)
        _, nearest = KDTree(positions).query(positions, count + 1)
        own = nearest == np.arange(len(rows))[:, None]
        own[~own.any(axis=1), -1] = True  # of points that are there more often than that
        nearest = nearest[~own].reshape(len(rows), count)
        away = positions[nearest] - positions[:, None]
        away /= np.maximum(np.abs(away).max(axis=(1, 2)), 1e-12)[:, None, None]
        first, second = np.triu_indices(3)
        return cls(rows, nearest, np.concatenate([
            np.ones((*nearest.shape, 1)), away, away[:, :, first] * away[:, :, second]], axis=2))

    def odd_ones(
        self, now: Foretold, off: NDArray[np.bool_], largest: float
    ) -> NDArray[np.bool_]:
        """Tell which readings (k,) are off: suspects, and of these the ones that are far even from
        what all other readings foretell with equal weights.
        """
        difference, sd = now.difference[self.rows], now.sd[self.rows]

        def odd(off: NDArray[np.bool_], fits: int) -> NDArray[np.bool_]:
            deviation, own, local = self._deviations(difference, off, fits)
            standard = deviation / (own * sd)
            odds = (standard**2 / 2 - np.log(2 * RANGE * largest / (np.sqrt(2 * np.pi) * sd))
                    + np.log(ODDS))
            return (odds > FOUND) & (deviation > LOCAL * local)

        suspects = off | odd(off, ROBUST)
        while True:
            left = suspects & odd(suspects, 1)
            if (left == suspects).all():
                return left
            suspects = left

    def _deviations(
        self, difference: Floats, off: NDArray[np.bool_], fits: int
    ) -> tuple[Floats, Floats, Floats]:
        """Deviation of readings (k,) from what the neighbours that are not off foretell, its
        standard deviation if theirs is 1, and as these scatter.
        """
        good = ~off[self.nearest]
        terms, values = self.terms * good[:, :, None], difference[self.nearest] * good
        root = good.astype(float)
        for _ in range(fits):
            inverse = np.linalg.pinv(terms * root[:, :, None], rcond=1e-6) * root[:, None]
            rest = values - np.einsum("kij,kjl,kl->ki", terms, inverse, values, optimize=True)
            typical = np.nanmedian(np.where(good, np.abs(rest), np.nan), axis=1)[:, None]
            root = good / np.hypot(1, rest / np.maximum(CAUCHY * MAD * typical, 1e-300))
        weights = inverse[:, 0]
        rank = np.einsum("kij,kji->k", terms, inverse)
        free = np.maximum(good.sum(axis=1) - rank, 1)
        scale = MAD * typical[:, 0] * np.sqrt(good.sum(axis=1) / free)
        own = np.sqrt(1 + np.sum(weights**2, axis=1))
        return (np.abs(difference - np.sum(weights * values, axis=1)), own, own * scale)
