"""Pictures of the points of a map: where they are in the magnet, numbers at them that fit how they
lie (on a line, around a circle, over angle and z, or in slices), and of the readings that prior and
posterior predict.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from scipy import special
from scipy.spatial import ConvexHull

from halbach_fe.core.arrays import Bools, Floats, Ints, box_middle, degrees_of, radii_of
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import along_edges, at_heights
from halbach_fe.inference.result import (
    COVERAGE_Z,
    HELD_OUT,
    HELD_OUT_MAP,
    TRAINING,
    InferenceResult,
    Prediction,
)
from halbach_fe.measurement.observation_operator import Observation
from halbach_fe.measurement.positions import point_spacing
from halbach_fe.report.page import (
    IRON,
    MEASURED,
    MOST_MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SMALL,
    chart,
    charts,
    figure_of,
    legend_above,
)

SAME = 1e-3
"""Part of the size of a map within which lengths count as equal."""


@dataclass(frozen=True)
class Panel:
    """Points of a map that are drawn in a plane."""

    title: str
    """Where they are."""
    points: Ints
    """Their numbers. Shape (n,)."""
    first: Floats
    second: Floats
    """Abscissae and ordinates, in the units of the labels. Shape (n,)."""
    labels: tuple[str, str]
    lengths: bool
    """Whether both are lengths, drawn to scale if that leaves something to see."""


def curve(points: Floats) -> tuple[Floats, str] | None:
    """Return the abscissae (n,) along the line or circle of points (n, 3) in m, and their label.

    Returns
    -------
    tuple, or None
        None if the points lie on neither.
    """
    centred = points - points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    if len(sizes) < 2 or sizes[1] <= SAME * sizes[0]:
        along = axes[0]
        number = int(np.argmax(np.abs(along)))
        if abs(along[number]) > 1 - SAME:
            return 1e3 * points[:, number], f"{'xyz'[number]} in mm"
        return 1e3 * (centred @ along), "distance along the line in mm"
    radii = radii_of(points)
    if np.ptp(points[:, 2]) <= SAME * radii.max() and np.ptp(radii) <= SAME * radii.max():
        return degrees_of(points), "angle in degrees"
    return None


def panels(points: Floats) -> list[Panel]:
    """Return the planes in which points (n, 3) in m are drawn, which lie on no `curve`."""
    fewest = 12  # fewest points in a slice; with fewer all points are drawn by angle and z
    few_radii = 3  # largest number of radii for which points count as circles about the axis
    every, z = np.arange(len(points)), 1e3 * points[:, 2]
    size = float(np.ptp(points, axis=0).max())
    radii = radii_of(points)
    if np.ptp(points[:, 2]) <= SAME * size:
        return [_slice(points, every, 2)]
    from_middle = np.linalg.norm(points - _centre(points), axis=1)

    def unrolled(title: str, chosen: Ints) -> Panel:
        return Panel(title, chosen, z[chosen], degrees_of(points[chosen]),
                     ("z in mm", "angle in degrees"), lengths=False)

    if np.ptp(from_middle) <= 10 * SAME * from_middle.max():
        return [unrolled(f"on the sphere of {2e3 * from_middle.mean():.4g} mm diameter", every)]
    different, number = _different(radii, SAME * size)
    if len(different) <= few_radii and np.abs(radii - different[number]).max() <= SAME * size:
        return [unrolled(f"at the radius of {1e3 * radius:.4g} mm", np.flatnonzero(number == one))
                for one, radius in reversed(list(enumerate(different))) if radius > SAME * size]
    spacing = point_spacing(points)
    found = []
    for axis in (1, 2):  # from the side, and from the end
        middle = points[np.argmin(np.abs(points[:, axis] - np.median(points[:, axis]))), axis]
        chosen = np.flatnonzero(np.abs(points[:, axis] - middle) <= spacing / 2)
        if len(chosen) >= fewest:
            found.append(_slice(points, chosen, axis))
    return found or [unrolled("all points", every)]


def _centre(points: Floats) -> Floats:
    """Return the centre (3,) of the sphere on which points (n, 3) lie, if they do.

    It solves p² = 2 c·p + constant by least squares.
    """
    matrix = np.column_stack([2 * points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(matrix, np.sum(points**2, axis=1))[0][:3])


def _different(values: Floats, apart: float) -> tuple[Floats, Ints]:
    """Return the different ones (m,) of values (n,), increasing, and the number (n,) of each value.

    Values that differ from their neighbours by no more than ``apart``, such as by rounding, are the
    same; their mean stands for them.
    """
    order = np.argsort(values, kind="stable")
    number = np.empty(len(values), np.intp)
    number[order] = np.append(0, np.cumsum(np.diff(values[order]) > apart))
    return np.asarray(np.bincount(number, values) / np.bincount(number)), number


def _slice(points: Floats, chosen: Ints, across: int) -> Panel:
    """Return the panel of points in a plane across an axis."""
    first, second = {0: (2, 1), 1: (2, 0), 2: (0, 1)}[across]
    middle = 1e3 * float(np.median(points[chosen, across])) + 0.0
    return Panel(f"at {'xyz'[across]} = {round(middle, 3):g} mm", chosen,
                 1e3 * points[chosen, first], 1e3 * points[chosen, second],
                 (f"{'xyz'[first]} in mm", f"{'xyz'[second]} in mm"), lengths=True)


def draw(axis: Axes, panel: Panel, values: Floats, **colours: Any) -> ScalarMappable:
    """Draw values (n,) at the points of a panel: as cells if they fill a grid, else as squares."""
    # Largest ratio of the sides of a slice that is drawn to scale. A longer one would be a line.
    most_aspect = 4.0
    columns, column = _different(panel.first, SAME * float(np.ptp(panel.first)))
    rows, row = _different(panel.second, SAME * float(np.ptp(panel.second)))
    if len(columns) * len(rows) == len(values) and min(len(columns), len(rows)) > 1:
        grid = np.full((len(rows), len(columns)), np.nan)
        grid[row, column] = values
        drawn: ScalarMappable = axis.pcolormesh(columns, rows, grid, shading="nearest",
                                                rasterized=True, **colours)
    else:
        drawn = axis.scatter(panel.first, panel.second, c=values, marker="s",
                             s=float(np.clip(6000 / len(values), 4, 60)), **colours)
    axis.set(xlabel=panel.labels[0], ylabel=panel.labels[1])
    if panel.lengths:
        sides = sorted(float(np.ptp(side)) for side in (panel.first, panel.second))
        axis.set_aspect("equal" if sides[1] <= most_aspect * sides[0] else "auto")
    else:
        axis.set_yticks(range(0, 361, 90))
    axis.set_facecolor("#eeeeee")
    return drawn


def maps_figure(points: Floats, rows: Mapping[str, Floats], unit: str) -> Figure:
    """Draw values (n,) at points (n, 3) in m: a row for each name, a column for each panel."""
    shown = panels(points)
    kept = _not_zero(rows)
    figure, axes = _grid(len(kept), len(shown))
    for number, (line, (name, values)) in enumerate(zip(axes, kept.items(), strict=True)):
        seen = np.concatenate([values[panel.points] for panel in shown])
        for axis, panel in zip(line, shown, strict=True):
            drawn = draw(axis, panel, values[panel.points], cmap="cividis", vmin=np.nanmin(seen),
                         vmax=np.nanmax(seen))
            _name(axis, panel.title, number, len(axes))
        figure.colorbar(drawn, ax=list(line), label=f"{name} in {unit}")
    return figure


def residual_figure(points: Floats, rows: Mapping[str, Mapping[str, Floats]], unit: str) -> Figure:
    """Draw residuals (n,) at points (n, 3) in m: a row for each outer name, a column for each inner
    one, with colours of their own that are symmetric about 0.
    """
    panel = panels(points)[0]
    rows = {name: row for name, row in rows.items()
            if all(np.isfinite(values[panel.points]).any() for values in row.values())} or rows
    figure, axes = _grid(len(rows), len(next(iter(rows.values()))))
    for number, (line, (name, row)) in enumerate(zip(axes, rows.items(), strict=True)):
        for axis, (title, values) in zip(line, row.items(), strict=True):
            seen = values[panel.points]
            limit = float(np.nanquantile(np.abs(seen), 0.99)) or 1.0
            drawn = draw(axis, panel, seen, cmap="RdBu_r", vmin=-limit, vmax=limit)
            figure.colorbar(drawn, ax=axis, label=f"{name} in {unit}", extend="both")
            _name(axis, f"{title}, {panel.title}", number, len(axes))
        for axis in line[1:]:
            axis.set_ylabel("")
    return figure


def _not_zero(rows: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the values that are not zero everywhere; the first ones if all are."""
    sizes = {name: float(np.nanmax(np.abs(values), initial=0.0)) for name, values in rows.items()}
    # part of the largest value of all components below which a component is zero, and not drawn
    nothing = 1e-9
    return {name: values for name, values in rows.items()
            if sizes[name] > nothing * max(sizes.values())} or dict(list(rows.items())[:1])


def _grid(rows: int, columns: int) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure and its axes in rows and columns."""
    figure = figure_of(0.4 + 2.4 * rows, max(4.6 * columns, 6.0))
    # the layout is made before axes are drawn to scale, which moves their labels outwards
    figure.set_layout_engine("constrained", rect=(0.03, 0.0, 0.95, 1.0))
    return figure, figure.subplots(rows, columns, squeeze=False).tolist()


def _name(axis: Axes, title: str, row: int, rows: int) -> None:
    """Give the axes of the first row a title, and those of the last one only the label of x."""
    if not row:
        axis.set_title(title, fontsize="medium")
    if row < rows - 1:
        axis.set_xlabel("")


def unit_for(largest: float) -> tuple[float, str]:
    """Return the factor and the name of the unit in which flux densities in T are drawn."""
    return (1e3, "mT") if largest >= 1e-3 else (1e6, "µT")


MARKERS: dict[str, dict[str, Any]] = {
    TRAINING: {"marker": ".", "ms": 4}, HELD_OUT: {"marker": "o", "mfc": "none", "ms": 4},
    HELD_OUT_MAP: {"marker": "x", "ms": 4, "mew": 0.8}}
"""Style of the markers by part of the readings."""

FAR = 12.0
"""Largest standardized residual for which the axis of residuals is linear."""

FEWEST_ON_A_LINE = 5
"""Fewest readings of a profile."""


@dataclass(frozen=True)
class ReadingLine:
    """Readings of the same quantity along z, around a circle, or by harmonic."""

    what: str
    """Label of the quantity."""
    index: Ints
    """Numbers of the readings. Shape (n,)."""
    place: Floats
    """Coordinates of the readings along the line, increasing. Shape (n,)."""
    axis: str
    """Name of the coordinate, with its unit."""


def axis_of_readings(result: InferenceResult) -> tuple[Floats, str]:
    """Return the abscissae of all readings in a figure, and the label of that axis.

    The abscissa is z; for readings in a single plane the angle about z; and for Fourier
    coefficients in a single plane their order. Positions are those that the map states; of several
    maps, those in the magnet.
    """
    places = (result.observation.places if result.is_campaign
              else result.observation.positions)
    if (along := _line_of_all(result)) is not None:
        return along
    if np.ptp(places[:, 2]) > 0:
        return 1e3 * places[:, 2], "z in mm"
    if any(result.observation.components):
        return degrees_of(places), "angle in degrees"
    return np.array([float(label[1:]) for label in result.observation.labels]), "harmonic"


def _line_of_all(result: InferenceResult) -> tuple[Floats, str] | None:
    """Return abscissae and label if all readings lie on a line or circle, see `curve`."""
    if result.is_campaign or not any(result.observation.components):
        return None
    return curve(result.observation.positions)


def main_line(result: InferenceResult, name: str | None = None) -> ReadingLine:
    """Return the line of readings through the strongest reading, of a map or by default of all.

    It has the readings with the same label and radius; of several maps, those of one map near the
    same line along z. Where several of them have the same z, it has the one nearest to the
    strongest reading in x and y.
    """
    place, axis = axis_of_readings(result)
    maps = np.array(result.maps)
    strongest = int(np.argmax(np.where(
        (maps == name) | (name is None), np.abs(result.readings), -1.0)))
    labels, what = np.array(result.observation.labels), result.observation.labels[strongest]
    if axis == "harmonic":
        labels, what = np.array([label[0] for label in labels]), what[0]
    radii, positions = result.observation.radii, result.observation.positions
    near = np.isclose(radii, radii[strongest], 0, 1e-4) | (_line_of_all(result) is not None)
    if result.is_campaign:  # stages may be inclined, so that lines are not at one radius
        mine = maps == maps[strongest]
        spacing = point_spacing(np.unique(positions[mine], axis=0))
        near = mine & (np.hypot(*(positions - positions[strongest])[:, :2].T) < spacing / 4)
    own = np.flatnonzero((labels == what) & near)
    away = (np.hypot(*(positions[own] - positions[strongest])[:, :2].T) if axis.startswith("z")
            else np.zeros(len(own)))
    order = np.lexsort((away, place[own].round(9)))
    _, first = np.unique(place[own][order].round(9), return_index=True)
    index = own[order[first]]
    return ReadingLine(what if axis != "harmonic" else f"{what}₁ … of the circle", index,
                       place[index], axis)


def prediction_profile_figure(result: InferenceResult, name: str | None = None) -> Figure:
    """Draw readings and predictions along the main line, and the residuals of the posterior."""
    line = main_line(result, name)
    index = line.index
    figure, (top, bottom) = charts(5.8, 2, sharex=True, height_ratios=[2, 1])
    measured = result.readings[index]
    top.plot(line.place, 1e3 * result.prediction_prior.mean[index], color=PRIOR,
             label="predicted before the update", lw=1.2)
    top.plot(line.place, 1e3 * result.prediction_posterior.mean[index], color=POSTERIOR,
             label="predicted after it", lw=1.2)
    difference = measured - result.prediction_posterior.mean[index]
    band = COVERAGE_Z * np.hypot(result.prediction_posterior.sd, result.sigma)[index]
    factor, unit = unit_for(float(max(np.abs(difference).max(), band.max())))
    residual, band = factor * difference, factor * band
    bottom.fill_between(line.place, -band, band, color=POSTERIOR, alpha=0.2, lw=0, step="mid",
                        label="95 % band (prediction and noise)")
    for part, mask in parts_of(result, index):
        for axis, values in ((top, 1e3 * measured), (bottom, residual)):
            axis.plot(line.place[mask], values[mask], ls="none", color=MEASURED, **MARKERS[part],
                      label=f"measured, {part}" if axis is top else None)
    top.set_ylabel(f"reading of {line.what}\nin mT")
    bottom.set_ylabel(f"measured − predicted\nin {unit}")
    bottom.set_xlabel(line.axis)
    legend_above(figure, top, bottom)
    return figure


def has_profile(result: InferenceResult, name: str | None = None) -> bool:
    """Whether enough readings lie on the line of the strongest one to draw a profile.

    Of scattered points, a few have the radius of the strongest one by chance, at few of all z.
    """
    line = main_line(result, name)
    if result.is_campaign or not line.axis.startswith("z"):
        return len(line.index) >= FEWEST_ON_A_LINE
    # a stage's steps are not exact, so that heights count in parts of the spacing
    step_mm = 250 * point_spacing(np.unique(result.observation.positions, axis=0))
    heights = np.unique(np.round(axis_of_readings(result)[0] / step_mm))
    return len(line.index) >= max(FEWEST_ON_A_LINE, len(heights) / 2)


def has_residual_maps(result: InferenceResult) -> bool:
    """Tell whether residuals can be drawn over the points of the map.

    Not of Fourier coefficients, of several maps, or on a line or circle, where the profile shows
    them.
    """
    if result.is_campaign or not all(result.observation.components):
        return False
    points = np.unique(result.observation.positions.round(9), axis=0)
    return len(points) >= FEWEST_ON_A_LINE and curve(points) is None


def residual_maps_figure(
    observation: Observation, residuals: Mapping[str, Floats]
) -> Figure:
    """Draw measured less predicted (readings,) in T, by name, over the points of the map."""
    points, number = np.unique(observation.positions.round(9), axis=0, return_inverse=True)
    factor, unit = unit_for(max(float(np.abs(each).max()) for each in residuals.values()))
    labels = np.array(observation.labels)

    def at_points(label: str, residual: Floats) -> Floats:
        values = np.full(len(points), np.nan)
        mine = labels == label
        values[number.ravel()[mine]] = factor * residual[mine]
        return values

    return residual_figure(points, {label: {
        name: at_points(label, residual) for name, residual in residuals.items()}
        for label in dict.fromkeys(observation.labels)}, unit)


def standardized_residuals_figure(result: InferenceResult) -> Figure:
    """Draw the standardized residuals of all readings for prior and posterior."""
    crowd = 3000  # number of readings from which smaller, transparent markers are used
    place, label = axis_of_readings(result)
    figure, axes = charts(5.8, 2, sharex=True)
    for axis, (name, prediction, colour) in zip(axes, predictions(result), strict=True):
        scores = result.standardized(prediction)
        for part, mask in parts_of(result, np.arange(len(scores))):
            style = {"marker": ".", "ms": 1.5} if len(scores) > crowd else MARKERS[part]
            axis.plot(place[mask], scores[mask], ls="none", label=part, **style,
                      color=MEASURED if part == TRAINING else colour,
                      alpha=0.5 if part == TRAINING or len(scores) > crowd else 1)
        axis.axhspan(-COVERAGE_Z, COVERAGE_Z, color=PUBLISHED, alpha=0.2, lw=0)
        axis.set_ylabel(f"standardized\nresidual, {name}")
        _scale(axis, scores)
    legend = legend_above(figure, axes[0], columns=3,
                          markerscale=5 if len(result.readings) > crowd else 1)
    if len(result.readings) <= crowd:  # the markers tell the parts apart, in two colours
        for handle in filter(None, legend.legend_handles):
            handle.set(color=MEASURED, alpha=1.0)
    axes[1].set_xlabel(label)
    return figure


def whitened_quantiles_figure(result: InferenceResult) -> Figure:
    """Draw the quantiles of whitened residuals against normal quantiles.

    The residuals are those of the held-out readings for prior and posterior. If nothing is held
    out, they are those of the training readings for the prior, which does not depend on them.
    """
    drawn_quantiles = 2000  # largest number of quantiles that are drawn
    figure, axis = chart(5.4, 5.2)
    unseen = result.held_out.any()
    chosen = result.held_out if unseen else ~result.held_out
    count = int(chosen.sum())
    rank = np.unique(np.linspace(1, count, min(count, drawn_quantiles)).round().astype(int))
    normal = special.ndtri((rank - 0.5) / count)
    axis.fill_between(normal, *special.ndtri(
        [special.betaincinv(rank, count - rank + 1, p) for p in (0.025, 0.975)]),
        color=PUBLISHED, alpha=0.3, lw=0,
        label="95 % band of each quantile,\nif the model is right")
    axis.axline((0, 0), slope=1, color=PUBLISHED, lw=0.8)
    found = []
    for name, prediction, colour in predictions(result)[: 2 if unseen else 1]:
        found.append(np.sort(result.whitened(prediction, chosen))[rank - 1])
        axis.plot(normal, found[-1], "." if name == "prior" else "x", color=colour, ms=4, mew=0.8,
                  label=name)
    axis.set(xlabel="normal quantile", ylabel="whitened residual, "
             + ("held-out readings" if unseen else "training readings"))
    _scale(axis, np.concatenate(found))
    legend_above(figure, axis, columns=1)
    return figure


def predictions(result: InferenceResult) -> list[tuple[str, Prediction, str]]:
    """Return name, prediction and colour of prior and posterior."""
    return [("prior", result.prediction_prior, PRIOR),
            ("posterior", result.prediction_posterior, POSTERIOR)]


def parts_of(result: InferenceResult, index: Ints) -> Iterator[tuple[str, Bools]]:
    """Yield each part of the readings that is present, and the mask of its readings."""
    parts = np.array(result.parts)[index]
    for part in MARKERS:
        if (mask := parts == part).any():
            yield part, mask


def _scale(axis: Axes, scores: Floats) -> None:
    """Make the axis symmetric about 0, and logarithmic beyond 3 if a residual exceeds `FAR`."""
    limit = 1.15 * max(3.5, float(np.abs(scores).max()))
    if limit > FAR:
        axis.set_yscale("symlog", linthresh=3.0)
        powers = [3.0, *(10.0**power for power in range(1, 12) if 10.0**power < limit)]
        ticks = [-power for power in reversed(powers)] + [0.0, *powers]
        axis.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.minorticks_off()
    axis.set_ylim(-limit, limit)


MOST_POINTING = 500
"""Largest number of blocks in a cross-section that have arrows: an arrow takes 10 ms, and more of
them than this cannot be told apart."""


def draw_cross_section(axis: Axes, magnet: Magnet, colour: str = "#777777") -> None:
    """Draw the blocks at the first ring's height, with their easy axes, and the iron, in mm.

    ``colour`` is that of the blocks. Their slots have numbers and their easy axes are drawn, unless
    there are too many to read.
    """
    # Distance from a block's middle to its outer side, relative to that from the axis, below which
    # a number has no place in it.
    small_block = 0.15
    # Distance from the axis, relative to that of the farthest block, from which blocks are
    # numbered: those of an inner layer have the same slots.
    outermost = 0.9
    most_numbered = 40  # largest number of blocks in a cross-section whose slots are numbered
    height = magnet.blocks[0].middle[2]  # of the first ring: layers around it are drawn too
    shown = [block for block in magnet.blocks if magnet.dimension == 2 or abs(
        block.middle[2] - height) <= (block.z_max - block.z_min) / 2 - 1e-9]
    reach = max((1e3 * float(np.hypot(*block.middle[:2])) for block in shown), default=0.0)
    numbered = reach > 0 and len(shown) <= most_numbered
    outlines = [1e3 * block.from_frame(at_heights(along_edges(block.outline, 9), 0.0))[:, :2]
                for block in shown]
    if len(shown) > MOST_POINTING:
        axis.plot(*np.vstack([part for outline in outlines for part in (
            outline, [[np.nan, np.nan]])]).T, color=colour, lw=0.3)
        shown = []
    for block, outline in zip(shown, outlines, strict=False):
        axis.plot(*outline.T, color=colour, lw=0.6)
        middle = box_middle(outline)
        arrow = 0.3 * float(np.ptp(outline, axis=0).min()) * np.array(block.easy_axis[:2])
        axis.annotate("", tuple(middle + arrow), tuple(middle - arrow),
                      arrowprops={"arrowstyle": "->", "color": colour, "lw": 0.8})
        distance = float(np.hypot(*middle))
        if numbered and distance > outermost * reach:
            outwards = middle / distance
            edge = float((outline @ outwards).max())
            # between the arrow and the outer side of a large block, beyond that of a small one
            beyond = edge - distance < small_block * reach
            if beyond:
                axis.margins(0.12)
            axis.annotate(
                str(block.slot),
                tuple(outwards * (edge if beyond else 0.25 * distance + 0.75 * edge)),
                tuple(outwards * (SMALL if beyond else 0)), textcoords="offset points",
                ha="center", va="center", fontsize=SMALL, color=colour)
    for body in magnet.iron:
        if body.sphere or not body.in_place:  # its shadow
            shadow = np.column_stack([part.ravel() for part in body.surface[:2]])
            axis.add_patch(Polygon(1e3 * shadow[ConvexHull(shadow).vertices], fill=False,
                                   color=IRON, lw=0.8))
            continue
        if body.outline is not None:
            axis.add_patch(Polygon([(1e3 * edge.start[0], 1e3 * edge.start[1])
                                    for edge in body.outline], fill=False, color=IRON, lw=0.8))
            continue
        for radius in (body.inner_radius, body.outer_radius):
            axis.add_patch(Circle((0, 0), 1e3 * radius, fill=False, color=IRON, lw=0.8))


def _inner_radii(magnet: Magnet) -> list[float]:
    """Return the smallest distance in m of every ring's blocks from the z axis.

    Of a block with flat sides that is the distance of an edge, which no corner has.
    """
    if len(magnet.blocks) > MOST_MEASURED:
        return [inner for _, (inner, _) in magnet.ring_sections]
    found = dict[int, float]()
    for block in magnet.blocks:
        x, y, _ = block.from_frame(at_heights(along_edges(block.outline, 33), 0.0)).T
        found[block.ring] = min(float(np.hypot(x, y).min()), found.get(block.ring, np.inf))
    return list(found.values())


def _side_of(body: IronSolid) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits in m of a body along z, and of its distances from the z axis.

    Of a body of triangles they are those of its shadow along z; of prisms, spheres and tubes that
    are not about that axis, those of the hull of the shadow.
    """
    x, y, z = body.surface
    ends, reach = (float(z.min()), float(z.max())), float(np.hypot(x, y).max())
    if body.is_coaxial:
        return ends, (body.inner_radius, reach)
    shadow = np.stack([x, y], axis=2)
    if body.triangles is None:
        shadow = shadow.reshape(-1, 2)
        shadow = shadow[ConvexHull(shadow).vertices][None]
    return ends, (_from_axis(shadow), reach)


def _from_axis(polygons: Floats) -> float:
    """Return the distance of the origin from convex polygons (m, n, 2), 0 within one of them."""
    along = np.roll(polygons, -1, axis=1) - polygons
    left = polygons[..., 0] * along[..., 1] - polygons[..., 1] * along[..., 0]
    if ((left > 0).all(axis=1) | (left < 0).all(axis=1)).any():
        return 0.0
    share = np.clip(-np.sum(polygons * along, axis=2) / np.maximum(
        np.sum(along**2, axis=2), np.finfo(float).tiny), 0, 1)  # sides of walls along z are points
    return float(np.linalg.norm(polygons + share[..., None] * along, axis=2).min())


def geometry_figure(magnet: Magnet, points: Floats, others: Floats | None = None) -> Figure:
    """Draw the positions of readings in the cross-section of the magnet.

    If the positions are not in a single plane, a second panel shows them by z and distance from
    the axis; of a cross-section, which has no ends, none does.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    others : ndarray, shape (m, 3), in m, optional
        Positions of held-out readings.
    """
    flat = magnet.dimension == 2 or np.ptp(points[:, 2]) == 0
    figure = figure_of(5.8, 5.5) if flat else figure_of(4.2)
    left, *right = figure.subplots(1, 1 if flat else 2, squeeze=False)[0]
    draw_cross_section(left, magnet)
    left.set(aspect="equal", xlabel="x in mm", ylabel="y in mm")
    for axis in right:
        axis.set(xlabel="z in mm", ylabel="distance from the axis in mm")
        axis.grid(alpha=0.3)
        for (z_limits, (_, outer)), inner in zip(
                magnet.ring_sections, _inner_radii(magnet), strict=True):
            axis.add_patch(Rectangle(
                (1e3 * z_limits[0], 1e3 * inner), 1e3 * (z_limits[1] - z_limits[0]),
                1e3 * (outer - inner), fill=False, color="#777777", lw=0.6))
        for body in magnet.iron:
            (start, end), (inner, outer) = _side_of(body)
            axis.add_patch(Rectangle((1e3 * start, 1e3 * inner), 1e3 * (end - start),
                                     1e3 * (outer - inner), fill=False, color=IRON, lw=0.8))
    for positions, marker, colour, name in ((points, ".", POSTERIOR, "positions"),
                                            (others, "x", PRIOR, "held out")):
        if positions is None:
            continue
        x, y, z = 1e3 * positions.T
        left.plot(x, y, marker, ms=3, color=colour, label=name)
        for axis in right:
            axis.plot(z, np.hypot(x, y), marker, ms=3, color=colour)
    for axis in right:
        axis.set_ylim(0, None)  # last, because setting a limit ends the automatic scaling
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=2,
                  markerscale=3)
    return figure
