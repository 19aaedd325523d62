"""Table and figure of the field outside of a magnet."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle

from halbach_fe.report.page import (
    POSTERIOR,
    SECOND,
    SMALL,
    Drawn,
    Figures,
    Section,
    Table,
    figure_of,
)
from halbach_fe.report.words import decimals, with_error
from halbach_fe.response.stray_field import NEAREST, StrayField

STRAY_FIGURE = "stray_field.png"


def line_name(stray: StrayField) -> str:
    """Return the name of the line at which |B| falls to the limit."""
    return f"{decimals(1e3 * stray.limit_T)}\u00a0mT line"


def sections_of_stray(stray: StrayField | None, drawn: bool = False) -> list[Section]:
    """Return the section of a page about the field outside; none if there is nothing to say.

    ``drawn`` tells whether the figure of `stray_pictures` is in it.
    """
    if stray is None:
        return []
    said = stray.unknown or (
        f"The largest distances at which |B| reaches {decimals(1e3 * stray.limit_T)}\u00a0mT, the "
        "usual limit of access to rooms of MRI magnets. The field is that of the magnet alone, "
        "without shields or external fields." + ("" if not _is_uncertain(stray) else
        " Without ± the standard deviation is below 0.5 mm."))
    rows = stray_rows(stray)
    return [Section([said, Table(rows), *([Drawn(STRAY_FIGURE)] if drawn and rows else [])],
                    f"Outside of the magnet: the {line_name(stray)}")]


def _is_uncertain(stray: StrayField) -> bool:
    """Tell whether the distances are those of an updated magnet, with standard deviations."""
    return any(reach is not None and reach.sd_m for reach in (stray.radial, stray.axial))


def stray_rows(stray: StrayField | None) -> list[dict[str, str]]:
    """Return a row of text for the sides of the magnet and one for its ends; none if unknown."""
    if stray is None or stray.unknown:
        return []
    rows = []
    for name, whence, own, reach in (
            ("beside the magnet", "the z axis", stray.radius_m, stray.radial),
            ("beyond its ends", "the plane z = 0", stray.half_length_m, stray.axial)):
        if reach is None:
            near = 1e3 * NEAREST * stray.radius_m
            rows.append({
                line_name(stray): name, "farthest": f"less than {1e3 * own + near:.3g}\u00a0mm",
                "from": whence, "from the magnet": f"less than {near:.2g}\u00a0mm", "at": ""})
            continue
        place = ", ".join(f"{1e3 * one:.0f}" for one in np.round(reach.at_m, 3) + 0.0)
        rows.append({
            line_name(stray): name, "farthest": f"{distance_text(reach.distance_m, reach.sd_m)}",
            "from": whence, "from the magnet": f"{1e3 * (reach.distance_m - own):.0f}\u00a0mm",
            "at": f"({place}) mm"})
    return rows


def distance_text(distance_m: float, sd_m: float) -> str:
    """Return a distance in mm, with its standard deviation if it is 0.5 mm or more."""
    text = with_error(round(1e3 * distance_m), 1e3 * sd_m) if sd_m >= 5e-4 else (
        f"{1e3 * distance_m:.0f}")
    return f"{text}\u00a0mm"


def stray_pictures(stray: StrayField | None) -> Figures:
    """Return figure and caption of the field outside by file name; none if it is unknown."""
    if stray is None or stray.unknown:
        return {}
    return {STRAY_FIGURE: (partial(stray_figure, stray), (
        f"|B| outside of the magnet in planes through its middle, in mT. Thick: the "
        f"{line_name(stray)}; dashed: the largest distances"))}


def stray_figure(stray: StrayField) -> Figure:
    """Draw lines of equal |B| around the magnet in three planes, in mm and mT."""
    others_t = (1e-4, 2e-4, 1e-3, 5e-3, 2e-2)  # flux densities of the thinner lines of the figure
    figure = figure_of(6.6)
    axes = figure.subplots(2, 2).ravel()
    radius, half = 1e3 * stray.radius_m, 1e3 * stray.half_length_m
    reached = [reach.distance_m for reach in (stray.radial, stray.axial) if reach]
    # half width of the figure's planes, relative to the largest distance of the line
    around = 1.15
    widest = 1e3 * (around * max(reached) if reached else max(
        float(np.abs(plane.first_m).max()) for plane in stray.planes))
    for axis, plane in zip(axes[:-1], stray.planes, strict=True):
        names = [name for name in "xyz" if name != plane.across]
        first, second = 1e3 * plane.first_m, 1e3 * plane.second_m
        size = np.log(np.maximum(plane.size_T, min(*others_t, stray.limit_T) / 10))  # may be 0
        if plane.across == "z":
            axis.add_patch(Circle((0, 0), radius, color="#cccccc", lw=0))
            limits: list[Patch] = [Circle(
                (0, 0), 1e3 * stray.radial.distance_m, fill=False, ls="--", lw=0.8,
                color=SECOND)] if stray.radial else []
        else:
            axis.add_patch(Rectangle((-radius, -half), 2 * radius, 2 * half, color="#cccccc", lw=0))
            limits = []
            if stray.radial and stray.axial:
                out, up = 1e3 * stray.radial.distance_m, 1e3 * stray.axial.distance_m
                limits = [Rectangle((-out, -up), 2 * out, 2 * up, fill=False, ls="--", lw=0.8,
                                    color=SECOND)]
        for patch in limits:
            axis.add_patch(patch)
        low, high = float(plane.size_T.min()), float(plane.size_T.max())
        thin = [value for value in others_t if low < value < high and value != stray.limit_T]
        if thin:
            lines = axis.contour(first, second, size, np.log(thin), colors="#777777",
                                 linewidths=0.6, linestyles="solid")
            axis.clabel(lines, fmt=lambda level: decimals(1e3 * float(np.exp(level)), 2),
                        fontsize=SMALL)
        if low < stray.limit_T < high:
            axis.contour(first, second, size, [np.log(stray.limit_T)], colors=POSTERIOR,
                         linewidths=2, linestyles="solid")
        axis.set(aspect="equal", xlabel=f"{names[0]} in mm", ylabel=f"{names[1]} in mm",
                 xlim=(-widest, widest), ylim=(-widest, widest))
        axis.grid(alpha=0.3)
    _explain(axes[-1], stray)
    return figure


def _explain(axis: Axes, stray: StrayField) -> None:
    """Say in an empty panel what is drawn in the others."""
    axis.set_axis_off()
    shown = [Patch(color="#cccccc", label="cylinder around the magnet"),
             Line2D([], [], color=POSTERIOR, lw=2, label=line_name(stray)),
             Line2D([], [], color="#777777", lw=0.6, label="other |B|, in mT")]
    if stray.radial:
        shown.append(Line2D([], [], color=SECOND, lw=0.8, ls="--",
                            label="largest distances of\nthat line from the middle"))
    axis.legend(handles=shown, loc="center", frameon=False)
