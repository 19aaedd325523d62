"""The inference: from a magnet and a measured map to the posterior of its magnetizations."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import HalbachWarning, MeasurementError, PointsOutsideError
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.block_prior import MeasuredPrior, prior_from_blocks
from halbach_fe.inference.campaign_readings import (
    Noises,
    Readings,
    check_validation_map,
    left_out,
    overlaps,
    read_campaign,
    warn_of_another_gain,
)
from halbach_fe.inference.relinearization import (
    Beside,
    Magnitudes,
    OpenTerms,
    amplitude_columns,
    bent,
    of_the_first,
    readings_of_field,
    warn_of_bent_readings,
)
from halbach_fe.inference.result import (
    Amplitudes,
    InferenceResult,
    InstrumentTerms,
    MapPose,
    Prediction,
)
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.campaign_maps import Map, maps_of
from halbach_fe.measurement.field_map import points_of, taking_arrays
from halbach_fe.measurement.observation_operator import Observation
from halbach_fe.measurement.probe_law import (
    in_si_and_magnet_axes,
    probe_points,
    sensor_matrix,
    turn_of,
)
from halbach_fe.response.block_variation import (
    Deviations,
    distribution_of,
    neighbour_columns,
    neighbour_parameters,
    study_prior,
    updated_field,
    with_magnetizations,
)
from halbach_fe.response.nonlinear import newton_readings
from halbach_fe.response.response_matrix import Response, response_matrix
from halbach_fe.solver.routes import choose_route, field_function
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.stats import posteriors
from halbach_fe.stats.gaussian import Gaussian, NoiseCovariance, stacked_root, with_independent
from halbach_fe.stats.posteriors import Rows, predict
from halbach_fe.study.inference_keys import Uncertain
from halbach_fe.study.model import Study

ROUNDS, AT_REST = 16, 0.3
"""Largest number of updates about terms of the instrument, and change of each of them in its
standard deviations up to which they are at rest."""

NO_WORSE, SMALLEST_SHARE = 1.0, 0.2
"""A change of the terms is halved if their log posterior density decreases by more than the first,
but not to less than the second."""

LEVEL = 2
"""Number of updates in a row, without one that is better by more than `NO_WORSE`, after which
changes by up to a standard deviation count as rest, too. Terms that a map hardly tells apart, such
as a turn about a uniform field and crosstalk, wander that far for ever: what blocks answer to them
is not linear in them. On the measured MRI magnet of docs/accuracy.md they changed by 0.3 to 0.7 in
every update from the fourth to the sixteenth, and the log posterior by 1 or 2."""


@taking_arrays
@alone
def infer(
    magnet: Magnet, data: xr.Dataset | Mapping[str, xr.Dataset], session: Session = NOT_KEPT,
    blocks: BlockTable | None = None, prior: Gaussian | None = None,
    linearized_only: bool = False, validation_map: xr.Dataset | None = None,
    say: Callable[[str], None] = lambda text: None, similar: Magnet | None = None,
) -> InferenceResult:
    """Update the block magnetizations of a study with a measured map.

    Parameters
    ----------
    magnet : Magnet
    data : Dataset or dict of str to Dataset
        The measured map, see `halbach_fe.read_map`; or positions (n, 3) in m, then readings (n, 3)
        in T, and ``sigma_T=``, see `halbach_fe.field_map`; or all maps that the study lists, see
        `halbach_fe.read_maps`. Terms of their instruments of which the study states a standard
        deviation are estimated with the magnetizations.
    session : Session, optional
        Its folder receives the mesh, the run folders and the response matrix.
    blocks : BlockTable, optional
        Measured blocks, whose prior replaces the study's.
    prior : Gaussian, optional
        Prior of all parameters in A/m, which replaces those of the study and of ``blocks``.
    linearized_only : bool
        Skip the solve of the updated magnet that checks whether its iron is linear enough.
    validation_map : Dataset, optional
        Another map, which is predicted but does not update the model; see
        `halbach_fe.measurement.observation_operator.study_for_validation_map`.
    say : callable, optional
        Takes a line of text about each update, if there are several: if terms of instruments are
        estimated, or |B| was read.
    similar : Magnet, optional
        A slightly different magnet that was solved for before, see
        `halbach_fe.response.response_matrix.response_matrix`. It saves most of the time.

    Returns
    -------
    InferenceResult
        Prior and posterior of the magnetizations, and the readings that both predict.

    Raises
    ------
    StudyError
        If the study does not describe the noise of the readings.
    MeasurementError
        If a map, the blocks or the prior do not fit the study, or points of a map are not in air
        within the meshed region.
    GetDPError
        If GetDP fails, or its answer does not pass verification.

    Warns
    -----
    HalbachWarning
        If the iron is not linear enough, or discarded information may change the posterior.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> result = hf.infer(magnet, hf.read_map("map.csv"), hf.Session.open("results"))
    >>> block = result.magnetizations.sel(parameter="r01s05.Mx")
    >>> bool(block["posterior_sd"] < block["prior_sd"])
    True
    """
    of_blocks = None if blocks is None else prior_from_blocks(magnet, blocks)
    if prior is not None:
        prior = distribution_of(magnet, prior, "prior")
    search = _Search.of(magnet, maps_of(magnet.study, data, validation_map), session, similar,
                        of_blocks, prior)
    at_rest = search.come_to_rest(say)
    if at_rest and search.has_uncertain_positions:
        search.estimate_noise_of_positions()
        at_rest = search.come_to_rest(say)
    if not at_rest:
        what = "terms of the instruments" if len(search.terms) else "directions of |B|"
        warnings.warn(
            f"The {what} of study {magnet.name} have not come to rest after {ROUNDS} updates: "
            f"{'their' if len(search.terms) else 'the'} error bars may be too small.",
            HalbachWarning, stacklevel=2)
    last = search.last
    warn_of_bent_readings(last.readings, last.magnitudes)
    warn_of_another_gain(search.maps)
    # relative change of a posterior variance (1 % of a standard deviation) that discarded
    # information may cause without a warning
    harmless = 0.02
    if last.update.discarded_information > harmless:
        warnings.warn(
            f"Study {magnet.name} has so many parameters and readings that some combinations of "
            "readings were discarded, which may change a posterior variance by a fraction of up to "
            f"{last.update.discarded_information:.1g}.",
            HalbachWarning, stacklevel=2)
    bent_iron = "" if linearized_only or not magnet.is_nonlinear else _check_linearization(
        magnet, last.readings.observation, session, last.model,
        last.whole.mean[:len(last.model.parameters)], last.errors.sd)
    return replace(search.result(blocks, at_rest), bent_iron=bent_iron)


@dataclass(frozen=True)
class _Update:
    """One update of all parameters: those of the blocks, then what is beside them."""

    readings: Readings
    vectors: Response
    model: Response
    """The responses of `Readings.vectors` and of the readings to the parameters of the blocks."""
    matrix: Rows
    """Derivatives (readings, parameters) by all parameters."""
    exact: Rows
    """The same for a solver without the error that readings share, see `_Search._beside`: its
    columns are 0."""
    of_field: Rows
    """The same for instruments that are known. Its columns of theirs are 0."""
    prior: Gaussian
    residual: Floats
    """Readings less what the model reads of the nominal magnet. Shape (readings,), in T."""
    errors: NoiseCovariance
    """Noise of the readings, with the solver's error and the bend of |B|."""
    magnitudes: Magnitudes
    """About which readings of |B| are linear."""
    update: posteriors.LinearPosterior

    @property
    def whole(self) -> Gaussian:
        """The posterior of all parameters."""
        return self.update.distribution

    def predicted(self, parameters: Gaussian, matrix: Rows | None = None) -> Prediction:
        """Return the prediction of all readings from a distribution of all parameters, by all of
        these unless ``matrix`` is that of some.
        """
        matrix = self.matrix if matrix is None else matrix
        mean, sd = predict(matrix, parameters)
        offset = self.model.offset + bent(self.readings, self.vectors, self.model, parameters)
        return Prediction(offset + mean, sd, partial(_root_of, matrix, parameters),
                          parameters.root.shape[1])


def _root_of(matrix: Rows, parameters: Gaussian, rows: Ints) -> Floats:
    """Return rows of a root of the covariance of what a matrix makes of some parameters."""
    return np.asarray(matrix[rows] @ parameters.root)


@dataclass
class _Search:
    """Updates, each about what the last one found, until the instruments are at rest."""

    magnet: Magnet
    session: Session
    similar: Magnet | None
    """See `infer`."""
    of_blocks: MeasuredPrior | None
    """Prior from a table of measured blocks."""
    prior: Gaussian | None
    """Prior of the blocks' parameters that replaces it and that of the study."""
    terms: OpenTerms
    """Terms of the instruments that are estimated."""
    amplitudes: tuple[Uncertain, ...]
    """What else is uncertain of the instruments."""
    maps: Sequence[Map]
    """With the instruments as they are estimated."""
    total: Floats
    """Change of the open terms since the study. Shape (terms,)."""
    at: _Estimate | None
    """The magnet as it is estimated; None if all terms are known."""
    nominal_field: Callable[[Floats], Floats] | None
    """Field of the nominal magnet, if ``amplitudes`` act on it."""
    magnitudes: Magnitudes = field(default_factory=Magnitudes)
    """The field about which readings of |B| are linear."""
    noises: Noises = field(default_factory=dict)
    """Noise of each map, computed once for one magnet."""
    noise_blocks: tuple[MagnetBlock, ...] | None = None
    """In whose gradient uncertain positions make the noise; None for the nominal ones."""
    solved: _Solved | None = None
    """The last response that was solved for."""
    error: Floats | None = None
    shared_error: Floats | None = None
    """Of the solver in each reading, and in all together, see `Response`. In T."""
    place: _Place | None = None
    """What the last update that was not worse has found."""
    share: float = 1.0
    """Part of the last change of the terms that was taken."""
    level: int = 0
    """Number of updates since the last that was better by more than `NO_WORSE`, but for those that
    were worse."""
    last: _Update = field(init=False)

    @classmethod
    def of(
        cls, magnet: Magnet, maps: Sequence[Map], session: Session, similar: Magnet | None,
        of_blocks: MeasuredPrior | None, prior: Gaussian | None
    ) -> _Search:
        """Return the search before its first update."""
        terms = OpenTerms.of(maps)
        amplitudes = tuple(one for one in magnet.study.uncertain if one.is_of_instrument)
        at = _Estimate.of(magnet, session) if len(terms) else None
        nominal = field_function(magnet, session.within("instrument")) if amplitudes else None
        return cls(magnet, session, similar, of_blocks, prior, terms, amplitudes, maps,
                   np.zeros(len(terms)), at, nominal)

    @property
    def has_uncertain_positions(self) -> bool:
        """Whether positions of readings are uncertain, which makes noise in a gradient."""
        return any(one.study.noise is not None and any(one.study.noise.position_sd_m or ())
                   for one in self.maps)

    def come_to_rest(self, say: Callable[[str], None]) -> bool:
        """Update about what the last update found, and tell whether that came to rest."""
        return any(self._update(number, say) for number in range(1, ROUNDS + 1))

    def estimate_noise_of_positions(self) -> None:
        """Take the noise that uncertain positions make in the gradient of the estimated magnet."""
        values = self.last.whole.mean[:len(self.magnet.parameter_names)]
        self.noise_blocks = with_magnetizations(self.magnet, values)
        self.noises, self.error, self.shared_error, self.place = {}, None, None, None

    def _update(self, number: int, say: Callable[[str], None]) -> bool:
        """Make an update, move to what it found, and tell whether that changed next to nothing."""
        readings = read_campaign(self.magnet, self.maps, self.noises, self.noise_blocks,
                                 self.magnitudes.directions)
        if self.solved is None:
            check_validation_map(readings, self.magnet.study)
        self.last = last = self._update_of(readings, self._vectors(readings))
        change = last.whole.mean[len(last.whole.mean) - len(self.terms):]
        largest = 0.0
        if self.at is not None:
            self._move(self.at, change)
            largest = np.max(np.abs(self.terms.counted @ change) / self._sd_of_terms())
            say(f"update {number}, of at most {ROUNDS}: the terms of the instruments change by up "
                f"to {largest:.2g} standard deviations" + (
                    f", of which {100 * self.share:.0f} % are taken" if self.share < 1 else ""))
        self.magnitudes = last.magnitudes.updated(
            readings, last.vectors, last.model, last.whole)
        directed = self.magnitudes.is_near(
            last.magnitudes, last.magnitudes.with_bend(readings.noise).sd)
        if not directed:
            self.place = None  # about other directions the evidence is another one
        return bool(directed and self.share == 1.0
                    and largest <= (AT_REST if self.level < LEVEL else 1.0))

    def _vectors(self, readings: Readings) -> Response:
        """Return the response of `Readings.vectors`, solved for or moved with the sensors."""
        # standard deviations of the unknowns up to which a response is moved with the sensors,
        # instead of solving for it again. What is neglected shrinks with the changes of the terms:
        # updates of the stepped dipole of docs/accuracy.md were solved anew at 54, 29 and 6, and
        # moved from 1.2 on, down to 0.2.
        neglected = 2.0
        if self.solved is not None and (
                self.at is None
                or self.solved.neglected(self.at, self.maps, readings) <= neglected):
            return self.solved.response if self.at is None else self.solved.moved(
                self.at, self.maps, readings)
        self.solved = _Solved(
            _response(self.magnet, readings.vectors, self.session, self.similar), self.maps,
            np.zeros(0) if self.at is None else readings_of_field(
                self.at.nominal, self.maps, readings.vectors))
        return self.solved.response

    def _update_of(self, readings: Readings, vectors: Response) -> _Update:
        """Return the update of all parameters by the readings for training."""
        model = readings.projected(vectors, self.session.folder)
        if self.error is None:  # one for all updates: they are compared by their probabilities
            self.error, self.shared_error = model.error, seen_columns(
                model.shared_error.T, readings)
        matrix: Rows = model.matrix
        prior = self._prior_of_blocks(len(model.parameters)).stacked
        if len(prior.mean) > len(model.parameters):
            prior = replace(prior, root=stacked_root(prior.root))  # of an earlier update, too
            matrix = Beside(matrix, model.of_neighbours)
        exact, of_field = matrix, matrix
        for of, columns, mean, sd in self._beside(readings):
            matrix, prior = Beside(matrix, columns), with_independent(prior, mean, sd)
            exact = Beside(exact, 0 * columns if of == "solver" else columns)
            of_field = Beside(of_field, 0 * columns if of == "instrument" else columns)
        magnitudes = self.magnitudes.about(readings, vectors, model, prior)
        errors = magnitudes.with_bend(readings.noise).with_independent_errors(self.error)
        residual, training = readings.values - model.offset, readings.training
        return _Update(
            readings, vectors, model, matrix, exact, of_field, prior, residual, errors, magnitudes,
            posteriors.update(matrix, residual[training], errors.subset(training), prior,
                                   np.flatnonzero(training)))

    def _prior_of_blocks(self, parameters: int) -> Gaussian:
        """Return the prior of the ``parameters`` of the blocks, with neighbours' blocks beside."""
        if self.prior is not None:
            return self.prior
        measured = None if self.of_blocks is None else self.of_blocks.gaussian
        return study_prior(self.magnet, parameters, measured)

    def _beside(
        self, readings: Readings
    ) -> Iterator[tuple[Literal["instrument", "solver"], Floats, Floats, Floats]]:
        """Yield of what it is, derivatives, prior mean and prior standard deviations of what is
        beside blocks.

        The solver's error is shared by all readings: it may be any multiple of the change that
        another discretization makes, normally distributed about 0. As noise that is independent
        from reading to reading it would average out, and the blocks would take its place.
        """
        if self.nominal_field is not None:
            columns = amplitude_columns(
                with_instruments(self.magnet.study, self.maps),
                self.nominal_field if self.at is None else self.at.field, self.maps, readings)
            yield "instrument", columns, *_unit_prior(columns)
        if self.shared_error is not None and self.shared_error.size:
            yield "solver", self.shared_error, *_unit_prior(self.shared_error)
        if self.at is not None:
            yield ("instrument", self.terms.columns(self.at.field, self.maps, readings),
                   -self.total, self.terms.sd)

    def _sd_of_terms(self) -> Floats:
        """Return the posterior standard deviations of the open terms, as they are counted."""
        whole = self.last.whole
        return whole.sd_of(np.hstack([
            np.zeros((len(self.terms), len(whole.mean) - len(self.terms))), self.terms.counted]))

    def _move(self, at: _Estimate, change: Floats) -> None:
        """Move terms, maps and magnet to what the last update found, or part of the way there."""
        whole, model = self.last.whole, self.last.model
        here = _Place(
            self.maps, self.total, at, change, whole.mean[:len(model.parameters)] - model.nominal,
            self.last.update.log_evidence + _log_density_at_zero(whole, len(change)))
        if self.place is not None and self.share > SMALLEST_SHARE and (
                here.log_posterior < self.place.log_posterior - NO_WORSE):
            self.share /= 2  # the readings are not linear in so large a change
        else:
            better = self.place is None or (
                here.log_posterior > self.place.log_posterior + NO_WORSE)
            self.place, self.share, self.level = here, 1.0, 0 if better else self.level + 1
        self.total, self.maps, self.at = self.place.moved(self.terms, self.share)

    def result(self, blocks: BlockTable | None, at_rest: bool) -> InferenceResult:
        """Return what the last update found."""
        magnet, last = self.magnet, self.last
        of_blocks = self.of_blocks if self.prior is None else None
        readings, whole = last.readings, last.whole
        prior, posterior, before = last.prior, whole, last.predicted(last.prior)
        own, others = len(last.model.parameters), neighbour_parameters(magnet)
        if len(whole.mean) > own:
            prior, posterior = of_the_first([prior, whole], own, others)
        return InferenceResult(
            magnet=magnet.with_study(with_instruments(magnet.study, self.maps)),
            observation=readings.observation, readings=readings.values,
            noise=last.magnitudes.with_bend(readings.noise), parts=readings.parts,
            regions=readings.regions, maps=readings.maps, response=last.model,
            prior=prior, posterior=posterior, prediction_prior=before,
            prediction_posterior=last.predicted(whole),
            prediction_exact=last.predicted(last.prior, last.exact)
            if last.model.shared_error.any() else before,
            prediction_field=last.predicted(whole, last.of_field)
            if len(self.terms) or self.amplitudes else None,
            prior_conflict=last.update.prior_conflict,
            parameters_learnt=last.update.parameters_learnt,
            log_evidence=last.update.log_evidence,
            kind="linearized" if magnet.is_nonlinear else "closed form",
            measured_blocks=blocks.serial if blocks and of_blocks else None,
            table_doubts=of_blocks.doubts if of_blocks else (),
            left_out=last.update.discarded_information,
            terms=InstrumentTerms(
                self.terms.names, self.terms.counted @ self.total, self._sd_of_terms(),
                self.terms.sd, at_rest, _poses(self.terms, self.maps, whole))
            if len(self.terms) else None,
            amplitudes=_amplitudes(magnet.study, whole, own, others),
            overlaps=overlaps(last.matrix, last.residual, last.errors, last.prior, readings),
            regions_left_out=left_out(last.matrix, last.residual, last.errors, last.prior,
                                      readings),
            noise_blocks=self.noise_blocks)


def _unit_prior(columns: Floats) -> tuple[Floats, Floats]:
    """Return mean and standard deviations of what columns (n, k) are per standard deviation of."""
    return np.zeros(columns.shape[1]), np.ones(columns.shape[1])


def _in_vacuum(magnet: Magnet, maps: Sequence[Map], observation: Observation) -> Floats:
    """Return readings (n, k) in T per A/m of what the magnetizations of neighbours' blocks
    deviate, without what iron answers.
    """
    if not magnet.study.external.neighbours:
        return np.zeros((len(observation), 0))
    found = []
    for one in maps:
        instrument = one.study.instrument
        points = probe_points(instrument, points_of(in_si_and_magnet_axes(instrument, one.data)))
        found.append(np.moveaxis(neighbour_columns(magnet, points), 2, 0)
                     @ sensor_matrix(instrument).T)
    return observation.read(np.concatenate(found, axis=1)).T


def seen_columns(columns: Floats, readings: Readings) -> Floats:
    """Return columns (n, k) in T with the covariance of others (n, m) in T, without those that are
    lost in the noise of all readings together.
    """
    left, sizes, _ = np.linalg.svd(columns.reshape(len(readings.values), -1), full_matrices=False)
    least_size = 0.1  # in noises, over all readings together
    seen = sizes > least_size * float(np.median(readings.noise.sd))
    return np.asarray(left[:, seen] * sizes[seen])


def _amplitudes(
    study: Study, posterior: Gaussian, parameters: int, beside: int
) -> Amplitudes | None:
    """Return what an update found of the uncertain amplitudes of a study.

    Those of the magnet are the last of its ``parameters``, those of instruments come after these
    and so many ``beside``.
    """
    found = sorted(study.uncertain, key=lambda one: one.is_of_instrument)
    if not found:
        return None
    own = np.arange(len(found)) + parameters - len(study.uncertain_of_magnet)
    own[len(study.uncertain_of_magnet):] += beside
    scale = np.array([one.sd for one in found])
    rows = np.eye(len(posterior.mean))[own]
    return Amplitudes(tuple(one.name for one in found), scale * posterior.mean[own],
                      scale * posterior.sd_of(rows), scale)


@dataclass(frozen=True)
class _Estimate:
    """The magnet as it is estimated.

    ``nominal`` is B of the nominal one, see `field`. ``deviations`` are those of all parameters
    (m,), and ``step`` is what the last update has changed of them.
    """

    nominal: Callable[[Floats], Floats]
    of_deviations: Deviations
    deviations: Floats
    step: Floats

    @classmethod
    def of(cls, magnet: Magnet, session: Session) -> _Estimate:
        """Return the nominal magnet."""
        deviations = Deviations.of(magnet)
        nothing = np.zeros(deviations.count)
        return cls(field_function(magnet, session.within("instrument")), deviations, nothing,
                   nothing)

    def updated(self, deviations: Floats) -> _Estimate:
        """Return the estimate of an update."""
        return replace(self, deviations=deviations, step=deviations - self.deviations)

    @cached_property
    def own(self) -> Callable[[Floats], Floats]:
        """The field of the deviations, in T at points (n, 3) in m."""
        return self.of_deviations.answered(self.deviations)

    def field(self, points: Floats) -> Floats:
        """Return B (n, 3) in T at points (n, 3) in m."""
        return self.nominal(points) + self.own(points)


@dataclass(frozen=True)
class _Place:
    """Terms of the instruments about which an update was made, and what it found."""

    maps: Sequence[Map]
    """With instruments of these terms."""
    total: Floats
    """Their change since the study. Shape (terms,)."""
    estimate: _Estimate
    """The magnet about which the update was made."""
    change: Floats
    """Of the terms, that the update found. Shape (terms,)."""
    deviations: Floats
    """Of the blocks, that the update found. Shape (parameters,)."""
    log_posterior: float
    """Log posterior density of the terms about which the update was made, but for a constant."""

    def moved(
        self, open_terms: OpenTerms, share: float
    ) -> tuple[Floats, Sequence[Map], _Estimate]:
        """Return terms, maps and magnet after a share of what the update found."""
        change, before = share * self.change, self.estimate.deviations
        return (open_terms.together(self.total, change), open_terms.applied(self.maps, change),
                self.estimate.updated(before + share * (self.deviations - before)))


def _log_density_at_zero(distribution: Gaussian, count: int) -> float:
    """Return the log density of a distribution's last ``count`` parameters at zero."""
    mean = distribution.mean[-count:]
    others = np.zeros((count, len(distribution.mean) - count))
    root = np.hstack([others, np.eye(count)]) @ distribution.root
    covariance = root @ root.T
    return float(-(mean @ np.linalg.solve(covariance, mean)
                   + np.linalg.slogdet(2 * np.pi * covariance)[1]) / 2)


@dataclass(frozen=True)
class _Solved:
    """The response of `Readings.vectors` of maps whose instruments had certain terms.

    ``nominal`` in T is what they read of the nominal magnet; it is empty if all terms are known.
    """

    response: Response
    maps: Sequence[Map]
    nominal: Floats

    def neglected(self, estimate: _Estimate, maps: Sequence[Map], readings: Readings) -> float:
        """Return the standard deviations by which `moved` may be wrong after changes of the terms.

        It is wrong in two parts. The field of the deviations, by which it is moved, lacks what iron
        answers; what is missing is taken to change by the same fraction as what is known. And the
        matrix of the old places is wrong for what the next update changes, which is taken to be at
        most what the last one has changed. No combination of the unknowns is wrong by more standard
        deviations than the norm of the error in units of the noise.
        """
        vectors = readings.vectors
        before = readings_of_field(estimate.own, self.maps, vectors)
        if not before.any():
            return 0.0
        missing = np.asarray(self.response.matrix @ estimate.deviations) - before
        part = np.linalg.norm(missing) / np.linalg.norm(before)
        moved = readings_of_field(estimate.own, maps, vectors) - before
        step = partial(estimate.of_deviations.field, estimate.step)
        unmoved = readings_of_field(step, maps, vectors) - readings_of_field(
            step, self.maps, vectors)
        noise, seen = readings.noise.sd, readings.projection
        return float(part * np.linalg.norm(seen @ moved / noise)
                     + np.linalg.norm(seen @ unmoved / noise))

    def moved(self, estimate: _Estimate, maps: Sequence[Map], readings: Readings) -> Response:
        """Return the response of `Readings.vectors` after small changes of the terms.

        Its matrix is the same, but for neighbours' blocks in vacuum. Its offset contains what the
        changes do to the readings of the magnet as it is estimated.
        """
        magnet, vectors = estimate.of_deviations.magnet, readings.vectors
        others = _in_vacuum(magnet, maps, vectors) - _in_vacuum(magnet, self.maps, vectors)
        change = (readings_of_field(estimate.field, maps, vectors) - self.nominal
                  - readings_of_field(estimate.own, self.maps, vectors))
        return replace(self.response, offset=self.response.offset + change,
                       of_neighbours=self.response.of_neighbours + others)


def _poses(open_terms: OpenTerms, maps: Sequence[Map], posterior: Gaussian) -> tuple[MapPose, ...]:
    """Return where the maps lie whose poses are among the open terms."""
    found = []
    for one, rows in zip(maps, open_terms.of_poses(maps), strict=True):
        known = np.zeros((len(rows), len(posterior.mean) - len(open_terms)))
        sd = posterior.sd_of(np.hstack([known, rows])).tolist()
        instrument = one.study.instrument
        x, y, z = (turn_of(instrument).apply(one.middle_m)
                   + instrument.translation_m).tolist()
        if rows.any():
            found.append(MapPose(one.name, (x, y, z), tuple(sd[:3]), tuple(sd[3:])))
    return tuple(found)


def _response(
    magnet: Magnet, observation: Observation, session: Session, similar: Magnet | None
) -> Response:
    """Return the response of all readings to the magnetizations."""
    try:
        return response_matrix(magnet, observation, session, similar)
    except PointsOutsideError as error:
        raise MeasurementError(error.sentence(f"map of study {error.study}")) from None


def with_instruments(study: Study, maps: Sequence[Map]) -> Study:
    """Return a study with the instruments of some maps, its own.

    An uncertain amplitude of the instrument that maps shared is that of each of them.
    """
    own = [one for one in maps if not one.is_validation]
    if not study.maps:
        return study.with_(instrument=own[0].study.instrument)
    changed = [number for number, one in enumerate(own)
               if one.study.instrument != study.of_map(number).instrument]
    shared = [f"maps[{number + 1}]." for number in changed if study.maps[number].instrument is None]
    return study.with_(
        maps=tuple(each.with_(instrument=own[number].study.instrument) if number in changed
                   else each for number, each in enumerate(study.maps)),
        uncertain=tuple(one.with_(change=one.change | {
            place + name: value for name, value in one.change.items()
            if name.startswith("instrument.") for place in shared}) for one in study.uncertain))


def observation_of(
    magnet: Magnet, data: xr.Dataset | Mapping[str, xr.Dataset],
    blocks: BlockTable | None = None, validation_map: xr.Dataset | None = None,
) -> Observation:
    """Return the observation of all readings of `infer`, with the same checks of its inputs.

    The noise that uncertain positions cause is left out, because its computation is the slow part
    of reading a map.
    """
    if blocks is not None:
        prior_from_blocks(magnet, blocks)
    maps = maps_of(magnet.study, data, validation_map)
    quick = []
    for one in maps:
        noise = one.study.noise
        if noise is not None:
            noise = noise.with_(position_sd_m=None) if noise.regions else None
        quick.append(replace(one, study=one.study.with_(noise=noise)))
    return read_campaign(magnet, quick).observation


def _check_linearization(
    magnet: Magnet, observation: Observation, session: Session, model: Response, mean: Floats,
    sigma: Floats,
) -> str:
    """Warn if the linearization of the iron changes readings of the posterior mean noticeably, and
    return that sentence; it is empty if not.
    """
    # Error that the linearization of the iron may cause in a reading, relative to its error bar; a
    # larger error causes a warning.
    linear_enough = 0.3
    own = replace(session, folder=session.folder / "posterior")
    mean = mean[:len(magnet.parameter_names)]
    if choose_route(magnet, observation.points) == "moments":
        true = observation.apply(updated_field(  # extrapolated, as the model is
            magnet, mean, observation.points, own, estimate=True))
    else:
        true = newton_readings(magnet, observation, own, mean[None])[0]
    others = np.zeros(len(model.parameters) - len(mean))
    linear = model.offset + model.matrix @ np.append(mean, others)
    worst = float((np.abs(linear - true) / sigma).max())
    if worst <= linear_enough:
        return ""
    said = ("The iron is linearized about the nominal magnet, which changes a reading of the "
            f"updated magnet by {worst:.2g} of its error bar: study {magnet.name} needs the "
            "non-linear posterior.")
    warnings.warn(said, HalbachWarning, stacklevel=3)
    return said
