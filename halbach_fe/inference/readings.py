"""The readings of all maps of a campaign, stacked: values, noise, and how B becomes a reading."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachWarning, MeasurementError, must_be
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.result import ALL_READINGS, HELD_OUT, HELD_OUT_MAP, TRAINING
from halbach_fe.measurement.campaign import SAME_PLACE_M, SAME_READING, SHARED, Map, repeated
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.instrument import in_si_and_magnet_axes, remove_nonlinear_part
from halbach_fe.measurement.observation import (
    Observation,
    concatenate,
    excluded_components,
    held_out_readings,
    observe,
)
from halbach_fe.measurement.reading_noise import noise_regions, reading_noise
from halbach_fe.stats.noise import NoiseCovariance
from halbach_fe.study.model import Study
from halbach_fe.study.types import MIN_SIGMA_T

BY_CHANCE = 0.15
"""Share of a held-out map's readings that may equal those that update the model: more than readings
at the same points do by chance."""

Noises = dict[str, NoiseCovariance]
"""Noise of the readings of a map, by its name."""


@dataclass(frozen=True)
class Readings:
    """The readings of some maps, one map after the other.

    Attributes
    ----------
    observation : Observation
    values : ndarray, shape (readings,), in T
    noise : NoiseCovariance
    parts, regions, maps : tuple of str
        Part (`TRAINING`, `HELD_OUT` or `HELD_OUT_MAP`), noise region and map of each reading.
    """

    observation: Observation
    values: Floats
    noise: NoiseCovariance
    parts: tuple[str, ...]
    regions: tuple[str, ...]
    maps: tuple[str, ...]

    @property
    def training(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Mask (readings,) of the readings that update the model."""
        return np.array(self.parts) == TRAINING


def read_campaign(
    magnet: Magnet, maps: Sequence[Map], known: Noises | None = None,
    estimated: Sequence[MagnetBlock] | None = None,
) -> Readings:
    """Return the readings of all maps, by the instrument of each.

    Parameters
    ----------
    magnet : Magnet
    maps : sequence of Map
    known : dict, optional
        Noise of the same maps with little other poses, which is not computed again; what is
        computed is added.
    estimated : sequence of MagnetBlock, optional
        Blocks with the magnetizations as they are estimated, in whose gradient uncertain positions
        make noise; by default the nominal ones.

    Raises
    ------
    StudyError
        If neither study nor map state the noise.
    MeasurementError
        If a map does not fit the study.
    """
    several = sum(not one.is_validation for one in maps) > 1
    noises = {} if known is None else known
    blocks = magnet.blocks if estimated is None else estimated
    found = [_read(magnet, one, several, noises, blocks) for one in maps]
    if magnet.dimension == 2:
        heights = np.concatenate([each.observation.points[:, 2] for each in found])
        _check_plane(heights, "map")
    return reduce(_stacked, found)


def _check_plane(heights: Floats, where: str) -> None:
    """Raise a MeasurementError if the points of a 2D study are at several heights."""
    if np.ptp(heights) > 0:
        raise MeasurementError(must_be(
            "points", where, "in one plane for a 2D study",
            f"z from {heights.min():g} to {heights.max():g} m",
            "Use a 3D study, or one circle of the map."))


def check_validation_map(readings: Readings, study: Study) -> None:
    """Refuse a held-out map of readings that update the model: it is no test of it.

    Raises
    ------
    MeasurementError
        If many of its readings are in the map that updates the model, unless the study holds
        all of these out.

    Warns
    -----
    HalbachWarning
        If some are.
    """
    observation, parts = readings.observation, np.array(readings.parts)
    noise = [region.sigma_T for region in study.noise.regions] if study.noise else []
    sigma = min([float(readings.noise.sd.min()), *noise])  # without that of positions, if stated
    numbers = np.unique(observation.labels, return_inverse=True)[1]
    rows = np.column_stack([numbers, observation.positions, readings.values])
    tolerance = np.array([0.5, *[SAME_PLACE_M] * 3, max(SAME_READING * sigma, MIN_SIGMA_T)])
    own = rows[parts == HELD_OUT_MAP]
    shared = int(repeated(own, rows[parts == TRAINING], tolerance).sum())
    if shared <= BY_CHANCE * len(own):
        return
    if repeated(own, rows[parts != HELD_OUT_MAP], tolerance).sum() > SHARED * len(own):
        raise MeasurementError(must_be(
            "--held-out", f"study {study.name}", "a map of other readings than those that update "
            "the model", "the same readings", "Hold back readings before the "
            "update (`inference.held_out`), or leave --held-out out."))
    warnings.warn(
        f"{shared} of {len(own)} readings of the held-out map update the model too: their "
        "predictions are no test.", HalbachWarning, stacklevel=2)


def _read(
    magnet: Magnet, one: Map, several: bool, noises: Noises, blocks: Sequence[MagnetBlock]
) -> Readings:
    """Return the readings of a map; ``several`` puts its name into error messages and regions."""
    study, where = one.study, one.name if one.is_validation or not several else f"map {one.name}"
    called = where if several else f"the {where}"
    magnet = magnet.with_study(study)
    data = in_si_and_magnet_axes(study.instrument, one.data)
    measured = ~np.isnan(data["B_T"].values)
    if not one.is_validation:
        measured &= ~excluded_components(study, data.sizes["point"], where)
    if not measured.any():
        raise MeasurementError(must_be(
            "readings", where, "some that the study does not exclude", "none",
            "Correct `inference.excluded_readings`."))
    if not np.any(data["B_T"].values[measured]):
        raise MeasurementError(must_be(
            "flux densities", where, "those of a magnet", "zero at all points",
            "Was the probe connected? Correct the map."))
    observation = observe(study, points_of(data), measured, where)
    if magnet.dimension == 2:
        _check_plane(observation.points[:, 2], where)
    observation = replace(observation, points=_places_in_air(
        magnet, observation.points, data.sizes["point"], where))
    if one.is_validation:
        parts = (HELD_OUT_MAP,) * len(observation)
    else:
        held_out = held_out_readings(study, observation, where)
        parts = tuple(np.where(held_out, HELD_OUT, TRAINING).tolist())
    regions = (ALL_READINGS,) * len(observation)
    if study.noise is not None and study.noise.regions:
        names = [region.name for region in study.noise.regions]
        regions = tuple(names[i] for i in noise_regions(
            study.noise, observation.positions[:, 2], observation.components, called))
    if several:
        single = len(set(regions)) == 1
        regions = tuple(one.name if single else f"{one.name}: {region}" for region in regions)
    values = observation.read(np.nan_to_num(remove_nonlinear_part(study.instrument, data)))
    if one.name not in noises:
        noises[one.name] = reading_noise(
            replace(magnet, blocks=tuple(blocks)), observation, data, called)
    return Readings(observation, values, noises[one.name], parts, regions,
                    (one.name,) * len(observation))


def _places_in_air(magnet: Magnet, points: Floats, rows: int, where: str) -> Floats:
    """Return sensors' points (n, 3) in m, those on a face of magnet or iron just outside.

    Raises
    ------
    MeasurementError
        If a point is not in air. ``rows`` is the number of the map's rows.

    Warns
    -----
    HalbachWarning
        If a point is on a face.
    """
    places = magnet.surroundings(points)
    refused = places.refusal()
    if refused is not None:
        first, _, what, hint = refused
        x, y, z = points[first]
        sensors = len(points) // rows
        count = places.no_air.reshape(-1, sensors).any(axis=1).sum()
        raise MeasurementError(must_be(
            f"reading {first // sensors + 1}", where, "at a point in air",
            f"({x:g}, {y:g}, {z:g}) m, {what} ({count} such readings)",
            hint or "Check the study's radii and the map's axes and units."))
    remark = places.on_faces()
    if remark is not None:
        warnings.warn(remark, HalbachWarning, stacklevel=4)
    return places.points


def _stacked(first: Readings, second: Readings) -> Readings:
    """Return the readings of some maps, followed by those of others, of independent noise."""
    return Readings(
        concatenate(first.observation, second.observation),
        np.concatenate([first.values, second.values]), first.noise.stacked_with(second.noise),
        first.parts + second.parts, first.regions + second.regions, first.maps + second.maps)
