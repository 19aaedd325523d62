"""The result of an inference, and scores of how well it predicts the readings.

Some readings (training) update the model, the others are held out. Prior and posterior predict all
of them, with error bars, and the predictions are compared with the readings region by region.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.notebook import ShownInNotebook
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import (
    Observation,
)
from halbach_fe.response.matrix import Response
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.linear_gaussian import row_slices, whitened
from halbach_fe.stats.noise import NoiseCovariance
from halbach_fe.study.model import Study

ALL_READINGS = "all"
"""Name of the only region of a study without noise regions."""

TRAINING, HELD_OUT, HELD_OUT_MAP = "training", "held out", "held-out map"
"""The parts of the readings: those that update the model, those of the same map that are held out,
and those of a validation map."""

COVERAGE_Z = 1.959964
"""Half width of a central 95 % band in standard deviations."""


PREDICTION_COLUMNS = (
    "label", "x_m", "y_m", "z_m", "region", "held_out", "part", "measured_T", "sigma_T",
    "solver_error_T", "prior_mean_T", "prior_sd_T", "posterior_mean_T", "posterior_sd_T",
    "standardized_residual_prior", "standardized_residual")
"""Columns of prediction.csv, one row per reading."""


@dataclass(frozen=True)
class Prediction:
    """The distribution of the readings that a model predicts, without their noise.

    Attributes
    ----------
    mean, sd : ndarray, shape (readings,), in T
    root : callable
        Returns the rows (c, columns), in T, of a root of the covariance for indices (c,) of
        readings.
    columns : int
        Number of columns of the root.
    """

    mean: Floats
    sd: Floats
    root: Callable[[Ints], Floats]
    columns: int


@dataclass(frozen=True)
class RegionScore:
    """How prior and posterior predict the readings of one region.

    Relative errors are ``|measured - predicted| / |measured|``, of readings that are not 0;
    standardized residuals are those over the standard deviation of prediction and noise, coverage
    the fraction within their 95 % band; chi2 is per reading, by the full covariance of both.
    Coverage and chi2 are None for training readings, which the posterior has seen, and whose
    standardized residuals by it are therefore smaller than 1.
    """

    region: str
    part: str
    readings: int
    median_relative_error_prior: float | None
    median_relative_error_posterior: float | None
    rms_standardized_prior: float
    rms_standardized_posterior: float
    coverage95_prior: float | None
    coverage95_posterior: float | None
    chi2_prior: float | None
    chi2_posterior: float | None


@dataclass(frozen=True)
class InferenceResult(ShownInNotebook):
    """A study, a map, and what the one says about the other.

    ``parts`` and ``regions`` are those of each reading: training, held out, or of a map that is
    only predicted; and the noise region. ``measured_blocks`` is how many blocks the prior was
    measured of; None if it is the study's. ``left_out`` is that of
    `halbach_fe.stats.linear_gaussian.LinearPosterior`.
    """

    magnet: Magnet
    observation: Observation
    readings: Floats
    noise: NoiseCovariance
    parts: tuple[str, ...]
    regions: tuple[str, ...]
    response: Response
    prior: Gaussian
    posterior: Gaussian
    prediction_prior: Prediction
    prediction_posterior: Prediction
    prior_conflict: float
    parameters_learnt: float
    log_evidence: float
    kind: Literal["closed form", "linearized", "samples"]
    measured_blocks: int | None = None
    left_out: float = 0.0

    @property
    def study(self) -> Study:
        """The study that was updated."""
        return self.magnet.study

    @property
    def magnetizations(self) -> xr.Dataset:
        """Block magnetizations in A/m by parameter: nominal, and mean and standard deviation of
        prior and posterior.
        """
        values = {
            "nominal": self.response.nominal, "prior_mean": self.prior.mean,
            "prior_sd": self.prior.sd, "posterior_mean": self.posterior.mean,
            "posterior_sd": self.posterior.sd}
        return xr.Dataset({name: ("parameter", value, {"units": "A/m"})
                           for name, value in values.items()},
                          coords={"parameter": list(self.response.parameters)})

    @property
    def predictions(self) -> xr.Dataset:
        """All readings with their noise, and what prior and posterior predict of them: the columns
        of prediction.csv, by reading.
        """
        prior, posterior = self.prediction_prior, self.prediction_posterior
        columns = dict(zip(PREDICTION_COLUMNS, (
            np.array(self.observation.labels), *self.observation.positions.T,
            np.array(self.regions), self.held_out.astype(int), np.array(self.parts),
            self.readings, self.noise.sd, self.response.error, prior.mean, prior.sd,
            posterior.mean, posterior.sd, self.standardized(prior), self.standardized(posterior)),
            strict=True))
        return xr.Dataset({name: ("reading", value) for name, value in columns.items()})

    @cached_property
    def held_out(self) -> NDArray[np.bool_]:
        """Which readings (readings,) the update has not seen."""
        return np.array(self.parts) != TRAINING

    @cached_property
    def errors(self) -> NoiseCovariance:
        """What readings may differ by from the model: their noise and the solver's error."""
        return self.noise.with_independent_errors(self.response.error)

    @property
    def sigma(self) -> Floats:
        """Standard deviations (readings,) of `errors`, in T."""
        return self.errors.sd

    @cached_property
    def scores(self) -> tuple[RegionScore, ...]:
        """Scores by region, and by part."""
        noise = self.study.noise
        names = [region.name for region in noise.regions] if noise else []
        predictions = {"prior": self.prediction_prior, "posterior": self.prediction_posterior}
        known = {name: (one, self.relative_error(one), self.standardized(one))
                 for name, one in predictions.items()}
        return tuple(
            self._score(region, part, chosen, known)
            for region in dict.fromkeys(names or [ALL_READINGS])
            for part in (TRAINING, HELD_OUT, HELD_OUT_MAP)
            if (chosen := self.chosen(region, part)).any())

    def chosen(self, region: str, part: str) -> NDArray[np.bool_]:
        """Which readings (readings,) are in a region and a part."""
        return (np.array(self.regions) == region) & (np.array(self.parts) == part)

    @property
    def conflict_limit(self) -> float:
        """`prior_conflict` beyond which chance is no explanation: five standard deviations."""
        return 1 + 5 * float(np.sqrt(2 / np.sum(~self.held_out)))

    def relative_error(self, prediction: Prediction) -> Floats:
        """``|measured - predicted| / |measured|`` of every reading; NaN for one of exactly 0."""
        measured = np.where(self.readings != 0, np.abs(self.readings), np.nan)
        return np.asarray(np.abs(self.readings - prediction.mean) / measured)

    def standardized(self, prediction: Prediction) -> Floats:
        """Measured less predicted over the standard deviation of prediction, noise and solver
        together, (readings,).

        Of held-out readings whose noise is correlated with that of training readings, as that of
        another component of the same point, with what the latter foretell taken off.
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
        """Residuals (chosen,) of some readings, whitened by the covariance of prediction, noise
        and solver together: independent and standard normal if all is well and the posterior has
        not seen them.
        """
        return whitened(*self._unseen(prediction, chosen), prediction.columns)

    def _unseen(
        self, prediction: Prediction, chosen: NDArray[np.bool_]
    ) -> tuple[Floats, NoiseCovariance, Callable[[Ints], Floats]]:
        """Residuals of some readings, their noise, and rows of a root of the prediction's
        covariance; of what is left of each when all that the noise of other, training readings
        foretells is taken off. Only then are noise and prediction independent.
        """
        seen = np.flatnonzero(~self.held_out & ~chosen)
        told, noise = self.errors.conditional(chosen, seen)
        residual, index = self.readings - prediction.mean, np.flatnonzero(chosen)

        def root(rows: Ints) -> Floats:
            own, from_ = prediction.root(index[rows]), told[rows]
            if from_.nnz:
                needed = np.unique(from_.indices)
                own = own - from_[:, needed] @ prediction.root(seen[needed])
            return own

        return residual[chosen] - told @ residual[seen], noise, root

    def _score(
        self, region: str, part: str, chosen: NDArray[np.bool_],
        known: Mapping[str, tuple[Prediction, Floats, Floats]],
    ) -> RegionScore:
        """Score of some readings, from each prediction's relative and standardized errors."""
        figures: dict[str, Any] = {}
        for name, (prediction, relative, standardized) in known.items():
            errors = relative[chosen & ~np.isnan(relative)]
            residuals = np.abs(standardized[chosen])
            unseen = part != TRAINING
            figures |= {
                f"median_relative_error_{name}": float(np.median(errors)) if len(errors) else None,
                f"rms_standardized_{name}": float(np.sqrt(np.mean(residuals**2))),
                f"coverage95_{name}": float(np.mean(residuals <= COVERAGE_Z)) if unseen else None,
                f"chi2_{name}": float(
                    np.mean(self.whitened(prediction, chosen) ** 2)) if unseen else None}
        return RegionScore(region=region, part=part, readings=int(chosen.sum()), **figures)
