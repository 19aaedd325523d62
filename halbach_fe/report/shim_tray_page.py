"""Page of `shim-tray`: the table to fill a tray from, and the field before and after."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats, azimuths_of, degrees_of
from halbach_fe.design.shim_tray import FilledTray
from halbach_fe.report.answer import Answer, of_a_conflict
from halbach_fe.report.homogeneity_page import largest_shown, plain_homogeneity, slices_figure
from halbach_fe.report.page import (
    LISTED,
    PUBLISHED,
    Drawn,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    attributes,
    chart,
    columns_by_axis,
    csv_file,
)
from halbach_fe.report.words import ppm, within_a_sentence
from halbach_fe.response.homogeneity import Homogeneity

STUDY_FILE = "study.filled.toml"
"""Name of the study that has the magnets of the tray."""

FEW = 1.2
"""Factor below which the deviations are called hardly smaller."""

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")


def answer(found: FilledTray) -> Answer:
    """Say what the tray does, with how many magnets, and what to do next."""
    question = f"Which magnets in the tray make the field in {found.model.region.text} homogeneous?"
    harmonics = "halbach-fe homogeneity STUDY --posterior POSTERIOR -o DIR"
    (_, before, _), (_, after, _) = found.before.rms_range_ppm, found.after.rms_range_ppm
    low, _, high = map(ppm, found.after.rms_range_ppm)
    count, places = len(found.filled), len(found.places_m)
    text = (f"With {count} magnets in the {places} places of the tray, the field deviates by "
            f"{ppm(after)} ppm rms (95 %: {low} to {high}), without them by {ppm(before)}.")
    if not count:
        text = ("Leave the tray empty: none of its magnets makes the field more homogeneous than "
                f"{ppm(before)} ppm rms.")
    elif not any(found.left.values()):
        text += " The whole inventory is used: more magnets may do better."
    useless = before < FEW * after
    if count and useless:
        text = f"Do not fill this tray: {within_a_sentence(text)} That is hardly less."
    if found.disagreement:
        return of_a_conflict(question, text, found.disagreement)
    if not count:
        return Answer(question, text, _ranges(found), "Put smaller magnets or more places into "
                      "[shim_tray], or look for what the deviation comes from: its harmonics tell.",
                      harmonics)
    step, trust = (f"Fill the tray from shim_tray.csv, then measure again and update {STUDY_FILE}, "
                   "which has the tray's magnets as free blocks."), ""
    command = f"halbach-fe infer DIR/{STUDY_FILE} --measurements NEW_MAP -o DIR"
    if useless:
        step, command = (
            ("The deviation is that of the design, and too large for a tray: search for a "
             "better arrangement of the blocks first.", "halbach-fe design STUDY -o DIR")
            if found.magnet.study.design is not None else
            ("Take larger magnets or more places, or look for what the deviation comes from: its "
             "harmonics tell.", harmonics))
    elif after > 2 * found.after.rms_ppm:
        trust = ("What remains is mostly what the measurement and the strength of the shims leave "
                 "open. ")
        step = (f"Fill the tray from shim_tray.csv, measure again with it, update {STUDY_FILE}, "
                "which has its magnets as free blocks, and fill a second one in places that are "
                "still free.")
    return Answer(
        question, text, f"{trust}{_ranges(found)}", step, command,
        gist=f"Do not fill this tray: {count} of its magnets hardly help." if useless else
        f"Fill the tray with {count} magnets in {places} places.",
        numbers=(("rms deviation without and with the tray",
                  f"{ppm(before)} → {ppm(after)}\u00a0ppm"),))


def _ranges(found: FilledTray) -> str:
    """Say what the ranges contain."""
    tray, doubt = found.magnet.study.shim_tray, f" {found.model.sampling.doubt}".rstrip()
    shims = (f"{100 * tray.strength_sd:g} % of each shim's strength and {100 * tray.common_sd:g} % "
             "that all shims share" if tray else "the strength of the shims")
    return (f"Yes, as far as the update is right: ranges contain what it leaves open, and {shims}."
            f"{doubt}")


def _rows(found: FilledTray) -> Rows:
    """Return a row of text for every magnet."""
    return [{
        "place": str(one.place),
        "at": "({})\u00a0mm".format(", ".join(f"{1e3 * value:.4g}" for value in one.position_m)),
        "magnet": one.magnet.name,
        "polarization from the radius": f"{one.from_radius_deg:g}°",
        "from the x axis": f"{one.direction_deg:.1f}°"} for one in found.filled]


def _field_rows(found: FilledTray) -> Rows:
    """Return a row of text for the field before and after."""
    def row(name: str, known: Homogeneity) -> dict[str, str]:
        low, middle, high = map(ppm, known.rms_range_ppm)
        return {"tray": name, "mean field": f"{1e3 * known.mean_T:.6g}\u00a0mT",
                "rms in ppm": middle, "rms, 95 % in ppm": f"{low} to {high}",
                "rms of the mean field in ppm": ppm(known.rms_ppm),
                "peak to peak in ppm": ppm(known.peak_to_peak_range_ppm[1])}

    return [row("empty", found.before), row("filled", found.after)]


def _summary(found: FilledTray) -> Plain:
    """Return the content of shim_tray.json."""
    return {"study": found.magnet.name, "region": asdict(found.model.region),
            "places": len(found.places_m), "magnets": len(found.filled), "left": found.left,
            "before": plain_homogeneity(found.before), "after": plain_homogeneity(found.after),
            "filled": [{**attributes(one, "place", "position_m"), "magnet": one.magnet.name,
                        **attributes(one, "from_radius_deg", "direction_deg")}
                       for one in found.filled]}


def _columns(found: FilledTray) -> dict[str, Iterable[object]]:
    """Return the columns of shim_tray.csv, with a row for every place, also of empty ones."""
    there = {one.place: one for one in found.filled}
    every = [there.get(number) for number in range(1, len(found.places_m) + 1)]
    return {"place": range(1, len(every) + 1),
            **columns_by_axis("{}_m", found.places_m),
            "magnet": ["" if one is None else one.magnet.name for one in every],
            **{key: [np.nan if one is None else getattr(one, key) for one in every]
               for key in ("from_radius_deg", "direction_deg")}}


def _tray_figure(found: FilledTray) -> Figure:
    """Draw the tray unrolled, seen from outside.

    Arrows are polarizations: upwards ones point away from the axis, those to the right towards
    larger angles.
    """
    columns, rows = (len(np.unique(values.round(6))) for values in (
        azimuths_of(found.places_m), found.places_m[:, 2]))
    figure, axis = chart(float(np.clip(1.6 + 0.45 * rows, 3.0, 8.0)), grid=False)

    def unrolled(places: Floats) -> tuple[Floats, Floats]:
        return degrees_of(places), 1e3 * places[:, 2]

    axis.plot(*unrolled(found.places_m), "o", ms=12, mfc="none", mec=PUBLISHED, lw=0.5,
              label="place")
    names = list(found.left)
    for number, name in enumerate(names):
        mine = [one for one in found.filled if one.magnet.name == name]
        if not mine:
            continue
        angle, z = unrolled(np.array([one.position_m for one in mine]))
        turn = np.radians([one.from_radius_deg for one in mine])
        colour = COLOURS[number % len(COLOURS)]
        axis.quiver(angle, z, np.sin(turn), np.cos(turn), pivot="mid", color=colour,
                    scale=max(26, 1.1 * columns), width=0.005, label=name)
    axis.set(xlabel="angle about z in degrees", ylabel="z in mm", xlim=(-10, 360))
    axis.margins(y=0.2)
    axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(names) + 1, frameon=False)
    return figure


def page(found: FilledTray) -> Page:
    """Return the page of a tray, with the table to fill it from."""
    tray, filled = found.magnet.study.shim_tray, found.filled_study
    assert tray is not None
    before, after = (model.slices(known) for model, known in (
        (found.model, found.before_known), (found.shimmed, found.after_known)))
    text = ("Deviation of |B| from its mean over the region (dashed), in planes through its "
            "centre, with {}")
    largest = largest_shown(before, found.before.mean_T)  # the same colours in both
    rows, fields = _rows(found), _field_rows(found)
    listed = ("The tray" if len(rows) <= LISTED else
              f"The first {LISTED} of {len(rows)} magnets of shim_tray.csv")
    figures = {
        "shim_tray.png": (
            partial(_tray_figure, found), "The tray unrolled, seen from outside. Arrows point to "
            "the north poles of its magnets: up is away from the axis, right is "
            "counter-clockwise"),
        "before.png": (partial(slices_figure, before, found.before.mean_T, largest),
                       text.format("an empty tray")),
        "after.png": (partial(slices_figure, after, found.after.mean_T, largest),
                      text.format("the filled tray"))}
    return Page("shim-tray", "shim tray", found.magnet.study, answer(found), _summary(found), [
        Section([Table(fields, "turned"), Drawn("before.png"), Drawn("after.png")]),
        Section([
            "Angles of a magnet's polarization are counter-clockwise as seen from +z: from the "
            "radius of its place outwards, and from the x axis. Empty places are left out.",
            Table(rows),
            f"Ranges contain what the measurement leaves open, {100 * tray.strength_sd:g} % of "
            f"each shim's strength, and {100 * tray.common_sd:g} % that all shims share, among it "
            "what permeable blocks answer. The rms is the median of the magnets that are possible; "
            "that of the mean field is smaller."], "What to put where")],
        {f"The field in {found.model.region.text}": fields, listed: rows[:LISTED]}, rows, figures,
        files={"shim_tray.csv": csv_file(_columns(found), {"study": found.magnet.name})},
        new_study=None if filled is None else (
            STUDY_FILE, lambda: [(filled, f"{len(rows)} magnets of the shim tray")]))
