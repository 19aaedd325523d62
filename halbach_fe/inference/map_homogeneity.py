"""Homogeneity of a measured map itself: a harmonic fit of its readings, without any magnet.

In the sphere about the region's centre that blocks and iron leave free, the field is a sum of
gradients of solid harmonics. Their amplitudes have a normal prior, of the same width on that sphere
for all, which the evidence of the readings chooses; the uniform field is as good as free. With the
covariance that the noise of the readings leaves they give the field in a region within the map.
Beside that of the nominal and of the updated magnet it shows how much the update explains.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.readings import Readings, read_campaign
from halbach_fe.inference.result import HELD_OUT
from halbach_fe.measurement.campaign import maps_of
from halbach_fe.measurement.field_map import refuse_total_field
from halbach_fe.measurement.harmonic_field import UNIFORM, fit_readings, solid_harmonic_fields
from halbach_fe.response.homogeneity import DRAWS, Homogeneity, HomogeneityModel, sphere_points

WITHIN = 0.75
"""Radius up to which readings are used, relative to that of the free sphere: at its surface the
series has no end."""

DEGREES = 28
"""Highest degree of the harmonics: at `WITHIN` the next ones are 3e-4 of what they are on the free
sphere."""

DIRECTIONS, SHELLS = 60, 8
"""Degree of the directions in which the free sphere is looked for (6° apart), and number of radii
that are tried at once."""

BEYOND = 0.02
"""How far a region may reach beyond the box around the readings, relative to its sides."""

POOR = 1.15
"""Noise that a fit finds, relative to the stated one, above which it is not to be relied on: the
readings are too far apart for the field between them, or noisier than stated."""

MAP, HELD_OUT_PART = "map", "map, held-out part"
"""Names of what is fitted: all readings, or those that do not update the magnet."""


def map_homogeneity(
    magnet: Magnet, data: xr.Dataset | Mapping[str, xr.Dataset], model: HomogeneityModel,
    seed: int = 0,
) -> tuple[dict[str, Homogeneity], float]:
    """Return the homogeneity that a map has by itself, in the region of a model, and the misfit.

    It has the name `MAP`; if the study holds readings out, that of these alone is beside it. The
    misfit is the noise that the fit of all readings finds, relative to the stated one, see `POOR`.

    Parameters
    ----------
    magnet : Magnet
        Its study states where the map lies, the instrument and the noise.
    data : Dataset or dict of str to Dataset
        The map, or all maps that the study lists.
    model : HomogeneityModel
        Of the region.
    seed : int
        Of the fields that are drawn for the error bars.

    Raises
    ------
    MeasurementError
        If the map does not fit the study, or the region reaches beyond it.
    """
    maps = maps_of(magnet.study, data)
    for one in maps:
        refuse_total_field(one.data, "a fit of the field by itself")
    readings = read_campaign(magnet, maps)
    _check_within(readings, model)
    held_out = np.array(readings.parts) == HELD_OUT
    free = _free_radius(magnet, np.array(model.region.centre_m))
    found = {MAP: _fitted(readings, np.ones_like(held_out), model, free, seed)}
    if held_out.any():
        found[HELD_OUT_PART] = _fitted(readings, held_out, model, free, seed)
    return {name: known for name, (known, _) in found.items()}, found[MAP][1]


def _check_within(readings: Readings, model: HomogeneityModel) -> None:
    """Refuse a region that reaches beyond the readings, where a fit of them tells nothing."""
    points, region = readings.observation.points, model.points[:len(model.weights)]
    low, high = points.min(axis=0), points.max(axis=0)
    margin = BEYOND * (high - low)
    outside = (region < low - margin) | (region > high + margin)
    if outside.any():
        axis = int(np.argmax(outside.sum(axis=0)))
        raise MeasurementError(must_be(
            "the region", "the map", "within its points, to compare with its own homogeneity",
            f"{model.region.text}, while {'xyz'[axis]} of the readings goes from "
            f"{1e3 * low[axis]:.4g} to {1e3 * high[axis]:.4g} mm",
            "Choose a smaller region, or leave the map out."))


def _fitted(
    readings: Readings, chosen: NDArray[np.bool_], model: HomogeneityModel, free_m: float,
    seed: int,
) -> tuple[Homogeneity, float]:
    """Return the homogeneity of the fit of some readings, and its noise over the stated noise."""
    observation, region = readings.observation, model.region
    centre = np.array(region.centre_m)
    near = np.linalg.norm(observation.points - centre, axis=1) <= WITHIN * free_m
    operator = observation.operator.tocsr()
    # a reading counts if all its sensors are near
    far = np.asarray(abs(operator) @ np.repeat(~near, 3).astype(float)).ravel() > 0
    used = np.flatnonzero(chosen & ~far)
    operator, sd = operator[used], readings.noise.sd[used]
    seen = np.unique(operator.indices // 3)
    columns = (3 * seen[:, None] + np.arange(3)).ravel()
    design = np.asarray(operator[:, columns] @ _fields(
        (observation.points[seen] - centre) / free_m)) / sd[:, None]
    scaled = readings.values[used] / sd
    fit = fit_readings(design, [scaled])[0]
    left = scaled - design @ fit.amplitudes
    noise = float(np.linalg.norm(left) / np.sqrt(max(len(left) - fit.used, 1.0)))
    values, vectors = np.linalg.eigh(design.T @ design)
    root = vectors * (noise / np.sqrt(np.maximum(values, 0.0) + fit.penalty))
    normals = np.random.default_rng(seed).standard_normal((root.shape[1], DRAWS))
    every = np.column_stack([fit.amplitudes, fit.amplitudes[:, None] + root @ normals])
    points = (model.points[:len(model.weights)] - centre) / free_m
    fields = (_fields(points) @ every).reshape(len(points), 3, -1)
    return model.of_fields(fields[..., 0], fields[..., 1:]), noise


def _fields(points: Floats) -> Floats:
    """Return B (3 n, amplitudes) at points (n, 3) in units of the free sphere's radius."""
    fields = solid_harmonic_fields(points, DEGREES).reshape(3 * len(points), -1)
    fields[:, :3] *= UNIFORM
    return fields


def _free_radius(magnet: Magnet, centre: Floats) -> float:
    """Return the radius in m of the sphere about a point that blocks and iron leave free."""
    directions, _ = sphere_points(DIRECTIONS)
    low, high = 0.0, magnet.field_reach
    while high - low > 1e-3 * high:
        middle = (low + high) / 2
        shells = np.linspace(low, middle, SHELLS)[1:, None, None] * directions
        if magnet.contains(centre + shells.reshape(-1, 3)).any():
            high = middle
        else:
            low = middle
    return low
