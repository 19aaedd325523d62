"""The inference: from a magnet and a measured map to the posterior of its magnetizations."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachWarning, MeasurementError, PointsOutsideError, must_be
from halbach_fe.geometry.blocks import MagnetBlock, vector
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
from halbach_fe.response.block_variation import study_prior, with_variations
from halbach_fe.response.matrix import Response, response_matrix
from halbach_fe.response.nonlinear import newton_readings
from halbach_fe.solver.formulation_choice import choose_route, solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.stats import linear_gaussian
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.linear_gaussian import predict
from halbach_fe.stats.noise import NoiseCovariance
from halbach_fe.study.materials import MU_0

LINEAR_ENOUGH = 0.3
"""Error that the linearization of the iron may cause in a reading, relative to its error bar; a
larger error causes a warning."""

LEFT_OUT = 0.02
"""Relative change of a posterior variance (1 % of a standard deviation) that discarded information
may cause; a larger change causes a warning."""


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
        The measured map, see `halbach_fe.read_map`.
    session : Session
        Its folder receives the mesh, the run folders and the response matrix.
    blocks : BlockTable, optional
        Measured blocks, whose prior replaces the study's.
    prior : Gaussian, optional
        Prior of all parameters in A/m, which replaces those of the study and of ``blocks``.
    linearized_only : bool
        Skip the solve of the updated magnet that checks whether its iron is linear enough.
    validation_map : Dataset, optional
        Another map, which is predicted but does not update the model; see
        `halbach_fe.measurement.observation.study_for_validation_map`.

    Returns
    -------
    InferenceResult
        Prior and posterior of the magnetizations, and the readings that both predict.

    Raises
    ------
    StudyError
        If the study does not describe the noise of the readings.
    MeasurementError
        If a map or the blocks do not fit the study, or points of a map are not in air within the
        meshed region.
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
    study = magnet.study
    of_blocks = None if blocks is None else prior_from_blocks(magnet, blocks)
    observation, noise, readings, parts = _read_maps(magnet, data, validation_map)
    training = np.array(parts) == TRAINING
    regions = (ALL_READINGS,) * len(observation)
    if study.noise is not None and study.noise.regions:
        names = [region.name for region in study.noise.regions]
        regions = tuple(names[i] for i in noise_regions(
            study.noise, observation.positions[:, 2], observation.components))
    try:
        model = response_matrix(magnet, observation, session)
    except PointsOutsideError as error:
        raise MeasurementError(error.sentence(f"map of study {error.study}")) from None
    varying = len(model.parameters) - len(magnet.parameter_names)
    prior_used = prior or (with_variations(of_blocks.gaussian, varying) if of_blocks
                           else study_prior(magnet, varying))
    errors = noise.with_independent_errors(model.error)
    update = linear_gaussian.update(
        model.matrix, (readings - model.offset)[training], errors.subset(training), prior_used,
        np.flatnonzero(training))
    posterior = update.distribution
    if update.discarded_information > LEFT_OUT:
        warnings.warn(
            f"Study {study.name} has so many parameters and readings that some combinations of "
            "readings were discarded, which may change a posterior variance by a fraction of up to "
            f"{update.discarded_information:.1g}.",
            HalbachWarning, stacklevel=2)
    if magnet.is_nonlinear and not linearized_only:
        _check_linearization(magnet, observation, session, model, posterior.mean, errors.sd)
    return InferenceResult(
        magnet=magnet, observation=observation, readings=readings, noise=noise, parts=parts,
        regions=regions, response=model, prior=prior_used, posterior=posterior,
        prediction_prior=_predict(model, prior_used),
        prediction_posterior=_predict(model, posterior),
        prior_conflict=update.prior_conflict, parameters_learnt=update.parameters_learnt,
        log_evidence=update.log_evidence,
        kind="linearized" if magnet.is_nonlinear else "closed form",
        measured_blocks=of_blocks.count if of_blocks and not prior else None,
        left_out=update.discarded_information)


def observation_of(
    magnet: Magnet, data: xr.Dataset, blocks: BlockTable | None = None,
    validation_map: xr.Dataset | None = None,
) -> Observation:
    """Return the observation of all readings of `infer`, with the same checks of its inputs.

    The noise that uncertain positions cause is left out, because its computation is the slow part
    of reading a map.
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
    """Return the observation, noise, readings in T, and parts of a map and a validation map.

    The part of a reading is `TRAINING`, `HELD_OUT` or, in the validation map, `HELD_OUT_MAP`.
    """
    observation, noise, readings = _read_map(magnet, data,
                                             excluded_components(magnet.study, data.sizes["point"]))
    held_out = held_out_readings(magnet.study, observation)
    parts = tuple(np.where(held_out, HELD_OUT, TRAINING).tolist())
    if validation_map is not None:
        validation, validation_noise, validation_readings = _read_map(
            magnet.with_study(study_for_validation_map(magnet.study, validation_map)),
            validation_map, np.zeros((validation_map.sizes["point"], 3), bool), "held-out map")
        observation = concatenate(observation, validation)
        noise = noise.stacked_with(validation_noise)
        readings = np.concatenate([readings, validation_readings])
        parts += (HELD_OUT_MAP,) * len(validation)
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
    """Return the study's observation of a map, its noise, and its readings in T.

    ``left_out`` (n, 3) marks the components of the map that are not used.
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
    """Return the prediction of all readings from a distribution of the magnetizations in A/m."""
    mean, sd = predict(model.matrix, parameters)
    return Prediction(model.offset + mean, sd, lambda rows: model.matrix[rows] @ parameters.root,
                      parameters.root.shape[1])


def _check_linearization(
    magnet: Magnet, observation: Observation, session: Session, model: Response, mean: Floats,
    sigma: Floats,
) -> None:
    """Warn if the linearization of the iron changes readings of the posterior mean noticeably."""
    own = replace(session, folder=session.folder / "posterior")
    if choose_route(magnet, observation.points) == "moments":
        updated = Magnet(magnet.study, _with_magnetizations(magnet, mean))
        true = observation.apply(solve_nominal(updated, observation.points, own))
    else:
        true = newton_readings(magnet, observation, own, mean[None])[0]
    worst = float((np.abs(model.offset + model.matrix @ mean - true) / sigma).max())
    if worst > LINEAR_ENOUGH:
        warnings.warn(
            "The iron is linearized about the nominal magnet, which changes a reading of the "
            f"updated magnet by {worst:.2g} of its error bar: study {magnet.name} needs the "
            "non-linear posterior.", HalbachWarning, stacklevel=2)


def _with_magnetizations(magnet: Magnet, values: Floats) -> tuple[MagnetBlock, ...]:
    """Return the blocks of a magnet with magnetizations (parameters,) in A/m.

    The axes of an anisotropic permeability turn with them, by fractions of a degree.
    """
    blocks, size = [], magnet.dimension
    for block, magnetization in zip(magnet.blocks, values.reshape(-1, size), strict=True):
        remanence = MU_0 * block.recoil_tensor[:, :size] @ magnetization
        strength = float(np.linalg.norm(remanence))
        blocks.append(block if not strength else replace(
            block, remanence=strength, easy_axis=vector(remanence / strength)))
    return tuple(blocks)
