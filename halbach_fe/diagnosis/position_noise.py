"""Estimate random errors of the probe's positions, which are noise in proportion to the gradient.

Such errors shift no mean, so that no signature shows them. They are detected by comparing the
evidence of the readings with and without this noise. Everything else that may be missing from the
model is integrated out: the blocks, all effects of the catalogue, smooth fields, and smooth errors
of the sensors. The noise must also explain the readings better than noise that is larger by one
factor everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.sparse as sparse
from scipy import linalg, special
from scipy.optimize import minimize_scalar

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.diagnosis.flexible_causes import DECAY_RATES, harmonic_fields, sensor_errors
from halbach_fe.diagnosis.marginal_evidence import Marginal
from halbach_fe.diagnosis.model_selection import DETECTION_LOG_ODDS, EFFECT_PRIOR_ODDS
from halbach_fe.diagnosis.scene import Campaign, ScannedMap
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.reading_noise import readings_per_displacement
from halbach_fe.stats.gaussian import NoiseCovariance
from halbach_fe.study.measurement import NoiseSettings
from halbach_fe.study.model import Study

CANDIDATE_SDS_M = np.geomspace(2e-5, 5e-4, 8)
"""Standard deviations of a position whose evidence is averaged, with equal prior probability."""


@dataclass(frozen=True)
class PositionNoise:
    """The evidence and the size of random errors of the positions."""

    log_bayes_factor: float
    """Log Bayes factor, averaged over the candidate sizes, over the better of two alternatives: no
    such errors, or noise that is larger everywhere by the best factor."""
    sd_m: float
    """The likeliest standard deviation of a position along each axis."""
    map: str | None = None
    """Name of the map among those that the study lists; None if it lists none."""
    over_none: float = 0.0
    """Log Bayes factor over no such errors, with noise of the stated size."""


def estimate_position_noise(
    update: InferenceResult, campaign: Campaign, marginal: Marginal, columns: Floats,
    residual: Floats, current: Sequence[PositionNoise], smooth: bool = True,
) -> tuple[PositionNoise, ...]:
    """Estimate the position noise of each map from its training readings.

    Parameters
    ----------
    marginal : Marginal
        The training readings with the blocks integrated out.
    columns : ndarray, shape (n, k)
        Whitened signatures of effects, per standard deviation of their amplitudes.
    residual : ndarray, shape (n,)
        Whitened training readings less their prior prediction.
    current : sequence of PositionNoise
        The position noise that the study of ``update`` already has.
    smooth : bool
        Whether smooth fields and errors of the sensors may explain part of the readings.

    Returns
    -------
    tuple of PositionNoise
        Of those maps that show it.
    """
    known = {noise.map: noise for noise in current}
    listed, points = bool(update.study.maps), campaign.points_of(update.study)
    of_map = np.array(update.maps)[~update.held_out]
    found = []
    for one in campaign.maps:
        own = np.flatnonzero(of_map == one.name)
        name = one.name if listed else None
        if len(own):
            noise = _of_map(update, one, points[one.rows], own,
                            marginal if len(own) == len(residual) else Marginal.of(
                                marginal.whitened[own]),
                            columns[own], residual[own], known.get(name), smooth)
            found += [] if noise is None else [replace(noise, map=name)]
    return tuple(found)


def _of_map(
    update: InferenceResult, scanned: ScannedMap, points: Floats, own: Ints, marginal: Marginal,
    columns: Floats, residual: Floats, current: PositionNoise | None, with_smooth: bool,
) -> PositionNoise | None:
    """Estimate the position noise of a map; None if there is no evidence of it.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
        The map's points in the magnet.
    own : ndarray of int, shape (rows,)
        Numbers of the map's readings among all training readings.
    marginal, columns, residual, current, with_smooth
        See `estimate_position_noise`, for these readings only.
    """
    # Excess of chi-squared, in its standard deviations, below which no noise is missing and nothing
    # is computed.
    min_chi2_excess = 2.0
    # Factor by which the prior standard deviations of effects are widened, so that effects can
    # explain as much as they are able to.
    effect_scale = 3.0
    # Prior standard deviation of the smooth terms in units of the noise of a reading. It is large,
    # so that the smooth terms can explain any smooth discrepancy.
    smooth_scale = 30.0
    count = len(residual)
    chi2 = float(residual @ marginal.remove(residual[:, None])[:, 0]) / count
    if current is None and chi2 < 1 + min_chi2_excess * np.sqrt(2 / count):
        return None
    training = np.flatnonzero(~update.held_out)[own]
    noise = update.errors.subset(training)
    analysis = sparse.csr_array(sparse.csc_array(update.observation.analysis[training])[
        :, 3 * scanned.rows.start:3 * scanned.rows.stop])
    rows = np.arange(count)
    # largest number of readings that are compared. Of more readings, a random subset is taken.
    most_readings = 3000
    if count > most_readings:
        rows = np.sort(np.random.default_rng(0).choice(rows, most_readings, replace=False))
    # the whitening contains the present noise of positions in the gradient of this magnet
    magnet = update.noise_magnet.with_study(scanned.study_of(update.study))
    moved = noise.whitening @ readings_per_displacement(magnet, analysis, points, np.ones(3))
    scale, smooth = smooth_scale * float(np.median(noise.sd)), []
    for terms in (harmonic_fields(points, 5, 8), sensor_errors(points, 2, 6)) if (
            with_smooth) else ():
        readings = scale * (analysis @ terms.fields.reshape(len(terms.fields), -1).T)
        smooth.append(noise.whiten(readings * np.exp(-terms.fineness @ DECAY_RATES[0])))
    nuisance = np.hstack([marginal.whitened, effect_scale * columns, *smooth])
    found = compare_noise_models(nuisance[rows], residual[rows], sparse.csr_array(moved[rows]),
                                 current.sd_m if current else 0.0)
    log_odds = found.log_bayes_factor + np.log(EFFECT_PRIOR_ODDS)
    return found if log_odds > DETECTION_LOG_ODDS else None


def have_settled(old: Sequence[PositionNoise], new: Sequence[PositionNoise]) -> bool:
    """Tell whether the estimates have converged between two rounds."""
    before = {noise.map: noise.sd_m for noise in old}
    # largest relative change between rounds that counts as converged
    tolerance = 0.1
    return before.keys() == {noise.map for noise in new} and all(
        abs(noise.sd_m / before[noise.map] - 1) < tolerance for noise in new)


def with_position_noise(study: Study, found: Sequence[PositionNoise]) -> Study:
    """Return the study with position noise added to the noise of its maps."""
    for one in found:
        if one.map is None:
            study = study.with_(noise=_added(study.noise, one.sd_m))
        else:
            number = [each.name for each in study.maps].index(one.map)
            study = study.with_tables({
                one.map: {"noise": _added(study.of_map(number).noise, one.sd_m)}})
    return study


def _added(noise: NoiseSettings | None, sd_m: float) -> NoiseSettings:
    """Return the noise of a map with more position noise."""
    settings = noise or NoiseSettings(position_sd_m=(sd_m,))
    old = settings.position_sd_m if noise else None
    return settings.with_(position_sd_m=tuple(float(np.hypot(sd, sd_m)) for sd in old or (0.0,)))


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
    # Largest factor of the noise in the alternative of noise that is larger everywhere.
    max_noise_factor = 30.0
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
    over_none = factor = mean - log_evidence(0.0)
    if factor > DETECTION_LOG_ODDS:
        larger = best(partial(log_evidence, 0.0), 1.0, max_noise_factor)
        factor = min(factor, mean - log_evidence(0.0, larger))
    if factor < DETECTION_LOG_ODDS:
        return PositionNoise(factor, 0.0)
    top = int(np.argmax(log_evidences))
    near = CANDIDATE_SDS_M[[max(top - 1, 0), min(top + 1, len(log_evidences) - 1)]]
    return PositionNoise(factor, best(log_evidence, *near.tolist()), over_none=over_none)


def _compressed(root: Floats) -> Floats:
    """Return a covariance factor (n, k) with fewer columns.

    Its covariance is the same except for components far below the noise. Many columns are nearly
    linearly dependent: a Cholesky factorization with pivots ends where no reading has more of the
    covariance left than is negligible. Eigenvectors of what it keeps are the fewest columns.
    """
    # Variance below which a principal component of the nuisance terms is dropped: its sum over all
    # readings, in units of the noise variance of one reading.
    negligible_variance = 1e-2
    covariance = root @ root.T
    factor, order, rank, _ = linalg.lapack.dpstrf(covariance, tol=negligible_variance / len(root),
                                                  lower=True, overwrite_a=True)
    kept = np.empty((len(root), rank))
    kept[order - 1] = np.tril(factor)[:, :rank]
    values, vectors = np.linalg.eigh(kept.T @ kept)
    return np.asarray(kept @ vectors[:, values > negligible_variance])
