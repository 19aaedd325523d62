"""The HTML page of a solved nominal magnet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.blocks import Floats, blocks_of
from halbach_fe.observation import Observation, circles, fourier_analysis
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
from halbach_fe.study import COMPONENTS, CirclePositions, FourierCoefficients, Study

COLOURS = (POSTERIOR, PRIOR, SECOND)
MOST_ORDERS = 10
UNITS = 1e4


@dataclass(frozen=True)
class Solution:
    """A solved nominal magnet.

    Attributes
    ----------
    study : Study
    points, flux_density : ndarray, shape (n, 3), in m and T
    observation : Observation
    readings, errors : ndarray, shape (readings,), in T
        Of the observation, and the solver's error bars.
    provenance : mapping
        Words by key: versions, method, run time.
    """

    study: Study
    points: Floats
    flux_density: Floats
    observation: Observation
    readings: Floats
    errors: Floats
    provenance: Mapping[str, str]


def write_report(solution: Solution, folder: Path) -> None:
    """Write report.html, self-contained, and its figures as PNG into ``folder``."""
    figures = {
        "geometry.png": (geometry(solution.study, solution.points), "The blocks of a ring with their "
                         "magnetization, the iron if there is any, and the study's positions"),
        "field.png": (_field(solution), "The field at the study's positions, and the solver's "
                      "error bar of each reading")}
    multipoles, circle = multipole_rows(solution)
    write_page(
        folder / "report.html", "solution.html.j2", save(figures, folder), study=solution.study,
        array=solution.study.array, remanence=blocks_of(solution.study)[0].remanence,
        multipoles=multipoles, circle=circle, provenance=solution.provenance,
        strongest=float(np.linalg.norm(solution.flux_density, axis=1).max()),
        error=float(solution.errors.max()),
        view=of_nominal(solution.study, field_points(solution.points, solution.flux_density)))


def multipole_rows(solution: Solution) -> tuple[list[dict[str, str]], str]:
    """Multipoles on the circle that is nearest to the middle, of the largest radius, as text, and
    which one that is; nothing if there are no circles.
    """
    positions = solution.study.observation.positions
    if not isinstance(positions, CirclePositions):
        return [], ""
    orders = min(MOST_ORDERS, (positions.angles - 1) // 2)
    if orders < 1:
        return [], ""
    settings = FourierCoefficients(quantity="fourier_coefficients", harmonics=orders,
                                   positions=positions)
    radius, index = min(circles(solution.points, settings), key=lambda one: (
        abs(solution.points[one[1][0], 2]), -one[0]))
    matrix, _, _ = fourier_analysis(solution.points[index], settings.model_copy(
        update={"positions": positions.model_copy(update={"radius_m": (radius,), "count": 1})}))
    skew, normal = (matrix @ solution.flux_density[index].ravel()).reshape(2, orders)
    main = int(np.argmax(np.hypot(skew, normal)))
    scale = UNITS / np.hypot(skew[main], normal[main])
    return [{"n": str(order + 1), "B_n in T": f"{normal[order]:+.6f}",
             "A_n in T": f"{skew[order]:+.6f}", "b_n in units": f"{scale * normal[order]:+.2f}",
             "a_n in units": f"{scale * skew[order]:+.2f}"}
            for order in range(orders)], (
                f"r = {1e3 * radius:g} mm, z = {1e3 * solution.points[index[0], 2]:g} mm")


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
    bottom.semilogy(seen, solution.errors, ".", ms=3, color=MEASURED)
    bottom.set_ylabel("error bar in T")
    bottom.set_xlabel(label)
    return figure

