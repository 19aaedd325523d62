"""Figures of the readings that prior and posterior predict."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import special

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.inference.result import (
    COVERAGE_Z,
    HELD_OUT,
    HELD_OUT_MAP,
    TRAINING,
    InferenceResult,
    Prediction,
)
from halbach_fe.measurement.observation import Observation
from halbach_fe.measurement.scan_lines import point_spacing
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    chart,
    legend_above,
    stacked_axes,
)
from halbach_fe.report.point_maps import curve, residual_figure, unit_for

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
    """Readings of the same quantity along z, around a circle, or by harmonic.

    Attributes
    ----------
    what : str
        Label of the quantity.
    index : ndarray, shape (n,)
        Numbers of the readings.
    place : ndarray, shape (n,)
        Coordinates of the readings along the line, increasing.
    axis : str
        Name of the coordinate, with its unit.
    """

    what: str
    index: Ints
    place: Floats
    axis: str


def axis_of_readings(result: InferenceResult) -> tuple[Floats, str]:
    """Return the abscissae of all readings in a figure, and the label of that axis.

    The abscissa is z; for readings in a single plane the angle about z; and for Fourier
    coefficients in a single plane their order. Positions are those that the map states; of several
    maps, those in the magnet.
    """
    x, y, z = (result.observation.places if result.is_campaign
               else result.observation.positions).T
    if (along := _line_of_all(result)) is not None:
        return along
    if np.ptp(z) > 0:
        return 1e3 * z, "z in mm"
    if any(result.observation.components):
        return np.degrees(np.arctan2(y, x)) % 360, "angle in degrees"
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
    figure, (top, bottom) = stacked_axes(2, [2, 1])
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
    figure, axes = stacked_axes(2)
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
    legend = figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False,
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


def parts_of(result: InferenceResult, index: Ints) -> Iterator[tuple[str, NDArray[np.bool_]]]:
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
