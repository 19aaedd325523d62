"""Figures and the HTML page of an inference result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from halbach_fe.core.arrays import Floats
from halbach_fe.inference.result import HELD_OUT_MAP, TRAINING, InferenceResult
from halbach_fe.report.answer import Answer
from halbach_fe.report.campaign_inference import (
    left_out_table,
    maps_figure,
    overlap_table,
    pose_table,
    term_table,
)
from halbach_fe.report.inference_answer import answer
from halbach_fe.report.magnet_table import magnet_rows
from halbach_fe.report.magnet_view_3d import colours_in_words, view_of_inference
from halbach_fe.report.magnetic_axis import axis_rows, definition
from halbach_fe.report.multipoles import MultipoleTable, middle_table, write_multipole_csv
from halbach_fe.report.page import POSTERIOR, SMALL, figure_of, own_style, save, write_page
from halbach_fe.report.prediction import (
    PublishedErrors,
    has_profile,
    prediction_profile_figure,
    relative_error_figure,
    residual_maps_figure,
    standardized_residuals_figure,
    whitened_quantiles_figure,
)
from halbach_fe.report.stray_field import stray_pictures, stray_section
from halbach_fe.report.words import decimals, flux_density, place_of, ppm, relative, with_error
from halbach_fe.response.homogeneity import PPM
from halbach_fe.response.multipoles import circle_models

NOTHING = "–"
NUMBERED_SLOTS, NUMBERED_RINGS = 32, 48
"""Largest numbers of slots and rings for which the contraction figure prints its values."""

RANKED = 8
"""Number of the blocks that a page lists: those that deviate most."""

ALIKE = 0.03
"""Range of the contractions of all blocks up to which they are said instead of drawn."""


def score_table(result: InferenceResult,
                published: PublishedErrors | None = None) -> list[dict[str, str]]:
    """Return the rows, as text, of the table that compares predictions before and after.

    Regions have names if there are several. Before the update, chi² is that of all training
    readings together, which the answer states: in their own row, or in one below those of several
    regions. Beside published errors, which are medians of relative ones, there are such medians of
    ours.
    """
    rows, largest = [], float(np.abs(result.readings).max())
    training = ~result.held_out
    alone = sum(score.part == TRAINING for score in result.scores) == 1
    for score in result.scores:
        row = {
            "region": score.region,
            "readings": f"{score.readings} {'of ' * (score.part == HELD_OUT_MAP)}{score.part}"
            .replace(" ", "\u00a0"),
            "before, rms": flux_density(score.rms_error_prior_T, zeros=True),
            "after, rms": flux_density(score.rms_error_posterior_T, zeros=True),
            "after, of the largest reading": relative(score.rms_error_posterior_T / largest)
            if largest else NOTHING,
            "rms residual/sd": f"{score.rms_standardized_posterior:.3g}",
            "95 % band holds": _percent(score.coverage95_posterior),
            "chi²/reading, before": _chi2(
                result.prior_conflict if alone and score.part == TRAINING else score.chi2_prior),
            "chi²/reading, after": _chi2(score.chi2_posterior),
        }
        if published is not None:
            inside = np.isin(np.round(published.z, 6), np.round(_z_of_readings(
                result, score.region, score.part), 6))
            row["median: prior"] = _percent(score.median_relative_error_prior)
            row["median: posterior"] = _percent(score.median_relative_error_posterior)
            row[f"{published.label}: prior"] = _percent(float(np.median(published.prior[inside])))
            row[f"{published.label}: posterior"] = _percent(
                float(np.median(published.posterior[inside])))
        rows.append(row)
    if not alone:
        off = [flux_density(float(np.sqrt(np.mean(
            (result.readings - each.mean)[training] ** 2))), zeros=True)
               for each in (result.prediction_prior, result.prediction_posterior)]
        together = {"region": "together", "readings": f"{training.sum()} {TRAINING}".replace(
            " ", "\u00a0"), "before, rms": off[0], "after, rms": off[1],
            "chi²/reading, before": _chi2(result.prior_conflict)}
        rows.append({name: together.get(name, NOTHING) for name in rows[0]})
    if len({row["region"] for row in rows}) == 1:  # its name tells nothing
        rows = [{name: text for name, text in row.items() if name != "region"} for row in rows]
    return rows


def _chi2(value: float | None) -> str:
    return NOTHING if value is None else decimals(value)


def block_table(result: InferenceResult) -> list[dict[str, str]]:
    """Return rows of text: the blocks that deviate most, the one that is least likely first.

    That is by the change of the magnetization along and across the easy axis, each in standard
    deviations of its prior.
    """
    nominal = result.by_block(result.response.nominal)
    size = np.linalg.norm(nominal, axis=1)
    there = np.flatnonzero(size)  # without the places of missing blocks
    axes = nominal[there] / size[there, None]
    change = result.by_block(result.posterior.mean - result.response.nominal)[there]
    along = np.einsum("ij,ij->i", change, axes)
    across = np.linalg.norm(change - along[:, None] * axes, axis=1)
    prior_sd = result.by_block(result.prior.sd)[there]
    distance = np.linalg.norm(change / np.where(prior_sd > 0, prior_sd, np.inf), axis=1)
    rows = []
    for one in np.argsort(-distance, kind="stable")[:RANKED].tolist():
        row = np.zeros((1, len(result.posterior.mean)))
        result.by_block(row[0])[there[one]] = axes[one]
        sd, of = result.posterior.sd_of(row)[0], 100 / size[there[one]]
        turn = np.degrees(np.arctan2(across[one], size[there[one]] + along[one]))
        rows.append({
            "block": place_of(result.magnet.blocks[there[one]]),
            "along the easy axis": f"{with_error(of * along[one], of * sd)}\u00a0%",
            "turned by": f"{decimals(float(turn), 2)}°",
            "standard deviations of its prior": decimals(float(distance[one]), 2)})
    return rows


@own_style
def write_inference_report(
    result: InferenceResult, folder: Path, published: PublishedErrors | None = None,
    assumptions: Sequence[str] = (), provenance: Mapping[str, str] | None = None,
) -> Answer:
    """Write report.html and its figures into a folder; return the page's answer.

    If the readings are on full circles, multipoles.csv is written too.

    Parameters
    ----------
    published : PublishedErrors, optional
        Relative errors from the literature to compare with.
    assumptions : sequence of str
        Sentences that state what the result rests on.
    provenance : mapping, optional
        Entries of the page's provenance table.
    """
    unseen = ("of the held-out readings for prior and posterior" if result.held_out.any()
              else "of the training readings for the prior (nothing was held out)")
    contraction = result.contraction[~np.isnan(result.contraction)]  # missing blocks have none
    profile = ("Readings with the predictions of prior and posterior, and the residuals of the "
               "posterior, along the line of the strongest reading")
    profiles = ({"profile.png": (prediction_profile_figure(result), profile)}
                if has_profile(result) else {})
    if (maps := residual_maps_figure(result)) is not None:
        profiles["residual_maps.png"] = (
            maps, "Measured less predicted over the map, before and after the update: what remains "
            "should be noise, without a pattern")
    if result.is_campaign:
        profiles = {"maps.png": (maps_figure(result), "Where the maps lie in the magnet")}
        profiles |= {f"profile-{name}.png": (
            prediction_profile_figure(result, name), f"Map {name}. {profile}")
            for name in dict.fromkeys(result.maps) if has_profile(result, name)}
    if published is not None:
        profiles["relative_error.png"] = (
            relative_error_figure(result, published), "Relative error of the predictions of prior "
            "and posterior along the same line")
    figures = profiles | {
        "residuals.png": (standardized_residuals_figure(result), "Standardized residuals of "
                          "all readings (divided by the standard deviation of prediction and "
                          "noise) for the prior (top) and the posterior (bottom). The grey band "
                          "should hold 95 % of them; of the training readings it holds more for "
                          "the posterior, which is fitted to them"),
        "quantiles.png": (whitened_quantiles_figure(result), f"Quantiles of the whitened residuals "
                          f"{unseen} against normal quantiles; they are whitened with the full "
                          "covariance of prediction and noise, and lie on the line if the model "
                          "is right"),
        "blocks.png": (_magnetization_change_figure(result), "Posterior change of the "
                       "magnetization along the easy axis, from nominal, by ring and slot"),
    } | ({} if not len(contraction) or np.ptp(contraction) < ALIKE else {
        "contraction.png": (_contraction_figure(result), "Contraction of each block: "
                            "the decrease of its variance from prior to posterior; 0 % means that "
                            "the readings contain no information about the block"),
    }) | dict(stray_pictures(result.stray_field))
    multipoles: list[MultipoleTable] = [
        (model, {"prior": model.of(result.prior), "posterior": model.of(result.posterior)})
        for model in ([] if result.is_campaign else circle_models(
            result.magnet, result.observation, result.response))]
    if multipoles:
        write_multipole_csv(result.study, multipoles, folder / "multipoles.csv")
    said = answer(result, multipoles)
    write_page(
        folder / "report.html", "inference.html.j2", save(figures, folder), study=result.study,
        provenance=provenance, result=result, multipoles=middle_table(multipoles, result.study),
        rows=score_table(result, published), published=published, assumptions=assumptions,
        magnet_rows=magnet_rows(result.magnet),
        answer=said, blocks=block_table(result),
        contraction=_contraction_in_words(result, contraction),
        terms=term_table(result), poses=pose_table(result), overlaps=overlap_table(result),
        left_out=left_out_table(result),
        noise=[flux_density(float(end), 2)
               for end in (result.noise.sd.min(), result.noise.sd.max())],
        position_sd=[f"{1e3 * sd:.3g}" for sd in (
            result.study.noise.position_sd_m or () if result.study.noise else ())],
        solver_error=_solver_error(result), superposition=ppm(
            PPM * float(result.response.superposition_error)),
        axis=axis_rows(result.magnetic_axis), axis_definition=(
            "" if result.magnetic_axis is None else definition(result.magnetic_axis)),
        stray=stray_section(result.stray_field), view=view_of_inference(result),
        view_colours=colours_in_words(result))
    return said


def _solver_error(result: InferenceResult) -> str:
    """Say how far the finite elements may be off, beside the noise."""
    error = result.response.error
    if not error.any():
        return "none: the blocks are in vacuum"
    return (f"at most {flux_density(float(error.max()), 2)}, "
            f"and at most {decimals(float((error / result.noise.sd).max()), 2)} times the noise "
            "of a reading; included in the error bars")


def _percent(value: float | None) -> str:
    return NOTHING if value is None else f"{100 * value:.3g}\u00a0%"


def _z_of_readings(result: InferenceResult, region: str, part: str) -> Floats:
    return result.observation.positions[result.chosen(region, part), 2]


def _figure_height(rings: int) -> float:
    """Return the height in inches of a figure with a row per ring."""
    return 1.8 + 0.25 * min(rings, NUMBERED_RINGS)


def _magnetization_change_figure(result: InferenceResult) -> Figure:
    """Draw the change of each magnetization along the easy axis, from nominal to posterior."""
    nominal = result.by_block(result.response.nominal)
    shift = result.by_block(result.posterior.mean - result.response.nominal)
    length = np.linalg.norm(nominal, axis=1)
    length[length == 0] = np.nan  # the place of a missing block is left blank
    along = np.einsum("ij,ij->i", shift, nominal) / length**2
    picture = 100 * result.magnet.by_ring(along)
    rings, slots = picture.shape
    figure = figure_of(_figure_height(rings))
    axis = figure.subplots()
    limit = float(np.nanmax(np.abs(picture), initial=0.0)) or 1.0
    image = axis.imshow(picture, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto",
                        origin="lower",
                        extent=(0.5, slots + 0.5, 0.5, rings + 0.5))
    axis.add_patch(Rectangle((0.5, 0.5), slots, rings, fill=False))
    axis.set_xlabel("slot")
    axis.set_ylabel("ring")
    axis.set_xticks(range(1, slots + 1, max(1, slots // 24)))
    axis.set_yticks(range(1, rings + 1, max(1, rings // 12)))
    figure.colorbar(image, label="posterior change along\nthe easy axis in %")
    return figure


def _contraction_in_words(result: InferenceResult, contraction: Floats) -> str:
    """Say what part of the blocks' variances the readings take away."""
    if not len(contraction):
        return "none: the prior leaves nothing open"
    low, high = (f"{100 * end:.0f}" for end in (contraction.min(), contraction.max()))
    share = f"{low} to {high}" if low != high else low
    together = ("" if result.measured_blocks is None or not result.study.prior.common_mode_sd else
                "; a part of it is the calibration of the coil, which all measured blocks share")
    return f"by {share}\u00a0% of the prior's variance{together}"


def _contraction_figure(result: InferenceResult) -> Figure:
    """Draw the contraction of each block: as bars for a single ring, else by ring and slot."""
    percent = 100 * result.magnet.by_ring(
        result.contraction)
    rings = len(percent)
    slots = np.arange(1, percent.shape[1] + 1)
    figure = figure_of(3 if rings == 1 else _figure_height(rings))
    axis = figure.subplots()
    axis.set(xlabel="slot", xticks=slots[::max(1, len(slots) // 24)])
    if rings == 1:
        there = ~np.isnan(percent[0])
        bars = axis.bar(slots[there], percent[0, there], color=POSTERIOR)
        if len(slots) <= NUMBERED_SLOTS:
            axis.bar_label(bars, fmt="%.0f", fontsize=SMALL)
        axis.set(ylabel="contraction in %", ylim=(0, 108), yticks=range(0, 101, 20))
        return figure
    image = axis.imshow(percent, cmap="cividis", vmin=0, vmax=100, aspect="auto", origin="lower",
                        extent=(0.5, len(slots) + 0.5, 0.5, rings + 0.5))
    if len(slots) <= NUMBERED_SLOTS and rings <= NUMBERED_RINGS:
        for (ring, slot), value in np.ndenumerate(percent):
            if np.isnan(value):
                continue
            axis.text(slot + 1, ring + 1, f"{value:.0f}", ha="center", va="center", fontsize=SMALL,
                      color="white" if value < 50 else "black")
    axis.set(ylabel="ring", yticks=range(1, rings + 1, max(1, rings // 12)))
    figure.colorbar(image, label="contraction in %")
    return figure
