"""Figures and page of a simulated campaign, by what is in the open: nothing of the truth."""

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
from halbach_fe.report.page import (
    POSTERIOR,
    PRIOR,
    SECOND,
    axes_along,
    geometry,
    places,
    save,
    write_page,
)
from halbach_fe.report.view import Points, of_nominal
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.simulate import observed_components, point_noise

COLOURS = (POSTERIOR, PRIOR, SECOND)


def write_campaign_page(
    study: Study, readings: xr.Dataset, held_out: xr.Dataset | None, blocks: BlockTable,
    folder: Path, files: Sequence[str],
) -> None:
    """Write campaign.html and its figures; ``files`` are names and digests of what was written."""
    maps = {"map": readings} | ({} if held_out is None else {"held out": held_out})
    points = points_of(readings)
    figures = {
        "campaign_field.png": (_field(study, maps), "What was read at the points of the map (dots) "
                               "and at those held out (crosses), and the standard deviation of the "
                               "noise"),
        "campaign_geometry.png": (geometry(
            build_magnet(study), points, None if held_out is None else points_of(held_out)),
                                  "The blocks of a "
            "ring as ordered, the iron of the study if there is any, and the points of the map "
            "and those held out")}
    size = np.linalg.norm(np.nan_to_num(readings["B_T"].values), axis=1)
    write_page(
        folder / "campaign.html", "campaign.html.j2", save(figures, folder), study=study,
        provenance={"source": "simulated", "SHA-256 of the truth": readings.attrs["truth_sha256"]},
        rows=[_row(study, name, data) for name, data in maps.items()], blocks=len(blocks),
        files=files, view=of_nominal(build_magnet(study), Points(
            points, size, "points of the map", "size of the<br>reading in T",
            "reading of %{customdata:.5g} T", (float(size.min()), float(size.max())))))


def _row(study: Study, name: str, data: xr.Dataset) -> dict[str, str]:
    fields, z = data["B_T"].values, points_of(data)[:, 2]
    sigma = _noise(study, data)
    return {"points of": name, "number": str(len(z)),
            "components": ", ".join(f"B{one}" for one in observed_components(study)),
            "z in m": " to ".join(dict.fromkeys(f"{one:g}" for one in (z.min(), z.max()))),
            "largest reading in T": f"{np.nanmax(np.abs(fields)):.5g}",
            "noise in T": " to ".join(dict.fromkeys(
                f"{one:.1e}" for one in (np.nanmin(sigma), np.nanmax(sigma))))}


def _noise(study: Study, data: xr.Dataset) -> Floats:
    """Standard deviations (n, 3) in T, as the map has them, or else the study."""
    return data["sigma_T"].values if "sigma_T" in data else point_noise(study, points_of(data))


def _field(study: Study, maps: dict[str, xr.Dataset]) -> Figure:
    figure, (top, bottom) = axes_along(2, [3, 1])
    for (name, data), marker in zip(maps.items(), (".", "x"), strict=False):
        place, label = places(points_of(data))
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
