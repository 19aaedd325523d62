"""Figures and the HTML page of an update."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from halbach_fe.blocks import Floats, blocks_of
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    axes_along,
    save,
    write_page,
)
from halbach_fe.update import COVERAGE_Z, Update

NOTHING = "–"


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


def score_table(update: Update, published: Published | None = None) -> list[dict[str, str]]:
    """Rows of the before/after table, as text."""
    rows = []
    for score in update.scores:
        row = {
            "region": score.region,
            "readings": f"{score.readings} {score.part}".replace(" ", "\u00a0"),
            "prior": _percent(score.median_relative_error_prior),
            "posterior": _percent(score.median_relative_error_posterior),
            "95 % band holds": _percent(score.coverage95_posterior),
            "chi²/reading": NOTHING if score.chi2_posterior is None
            else f"{score.chi2_posterior:.3g}",
        }
        if published is not None:
            inside = np.isin(np.round(published.z, 6), np.round(_z_of(
                update, score.region, score.part), 6))
            row[f"{published.label}: prior"] = _percent(float(np.median(published.prior[inside])))
            row[f"{published.label}: posterior"] = _percent(
                float(np.median(published.posterior[inside])))
        rows.append(row)
    return rows


def write_report(
    update: Update, folder: Path, published: Published | None = None,
    assumptions: Sequence[str] = (),
) -> None:
    """Write report.html, self-contained, and its figures as PNG into ``folder``.

    ``assumptions`` are sentences that the reader must know before the numbers.
    """
    figures = {
        "profile.png": (_profile(update), "Measured readings along z with the prior and posterior "
                        "prediction and the posterior's residuals"),
        "relative_error.png": (_relative_error(update, published), "Relative error along z of "
                               "prior and posterior, logarithmic"),
        "blocks.png": (_blocks(update), "Posterior change of the magnetization along the easy "
                       "axis by ring and slot"),
    }
    array = update.study.array
    write_page(
        folder / "report.html", "inference.html.j2", save(figures, folder), update=update,
        rows=score_table(update, published), assumptions=assumptions, array=array,
        remanence=blocks_of(update.study)[0].remanence, conflict=_conflict(update))


def _conflict(update: Update) -> str:
    """Say so when prior, model and readings cannot all be right."""
    if update.prior_conflict <= update.conflict_limit:
        return ""
    shift = float(np.max(np.abs(update.posterior.mean - update.prior.mean) / update.prior.sd))
    return (f"Prior, model and readings cannot all be right: chi² per reading is "
            f"{update.prior_conflict:.3g}, where 1 is expected and {update.conflict_limit:.2g} "
            f"would be rare, and the largest change of a block is {shift:.1f} prior standard "
            "deviations. Something is missing from the model (geometry, position of the readings, "
            "iron, ...), so its error bars are too small.")


def _percent(value: float | None) -> str:
    return NOTHING if value is None else f"{100 * value:.3g}\u00a0%"


def _z_of(update: Update, region: str, part: str) -> Floats:
    return update.observation.positions[update.chosen(region, part), 2]


def _first_label(update: Update) -> tuple[str, Floats, np.ndarray[tuple[int], np.dtype[np.intp]]]:
    """The readings that a figure along z shows: all of the first label, in order of z."""
    label = update.observation.labels[0]
    index = np.flatnonzero(np.array(update.observation.labels) == label)
    z = update.observation.positions[index, 2]
    order = np.argsort(z, kind="stable")
    return label, z[order], index[order]


def _profile(update: Update) -> Figure:
    label, z, index = _first_label(update)
    figure, (top, bottom) = axes_along(2, [2, 1])
    held = update.held_out[index]
    measured = update.readings[index]
    top.plot(z, update.prediction_prior.mean[index], color=PRIOR, label="prior", lw=1.2)
    top.plot(z, update.prediction_posterior.mean[index], color=POSTERIOR, label="posterior", lw=1.2)
    top.plot(z[~held], measured[~held], ".", color=MEASURED, ms=4, label="measured, training")
    top.plot(z[held], measured[held], "o", mfc="none", color=MEASURED, ms=4,
             label="measured, held out")
    top.set_ylabel(f"{label} in T")
    top.legend()
    residual = 1e3 * (measured - update.prediction_posterior.mean[index])
    band = 1e3 * COVERAGE_Z * np.hypot(update.prediction_posterior.sd, update.sigma)[index]
    bottom.fill_between(z, -band, band, color=POSTERIOR, alpha=0.2, lw=0, step="mid",
                        label="95 % band of prediction and noise")
    bottom.plot(z[~held], residual[~held], ".", color=MEASURED, ms=4)
    bottom.plot(z[held], residual[held], "o", mfc="none", color=MEASURED, ms=4)
    bottom.set_ylabel("measured − posterior\nin mT")
    bottom.set_xlabel("z in m")
    bottom.legend(loc="lower center")
    return figure


def _relative_error(update: Update, published: Published | None) -> Figure:
    label, z, index = _first_label(update)
    figure, (axis,) = axes_along(1)
    figure.set_size_inches(8, 4.5)
    held = update.held_out[index]
    if published is not None:
        axis.semilogy(published.z, published.prior, ":", color=PUBLISHED, lw=1,
                      label=f"{published.label}, prior")
        axis.semilogy(published.z, published.posterior, "-", color=PUBLISHED, lw=1,
                      label=f"{published.label}, posterior")
    for name, prediction, colour in (("prior", update.prediction_prior, PRIOR),
                                     ("posterior", update.prediction_posterior, POSTERIOR)):
        error = update.relative_error(prediction)[index]
        axis.semilogy(z, error, "-", color=colour, lw=1, label=name)
        axis.semilogy(z[held], error[held], "o", mfc="none", color=colour, ms=3,
                      label=f"{name}, held out")
    axis.set_xlabel("z in m")
    axis.set_ylabel(f"|measured − predicted| / |measured| of {label}")
    axis.legend(ncols=2, fontsize="small")
    return figure


def _blocks(update: Update) -> Figure:
    array = update.study.array
    dimension = update.study.dimension
    nominal = update.response.nominal.reshape(-1, dimension)
    shift = (update.posterior.mean - update.response.nominal).reshape(-1, dimension)
    length = np.linalg.norm(nominal, axis=1)
    along = np.einsum("ij,ij->i", shift, nominal) / length**2
    picture = 100 * along.reshape(array.rings, array.blocks_per_ring)
    figure = Figure(figsize=(8, 1.8 + 0.25 * array.rings), layout="constrained")
    axis = figure.subplots()
    limit = float(np.abs(picture).max()) or 1.0
    image = axis.imshow(picture, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto",
                        origin="lower",
                        extent=(0.5, array.blocks_per_ring + 0.5, 0.5, array.rings + 0.5))
    axis.add_patch(Rectangle((0.5, 0.5), array.blocks_per_ring, array.rings, fill=False))
    axis.set_xlabel("slot")
    axis.set_ylabel("ring")
    axis.set_xticks(range(1, array.blocks_per_ring + 1))
    axis.set_yticks(range(1, array.rings + 1, max(1, array.rings // 12)))
    figure.colorbar(image, label="posterior change along\nthe easy axis in %")
    return figure
