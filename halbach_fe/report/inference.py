"""Figures and the HTML page of an update."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from halbach_fe.core.arrays import Floats
from halbach_fe.inference.result import InferenceResult
from halbach_fe.report.multipoles import Table, middle_table, table_csv
from halbach_fe.report.page import POSTERIOR, save, write_page
from halbach_fe.report.prediction import Published, profile, quantiles, relative_error, residuals
from halbach_fe.report.view import of_update
from halbach_fe.response.multipoles import circle_models
from halbach_fe.stats.linear_gaussian import contraction

NOTHING = "–"
NUMBERED_SLOTS, NUMBERED_RINGS = 32, 48
"""More do not find room for their numbers."""


def score_table(update: InferenceResult,
                published: Published | None = None) -> list[dict[str, str]]:
    """Rows of the before/after table, as text."""
    rows = []
    for score in update.scores:
        row = {
            "region": score.region,
            "readings": f"{score.readings} {score.part}".replace(" ", "\u00a0"),
            "prior": _percent(score.median_relative_error_prior),
            "posterior": _percent(score.median_relative_error_posterior),
            "rms residual/sd": f"{score.rms_standardized_posterior:.3g}",
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


def write_inference_report(
    update: InferenceResult, folder: Path, published: Published | None = None,
    assumptions: Sequence[str] = (), provenance: Mapping[str, str] | None = None,
) -> None:
    """Write report.html, self-contained, and its figures as PNG into ``folder``; and
    multipoles.csv, if the readings are of full circles.

    ``assumptions`` are sentences that the reader must know before the numbers.
    """
    unseen = ("of the held-out readings by prior and posterior" if update.held_out.any()
              else "of the training readings by the prior (nothing was held out)")
    figures = {
        "profile.png": (profile(update), "Measured readings with the prior and posterior "
                        "prediction, and the posterior's residuals, along the line of the "
                        "strongest reading"),
        "relative_error.png": (relative_error(update, published), "Relative error of prior and "
                               "posterior on the same line, logarithmic"),
        "residuals.png": (residuals(update), "Residuals of all readings over the standard "
                          "deviation of prediction and noise, before (top) and after the update "
                          "(bottom); 95 % belong into the grey band, and more of the training "
                          "readings after the update, which has seen them"),
        "quantiles.png": (quantiles(update), f"Quantiles of residuals {unseen}, whitened by the "
                          "full covariance of prediction and noise, against those of a normal "
                          "distribution; on the line if all is well"),
        "blocks.png": (_blocks(update), "Posterior change of the magnetization along the easy "
                       "axis by ring and slot"),
        "contraction.png": (_contraction(update), "What the readings tell of each block: by how "
                            "much its variance shrinks from prior to posterior, 0 % nothing, "
                            "100 % all"),
    }
    multipoles: list[Table] = [
        (model, {"prior": model.of(update.prior), "posterior": model.of(update.posterior)})
        for model in circle_models(update.magnet, update.observation, update.response)]
    if multipoles:
        table_csv(update.study, multipoles, folder / "multipoles.csv")
    array = update.study.array
    write_page(
        folder / "report.html", "inference.html.j2", save(figures, folder), study=update.study,
        provenance=provenance, update=update, multipoles=middle_table(multipoles),
        rows=score_table(update, published), assumptions=assumptions, array=array,
        remanence=update.magnet.blocks[0].remanence, conflict=_conflict(update),
        view=of_update(update))


def _conflict(update: InferenceResult) -> str:
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


def _z_of(update: InferenceResult, region: str, part: str) -> Floats:
    return update.observation.positions[update.chosen(region, part), 2]


def _height(rings: int) -> float:
    """In inches, of a picture with a row a ring."""
    return 1.8 + 0.25 * min(rings, NUMBERED_RINGS)


def _blocks(update: InferenceResult) -> Figure:
    array = update.study.array
    dimension = update.study.dimension
    nominal = update.response.nominal.reshape(-1, dimension)
    shift = (update.posterior.mean - update.response.nominal).reshape(-1, dimension)
    length = np.linalg.norm(nominal, axis=1)
    along = np.einsum("ij,ij->i", shift, nominal) / length**2
    picture = 100 * along.reshape(array.rings, array.blocks_per_ring)
    figure = Figure(figsize=(8, _height(array.rings)), layout="constrained")
    axis = figure.subplots()
    limit = float(np.abs(picture).max()) or 1.0
    image = axis.imshow(picture, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto",
                        origin="lower",
                        extent=(0.5, array.blocks_per_ring + 0.5, 0.5, array.rings + 0.5))
    axis.add_patch(Rectangle((0.5, 0.5), array.blocks_per_ring, array.rings, fill=False))
    axis.set_xlabel("slot")
    axis.set_ylabel("ring")
    axis.set_xticks(range(1, array.blocks_per_ring + 1, max(1, array.blocks_per_ring // 24)))
    axis.set_yticks(range(1, array.rings + 1, max(1, array.rings // 12)))
    figure.colorbar(image, label="posterior change along\nthe easy axis in %")
    return figure


def _contraction(update: InferenceResult) -> Figure:
    array = update.study.array
    percent = 100 * contraction(update.prior, update.posterior, update.study.dimension).reshape(
        array.rings, array.blocks_per_ring)
    slots = np.arange(1, array.blocks_per_ring + 1)
    figure = Figure(figsize=(8, 3 if array.rings == 1 else _height(array.rings)),
                    layout="constrained")
    axis = figure.subplots()
    axis.set(xlabel="slot", xticks=slots[::max(1, len(slots) // 24)])
    if array.rings == 1:
        bars = axis.bar(slots, percent[0], color=POSTERIOR)
        if len(slots) <= NUMBERED_SLOTS:
            axis.bar_label(bars, fmt="%.0f", fontsize=7)
        axis.set(ylabel="variance taken in %", ylim=(0, 108), yticks=range(0, 101, 20))
        return figure
    image = axis.imshow(percent, cmap="cividis", vmin=0, vmax=100, aspect="auto", origin="lower",
                        extent=(0.5, len(slots) + 0.5, 0.5, array.rings + 0.5))
    if len(slots) <= NUMBERED_SLOTS and array.rings <= NUMBERED_RINGS:
        for (ring, slot), value in np.ndenumerate(percent):
            axis.text(slot + 1, ring + 1, f"{value:.0f}", ha="center", va="center", fontsize=7,
                      color="white" if value < 50 else "black")
    axis.set(ylabel="ring", yticks=range(1, array.rings + 1, max(1, array.rings // 12)))
    figure.colorbar(image, label="variance taken in %")
    return figure
