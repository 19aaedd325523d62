"""The HTML page of a solved nominal magnet."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.report.magnet_table import magnet_rows
from halbach_fe.report.magnet_view_3d import field_points, view_of_nominal_magnet
from halbach_fe.report.multipoles import MultipoleTable, middle_table, write_multipole_csv
from halbach_fe.report.page import (
    MEASURED,
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
from halbach_fe.response.multipoles import solved_circles
from halbach_fe.response.solution import Solution
from halbach_fe.study.types import COMPONENTS

COLOURS = (POSTERIOR, PRIOR, SECOND)


@own_style
def write_solution_report(
    solution: Solution, folder: Path, provenance: Mapping[str, str]
) -> None:
    """Write report.html, self-contained, and its figures as PNG into ``folder``; and
    multipoles.csv, if the positions are full circles.

    ``provenance`` are words by key for the end of the page: versions, hashes of files, run time.
    """
    figures = {
        "geometry.png": (geometry_figure(solution.magnet, solution.points), "The blocks of a ring "
                         "with their magnetization, the iron if there is any, and the study's "
                         "positions"),
        "field.png": (field_figure(solution),
                      "The field at the study's positions, and the solver's "
                      "error bar of each reading")}
    multipoles: list[MultipoleTable] = [
        (model, {"nominal": known}) for model, known in solved_circles(
            solution.magnet, solution.points, solution.flux_density, solution.errors)]
    if multipoles:
        write_multipole_csv(solution.magnet.study, multipoles, folder / "multipoles.csv")
    write_page(
        folder / "report.html", "solution.html.j2", save(figures, folder),
        study=solution.magnet.study,
        magnet_rows=magnet_rows(solution.magnet),
        multipoles=middle_table(multipoles), provenance=provenance,
        strongest=float(np.linalg.norm(solution.flux_density, axis=1).max()),
        error=float(solution.errors.max()),
        view=view_of_nominal_magnet(
            solution.magnet, field_points(solution.points, solution.flux_density)))


def field_figure(solution: Solution) -> Figure:
    """Components along z, or around the circle, or by number of the point; errors below."""
    place, label = axis_of_points(solution.points)
    seen, _ = axis_of_points(solution.observation.positions)
    figure, (top, bottom) = stacked_axes(2, [2, 1])
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

