"""Page of `field`: the field on lines, its integrals and its kicks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.core.numbers import csv_text
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.report.answer import Answer, agreement, of_a_conflict
from halbach_fe.report.page import (
    COLOURS_OF_COMPONENTS,
    Page,
    Rows,
    Section,
    Table,
    chart,
    columns_by_axis,
    legend_above,
    linearized,
)
from halbach_fe.report.words import counted, flux_density, with_error
from halbach_fe.response.field_on_lines import FieldOnLines
from halbach_fe.study.types import COMPONENTS


def answer(found: FieldOnLines) -> Answer:
    """Say how strong the field is, what its integrals are, and what to do next."""
    question, lines, rows = "How strong is the field along the lines?", found.lines, _rows(found)
    size = np.linalg.norm(found.mean, axis=2)
    place = lines.points.reshape(-1, 3)[size.argmax()]
    said = (f"On {counted(len(lines.points), 'line')} of {lines.count} points |B| is at most "
            f"{flux_density(float(size.max()), 4)}, at ("
            f"{', '.join(f'{1e3 * value:.4g}' for value in place.round(9) + 0.0)}) mm. The first "
            f"integrals along {_which(found)} are "
            + ", ".join(row["first integral, T m"] for row in rows)
            + " T m for Bx, By, Bz.")
    if unknown := found.without_integrals:
        return Answer(
            question, said, f"Only the field at the points, not its integrals: {unknown}.",
            "Take more points with --count, or a shorter line.",
            "halbach-fe field STUDY --from-m X Y Z --to-m X Y Z --count N -o DIR", sound=False)
    if not found.measured:
        return Answer(
            question, said, "Yes, for the magnet as ordered, not as it was built: ± is what the "
            "tolerances of its blocks (the study's prior), the solver and the spacing of the "
            "points leave open.",
            "Measure it, update its blocks, and ask again with --posterior and the posterior.h5 of "
            "that update.", "halbach-fe infer STUDY --measurements MAP -o DIR")
    if found.disagreement:
        return of_a_conflict(question, said, found.disagreement)
    return Answer(
        question, said, f"{agreement(found.disagreement)} ± is what map, prior, solver and the "
        "spacing of the points leave open.", "Hand the tables to the programs that need them; "
        "halbach-fe export turns field_map.csv into their formats.")


def page(found: FieldOnLines) -> Page:
    """Return the page of the field on lines, with its tables for other programs."""
    study, lines, columns = found.magnet.study, found.lines, integrals(found)
    title, rows = f"Integrals of B along {_which(found)}", _rows(found)
    files: dict[str, Callable[[Path], object] | None] = {
        "field.csv": lambda path: write_text(path, csv_text(_points(found))),
        "field_map.csv": partial(write_map, field_map(
            lines.points.reshape(-1, 3), found.mean.reshape(-1, 3), attributes={
                "study": study.name})),
        "integrals.csv": lambda path: write_text(path, csv_text(columns))}
    without = int(np.isnan(columns.get("kick_u_T2_m2", np.zeros(1))).sum())
    if found.slope is not None and not without:
        files["kick_map.txt"] = partial(write_text, text=kick_map(found))
    no_kicks = "" if not without else (
        f"No kick_map.txt: {without} of {len(lines.points)} lines go through or along blocks "
        "or iron, where no particle flies, and have no kicks.")
    return Page(
        "field", "field on lines", study, answer(found), {
            "lines": len(lines.points), "points_per_line": lines.count,
            "reservation": found.disagreement or None,
            **{name: [None if np.isnan(value) else float(value) for value in values]
               for name, values in columns.items()}},
        [Section([
            "Integrals go from the start of a line to its end, the second over all points between. "
            "± is the standard deviation.", Table(rows), no_kicks, linearized(study)], title)],
        {title: rows}, figures={"field.png": (
            partial(_field_figure, found), f"B along {_which(found)}; bands are two standard "
            "deviations")},
        files=files, remarks=(no_kicks,), stored=False)


def _points(found: FieldOnLines) -> dict[str, Any]:
    """Return the columns of field.csv, a row for each point of every line."""
    columns: dict[str, Floats] = {}
    for name, values in (("{}_m", found.lines.points), ("B{}_T", found.mean),
                         ("sd_B{}_T", found.sd),
                         *zip(("H{}_A_per_m", "sd_H{}_A_per_m"), found.strength, strict=True)):
        columns |= columns_by_axis(name, values)
    return {**columns, "in_block": found.in_block.ravel()}


def integrals(found: FieldOnLines) -> dict[str, Floats]:
    """Return the columns of integrals.csv, a row for each line at the offsets u and v."""
    columns = dict(zip(("u_m", "v_m"), (each.ravel() for each in np.meshgrid(
        *found.lines.across, indexing="ij")), strict=True))
    for order, unit in ((1, "T_m"), (2, "T_m2")):
        mean, sd = found.integrals(order)
        for axis, values, bars in zip(COMPONENTS, mean.T, sd.T, strict=True):
            columns |= {f"I{order}{axis}_{unit}": values, f"sd_I{order}{axis}_{unit}": bars}
    columns["Phi_T2_m3"], columns["sd_Phi_T2_m3"] = found.kick_potential()
    if found.slope is not None:
        for across, (kick, sd) in zip("uv", found.kicks(), strict=True):
            columns |= {f"kick_{across}_T2_m2": kick.ravel(),
                        f"sd_kick_{across}_T2_m2": sd.ravel()}
    return columns


def kick_map(found: FieldOnLines) -> str:
    """Return a kick map in the text format of Radia; rows begin at the highest offset."""
    u, v = found.lines.across
    text = ["# kick map of halbach-fe", "# Length [m]", f"{found.lines.length:.9g}",
            "# Number of Horizontal Points", f"{len(u)}",
            "# Number of Vertical Points", f"{len(v)}"]
    for name, (kick, _) in zip(("Horizontal", "Vertical"), found.kicks(), strict=True):
        text += [f"# {name} 2nd Order Kick [T2m2]", "START",
                 "\t" + "\t".join(f"{one:.9g}" for one in u)]
        text += ["\t".join([f"{v[row]:.9g}", *(f"{value:.12g}" for value in kick[:, row])])
                 for row in range(len(v) - 1, -1, -1)]
    return "\n".join(text) + "\n"


def _middle(found: FieldOnLines) -> int:
    """Return the number of the line in the middle."""
    return len(found.lines.points) // 2


def _which(found: FieldOnLines) -> str:
    """Name the line in the middle, or next to it."""
    u, v = (1e3 * float(each.ravel()[_middle(found)]) for each in np.meshgrid(
        *found.lines.across, indexing="ij"))
    return "the middle line" if not u and not v else f"the line at u = {u:.4g} mm, v = {v:.4g} mm"


def _rows(found: FieldOnLines) -> Rows:
    """Return a row of text for each component of B, with its integrals along `_which`."""
    number = _middle(found)
    (first, sd), (second, sd_second) = (
        [values[number] for values in found.integrals(order)] for order in (1, 2))
    return [{"component": axis, "first integral, T m": with_error(first[i], sd[i]),
             "second integral, T m²": with_error(second[i], sd_second[i])}
            for i, axis in enumerate(COMPONENTS)]


def _field_figure(found: FieldOnLines) -> Figure:
    """Draw the components of B along `_which`."""
    figure, axis = chart(3.8)
    number, along = _middle(found), np.linspace(0, 1e3 * found.lines.length, found.lines.count)
    for name, colour, mean, sd in zip(COMPONENTS, COLOURS_OF_COMPONENTS, found.mean[number].T,
                                      found.sd[number].T, strict=True):
        axis.plot(along, 1e3 * mean, color=colour, label=f"B{name}")
        axis.fill_between(along, 1e3 * (mean - 2 * sd), 1e3 * (mean + 2 * sd), color=colour,
                          alpha=0.3, lw=0)
    axis.set(xlabel="distance from the start in mm", ylabel="B in mT")
    legend_above(figure, axis, columns=3)
    return figure
