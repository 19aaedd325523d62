"""Figures, table and page of the verification of a study's computed field."""

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
from halbach_fe.report.magnet_table import magnet_rows
from halbach_fe.report.magnet_view_3d import ViewPoints, view_of_nominal_magnet
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SECOND,
    THIRD,
    axis_of_points,
    geometry_figure,
    own_style,
    save,
    stacked_axes,
    write_page,
)
from halbach_fe.response.discretization_error import REFINEMENT
from halbach_fe.response.mesh_convergence import EXACT, FLATTEST, STEEPEST, STEPS, Verification

COLOURS = (THIRD, PRIOR, POSTERIOR, PUBLISHED, SECOND, MEASURED)
MARKERS = ("v", "^", "o", ".", "s", "x")


def difference_table(found: Verification) -> list[dict[str, str]]:
    """Return rows of text: the change of the field for each change of the model, and the error."""
    def row(what: str, pointwise: float, fourier: float | None) -> dict[str, str]:
        return {"change": what, "pointwise": f"{pointwise:.1e}",
                "Fourier": "" if fourier is None else f"{fourier:.1e}"}

    rows = [row(difference.what, difference.pointwise, difference.fourier)
            | {name: f"{value:.1e}" for name, value in difference.by_region.items()}
            for difference in found.differences]
    rows.append(row(f"estimated error (order {found.order:.1f})", found.error_pointwise,
                    found.error_fourier) | dict.fromkeys(found.differences[0].by_region, ""))
    return rows


def verification_verdict(magnet: Magnet, found: Verification) -> str:
    """Return sentences that state the field's estimated error and compare it with the noise."""
    error = found.error_pointwise * found.main_field_T
    if not error:
        return ("No finite elements are needed: the field is the exact one of the blocks in "
                "vacuum.")
    text = (f"At the study's positions the estimated error of B is {error:.1e} T at most, "
            f"{found.error_pointwise:.1e} of the largest field at these positions "
            f"({found.main_field_T:.4g} T).")
    if magnet.study.noise is not None and magnet.study.noise.regions:
        sigma = min(region.sigma_T for region in magnet.study.noise.regions)
        fourier = magnet.study.observation.quantity == "fourier_coefficients"
        own = found.error_fourier if fourier else found.error_pointwise
        if own is not None:
            text += (f" The error of a {'Fourier coefficient' if fourier else 'reading'} is "
                     f"{own * found.main_field_T / sigma:.2g} of the smallest noise sd in the "
                     f"study ({sigma:.1e} T).")
    if found.order <= FLATTEST:
        text += (" The last refinement does not change the field less than the one before: the "
                 "estimate is rough, and the mesh should be finer.")
    return text


def error_basis(found: Verification) -> str:
    """Return sentences that state how the error is estimated."""
    if found.differences[-1].what == EXACT:
        return "The error is the difference from the exact field of the blocks in vacuum."
    limit = {FLATTEST: " at most", STEEPEST: " at least"}.get(found.order, "")
    boundary = (", plus the change that a boundary farther away makes"
                if found.route != "moments" else "")
    text = ("The estimated error is the total change that all further refinements would make"
            f"{boundary}. It assumes that the changes by successive refinements go on to decrease "
            f"by the same factor as these {STEPS} do, or as the last two if these decrease less "
            f"(order {found.order:.1f}{limit} in the element size).")
    if len(found.differences) > STEPS + 1:
        text += (" The error of the dual formulation has the opposite sign, as far as energies are "
                 "concerned. The difference between the two formulations is the solver's error bar "
                 "of the readings, and not part of the estimate.")
    return text


@own_style
def write_verification(
    magnet: Magnet, found: Verification, folder: Path, provenance: Mapping[str, str]
) -> None:
    """Write verification.json, verification.csv, verification.html and its figures."""
    write_text(folder / "verification.json",
               json.dumps(found.plain(), indent=1, allow_nan=False) + "\n")
    columns = dict(zip(("x_m", "y_m", "z_m"), found.points.T, strict=True))
    with atomic(folder / "verification.csv") as temporary:
        write_csv(columns | {f"{difference.what} in T": change for difference, change in zip(
            found.differences, found.changes, strict=True)}, {"study": magnet.name}, temporary)
    figures = {}
    if found.changes[:STEPS].any():
        figures["verification_convergence.png"] = _convergence_figure(found), (
            "Relative change of the field against element size, both logarithmic: change by the "
            "next finer mesh with the slope of the order, estimated error of the study's own "
            "mesh, and for comparison the changes by a boundary farther away and by another "
            "formulation")
        figures["verification_along.png"] = _change_figure(found), (
            "Change of B at every position of the study, for each change of the model")
    figures["verification_geometry.png"] = geometry_figure(magnet, found.points), (
        "The blocks of the first ring with their easy axes, the iron ring if the study has one, "
        "and the study's positions")
    change = found.changes[STEPS - 1]
    write_page(
        folder / "verification.html", "verification.html.j2", save(figures, folder),
        study=magnet.study, magnet_rows=magnet_rows(magnet),
        provenance=provenance, found=found, rows=difference_table(found), basis=error_basis(found),
        verdict=verification_verdict(magnet, found), refinement=REFINEMENT, flattest=FLATTEST,
        view=view_of_nominal_magnet(magnet, ViewPoints(
            found.points, change, "positions", "change by a<br>finer mesh in T",
            "a finer mesh changes B by %{customdata:.1e} T",
            (float(change.min()), float(change.max())))))


def _convergence_figure(found: Verification) -> Figure:
    """Draw the change by the next finer mesh, relative to the largest field, by element size."""
    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axis = figure.subplots()
    size = 1e3 * found.element_size_m
    sizes = size * np.array([REFINEMENT**2, REFINEMENT, 1.0])
    steps = np.array([difference.pointwise for difference in found.differences[:STEPS]])
    line = size * np.array([REFINEMENT**2, 1 / REFINEMENT])
    axis.plot(sizes, steps, "o", color=POSTERIOR, label="change by the next finer mesh")
    axis.plot(line, steps[-1] * (line / size)**found.order, "-", color=POSTERIOR, lw=0.8,
              label=f"order {found.order:.1f}")
    axis.plot(size, found.error_pointwise, "*", ms=12, color=PRIOR,
              label="estimated error of the study's mesh")
    for difference, style, colour in zip(found.differences[STEPS:], ("--", ":", "-."),
                                         (PUBLISHED, SECOND, MEASURED), strict=False):
        if difference.pointwise > 0:
            axis.axhline(difference.pointwise, ls=style, color=colour,
                         label=difference.what.replace("_", " "))
    axis.set(xscale="log", yscale="log", xlabel="element size at the magnet in mm",
             ylabel="change of B over the largest field")
    axis.set_xticks(size * np.array([1 / REFINEMENT, 1, REFINEMENT, REFINEMENT**2]))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3, which="both")
    axis.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize="small")
    return figure


def _change_figure(found: Verification) -> Figure:
    """Draw the change of B at every position, for each change of the model."""
    figure, (axis,) = stacked_axes(1)
    place, label = axis_of_points(found.points)
    for difference, change, colour, marker in zip(
            found.differences, found.changes, COLOURS, MARKERS, strict=False):
        seen = change > 0
        axis.semilogy(place[seen], change[seen], marker, ms=4, color=colour,
                      label=difference.what.replace("_", " "))
    axis.set(xlabel=label, ylabel="|change of B| in T")
    figure.legend(loc="outside upper center", ncols=2, fontsize="small")
    return figure
