"""Positions that shake: noise in proportion to the gradient, of unknown size.

It is no mean shift, so no signature shows it; the noise with it explains the readings better than
that without, or worse. Whatever else may be missing is integrated out: the blocks, all effects of
the catalogue, smooth fields and smooth errors of the sensors of any kind. Noise that is larger
everywhere must be the worse explanation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse as sparse
from scipy import special
from scipy.optimize import minimize_scalar

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.diagnosis.model_selection import EFFECT_ODDS, FOUND
from halbach_fe.diagnosis.smooth_discrepancy import DECAYS, harmonic_fields, sensor_errors
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.instrument import probe_points
from halbach_fe.measurement.reading_noise import displacement
from halbach_fe.stats.noise import NoiseCovariance
from halbach_fe.study.measurement import NoiseSettings
from halbach_fe.study.model import Study

AMPLITUDES_M = np.geomspace(2e-5, 5e-4, 8)
"""Standard deviations of a position that are tried, equally likely."""

LARGEST = 30.0
"""Factor of the noise, where it is larger everywhere."""

SMOOTH = 30.0
"""Size of smooth terms, over the noise of a reading: they may explain anything smooth."""

ROOM = 3.0
"""What amplitudes of effects may be, over their usual size: they may explain what they can."""

MOST_READINGS = 3000
"""That are compared; of more, some at random."""

NEGLIGIBLE = 1e-2
"""Sum over all readings, in variances of the noise of one, that no explanation needs."""

SUSPICIOUS = 2.0
"""Standard deviations of chi2 below which there is nothing to explain, and nothing is computed."""

SAME = 0.1
"""Ratio of amplitudes, less one, that counts as none."""


@dataclass(frozen=True)
class PositionNoise:
    """How well uncertain positions explain a residual.

    Attributes
    ----------
    log_bayes_factor : float
        Averaged over the amplitude; over noise without, or larger everywhere by the best factor,
        whichever is better.
    sd_m : float
        The likeliest standard deviation of a position, along each axis.
    """

    log_bayes_factor: float
    sd_m: float


def estimate_position_noise(
    update: InferenceResult, marginal: Marginal, columns: Floats, residual: Floats,
    present: PositionNoise | None,
) -> PositionNoise | None:
    """Judge the training readings of a study that has some vibration already, or none.

    Parameters
    ----------
    marginal : Marginal
        Of the blocks.
    columns : ndarray, shape (n, k)
        Signatures of effects, whitened, per standard deviation of their amplitudes.
    residual : ndarray, shape (n,)
        Readings less what the model foretells, whitened.
    """
    count = len(residual)
    if present is None and update.prior_conflict < 1 + SUSPICIOUS * np.sqrt(2 / count):
        return None
    noise, observation = update.errors.part(~update.held_out), update.observation
    training = np.flatnonzero(~update.held_out)
    rows = np.arange(count)
    if count > MOST_READINGS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MOST_READINGS, replace=False))
    moved = noise.whitening @ displacement(update.magnet, observation, np.ones(3))[training]
    scale, smooth = SMOOTH * float(np.median(noise.sd)), []
    points = probe_points(update.study.instrument, observation.map_points)
    for terms in (harmonic_fields(points, 5, 8), sensor_errors(points, 2, 6)):
        readings = scale * observation.read(terms.fields)[:, training].T
        smooth.append(noise.whiten(readings * np.exp(-terms.fineness @ DECAYS[0])))
    anything = np.hstack([marginal.whitened, ROOM * columns, *smooth])
    found = judge_vibration(anything[rows], residual[rows], sparse.csr_array(moved[rows]),
                            present.sd_m if present else 0.0)
    return found if found.log_bayes_factor + np.log(EFFECT_ODDS) > FOUND else None


def has_settled(old: PositionNoise | None, new: PositionNoise | None) -> bool:
    """Tell whether nothing changed."""
    if old is None or new is None:
        return old is new
    return abs(new.sd_m / old.sd_m - 1) < SAME


def with_position_noise(study: Study, vibration: PositionNoise | None) -> Study:
    """The study with more noise."""
    if vibration is None:
        return study
    settings = study.noise or NoiseSettings(position_sd_m=(vibration.sd_m,))
    old = settings.position_sd_m if study.noise else None
    more = tuple(float(np.hypot(one, vibration.sd_m)) for one in old or (0.0,))
    return study.with_(noise=settings.with_(position_sd_m=more))


def judge_vibration(
    root: Floats, residual: Floats, displacement: sparse.csr_array, present: float = 0.0,
) -> PositionNoise:
    """Compare noise with and without vibration; everything is whitened.

    Parameters
    ----------
    root : ndarray, shape (n, m)
        What the blocks, and anything else, may do to the readings.
    residual : ndarray, shape (n,)
        Readings less what the model foretells.
    displacement : sparse array, shape (n, k)
        Change of the readings per m as each point moves along each axis.
    present : float
        Standard deviation in m of the vibration with which all was whitened.
    """
    moved = sparse.csr_array(displacement @ displacement.T)
    root = _compressed(root)

    def log_evidence(sd: float, factor: float = 1.0) -> float:
        total = NoiseCovariance(sparse.csr_array(factor**2 * (
            sparse.eye_array(len(residual)) + (sd**2 - present**2) * moved)))
        marginal = Marginal.of(total.whiten(root))
        white = total.whiten(residual)
        chi2 = float(white @ marginal.remove(white[:, None])[:, 0])
        return -chi2 / 2 - total.log_size - float(np.log(np.diag(marginal.factor[0])).sum())

    def best(of: Callable[[float], float], low: float, high: float) -> float:
        """Where a log evidence is largest, of positive numbers."""
        found = minimize_scalar(lambda one: -of(float(np.exp(one))), method="bounded",
                                bounds=(np.log(low), np.log(high)), options={"xatol": 1e-2})
        return float(np.exp(found.x))

    found = np.array([log_evidence(sd) for sd in AMPLITUDES_M])
    mean = float(special.logsumexp(found) - np.log(len(found)))
    factor = mean - log_evidence(0.0)
    if factor > FOUND:
        larger = best(partial(log_evidence, 0.0), 1.0, LARGEST)
        factor = min(factor, mean - log_evidence(0.0, larger))
    if factor < FOUND:
        return PositionNoise(factor, 0.0)
    top = int(np.argmax(found))
    near = AMPLITUDES_M[[max(top - 1, 0), min(top + 1, len(found) - 1)]]
    return PositionNoise(factor, best(log_evidence, *near.tolist()))


def _compressed(root: Floats) -> Floats:
    """A root (n, k) of fewer columns, of the same covariance but for what is far below the noise:
    many things do nearly the same to the readings.
    """
    values, vectors = np.linalg.eigh(root.T @ root)
    return np.asarray(root @ vectors[:, values > NEGLIGIBLE])
