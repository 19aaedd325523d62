"""Figures, tables and page of how exact a study's field is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from halbach_fe.core.files import atomic, write_text
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.tables import write_csv
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SECOND,
    axes_along,
    geometry,
    places,
    save,
    write_page,
)
from halbach_fe.report.view import Points, of_nominal
from halbach_fe.response.discretization_error import REFINEMENT
from halbach_fe.response.mesh_convergence import EXACT, FLATTEST, STEEPEST, Verification

COLOURS = (PRIOR, POSTERIOR, PUBLISHED, SECOND, MEASURED)
MARKERS = ("^", "o", ".", "s", "x")


def difference_table(found: Verification) -> list[dict[str, str]]:
    """Rows of text: the differences, and the error that they amount to."""
    def row(what: str, pointwise: float, fourier: float | None) -> dict[str, str]:
        return {"change": what, "pointwise": f"{pointwise:.1e}",
                "Fourier": "" if fourier is None else f"{fourier:.1e}"}

    rows = [row(one.what, one.pointwise, one.fourier)
            | {name: f"{value:.1e}" for name, value in one.by_region.items()}
            for one in found.differences]
    rows.append(row(f"estimated error (order {found.order:.1f})", found.error_pointwise,
                    found.error_fourier) | dict.fromkeys(found.differences[0].by_region, ""))
    return rows


def verdict(magnet: Magnet, found: Verification) -> str:
    """How exact the field is, relative to what, in words."""
    error = found.error_pointwise * found.main_field_T
    if not error:
        return ("Nothing is left to finite elements: the field is the exact one of the blocks in "
                "vacuum.")
    text = (f"At the study's positions B is off by about {error:.1e} T at most, "
            f"{found.error_pointwise:.1e} of the largest field there "
            f"({found.main_field_T:.4g} T).")
    if magnet.study.noise is not None and magnet.study.noise.regions:
        sigma = min(region.sigma_T for region in magnet.study.noise.regions)
        fourier = magnet.study.observation.quantity == "fourier_coefficients"
        own = found.error_fourier if fourier else found.error_pointwise
        if own is not None:
            text += (f" For a {'Fourier coefficient' if fourier else 'reading'} that is "
                     f"{own * found.main_field_T / sigma:.2g} of the smallest noise in the study "
                     f"({sigma:.1e} T).")
    if found.order <= FLATTEST:
        text += (" Finer elements do not change it less than coarser ones did: the estimate is a "
                 "rough one, and the mesh should be finer.")
    return text


def basis(found: Verification) -> str:
    """What the estimate rests on, in words."""
    if found.differences[-1].what == EXACT:
        return "The error is the difference to the exact field of the blocks in vacuum."
    limit = {FLATTEST: " at most", STEEPEST: " at least"}.get(found.order, "")
    text = ("The estimated error is what all further refinements would change, if each changes "
            f"less by the same factor as the last two did (order {found.order:.1f}{limit} in the "
            "element size), and what a boundary farther away changes.")
    if len(found.differences) > 3:
        text += (" The dual formulation errs in the opposite direction, as far as energies go; its "
                 "difference is the error bar of readings, and not part of the estimate.")
    return text


def write_verification(
    magnet: Magnet, found: Verification, folder: Path, provenance: Mapping[str, str]
) -> None:
    """Write verification.json, verification.csv, verification.html and its figures."""
    write_text(folder / "verification.json",
               json.dumps(found.plain(), indent=1, allow_nan=False) + "\n")
    columns = dict(zip(("x_m", "y_m", "z_m"), found.points.T, strict=True))
    with atomic(folder / "verification.csv") as temporary:
        write_csv(columns | {f"{one.what} in T": change for one, change in zip(
            found.differences, found.changes, strict=True)}, {"study": magnet.name}, temporary)
    figures = {}
    if found.changes[:2].any():
        figures["verification_convergence.png"] = _convergence(found), (
            "Error against element size, both logarithmic: what the next finer mesh changes, the "
            "slope between the two, the estimated error of the study's own mesh, and for "
            "comparison what a farther boundary and another formulation change")
        figures["verification_along.png"] = _along(found), (
            "Change of B at every position of the study, for each change of the model")
    figures["verification_geometry.png"] = geometry(magnet, found.points), (
        "The blocks of a ring with their magnetization, the iron if there is any, and the study's "
        "positions")
    change = found.changes[1]
    write_page(
        folder / "verification.html", "verification.html.j2", save(figures, folder),
        study=magnet.study,
        provenance=provenance, found=found, rows=difference_table(found), basis=basis(found),
        verdict=verdict(magnet, found), refinement=REFINEMENT, flattest=FLATTEST,
        view=of_nominal(magnet, Points(
            found.points, change, "positions", "changed by a<br>finer mesh, in T",
            "a finer mesh changes B by %{customdata:.1e} T",
            (float(change.min()), float(change.max())))))


def _convergence(found: Verification) -> Figure:
    """What the next finer mesh changes, over the largest field, by element size."""
    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axis = figure.subplots()
    size = 1e3 * found.element_size_m
    sizes = size * np.array([REFINEMENT, 1.0])
    steps = np.array([one.pointwise for one in found.differences[:2]])
    line = size * np.array([REFINEMENT, 1 / REFINEMENT])
    axis.plot(sizes, steps, "o", color=POSTERIOR, label="changed by the next finer mesh")
    axis.plot(line, steps[1] * (line / size)**found.order, "-", color=POSTERIOR, lw=0.8,
              label=f"order {found.order:.1f}")
    axis.plot(size, found.error_pointwise, "*", ms=12, color=PRIOR,
              label="estimated error of the study's mesh")
    for one, style, colour in zip(found.differences[2:], ("--", ":", "-."),
                                  (PUBLISHED, SECOND, MEASURED), strict=False):
        if one.pointwise > 0:
            axis.axhline(one.pointwise, ls=style, color=colour, label=one.what.replace("_", " "))
    axis.set(xscale="log", yscale="log", xlabel="element size at the magnet in mm",
             ylabel="change of B over the largest field")
    axis.set_xticks(size * np.array([1 / REFINEMENT, 1, REFINEMENT]))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3, which="both")
    axis.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize="small")
    return figure


def _along(found: Verification) -> Figure:
    figure, (axis,) = axes_along(1)
    place, label = places(found.points)
    for one, change, colour, marker in zip(found.differences, found.changes, COLOURS, MARKERS,
                                           strict=False):
        seen = change > 0
        axis.semilogy(place[seen], change[seen], marker, ms=4, color=colour,
                      label=one.what.replace("_", " "))
    axis.set(xlabel=label, ylabel="|change of B| in T")
    figure.legend(loc="outside upper center", ncols=2, fontsize="small")
    return figure
