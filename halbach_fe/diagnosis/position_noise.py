"""Estimate random errors of the probe's positions, which are noise in proportion to the gradient.

Such errors shift no mean, so that no signature shows them. They are detected by comparing the
evidence of the readings with and without this noise. Everything else that may be missing from the
model is integrated out: the blocks, all effects of the catalogue, smooth fields, and smooth errors
of the sensors. The noise must also explain the readings better than noise that is larger by one
factor everywhere.
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
from halbach_fe.diagnosis.model_selection import DETECTION_LOG_ODDS, EFFECT_PRIOR_ODDS
from halbach_fe.diagnosis.smooth_discrepancy import DECAY_RATES, harmonic_fields, sensor_errors
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.instrument import probe_points
from halbach_fe.measurement.reading_noise import readings_per_displacement
from halbach_fe.stats.noise import NoiseCovariance
from halbach_fe.study.measurement import NoiseSettings
from halbach_fe.study.model import Study

CANDIDATE_SDS_M = np.geomspace(2e-5, 5e-4, 8)
"""Standard deviations of a position whose evidence is averaged, with equal prior probability."""

MAX_NOISE_FACTOR = 30.0
"""Largest factor of the noise in the alternative of noise that is larger everywhere."""

SMOOTH_SCALE = 30.0
"""Prior standard deviation of the smooth terms in units of the noise of a reading. It is large, so
that the smooth terms can explain any smooth discrepancy."""

EFFECT_SCALE = 3.0
"""Factor by which the prior standard deviations of effects are widened, so that effects can explain
as much as they are able to."""

MAX_READINGS = 3000
"""Largest number of readings that are compared. Of more readings, a random subset is taken."""

NEGLIGIBLE_VARIANCE = 1e-2
"""Variance below which a principal component of the nuisance terms is dropped: its sum over all
readings, in units of the noise variance of one reading."""

MIN_CHI2_EXCESS = 2.0
"""Excess of chi-squared, in its standard deviations, below which no noise is missing and nothing is
computed."""

CONVERGENCE_TOLERANCE = 0.1
"""Largest relative change between rounds that counts as converged."""


@dataclass(frozen=True)
class PositionNoise:
    """The evidence and the size of random errors of the positions.

    Attributes
    ----------
    log_bayes_factor : float
        Log Bayes factor, averaged over the candidate sizes, over the better of two alternatives: no
        such errors, or noise that is larger everywhere by the best factor.
    sd_m : float
        The likeliest standard deviation of a position along each axis.
    """

    log_bayes_factor: float
    sd_m: float


def estimate_position_noise(
    update: InferenceResult, marginal: Marginal, columns: Floats, residual: Floats,
    current: PositionNoise | None,
) -> PositionNoise | None:
    """Estimate the position noise from the training readings; None if there is no evidence of it.

    Parameters
    ----------
    update : InferenceResult
    marginal : Marginal
        The training readings with the blocks integrated out.
    columns : ndarray, shape (n, k)
        Whitened signatures of effects, per standard deviation of their amplitudes.
    residual : ndarray, shape (n,)
        Whitened training readings less their prior prediction.
    current : PositionNoise or None
        The position noise that the study of ``update`` already has.
    """
    count = len(residual)
    if current is None and update.prior_conflict < 1 + MIN_CHI2_EXCESS * np.sqrt(2 / count):
        return None
    noise, observation = update.errors.subset(~update.held_out), update.observation
    training = np.flatnonzero(~update.held_out)
    rows = np.arange(count)
    if count > MAX_READINGS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_READINGS, replace=False))
    per_metre = readings_per_displacement(update.magnet, observation, np.ones(3))
    moved = noise.whitening @ per_metre[training]
    scale, smooth = SMOOTH_SCALE * float(np.median(noise.sd)), []
    points = probe_points(update.study.instrument, observation.map_points)
    for terms in (harmonic_fields(points, 5, 8), sensor_errors(points, 2, 6)):
        readings = scale * observation.read(terms.fields)[:, training].T
        smooth.append(noise.whiten(readings * np.exp(-terms.fineness @ DECAY_RATES[0])))
    nuisance = np.hstack([marginal.whitened, EFFECT_SCALE * columns, *smooth])
    found = compare_noise_models(nuisance[rows], residual[rows], sparse.csr_array(moved[rows]),
                                 current.sd_m if current else 0.0)
    log_odds = found.log_bayes_factor + np.log(EFFECT_PRIOR_ODDS)
    return found if log_odds > DETECTION_LOG_ODDS else None


def has_settled(old: PositionNoise | None, new: PositionNoise | None) -> bool:
    """Tell whether the estimate has converged between two rounds."""
    if old is None or new is None:
        return old is new
    return abs(new.sd_m / old.sd_m - 1) < CONVERGENCE_TOLERANCE


def with_position_noise(study: Study, position_noise: PositionNoise | None) -> Study:
    """Return the study with position noise added to its noise."""
    if position_noise is None:
        return study
    settings = study.noise or NoiseSettings(position_sd_m=(position_noise.sd_m,))
    old = settings.position_sd_m if study.noise else None
    more = tuple(float(np.hypot(sd, position_noise.sd_m)) for sd in old or (0.0,))
    return study.with_(noise=settings.with_(position_sd_m=more))


def compare_noise_models(
    root: Floats, residual: Floats, per_displacement: sparse.csr_array, current_sd_m: float = 0.0,
) -> PositionNoise:
    """Compare the evidence of whitened readings with and without position noise.

    Parameters
    ----------
    root : ndarray, shape (n, m)
        Whitened covariance factor of blocks, effects and smooth terms.
    residual : ndarray, shape (n,)
        Whitened readings less their prior prediction.
    per_displacement : sparse array, shape (n, k)
        Whitened change of the readings per m as each point moves along each axis.
    current_sd_m : float
        Standard deviation of the position noise that the whitening already includes.
    """
    moved = sparse.csr_array(per_displacement @ per_displacement.T)
    root = _compressed(root)

    def log_evidence(sd: float, factor: float = 1.0) -> float:
        total = NoiseCovariance(sparse.csr_array(factor**2 * (
            sparse.eye_array(len(residual)) + (sd**2 - current_sd_m**2) * moved)))
        marginal = Marginal.of(total.whiten(root))
        white = total.whiten(residual)
        chi2 = float(white @ marginal.remove(white[:, None])[:, 0])
        return (-chi2 / 2 - total.log_sqrt_determinant
                - float(np.log(np.diag(marginal.factor[0])).sum()))

    def best(of: Callable[[float], float], low: float, high: float) -> float:
        """Return the positive number at which a log evidence is largest."""
        maximum = minimize_scalar(lambda logarithm: -of(float(np.exp(logarithm))),
                                  method="bounded", bounds=(np.log(low), np.log(high)),
                                  options={"xatol": 1e-2})
        return float(np.exp(maximum.x))

    log_evidences = np.array([log_evidence(sd) for sd in CANDIDATE_SDS_M])
    mean = float(special.logsumexp(log_evidences) - np.log(len(log_evidences)))
    factor = mean - log_evidence(0.0)
    if factor > DETECTION_LOG_ODDS:
        larger = best(partial(log_evidence, 0.0), 1.0, MAX_NOISE_FACTOR)
        factor = min(factor, mean - log_evidence(0.0, larger))
    if factor < DETECTION_LOG_ODDS:
        return PositionNoise(factor, 0.0)
    top = int(np.argmax(log_evidences))
    near = CANDIDATE_SDS_M[[max(top - 1, 0), min(top + 1, len(log_evidences) - 1)]]
    return PositionNoise(factor, best(log_evidence, *near.tolist()))


def _compressed(root: Floats) -> Floats:
    """Return a covariance factor (n, k) with fewer columns.

    Its covariance is the same except for components far below the noise. Many columns are nearly
    linearly dependent.
    """
    values, vectors = np.linalg.eigh(root.T @ root)
    return np.asarray(root @ vectors[:, values > NEGLIGIBLE_VARIANCE])
