"""The HTML page of a solved nominal magnet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import Observation
from halbach_fe.report.multipoles import Table, middle_table, table_csv
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    SECOND,
    axes_along,
    geometry,
    places,
    save,
    write_page,
)
from halbach_fe.report.view import field_points, of_nominal
from halbach_fe.response.multipoles import solved_circles
from halbach_fe.study.types import COMPONENTS

COLOURS = (POSTERIOR, PRIOR, SECOND)


@dataclass(frozen=True)
class Solution:
    """A solved nominal magnet.

    Attributes
    ----------
    magnet : Magnet
    points, flux_density : ndarray, shape (n, 3), in m and T
    observation : Observation
    readings, errors : ndarray, shape (readings,), in T
        Of the observation, and the solver's error bars.
    provenance : mapping
        Words by key: versions, method, run time.
    """

    magnet: Magnet
    points: Floats
    flux_density: Floats
    observation: Observation
    readings: Floats
    errors: Floats
    provenance: Mapping[str, str]


def write_solution_report(solution: Solution, folder: Path) -> None:
    """Write report.html, self-contained, and its figures as PNG into ``folder``; and
    multipoles.csv, if the positions are full circles.
    """
    figures = {
        "geometry.png": (geometry(solution.magnet, solution.points), "The blocks of a ring with "
                         "their magnetization, the iron if there is any, and the study's "
                         "positions"),
        "field.png": (_field(solution), "The field at the study's positions, and the solver's "
                      "error bar of each reading")}
    multipoles: list[Table] = [
        (model, {"nominal": known}) for model, known in solved_circles(
            solution.magnet, solution.points, solution.flux_density, solution.errors)]
    if multipoles:
        table_csv(solution.magnet.study, multipoles, folder / "multipoles.csv")
    write_page(
        folder / "report.html", "solution.html.j2", save(figures, folder),
        study=solution.magnet.study,
        array=solution.magnet.study.array, remanence=solution.magnet.blocks[0].remanence,
        multipoles=middle_table(multipoles), provenance=solution.provenance,
        strongest=float(np.linalg.norm(solution.flux_density, axis=1).max()),
        error=float(solution.errors.max()),
        view=of_nominal(solution.magnet, field_points(solution.points, solution.flux_density)))


def _field(solution: Solution) -> Figure:
    """Components along z, or around the circle, or by number of the point; errors below."""
    place, label = places(solution.points)
    seen, _ = places(solution.observation.positions)
    figure, (top, bottom) = axes_along(2, [2, 1])
    order = np.argsort(place, kind="stable")
    for component, colour, column in zip(COMPONENTS, COLOURS, solution.flux_density.T, strict=True):
        top.plot(place[order], column[order], ".", ms=3, color=colour, label=f"B{component}")
    top.set_ylabel("B in T")
    top.legend(ncols=3)
    bottom.plot(seen, solution.errors, ".", ms=3, color=MEASURED)
    if solution.errors.any():  # blocks in vacuum have none
        bottom.set_yscale("log")
    bottom.set_ylabel("error bar in T")
    bottom.set_xlabel(label)
    return figure

