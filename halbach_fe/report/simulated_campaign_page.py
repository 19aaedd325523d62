"""Page of `simulate-measurement`: a simulated campaign.

They show only what a measurement would give, and nothing of the hidden truth.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import TOTAL_COLUMN, is_total_field, points_of
from halbach_fe.measurement.observation_operator import TOTAL_LABEL
from halbach_fe.measurement.probe_law import by_stated_units
from halbach_fe.report.answer import Answer
from halbach_fe.report.magnet_view_3d import ViewPoints, view_of_nominal_magnet
from halbach_fe.report.page import COLOURS_OF_COMPONENTS, Page, Section, Table, View, chart
from halbach_fe.report.point_maps import curve, geometry_figure, maps_figure
from halbach_fe.report.words import counted, flux_density
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.simulate import (
    SimulatedCampaign,
    campaign_files,
    observed_components,
    point_noise,
)


def answer(study: Study, readings: xr.Dataset, held_out: xr.Dataset | None, blocks: int) -> Answer:
    """Say what was simulated, and what to do with it."""
    maps = [readings] + ([] if held_out is None else [held_out])
    largest = max(float(np.nanmax(np.abs(column)))
                  for each in maps for column in _columns(study, each).values())
    more = " (no held-out.csv: no point is between others)" if held_out is None else (
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


def page(campaign: SimulatedCampaign) -> Page:
    """Return the page of a simulated campaign.

    Its files are in the units and along the axes that the study states, the page is in m and T.
    """
    study, blocks = campaign.study, len(campaign.blocks)
    readings, held_out = (  # in m and T, as whoever reads them gets them
        None if data is None else by_stated_units(study.instrument, data)
        for data in (campaign.readings, campaign.held_out))
    assert readings is not None
    maps = {"map": readings} | ({} if held_out is None else {"held out": held_out})
    magnet, points = build_magnet(study), points_of(readings)
    magnitude = 1e3 * np.linalg.norm(list(_columns(study, readings).values()), axis=0)
    view = View(lambda: view_of_nominal_magnet(magnet, ViewPoints(
        points, magnitude, "points of the map", "magnitude of the<br>readings in mT",
        "magnitude of the readings %{customdata:.5g} mT")),
        "points of the map by the magnitude of the readings")
    rows = [_map_row(study, name, data) for name, data in maps.items()]
    secret = readings.attrs["truth_sha256"]
    return Page(
        "simulate-measurement", "a simulated measurement campaign", study,
        answer(study, readings, held_out, blocks), {
            "study": study.name, "points": readings.sizes["point"],
            "readings": int(np.isfinite(campaign.without_noise).sum()), "blocks": blocks,
            "model": campaign.truth["model"], "truth_sha256": secret},
        [Section([
            "Magnetizations were drawn at random, the field was computed with programs other than "
            "halbach-fe, and noise was added. The true magnetizations and hidden effects are in "
            "`truth/truth.json`.", Table(rows, "numbers"),
            f"{blocks} single blocks have simulated measurements in a Helmholtz coil. The points "
            "are shown at the positions that the map states; a campaign may contain a hidden error "
            "of these positions. The picture shows the blocks with their nominal geometry and "
            "magnetization.", view], "What was simulated")],
        {"What was measured": rows},
        figures={
            "campaign_field.png": (
                partial(_field_figure, study, maps), "The readings of the map"),
            "campaign_geometry.png": (
                partial(geometry_figure, magnet, points,
                        None if held_out is None else points_of(held_out)),
                "The nominal blocks of the first ring, "
                f"{'the iron, ' if magnet.iron else ''}and the points of the map and the held-out "
                "points")},
        files=campaign_files(campaign), stored=False, stem="campaign",
        provenance={"source": "simulated", "SHA-256 of the truth": secret})


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
    figure, axis = chart(4)
    for (name, data), marker in zip(maps.items(), (".", "x"), strict=False):
        place, label = curve(points_of(data)) or (np.zeros(0), "")
        for (shown, column), colour in zip(
                _columns(study, data).items(), COLOURS_OF_COMPONENTS, strict=False):
            axis.plot(place, 1e3 * column, marker, ms=4, color=colour, label=f"{shown}, {name}")
        axis.set_xlabel(label)
    axis.set_ylabel("reading in mT")
    figure.legend(loc="outside upper center", ncols=2 * len(maps), markerscale=2)
    return figure
