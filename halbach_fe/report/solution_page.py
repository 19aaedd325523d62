"""Page of `solve`: the field of the nominal magnet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.report.answer import Answer, along_the_axis
from halbach_fe.report.homogeneity_page import (
    sections_of_stray,
    stray_pictures,
    stray_rows,
    stray_title,
)
from halbach_fe.report.magnet_view_3d import field_points, view_of_nominal_magnet
from halbach_fe.report.multipoles_page import (
    MultipoleTable,
    main_field_in_words,
    multipole_csv,
    sections_of_circles,
)
from halbach_fe.report.page import (
    COLOURS_OF_COMPONENTS,
    MEASURED,
    Figures,
    Page,
    Rows,
    Section,
    Table,
    View,
    charts,
    label_logarithmic,
    last_sections,
    legend_above,
)
from halbach_fe.report.point_maps import curve, geometry_figure, maps_figure
from halbach_fe.report.words import (
    ROUNDING,
    coils_in_words,
    counted,
    decimals,
    flux_density,
    is_fourier,
    magnet_rows,
    relative,
)
from halbach_fe.response.multipoles import solved_circles
from halbach_fe.response.solution import Solution, write_solution
from halbach_fe.solver.routes import finer_in_words
from halbach_fe.study.types import COMPONENTS

ROUGH = 1e-3
"""Error of the solver relative to the field above which a solution is not to be used."""


def answer(solution: Solution, tables: Sequence[MultipoleTable] = ()) -> Answer:
    """Say how strong the field is, how far the solver may be off, and what to do next.

    With ``tables``, the multipoles of the study's circles, the main one is said first.
    """
    size = np.linalg.norm(solution.flux_density, axis=1)
    low, high, error = float(size.min()), float(size.max()), float(solution.errors.max())
    equal = flux_density(low, 4) == flux_density(high, 4)
    question = "How strong is the field?"
    main = main_field_in_words(tables, solution.magnet)
    said = (f"{main} At the study's {counted(len(size), 'position')} the nominal magnet makes "
            f"{'' if equal else flux_density(low, 4) + ' to '}{flux_density(high, 4)}.").lstrip()
    of_blocks = ("It is the field of the magnet as the study states it; a magnet that is built has "
                 "the tolerances of its blocks besides.")
    if far := solution.magnet.surroundings(solution.points).far_away():
        return Answer(question, said,
                      f"Not before the positions are checked. {far} {of_blocks}",
                      "Correct the positions, or go on if they are meant to be there.",
                      "halbach-fe solve STUDY -o DIR", False)
    if solution.magnet.is_vacuum and error <= ROUNDING * high:
        coils = coils_in_words(solution.magnet)
        return Answer(question, said,
                      f"Yes: {'the part of the blocks' if coils else 'that'} is exact. The study's "
                      "blocks have a recoil permeability of 1 and there is no iron, so that it is "
                      f"a closed form, without a mesh.{coils} {of_blocks}",
                      *_after_an_exact_field(solution))
    sigma = _smallest_noise(solution)
    reading = ("a Fourier coefficient of B_r on a circle" if is_fourier(solution.magnet.study)
               else "a component of B")
    fine = error <= (sigma or ROUGH * high)
    finer = finer_in_words(solution.magnet, solution.points)
    compared = ("" if not sigma else "Yes: the error is below the noise of the readings, "
                f"{flux_density(sigma)}. " if fine else
                f"Yes, to that error. It is {decimals(error / sigma, 2)} times the noise of the "
                f"readings, {flux_density(sigma)}; error bars of what follows include it. ")
    return Answer(
        question,
        f"{said} By comparison with one other mesh and boundary, {reading} is off by up to "
        f"{flux_density(error)}, {relative(error / high)} of the largest |B|; halbach-fe verify "
        "estimates it from several meshes.",
        f"{compared}{of_blocks}",
        "Check that error with several meshes."
        if fine else
        f"See how the error falls with the mesh, then take {finer}."
        if finer else "Check that error with several meshes. No key of the mesh lowers it: the "
        "grid of the iron is fixed on this route.",
        "halbach-fe verify STUDY -o DIR", error <= ROUGH * high)


def _after_an_exact_field(solution: Solution) -> tuple[str, str]:
    """Return the next step, and its command."""
    if not solution.magnet.has_bore:
        return ("Choose where to measure it." if _smallest_noise(solution) else
                "Add [[noise.regions]] to the study, and choose where to measure it.",
                "halbach-fe plan STUDY -o DIR")
    if solution.magnet.cancels_along_z and not solution.magnet.study.homogeneity:
        return along_the_axis(solution.magnet)
    if solution.magnet.dimension == 2 or solution.magnet.array.multipole_order > 1:
        return ("See its multipoles, with what the tolerances of the blocks make of them.",
                "halbach-fe multipoles STUDY -o DIR")
    return ("See how homogeneous it is, with what the tolerances of the blocks make of it.",
            "halbach-fe homogeneity STUDY -o DIR")


def _smallest_noise(solution: Solution) -> float:
    """Return the smallest standard deviation of a reading in T; 0 if the study states none."""
    noise = solution.magnet.study.noise
    return min((region.sigma_T for region in noise.regions), default=0.0) if noise else 0.0


def page(solution: Solution) -> Page:
    """Return the page of a solved nominal magnet, with the multipoles of full circles."""
    magnet, study, rows = solution.magnet, solution.magnet.study, field_table(solution)
    figures: Figures = {
        "geometry.png": (
            partial(geometry_figure, magnet, solution.points), "The blocks of a ring with their "
            "magnetization and slots, the iron if there is any, and the study's positions"),
        "field.png": (
            partial(field_figure, solution), "The field at the study's positions"
            + (", and the solver's error bar of each reading"
               if solution.errors.any() and curve(solution.points) else "")),
        **stray_pictures(solution.stray_field)}
    multipoles: list[MultipoleTable] = [
        (model, {"nominal": known}) for model, known in solved_circles(
            magnet, solution.points, solution.flux_density, solution.errors)]
    files: dict[str, Callable[[Path], object] | None] = {
        "field_map.h5": lambda path: write_solution(solution, path.parent),
        **dict.fromkeys(("field_map.csv", "field_map.vtu", "readings.csv"))}
    if multipoles:
        files["multipoles.csv"] = multipole_csv(study, multipoles)
    view = View(lambda: view_of_nominal_magnet(magnet, field_points(
        solution.points, solution.flux_density)), "the study's positions by the magnitude of the "
        "field")
    return Page(
        "solve", "the nominal magnet", study, answer(solution, multipoles), solution.summary(), [
            Section([view]), Section([Table(rows)], "The field at the study's positions"),
            *sections_of_stray(solution.stray_field), *sections_of_circles(
                multipoles, magnet, "They are those of the circle's own points. With m points, "
                "order n would contain order m − n too; that part is subtracted, as the blocks "
                "make it in vacuum.", "" if not solution.errors.any() else
                " ± is the standard deviation that the solver's error allows."),
            *last_sections(figures, magnet_rows(magnet))],
        {"The field at the study's positions": rows,
         stray_title(solution.stray_field): stray_rows(solution.stray_field)},
        figures=figures, shown=("field.png",), files=files, stored=False, stem="report",
        provenance={"GetDP": solution.getdp, "method": study.solver.method,
                    "points, readings": f"{len(solution.points)}, {len(solution.readings)}"})


def field_table(solution: Solution) -> Rows:
    """Return rows of text: where the field is strongest and weakest, and the means of B and |B|.

    That of the vector B is 0 on a circle of a multipole, whose |B| is not.
    """
    size = np.linalg.norm(solution.flux_density, axis=1)
    nothing = max(float(solution.errors.max()), ROUNDING * float(size.max()))
    components = COMPONENTS[:solution.magnet.dimension]

    def row(what: str, field: Floats, where: str = "") -> dict[str, str]:
        seen = np.where(np.abs(field) > nothing, field, 0.0)
        return {"B": what, "|B|": flux_density(float(np.linalg.norm(seen)), 5)} | {
            f"B{name}": flux_density(float(value), 5)
            for name, value in zip(components, seen, strict=False)} | {"at": where}

    def at(number: int) -> str:
        point = 1e3 * solution.points[number, :solution.magnet.dimension].round(9) + 0.0
        return "({}) mm".format(", ".join(f"{one:.4g}" for one in point))

    ends = {"strongest": int(np.argmax(size)), "weakest": int(np.argmin(size))}
    return [*(row(what, solution.flux_density[number], at(number))
              for what, number in ends.items()),
            row("mean of the vector B", solution.flux_density.mean(axis=0)),
            {"B": "mean of |B|", "|B|": flux_density(float(size.mean()), 5)}
            | {f"B{name}": "" for name in components} | {"at": ""}]


def field_figure(solution: Solution) -> Figure:
    """Draw the components along a line or a circle, with the error bars below, or as maps.

    Error bars of Fourier coefficients are drawn by their order.
    """
    if (along := curve(solution.points)) is None:
        return maps_figure(solution.points, {
            f"B{name}": 1e3 * column
            for name, column in zip(COMPONENTS, solution.flux_density.T, strict=True)}, "mT")
    place, label = along
    fourier = not any(solution.observation.components)
    bars = ((np.array([float(name[1:]) for name in solution.observation.labels]), "harmonic")
            if fourier else curve(solution.observation.positions))
    below = bars if solution.errors.any() else None  # blocks in vacuum have none
    figure, (top, *others) = charts(5.8, 2, height_ratios=[2, 1], sharex=not fourier) if (
        below) else charts(4.1)
    order = np.argsort(place, kind="stable")
    for component, colour, column in zip(
            COMPONENTS[:solution.magnet.dimension], COLOURS_OF_COMPONENTS, solution.flux_density.T,
            strict=False):
        top.plot(place[order], 1e3 * column[order], ".-", ms=4, lw=0.8, color=colour,
                 label=f"B{component}")
    top.set_ylabel("B in mT")
    legend_above(figure, top, columns=3)
    if below:
        others[0].semilogy(below[0], 1e6 * solution.errors, ".", ms=3, color=MEASURED)
        others[0].set(ylabel="error bar in µT", xlabel=below[1])
        label_logarithmic(others[0].yaxis)
    if not below or fourier:
        top.set_xlabel(label)
    return figure
