"""A measurement plan: the positions that tell most about a study's magnetizations, compared with
the positions of the study.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.reading_noise import reading_noise
from halbach_fe.response.matrix import response_matrix
from halbach_fe.solver.field import check_points
from halbach_fe.solver.session import Session
from halbach_fe.stats.d_optimal import greedy, information
from halbach_fe.stats.gaussian import Gaussian, nominal_prior
from halbach_fe.stats.linear_gaussian import posterior
from halbach_fe.stats.noise import NoiseCovariance

CURVE_POINTS = 100
"""Numbers of points for which the study's own positions are judged."""


@dataclass(frozen=True)
class MeasurementPlan:
    """Positions chosen one after another, and what they and the study's own tell.

    Attributes
    ----------
    parameters : tuple of str
    candidates, points, baseline : ndarray, shape (n, 3), in m
        What was chosen from, what was chosen, in order, and the study's positions.
    gain : ndarray
        Expected information in nats after every chosen position.
    baseline_counts, baseline_gain : ndarray
        Numbers of the study's positions, spread evenly, and what they tell.
    nominal, prior_sd, planned_sd, baseline_sd : ndarray, shape (parameters,), in A/m
        Nominal magnetization; sd before, after the plan, and after as many of the study's
        positions.
    """

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

    @property
    def same_information(self) -> int | None:
        """How many chosen positions tell as much as all of the study's; None if all tell less."""
        enough = np.flatnonzero(self.gain >= self.baseline_gain[-1])
        return int(enough[0]) + 1 if len(enough) else None

    @property
    def volume_ratio(self) -> float:
        """Mean sd (geometric, over the posterior's axes) after the plan over that after as many of
        the study's positions.
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
        How many; default the study's ``plan.points``, else as many as the study
        measures.

    Raises
    ------
    StudyError
        If there are fewer candidates, or the study does not observe flux densities.
    """
    if magnet.study.observation.quantity != "flux_density":
        raise StudyError(
            f"Input `observation.quantity` of study {magnet.name} must be flux_density for a plan; "
            f"instead it is {magnet.study.observation.quantity}. Plan the points first.")
    baseline = points_from(magnet.study.observation.positions)
    sets = magnet.study.plan.candidates or (magnet.study.observation.positions,)
    places: list[Floats] = [points_from(one) for one in sets]
    candidates: Floats = np.unique(np.vstack(places).round(9), axis=0)
    wanted = count or magnet.study.plan.points or len(baseline)
    if wanted > len(candidates):
        raise StudyError(
            f"Input `plan.points` of study {magnet.name} must be at most the number of candidates, "
            f"{len(candidates)}; instead it is {wanted}. Add `plan.candidates`.")
    check_points(magnet, baseline)
    try:
        check_points(magnet, candidates)
    except StudyError as error:
        raise StudyError(str(error).replace("observation.positions", "plan.candidates")) from None
    points = np.vstack([baseline, candidates])
    observation = observe(magnet.study, points, np.ones_like(points, bool))
    noise = reading_noise(magnet, observation, xr.Dataset())
    model = response_matrix(magnet, observation, session)
    errors = noise.plus(model.error)
    prior = nominal_prior(model.nominal, magnet.dimension, magnet.study.prior.magnitude_sd,
                        magnet.study.prior.direction_sd_deg, magnet.study.prior.common_mode_sd)
    size = len(observation) // len(points)  # readings at a point, which alone may be correlated
    whitened = errors.whiten(model.whole @ prior.root).reshape(len(points), size, -1)
    chosen, gain = greedy(whitened[len(baseline):], wanted)
    same = min(wanted, len(baseline))
    counts = np.unique(np.append(np.linspace(1, len(baseline), CURVE_POINTS).astype(int), same))
    own = [information(whitened[spread(len(baseline), number)].reshape(-1, whitened.shape[2]))
           for number in counts]
    rows = np.arange(len(observation)).reshape(len(points), size)

    def sd_after(positions: Ints) -> Floats:
        index = rows[positions].ravel()
        return _posterior(model.matrix[index], errors.part(index), prior).sd

    return MeasurementPlan(
        model.parameters, candidates, candidates[chosen], baseline, gain, counts, np.array(own),
        model.nominal, prior.sd, sd_after(chosen + len(baseline)),
        sd_after(spread(len(baseline), same)))


def spread(total: int, count: int) -> Ints:
    """``count`` of ``total`` indices, evenly."""
    return np.floor(np.arange(count) * total / count).astype(int)


def _posterior(matrix: Floats, noise: NoiseCovariance, prior: Gaussian) -> Gaussian:
    """What remains to be known; it does not depend on the readings."""
    return posterior(matrix, matrix @ prior.mean, noise, prior)
