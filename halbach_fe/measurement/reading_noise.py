"""The noise of readings: a covariance of what map or study states, and of uncertain positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sparse
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.field_map import TOTAL_SIGMA_COLUMN, is_total_field
from halbach_fe.measurement.observation_operator import TOTAL, Observation
from halbach_fe.measurement.probe_law import probe_points, sensor_matrix
from halbach_fe.solver.exact_block_field import external_gradient, gradient_of
from halbach_fe.stats.gaussian import NoiseCovariance
from halbach_fe.study.measurement_keys import NoiseSettings

ROUNDING = 1e-12
"""Correlation coefficient below which readings count as independent. Sums over the points of a
circle that cancel exactly leave rounding errors of 1e-15."""


def noise_regions(
    noise: NoiseSettings, z: Floats, components: Sequence[str], where: str = "the map"
) -> NDArray[np.int64]:
    """Return for each reading the index of the first noise region of the study that contains it.

    Parameters
    ----------
    noise : NoiseSettings
        The study's noise.
    z : ndarray, shape (readings,), in m
    components : sequence of str
        Component of each reading, x, y or z; `TOTAL` for |B|, and empty for a Fourier coefficient,
        which a region contains whatever its components.
    where : str
        What error messages call the map.

    Raises
    ------
    StudyError
        If a reading is in no region.
    """
    region = np.full(len(z), -1)
    whole = ["", TOTAL]  # neither has one of the components that a region may list
    for number, window in reversed(list(enumerate(noise.regions))):
        low = -np.inf if window.z_min_m is None else window.z_min_m
        high = np.inf if window.z_max_m is None else window.z_max_m
        region[(z >= low) & (z <= high)
               & np.isin(components, [*whole, *window.components])] = number
    if (region < 0).any():
        first = int(np.argmin(region))
        which = f", component {components[first]}," if components[first] else ""
        raise StudyError(
            f"Input `noise.regions` of study must cover every reading of {where}; instead z = "
            f"{z[first]:g} m{which} is in none. Add a last region without limits.")
    return region


def reading_noise(
    magnet: Magnet, observation: Observation, data: xr.Dataset, where: str = "the map"
) -> NoiseCovariance:
    """Return the noise covariance of the readings of a map.

    If the map states the noise of its points (``sigma_T``), it is propagated to the readings;
    otherwise each reading has the sigma of its noise region in the study. In both cases the effect
    of uncertain positions is added.

    For Fourier coefficients, noise that differs along a circle leaves the coefficients of this
    circle correlated. A region's sigma is that of the coefficients, not that of the points. Error
    messages call the map ``where``.

    Raises
    ------
    StudyError
        If neither map nor study states the noise.
    """
    settings = magnet.study.noise
    if is_total_field(data) and TOTAL_SIGMA_COLUMN in data:
        own = data[TOTAL_SIGMA_COLUMN].values[observation.map_rows]
        covariance = sparse.diags_array(own**2)
    elif "sigma_T" in data:
        points = np.nan_to_num(data["sigma_T"].values.ravel()) ** 2
        analysis = observation.analysis
        covariance = analysis @ sparse.diags_array(points) @ analysis.T
    elif settings is None or not settings.regions:
        raise StudyError(
            f"Input `noise` of study {magnet.name} must say how noisy the readings are, since "
            f"{where} has no sigma_T; instead it is missing. Add [[noise.regions]] to the study, "
            "or sigma_T to the map.")
    else:
        sigma = np.array([region.sigma_T for region in settings.regions])[noise_regions(
            settings, observation.positions[:, 2], observation.components, where)]
        covariance = sparse.diags_array(sigma**2)
    if settings is not None and settings.position_sd_m is not None:
        moved = readings_per_displacement(
            magnet, observation.analysis, probe_points(magnet.study.instrument,
                                                       observation.map_points),
            np.array(settings.position_sd_m))
        covariance = covariance + moved @ moved.T
    return NoiseCovariance(_without_rounding(sparse.csr_array(covariance)))


def readings_per_displacement(
    magnet: Magnet, analysis: sparse.csr_array, points: Floats, sd: Floats
) -> sparse.csr_array:
    """Return the changes of the readings if each of n points is displaced along each axis of the
    stage, which may be turned in the magnet.

    The field gradient is that of the magnet's blocks in vacuum and of external sources. The
    reaction field of recoil permeability and iron, some per cent of the field in the bore but more
    beside poles, is neglected: the result only sets the size of the noise. Deviations of the blocks
    have a gradient of their own, which is the larger part where the nominal field is uniform: an
    update therefore estimates the noise again with the blocks as they are updated.

    Parameters
    ----------
    magnet : Magnet
        With the instrument of the map in its study, and nominal or estimated blocks.
    analysis : sparse array, shape (readings, 3 n)
        Maps the values of a field map to the readings, see `Observation`.
    points : ndarray, shape (n, 3), in m
        Positions of the probe in the magnet.
    sd : ndarray, shape (3,), in m
        Displacements along x, y and z of the stage, usually standard deviations.

    Returns
    -------
    changes : sparse array, shape (readings, 3 n), in T
        One column for each point and axis.
    """
    instrument = magnet.study.instrument
    moved = rotation_matrix(instrument.rotation_rad) * sd  # columns, in the magnet
    gradient = sensor_matrix(instrument) @ (
        gradient_of(magnet.blocks, points) + external_gradient(magnet, points)) @ moved
    number = np.arange(len(gradient) + 1)
    return sparse.csr_array(
        analysis @ sparse.bsr_array((gradient, number[:-1], number)))


def _without_rounding(covariance: sparse.csr_array) -> sparse.csr_array:
    """Return the covariance without correlations below `ROUNDING`.

    Equal noise at all points of a circle leaves its Fourier coefficients independent; without
    rounding errors, their covariance is diagonal.
    """
    entries = covariance.tocoo()
    rows, columns = entries.coords
    variance = covariance.diagonal()
    kept = np.abs(entries.data) > ROUNDING * np.sqrt(variance[rows] * variance[columns])
    return sparse.csr_array((entries.data[kept], (rows[kept], columns[kept])),
                            shape=covariance.shape)
