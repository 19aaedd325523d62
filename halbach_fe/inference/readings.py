"""The readings of all maps of a campaign, stacked: values, noise, and how B becomes a reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.result import ALL_READINGS, HELD_OUT, HELD_OUT_MAP, TRAINING
from halbach_fe.measurement.campaign import Map
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


def read_campaign(magnet: Magnet, maps: Sequence[Map]) -> Readings:
    """Return the readings of all maps, by the instrument of each.

    Raises
    ------
    StudyError
        If neither study nor map state the noise.
    MeasurementError
        If a map does not fit the study.
    """
    several = sum(not one.is_validation for one in maps) > 1
    found = reduce(_stacked, (_read(magnet, one, several) for one in maps))
    heights = found.observation.points[:, 2]
    if magnet.dimension == 2 and np.ptp(heights) > 0:
        raise MeasurementError(must_be(
            "points", "map", "in one plane for a 2D study",
            f"z from {heights.min():g} to {heights.max():g} m",
            "Use a 3D study, or one circle of the map."))
    return found


def _read(magnet: Magnet, one: Map, several: bool) -> Readings:
    """Return the readings of a map; ``several`` puts its name into error messages and regions."""
    study, where = one.study, one.name if one.is_validation or not several else f"map {one.name}"
    magnet = magnet.with_study(study)
    data = in_si_and_magnet_axes(study.instrument, one.data)
    measured = ~np.isnan(data["B_T"].values)
    if not one.is_validation:
        measured &= ~excluded_components(study, data.sizes["point"])
    observation = observe(study, points_of(data), measured, where)
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
    if one.is_validation:
        parts = (HELD_OUT_MAP,) * len(observation)
    else:
        held_out = held_out_readings(study, observation)
        parts = tuple(np.where(held_out, HELD_OUT, TRAINING).tolist())
    regions = (ALL_READINGS,) * len(observation)
    if study.noise is not None and study.noise.regions:
        names = [region.name for region in study.noise.regions]
        regions = tuple(names[i] for i in noise_regions(
            study.noise, observation.positions[:, 2], observation.components))
    if several:
        single = len(set(regions)) == 1
        regions = tuple(one.name if single else f"{one.name}: {region}" for region in regions)
    values = observation.read(np.nan_to_num(remove_nonlinear_part(study.instrument, data)))
    return Readings(observation, values, reading_noise(magnet, observation, data), parts, regions,
                    (one.name,) * len(observation))


def _stacked(first: Readings, second: Readings) -> Readings:
    """Return the readings of some maps, followed by those of others, of independent noise."""
    return Readings(
        concatenate(first.observation, second.observation),
        np.concatenate([first.values, second.values]), first.noise.stacked_with(second.noise),
        first.parts + second.parts, first.regions + second.regions, first.maps + second.maps)
