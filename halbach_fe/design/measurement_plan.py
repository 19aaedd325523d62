"""Measurement plans: positions with the most information about what a study asks for.

That are the magnetizations (D-optimal design), or, if the study has a table ``homogeneity``, the
deviations of |B| in its region: the sum of their variances is made small (A-optimal design).
Positions are chosen one after another, and compared with the study's own positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.notebook import ShownInNotebook
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.reading_noise import reading_noise
from halbach_fe.response.block_variation import study_prior
from halbach_fe.response.deviations import Deviations, deviation_model
from halbach_fe.response.homogeneity import Region, default_region, homogeneity_model, region_points
from halbach_fe.response.matrix import response_matrix
from halbach_fe.solver.formulation_choice import check_points
from halbach_fe.solver.session import Session
from halbach_fe.stats.d_optimal import greedy, information, variance_left
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.linear_gaussian import posterior
from halbach_fe.stats.noise import NoiseCovariance


@dataclass(frozen=True)
class UnknownDeviation:
    """The rms uncertainty of the deviation of |B| in the study's region, in ppm.

    Attributes
    ----------
    region : Region
    prior : float
        Without any readings.
    planned : ndarray, shape (count,)
        After the first 1, 2, ... chosen positions.
    baseline : ndarray
        After the evenly spread subsets of the study's positions.
    """

    region: Region
    prior: float
    planned: Floats
    baseline: Floats


CURVE_POINTS = 100
"""Number of subsets, of increasing size, of the study's positions whose information is computed."""


@dataclass(frozen=True)
class MeasurementPlan(ShownInNotebook):
    """Positions of a measurement plan, and its information compared with the study's positions.

    Attributes
    ----------
    magnet : Magnet
    parameters : tuple of str
        Names of the components of the magnetizations.
    candidates : ndarray, shape (n, 3), in m
        Positions among which the plan chooses.
    points : ndarray, shape (count, 3), in m
        Chosen positions, in the order of choice.
    baseline : ndarray, shape (m, 3), in m
        Positions of the study.
    gain : ndarray, shape (count,)
        Expected information in nats of the first 1, 2, ... chosen positions.
    baseline_counts : ndarray of int
        Numbers of positions in evenly spread subsets of the study's positions.
    baseline_gain : ndarray
        Expected information in nats of these subsets.
    nominal : ndarray, shape (parameters,), in A/m
        Nominal magnetization.
    prior_sd, planned_sd, baseline_sd : ndarray, shape (parameters,), in A/m
        Standard deviation of the prior, of the posterior for the plan, and of the posterior for
        equally many evenly spread positions of the study (all of them if the plan has more).
    deviation : UnknownDeviation or None
        What is left unknown of the deviation of |B|, if the study asks for a homogeneous field.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> plan = hf.plan(magnet, hf.Session.open("results"), points=4)
    >>> plan.points.shape, bool(plan.gain[3] > plan.gain[0])
    ((4, 3), True)
    """

    magnet: Magnet
    parameters: tuple[str, ...]
    candidates: Floats
    points: Floats
    baseline: Floats
    gain: Floats
    baseline_counts: Ints
    baseline_gain: Floats
    nominal: Floats
    prior_sd: Floats
    planned_sd: Floats
    baseline_sd: Floats
    deviation: UnknownDeviation | None

    @property
    def same_information(self) -> int | None:
        """Smallest number of chosen positions that tell as much as all the study's positions.

        None if all chosen positions together tell less.
        """
        enough = np.flatnonzero(
            self.gain >= self.baseline_gain[-1] if self.deviation is None else
            self.deviation.planned <= self.deviation.baseline[-1])
        return int(enough[0]) + 1 if len(enough) else None

    @property
    def volume_ratio(self) -> float:
        """Ratio of the geometric mean sd for the plan to that for the study's positions.

        The mean is over the principal axes of the posterior; both have equally many positions.
        """
        count = min(len(self.gain), len(self.baseline))
        own = self.baseline_gain[np.searchsorted(self.baseline_counts, count)]
        difference = self.gain[count - 1] - own
        return float(np.exp(-difference / len(self.parameters)))


def plan_measurement(magnet: Magnet, session: Session, count: int | None = None) -> MeasurementPlan:
    """Choose positions for a study's next measurement.

    Parameters
    ----------
    count : int, optional
        Number of positions to choose. Default: the study's ``plan.points``, else the number of
        positions that the study measures.

    Raises
    ------
    StudyError
        If there are fewer candidates than positions to choose, a position is outside of the region
        where the field is computed, or the study does not observe flux densities.
    """
    if magnet.study.observation.quantity != "flux_density":
        raise StudyError(
            f"Input `observation.quantity` of study {magnet.name} must be flux_density for a plan; "
            f"instead it is {magnet.study.observation.quantity}. Plan with a study that observes "
            "flux densities.")
    baseline = points_from(magnet.study.observation.positions)
    sets = magnet.study.plan.candidates or (magnet.study.observation.positions,)
    places: list[Floats] = [points_from(positions) for positions in sets]
    candidates: Floats = np.unique(np.vstack(places).round(9), axis=0)
    wanted = count or magnet.study.plan.points or len(baseline)
    if wanted > len(candidates):
        raise StudyError(
            f"Input {'--points' if count else '`plan.points`'} of study {magnet.name} must be at "
            f"most the number of candidates, {len(candidates)}; instead it is {wanted}. Ask for "
            "fewer, or add `plan.candidates`.")
    farthest, reach = float(np.linalg.norm(candidates, axis=1).max()), magnet.field_reach
    if magnet.study.plan.candidates and farthest > reach:  # never in 2D, where it is infinite
        raise StudyError(must_be(
            "`plan.candidates`", f"study {magnet.name}", f"within {reach:.3g} m of the middle of "
            "the magnet, where there is some field", f"one at {farthest:.4g} m",
            "Are they in metres?"))
    check_points(magnet, baseline)
    check_points(magnet, candidates, "plan.candidates")
    if magnet.study.homogeneity is not None:
        region_points(magnet, default_region(magnet))  # refuses a region that reaches into material
    points = np.vstack([baseline, candidates])
    # the order in which they would be measured is not known yet
    steady = magnet.study.instrument.with_(lag_m=0.0)
    observation = observe(magnet.study.with_(instrument=steady), points,
                          np.ones_like(points, bool))
    noise = reading_noise(magnet, observation, xr.Dataset())
    model = response_matrix(magnet, observation, session)
    errors = noise.with_independent_errors(model.error)
    prior = study_prior(magnet, len(model.parameters) - len(magnet.parameter_names))
    size = len(observation) // len(points)  # readings per point; only these may be correlated
    whitened = errors.whiten(model.whole @ prior.root).reshape(len(points), size, -1)
    values = _values(magnet, prior, session.within("objective"))
    choice = greedy(whitened[len(baseline):], wanted, None if values is None else values.root)
    chosen = choice.chosen
    same = min(wanted, len(baseline))
    counts = np.unique(np.append(np.linspace(1, len(baseline), CURVE_POINTS).astype(int), same))
    subsets = [whitened[spread(len(baseline), number)].reshape(-1, whitened.shape[2])
               for number in counts]
    rows = np.arange(len(observation)).reshape(len(points), size)

    def sd_after(positions: Ints) -> Floats:
        index = rows[positions].ravel()
        return _posterior(model.matrix[index], errors.subset(index), prior).sd

    deviation = None
    if values is not None:
        before = float(np.sum(values.root**2))
        # rounding leaves less than nothing where everything is known
        deviation = UnknownDeviation(
            default_region(magnet), np.sqrt(before),
            np.sqrt(np.maximum(before - choice.fall, 0.0)),
            np.sqrt(np.maximum([variance_left(subset, values.root) for subset in subsets], 0.0)))
    return MeasurementPlan(
        magnet, model.parameters, candidates, candidates[chosen], baseline, choice.gain, counts,
        np.array([information(subset) for subset in subsets]), model.nominal, prior.sd,
        sd_after(chosen + len(baseline)), sd_after(spread(len(baseline), same)), deviation)


def _values(magnet: Magnet, prior: Gaussian, session: Session) -> Deviations | None:
    """Return the deviations of |B| that the prior allows, if the study asks for them."""
    if magnet.study.homogeneity is None:
        return None
    return deviation_model(homogeneity_model(magnet, default_region(magnet), session)).of(prior)


def spread(total: int, count: int) -> Ints:
    """Return ``count`` evenly spread indices out of ``total``."""
    return np.floor(np.arange(count) * total / count).astype(int)


def _posterior(matrix: Floats, noise: NoiseCovariance, prior: Gaussian) -> Gaussian:
    """Return the posterior for readings equal to their prior mean.

    Its covariance is that for any readings, because the model is linear.
    """
    return posterior(matrix, matrix @ prior.mean, noise, prior)
