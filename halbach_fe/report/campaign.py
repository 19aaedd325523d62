"""Figures and page of a simulated campaign.

They show only what a measurement would give, and nothing of the hidden truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.field_map import points_of
from halbach_fe.report.magnet_view_3d import ViewPoints, view_of_nominal_magnet
from halbach_fe.report.page import (
    POSTERIOR,
    PRIOR,
    SECOND,
    axis_of_points,
    geometry_figure,
    own_style,
    save,
    stacked_axes,
    write_page,
)
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.simulate import observed_components, point_noise

COLOURS = (POSTERIOR, PRIOR, SECOND)


@own_style
def write_campaign_page(
    study: Study, readings: xr.Dataset, held_out: xr.Dataset | None, blocks: BlockTable,
    folder: Path, files: Sequence[str],
) -> None:
    """Write campaign.html and its figures.

    Parameters
    ----------
    readings : xarray.Dataset
        The simulated field map.
    held_out : xarray.Dataset or None
        The simulated readings that are held out.
    blocks : BlockTable
        The simulated measurements of single blocks.
    files : sequence of str
        Names and digests of the campaign's files.
    """
    maps = {"map": readings} | ({} if held_out is None else {"held out": held_out})
    points = points_of(readings)
    figures = {
        "campaign_field.png": (
            _field_figure(study, maps), "Readings at the points of the map (dots) and at the "
            "held-out points (crosses), and the standard deviation of their noise"),
        "campaign_geometry.png": (
            geometry_figure(build_magnet(study), points,
                            None if held_out is None else points_of(held_out)),
            "The nominal blocks of the first ring, the iron ring if the study has one, and the "
            "points of the map and the held-out points")}
    magnitude = np.linalg.norm(np.nan_to_num(readings["B_T"].values), axis=1)
    write_page(
        folder / "campaign.html", "campaign.html.j2", save(figures, folder), study=study,
        provenance={"source": "simulated", "SHA-256 of the truth": readings.attrs["truth_sha256"]},
        rows=[_map_row(study, name, data) for name, data in maps.items()], blocks=len(blocks),
        files=files, view=view_of_nominal_magnet(build_magnet(study), ViewPoints(
            points, magnitude, "points of the map", "magnitude of the<br>readings in T",
            "magnitude of the readings %{customdata:.5g} T",
            (float(magnitude.min()), float(magnitude.max())))))


def _map_row(study: Study, name: str, data: xr.Dataset) -> dict[str, str]:
    """Return the row of a map in the page's table."""
    fields, z = data["B_T"].values, points_of(data)[:, 2]
    sigma = _noise(study, data)
    return {"points of": name, "number": str(len(z)),
            "components": ", ".join(f"B{name}" for name in observed_components(study)),
            "z in m": " to ".join(dict.fromkeys(f"{end:g}" for end in (z.min(), z.max()))),
            "largest reading in T": f"{np.nanmax(np.abs(fields)):.5g}",
            "sd of the noise in T": " to ".join(dict.fromkeys(
                f"{end:.1e}" for end in (np.nanmin(sigma), np.nanmax(sigma))))}


def _noise(study: Study, data: xr.Dataset) -> Floats:
    """Return standard deviations (n, 3) in T: the map's if it has them, else the study's."""
    return data["sigma_T"].values if "sigma_T" in data else point_noise(study, points_of(data))


def _field_figure(study: Study, maps: dict[str, xr.Dataset]) -> Figure:
    """Draw the readings of all maps, and the standard deviations of their noise below."""
    figure, (top, bottom) = stacked_axes(2, [3, 1])
    for (name, data), marker in zip(maps.items(), (".", "x"), strict=False):
        place, label = axis_of_points(points_of(data))
        for component in observed_components(study):
            number = COMPONENTS.index(component)
            top.plot(place, data["B_T"].values[:, number], marker, ms=4, color=COLOURS[number],
                     label=f"B{component}, {name}")
            bottom.semilogy(place, _noise(study, data)[:, number], marker, ms=4,
                            color=COLOURS[number])
        bottom.set_xlabel(label)
    top.set_ylabel("reading in T")
    bottom.set_ylabel("sd of the noise in T")
    figure.legend(loc="outside upper center", ncols=2 * len(maps), markerscale=2)
    return figure
