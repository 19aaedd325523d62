"""Find random errors of a map beyond its noise: single readings far off, and errors of positions.

Each reading has a leave-one-out residual: its difference from the prediction by all other readings,
with the blocks integrated out. The residual is compared with those of the neighbouring readings. A
discrepancy that an incomplete model causes is smooth, so that it varies little between neighbours,
or is rough in a whole region. A second-order polynomial that is fitted robustly to the residuals of
the neighbours predicts the residual, and the scatter of the neighbours about the polynomial is the
local scale.

Random errors of the probe's positions are noise in proportion to the gradient. They shift no mean,
so that no signature shows them. They are detected by comparing the evidence of the readings with
and without this noise. Everything else that may be missing from the model is integrated out: the
blocks, all effects of the catalogue, smooth fields, and smooth errors of the sensors. The noise
must also explain the readings better than noise that is larger by one factor everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.linalg as linalg
import scipy.sparse as sparse
from scipy import special
from scipy.optimize import minimize_scalar
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.numbers import MAD_TO_SD
from halbach_fe.diagnosis.effect_selection import DETECTION_LOG_ODDS, EFFECT_PRIOR_ODDS
from halbach_fe.diagnosis.flexible_causes import DECAY_RATES, harmonic_fields, sensor_errors
from halbach_fe.diagnosis.marginal_evidence import Marginal, with_fewer_columns
from halbach_fe.diagnosis.scanned_maps import Campaign, ScannedMap
from halbach_fe.inference.result import HELD_OUT_MAP, InferenceResult
from halbach_fe.measurement.observation_operator import TOTAL
from halbach_fe.measurement.reading_noise import readings_per_displacement
from halbach_fe.stats.gaussian import NoiseCovariance
from halbach_fe.study.inference_keys import ExcludedReading, Inference
from halbach_fe.study.measurement_keys import NoiseSettings
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

NEIGHBOURS = 24
"""Number of neighbours of the same component. A second-order polynomial has ten coefficients."""

CROWD_PROBABILITY = 1e-4
"""Probability of as many neighbouring outliers by chance, below which they are not outliers."""


@dataclass(frozen=True)
class Outlier:
    """A reading that is an outlier."""

    row: int
    """Row of the map, from 1."""
    component: str
    """x, y or z, or `TOTAL` of |B|."""
    at_m: tuple[float, ...]
    """Position of the reading according to the map."""
    off_T: float
    sd_T: float
    """Difference from the prediction by all readings that are no outliers, and its standard
    deviation."""
    map: str | None = None
    """Name of the map among those that the study lists; None if it lists none."""


def outliers_of(update: InferenceResult, campaign: Campaign) -> tuple[Outlier, ...]:
    """Find the outliers among the readings of all maps, each among its neighbours in its map.

    There are none among Fourier coefficients, each of which is computed from many readings.
    """
    observation = update.observation
    if not all(observation.components):
        return ()
    own = np.array(update.parts) != HELD_OUT_MAP
    root = with_fewer_columns(update.prediction_prior.root(np.flatnonzero(own)))
    residual = (update.readings - update.prediction_prior.mean)[own]
    noise, training = update.errors.subset(own), ~update.held_out[own]
    maps = np.array(update.maps)
    labels = [f"{name} {label}" for name, label in zip(
        maps[own].tolist(), np.array(observation.labels)[own].tolist(), strict=True)]
    flagged = find_outliers(root, residual, noise, training, labels, observation.positions[own],
                            float(np.abs(update.readings[own]).max()))
    if not flagged.any():
        return ()
    predicted = leave_one_out(root, residual, noise, training & ~flagged)
    point, component = observation.map_rows[own], np.array(observation.components)[own].tolist()
    names, listed = maps[own], bool(update.study.maps)
    first = {one.name: one.rows.start for one in campaign.maps}
    return tuple(
        Outlier(int(point[k] - first[str(names[k])]) + 1, component[k],
                tuple(observation.positions[own][k].tolist()), float(predicted.difference[k]),
                float(predicted.sd[k]), str(names[k]) if listed else None)
        for k in np.flatnonzero(flagged))


def excluding(study: Study, outliers: Sequence[Outlier]) -> Study:
    """Return the study with outliers excluded."""
    if not study.maps:
        return study.with_(inference=_excluding(study.inference, outliers))
    return study.with_tables({
        one.name: {"inference": _excluding(study.of_map(number).inference, own)}
        for number, one in enumerate(study.maps)
        if (own := [outlier for outlier in outliers if outlier.map == one.name])})


def _excluding(inference: Inference, outliers: Sequence[Outlier]) -> Inference:
    """Return the settings of a map with outliers excluded."""
    rows: dict[int, list[str]] = {}
    for outlier in outliers:
        rows.setdefault(outlier.row, []).append(outlier.component)
    return inference.with_(excluded_readings=(
        *inference.excluded_readings,
        *(ExcludedReading(row=row, components=tuple(
            name for name in COMPONENTS if name in names or TOTAL in names))
          for row, names in rows.items())))


@dataclass(frozen=True)
class LeaveOneOut:
    """Differences of readings from their prediction by other readings."""

    difference: Floats
    sd: Floats
    """The differences and their standard deviations. Shape (n,), in T."""


def leave_one_out(
    root: Floats, residual: Floats, noise: NoiseCovariance, used: Bools
) -> LeaveOneOut:
    """Predict every reading from the used readings; a used reading from all other used ones.

    With S the covariance of the used readings, blocks integrated out, the difference of a used
    reading from its prediction is ``(S^-1 r)_i / (S^-1)_ii``, with variance ``1 / (S^-1)_ii``.

    Parameters
    ----------
    root : ndarray, shape (n, m), in T
        H L, the covariance factor of the readings that the blocks cause.
    residual : ndarray, shape (n,), in T
        Readings less the prior prediction of the model.
    used : ndarray of bool, shape (n,)
        Readings from which the prediction is made.
    """
    noise_of_used = noise.subset(used)
    marginal = Marginal.of(noise_of_used.whiten(root[used]))
    whitened = noise_of_used.whiten(residual[used])
    whitening = noise_of_used.whitening
    half = linalg.solve_triangular(marginal.factor[0], marginal.whitened.T, lower=True)
    absorbed = whitening.T @ half.T
    precision = np.asarray(whitening.power(2).sum(axis=0)).ravel() - np.einsum(
        "ij,ij->i", absorbed, absorbed)
    difference, sd = np.empty(len(residual)), np.empty(len(residual))
    difference[used] = whitening.T @ marginal.remove(whitened[:, None])[:, 0] / precision
    sd[used] = 1 / np.sqrt(precision)
    blocks = linalg.cho_solve(marginal.factor, marginal.whitened.T @ whitened)
    spread = linalg.solve_triangular(marginal.factor[0], root[~used].T, lower=True)
    difference[~used] = residual[~used] - root[~used] @ blocks
    sd[~used] = np.hypot(noise.sd[~used], np.linalg.norm(spread, axis=0))
    return LeaveOneOut(difference, sd)


def find_outliers(
    root: Floats, residual: Floats, noise: NoiseCovariance, training: Bools,
    labels: Sequence[str], positions: Floats, largest: float,
) -> Bools:
    """Tell which readings are outliers.

    Parameters
    ----------
    root, residual, noise
        See `leave_one_out`.
    training : ndarray of bool, shape (n,)
        Readings from which others are predicted.
    labels : sequence of str
        Component of each reading.
    positions : ndarray, shape (n, 3), in m
    largest : float
        Magnitude of the largest reading in T.
    """
    # Largest fraction of the readings that may be outliers. If more are found, none is reported.
    max_outlier_fraction = 0.1
    # Largest number of passes. Several passes are needed because large outliers distort the
    # prediction of other readings, and so hide small outliers.
    max_passes = 6
    groups = [_Neighbourhood.of(rows, positions[rows]) for label in dict.fromkeys(labels)
                      if len(rows := np.flatnonzero(np.array(labels) == label)) > NEIGHBOURS / 2]
    flagged = np.zeros(len(residual), bool)
    for _ in range(max_passes):
        predicted = leave_one_out(root, residual, noise, training & ~flagged)
        before = flagged
        flagged = np.zeros(len(residual), bool)
        for group in groups:
            flagged[group.rows] = group.outlying(predicted, before[group.rows], largest)
        if (flagged == before).all() or flagged.mean() > max_outlier_fraction:
            break
    flagged &= ~_crowded(flagged, groups)
    return flagged if flagged.mean() <= max_outlier_fraction else np.zeros(len(residual), bool)


def _crowded(
    flagged: Bools, neighbourhoods: Sequence[_Neighbourhood]
) -> Bools:
    """Tell which flagged readings have more flagged neighbours than chance explains.

    Such readings are no outliers: a local source, for example, affects neighbours alike.
    """
    # Number of nearest neighbours that are examined for further outliers, see `_crowded`.
    crowd_neighbours = 4
    flagged_neighbours = np.zeros(len(flagged), int)
    for group in neighbourhoods:
        nearest = group.rows[group.nearest[:, :crowd_neighbours]]
        flagged_neighbours[group.rows] = flagged[nearest].sum(axis=1)
    pairs = flagged_neighbours[flagged].sum()
    expected = crowd_neighbours * flagged.sum() * flagged.mean()
    crowded = flagged & (flagged_neighbours > 0)
    probability = special.pdtrc(pairs - 1, expected)
    return crowded if probability < CROWD_PROBABILITY else np.zeros_like(flagged)


@dataclass(frozen=True)
class _Neighbourhood:
    """The readings of one component with their neighbours."""

    rows: Ints
    """Numbers of the readings. Shape (k,)."""
    nearest: Ints
    """Neighbours of each reading, as positions in ``rows``, the nearest first.
    Shape (k, neighbours)."""
    terms: Floats
    """Second-order monomials of the scaled distance from the reading to its neighbours. At the
    reading itself all but the first are 0. Shape (k, neighbours, 10)."""

    @classmethod
    def of(cls, rows: Ints, positions: Floats) -> _Neighbourhood:
        """Build it from positions (k, 3) in m."""
        count = min(NEIGHBOURS, len(rows) - 1)
        _, nearest = KDTree(positions).query(positions, count + 1)
        own = nearest == np.arange(len(rows))[:, None]
        own[~own.any(axis=1), -1] = True  # a point with more than `count` coincident ones
        nearest = nearest[~own].reshape(len(rows), count)
        away = positions[nearest] - positions[:, None]
        away /= np.maximum(np.abs(away).max(axis=(1, 2)), 1e-12)[:, None, None]
        first, second = np.triu_indices(3)
        return cls(rows, nearest, np.concatenate([
            np.ones((*nearest.shape, 1)), away, away[:, :, first] * away[:, :, second]], axis=2))

    def outlying(
        self, predicted: LeaveOneOut, flagged: Bools, largest: float
    ) -> Bools:
        """Tell which readings (k,) are outliers.

        Suspects deviate from a robust fit to their neighbours. Outliers are those suspects that
        deviate also from an ordinary fit to the neighbours that are no suspects.
        """
        # Number of reweighted fits of a polynomial. Neighbours far from the previous fit have less
        # weight, because several of them may be outliers.
        robust_fits = 6
        # Log posterior odds above which a reading is an outlier: deviations of about six standard
        # deviations.
        outlier_log_odds = 5.0
        # Largest error of an outlier relative to the map's largest reading. All errors up to it, of
        # either sign, are equally likely.
        outlier_range = 0.1
        outlier_prior_odds = 1e-3  # prior odds that a reading is an outlier
        # Smallest deviation of an outlier, in units of the local scale. The scale is the median of
        # about 24 numbers: of noise of unknown level, one reading in 10^5 deviates further.
        local_scale_factor = 9.0
        difference, sd = predicted.difference[self.rows], predicted.sd[self.rows]

        def is_outlying(flagged: Bools, fits: int) -> Bools:
            deviation, own, local = self._deviations(difference, flagged, fits)
            standard = deviation / (own * sd)
            volume = 2 * outlier_range * largest / (np.sqrt(2 * np.pi) * sd)
            odds = standard**2 / 2 - np.log(volume) + np.log(outlier_prior_odds)
            return (odds > outlier_log_odds) & (deviation > local_scale_factor * local)

        suspects = flagged | is_outlying(flagged, robust_fits)
        while True:
            left = suspects & is_outlying(suspects, 1)
            if (left == suspects).all():
                return left
            suspects = left

    def _deviations(
        self, difference: Floats, flagged: Bools, fits: int
    ) -> tuple[Floats, Floats, Floats]:
        """Return deviations of readings (k,) from the fit to their neighbours that are not flagged.

        Returns
        -------
        deviation : ndarray, shape (k,)
        own : ndarray, shape (k,)
            Standard deviation of the deviation if that of every reading is 1.
        local : ndarray, shape (k,)
            Standard deviation of the deviation according to the scatter of the neighbours.
        """
        # Distance in units of the local scale at which a neighbour has half its weight (P. W.
        # Holland and R. E. Welsch, Communications in Statistics A6 (1977) 813).
        cauchy_scale = 2.385
        good = ~flagged[self.nearest]
        terms, values = self.terms * good[:, :, None], difference[self.nearest] * good
        root = good.astype(float)
        for _ in range(fits):
            weighted = np.swapaxes(terms, 1, 2) * root[:, None]**2
            sizes, vectors = np.linalg.eigh(weighted @ terms)
            # neighbours in a plane or on a line determine some combinations only
            sizes = np.where(sizes > 1e-12 * sizes[:, -1:], sizes, np.inf)
            inverse = (vectors / sizes[:, None]) @ (np.swapaxes(vectors, 1, 2) @ weighted)
            rest = values - (terms @ (inverse @ values[..., None]))[..., 0]
            typical = np.nanmedian(np.where(good, np.abs(rest), np.nan), axis=1)[:, None]
            root = good / np.hypot(1, rest / np.maximum(cauchy_scale * MAD_TO_SD * typical, 1e-300))
        weights = inverse[:, 0]
        rank = np.einsum("kij,kji->k", terms, inverse)
        free = np.maximum(good.sum(axis=1) - rank, 1)
        scale = MAD_TO_SD * typical[:, 0] * np.sqrt(good.sum(axis=1) / free)
        own = np.sqrt(1 + np.sum(weights**2, axis=1))
        return (np.abs(difference - np.sum(weights * values, axis=1)), own, own * scale)


CANDIDATE_SDS_M = np.geomspace(2e-5, 5e-4, 8)
"""Standard deviations of a position whose evidence is averaged, with equal prior probability."""


@dataclass(frozen=True)
class PositionNoise:
    """The evidence and the size of random errors of the positions."""

    log_bayes_factor: float
    """Log Bayes factor, averaged over the candidate sizes, over the best of three alternatives: no
    such errors, or noise that is larger everywhere, or of the component with the largest residuals,
    by the best factor."""
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
    component = np.asarray(abs(analysis).argmax(axis=1)).ravel() % 3
    found = compare_noise_models(nuisance[rows], residual[rows], sparse.csr_array(moved[rows]),
                                 component[rows], current.sd_m if current else 0.0)
    log_odds = found.log_bayes_factor + np.log(EFFECT_PRIOR_ODDS)
    return found if log_odds > DETECTION_LOG_ODDS else None


def have_settled(
    old: Sequence[PositionNoise], new: Sequence[PositionNoise],
    earlier: Sequence[Sequence[PositionNoise]] = (),
) -> bool:
    """Tell whether the estimates have converged between two rounds.

    They may also take turns with ``earlier`` ones of the same model. The smallest of these is the
    last then, unless it is none at all: a larger one hides effects that the map shows.
    """
    if _are_close(old, new):
        return True
    before, after = (sum(noise.sd_m for noise in one) for one in (old, new))
    return any(_are_close(one, new) for one in earlier) and (
        0.0 < before <= after or not after)


def _are_close(old: Sequence[PositionNoise], new: Sequence[PositionNoise]) -> bool:
    """Tell whether two estimates are of the same maps and about equal."""
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
    root: Floats, residual: Floats, per_displacement: sparse.csr_array, component: Ints,
    current_sd_m: float,
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
    component : ndarray of int, shape (n,)
        The component of B that each reading is of.
    current_sd_m : float
        Standard deviation of the position noise that the whitening already includes.
    """
    # Largest factor of the noise in the alternatives of noise that is larger.
    max_noise_factor = 30.0
    moved = sparse.csr_array(per_displacement @ per_displacement.T)
    root, everywhere = _compressed(root), np.ones(len(residual), bool)

    def log_evidence(sd: float, factor: float = 1.0, of: Bools = everywhere) -> float:
        scale = sparse.diags_array(np.where(of, factor, 1.0))
        total = NoiseCovariance(sparse.csr_array(scale @ (
            sparse.eye_array(len(residual)) + (sd**2 - current_sd_m**2) * moved) @ scale))
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
        left = Marginal.of(root).remove(residual[:, None])[:, 0]**2
        worst = max(set(component.tolist()), key=lambda one: float(left[component == one].mean()))
        for some in (everywhere, component == worst):
            larger = best(partial(log_evidence, 0.0, of=some), 1.0, max_noise_factor)
            factor = min(factor, mean - log_evidence(0.0, larger, some))
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
