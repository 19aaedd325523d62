"""Noise of readings: of the points of a map, by region, and by uncertain positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sparse
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.instrument import probe_points
from halbach_fe.measurement.observation import Observation
from halbach_fe.solver.vacuum_field import gradient_of
from halbach_fe.stats.noise import NoiseCovariance
from halbach_fe.study.measurement import (
    NoiseSettings,
)

ROUNDING = 1e-12
"""Correlations below it are none: sums over a circle's points cancel to 1e-15."""


def noise_regions(
    noise: NoiseSettings, z: Floats, components: Sequence[str]
) -> NDArray[np.int64]:
    """Index of the noise region of each reading, at z in m and of a component: the first that
    fits.

    Raises
    ------
    StudyError
        If some reading is in none.
    """
    region = np.full(len(z), -1)
    for number, window in reversed(list(enumerate(noise.regions))):
        low = -np.inf if window.z_min_m is None else window.z_min_m
        high = np.inf if window.z_max_m is None else window.z_max_m
        region[(z >= low) & (z <= high) & np.isin(components, ["", *window.components])] = number
    if (region < 0).any():
        first = int(np.argmin(region))
        which = f", component {components[first]}," if components[first] else ""
        raise StudyError(
            f"Input `noise.regions` of study must cover every reading; instead z = "
            f"{z[first]:g} m{which} is in none. Add a last region without limits.")
    return region


def reading_noise(magnet: Magnet, observation: Observation, data: xr.Dataset) -> NoiseCovariance:
    """Noise of the readings: of the map's points where it says, else by region; and in both cases
    what uncertain positions add.

    For Fourier coefficients the noise of points is propagated, with the correlations that it
    leaves within a circle unless it is the same everywhere; the regions' sigma is that of the
    coefficients themselves.
    """
    settings = magnet.study.noise
    if "sigma_T" in data:
        points = np.nan_to_num(data["sigma_T"].values.ravel()) ** 2
        analysis = observation.analysis
        covariance = analysis @ sparse.diags_array(points) @ analysis.T
    elif settings is None or not settings.regions:
        raise StudyError(
            f"Input `noise` of study {magnet.name} must say how noisy the readings are, since the "
            "map does not; instead it is missing. Add [[noise.regions]], or sigma_T to the map.")
    else:
        sigma = np.array([region.sigma_T for region in settings.regions])[noise_regions(
            settings, observation.positions[:, 2], observation.components)]
        covariance = sparse.diags_array(sigma**2)
    if settings is not None and settings.position_sd_m is not None:
        moved = displacement(magnet, observation, np.array(settings.position_sd_m))
        covariance = covariance + moved @ moved.T
    return NoiseCovariance(_without_rounding(sparse.csr_array(covariance)))


def displacement(magnet: Magnet, observation: Observation, sd: Floats) -> sparse.csr_array:
    """Change of the readings (readings, 3 n) in T when each point is moved by a standard deviation
    (3,) in m along each axis.

    The gradient is that of the nominal blocks in vacuum. What permeability and iron react with, in
    the bore some per cent of the field, is left out of this scale of the noise.
    """
    points = probe_points(magnet.study.instrument, observation.map_points)
    gradient = gradient_of(magnet.blocks, points) * sd
    number = np.arange(len(gradient) + 1)
    return sparse.csr_array(
        observation.analysis @ sparse.bsr_array((gradient, number[:-1], number)))


def _without_rounding(covariance: sparse.csr_array) -> sparse.csr_array:
    """The covariance without correlations below `ROUNDING`: equal noise all around a circle leaves
    its coefficients independent.
    """
    entries = covariance.tocoo()
    rows, columns = entries.coords
    variance = covariance.diagonal()
    kept = np.abs(entries.data) > ROUNDING * np.sqrt(variance[rows] * variance[columns])
    return sparse.csr_array((entries.data[kept], (rows[kept], columns[kept])),
                            shape=covariance.shape)
