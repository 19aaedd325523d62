"""The result of an inference, and scores of how well it predicts the readings.

Some readings (training) update the model, the others are held out. Prior and posterior predict all
of them, with error bars, and the predictions are compared with the readings region by region.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.special import gammainc

from halbach_fe.core.arrays import Floats, Ints, rms
from halbach_fe.core.errors import StudyError
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.numbers import decimals, in_a_row
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.measurement.campaign_maps import ONLY_MAP
from halbach_fe.measurement.doubted_terms import (
    ALL_BLOCKS,
    UNLIKE,
    Term,
    block_doubts,
    doubts,
    doubts_in_words,
    factor_in_words,
    factor_of,
    held_back,
    held_back_in_words,
    likeness_of,
    shared_doubts,
    shared_in_words,
    words_of,
)
from halbach_fe.measurement.observation_operator import Observation
from halbach_fe.response.magnetic_axis import MagneticAxis
from halbach_fe.response.response_matrix import Response
from halbach_fe.response.stray_field import StrayField
from halbach_fe.stats.gaussian import Gaussian, NoiseCovariance
from halbach_fe.stats.posteriors import contraction, row_slices, whitened
from halbach_fe.study.inference_keys import shifted
from halbach_fe.study.model import Study

ALL_READINGS = "all"
"""Name of the only region of a study without noise regions."""

TRAINING, HELD_OUT, HELD_OUT_MAP = "training", "held out", "held-out map"
"""The parts of the readings: those that update the model, those of the same map that are held out,
and those of a validation map."""

COVERAGE_Z = 1.959964
"""Half width of a central 95 % band in standard deviations."""

PREDICTION_COLUMNS = (
    "label", "x_m", "y_m", "z_m", "map", "region", "held_out", "part", "measured_T", "sigma_T",
    "solver_error_T", "prior_mean_T", "prior_sd_T", "posterior_mean_T", "posterior_sd_T",
    "standardized_residual_prior", "standardized_residual",
    "field_T", "field_sd_T", "place_x_m", "place_y_m", "place_z_m",
    "along_x", "along_y", "along_z")
"""Columns of prediction.csv, one row per reading. The last eight are those of `SensedField`."""

TOO_NEAR = 0.1
"""chi-squared per reading below which the noise or the prior is stated too large, by a factor of
three. Error bars of the solver that count as noise leave 0.2 in magnets that are known well."""

FEWEST_READINGS = 20
"""Readings, beyond the parameters learnt, whose chi-squared is below that by chance with a
probability of 1e-7, with a sd of a third. Of fewer it has to be smaller: of one, it is so in a
quarter of all maps."""

OWN_NOISE = ("(A column sigma_T of the map counts in place of the study's.) `halbach-fe check` "
             "finds the noise of the map if its points are near enough to each other.")
"""Advice where the noise is stated too large."""

TOO_FAR = 1.3
"""chi-squared per held-out reading, with the covariance of the predictions, up to which there is no
word however many readings there are: error bars are then too small by a seventh."""

WELL_KNOWN = 2.0
"""rms of what was left out, in units of its noise, up to which the magnet is known there."""


@dataclass(frozen=True)
class Prediction:
    """The distribution of the readings that a model predicts, without their noise."""

    mean: Floats
    sd: Floats
    """Shape (readings,), in T."""
    root: Callable[[Ints], Floats]
    """Returns the rows (c, columns), in T, of a root of the covariance for indices (c,) of
    readings."""
    columns: int
    """Number of columns of the root."""


@dataclass(frozen=True)
class SensedField:
    """The field of the updated magnet where the sensors read it, without their own errors.

    A reading is known as well as its noise. The field is not, if gain, crosstalk or pose are
    uncertain: what the instrument may be wrong by, the magnet may have.
    """

    places: Floats
    """In the magnet, as the instrument is estimated. The field is that of these fixed places.
    Shape (readings, 3), in m."""
    along: Floats
    """Unit vectors in the magnet's axes, along which the sensors read: x, y or z, but for turns and
    crosstalk. Shape (readings, 3)."""
    mean: Floats
    sd: Floats
    """The component of B along these, and its standard deviation by blocks and solver. ``along``,
    ``mean`` and ``sd`` are NaN for Fourier coefficients, which are sums over circles.
    Shape (readings,), in T."""

    @property
    def strongest(self) -> int | None:
        """Number of the reading at which the field is strongest; None if no reading has one."""
        return None if np.isnan(self.mean).all() else int(np.nanargmax(np.abs(self.mean)))

    def summary(self) -> dict[str, object] | None:
        """Return the strongest field as plain data for JSON; None if no reading has one."""
        most = self.strongest
        return None if most is None else {
            "at_m": self.places[most].tolist(), "along": self.along[most].tolist(),
            "mean_T": float(self.mean[most]), "sd_T": float(self.sd[most])}


@dataclass(frozen=True)
class MapPose:
    """Where a map lies in the magnet, as the update found it."""

    name: str
    """Of the map."""
    middle_m: tuple[float, float, float]
    middle_sd_m: tuple[float, float, float]
    """Middle of its points in the magnet's axes, and the standard deviations."""
    turn_sd_rad: tuple[float, float, float]
    """Standard deviations of its turn about each axis of the magnet."""


@dataclass(frozen=True)
class Amplitudes:
    """Uncertain numbers that were estimated together with the magnetizations."""

    names: tuple[str, ...]
    """As in the tables ``[[uncertain]]`` of the study, those of the magnet first; of instruments
    such as ``fringe.translation_x_m``, after the name of a map, a stage or a probe."""
    change: Floats
    sd: Floats
    prior_sd: Floats
    """Change from what the study says, and standard deviations after and before. Shape (n,)."""

    def rows(self) -> Iterator[tuple[str, float, float, float]]:
        """Yield name, change, and standard deviations after and before of each."""
        return zip(self.names, self.change.tolist(), self.sd.tolist(), self.prior_sd.tolist(),
                   strict=True)

    def summary(self) -> dict[str, dict[str, float]]:
        """Return these by name as plain data for JSON."""
        return {name: {"change": change, "sd": sd, "prior_sd": prior_sd}
                for name, change, sd, prior_sd in self.rows()}


@dataclass(frozen=True)
class InstrumentTerms(Amplitudes):
    """Terms of the instruments that were estimated together with the magnetizations."""

    at_rest: bool
    """Whether the last update changed no term by more than a part of its standard deviation."""
    poses: tuple[MapPose, ...]
    """Where the maps lie whose poses are among the terms."""


@dataclass(frozen=True)
class Overlap:
    """How one map agrees with what an update by another map alone predicts."""

    name: str
    by: str
    """The map that is predicted, and the map whose update predicts it."""
    readings: int
    """Number of readings of ``name`` within the region of ``by``: those that are held out, or all
    of them if none is."""
    held_out: bool
    """Whether these readings are held out of the common update too."""
    rms_T: float
    """Rms difference from the prediction."""
    chi2: float
    """Chi-squared per reading, by the covariance of prediction, noise and instruments."""

    @property
    def limit(self) -> float:
        """Limit of ``chi2`` beyond which chance is no explanation: five sd above 1."""
        return 1 + 5 * float(np.sqrt(2 / self.readings))

    @property
    def disagreement(self) -> str:
        """A sentence if the two maps do not agree, else an empty string."""
        where = (f"Where they overlap, map {self.name} is {decimals(1e3 * self.rms_T)} mT rms off "
                 f"what map {self.by} predicts (chi² per reading is {decimals(self.chi2)}, where 1 "
                 "is expected")
        if self.chi2 > self.limit:
            return (f"{where} and more than {self.limit:.2g} is rare): they are not of the same "
                    "magnet in the same state, or the pose, probe or noise of one of them is not "
                    "what the study says.")
        if self.chi2 < min(TOO_NEAR, 2 - self.limit):
            return f"{where}): the noise of these maps is stated too large."
        return ""


@dataclass(frozen=True)
class Stretch:
    """How readings that were left out are predicted where they lie between two planes."""

    axis: str
    """Of the magnet, along which the readings that were left out are longest."""
    from_m: float
    to_m: float
    """Of the readings there, along this axis."""
    readings: int
    rms_T: float
    noise_T: float
    """As those of `LeftOut`."""

    @property
    def over_noise(self) -> float:
        """The rms difference in units of the noise."""
        return self.rms_T / self.noise_T

    @property
    def where(self) -> str:
        """The place in words."""
        low, high = (str(round(1e3 * each)).replace("-", "−") for each in (self.from_m, self.to_m))
        return f"{self.axis} = {low}{f' to {high}' if high != low else ''} mm"


@dataclass(frozen=True)
class LeftOut:
    """How an update that has not seen a whole map, or the ends of the only one, predicts it."""

    name: str
    """The map; empty if it is the ends of the only one."""
    readings: int
    rms_T: float
    """Rms difference from the prediction, with the pose and the probe that only this map has."""
    noise_T: float
    """Rms of noise and solver error of these readings."""
    allowed_T: float
    """Rms of noise and error bars of the prediction, without that pose and that probe."""
    chi2: float
    """Chi-squared per reading, by the covariance of prediction, noise and instruments."""
    stretches: tuple[Stretch, ...] = ()
    """The same along the magnet or across it."""

    @property
    def over_noise(self) -> float:
        """The rms difference in units of the noise."""
        return self.rms_T / self.noise_T

    @property
    def worst(self) -> Stretch | None:
        """Where the prediction is farthest off, if it is farther off there than twice the noise."""
        worst = max(self.stretches, key=lambda one: one.over_noise, default=None)
        return worst if worst is not None and worst.over_noise > WELL_KNOWN else None

    @property
    def in_words(self) -> str:
        """What was left out, and how well it is predicted."""
        what = (f"Map {self.name}, left out, is predicted by the others" if self.name else
                "The ends of the map, left out, are predicted by its middle")
        where = "" if self.worst is None else (
            f", the worst {decimals(self.worst.over_noise, 2)} times at {self.worst.where} of the "
            "magnet")
        return (f"{what} to {decimals(self.over_noise, 2)} times its noise (chi² per reading "
                f"{decimals(self.chi2, 2)}{where})")

    @property
    def disagreement(self) -> str:
        """A sentence if the prediction is farther off than its error bars allow, else nothing."""
        limit = max(TOO_FAR, 1 + 5 * float(np.sqrt(2 / self.readings)))
        return "" if self.chi2 <= limit else (
            f"{self.in_words}, where at most {limit:.2g} is expected: where nobody "
            "measured, the magnet is not what the update says, and its error bars are too small.")


@dataclass(frozen=True)
class RegionScore:
    """Scores of the predictions of prior and posterior for the readings of a region and a part."""

    region: str
    part: str
    """Noise region and part (training, held out, held-out map) of the readings."""
    readings: int
    """Number of readings."""
    rms_error_prior_T: float
    rms_error_posterior_T: float
    """Root mean square of measured minus predicted."""
    median_relative_error_prior: float | None
    median_relative_error_posterior: float | None
    """Median of ``|measured - predicted| / |measured|`` over the readings that are not 0."""
    rms_standardized_prior: float
    rms_standardized_posterior: float
    """Root mean square of the standardized residuals: measured minus predicted, divided by the
    standard deviation of prediction, noise and solver together. That of the posterior is below 1
    for training readings, to which the posterior was fitted."""
    coverage95_prior: float | None
    coverage95_posterior: float | None
    """Fraction of the standardized residuals within their central 95 % band; None for training
    readings."""
    chi2_prior: float | None
    chi2_posterior: float | None
    """Chi-squared per reading by the full covariance of prediction, noise and solver; None for
    training readings."""


FAR_BARS = 10.0
"""Error bars from which an amplitude moved far: the blocks' chi² was 9 where a gap had moved by 70,
and 1 after a second update."""


def far_in_words(names: Sequence[str]) -> str:
    """Say that the update is linear in amplitudes that moved far, if there are any."""
    return "" if not names else (
        "The update is linear in the amplitudes of [[uncertain]], and moved "
        f"{in_a_row(names)} by more than {FAR_BARS:.0f} error bars: bars may be too small.")


class Reservation(str):
    """Why an update that agrees with its maps is to be used with care, as its verdict begins.

    Where a text says how a posterior disagrees with its map, one of this class says that it does
    not, and what is open.
    """

    __slots__ = ()


@dataclass(frozen=True)
class InferenceResult(ShownInNotebook):
    """The posterior of a magnet's magnetizations after a measurement, and its predictions.

    Attributes
    ----------
    magnet : Magnet
    observation : Observation
        How B at points becomes readings; all readings, training and held out.
    readings : ndarray, shape (readings,), in T
        Measured values.
    noise : NoiseCovariance
        The noise covariance of the readings.
    parts : tuple of str
        Part of each reading: ``training``, ``held out`` or, if the reading is from a validation
        map, ``held-out map``.
    regions : tuple of str
        Noise region of each reading; among several maps with the name of its map.
    maps : tuple of str
        Map of each reading, see `halbach_fe.measurement.campaign_maps.Map`.
    response : Response
        The linear model of the readings.
    prior, posterior : Gaussian
        Distributions of the magnetizations (parameters,) in A/m, with those of neighbours' blocks
        beside.
    prediction_prior, prediction_posterior : Prediction
        Their predictions of all readings.
    prediction_exact : Prediction
        That of the prior by a solver whose error no readings share.
    prediction_field : Prediction or None
        That of the posterior by instruments without the errors that were estimated; None if none
        was, so that it is `prediction_posterior`.
    prior_conflict : float
        Chi-squared per training reading of the prior's prediction. It is about 1 if prior, model
        and noise are right; see `conflict_limit`.
    parameters_learnt : float
        Effective number of parameters that the readings determine.
    log_evidence : float
        Logarithm of the marginal likelihood of the training readings.
    kind : {"closed form", "linearized", "samples"}
        How the posterior was computed: in closed form, by linearization of the iron, or by Markov
        chains.
    measured_blocks : tuple of str or None
        Serial numbers of the measured blocks from which the prior follows; None if it is the
        study's prior.
    table_doubts : tuple of str
        Sentences about why the table of measured blocks may not be of this magnet.
    left_out : float
        Upper bound of the relative change of a posterior variance by discarded information, see
        `halbach_fe.stats.posteriors.LinearPosterior`.
    terms : InstrumentTerms or None
        Terms of the instruments that were estimated with the magnetizations; None if all are known.
    amplitudes : Amplitudes or None
        Uncertain amplitudes of the study, see `halbach_fe.study.inference_keys.Uncertain`; None if
        there are none.
    overlaps : tuple of Overlap
        How maps agree where they overlap.
    regions_left_out : tuple of LeftOut
        How each map is predicted by the others, or the ends of a single one by its middle.
    noise_blocks : tuple of MagnetBlock or None
        Blocks in whose gradient uncertain positions make the noise, as a first update estimated
        them; None if they are the nominal ones.
    bent_iron : str
        A sentence if iron is not as linear as the update takes it to be.
    stray_field : StrayField or None
        How far outside the field of the updated magnet is strong; None if that was not computed,
        see `halbach_fe.response.stray_field.stray_field`.
    magnetic_axis : MagneticAxis or None
        Centre, axis and roll of the updated magnet; None if they were not computed, see
        `halbach_fe.response.magnetic_axis.magnetic_axis`.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> result = hf.infer(magnet, hf.read_map("map.csv"), hf.Session.open("results"))
    >>> list(result.magnetizations)
    ['nominal', 'prior_mean', 'prior_sd', 'posterior_mean', 'posterior_sd']
    >>> result.prior_conflict < result.conflict_limit
    True
    """

    magnet: Magnet
    observation: Observation
    readings: Floats
    noise: NoiseCovariance
    parts: tuple[str, ...]
    regions: tuple[str, ...]
    maps: tuple[str, ...]
    response: Response
    prior: Gaussian
    posterior: Gaussian
    prediction_prior: Prediction
    prediction_posterior: Prediction
    prediction_exact: Prediction
    prior_conflict: float
    parameters_learnt: float
    log_evidence: float
    kind: Literal["closed form", "linearized", "samples"]
    measured_blocks: tuple[str, ...] | None = None
    table_doubts: tuple[str, ...] = ()
    left_out: float = 0.0
    terms: InstrumentTerms | None = None
    amplitudes: Amplitudes | None = None
    overlaps: tuple[Overlap, ...] = ()
    regions_left_out: tuple[LeftOut, ...] = ()
    prediction_field: Prediction | None = None
    noise_blocks: tuple[MagnetBlock, ...] | None = None
    bent_iron: str = ""
    stray_field: StrayField | None = None
    magnetic_axis: MagneticAxis | None = None

    @property
    def noise_magnet(self) -> Magnet:
        """The magnet in whose gradient uncertain positions make the noise."""
        return self.magnet if self.noise_blocks is None else replace(
            self.magnet, blocks=self.noise_blocks)

    @property
    def is_campaign(self) -> bool:
        """Whether several maps updated the model."""
        return len({name for name, part in zip(self.maps, self.parts, strict=True)
                    if part != HELD_OUT_MAP}) > 1

    @property
    def study(self) -> Study:
        """The study that was updated."""
        return self.magnet.study

    @property
    def of_blocks(self) -> InferenceResult:
        """The result with the uncertain amplitudes of the magnet beside its magnetizations, as what
        neighbours' blocks deviate is. It serves what moves blocks from slot to slot.
        """
        count = len(self.response.parameters) - len(self.study.uncertain_of_magnet)
        if count == len(self.response.parameters):
            return self
        prior, posterior = (each.stacked.split(count, len(each.stacked.mean) - count)
                            for each in (self.prior, self.posterior))
        return replace(self, prior=prior, posterior=posterior)

    @property
    def magnetizations(self) -> xr.Dataset:
        """Nominal magnetizations, and mean and sd of prior and posterior, in A/m by parameter."""
        values = {
            "nominal": self.response.nominal, "prior_mean": self.prior.mean,
            "prior_sd": self.prior.sd, "posterior_mean": self.posterior.mean,
            "posterior_sd": self.posterior.sd}
        return xr.Dataset({name: ("parameter", value, {"units": "A/m"})
                           for name, value in values.items()},
                          coords={"parameter": list(self.response.parameters)})

    def by_block(self, values: Floats) -> Floats:
        """Return the uniform magnetizations (blocks, dimension, ...) among parameters (m, ...)."""
        size = self.magnet.dimension
        count = len(self.magnet.blocks)
        return values[:size * count].reshape(count, size, *values.shape[1:])

    @property
    def contraction(self) -> Floats:
        """Posterior contraction (blocks,) of the uniform magnetizations, see `contraction` of
        `halbach_fe.stats.posteriors`.
        """
        return contraction(self.by_block(self.prior.sd), self.by_block(self.posterior.sd))

    @property
    def predictions(self) -> xr.Dataset:
        """All readings with their noise, the predictions of prior and posterior, and the field.

        The variables are the columns of prediction.csv. What prior and posterior predict are
        readings, with the gain and all else that the instrument does; `field` is without these.
        """
        prior, posterior, field = self.prediction_prior, self.prediction_posterior, self.field
        columns = dict(zip(PREDICTION_COLUMNS, (
            np.array(self.observation.labels), *self.observation.positions.T,
            np.array(self.maps), np.array(self.regions), self.held_out.astype(int),
            np.array(self.parts), self.readings, self.noise.sd, self.response.error, prior.mean,
            prior.sd, posterior.mean, posterior.sd, self.standardized(prior),
            self.standardized(posterior), field.mean, field.sd, *field.places.T,
            *field.along.T), strict=True))
        return xr.Dataset({name: ("reading", value) for name, value in columns.items()})

    @cached_property
    def field(self) -> SensedField:
        """The field of the updated magnet at the places of the readings.

        A reading is linear in B at its sensor, so that the field is what the magnetizations make of
        the reading, divided by the sensor's sensitivity. Terms and amplitudes of the instrument
        that were estimated with the magnetizations are in their covariance, not in the field.
        """
        observation, known = self.observation, self.prediction_field or self.prediction_posterior
        size = np.linalg.norm(observation.sensitivities, axis=1)
        return SensedField(observation.places, observation.sensitivities / size[:, None],
                           known.mean / size, np.hypot(known.sd, self.response.error) / size)

    @cached_property
    def held_out(self) -> NDArray[np.bool_]:
        """Mask (readings,) of the readings that did not update the model."""
        return np.array(self.parts) != TRAINING

    @cached_property
    def errors(self) -> NoiseCovariance:
        """Covariance of the readings about the model: their noise and the solver's error."""
        return self.noise.with_independent_errors(self.response.error)

    @property
    def sigma(self) -> Floats:
        """Standard deviations (readings,) of `errors`, in T."""
        return self.errors.sd

    @cached_property
    def scores(self) -> tuple[RegionScore, ...]:
        """Scores of the predictions by region and part."""
        noise = self.study.noise
        names = [region.name for region in noise.regions] if noise else []
        predictions = {"prior": self.prediction_prior, "posterior": self.prediction_posterior}
        errors = {
            name: (prediction, self.relative_error(prediction), self.standardized(prediction))
            for name, prediction in predictions.items()}
        return tuple(
            self._score(region, part, chosen, errors)
            for region in dict.fromkeys([*names, *self.regions])
            for part in (TRAINING, HELD_OUT, HELD_OUT_MAP)
            if (chosen := self.chosen(region, part)).any())

    def chosen(self, region: str, part: str) -> NDArray[np.bool_]:
        """Return the mask (readings,) of the readings in a region and a part."""
        return (np.array(self.regions) == region) & (np.array(self.parts) == part)

    @property
    def conflict_limit(self) -> float:
        """Limit of `prior_conflict` beyond which chance is no explanation: five sd above 1."""
        return 1 + 5 * float(np.sqrt(2 / np.sum(~self.held_out)))

    @property
    def disagreement(self) -> str:
        """Sentences if prior, model and maps cannot all be right, else an empty string."""
        found = [self._conflict or self.too_near, self.held_out_conflict, self._doubted,
                 *(each.disagreement for each in self.overlaps),
                 *(each.disagreement for each in self.regions_left_out)]
        if any(found) and not self.too_near:
            found += self.table_doubts
        return " ".join(sentence for sentence in found if sentence)

    @cached_property
    def doubts(self) -> tuple[Term, ...]:
        """Terms of instruments, and all blocks together, that are far from their priors; see
        `halbach_fe.measurement.doubted_terms`.

        A single block may be what the update is to find: the answer names it, and chi-squared
        judges it.
        """
        magnet, terms = self.magnet, []
        if self.terms is not None:
            for name, change, _, sd in self.terms.rows():
                terms.append(Term(*words_of(name.removeprefix(f"{ONLY_MAP}.")), change, sd))
        blocks = block_doubts(magnet, self.posterior.mean, self.prior.mean, self.prior.sd)
        return doubts(terms, magnet.dimension * len(magnet.blocks)) + tuple(
            one for one in blocks if one.name == ALL_BLOCKS)

    @cached_property
    def shared_doubts(self) -> tuple[Term, ...]:
        """What all blocks together are farther off than their prior allows, though no block is.

        An error of the instrument does the same, which a good chi-squared does not tell apart.
        """
        training = ~self.held_out
        error, size = (np.linalg.norm(values[training]) for values in (
            self.response.error, self.prediction_posterior.mean))
        return () if self.doubts else shared_doubts(
            self.magnet, self.posterior.mean, self.prior, float(error / size) if size else 0.0)

    @cached_property
    def held_back(self) -> tuple[Term, ...]:
        """Blocks so far off that their prior is refuted, which holds them back nevertheless."""
        return held_back(self.magnet, self.posterior.mean, self.posterior.sd, self.prior)

    @property
    def far_amplitudes(self) -> tuple[str, ...]:
        """Names of uncertain amplitudes that moved farther than the update is linear in them.

        Fields are linear in currents, moments and uniform fields, however far these move.
        """
        linear = ("current_A", "background_T", "moment_A_m2", "offset_T", "drift_T")
        found = self.amplitudes
        if found is None:
            return ()
        bent = {one.name for one in self.study.uncertain
                if {name.split(".")[-1].partition("[")[0] for name in one.change} - set(linear)}
        return tuple(name for name, change, sd in zip(
            found.names, found.change, found.sd, strict=True)
            if name in bent and abs(change) > FAR_BARS * sd)

    @cached_property
    def study_as_found(self) -> Study:
        """The study with the amplitudes that were found, as which they are to be updated again.

        It is the study itself if none of them moved far, or if there is no such magnet.
        """
        study, found = self.study, self.amplitudes
        if found is None or not self.far_amplitudes:
            return study
        change = dict(zip(found.names, found.change.tolist(), strict=True))
        try:
            for one in self.study.uncertain:
                study = shifted(study, one, change[one.name])
            study = study.with_(uncertain=self.study.uncertain)
            build_magnet(study)
        except (StudyError, ValidationError):
            return self.study
        return study

    @property
    def reservation(self) -> Reservation:
        """Sentences if the update agrees with its maps and is not sound nevertheless, else empty.

        It holds for whatever is computed from the posterior.
        """
        if self.disagreement:
            return Reservation()
        if self.held_back:
            measured = self.measured_blocks is not None
            return Reservation(f"Only in part. {held_back_in_words(self.held_back, measured)}")
        wide = [one for one in self.regions_left_out if one.name and one.over_noise > WELL_KNOWN]
        if wide:
            return Reservation(f"Only in part. {wide[0].in_words}: where no map lies, the magnet "
                               "is known no better than its error bars say.")
        said = shared_in_words(self.shared_doubts, self.magnet.dimension == 2) or " ".join(
            self.table_doubts) or self.bent_iron or far_in_words(self.far_amplitudes)
        return Reservation(f"Only with care. {said}" if said else "")

    @property
    def _doubted(self) -> str:
        """Sentences about `doubts`, a factor of the readings, and readings that are not like the
        model, if model and readings disagree; nothing if there are none.
        """
        said = [doubts_in_words(self.doubts)]
        if self._conflict or self.doubts:
            said.append(self._unlike(~self.held_out, bool(self.doubts)))
        return " ".join(each for each in said if each)

    @cached_property
    def noise_ratio(self) -> float:
        """Variance that the update leaves of the training readings, over that of their noise.

        It is 1 on average if the noise is right, whatever the prior: of n readings an update
        explains as much as belongs to the parameters that it learns. The solver's error does not
        count as noise here. NaN if too few readings are left.
        """
        training = ~self.held_out
        count = float(training.sum()) - self.parameters_learnt
        if count < FEWEST_READINGS:
            return np.nan
        left = self.noise.subset(training).whiten(
            (self.readings - self.prediction_posterior.mean)[training])
        return float(left @ left) / count

    @property
    def solver_over_noise(self) -> float:
        """The solver's error over the noise of the training readings, both rms."""
        training = ~self.held_out
        return float(np.linalg.norm(self.response.error[training])
                     / np.linalg.norm(self.noise.sd[training]))

    @property
    def too_near(self) -> str:
        """A sentence if noise or prior are stated too large, else an empty string.

        Readings may be nearer than error bars that the solver makes: these are upper bounds.
        """
        chi2, readings = self.prior_conflict, float(np.sum(~self.held_out))
        chance, least = (gammainc(count / 2, count * least / 2) for count, least in (
            (readings, chi2), (FEWEST_READINGS, TOO_NEAR)))
        if chi2 < TOO_NEAR and chance < least and self.solver_over_noise < 1:
            return (f"The readings are {_times_nearer(chi2)} times nearer to the "
                    "model than their noise and the prior allow (chi² per reading is "
                    f"{chi2:.2g}, where 1 is expected): sigma_T, position_sd_m or prior is too "
                    f"large, so that error bars are too wide. {OWN_NOISE}")
        if self.noise_ratio < TOO_NEAR:
            return (f"The updated model is {_times_nearer(self.noise_ratio)} times nearer to the "
                    "readings than their noise allows: sigma_T or position_sd_m is too "
                    f"large, so that error bars are too wide. {OWN_NOISE}")
        return ""

    @property
    def held_out_conflict(self) -> str:
        """A sentence if held-out readings are far from their predictions, else nothing."""
        for part, words in ((HELD_OUT, ""), (HELD_OUT_MAP, " of the held-out map")):
            of_part = [score for score in self.scores if score.part == part]
            count = sum(score.readings for score in of_part)
            if not count:
                continue
            chi2 = sum(score.readings * float(score.chi2_posterior or 0.0)
                       for score in of_part) / count
            if chi2 > max(TOO_FAR, 1 + 5 * np.sqrt(2 / count)):
                unlike = self._unlike(np.array(self.parts) == part) if words else ""
                return (f"Held-out readings{words} are farther from their predictions than these "
                        f"and the noise allow (chi² per reading is {decimals(chi2)}, where 1 is "
                        "expected): sigma_T is too small, an effect is missing from the model, or "
                        f"these readings are not of this magnet.{unlike and f' {unlike}'}")
        return ""

    @property
    def common_factor(self) -> str:
        """A sentence if the training readings are not those of this magnet but for a factor, which
        all blocks would have to take; else nothing.
        """
        return self._unlike(~self.held_out) if any(
            one.name == ALL_BLOCKS for one in self.doubts) else ""

    def _unlike(self, chosen: NDArray[np.bool_], doubted: bool = True) -> str:
        """Say that chosen readings, by a mask (n,), are not like the field that the prior predicts
        or, if ``doubted``, a factor times it; nothing if they are neither.
        """
        # Size of readings, in units of what prior and noise make of a field that is zero, from
        # which they can be compared with the nominal field in shape.
        far_from_zero = 3.0
        both = self.readings[chosen], self.prediction_prior.mean[chosen]
        allowed = np.hypot(self.prediction_prior.sd, self.noise.sd)[chosen]
        far = np.linalg.norm(both[0]) > far_from_zero * np.linalg.norm(allowed)
        likeness = likeness_of(*both) if far else 1.0
        return factor_in_words(factor_of(*both), likeness) \
            if doubted or abs(likeness) < UNLIKE else ""

    @property
    def _conflict(self) -> str:
        """A sentence if prior, model and readings cannot all be right, else an empty string."""
        chi2 = self.prior_conflict
        if chi2 <= self.conflict_limit:
            return ""
        free = self.prior.sd > 0  # a missing block has no parameters to change
        change = np.abs(self.posterior.mean - self.prior.mean)[free] / self.prior.sd[free]
        return ("Prior, model and readings cannot all be right: chi² per reading is "
                f"{decimals(chi2)}, where 1 is expected and more than {self.conflict_limit:.2g} is "
                "rare, and the largest change of a block is "
                f"{float(change.max(initial=0.0)):.1f} prior standard deviations. An effect is "
                "missing from the model (geometry, position or unit of the readings, iron, ...), "
                "so its error bars are too small.")

    def relative_error(self, prediction: Prediction) -> Floats:
        """Return ``|measured - predicted| / |measured|`` (readings,); NaN for readings of 0."""
        measured = np.where(self.readings != 0, np.abs(self.readings), np.nan)
        return np.asarray(np.abs(self.readings - prediction.mean) / measured)

    def standardized(self, prediction: Prediction) -> Floats:
        """Return the standardized residuals (readings,) of a prediction.

        They are measured minus predicted, divided by the standard deviation of prediction, noise
        and solver together. The noise of a held-out reading may be correlated with that of training
        readings, for example of another component at the same point. Its expectation from the
        training readings is then subtracted from the residual.
        """
        result = (self.readings - prediction.mean) / np.hypot(prediction.sd, self.sigma)
        if self.errors.covariance[self.held_out][:, ~self.held_out].nnz:
            residual, noise, root = self._unseen(prediction, self.held_out)
            sd = np.concatenate([
                np.linalg.norm(root(np.arange(part.start, part.stop)), axis=1)
                for part in row_slices(len(residual), prediction.columns)])
            result[self.held_out] = residual / np.hypot(noise.sd, sd)
        return result

    def whitened(self, prediction: Prediction, chosen: NDArray[np.bool_]) -> Floats:
        """Return the residuals (chosen,) of some readings, whitened.

        The covariance is that of prediction, noise and solver together. The whitened residuals are
        independent and standard normal if model and noise are right and the readings were not used
        to update the model.
        """
        return whitened(*self._unseen(prediction, chosen), prediction.columns)

    def _unseen(
        self, prediction: Prediction, chosen: NDArray[np.bool_]
    ) -> tuple[Floats, NoiseCovariance, Callable[[Ints], Floats]]:
        """Return residuals, noise and prediction of some readings, given the other training ones.

        The noise of the chosen readings may be correlated with that of training readings. Its
        conditional expectation, a linear combination of the residuals of the latter, is subtracted
        from the residuals and from the prediction, and the noise is the conditional one. Only then
        are noise and prediction independent.

        Returns
        -------
        residuals : ndarray, shape (chosen,), in T
        noise : NoiseCovariance
        root : callable
            Rows of a root of the prediction's covariance, for indices of chosen readings.
        """
        seen = np.flatnonzero(~self.held_out & ~chosen)
        regression, noise = self.errors.conditional(chosen, seen)
        residual, index = self.readings - prediction.mean, np.flatnonzero(chosen)

        def root(rows: Ints) -> Floats:
            own, weights = prediction.root(index[rows]), regression[rows]
            if weights.nnz:
                needed = np.unique(weights.indices)
                own = own - weights[:, needed] @ prediction.root(seen[needed])
            return own

        return residual[chosen] - regression @ residual[seen], noise, root

    def _score(
        self, region: str, part: str, chosen: NDArray[np.bool_],
        errors: Mapping[str, tuple[Prediction, Floats, Floats]],
    ) -> RegionScore:
        """Return the score of the chosen readings.

        ``errors`` holds each prediction with its relative errors and standardized residuals.
        """
        figures: dict[str, Any] = {}
        for name, (prediction, relative, standardized) in errors.items():
            finite = relative[chosen & ~np.isnan(relative)]
            residuals = np.abs(standardized[chosen])
            unseen = part != TRAINING
            error = (self.readings - prediction.mean)[chosen]
            figures |= {
                f"rms_error_{name}_T": rms(error),
                f"median_relative_error_{name}": float(np.median(finite)) if len(finite) else None,
                f"rms_standardized_{name}": rms(residuals),
                f"coverage95_{name}": float(np.mean(residuals <= COVERAGE_Z)) if unseen else None,
                f"chi2_{name}": float(
                    np.mean(self.whitened(prediction, chosen) ** 2)) if unseen else None}
        return RegionScore(region=region, part=part, readings=int(chosen.sum()), **figures)


def _times_nearer(chi2: float) -> str:
    """Return how many times residuals are smaller than expected, as text."""
    return f"{1 / np.sqrt(max(chi2, 1e-300)):.3g}"
