"""Figures of how prior and posterior predict the readings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.inference.result import (
    COVERAGE_Z,
    HELD_OUT,
    HELD_OUT_MAP,
    TRAINING,
    InferenceResult,
    Prediction,
)
from halbach_fe.report.page import MEASURED, POSTERIOR, PRIOR, PUBLISHED, axes_along

MARKERS: dict[str, dict[str, Any]] = {
    TRAINING: {"marker": ".", "ms": 4}, HELD_OUT: {"marker": "o", "mfc": "none", "ms": 4},
    HELD_OUT_MAP: {"marker": "x", "ms": 4, "mew": 0.8}}
FAR = 12.0
"""Standard deviations beyond which an axis of residuals becomes logarithmic."""

CROWD = 3000
"""Readings beyond which markers would hide each other."""

DRAWN_QUANTILES = 2000


@dataclass(frozen=True)
class Published:
    """Relative errors that somebody else published for the same readings.

    Attributes
    ----------
    label : str
    z : ndarray, shape (n,), in m
        Increasing.
    prior, posterior : ndarray, shape (n,)
        Relative errors at z.
    """

    label: str
    z: Floats
    prior: Floats
    posterior: Floats


@dataclass(frozen=True)
class Line:
    """Readings of one kind in a row: along z, around a circle, or by harmonic.

    Attributes
    ----------
    what : str
        Label of the readings.
    index : ndarray, shape (n,)
        Which readings.
    place : ndarray, shape (n,)
        Increasing.
    axis : str
        What the places are, with their unit.
    """

    what: str
    index: Ints
    place: Floats
    axis: str


def places(update: InferenceResult) -> tuple[Floats, str]:
    """Where all readings stand in a figure, and what that is: z, or in a plane the angle, or the
    order of Fourier coefficients if there is nothing else.
    """
    x, y, z = update.observation.positions.T
    if np.ptp(z) > 0:
        return z, "z in m"
    if any(update.observation.components):
        return np.degrees(np.arctan2(y, x)) % 360, "angle in degrees"
    return np.array([float(label[1:]) for label in update.observation.labels]), "harmonic"


def main_line(update: InferenceResult) -> Line:
    """The line through the strongest reading: of its label and radius, at each place the reading
    that is nearest to it in the plane.
    """
    place, axis = places(update)
    strongest = int(np.argmax(np.abs(update.readings)))
    labels, what = np.array(update.observation.labels), update.observation.labels[strongest]
    if axis == "harmonic":
        labels, what = np.array([label[0] for label in labels]), what[0]
    radii, positions = update.observation.radii, update.observation.positions
    own = np.flatnonzero((labels == what) & np.isclose(radii, radii[strongest], 0, 1e-4))
    away = (np.hypot(*(positions[own] - positions[strongest])[:, :2].T) if axis.startswith("z")
            else np.zeros(len(own)))
    order = np.lexsort((away, place[own].round(9)))
    _, first = np.unique(place[own][order].round(9), return_index=True)
    index = own[order[first]]
    return Line(what if axis != "harmonic" else f"{what}₁ … of the circle", index, place[index],
                axis)


def profile(update: InferenceResult) -> Figure:
    """Readings along the main line, their predictions, and what the posterior leaves of them."""
    line = main_line(update)
    index = line.index
    figure, (top, bottom) = axes_along(2, [2, 1])
    measured = update.readings[index]
    top.plot(line.place, update.prediction_prior.mean[index], color=PRIOR, label="prior", lw=1.2)
    top.plot(line.place, update.prediction_posterior.mean[index], color=POSTERIOR,
             label="posterior", lw=1.2)
    residual = 1e3 * (measured - update.prediction_posterior.mean[index])
    band = 1e3 * COVERAGE_Z * np.hypot(update.prediction_posterior.sd, update.sigma)[index]
    bottom.fill_between(line.place, -band, band, color=POSTERIOR, alpha=0.2, lw=0, step="mid",
                        label="95 % band of prediction and noise")
    for part, mask in _parts(update, index):
        for axis, values in ((top, measured), (bottom, residual)):
            axis.plot(line.place[mask], values[mask], ls="none", color=MEASURED, **MARKERS[part],
                      label=f"measured, {part}" if axis is top else None)
    top.set_ylabel(f"{line.what} in T")
    top.legend()
    bottom.set_ylabel("measured − posterior\nin mT")
    bottom.set_xlabel(line.axis)
    bottom.legend(loc="lower center")
    return figure


def relative_error(update: InferenceResult, published: Published | None) -> Figure:
    """|measured - predicted| / |measured| along the main line."""
    line = main_line(update)
    figure, (axis,) = axes_along(1)
    figure.set_size_inches(8, 4.5)
    if published is not None:
        axis.semilogy(published.z, published.prior, ":", color=PUBLISHED, lw=1,
                      label=f"{published.label}, prior")
        axis.semilogy(published.z, published.posterior, "-", color=PUBLISHED, lw=1,
                      label=f"{published.label}, posterior")
    for name, prediction, colour in _predictions(update):
        error = update.relative_error(prediction)[line.index]
        axis.semilogy(line.place, error, "-", color=colour, lw=1, label=name)
        for part, mask in _parts(update, line.index):
            if part != TRAINING:
                axis.semilogy(line.place[mask], error[mask], ls="none", color=colour,
                              label=f"{name}, {part}", **MARKERS[part])
    axis.set_xlabel(line.axis)
    axis.set_ylabel(f"|measured − predicted| / |measured| of {line.what}")
    axis.legend(ncols=2, fontsize="small")
    return figure


def residuals(update: InferenceResult) -> Figure:
    """Standardized residuals of all readings, before and after the update."""
    place, label = places(update)
    figure, axes = axes_along(2)
    for axis, (name, prediction, colour) in zip(axes, _predictions(update), strict=True):
        scores = update.standardized(prediction)
        for part, mask in _parts(update, np.arange(len(scores))):
            style = {"marker": ".", "ms": 1.5} if len(scores) > CROWD else MARKERS[part]
            axis.plot(place[mask], scores[mask], ls="none", label=part, **style,
                      color=MEASURED if part == TRAINING else colour,
                      alpha=0.5 if part == TRAINING or len(scores) > CROWD else 1)
        axis.axhspan(-COVERAGE_Z, COVERAGE_Z, color=PUBLISHED, alpha=0.2, lw=0)
        axis.set_ylabel(f"residual / sd\n{name}")
        _scale(axis, scores)
    axes[0].legend(ncols=3, fontsize="small", loc="upper right",
                   markerscale=5 if len(update.readings) > CROWD else 1)
    axes[1].set_xlabel(label)
    return figure


def quantiles(update: InferenceResult) -> Figure:
    """Whitened residuals of the readings that were not seen against normal quantiles; of the
    training readings by the prior, which has not seen them either, if nothing was held out.
    """
    figure = Figure(figsize=(5.2, 5), layout="constrained")
    axis = figure.subplots()
    unseen = update.held_out.any()
    chosen = update.held_out if unseen else ~update.held_out
    count = int(chosen.sum())
    rank = np.unique(np.linspace(1, count, min(count, DRAWN_QUANTILES)).round().astype(int))
    normal = stats.norm.ppf((rank - 0.5) / count)
    axis.fill_between(normal, *stats.norm.ppf(
        [stats.beta.ppf(p, rank, count - rank + 1) for p in (0.025, 0.975)]),
        color=PUBLISHED, alpha=0.3, lw=0, label="95 % of each, if all is well")
    axis.axline((0, 0), slope=1, color=PUBLISHED, lw=0.8)
    found = []
    for name, prediction, colour in _predictions(update)[: 2 if unseen else 1]:
        found.append(np.sort(update.whitened(prediction, chosen))[rank - 1])
        axis.plot(normal, found[-1], "." if name == "prior" else "x", color=colour, ms=4, mew=0.8,
                  label=name)
    axis.set(xlabel="normal quantile", ylabel="whitened residual, "
             + ("held-out readings" if unseen else "training readings"))
    _scale(axis, np.concatenate(found))
    axis.grid(alpha=0.3)
    axis.legend(loc="upper left")
    return figure


def _predictions(update: InferenceResult) -> list[tuple[str, Prediction, str]]:
    return [("prior", update.prediction_prior, PRIOR),
            ("posterior", update.prediction_posterior, POSTERIOR)]


def _parts(update: InferenceResult, index: Ints) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Parts that some of the readings belong to, and which."""
    parts = np.array(update.parts)[index]
    for part in MARKERS:
        if (mask := parts == part).any():
            yield part, mask


def _scale(axis: Axes, scores: Floats) -> None:
    """Symmetric about 0, and logarithmic beyond the error bars if some are far away."""
    limit = 1.15 * max(3.5, float(np.abs(scores).max()))
    if limit > FAR:
        axis.set_yscale("symlog", linthresh=3.0)
        powers = [3.0, *(10.0**power for power in range(1, 12) if 10.0**power < limit)]
        ticks = [-one for one in reversed(powers)] + [0.0, *powers]
        axis.set_yticks(ticks, [f"{one:g}" for one in ticks])
        axis.minorticks_off()
    axis.set_ylim(-limit, limit)
