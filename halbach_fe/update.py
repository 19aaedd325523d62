"""From a study and a measured map to the updated magnet: the inference, and how well it predicts.

Readings are split into those that update the model and those held out; both are predicted by the
prior and by the posterior, with error bars, and compared region by region.
"""

from __future__ import annotations

import csv
import io
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy.sparse as sparse
import xarray as xr
from numpy.typing import NDArray

from halbach_fe import foreign
from halbach_fe.block_table import BlockTable
from halbach_fe.blocks import Floats, Ints, blocks_of, points_in_material
from halbach_fe.errors import HalbachWarning, MeasurementError, PointsOutsideError, must_be
from halbach_fe.field_map import atomic, points_of, write_hdf5
from halbach_fe.inference import linear
from halbach_fe.inference.linear import parts_of, predict, whitened
from halbach_fe.inference.noise import Noise
from halbach_fe.inference.prior import Gaussian, Root, beside, block_prior, entries
from halbach_fe.instrument import as_read, without_remainder
from halbach_fe.measured_prior import prior_from_blocks
from halbach_fe.nonlinear import newton_readings
from halbach_fe.observation import (
    Observation,
    excluded,
    held_out,
    noise_regions,
    observe,
    predicted_as,
    reading_noise,
    together,
)
from halbach_fe.response import Response, response
from halbach_fe.solve import Workshop
from halbach_fe.study import Study, is_nonlinear

ALL_READINGS = "all"
"""The one region of a study without noise regions."""

TRAINING, HELD_OUT, HELD_OUT_MAP = "training", "held out", "held-out map"
LINEAR_ENOUGH = 0.3
"""Of the error bar: what linearizing the iron may move a reading without a word."""

LEFT_OUT = 0.02
"""Of a variance, 1 % of a standard deviation: what may be left out without a word."""

WRITTEN_COVARIANCE = 2000
"""Parameters, at most, whose covariance is written too: 32 MB."""

COVERAGE_Z = 1.959964
"""Half width of a central 95 % band in standard deviations."""


@dataclass(frozen=True)
class Prediction:
    """Readings as a model foretells them, without noise.

    Attributes
    ----------
    mean, sd : ndarray, shape (readings,), in T
    root : callable
        Indices (c,) of readings to these rows (c, columns) of a root of their covariance, in T.
    columns : int
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
class Update:
    """A study, a map, and what the one says about the other.

    ``parts`` and ``regions`` are those of each reading: training, held out, or of a map that is
    only predicted; and the noise region. ``measured_blocks`` is how many blocks the prior was
    measured of; None if it is the study's. ``left_out`` is that of
    `halbach_fe.inference.linear.LinearPosterior`.
    """

    study: Study
    observation: Observation
    readings: Floats
    noise: Noise
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

    @cached_property
    def held_out(self) -> NDArray[np.bool_]:
        """Which readings (readings,) the update has not seen."""
        return np.array(self.parts) != TRAINING

    @cached_property
    def errors(self) -> Noise:
        """What readings may differ by from the model: their noise and the solver's error."""
        return self.noise.plus(self.response.error)

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
                for part in parts_of(len(residual), prediction.columns)])
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
    ) -> tuple[Floats, Noise, Callable[[Ints], Floats]]:
        """Residuals of some readings, their noise, and rows of a root of the prediction's
        covariance; of what is left of each when all that the noise of other, training readings
        foretells is taken off. Only then are noise and prediction independent.
        """
        seen = np.flatnonzero(~self.held_out & ~chosen)
        told, noise = self.errors.given(chosen, seen)
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


def infer(
    study: Study, data: xr.Dataset, workshop: Workshop, blocks: BlockTable | None = None,
    prior: Gaussian | None = None, linearized_only: bool = False, unseen: xr.Dataset | None = None,
) -> Update:
    """Update the block magnetizations of a study with a measured map.

    Parameters
    ----------
    study : Study
    data : Dataset
        As `halbach_fe.field_map.read_map` returns it.
    workshop : Workshop
        Its folder receives the mesh, the run folders and the response matrix.
    blocks : BlockTable, optional
        Measured blocks, whose prior takes the place of the study's.
    prior : Gaussian, optional
        Of the parameters in A/m, in place of both.
    linearized_only : bool
        Do not solve the updated magnet to see whether linearizing its iron was good enough.
    unseen : Dataset, optional
        Another map, which is only predicted; see `halbach_fe.observation.predicted_as`.

    Raises
    ------
    MeasurementError
        If a map or the blocks do not fit the study.
    """
    of_blocks = None if blocks is None else prior_from_blocks(study, blocks)
    observation, noise, readings, parts = _read(study, data, unseen)
    keep = np.array(parts) != TRAINING
    regions = (ALL_READINGS,) * len(observation)
    if study.noise is not None and study.noise.regions:
        names = [region.name for region in study.noise.regions]
        regions = tuple(names[i] for i in noise_regions(
            study.noise, observation.positions[:, 2], observation.components))
    try:
        model = response(study, observation, workshop)
    except PointsOutsideError as error:
        raise MeasurementError(str(error).replace("`observation.positions`", "map")) from None
    before = prior or (of_blocks.gaussian if of_blocks else block_prior(
        model.nominal, study.dimension, study.prior.magnitude_sd, study.prior.direction_sd_deg,
        study.prior.common_mode_sd))
    errors = noise.plus(model.error)
    learnt = linear.update(
        model.matrix, (readings - model.offset)[~keep], errors.part(~keep), before,
        np.flatnonzero(~keep))
    after = learnt.distribution
    if learnt.left_out > LEFT_OUT:
        warnings.warn(
            f"Of so many parameters and readings of study {study.name} some combinations were left "
            f"out, which together may change a variance by {learnt.left_out:.1g} of itself.",
            HalbachWarning, stacklevel=2)
    if is_nonlinear(study) and not linearized_only:
        _check_linearization(study, observation, workshop, model, after.mean, errors.sd)
    return Update(
        study=study, observation=observation, readings=readings, noise=noise, parts=parts,
        regions=regions, response=model, prior=before, posterior=after,
        prediction_prior=_predict(model, before), prediction_posterior=_predict(model, after),
        prior_conflict=learnt.conflict, parameters_learnt=learnt.learnt,
        log_evidence=learnt.log_evidence,
        kind="linearized" if is_nonlinear(study) else "closed form",
        measured_blocks=of_blocks.count if of_blocks and not prior else None,
        left_out=learnt.left_out)


def observed(
    study: Study, data: xr.Dataset, blocks: BlockTable | None = None,
    unseen: xr.Dataset | None = None,
) -> Observation:
    """What `infer` would update with and predict, its inputs checked as there.

    What uncertain positions add to the noise, the slow part of reading a map, is left out.
    """
    if blocks is not None:
        prior_from_blocks(study, blocks)
    if study.noise is not None:
        study = study.model_copy(update={
            "noise": study.noise.model_copy(update={"position_sd_m": None})})
    return _read(study, data, unseen)[0]


def _read(
    study: Study, data: xr.Dataset, unseen: xr.Dataset | None
) -> tuple[Observation, Noise, Floats, tuple[str, ...]]:
    """A map, and one that is only predicted: with noise, readings in T, and the part of each."""
    observation, noise, readings = _measured(study, data, excluded(study, data.sizes["point"]))
    keep = held_out(study, observation)
    parts = tuple(np.where(keep, HELD_OUT, TRAINING).tolist())
    if unseen is not None:
        try:
            other, its_noise, its_readings = _measured(
                predicted_as(study, unseen), unseen, np.zeros((unseen.sizes["point"], 3), bool))
        except MeasurementError as error:
            raise MeasurementError(
                str(error).replace(" of map must", " of held-out map must")) from None
        observation, noise = together(observation, other), noise.beside(its_noise)
        readings = np.concatenate([readings, its_readings])
        parts += (HELD_OUT_MAP,) * len(other)
    heights = observation.points[:, 2]
    if study.dimension == 2 and np.ptp(heights) > 0:
        raise MeasurementError(must_be(
            "points", "map", "in one plane for a 2D study",
            f"z from {heights.min():g} to {heights.max():g} m",
            "Use a 3D study, or one circle of the map."))
    return observation, noise, readings, parts


def _measured(
    study: Study, data: xr.Dataset, left_out: NDArray[np.bool_]
) -> tuple[Observation, Noise, Floats]:
    """A map as the study observes it but for components (n, 3) that are left out, with its noise
    and its readings in T.
    """
    data = as_read(study.instrument, data)
    observation = observe(
        study, points_of(data), ~np.isnan(data["B_T"].values) & ~left_out)
    inside = points_in_material(study, observation.points)
    if inside.any():
        first = int(np.argmax(inside))
        x, y, z = observation.points[first]
        sensors = len(inside) // data.sizes["point"]
        raise MeasurementError(must_be(
            f"reading {first // sensors + 1}", "map", "at a point in air",
            f"({x:g}, {y:g}, {z:g}) m, inside magnet or iron "
            f"({inside.reshape(-1, sensors).any(axis=1).sum()} such readings)",
            "Check the study's radii and the map's axes and units."))
    return (observation, reading_noise(study, observation, data),
            observation.read(np.nan_to_num(without_remainder(study.instrument, data))))


def _predict(model: Response, parameters: Gaussian) -> Prediction:
    mean, sd = predict(model.matrix, parameters)
    return Prediction(model.offset + mean, sd, lambda rows: model.matrix[rows] @ parameters.root,
                      parameters.root.shape[1])


def _check_linearization(
    study: Study, observation: Observation, workshop: Workshop, model: Response, mean: Floats,
    sigma: Floats,
) -> None:
    """Warn if iron is so far from linear that the posterior's readings show it."""
    folder = replace(workshop, folder=workshop.folder / "posterior")
    true = newton_readings(study, observation, folder, mean[None])[0]
    worst = float((np.abs(model.offset + model.matrix @ mean - true) / sigma).max())
    if worst > LINEAR_ENOUGH:
        warnings.warn(
            f"The iron is linearized about the nominal magnet, which moves a reading of the updated"
            f" one by {worst:.2g} of its error bar: study {study.name} needs the non-linear "
            "posterior.", HalbachWarning, stacklevel=2)


def write_update(update: Update, folder: Path) -> None:
    """Write posterior.h5, prediction.csv and summary.json."""
    parameters = list(update.response.parameters)
    labels = {"reading": list(update.observation.labels)}
    magnetization = xr.Dataset(
        {name: ("parameter", values, {"units": "A/m"})
         for name, values in (
             ("nominal", update.response.nominal),
             ("prior_mean", update.prior.mean), ("prior_sd", update.prior.sd),
             ("posterior_mean", update.posterior.mean), ("posterior_sd", update.posterior.sd))},
        coords={"parameter": parameters}, attrs={"study": update.study.model_dump_json()})
    known = {"prior": update.prior, "posterior": update.posterior}
    for name, one in known.items():
        magnetization.update(_stored_root(name, one, update.prior))
        if len(parameters) <= WRITTEN_COVARIANCE:
            magnetization[f"{name}_covariance"] = (("parameter", "parameter_2"), one.covariance,
                                                   {"units": "A2/m2"})
    write_hdf5(magnetization, folder / "posterior.h5")
    x, y, z = update.observation.positions.T
    columns = {
        "label": np.array(labels["reading"]), "x_m": x, "y_m": y, "z_m": z,
        "region": np.array(update.regions), "held_out": update.held_out.astype(int),
        "part": np.array(update.parts), "measured_T": update.readings, "sigma_T": update.noise.sd,
        "solver_error_T": update.response.error,
        "prior_mean_T": update.prediction_prior.mean, "prior_sd_T": update.prediction_prior.sd,
        "posterior_mean_T": update.prediction_posterior.mean,
        "posterior_sd_T": update.prediction_posterior.sd,
        "standardized_residual_prior": update.standardized(update.prediction_prior),
        "standardized_residual": update.standardized(update.prediction_posterior)}
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    write_text(folder / "prediction.csv", table.getvalue())
    text = json.dumps(summary(update), indent=1, allow_nan=False)
    write_text(folder / "summary.json", text + "\n")


def read_posterior(study: Study, path: Path) -> dict[str, Gaussian]:
    """Prior and posterior of the magnetizations in A/m, by these names, from a posterior.h5.

    Raises
    ------
    MeasurementError
        If it is none, or not of this study's magnet.
    """
    nominal = np.concatenate([block.magnetization[:study.dimension] for block in blocks_of(study)])
    found: dict[str, Gaussian] = {}
    try:
        data = foreign.dataset(path)
        own = foreign.numbers(data["nominal"], data["nominal"].shape)
        for name in ("prior", "posterior"):
            found[name] = Gaussian(foreign.numbers(data[f"{name}_mean"], own.shape),
                                   _read_root(data, name, found.get("prior"), len(own)))
    except (OSError, KeyError, ValueError, TypeError):
        raise MeasurementError(must_be(
            "--posterior", str(path), "a posterior.h5 that halbach-fe infer wrote",
            "none that can be read")) from None
    if own.shape != nominal.shape or not np.allclose(own, nominal, rtol=1e-9, atol=1e-6):
        raise MeasurementError(must_be(
            "--posterior", str(path), f"that of the magnet of study {study.name}",
            "that of another nominal magnet", "Use the study that was inferred."))
    return found


def _stored_root(name: str, one: Gaussian, prior: Gaussian) -> dict[str, Any]:
    """Variables of the root of a distribution's covariance: its rows as a sparse matrix, or what
    the readings left of the prior's, see `Root`.
    """
    if isinstance(one.root, Root) and one is not prior and one.root.outer is entries(prior.root):
        return {f"{name}_directions": (("coordinate", "direction"), one.root.directions),
                f"{name}_left": ("direction", one.root.left)}
    rows = sparse.csr_array(entries(one.root))
    return {f"{name}_root": (f"{name}_entry", rows.data, {"units": "A/m"}),
            f"{name}_root_column": (f"{name}_entry", rows.indices),
            f"{name}_root_row_start": (f"{name}_row", rows.indptr, {"columns": rows.shape[1]})}


def _read_root(
    data: xr.Dataset, name: str, prior: Gaussian | None, size: int
) -> Floats | Root:
    """The root with ``size`` rows; KeyError, ValueError or TypeError if what is stored is none."""
    if f"{name}_left" in data and prior is not None:
        left = data[f"{name}_left"]
        return Root(entries(prior.root), foreign.numbers(
            data[f"{name}_directions"], (prior.root.shape[1], len(left))),
            foreign.numbers(left, left.shape))
    start, values = data[f"{name}_root_row_start"], data[f"{name}_root"]
    rows = sparse.csr_array(
        (foreign.numbers(values, values.shape), _whole(data[f"{name}_root_column"]), _whole(start)),
        shape=(size, int(start.attrs["columns"])))
    rows.check_format()  # scipy would follow indices anywhere
    return beside(rows)


def _whole(data: xr.DataArray) -> Ints:
    values = foreign.numbers(data, data.shape)
    if (np.abs(values) > np.iinfo(np.int32).max).any() or (values % 1 != 0).any():
        raise ValueError("it must be whole numbers")
    return values.astype(np.int64)


def summary(update: Update) -> dict[str, object]:
    """What a script wants to know of an update."""
    shift = update.posterior.mean - update.prior.mean
    return {
        "study": update.study.name,
        "readings": len(update.readings),
        "held_out": int(update.held_out.sum()),
        "parameters": len(update.response.parameters),
        "posterior": update.kind,
        "measured_blocks": update.measured_blocks,
        "superposition_error": update.response.superposition_error,
        "largest_solver_error_T": float(update.response.error.max()),
        "largest_solver_error_over_noise": float((update.response.error / update.noise.sd).max()),
        "prior_conflict": update.prior_conflict,
        "prior_conflict_limit": update.conflict_limit,
        "parameters_learnt": update.parameters_learnt,
        "log_evidence": update.log_evidence,
        "information_left_out": update.left_out,
        "contraction_by_block": linear.contraction(
            update.prior, update.posterior, update.study.dimension).round(6).tolist(),
        "largest_shift_A_per_m": float(np.abs(shift).max()),
        "common_shift": float(shift @ update.prior.mean / (update.prior.mean @ update.prior.mean)),
        "scores": [asdict(score) for score in update.scores],
    }


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
