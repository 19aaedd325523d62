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
from halbach_fe.measurement.field_map import TOTAL_COLUMN, is_total_field, points_of
from halbach_fe.measurement.observation import TOTAL_LABEL
from halbach_fe.report.answer import Answer
from halbach_fe.report.magnet_view_3d import ViewPoints, view_of_nominal_magnet
from halbach_fe.report.page import (
    POSTERIOR,
    PRIOR,
    SECOND,
    geometry_figure,
    own_style,
    save,
    stacked_axes,
    write_page,
)
from halbach_fe.report.point_maps import curve, maps_figure
from halbach_fe.report.words import counted, flux_density
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.simulate import observed_components, point_noise

COLOURS = (POSTERIOR, PRIOR, SECOND)


def answer(study: Study, readings: xr.Dataset, held_out: xr.Dataset | None, blocks: int) -> Answer:
    """Say what was simulated, and what to do with it."""
    maps = [readings] + ([] if held_out is None else [held_out])
    largest = max(float(np.nanmax(np.abs(column)))
                  for each in maps for column in _columns(study, each).values())
    more = "" if held_out is None else (
        f", {counted(held_out.sizes['point'], 'more point')} to test predictions (held-out.csv)")
    sigma = _noise(study, readings)
    low, high = float(np.nanmin(sigma)), float(np.nanmax(sigma))
    return Answer(
        "What would a measurement of this magnet give?",
        f"Readings up to {flux_density(largest, 4)} with a noise of {flux_density(low, 2)}"
        f"{'' if np.isclose(low, high) else f' to {flux_density(high, 2)}'}. Simulated are a map "
        f"of {counted(readings.sizes['point'], 'point')} (map.csv){more}, and coil measurements of "
        f"{counted(blocks, 'single block')} (blocks.csv).",
        "Only as a test: the magnet was never built. Its blocks were drawn at random, and "
        "its field was computed with programs other than halbach-fe. A campaign may contain a "
        "hidden error, also of the positions that the map states.",
        "Update the magnet with the map, as if it were measured, then compare with the truth.",
        "halbach-fe infer STUDY --measurements DIR/map.csv --blocks DIR/blocks.csv"
        + (" --held-out DIR/held-out.csv" if held_out is not None else "") + " -o DIR")


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
    magnet, points = build_magnet(study), points_of(readings)
    figures = {
        "campaign_field.png": (
            _field_figure(study, maps), "The readings of the map"),
        "campaign_geometry.png": (
            geometry_figure(magnet, points, None if held_out is None else points_of(held_out)),
            f"The nominal blocks of the first ring, {'the iron, ' if magnet.iron else ''}and the "
            "points of the map and the held-out points")}
    magnitude = np.linalg.norm(list(_columns(study, readings).values()), axis=0)
    write_page(
        folder / "campaign.html", "campaign.html.j2", save(figures, folder), study=study,
        provenance={"source": "simulated", "SHA-256 of the truth": readings.attrs["truth_sha256"]},
        answer=answer(study, readings, held_out, len(blocks)),
        rows=campaign_table(study, readings, held_out), blocks=len(blocks),
        files=files, view=view_of_nominal_magnet(magnet, ViewPoints(
            points, 1e3 * magnitude, "points of the map", "magnitude of the<br>readings in mT",
            "magnitude of the readings %{customdata:.5g} mT",
            (1e3 * float(magnitude.min()), 1e3 * float(magnitude.max())))))


def campaign_table(
    study: Study, readings: xr.Dataset, held_out: xr.Dataset | None
) -> list[dict[str, str]]:
    """Return a row of text for the map, and one for the held-out points if there are any."""
    maps = {"map": readings} | ({} if held_out is None else {"held out": held_out})
    return [_map_row(study, name, data) for name, data in maps.items()]


def _map_row(study: Study, name: str, data: xr.Dataset) -> dict[str, str]:
    """Return the row of a map in the page's table."""
    fields, z = _columns(study, data), points_of(data)[:, 2]
    sigma = _noise(study, data)
    return {"points of": name, "number": str(len(z)),
            "components": ", ".join(fields),
            "z in mm": " to ".join(dict.fromkeys(
                f"{1e3 * round(end, 9):.4g}" for end in (z.min(), z.max()))),
            "largest reading": flux_density(float(np.nanmax(np.abs(
                list(fields.values())))), 5),
            "sd of the noise": " to ".join(dict.fromkeys(
                flux_density(float(end), 2) for end in (np.nanmin(sigma), np.nanmax(sigma))))}


def _noise(study: Study, data: xr.Dataset) -> Floats:
    """Return standard deviations (n, 3) in T: the map's if it has them, else the study's."""
    return data["sigma_T"].values if "sigma_T" in data else point_noise(
        study, points_of(data), is_total_field(data))


def _columns(study: Study, data: xr.Dataset) -> dict[str, Floats]:
    """Return the readings (n,) in T of a map, by their names."""
    if is_total_field(data):
        return {TOTAL_LABEL: data[TOTAL_COLUMN].values}
    return {f"B{name}": data["B_T"].values[:, COMPONENTS.index(name)]
            for name in observed_components(study)}


def _field_figure(study: Study, maps: dict[str, xr.Dataset]) -> Figure:
    """Draw the readings of all maps along a line or circle, or those of the map as a map."""
    if any(curve(points_of(data)) is None for data in maps.values()):
        (data, *_) = maps.values()
        return maps_figure(points_of(data), {
            name: 1e3 * column for name, column in _columns(study, data).items()}, "mT")
    figure, (axis,) = stacked_axes(1)
    figure.set_figheight(4)
    for (name, data), marker in zip(maps.items(), (".", "x"), strict=False):
        place, label = curve(points_of(data)) or (np.zeros(0), "")
        for (shown, column), colour in zip(_columns(study, data).items(), COLOURS, strict=False):
            axis.plot(place, 1e3 * column, marker, ms=4, color=colour, label=f"{shown}, {name}")
        axis.set_xlabel(label)
    axis.set_ylabel("reading in mT")
    figure.legend(loc="outside upper center", ncols=2 * len(maps), markerscale=2)
    return figure
