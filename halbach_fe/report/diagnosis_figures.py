"""Figures of a diagnosis, for the model before and after it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.diagnosis.effect_selection import DETECTION_LOG_ODDS
from halbach_fe.diagnosis.marginal_evidence import ResidualGroup
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.diagnosis.summary import label_in_words, place_in_words, rivals
from halbach_fe.inference.result import COVERAGE_Z, InferenceResult
from halbach_fe.measurement.positions import point_spacing
from halbach_fe.report.diagnosis_answer import catalogue_titles, title_of
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SECOND,
    SMALL,
    Rows,
    chart,
    charts,
    draw_by_slot,
    figure_of,
    legend_above,
)
from halbach_fe.report.point_maps import (
    FEWEST_ON_A_LINE,
    axis_of_readings,
    residual_maps_figure,
    unit_for,
)

NONE, UNKNOWN, OUTSIDE = "none", "unknown", "outside the catalogue"
"""Names of the probabilities that nothing is missing, and an unlisted cause, and that in words."""

MAX_BARS = 8
"""Largest number of bars of a chart, and of rows of residuals."""
RESIDUAL_LIMIT = 5.0
"""Standardized residual at the end of the colour scale."""

GROUP_TITLES = {"map": "by map", "z": "along z", "angle": "by angle", "radius": "by radius",
                "label": "by reading"}
"""Titles of the kinds of groups of readings."""


@dataclass(frozen=True)
class State:
    """A model in a report: the study before the diagnosis, or with the findings."""

    when: str
    """Label of the state."""
    update: InferenceResult
    groups: Sequence[ResidualGroup]
    loo_residuals: Floats
    """Standardized leave-one-out residuals of the training readings. Shape (n,)."""
    colour: str
    marker: str
    """Of the state in figures."""


def states(diagnosis: Diagnosis) -> list[State]:
    """Return the states before and after a diagnosis; one state if the diagnosis added nothing."""
    before = State("before", diagnosis.before, diagnosis.groups_before,
                   diagnosis.loo_residuals_before, PRIOR, "o")
    after = State("after", diagnosis.after, diagnosis.groups_after,
                  diagnosis.loo_residuals_after, POSTERIOR, "s")
    if diagnosis.study == diagnosis.corrected_study:
        return [replace(after, when="the study without changes")]
    return [before, after]


def groups(diagnosis: Diagnosis) -> Figure:
    """Draw chi-squared of groups of readings, with the kind that has most groups on the left."""
    kinds = [group.kind for group in diagnosis.groups_before]
    sizes = {kind: kinds.count(kind) for kind in kinds}
    if not sizes:
        figure, axis = chart(1, grid=False)
        axis.text(0.5, 0.5, "too few readings to group them", ha="center", transform=axis.transAxes)
        axis.set_axis_off()
        return figure
    first, *others = sorted(sizes, key=lambda kind: -sizes[kind])
    tallest = max(sizes[first], sum(sizes[kind] + 1.5 for kind in others))
    figure = figure_of(1.1 + 0.21 * tallest)
    left, *right = figure.subfigures(1, 2 if others else 1, squeeze=False)[0]
    axes = [left.subplots()]
    if others:
        axes += right[0].subplots(len(others), 1, sharex=True, squeeze=False, gridspec_kw={
            "height_ratios": [sizes[kind] + 0.5 for kind in others]})[:, 0].tolist()
    shown = states(diagnosis)
    everything = [group.chi2_per_reading for state in shown for group in state.groups]
    limits = max(0.1, 0.9 * min(0.9, *everything)), 1.1 * max(1.1, *everything)
    for axis, kind in zip(axes, [first, *others], strict=True):
        names = [group.name for group in diagnosis.groups_before if group.kind == kind]
        axis.axvline(1.0, color=PUBLISHED, lw=0.8)
        for state in shown:
            for group in state.groups:
                if group.kind == kind and group.name in names:
                    axis.plot(max(group.chi2_per_reading, limits[0]), names.index(group.name),
                              state.marker, ms=6, color=state.colour, clip_on=False,
                              mfc=state.colour if group.disagrees else "white")
            axis.plot([], [], state.marker, color=state.colour, label=state.when)
        axis.set_yticks(range(len(names)), names, fontsize=SMALL)
        axis.set_ylim(len(names) - 0.4, -0.6)
        axis.set_title(GROUP_TITLES.get(kind, kind), fontsize="medium", loc="left")
        axis.grid(alpha=0.3, axis="x")
        if limits[1] > 5:
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(LogLocator(
                subs=(1, 2, 5) if limits[1] < 100 * limits[0] else (1,)))
            axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.xaxis.set_minor_formatter(NullFormatter())
        axis.set_xlim(*limits)
    legend_above(figure, axes[0])
    for axis in (axes[0], axes[-1]):
        axis.set_xlabel("chi² per reading (1 expected)")
    return figure


def residuals(diagnosis: Diagnosis) -> Figure:
    """Draw standardized residuals, one row for each component (or coefficient) and radius, or
    map of several.
    """
    before = diagnosis.before
    observation, chosen = before.observation, ~before.held_out
    labels = np.array(["".join(c for c in label if not c.isdigit())
                       for label in observation.labels])[chosen]
    names = list(dict.fromkeys(before.maps))
    group = np.array([names.index(name) for name in before.maps], float) if (
        before.is_campaign) else np.round(observation.radii, 5)
    group = group[chosen]
    rows = [(label, one) for label in dict.fromkeys(labels.tolist()) for one in np.unique(group)]
    apart = len(rows) <= MAX_BARS
    if not apart:
        rows = [(label, -1.0) for label in dict.fromkeys(labels.tolist())]
    shown = states(diagnosis)
    figure = figure_of(1.2 + 1.15 * len(rows))
    axes = figure.subplots(len(rows), len(shown), sharex=True, sharey="row", squeeze=False)
    coloured = False
    for (label, one), row in zip(rows, axes, strict=True):
        mine = np.flatnonzero((labels == label) & ((group == one) | (not apart)))
        for axis, state in zip(row, shown, strict=True):
            coloured |= _residual_map(axis, diagnosis.before, np.flatnonzero(chosen)[mine],
                                      state.loo_residuals[mine])
        which = f"map {names[int(one)]}" if before.is_campaign else f"{1e3 * one:.0f} mm"
        row[0].set_ylabel(label + (f", {which}" if apart and len(set(group)) > 1 else "")
                          + "\n" + row[0].get_ylabel())
        for axis in row[1:]:
            axis.set_ylabel("")
    for axis, state in zip(axes[0], shown, strict=True):
        axis.set_title(state.when)
    for axis in axes[:-1].ravel():
        axis.set_xlabel("")
    if coloured:
        figure.colorbar(_colours(RESIDUAL_LIMIT), ax=list(axes.ravel()), extend="both", aspect=40,
                        shrink=0.8, label="standardized residual")
    return figure


def _residual_map(axis: Axes, update: InferenceResult, readings: Ints, values: Floats) -> bool:
    """Draw residuals over z and angle, or over one of them if the readings are on a line or circle.

    Returns
    -------
    bool
        Whether the residuals are shown by colour.
    """
    observation = update.observation
    x, y, z = 1e3 * (observation.places if update.is_campaign
                     else observation.positions)[readings].T
    numbers = ["".join(c for c in update.observation.labels[reading] if c.isdigit())
               for reading in readings]
    up = np.degrees(np.arctan2(y, x)) % 360
    name = "angle in °"
    if all(numbers):
        up, name = np.array(numbers, float), "order"
    axis.set_xlabel("z in mm")
    if np.ptp(z) == 0 or len(np.unique(np.round(up))) < 3:
        axis.axhspan(-COVERAGE_Z, COVERAGE_Z, color=PUBLISHED, alpha=0.3, lw=0)
        axis.plot(up if np.ptp(z) == 0 else z, values, ".", color=MEASURED, ms=4)
        axis.set_xlabel(name if np.ptp(z) == 0 else "z in mm")
        axis.set_ylabel("residual")
        return False
    columns, column = np.unique(np.round(z, 3), return_inverse=True)
    rows, row = np.unique(np.round(up, 3), return_inverse=True)
    limits: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -RESIDUAL_LIMIT, "vmax": RESIDUAL_LIMIT}
    if len(columns) * len(rows) <= 4 * len(values) and len(columns) > 1:
        grid = np.full((len(rows), len(columns)), np.nan)
        order = np.argsort(np.abs(values))  # the largest residual of a cell is drawn last
        grid[row[order], column[order]] = values[order]
        axis.pcolormesh(columns, rows, grid, shading="nearest", rasterized=True, **limits)
    else:
        axis.scatter(z, up, c=values, s=9, **limits)
    if name == "order":
        axis.set_yticks(rows)
    else:
        axis.set_yticks([0, 120, 240])
    axis.set_facecolor("#eeeeee")
    axis.set_ylabel(name)
    return True


def _colours(limit: float) -> ScalarMappable:
    """Return the colour scale of values between -``limit`` and ``limit``."""
    return ScalarMappable(Normalize(-limit, limit), "RdBu_r")


def probabilities(diagnosis: Diagnosis) -> Figure:
    """Draw the probabilities of effects, and Bayes factors of identified effects and rivals."""
    bar_in, line_in = 0.3, 0.14  # height in inches of a bar, and of every further line of its name
    longest_name = 38  # number of characters in a line of an effect's name beside its bar
    top = sorted(diagnosis.probabilities.items(), key=lambda item: -item[1])[:MAX_BARS]
    titles = catalogue_titles(diagnosis)

    def in_words(name: str, place: str = "") -> str:
        """Return the description of an effect in short lines."""
        said = {NONE: "nothing is missing", UNKNOWN: OUTSIDE}.get(name) or title_of(name, titles)
        return textwrap.fill(", ".join(filter(None, (said, label_in_words(place)))), longest_name)

    bars = []
    for effect in diagnosis.identified:
        own = effect.hypothesis
        bars.append((in_words(own.effect.name, place_in_words(own.place)),
                     effect.selection.log_bayes_factor, POSTERIOR))
        bars += [("or " + in_words(rival.effect, rival.place), factor, PUBLISHED)
                 for rival, factor in rivals(effect)]
    if diagnosis.unknown is not None:
        bars.append((OUTSIDE, diagnosis.unknown.log_bayes_factor, SECOND))
    bars = bars[:2 * MAX_BARS]
    names = [in_words(name) for name, _ in top]
    heights = [0.7 + (bar_in + line_in * max(name.count("\n") for name in own)) * len(own)
               for own in (names, [name for name, *_ in bars]) if own]
    figure = figure_of(sum(heights) + 0.2)
    left, *others = figure.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    left.barh(names, [100 * value for _, value in top], color=POSTERIOR)
    for height, (_, value) in enumerate(top):
        said = f"{100 * value:.2f} %" if value > 1e-4 else "less than 0.01 %"
        left.text(100 * value + 1, height, said, va="center", fontsize=SMALL)
    left.set_xlim(0, 130)
    left.set_xticks(range(0, 101, 20))
    left.set_xlabel("probability in %, if at most one effect is missing")
    left.set_ylim(len(top) - 0.4, -0.6)
    for right in others:
        right.barh(range(len(bars)), [value / np.log(10) for _, value, _ in bars],
                   color=[colour for *_, colour in bars])
        right.set_yticks(range(len(bars)), [name for name, *_ in bars])
        right.set_xscale("log")  # factors range from a few to 1e5
        right.set_xlim(left=0.3)
        right.axvline(DETECTION_LOG_ODDS / np.log(10), color=MEASURED, lw=0.8, ls="--")
        right.set_xlabel("power of ten of the Bayes factor")
        right.set_ylim(len(bars) - 0.4, -0.6)
    return figure


def is_scattered(update: InferenceResult) -> bool:
    """Whether the readings are of B at points of one map that lie on no lines or circles."""
    return not update.is_campaign and all(update.observation.components) and not _line(
        update, np.zeros(int(np.sum(~update.held_out))))[-1]


def profile(diagnosis: Diagnosis) -> Figure:
    """Draw the readings with the largest residuals, their predictions and residuals.

    Of scattered points it is what remains of each component, over the points.
    """
    if is_scattered(diagnosis.before):
        return residual_maps_figure(diagnosis.before.observation, {
            state.when: state.update.readings - state.update.prediction_posterior.mean
            for state in states(diagnosis)})
    shown, before, after = states(diagnosis), diagnosis.before, diagnosis.after
    label, index, along, name, connected = _line(before, diagnosis.loo_residuals_before)
    harmonic = name == "harmonic" and connected
    line = {"lw": 1.2} if connected and not harmonic else {"ls": "none", "marker": "_", "ms": 10}
    figure, (top, bottom) = charts(5.4, 2, sharex=True, height_ratios=[1.4, 1])
    held, measured = before.held_out[index], before.readings[index]
    factor, unit = unit_for(max(float(np.abs(
        state.update.readings - state.update.prediction_posterior.mean)[index].max())
        for state in shown))
    for state in shown:
        mean, colour = state.update.prediction_posterior.mean, state.colour
        top.plot(along, 1e3 * mean[index], color=colour, label=f"predicted, {state.when}", **line)
        residual = factor * (state.update.readings - mean)[index]
        bottom.plot(along[~held], residual[~held], ".", color=colour, ms=6)
        bottom.plot(along[held], residual[held], "o", mfc="none", color=colour, ms=5)
    top.plot(along[~held], 1e3 * measured[~held], ".", color=MEASURED, ms=4,
             label="measured, training")
    if held.any():
        top.plot(along[held], 1e3 * measured[held], "o", mfc="none", color=MEASURED, ms=4,
                 label="measured, held out")
    band = factor * COVERAGE_Z * np.hypot(after.prediction_posterior.sd, after.sigma)[index]
    if connected and not harmonic:
        bottom.fill_between(along, -band, band, color=POSTERIOR, alpha=0.2, lw=0)
    else:
        bottom.errorbar(along, 0 * along, band, fmt="none", color=POSTERIOR, alpha=0.2, lw=4)
    where = (before.observation.places if before.is_campaign
             else before.observation.positions)[index[0]]
    x, y, _ = 1e3 * where.round(6) + 0.0  # no -0
    of_map = f" of map {before.maps[index[0]]}" if before.is_campaign else ""
    line_at = f"x = {x:.0f} mm, y = {y:.0f} mm".replace("-", "\u2212")
    if harmonic:
        wave = {"A": "cos", "B": "sin"}[label]
        label = f"{label}$_n$"
        top.set_title(f"{label}{of_map}, coefficients of {wave} n\u03c6 in the radial B, at a "
                      f"radius of {np.hypot(x, y):.0f} mm", fontsize="medium")
    else:
        top.set_title(f"{label}{of_map} at all points" if not connected else
                      f"{label}{of_map} at {line_at}"
                      if name.startswith("z") else
                      f"{label}{of_map} at a radius of {np.hypot(x, y):.0f} mm",
                      fontsize="medium")
    top.set_ylabel(f"{label} in mT")
    legend_above(figure, top)
    bottom.set_ylabel(f"measured − predicted\nin {unit}")
    bottom.set_xlabel("harmonic n" if harmonic else name)
    return figure


def _line(update: InferenceResult, loo_residuals: Floats) -> tuple[str, Ints, Floats, str, bool]:
    """Return the readings of the profile.

    These are the readings with the largest residuals of all lines along z, circles, or coefficients
    of one kind. If no line has as many as `FEWEST_ON_A_LINE`, they are all of one component.

    ``loo_residuals`` (n,): standardized leave-one-out residuals of the training readings.

    Returns
    -------
    label : str
        Component or kind of the readings.
    index : ndarray of int
        Numbers of the readings.
    along : ndarray
        Their coordinates on the abscissa.
    name : str
        Name of the abscissa.
    connected : bool
        Whether they lie on a line.
    """
    worst = np.full(len(update.readings), np.nan)
    worst[~update.held_out] = loo_residuals**2
    along, name = axis_of_readings(update)
    labels = np.array([label[0] if name == "harmonic" else label
                       for label in update.observation.labels])
    apart = np.round(update.observation.positions[:, :2] if name.startswith("z")
                     else update.observation.radii[:, None], 6)
    if update.is_campaign:
        apart = _lines_of_maps(update)
    groups = [np.flatnonzero((labels == label) & (apart == location).all(axis=1))
              for label in dict.fromkeys(labels.tolist()) for location in np.unique(apart, axis=0)]
    longest = max(len(group) for group in groups)
    index = max((group for group in groups if 2 * len(group) >= longest
                 and not np.isnan(worst[group]).all()),
                key=lambda group: float(np.nanmean(worst[group])))
    connected = longest >= FEWEST_ON_A_LINE
    if not connected:
        index = np.flatnonzero(labels == labels[index[0]])
    order = np.argsort(along[index], kind="stable")
    return str(labels[index[0]]), index[order], along[index][order], name, connected


def _lines_of_maps(update: InferenceResult) -> Floats:
    """Return what readings (readings, 3) on one line along z in the magnet have in common: their
    map, and x and y in steps of half the distance of its points, as stages may be inclined.
    """
    observation, maps = update.observation, np.array(update.maps)
    found = np.empty((len(maps), 3))
    for number, name in enumerate(dict.fromkeys(update.maps)):
        own = maps == name
        step = point_spacing(np.unique(observation.positions[own], axis=0)) / 2
        found[own] = np.column_stack([np.full(own.sum(), number),
                                      np.round(observation.places[own, :2] / step)])
    return found


def _parts(update: InferenceResult, vectors: Floats) -> dict[str, Floats]:
    """Split magnetizations (parameters, ...) in A/m into components for each block.

    Each component (blocks, ...) is relative to the magnitude of the nominal magnetization: along
    the easy axis in %, across it and along z in mrad.
    """
    dimension = update.study.dimension
    nominal = update.by_block(update.response.nominal)
    length = np.linalg.norm(nominal, axis=1)
    length[length == 0] = np.inf  # a missing block has no magnetization
    axis = nominal / length[:, None]
    across = np.zeros_like(axis)
    across[:, 0], across[:, 1] = -axis[:, 1], axis[:, 0]
    relative = update.by_block(vectors.reshape(len(vectors), -1)) / length[:, None, None]
    found = {"along the easy axis in %": 100 * np.einsum("bck,bc->bk", relative, axis),
             "across it in mrad": 1e3 * np.einsum("bck,bc->bk", relative, across)}
    if dimension == 3:
        found["along z in mrad"] = 1e3 * relative[:, 2]
    return found


def _deviations(update: InferenceResult) -> dict[str, Floats]:
    """Return posterior less prior mean of each component, (rings, slots)."""
    return {name: update.magnet.by_ring(values[:, 0]) for name, values in
            _parts(update, update.posterior.mean - update.prior.mean).items()}


def magnetizations(diagnosis: Diagnosis) -> Figure:
    """Draw posterior less prior mean of every block's magnetization by ring and slot."""
    shown = states(diagnosis)
    found = [_deviations(state.update) for state in shown]
    rings = len(next(iter(found[0].values())))
    figure = figure_of(1.0 + len(found[0]) * (1.0 + 0.14 * min(rings, 40)))
    axes = figure.subplots(len(found[0]), len(shown), sharex=True, sharey=True, squeeze=False)
    for row, name in zip(axes, found[0], strict=True):
        limit = max(float(np.nanmax(np.abs(deviations[name]))) for deviations in found) or 1.0
        for axis, deviations in zip(row, found, strict=True):
            draw_by_slot(axis, deviations[name], cmap="RdBu_r", vmin=-limit, vmax=limit)
            axis.set_yticks(range(1, rings + 1, max(1, rings // 6)))
        figure.colorbar(_colours(limit), ax=list(row), label=name.replace(" in", "\nin"))
        row[0].set_ylabel("ring")
    for axis, state in zip(axes[0], shown, strict=True):
        axis.set_title(state.when)
    for axis in axes[-1]:
        axis.set_xlabel("slot")
    return figure


def structure(diagnosis: Diagnosis) -> Rows:
    """Return the rows of a table of rms changes of the magnetizations, and their prior."""
    found = [(state.when, _deviations(state.update)) for state in states(diagnosis)]
    prior = _parts(diagnosis.before, np.asarray(diagnosis.before.prior.root))
    return [{"rms change of the magnetizations": name,
             "prior sd": f"{np.sqrt(np.mean(np.sum(values**2, axis=1))):.3g}"} | {
        when: f"{np.sqrt(np.nanmean(one[name]**2)):.3g}" for when, one in found}
        for name, values in prior.items()]


