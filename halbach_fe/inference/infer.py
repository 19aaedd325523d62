"""From a study and a measured map to the updated magnet."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachWarning, MeasurementError, PointsOutsideError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.inference.result import (
    ALL_READINGS,
    HELD_OUT,
    HELD_OUT_MAP,
    TRAINING,
    InferenceResult,
    Prediction,
)
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.instrument import in_si_and_magnet_axes, remove_nonlinear_part
from halbach_fe.measurement.observation import (
    Observation,
    concatenate,
    excluded_components,
    held_out_readings,
    observe,
    study_for_validation_map,
)
from halbach_fe.measurement.reading_noise import noise_regions, reading_noise
from halbach_fe.response.matrix import Response, response_matrix
from halbach_fe.response.nonlinear import newton_readings
from halbach_fe.solver.session import Session
from halbach_fe.stats import linear_gaussian
from halbach_fe.stats.gaussian import Gaussian, nominal_prior
from halbach_fe.stats.linear_gaussian import predict
from halbach_fe.stats.noise import NoiseCovariance

LINEAR_ENOUGH = 0.3
"""Of the error bar: what linearizing the iron may move a reading without a word."""

LEFT_OUT = 0.02
"""Of a variance, 1 % of a standard deviation: what may be left out without a word."""


def infer(
    magnet: Magnet, data: xr.Dataset, session: Session, blocks: BlockTable | None = None,
    prior: Gaussian | None = None, linearized_only: bool = False,
    validation_map: xr.Dataset | None = None,
) -> InferenceResult:
    """Update the block magnetizations of a study with a measured map.

    Parameters
    ----------
    magnet : Magnet
    data : Dataset
        As `halbach_fe.measurement.field_map.read_map` returns it.
    session : Session
        Its folder receives the mesh, the run folders and the response matrix.
    blocks : BlockTable, optional
        Measured blocks, whose prior takes the place of the study's.
    prior : Gaussian, optional
        Of the parameters in A/m, in place of both.
    linearized_only : bool
        Do not solve the updated magnet to see whether linearizing its iron was good enough.
    validation_map : Dataset, optional
        Another map, which is only predicted; see `halbach_fe.measurement.observation.predicted_as`.

    Raises
    ------
    MeasurementError
        If a map or the blocks do not fit the study.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> result = hf.infer(magnet, hf.read_map("map.csv"), hf.Session.open("results"))
    >>> block = result.magnetizations.sel(parameter="r01s05.Mx")
    >>> bool(block["posterior_sd"] < block["prior_sd"])
    True
    """
    study = magnet.study
    of_blocks = None if blocks is None else prior_from_blocks(magnet, blocks)
    observation, noise, readings, parts = _read_maps(magnet, data, validation_map)
    keep = np.array(parts) != TRAINING
    regions = (ALL_READINGS,) * len(observation)
    if study.noise is not None and study.noise.regions:
        names = [region.name for region in study.noise.regions]
        regions = tuple(names[i] for i in noise_regions(
            study.noise, observation.positions[:, 2], observation.components))
    try:
        model = response_matrix(magnet, observation, session)
    except PointsOutsideError as error:
        raise MeasurementError(error.sentence(f"map of study {error.study}")) from None
    before = prior or (of_blocks.gaussian if of_blocks else nominal_prior(
        model.nominal, study.dimension, study.prior.magnitude_sd, study.prior.direction_sd_deg,
        study.prior.common_mode_sd))
    errors = noise.with_independent_errors(model.error)
    learnt = linear_gaussian.update(
        model.matrix, (readings - model.offset)[~keep], errors.subset(~keep), before,
        np.flatnonzero(~keep))
    after = learnt.distribution
    if learnt.discarded_information > LEFT_OUT:
        warnings.warn(
            f"Of so many parameters and readings of study {study.name} some combinations were left "
            f"out, which together may change a variance by {learnt.discarded_information:.1g} of "
            "itself.",
            HalbachWarning, stacklevel=2)
    if magnet.is_nonlinear and not linearized_only:
        _check_linearization(magnet, observation, session, model, after.mean, errors.sd)
    return InferenceResult(
        magnet=magnet, observation=observation, readings=readings, noise=noise, parts=parts,
        regions=regions, response=model, prior=before, posterior=after,
        prediction_prior=_predict(model, before), prediction_posterior=_predict(model, after),
        prior_conflict=learnt.prior_conflict, parameters_learnt=learnt.parameters_learnt,
        log_evidence=learnt.log_evidence,
        kind="linearized" if magnet.is_nonlinear else "closed form",
        measured_blocks=of_blocks.count if of_blocks and not prior else None,
        left_out=learnt.discarded_information)


def observation_of(
    magnet: Magnet, data: xr.Dataset, blocks: BlockTable | None = None,
    validation_map: xr.Dataset | None = None,
) -> Observation:
    """What `infer` would update with and predict, its inputs checked as there.

    What uncertain positions add to the noise, the slow part of reading a map, is left out.
    """
    if blocks is not None:
        prior_from_blocks(magnet, blocks)
    noise = magnet.study.noise
    if noise is not None:
        magnet = magnet.with_(noise=noise.with_(position_sd_m=None) if noise.regions else None)
    return _read_maps(magnet, data, validation_map)[0]


def _read_maps(
    magnet: Magnet, data: xr.Dataset, validation_map: xr.Dataset | None
) -> tuple[Observation, NoiseCovariance, Floats, tuple[str, ...]]:
    """A map, and one that is only predicted: with noise, readings in T, and the part of each."""
    observation, noise, readings = _read_map(magnet, data,
                                             excluded_components(magnet.study, data.sizes["point"]))
    keep = held_out_readings(magnet.study, observation)
    parts = tuple(np.where(keep, HELD_OUT, TRAINING).tolist())
    if validation_map is not None:
        other, its_noise, its_readings = _read_map(
            magnet.with_study(study_for_validation_map(magnet.study, validation_map)),
            validation_map, np.zeros((validation_map.sizes["point"], 3), bool), "held-out map")
        observation, noise = concatenate(observation, other), noise.stacked_with(its_noise)
        readings = np.concatenate([readings, its_readings])
        parts += (HELD_OUT_MAP,) * len(other)
    heights = observation.points[:, 2]
    if magnet.dimension == 2 and np.ptp(heights) > 0:
        raise MeasurementError(must_be(
            "points", "map", "in one plane for a 2D study",
            f"z from {heights.min():g} to {heights.max():g} m",
            "Use a 3D study, or one circle of the map."))
    return observation, noise, readings, parts


def _read_map(
    magnet: Magnet, data: xr.Dataset, left_out: NDArray[np.bool_], where: str = "map"
) -> tuple[Observation, NoiseCovariance, Floats]:
    """A map as the study observes it but for components (n, 3) that are left out, with its noise
    and its readings in T.
    """
    data = in_si_and_magnet_axes(magnet.study.instrument, data)
    observation = observe(
        magnet.study, points_of(data), ~np.isnan(data["B_T"].values) & ~left_out, where)
    inside = magnet.contains(observation.points)
    if inside.any():
        first = int(np.argmax(inside))
        x, y, z = observation.points[first]
        sensors = len(inside) // data.sizes["point"]
        raise MeasurementError(must_be(
            f"reading {first // sensors + 1}", where, "at a point in air",
            f"({x:g}, {y:g}, {z:g}) m, inside magnet or iron "
            f"({inside.reshape(-1, sensors).any(axis=1).sum()} such readings)",
            "Check the study's radii and the map's axes and units."))
    return (observation, reading_noise(magnet, observation, data),
            observation.read(np.nan_to_num(remove_nonlinear_part(magnet.study.instrument, data))))


def _predict(model: Response, parameters: Gaussian) -> Prediction:
    mean, sd = predict(model.matrix, parameters)
    return Prediction(model.offset + mean, sd, lambda rows: model.matrix[rows] @ parameters.root,
                      parameters.root.shape[1])


def _check_linearization(
    magnet: Magnet, observation: Observation, session: Session, model: Response, mean: Floats,
    sigma: Floats,
) -> None:
    """Warn if iron is so far from linear that the posterior's readings show it."""
    folder = replace(session, folder=session.folder / "posterior")
    true = newton_readings(magnet, observation, folder, mean[None])[0]
    worst = float((np.abs(model.offset + model.matrix @ mean - true) / sigma).max())
    if worst > LINEAR_ENOUGH:
        warnings.warn(
            f"The iron is linearized about the nominal magnet, which moves a reading of the updated"
            f" one by {worst:.2g} of its error bar: study {magnet.name} needs the non-linear "
            "posterior.", HalbachWarning, stacklevel=2)
