"""Measurement plans: positions with the most information about what a study asks for.

That are the magnetizations (D-optimal design), or, if the study has a table ``homogeneity``, the
deviations of |B| in its region: the sum of their variances is made small (A-optimal design).
Positions are chosen one after another, and compared with the study's own positions.

The information gain of a linear-Gaussian measurement is the mutual information between parameters
and readings, ``1/2 log det(I + G G^T)`` nats, where G = Sigma^-1/2 H L is the whitened response of
the readings to the whitened parameters (D-optimality; K. Chaloner, I. Verdinelli, Statist. Sci. 10
(1995) 273). The gain does not depend on the values of the readings, so that it is known before the
measurement. The gain is submodular; a greedy choice, position by position, therefore reaches at
least 1 - 1/e of the largest possible gain (A. Krause et al., J. Mach. Learn. Res. 9 (2008) 235).

For values of interest, with the roots V of their covariance and C of that of the parameters given
the positions chosen so far, a position with the response G takes ``tr(V C G^T (I + G C G^T)^-1 G C
V^T)`` off the sum of their variances.

What else the study states as open is beside the parameters, as in an update: terms and amplitudes
of the instrument, blocks of neighbours, and the solver's error. Information about these does not
count: the gain is that about all together, less what the readings tell of them if the parameters
are known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from halbach_fe.core.arrays import Floats, Ints, box_middle
from halbach_fe.core.errors import StudyError
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.design.objective import Deviations, deviation_model
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.campaign_readings import Readings, read_campaign
from halbach_fe.inference.infer import seen_columns
from halbach_fe.inference.relinearization import open_columns
from halbach_fe.measurement.campaign_maps import ONLY_MAP, Map
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.probe_law import seen, sensor_matrix, sensor_positions
from halbach_fe.response.block_variation import neighbour_prior, study_prior, with_variations
from halbach_fe.response.homogeneity import homogeneity_model
from halbach_fe.response.region import Region, default_region, region_points
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver.routes import check_points, field_function
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.posteriors import posterior
from halbach_fe.study.inference_keys import Inference
from halbach_fe.study.measurement_keys import Instrument, InstrumentSd


@dataclass(frozen=True)
class UnknownDeviation:
    """The rms uncertainty of the deviation of |B| in the study's region, in ppm."""

    region: Region
    prior: float
    """Without any readings."""
    planned: Floats
    """After the first 1, 2, ... chosen positions. Shape (count,)."""
    baseline: Floats
    """After the evenly spread subsets of the study's positions."""


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

    ``count``: number of positions to choose. Default: the study's ``plan.points``, else the number
    of positions that the study measures.

    Raises
    ------
    StudyError
        If there are fewer candidates than positions to choose, a position is outside of the region
        where the field is computed, or the study does not observe flux densities.
    """
    baseline = points_from(magnet.study.observation.positions)
    candidates, wanted = _candidates(magnet, baseline, count)
    points = np.vstack([baseline, candidates])
    readings, one, field = _readings(magnet, points, session.within("instrument"))
    observation = readings.observation
    model = response_matrix(magnet, observation, session)
    beside = _beside(readings, one, field, model.shared_error)
    errors = readings.noise.with_independent_errors(model.error)
    prior = study_prior(magnet, len(model.parameters))
    everything = with_variations(prior.stacked, beside.shape[1])
    whole = np.hstack([model.whole, model.of_neighbours, beside])
    size = len(observation) // len(points)  # readings per point; only these may be correlated
    whitened = errors.whiten(whole @ everything.root).reshape(len(points), size, -1)
    others = errors.whiten(np.hstack([beside, seen_columns(
        model.of_neighbours @ neighbour_prior(magnet).root, readings)])).reshape(
            len(points), size, -1)
    values = _values(magnet, prior, session.within("objective"))
    root = np.zeros((0, whitened.shape[2])) if values is None else np.pad(
        values.root, ((0, 0), (0, beside.shape[1])))
    choice = greedy(whitened[len(baseline):], wanted, None if values is None else root,
                    others[len(baseline):])
    chosen = choice.chosen
    same = min(wanted, len(baseline))
    # number of subsets, of increasing size, of the study's positions whose information is computed
    curve_points = 100
    counts = np.unique(np.append(np.linspace(1, len(baseline), curve_points).astype(int), same))
    subsets, of_others = ([each[spread(len(baseline), number)].reshape(
        number * size, each.shape[2]) for number in counts] for each in (whitened, others))
    rows = np.arange(len(observation)).reshape(len(points), size)

    def sd_after(positions: Ints) -> Floats:
        index = rows[positions].ravel()
        # for readings as the prior expects: the model is linear, so that others change no sd
        matrix = whole[index]
        return posterior(matrix, matrix @ everything.mean, errors.subset(index), everything).sd[
            :len(model.parameters)]

    deviation = None
    if values is not None:
        before = float(np.sum(values.root**2))
        # rounding leaves less than nothing where everything is known
        deviation = UnknownDeviation(
            default_region(magnet), np.sqrt(before),
            np.sqrt(np.maximum(before - choice.fall, 0.0)),
            np.sqrt(np.maximum([variance_left(subset, root) for subset in subsets], 0.0)))
    return MeasurementPlan(
        magnet, model.parameters, candidates, candidates[chosen], baseline, choice.gain, counts,
        np.array([information(subset) - information(other) for subset, other in zip(
            subsets, of_others, strict=True)]), model.nominal, prior.sd,
        sd_after(chosen + len(baseline)), sd_after(spread(len(baseline), same)), deviation)


def _readings(
    magnet: Magnet, points: Floats, session: Session
) -> tuple[Readings, Map, Callable[[Floats], Floats]]:
    """Return the readings of a map of the nominal magnet at points (n, 3) in m, the map, and the
    nominal field, a function of points (n, 3) in m.

    The order in which they would be measured is not known yet: there is neither lag nor drift.
    """
    study = magnet.study
    steady = study.instrument.with_(**{key: getattr(Instrument(), key) for key in (
        "lag_m", "length_unit_m", "flux_density_unit_T", "position_axes", "field_axes")})
    study = study.with_(
        maps=(), inference=Inference(), instrument=steady,
        instrument_sd=study.instrument_sd.with_(drift_T=0.0),
        uncertain=tuple(one for one in study.uncertain if not any(
            name.startswith("maps[") for name in one.change)))
    is_open = study.instrument_sd != InstrumentSd() or any(
        each.is_of_instrument for each in study.uncertain)
    field = field_function(magnet, session) if is_open else _any_field
    sensors = sensor_positions(steady, points)
    shown = seen(sensor_matrix(steady), field(sensors.reshape(-1, 3)).reshape(sensors.shape))
    middle = box_middle(points)
    one = Map(ONLY_MAP, field_map(points, shown), study, middle, middle, *3 * (ONLY_MAP,))
    return read_campaign(magnet.with_study(study), [one]), one, field


def _any_field(points: Floats) -> Floats:
    """Return a field (n, 3) in T that stands for one on which nothing depends."""
    return 0 * points + [1.0, 1.0, 0.0]


def _beside(
    readings: Readings, one: Map, field: Callable[[Floats], Floats], shared_error: Floats
) -> Floats:
    """Return readings (n, k) in T per prior standard deviation of what is open beside the
    parameters of magnets; ``shared_error`` (e, n) in T is the solver's.
    """
    return np.hstack([shared_error.reshape(-1, len(readings.values)).T,
                      open_columns(one.study, field, [one], readings)])


def _candidates(magnet: Magnet, baseline: Floats, count: int | None) -> tuple[Floats, int]:
    """Return the candidate positions (n, 3) in m and the number of positions to choose.

    StudyError: See `plan_measurement`.
    """
    if magnet.study.observation.quantity != "flux_density":
        raise StudyError(
            f"Input `observation.quantity` of study {magnet.name} must be flux_density for a plan; "
            f"instead it is {magnet.study.observation.quantity}. Plan with a study that observes "
            "flux densities.")
    if magnet.study.noise is None or not magnet.study.noise.regions:
        raise StudyError(
            f"Input `noise` of study {magnet.name} must say how noisy the readings will be, since "
            "no map is there that has sigma_T; instead it is missing. Add [[noise.regions]] to "
            "the study.")
    sets = magnet.study.plan.candidates or (magnet.study.observation.positions,)
    places: list[Floats] = [points_from(positions) for positions in sets]
    candidates: Floats = np.unique(np.vstack(places).round(9), axis=0)
    wanted = count or magnet.study.plan.points or min(len(baseline), len(candidates))
    if wanted > len(candidates):
        raise StudyError(
            f"Input {'--points' if count else '`plan.points`'} of study {magnet.name} must be at "
            f"most the number of candidates, {len(candidates)}; instead it is {wanted}. Ask for "
            "fewer, or add `plan.candidates`.")
    if magnet.study.plan.candidates and magnet.dimension == 3:
        farthest = candidates[np.argmax(np.linalg.norm(candidates, axis=1))]
        magnet.refuse_without_field("`plan.candidates`", float(np.linalg.norm(farthest)),
                                    f"one at ({', '.join(f'{each:g}' for each in farthest)}) m")
    check_points(magnet, baseline)
    check_points(magnet, candidates, "plan.candidates")
    if magnet.study.homogeneity is not None:
        region_points(magnet, default_region(magnet))  # refuses a region that reaches into material
    return candidates, wanted


def _values(magnet: Magnet, prior: Gaussian, session: Session) -> Deviations | None:
    """Return the deviations of |B| that the prior allows, if the study asks for them."""
    if magnet.study.homogeneity is None:
        return None
    return deviation_model(homogeneity_model(magnet, default_region(magnet), session)).of(prior)


def spread(total: int, count: int) -> Ints:
    """Return ``count`` evenly spread indices out of ``total``."""
    return np.floor(np.arange(count) * total / count).astype(int)


def information(design: Floats) -> float:
    """Return the information gain in nats of readings with whitened response (n, m)."""
    small = design @ design.T if len(design) < design.shape[1] else design.T @ design
    return float(np.linalg.slogdet(np.eye(len(small)) + small)[1]) / 2


def variance_left(design: Floats, values: Floats) -> float:
    """Return the sum of the variances of values after readings with whitened response (n, m).

    ``values`` (v, m) is the root of their covariance before the readings, in terms of the same
    whitened parameters.
    """
    if len(design) < design.shape[1]:
        cross = values @ design.T
        fall = np.linalg.solve(np.eye(len(design)) + design @ design.T, cross.T)
        return float(np.sum(values**2) - np.sum(cross * fall.T))
    inner = np.eye(design.shape[1]) + design.T @ design
    return float(np.sum(values * np.linalg.solve(inner, values.T).T))


@dataclass(frozen=True)
class Choice:
    """Positions in the order of their choice, and what they tell."""

    chosen: Ints
    """Indices of the positions. Shape (count,)."""
    gain: Floats
    """Information gain in nats of the positions chosen up to and including each. Shape (count,)."""
    fall: Floats
    """What they take off the sum of the variances of the values of interest; 0 without such.
    Shape (count,)."""


class _Told:
    """What positions chosen so far tell of whitened parameters, by a design (positions, k, m)."""

    def __init__(self, design: Floats) -> None:
        self.design, self.covariance = design, np.eye(design.shape[2])
        # covariance of the noise-free readings at each position, given the positions chosen so far
        self.predicted = np.einsum("pkm,plm->pkl", design, design)

    @property
    def spread(self) -> Floats:
        """Covariance (positions, k, k) of the readings at each position."""
        return np.asarray(np.eye(self.design.shape[1]) + self.predicted)

    def choose(self, number: int) -> tuple[Floats, Floats]:
        """Choose a position; return the root (m, k) of what it takes off the covariance, and what
        that changes in all readings (positions, k, k).
        """
        reduction = np.linalg.solve(
            np.linalg.cholesky(self.spread[number]), self.design[number] @ self.covariance).T
        self.covariance -= reduction @ reduction.T
        reduction_at = self.design @ reduction
        self.predicted -= reduction_at @ reduction_at.transpose(0, 2, 1)
        return reduction, reduction_at


def greedy(
    design: Floats, count: int, values: Floats | None = None, beside: Floats | None = None
) -> Choice:
    """Choose positions one by one, each for the largest gain of information or fall of variance.

    Parameters
    ----------
    design : ndarray, shape (positions, k, m)
        Whitened response of the k readings that are taken at each position.
    count : int
        Number of positions to choose; each is chosen at most once.
    values : ndarray, shape (v, m), optional
        Root of the covariance of the values whose variances are to fall, in terms of the same
        whitened parameters. Without it, the information about all parameters counts.
    beside : ndarray, shape (positions, k, q), optional
        The part of the design of those parameters about which information does not count.
    """
    told, others = _Told(design), _Told(design[:, :, :0] if beside is None else beside)
    root = np.zeros((0, design.shape[2])) if values is None else values
    cross = np.einsum("vm,pkm->pvk", root, design)
    chosen: list[int] = []
    gains, falls = np.zeros(count), np.zeros(count)
    for number in range(count):
        spread = told.spread
        gain = (np.linalg.slogdet(spread)[1] - np.linalg.slogdet(others.spread)[1]) / 2
        fall = np.einsum("pvk,pkv->p", cross, np.linalg.solve(spread, cross.swapaxes(1, 2)))
        score = gain.copy() if values is None else fall.copy()
        score[chosen] = -np.inf
        best = int(np.argmax(score))
        gains[number], falls[number] = gain[best], fall[best]
        chosen.append(best)
        others.choose(best)
        reduction, reduction_at = told.choose(best)
        cross -= np.einsum("vj,pkj->pvk", root @ reduction, reduction_at)
    return Choice(np.array(chosen), np.cumsum(gains), np.cumsum(falls))
