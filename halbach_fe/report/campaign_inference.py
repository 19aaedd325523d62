"""Tables, figures and study file of an update by several maps, or with uncertain instruments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.numbers import decimals
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.campaign import with_paths_from
from halbach_fe.report.page import MEASURED, POSTERIOR, PRIOR, PUBLISHED, SECOND, figure_of
from halbach_fe.study.edit_file import write_edited
from halbach_fe.study.reader import read_study

STUDY_FILE = "study.updated.toml"

NOTE = "found by halbach-fe infer"

UNITS = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "T": ("mT", 1e3)}
"""Unit that people read, and its factor, for the unit at the end of a term's name."""

COLOURS = (POSTERIOR, SECOND, MEASURED, PUBLISHED, PRIOR)


def term_table(result: InferenceResult) -> list[dict[str, str]]:
    """Return rows of text: what the update says about the instruments, and about uncertain
    amplitudes; none if all are known.
    """
    rows = []
    terms = [row for found in (result.terms, result.amplitudes) if found is not None
             for row in zip(found.names, found.change, found.sd, found.prior_sd, strict=True)]
    for name, change, sd, prior_sd in terms:
        owner, _, term = name.rpartition(".")
        what, _, unit = term.rpartition("_")
        shown, factor = UNITS.get(unit, ("%", 100.0))
        what = what if unit in UNITS else term
        rows.append({"of": owner, "term": what.replace("_", " "),
                     "change from the study": f"{factor * change:+.4f} ± {factor * sd:.4f} {shown}",
                     "known before": f"± {factor * prior_sd:.3g} {shown}"})
    return rows


def pose_table(result: InferenceResult) -> list[dict[str, str]]:
    """Return rows of text: where the middles of the maps lie; none if that was known before."""
    return [{"map": pose.name} | {
        f"{axis} of its middle": f"{1e3 * value:.3f} ± {1e3 * sd:.3f} mm"
        for axis, value, sd in zip("xyz", pose.middle_m, pose.middle_sd_m, strict=True)} | {
        "turned about x, y, z": "± " + ", ".join(f"{1e3 * sd:.2g}" for sd in pose.turn_sd_rad)
        + " mrad"} for pose in (result.terms.poses if result.terms else ())]


def overlap_table(result: InferenceResult) -> list[dict[str, str]]:
    """Return rows of text: how maps agree where they overlap; none if they do not."""
    return [{
        "map": each.name, "as predicted by map": each.by,
        "readings": f"{each.readings}{' held out' if each.held_out else ''}",
        "rms difference": f"{1e3 * each.rms_T:.3g} mT", "chi²/reading": decimals(each.chi2),
        "verdict": "they disagree" if each.disagreement else "they agree"}
        for each in result.overlaps]


def left_out_table(result: InferenceResult) -> list[dict[str, str]]:
    """Return rows of text: how maps, or ends of the only one, are predicted that were left out."""
    return [{
        "left out": each.name or "ends of the map", "readings": str(each.readings),
        "rms difference": f"{1e3 * each.rms_T:.3g} mT", "over noise": decimals(each.over_noise),
        "chi²/reading": decimals(each.chi2)} for each in result.regions_left_out]


def maps_figure(result: InferenceResult) -> Figure:
    """Draw where the maps lie in the magnet."""
    figure = figure_of(3.6)
    along, across = figure.subplots(1, 2, width_ratios=(2, 1))
    places, maps = 1e3 * result.observation.places, np.array(result.maps)
    for number, name in enumerate(dict.fromkeys(result.maps)):
        mine = maps == name
        style = {"ls": "none", "marker": ".ox+d"[number % 5], "mfc": "none",
                 "ms": 2 if number == 0 else 4, "color": COLOURS[number % len(COLOURS)]}
        along.plot(places[mine, 2], np.hypot(*places[mine, :2].T), label=name, **style)
        across.plot(places[mine, 0], places[mine, 1], **style)
    along.set_xlabel("z in the magnet in mm")
    along.set_ylabel("distance from the axis in mm")
    figure.legend(*along.get_legend_handles_labels(), loc="outside upper center", ncols=4,
                  frameon=False, markerscale=3)
    across.set_aspect("equal", adjustable="datalim")
    across.set_xlabel("x in the magnet in mm")
    across.set_ylabel("y in the magnet in mm")
    for axis in (along, across):
        axis.grid(alpha=0.3)
    return figure


def write_updated_study(path: Path, result: InferenceResult, folder: Path) -> None:
    """Write study.updated.toml: the study in a file, with the instruments that were found."""
    study = with_paths_from(result.study, path.parent, folder)
    before = with_paths_from(read_study(path), path.parent, folder)
    write_edited(folder / STUDY_FILE, path.read_text(encoding="utf-8-sig"),
                 [(before, "path from this folder"), (study, NOTE)])
