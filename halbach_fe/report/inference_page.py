"""Page of `infer`: tables and figures of an updated magnet; its answer is a module beside."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from halbach_fe.core.arrays import Floats, rms
from halbach_fe.core.numbers import EMPTY_CELL
from halbach_fe.inference.posterior_files import (
    distributions_of,
    inference_summary,
    write_inference,
)
from halbach_fe.inference.result import HELD_OUT_MAP, TRAINING, InferenceResult
from halbach_fe.measurement.probe_law import row_order_note
from halbach_fe.report.homogeneity_page import (
    sections_of_stray,
    stray_pictures,
    stray_rows,
    stray_title,
)
from halbach_fe.report.inference_answer import along_easy_axes, answer, easy_axes
from halbach_fe.report.magnet_view_3d import colours_in_words, view_of_inference
from halbach_fe.report.multipoles_page import MultipoleTable, multipole_csv, sections_of_circles
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SECOND,
    SMALL,
    Figures,
    Page,
    Rows,
    Section,
    Table,
    Text,
    View,
    chart,
    draw_by_slot,
    last_sections,
    legend_above,
    magnet_panels,
)
from halbach_fe.report.point_maps import (
    has_profile,
    has_residual_maps,
    prediction_profile_figure,
    residual_maps_figure,
    standardized_residuals_figure,
    whitened_quantiles_figure,
)
from halbach_fe.report.words import (
    capital,
    decimals,
    flux_density,
    magnet_rows,
    place_of,
    ppm,
    relative,
    with_error,
    with_unit,
)
from halbach_fe.response.homogeneity import PPM
from halbach_fe.response.magnetic_axis import MagneticAxis
from halbach_fe.response.multipoles import circle_models
from halbach_fe.stats.gaussian import by_readings_alone

STUDY_FILE = "study.updated.toml"

NOTE = "found by halbach-fe infer"

UNITS = {
    "A_per_m": ("kA/m", 1e-3), "A_m2": ("A m²", 1.0), "m_per_H": ("m/H", 1.0),
    "per_K": ("%/K", 100.0), "per_T2": ("%/T²", 100.0), "per_T": ("%/T", 100.0),
    "1/T^2": ("%/T²", 100.0), "1/T": ("%/T", 100.0), "m": ("mm", 1e3), "rad": ("mrad", 1e3),
    "deg": ("°", 1.0), "T": ("mT", 1e3), "K": ("K", 1.0), "C": ("°C", 1.0), "A": ("A", 1.0)}
"""Unit that people read, and its factor, for the unit at the end of a term's or key's name; longer
ones come before those that they end with."""

COLOURS = (POSTERIOR, SECOND, MEASURED, PUBLISHED, PRIOR)


def term_table(result: InferenceResult) -> Rows:
    """Return rows of text: what the update says about the instruments, and about uncertain
    amplitudes; none if all are known.
    """
    rows = []
    terms = [row for found in (result.terms, result.amplitudes) if found is not None
             for row in found.rows()]
    changes = {one.name: one.change for one in result.study.uncertain}
    for name, change, sd, prior_sd in terms:
        owner, _, term = name.rpartition(".")
        unit = _unit_of(term)
        what = term.removesuffix(f"_{unit}") if unit else term
        if not unit:
            unit = _unit_of_changes(changes.get(name, {}))
        shown, factor = UNITS.get(unit, ("%", 100.0))
        rows.append({"of": owner, "term": what.replace("_", " "),
                     "change from the study": f"{factor * change:+.4f} ± {factor * sd:.4f} {shown}",
                     "known before": f"± {factor * prior_sd:.3g} {shown}"})
    return rows


def _unit_of(name: str) -> str:
    """Return the unit, a key of `UNITS`, at the end of a name; empty if it has none."""
    name = re.sub(r"(\[\d+\])+$", "", name)
    return next((unit for unit in UNITS if name.endswith(f"_{unit}")), "")


def _unit_of_changes(change: Mapping[str, float]) -> str:
    """Return the unit of an amplitude that changes numbers of the study by as much as itself.

    Empty if they have none or several, or change by another factor: the amplitude then is a part
    of that.
    """
    units = {_unit_of(key) for key in change}
    same = all(abs(factor) == 1.0 for factor in change.values())
    return units.pop() if len(units) == 1 and same else ""


def pose_table(result: InferenceResult) -> Rows:
    """Return rows of text: where the middles of the maps lie; none if that was known before."""
    return [{"map": pose.name} | {
        f"{axis} of its middle": f"{1e3 * value:.3f} ± {1e3 * sd:.3f} mm"
        for axis, value, sd in zip("xyz", pose.middle_m, pose.middle_sd_m, strict=True)} | {
        "turned about x, y, z": "± " + ", ".join(f"{1e3 * sd:.2g}" for sd in pose.turn_sd_rad)
        + " mrad"} for pose in (result.terms.poses if result.terms else ())]


def overlap_table(result: InferenceResult) -> Rows:
    """Return rows of text: how maps agree where they overlap; none if they do not."""
    return [{
        "map": each.name, "as predicted by map": each.by,
        "readings": f"{each.readings}{' held out' if each.held_out else ''}",
        "rms difference": f"{decimals(1e3 * each.rms_T)} mT", "chi²/reading": decimals(each.chi2),
        "verdict": "they disagree" if each.disagreement else "they agree"}
        for each in result.overlaps]


def left_out_table(result: InferenceResult) -> Rows:
    """Return rows of text: how maps, or ends of the only one, are predicted that were left out."""
    return [{
        "left out": each.name or "ends of the map", "readings": str(each.readings),
        "rms difference": f"{decimals(1e3 * each.rms_T)} mT",
        "error bars and noise allow": f"{decimals(1e3 * each.allowed_T)} mT",
        "over noise": decimals(each.over_noise),
        "chi²/reading": decimals(each.chi2)} for each in result.regions_left_out]


def stretch_table(result: InferenceResult) -> Rows:
    """Return rows of text: the same along what was left out."""
    return [{
        "left out": each.name or "ends of the map", "in the magnet": one.where,
        "readings": str(one.readings), "rms difference": f"{decimals(1e3 * one.rms_T)} mT",
        "over noise": decimals(one.over_noise)}
        for each in result.regions_left_out for one in each.stretches]


def left_out_section(result: InferenceResult) -> Section:
    """Return the section of what was left out as a whole; empty if nothing was."""
    left_out = left_out_table(result)
    return Section([
        "Readings that were left out as a whole, each map in turn or the ends of the only one, "
        "predicted by an update with all others. Held-out lines between other lines say nothing of "
        "that. The rms difference is that with the pose and the probe that only this map has "
        "fitted to it; chi² is 1 on average if the error bars hold.",
        Table(left_out), "And where it lies, along its longest axis:",
        Table(stretch_table(result))], "Where nobody measured", about=left_out)


def maps_figure(result: InferenceResult) -> Figure:
    """Draw where the maps lie in the magnet."""
    figure, along, across = magnet_panels("distance from the axis in mm")
    places, maps = 1e3 * result.observation.places, np.array(result.maps)
    for number, name in enumerate(dict.fromkeys(result.maps)):
        mine = maps == name
        style: dict[str, Any] = {"ls": "none", "marker": ".ox+d"[number % 5], "mfc": "none",
                                 "ms": 2 if number == 0 else 4,
                                 "color": COLOURS[number % len(COLOURS)]}
        along.plot(places[mine, 2], np.hypot(*places[mine, :2].T), label=name, **style)
        across.plot(places[mine, 0], places[mine, 1], **style)
    legend_above(figure, along, columns=4, markerscale=3)
    return figure


UNDEFINED = "not defined"


def axis_rows(axis: MagneticAxis | None) -> Rows:
    """Return a row of text for each of centre, slope of the axis, and roll; none without axis."""
    if axis is None:
        return []
    found = {} if axis.centre_m is not None else {"magnetic centre": UNDEFINED}
    where = "" if axis.slope_rad is None else ", mean of the middle half"
    for what, unit, names, values, bars in (
            ("magnetic centre, {}", "mm", "xyz", axis.centre_m, axis.centre_sd_m),
            ("magnetic axis, d{}/dz", "mrad", "xy", axis.slope_rad, axis.slope_sd_rad),
            (f"roll about z{where}", "mrad", "z", [axis.roll_rad], [axis.roll_sd_rad])):
        if values is not None and bars is not None:
            found |= {what.format(name): with_unit(value, sd, unit)
                      for name, value, sd in zip(names, values, bars, strict=False)}
    return [{"of the updated magnet": what, "value": value} for what, value in found.items()]


def definition(axis: MagneticAxis | None, middle_z_m: float) -> str:
    """Return how centre, axis and roll are defined for the magnet's order and middle, in sentences;
    empty without an axis.
    """
    if axis is None:
        return ""
    roll = ("The roll is the turn of the main multipole about z from that of the nominal magnet, "
            "right-handed; in a magnet of finite length in the mean along its middle half, "
            "weighted by the square of the field. The integral along z, whose roll shim states, "
            "has another one if rings are turned against each other. In the table of multipoles, "
            "a of the main order says the same of one circle, with the other sign. ± is the "
            "standard deviation.")
    if axis.order == 1:
        return ("A dipole has no axis. Its centre is the point near the middle, of a magnet of "
                "finite length, where the gradient of the main component vanishes; a homogeneous "
                f"field may have none there. {roll}")
    return (f"The centre is where the multipole of order {axis.order - 1} vanishes"
            + ("" if axis.slope_rad is None else
               ", the axis the straight line through the centres along the middle half of the "
               f"magnet; the centre is its point at z = {1e3 * middle_z_m:g} mm") + f". {roll}")


ALONE = "by the readings alone"
"""Head of a column of deviations along easy axes."""

SHRUNK = (
    "± along the easy axis counts on what was known of the block before: one that is farther off "
    f"than that is shown too near to the nominal one. “{capital(ALONE)}” leaves out "
    "what was known before of that block.")
"""What the columns of the table of blocks mean."""

MOST_PARAMETERS = 3000
"""Number of magnetizations up to which that column is computed, in seconds."""

NUMBERED_SLOTS, NUMBERED_RINGS = 32, 48
"""Largest numbers of slots and rings for which the contraction figure prints its values."""

ALIKE = 0.03
"""Range of the contractions of all blocks up to which they are said instead of drawn."""


def score_table(result: InferenceResult) -> Rows:
    """Return the rows, as text, of the table that compares predictions before and after.

    Regions have names if there are several. Before the update, chi² is that of all training
    readings together, which the answer states: in their own row, or in one below those of several
    regions.
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
            if largest else EMPTY_CELL,
            "rms residual/sd": f"{score.rms_standardized_posterior:.3g}",
            "95 % band holds": _percent(score.coverage95_posterior),
            "chi²/reading, before": _chi2(
                result.prior_conflict if alone and score.part == TRAINING else score.chi2_prior),
            "chi²/reading, after": _chi2(score.chi2_posterior),
        }
        rows.append(row)
    if not alone:
        off = [flux_density(rms((result.readings - each.mean)[training]), zeros=True)
               for each in (result.prediction_prior, result.prediction_posterior)]
        together = {"region": "together", "readings": f"{training.sum()} {TRAINING}".replace(
            " ", "\u00a0"), "before, rms": off[0], "after, rms": off[1],
            "chi²/reading, before": _chi2(result.prior_conflict)}
        rows.append({name: together.get(name, EMPTY_CELL) for name in rows[0]})
    if len({row["region"] for row in rows}) == 1:  # its name tells nothing
        rows = [{name: text for name, text in row.items() if name != "region"} for row in rows]
    return rows


def _chi2(value: float | None) -> str:
    return EMPTY_CELL if value is None else decimals(value)


def block_table(result: InferenceResult) -> Rows:
    """Return rows of text: the blocks that deviate most, the one that is least likely first.

    That is by the change of the magnetization along and across the easy axis, each in standard
    deviations of its prior.
    """
    ranked = 8  # number of the blocks that a page lists: those that deviate most
    there, axes, size = easy_axes(result)
    change = result.by_block(result.posterior.mean - result.response.nominal)[there]
    along = np.einsum("ij,ij->i", change, axes)
    across = np.linalg.norm(change - along[:, None] * axes, axis=1)
    prior_sd = result.by_block(result.prior.sd)[there]
    distance = np.linalg.norm(change / np.where(prior_sd > 0, prior_sd, np.inf), axis=1)
    chosen = np.argsort(-distance, kind="stable")[:ranked]
    directions = np.zeros((len(chosen), len(result.posterior.mean)))
    for row, one in zip(directions, chosen, strict=True):
        result.by_block(row)[there[one]] = axes[one]
    of, sds = 100 / size[chosen], result.posterior.sd_of(directions)
    alone = _by_readings(result, directions, of)
    turns = np.degrees(np.arctan2(across, size + along))[chosen].tolist()
    return [{
        "block": place_of(result.magnet.blocks[there[one]]),
        "along the easy axis": f"{with_error(of[row] * along[one], of[row] * sds[row])}\u00a0%",
        **({ALONE: alone[row]} if alone else {}),
        "turned by": f"{decimals(turns[row], 2)}°",
        "standard deviations of its prior": decimals(float(distance[one]), 2)}
        for row, one in enumerate(chosen.tolist())]


def _by_readings(result: InferenceResult, directions: Floats, of: Floats) -> list[str]:
    """Return what readings alone say along unit vectors (k, m), in per cent by ``of`` (k,).

    It is empty for a magnet of more than `MOST_PARAMETERS`.
    """
    if directions.shape[1] > MOST_PARAMETERS:
        return []
    mean, sd = by_readings_alone(result.prior, result.posterior, directions)
    mean = of * (mean + directions @ (result.prior.mean - result.response.nominal))
    return [f"{with_error(value, bar)}\u00a0%" if bar < 100 else EMPTY_CELL  # not a whole block
            for value, bar in zip(mean.tolist(), (of * sd).tolist(), strict=True)]


def page(result: InferenceResult) -> Page:
    """Return the page of an updated magnet."""
    known = distributions_of(result.magnet, result)
    multipoles: list[MultipoleTable] = [
        (model, {name: model.of(distribution) for name, distribution in known.items()})
        for model in ([] if result.is_campaign else circle_models(
            result.magnet, result.observation, result.response))]
    rows, axis, stray = (score_table(result), axis_rows(result.magnetic_axis),
                         result.stray_field)
    profiles = _profiles(result)
    figures = {**profiles, **_pictures(result), **stray_pictures(stray)}
    doubtful = _doubtful(result)
    files: dict[str, Callable[[Path], object] | None] = {
        "summary.json": lambda path: write_inference(result, path.parent),
        **dict.fromkeys(("prediction.csv", "posterior.h5"))}
    if multipoles:
        files["multipoles.csv"] = multipole_csv(result.study, multipoles)
    return Page(
        "infer", "the updated magnet", result.study, answer(result, multipoles),
        inference_summary(result), [
            Section([order := row_order_note(result.study)]),
            Section([*doubtful, Table(block_table(result)), Text(SHRUNK, "small")],
                    "The blocks that deviate most"),
            _before_and_after(rows), *_sections_of_maps(result),
            Section([View(lambda: view_of_inference(result), colours_in_words(result))]),
            Section([*doubtful, definition(result.magnetic_axis, result.magnet.middle_z_m),
                     Table(axis)],
                    "Magnetic centre, axis and roll", about=axis),
            *sections_of_stray(stray, warning=doubtful),
            *sections_of_circles(
                multipoles, result.magnet, "They are those of the readings on the circle about the "
                "axis of the magnet, where the study says that the map lies. With m readings, "
                "order n would contain order m − n too; that part is subtracted, as the updated "
                "blocks make it in vacuum. Their error bars take the solver's error of every "
                "reading in full: `halbach-fe multipoles` takes as many points as are needed, and "
                "has smaller bars.", " ± is the standard deviation.", doubtful),
            *last_sections(figures, _model(result))],
        {"Differences of readings and predictions": rows,
         "The instruments, estimated with the blocks": term_table(result),
         "Where the maps lie in the magnet": pose_table(result),
         "Maps where they overlap": overlap_table(result),
         "Where nobody measured": left_out_table(result),
         "Magnetic centre, axis and roll": axis, stray_title(stray): stray_rows(stray)},
        figures=figures, shown=tuple([*profiles][:1]), files=files, stored=False, stem="report",
        remarks=[order],
        new_study=None if result.terms is None and result.study_as_found is result.study else (
            STUDY_FILE, lambda: [(result.study_as_found, NOTE)]))


def _doubtful(result: InferenceResult) -> list[Text]:
    """Return a warning above numbers of an update that disagrees with its map; none of others."""
    if not result.disagreement:
        return []
    what = ("Model and measurement disagree" if result.disagreement != result.too_near
            else "The noise is stated too large")
    return [Text(f"{what}: these numbers may be off by more than their ±.", "warning")]


def _profiles(result: InferenceResult) -> Figures:
    """Return the figures of readings and predictions, the first of which leads the page."""
    profile = ("Readings with the predictions of prior and posterior, and the residuals of the "
               "posterior, along the line of the strongest reading")
    figures: dict[str, tuple[Callable[[], Figure], str]] = {}
    if result.is_campaign:
        figures["maps.png"] = (partial(maps_figure, result), "Where the maps lie in the magnet")
        figures |= {f"profile-{name}.png": (
            partial(prediction_profile_figure, result, name), f"Map {name}. {profile}")
            for name in dict.fromkeys(result.maps) if has_profile(result, name)}
    elif has_profile(result):
        figures["profile.png"] = partial(prediction_profile_figure, result), profile
    if has_residual_maps(result):
        figures["residual_maps.png"] = (
            partial(residual_maps_figure, result.observation, {
                name: result.readings - each.mean for name, each in (
                    ("before", result.prediction_prior), ("after", result.prediction_posterior))}),
            "Measured less predicted over the map, before "
            "and after the update: what remains should be noise, without a pattern")
    return figures


def _pictures(result: InferenceResult) -> Figures:
    """Return the figures of residuals and blocks."""
    unseen = ("of the held-out readings for prior and posterior" if result.held_out.any()
              else "of the training readings for the prior (nothing was held out)")
    contraction = _contraction(result)
    return {
        "residuals.png": (
            partial(standardized_residuals_figure, result), "Standardized residuals of all "
            "readings (divided by the standard deviation of prediction and noise) for the prior "
            "(top) and the posterior (bottom). The grey band should hold 95 % of them; of the "
            "training readings it holds more for the posterior, which is fitted to them"),
        "quantiles.png": (
            partial(whitened_quantiles_figure, result), f"Quantiles of the whitened residuals "
            f"{unseen} against normal quantiles; they are whitened with the full covariance of "
            "prediction and noise, and lie on the line if the model is right"),
        "blocks.png": (
            partial(_magnetization_change_figure, result), "Posterior change of the magnetization "
            "along the easy axis, from nominal, by ring and slot"),
    } | ({} if not len(contraction) or np.ptp(contraction) < ALIKE else {
        "contraction.png": (
            partial(_contraction_figure, result), "Contraction of each block: the decrease of its "
            "variance from prior to posterior; 0 % means that the readings contain no information "
            "about the block")})


def _before_and_after(rows: Sequence[Mapping[str, str]]) -> Section:
    """Return the section of the table of scores, and what its columns are."""
    most_turned = 5  # largest number of rows of a table that has a column for each
    return Section([
        "Before and after the update: rms differences of readings and their predictions. "
        "Held-out readings did not update the magnet.",
        Table(rows, "turned" if len(rows) <= most_turned else ""), Text(
            "**of the largest reading**: the rms difference after the update, relative to the "
            "largest reading of all. **95 % band holds**: the share of the readings within the 95 "
            "% band of their prediction. **rms residual/sd**: each reading's difference from its "
            "prediction after the update, divided by the standard deviation of prediction, solver "
            "and noise together; the root mean square of these. About 1 is expected for held-out "
            "readings, less for training readings, to which the magnet was fitted. "
            "**chi²/reading**: the mean of their squares, with all correlations; 1 is expected if "
            "prior, model and noise are right. Before the update that of the training readings "
            "tests prior, model and map together: it is the one of the answer above. After it, "
            "chi² and the 95 % band test the error bars, by held-out readings only.", "small")],
        "Before and after")


def _sections_of_maps(result: InferenceResult) -> list[Section]:
    """Return what the page says of several maps, of where they lie and of their instruments."""
    overlaps, poses, terms = overlap_table(result), pose_table(result), term_table(result)
    found = ["Estimated together with the magnetizations, whose error bars include what remains "
             "uncertain here."]
    if result.terms:
        found += ["Translations are those of the middle of a map (of the first one on a common "
                  "stage), rotations about it, along the magnet's axes; stage shifts are along "
                  "those of the stage.", f"{STUDY_FILE} has the instruments that were found."
                  if result.terms.at_rest else
                  "They have not come to rest: their error bars may be too small."]
    if result.amplitudes:
        found.append("What the study has in tables [[uncertain]] is given as the change from what "
                     "it says." + (
                         "" if result.study_as_found is result.study else
                         f" {STUDY_FILE} has them as found."))
    return [
        Section([
            "Where two maps overlap, the readings of one are compared with what an update by the "
            "other alone predicts there. chi² is 1 on average if they are of the same magnet, and "
            "pose, probe and noise are as stated or uncertain.", Table(overlaps)],
            "Do the maps agree?", about=overlaps),
        left_out_section(result),
        Section(["In the magnet's axes, as the update found it.", Table(poses)],
                "Where the maps lie", about=poses),
        Section([" ".join(found), Table(terms)], "The instruments", about=terms)]


def _model(result: InferenceResult) -> dict[str, str]:
    """Return how the update was made, and of what magnet."""
    study, noise = result.study, result.noise
    sizes = dict.fromkeys(flux_density(float(end), 2) for end in (noise.sd.min(), noise.sd.max()))
    positions = study.noise.position_sd_m if study.noise else None
    moved = "" if not positions else (
        f"; sd of positions {', '.join(f'{1e3 * sd:.3g}' for sd in positions)} mm")
    blocks = result.measured_blocks
    return {
        "method of inference": result.kind, **magnet_rows(result.magnet),
        "finite-element method": study.solver.method,
        "unknown magnetizations, readings":
            f"{len(result.response.parameters)}, {len(result.readings)}",
        "prior": "the study's" if blocks is None else f"{len(blocks)} measured blocks",
        "contraction of the blocks": _contraction_in_words(result, _contraction(result)),
        "noise of the readings": f"{' to '.join(sizes)}, "
        f"{'independent' if noise.independent else 'correlated'}{moved}",
        "error of the finite elements": _solver_error(result),
        "superposition of the blocks":
            f"right to {ppm(PPM * float(result.response.superposition_error))} ppm of what "
            "permeable blocks and iron add to their fields"}


def _contraction(result: InferenceResult) -> Floats:
    """Return the contractions of the blocks that there are."""
    return result.contraction[~np.isnan(result.contraction)]


def _solver_error(result: InferenceResult) -> str:
    """Say how far the finite elements may be off, beside the noise."""
    error = result.response.error
    if not error.any():
        return "none: the blocks are in vacuum"
    return (f"at most {flux_density(float(error.max()), 2)}, "
            f"and at most {decimals(float((error / result.noise.sd).max()), 2)} times the noise "
            "of a reading; included in the error bars")


def _percent(value: float | None) -> str:
    return EMPTY_CELL if value is None else f"{100 * value:.3g}\u00a0%"


def _figure_height(rings: int) -> float:
    """Return the height in inches of a figure with a row per ring."""
    return 1.8 + 0.25 * min(rings, NUMBERED_RINGS)


def _magnetization_change_figure(result: InferenceResult) -> Figure:
    """Draw the change of each magnetization along the easy axis, from nominal to posterior."""
    picture = 100 * result.magnet.by_ring(along_easy_axes(result))  # blank for missing blocks
    rings, slots = picture.shape
    figure, axis = chart(_figure_height(rings), grid=False)
    limit = float(np.nanmax(np.abs(picture), initial=0.0)) or 1.0
    image = draw_by_slot(axis, picture, cmap="RdBu_r", vmin=-limit, vmax=limit)
    axis.add_patch(Rectangle((0.5, 0.5), slots, rings, fill=False))
    axis.set(xlabel="slot", ylabel="ring", xticks=range(1, slots + 1, max(1, slots // 24)),
             yticks=range(1, rings + 1, max(1, rings // 12)))
    figure.colorbar(image, label="posterior change along\nthe easy axis in %")
    return figure


def _contraction_in_words(result: InferenceResult, contraction: Floats) -> str:
    """Say what part of the blocks' variances the readings take away."""
    if not len(contraction):
        return "none: the prior leaves nothing open"
    low, high = (f"{100 * end:.0f}" for end in (contraction.min(), contraction.max()))
    share = f"{low} to {high}" if low != high else low
    together = ("" if result.measured_blocks is None or not result.study.prior.calibration_sd else
                "; a part of it is the calibration of the coil, which all measured blocks share")
    return f"by {share}\u00a0% of the prior's variance{together}"


def _contraction_figure(result: InferenceResult) -> Figure:
    """Draw the contraction of each block: as bars for a single ring, else by ring and slot."""
    percent = 100 * result.magnet.by_ring(result.contraction)
    rings = len(percent)
    slots = np.arange(1, percent.shape[1] + 1)
    figure, axis = chart(3 if rings == 1 else _figure_height(rings), grid=False)
    axis.set(xlabel="slot", xticks=slots[::max(1, len(slots) // 24)])
    if rings == 1:
        there = ~np.isnan(percent[0])
        bars = axis.bar(slots[there], percent[0, there], color=POSTERIOR)
        if len(slots) <= NUMBERED_SLOTS:
            axis.bar_label(bars, fmt="%.0f", fontsize=SMALL)
        axis.set(ylabel="contraction in %", ylim=(0, 108), yticks=range(0, 101, 20))
        return figure
    image = draw_by_slot(axis, percent, cmap="cividis", vmin=0, vmax=100)
    if len(slots) <= NUMBERED_SLOTS and rings <= NUMBERED_RINGS:
        for (ring, slot), value in np.ndenumerate(percent):
            if np.isnan(value):
                continue
            axis.text(slot + 1, ring + 1, f"{value:.0f}", ha="center", va="center", fontsize=SMALL,
                      color="white" if value < 50 else "black")
    axis.set(ylabel="ring", yticks=range(1, rings + 1, max(1, rings // 12)))
    figure.colorbar(image, label="contraction in %")
    return figure
