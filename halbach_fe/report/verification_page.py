"""Page of `verify`: figures and table of the errors of a computed field."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from halbach_fe.report.answer import Answer
from halbach_fe.report.magnet_view_3d import ViewPoints, field_points, view_of_nominal_magnet
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SECOND,
    THIRD,
    Page,
    Rows,
    Section,
    Table,
    Text,
    View,
    axis_of_points,
    chart,
    columns_by_axis,
    csv_file,
    label_logarithmic,
    last_sections,
    legend_above,
)
from halbach_fe.report.point_maps import geometry_figure
from halbach_fe.report.words import (
    ROUNDING,
    coils_in_words,
    decimals,
    flux_density,
    in_a_row,
    is_fourier,
    magnet_rows,
    ppm,
    relative,
)
from halbach_fe.response.discretization_error import (
    BOUNDARY,
    EXACT,
    FLATTEST,
    REFINEMENT,
    STEEPEST,
    STEPS,
    Verification,
)
from halbach_fe.solver.routes import finer_in_words

COLOURS = (THIRD, PRIOR, POSTERIOR, PUBLISHED, SECOND, MEASURED)
MARKERS = ("v", "^", "o", ".", "s", "x")


def _coarsest(found: Verification) -> int:
    """Return the number of the first refinement that changes the mesh: one that cannot be made any
    coarser changes nothing.
    """
    changed = [number for number in range(STEPS) if found.differences[number].pointwise > 0]
    return min([*changed, STEPS - 1])


def _is_exact(found: Verification) -> bool:
    """Tell whether the field is a closed form; iron far away may add less than the rounding."""
    return found.magnet.is_vacuum and found.error_pointwise < ROUNDING


def difference_table(found: Verification) -> Rows:
    """Return rows of text: the change of the field for each change of the model, and the error, in
    ppm of the largest field; none if the field is exact.
    """
    if _is_exact(found):
        return []

    def row(what: str, pointwise: float, fourier: float | None) -> dict[str, str]:
        return {"change": what, "pointwise in ppm": ppm(1e6 * pointwise)} | (
            {} if fourier is None else {"Fourier in ppm": ppm(1e6 * fourier)})

    regions = found.differences[0].by_region
    several = regions if len(regions) > 1 else ()  # the only one is the whole map
    rows = [row(difference.what, difference.pointwise, difference.fourier)
            | {f"{name} in ppm": ppm(1e6 * difference.by_region[name]) for name in several}
            for difference in found.differences[_coarsest(found):]]
    rows.append(row(f"estimated error (order {found.order:.1f})", found.error_pointwise,
                    found.error_fourier) | {f"{name} in ppm": "" for name in several})
    return rows


def answer(found: Verification) -> Answer:
    """Say how far the computed field is off, whether that matters, and what to do next."""
    question = "How far is the computed field off?"
    error, main = found.error_pointwise * found.main_field_T, found.main_field_T
    measure = ("Measure the magnet, and update its blocks with the map.",
               "halbach-fe infer STUDY --measurements MAP -o DIR")
    if _is_exact(found):
        coils = coils_in_words(found.magnet)
        return Answer(question, f"The computed field {'of the blocks ' if coils else ''}is not off "
                      "at all: no finite elements are needed, it is the exact one of the blocks in "
                      f"vacuum ({flux_density(main, 4)} at most"
                      f"{', with the coils' if coils else ''}).{coils}",
                      "Yes, to that error." if coils else
                      "Yes, to the rounding of the computer: it is a closed form.", *measure)
    said = (f"At the study's positions the vector B is off by {flux_density(error)} at most, by "
            f"estimate. That is {relative(found.error_pointwise)} of the largest field there "
            f"({flux_density(main, 4)}).")
    if is_fourier(found.magnet.study) and found.error_fourier is not None:
        said += (" A reading, which is a Fourier coefficient of B_r on a circle, is off by "
                 f"{flux_density(found.error_fourier * main)} at most: over a circle the errors "
                 "of the elements average out.")
    rough = found.order <= FLATTEST
    noisy, noise = _beside_the_noise(found)
    trust = ("No: the last refinement does not change the field less than the one before. The "
             "estimate is rough, and the mesh should be finer." if rough else
             "Yes: the field converges. The estimate takes it that elements of half the size "
             f"divide the change from mesh to mesh by {2**found.order:.2g} (order "
             f"{found.order:.1f}), no more than these meshes show.")
    keys_of_route = finer_in_words(found.magnet, found.points)
    finer = (f"Take {keys_of_route}, and verify again.",
             "halbach-fe verify STUDY -o DIR") if keys_of_route else measure
    keys = _boundary_keys(found)
    if keys and _boundary_part(found) > error / 2:
        finer = ("Most of the error is that the computed region ends too near. Make "
                 + " and ".join(f"{key} larger (now {1e3 * size:.3g} mm)"
                                for key, size in keys.items()) + ", and verify again.", finer[1])
    bars = "" if rough or found.differences[-1].what == EXACT else (
        "This estimate is from several meshes: quote it, rather than that of halbach-fe solve, "
        "which is from a single comparison and may be several times larger.")
    return Answer(question, said, " ".join(filter(None, (trust, noise, bars))),
                  *(finer if rough or noisy else measure), sound=not rough)


def _beside_the_noise(found: Verification) -> tuple[bool, str]:
    """Tell whether the error is above the noise of the readings, and say how they compare."""
    study = found.magnet.study
    fourier = is_fourier(study)
    own = found.error_fourier if fourier else found.error_pointwise
    if study.noise is None or not study.noise.regions or own is None:
        return False, ""
    sigma = min(region.sigma_T for region in study.noise.regions)
    ratio = own * found.main_field_T / sigma
    return ratio > 1, (
        f"The error of a {'Fourier coefficient' if fourier else 'reading'} is {decimals(ratio, 2)} "
        f"times the smallest noise in the study ({flux_density(sigma)}).")


def _boundary_part(found: Verification) -> float:
    """Return the part of the pointwise error in T that a boundary farther away removes."""
    return sum(each.pointwise for each in found.differences
               if each.what == BOUNDARY) * found.main_field_T


def _boundary_keys(found: Verification) -> dict[str, float]:
    """Return the sizes in m of the computed region that the study states, by their keys.

    The usual ones are so large that a boundary farther away changes the mesh rather than the field.
    """
    stated = found.magnet.study.open_boundary.model_dump(exclude_none=True)
    return {f"open_boundary.{name}": size for name, size in stated.items()}


def _compared(found: Verification) -> str:
    """Name the changes of the model besides refinements, if there are any, for a caption."""
    others = [f"{'a' if each.what == BOUNDARY else 'the'} {each.what}"
              for each in found.differences[STEPS:]]
    return f"; for comparison, the change by {in_a_row(others)}" if others else ""


def error_basis(found: Verification) -> str:
    """Return sentences that state how the error is estimated."""
    if found.differences[-1].what == EXACT:
        return "The error is the difference from the exact field of the blocks in vacuum."
    limit = {FLATTEST: " at most", STEEPEST: " at least"}.get(found.order, "")
    boundary = (", plus the change that a boundary farther away makes, for which there is another "
                "mesh of the same element sizes"
                if found.route != "moments" else "")
    text = ("The estimated error is the total change that all further refinements would make"
            f"{boundary}. It assumes that these changes decrease with the power "
            f"{found.order:.1f}{limit} of the element size: that by which all changes above "
            "decrease, or the last two if they decrease less.")
    if len(found.differences) > STEPS + 1:
        text += (" The error of the dual formulation has the opposite sign, as far as energies are "
                 "concerned. The difference between the two formulations is no part of the "
                 "estimate.")
    reading = "a Fourier coefficient" if is_fourier(found.magnet.study) else "a component of B"
    return (f"{text} The error bars of readings, which halbach-fe solve states, are an estimate "
            f"apart from this one: the change of {reading} by one other discretization.")


def page(found: Verification) -> Page:
    """Return the page of how far the computed field is off."""
    magnet, rows, change = found.magnet, difference_table(found), found.changes[STEPS - 1]
    main_field = flux_density(found.main_field_T, 4)
    figures = {}
    if found.changes[:STEPS].any():
        figures["verification_convergence.png"] = partial(_convergence_figure, found), (
            "Change of the field against element size, both logarithmic: change by the "
            "next finer mesh with the slope of the order, and estimated error of the study's own "
            f"mesh{_compared(found)}")
        figures["verification_along.png"] = partial(_change_figure, found), (
            "Change of B at every position of the study, for each change of the model")
    figures["verification_geometry.png"] = partial(geometry_figure, magnet, found.points), (
        "The blocks of the first ring with their easy axes, "
        f"{'the iron, ' if magnet.iron else ''}and the study's positions")
    fourier = (" Fourier: the same for the Fourier coefficients of B_r on the study's circles."
               if rows and "Fourier in ppm" in rows[0] else "")
    changes = Section([Table(rows, "numbers"), Text(
        f"Of the nominal magnet at the study's {len(found.points)} positions. Pointwise: the "
        f"largest change of B, in ppm of the largest field at these positions, {main_field}."
        f"{fourier} {error_basis(found)}", "small")],
        "Changes of the model, and how much they change the field", about=rows)
    model = {"route": found.route.replace("_", " "), "method": magnet.study.solver.method,
             "elements at the magnet": f"{1e3 * found.element_size_m:.3g} mm; finer by a factor of "
             f"{REFINEMENT}, coarser by it and by its square", **magnet_rows(magnet)}
    view = View(lambda: view_of_nominal_magnet(
        magnet, field_points(found.points, found.field) if not change.any() else ViewPoints(
            found.points, 1e6 * change, "positions", "change by a<br>finer mesh in µT",
            "a finer mesh changes B by %{customdata:.3g} µT")),
        "positions of the study by the change of B that a finer mesh makes" if rows else
        "positions of the study by the magnitude of the field")
    return Page(
        "verify", "verification of the computed field", magnet.study, answer(found), found.plain(),
        [changes, Section([view]), *last_sections(figures, model)],
        {f"Changes of B in ppm of {main_field}, route {model['route']}": rows}, figures=figures,
        files={"verification.csv": csv_file(
            columns_by_axis("{}_m", found.points) | {
                f"{difference.what} in T": column for difference, column in zip(
                    found.differences, found.changes, strict=True)}, {"study": magnet.name})},
        stem="verification")


def _convergence_figure(found: Verification) -> Figure:
    """Draw the change by the next finer mesh, relative to the largest field, by element size."""
    figure, axis = chart(4.6, grid=False)
    size = 1e3 * found.element_size_m
    sizes = (size * np.array([REFINEMENT**2, REFINEMENT, 1.0]))[_coarsest(found):]
    steps = 1e6 * np.array([difference.pointwise
                            for difference in found.differences[_coarsest(found):STEPS]])
    line = size * np.array([REFINEMENT**2, 1 / REFINEMENT])
    axis.plot(sizes, steps, "o", color=POSTERIOR, label="change by the next finer mesh")
    axis.plot(line, steps[-1] * (line / size)**found.order, "-", color=POSTERIOR, lw=0.8,
              label=f"order {found.order:.1f}")
    axis.plot(size, 1e6 * found.error_pointwise, "*", ms=12, color=PRIOR,
              label="estimated error of the study's mesh")
    for difference, style, colour in zip(found.differences[STEPS:], ("--", ":", "-."),
                                         (PUBLISHED, SECOND, MEASURED), strict=False):
        if difference.pointwise > 0:
            axis.axhline(1e6 * difference.pointwise, ls=style, color=colour,
                         label=difference.what.replace("_", " "))
    axis.set(xscale="log", yscale="log", xlabel="element size at the magnet in mm",
             ylabel="change of B in ppm of the largest field")
    label_logarithmic(axis.yaxis)
    axis.set_xticks([*sizes, size / REFINEMENT])
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3, which="both")
    legend_above(figure, axis)
    return figure


def _change_figure(found: Verification) -> Figure:
    """Draw the change of B at every position, for each change of the model."""
    figure, axis = chart(4.1)
    place, label = axis_of_points(found.points)
    for difference, change, colour, marker in zip(
            found.differences, found.changes, COLOURS, MARKERS, strict=False):
        if not change.any():
            continue
        seen = change > 0
        axis.semilogy(place[seen], 1e6 * change[seen], marker, ms=4, color=colour,
                      label=difference.what.replace("_", " "))
    axis.set(xlabel=label, ylabel="|change of B| in µT")
    label_logarithmic(axis.yaxis)
    legend_above(figure, axis)
    return figure
