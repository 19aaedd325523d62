"""Relative errors as the paper has them, and what a page of ours shows beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.inference.result import TRAINING, InferenceResult
from halbach_fe.report import inference_page
from halbach_fe.report.page import (
    PUBLISHED,
    Drawn,
    Items,
    Page,
    Section,
    Table,
    chart,
    legend_above,
)
from halbach_fe.report.point_maps import MARKERS, main_line, parts_of, predictions


@dataclass(frozen=True)
class PublishedErrors:
    """Relative errors from the literature for the same readings.

    Attributes
    ----------
    label : str
        Name of the source in legends.
    z : ndarray, shape (n,), in m
        Positions, increasing.
    prior, posterior : ndarray, shape (n,)
        Relative errors of the predictions at z.
    """

    label: str
    z: Floats
    prior: Floats
    posterior: Floats


def relative_error_figure(result: InferenceResult, published: PublishedErrors) -> Figure:
    """Draw the relative error |measured - predicted| / |measured| along the main line."""
    line = main_line(result)
    figure, axis = chart(4.5)
    for name, errors, style in (("prior", published.prior, ":"),
                                ("posterior", published.posterior, "-")):
        axis.semilogy(1e3 * published.z, errors, style, color=PUBLISHED, lw=1,
                      label=f"{published.label}, {name}")
    for name, prediction, colour in predictions(result):
        error = result.relative_error(prediction)[line.index]
        axis.semilogy(line.place, error, "-", color=colour, lw=1, label=name)
        for part, mask in parts_of(result, line.index):
            if part != TRAINING:
                axis.semilogy(line.place[mask], error[mask], ls="none", color=colour,
                              label=f"{name}, {part}", **MARKERS[part])
    axis.set_xlabel(line.axis)
    axis.set_ylabel(f"|measured − predicted| / |measured| of {line.what}")
    legend_above(figure, axis)
    return figure


def median_table(result: InferenceResult, published: PublishedErrors) -> list[dict[str, str]]:
    """Return rows of text: medians of relative errors by region, ours and those of the paper."""
    rows = []
    for score in result.scores:
        z = result.observation.positions[result.chosen(score.region, score.part), 2]
        inside = np.isin(np.round(published.z, 6), np.round(z, 6))
        rows.append({"region": score.region, "readings": f"{score.readings} {score.part}"} | {
            name: "–" if value is None else f"{100 * value:.3g}\u00a0%" for name, value in (
                ("prior", score.median_relative_error_prior),
                ("posterior", score.median_relative_error_posterior),
                (f"{published.label}: prior", float(np.median(published.prior[inside]))),
                (f"{published.label}: posterior", float(np.median(published.posterior[inside]))))})
    return rows


def page(
    result: InferenceResult, published: PublishedErrors, assumptions: Sequence[str]
) -> Page:
    """Return the page of an update, with the paper's errors beside ours, and what both rest on."""
    made, figure = inference_page.page(result), "relative_error.png"
    return replace(
        made, figures={**made.figures, figure: (
            partial(relative_error_figure, result, published), "Relative error of the predictions "
            "of prior and posterior along the line of the strongest reading")},
        sections=[*made.sections[:2], Section([
            "Medians of relative errors, as they are published.",
            Table(median_table(result, published)), Drawn(figure)], "Relative errors"),
            Section([Items(assumptions)] if assumptions else [], "Assumptions"),
            *made.sections[2:]])
