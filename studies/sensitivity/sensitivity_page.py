"""Figures, tables and page of a sensitivity study of a cross-section."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    IRON,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    THIRD,
    Page,
    Section,
    Table,
    Text,
    csv_file,
    figure_of,
    label_logarithmic,
    legend_above,
)
from halbach_fe.report.point_maps import draw_cross_section
from halbach_fe.report.words import flux_density, fraction


@dataclass(frozen=True)
class Sensitivity:
    """Results of a sensitivity study.

    Attributes
    ----------
    block : int
        Slot, counted from 1, of the block with respect to whose magnetization the map of the
        derivative is taken.
    x, y : ndarray, shape (n,), in m
        Coordinates of the map's columns and rows.
    size : ndarray, shape (n, n), in T m/A
        Magnitude of the derivative |B'| by y and x; NaN outside the mesh.
    angle : ndarray, shape (m,), in rad
        Angles of the readings on the circle.
    along, across : ndarray, shape (m, blocks), in T
        Magnitude of the change of B at each reading if a block has 1 % more magnetization, and if
        its magnetization is turned by 1 degree.
    printed_form : float
        Largest relative error on the circle of the derivative if it is computed with the formula
        as printed in the paper, which takes the iron's reluctivity at the field of the derivative.
    information : mapping
        Numbers of points, and expected information in nats for each, by name of the plan.
    unknowns : int
        Number of components of the magnetizations.
    """

    block: int
    x: Floats
    y: Floats
    size: Floats
    angle: Floats
    along: Floats
    across: Floats
    printed_form: float
    information: Mapping[str, tuple[Ints, Floats]]
    unknowns: int


def answer(found: Sensitivity, plans: Mapping[str, Mapping[str, Any]]) -> Answer:
    """Say how much a reading changes with a block, and which plan of the measurement is best."""
    name, best = min(plans.items(), key=lambda plan: float(
        plan[1]["mean_sd_over_study_with_as_many_points"]))
    same = best["points_with_the_study_information"]
    said = (f"If a block has 1 % more magnetization, a reading on the circle changes by up to "
            f"{flux_density(float(found.along.max()))}; if it is turned by 1°, by up to "
            f"{flux_density(float(found.across.max()))}. The best plan is to measure {name}: "
            f"{best['points']} positions leave "
            f"{fraction(float(best['mean_sd_over_study_with_as_many_points']))} of the uncertainty "
            "that as many on the study's circle leave"
            + (f", and {same} tell as much as the whole circle." if same else "."))
    return Answer(
        "How much does the field tell about the blocks, and where should it be measured?", said,
        "Yes, as far as the study's prior and noise are right, for small changes: the iron is "
        "linearized about the nominal magnet.",
        "Plan the measurement of your own magnet.", "halbach-fe plan STUDY -o DIR")


def page(magnet: Magnet, found: Sensitivity, plans: Mapping[str, Mapping[str, Any]]) -> Page:
    """Return the page of a sensitivity study; ``plans`` are the summaries of plans, by name."""
    readings, blocks = found.along.shape
    return Page("sensitivity", "what the field tells about its blocks", magnet.study,
                answer(found, plans), {
        "study": magnet.name, "block": found.block, "printed_form_error": found.printed_form,
        "largest_one_percent_T": float(found.along.max()),
        "smallest_one_percent_T": float(found.along.min()),
        "largest_one_degree_T": float(found.across.max()), "plans": plans}, [
        Section([Text(
            "The derivatives are those of the non-linear problem at the nominal magnet, with the "
            "differential reluctivity of the iron (the Gateaux derivative). The formula as printed "
            "in the paper, which takes the reluctivity at the field of the derivative, deviates on "
            f"the circle by up to {100 * found.printed_form:.2g} %.", "small")]),
        Section([Table(plan_rows(plans), "numbers"), Text(
            "Uncertainty is the geometric mean of the standard deviations of all patterns of "
            "blocks (the principal axes of the posterior).", "small")], "Where to measure")],
        rows=plan_rows(plans), figures={
            "derivative.png": (
                partial(_derivative_figure, magnet, found), f"Change of B if block {found.block} "
                "(outlined) has 1 % more magnetization, on a logarithmic scale: the derivative of "
                "B with respect to its magnetization, times 1 % of that"),
            "readings.png": (
                partial(_sensitivity_of_readings_figure, found), "Change of B at every reading of "
                "the circle for every block: for 1 % more magnetization, and for a turn by 1 "
                "degree"),
            "information.png": (
                partial(_uncertainty_of_plans_figure, found), "Uncertainty of all patterns of "
                "blocks that remains, in the geometric mean, against the number of points")},
        files={"readings.csv": csv_file({
            "angle_rad": np.repeat(found.angle, blocks),
            "slot": np.tile(np.arange(1, blocks + 1), readings),
            "one_percent_T": found.along.ravel(), "one_degree_T": found.across.ravel()}, {})})


def plan_rows(plans: Mapping[str, Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return a row of text per plan."""
    return [{
        "where": name, "positions": str(plan["points"]),
        f"positions that tell as much as the {plan['study_points']} of the circle":
            str(plan["points_with_the_study_information"] or f"more than {plan['points']}"),
        "uncertainty beside as many on the circle":
            fraction(float(plan["mean_sd_over_study_with_as_many_points"]))}
        for name, plan in plans.items()]


def _derivative_figure(magnet: Magnet, found: Sensitivity) -> Figure:
    """Draw by how much 1 % more magnetization of the block changes B, with all blocks."""
    smallest_shown = 1e-4  # smallest change that has a colour of its own, relative to the largest
    figure = figure_of(6)
    axis = figure.subplots()
    block = next(each for each in magnet.blocks if each.slot == found.block)
    change_mT = 1e3 * 0.01 * float(np.linalg.norm(block.magnetization)) * found.size
    largest = float(np.nanmax(change_mT))
    shown = axis.pcolormesh(1e3 * found.x, 1e3 * found.y, change_mT, shading="nearest",
                            norm=LogNorm(largest * smallest_shown, largest), cmap="cividis",
                            rasterized=True)
    draw_cross_section(axis, magnet, "black")
    outline = np.vstack([edge.at(np.linspace(0, 1, 9))[0] for edge in block.outline])
    axis.plot(*1e3 * block.from_frame(np.column_stack([outline, 0 * outline[:, 0]])).T[:2],
              color=THIRD, lw=2)
    axis.set(aspect="equal", xlabel="x in mm", ylabel="y in mm")
    bar = figure.colorbar(shown, label="|change of B| in mT", extend="min")
    label_logarithmic(bar.ax.yaxis)
    return figure


def _sensitivity_of_readings_figure(found: Sensitivity) -> Figure:
    """Draw the change of B by reading and block, for both kinds of change."""
    figure = figure_of(4.2)
    axes = figure.subplots(1, 2, sharey=True)
    degrees = np.degrees(found.angle)
    blocks = np.arange(1, found.along.shape[1] + 1)
    for axis, values, name in zip(axes, (found.along, found.across),
                                  ("1 % more magnetization", "turned by 1 degree"), strict=True):
        shown = axis.pcolormesh(blocks, degrees, 1e3 * values, shading="nearest", cmap="cividis")
        axis.set(xlabel="slot", title=name)
        figure.colorbar(shown, label="|change of B| in mT", ax=axis)
    axes[0].set_ylabel("angle of the reading in degrees")
    return figure


def _uncertainty_of_plans_figure(found: Sensitivity) -> Figure:
    """Draw the uncertainty that all plans leave against the number of points."""
    figure = figure_of(4.2)
    axis = figure.subplots()
    colours = (PRIOR, POSTERIOR, PUBLISHED, IRON)
    for (name, (counts, gain)), colour in zip(found.information.items(), colours, strict=False):
        # dashed and in front, because curves of other plans may lie almost on the first
        axis.plot(counts, 100 * np.exp(-gain / found.unknowns), color=colour, label=name,
                  ls="--" if colour == PRIOR else "-", zorder=3 if colour == PRIOR else 2)
    axis.set(xlabel="points", ylabel="uncertainty that remains in %", xlim=(0, None),
             yscale="log")
    label_logarithmic(axis.yaxis)
    axis.grid(alpha=0.3)
    legend_above(figure, axis)
    return figure
