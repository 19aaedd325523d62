"""Page of `demagnetization`: figures and tables of the margin to the knee."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.design.demagnetization import (
    LINEAR,
    SHARES,
    DemagnetizationMap,
    knee_now,
    write_vtu,
)
from halbach_fe.geometry.blocks import block_in_words
from halbach_fe.report.answer import Answer
from halbach_fe.report.magnet_view_3d import BlockValues, Colours, magnet_view
from halbach_fe.report.page import (
    LISTED,
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    View,
    chart,
    csv_file,
    figure_of,
    legend_above,
)
from halbach_fe.report.words import place_of
from halbach_fe.study.model import is_nonlinear

PAST = "#D55E00"
"""Colour of the knee and of cells past it."""

ROOM_C = 20.0
"""Temperature in °C at which a magnet is kept at least."""

VERY_EDGES = 1e-3
"""Share of the volume that counts as the very edges of blocks, where H has no bound. A magnet of
many blocks may lose as little in a large part of one: of no block is it more than the last of
`SHARES`, whose temperature is stated as a limit."""

AT_ROOM = "It loses magnetization at room temperature already."
"""Sentence about a magnet that does not keep its magnetization there."""


def demagnetization_summary(found: DemagnetizationMap) -> Plain:
    """Return the content of demagnetization.json: margins, shares and limit temperatures."""
    material, worst = found.material, int(np.argmin(found.margin))
    block = found.blocks[found.cells.block[worst]]
    temperature = material.temperature_C
    limits = {str(share): found.limit_temperature(share) for share in SHARES}
    return {
        "study": found.study.name, "temperature_C": temperature,
        "knee_A_per_m": float(found.margin[worst] - found.along[worst]),
        "least_H_A_per_m": float(found.along[worst]),
        "least_margin_A_per_m": float(found.margin[worst]),
        "margin_error_A_per_m": found.along_error,
        "at_m": found.cells.middles[worst].tolist(), "block": block.name, "ring": block.ring,
        "slot": block.slot,
        "share_beyond_knee": found.share_beyond_now, "share_error": found.share_error,
        "limit_temperature_C": {share: limit if math.isfinite(limit) else None
                                for share, limit in limits.items()},
        "cells": len(found.along),
    }


def answer(found: DemagnetizationMap) -> Answer:
    """Say whether blocks lose magnetization, at which temperature they begin to, and what next."""
    state = _Losses.of(found)
    next_step, command = _next_step(found, state)
    temperature, start = f"{found.material.temperature_C:g}\u00a0°C", _past_the_knee(found)
    said = (f"{state.in_a_word}: at {temperature}, "
            f"{'if the linear law held, ' if state.far else ''}{start}.")
    concern = f"At {temperature}, {start}." if state.now else AT_ROOM if state.at_room else ""
    return Answer(
        "Do the blocks keep their magnetization?",
        " ".join(filter(None, [said, _worst_block(found), _margins(found),
                               AT_ROOM if state.at_room else ""])),
        _trust(found, state), next_step, command, concern=concern, sound=not state.far)


@dataclass(frozen=True)
class _Losses:
    """Whether magnetization is lost, and whether that can be known."""

    now: bool
    at_room: bool
    """Whether some is lost at the temperature of the study, and at room temperature."""
    far: float | None
    """Factor of the coercivity at that temperature, if it is so far from the reference that the
    coefficients of the study do not hold."""
    sure: bool
    """Whether some is lost on the way to that temperature, where they hold."""

    @classmethod
    def of(cls, found: DemagnetizationMap) -> _Losses:
        """Return those of a map of margins."""
        limit, now = found.limit_temperature(SHARES[-1]), not _at_edges_alone(found)
        at_room = limit > ROOM_C if found.worst_when_cold else limit < ROOM_C
        low, high = LINEAR
        on_the_way = now and math.isfinite(limit) and (
            low <= found.coercivity_factor(limit) <= high)
        return cls(now, at_room, found.far_from_reference, at_room or on_the_way)

    @property
    def in_a_word(self) -> str:
        """Whether the blocks keep their magnetization."""
        if self.far and not self.sure:
            return "Not known"
        return "No" if self.now or self.at_room else "Yes"


def _at_edges_alone(found: DemagnetizationMap) -> bool:
    """Tell whether no more than the very edges of blocks is past the knee."""
    return found.share_beyond_now <= VERY_EDGES and max(
        row["share_beyond_knee"] for row in found.by_block()) <= SHARES[-1]


def _past_the_knee(found: DemagnetizationMap) -> str:
    """Say which share of the volume loses magnetization."""
    lost = found.share_beyond_now
    if not lost:
        return "no cell is past the knee of the demagnetization curve"
    if _at_edges_alone(found):
        return (f"about {100 * lost:.1g} % of the magnet's volume, at the very edges of "
                "blocks, is past the knee of its demagnetization curve")
    error = f" ± {_percent(found.share_error)}" if found.share_error else ""
    return (f"{100 * lost:.3g}{error} % of the magnet's volume is past the knee of its "
            "demagnetization curve and loses magnetization for good")


def _percent(share: float) -> str:
    """Return an error of a share in per cent."""
    return f"{float(f'{100 * share:.1g}'):g}"


def _worst_block(found: DemagnetizationMap) -> str:
    """Say which block loses most, if any does."""
    if _at_edges_alone(found):
        return ""
    most = max(found.by_block(), key=lambda row: row["share_beyond_knee"])
    by_name = {each.name: each for each in found.blocks}
    return (f"The block that loses most is {place_of(by_name[most['block']])}, of which "
            f"{100 * most['share_beyond_knee']:.3g} % is past the knee.")


def _margins(found: DemagnetizationMap) -> str:
    """Say how far the worst cell is from the knee, and which temperatures are too much."""
    worst = int(np.argmin(found.margin))
    block = place_of(found.blocks[found.cells.block[worst]])
    limits = "; ".join(_limit_in_words(found, share) for share in SHARES)
    bar = f"\u00a0±\u00a0{1e-3 * found.along_error:.2g}" if found.along_error else ""
    return (f"The smallest margin in the middle of a cell is {1e-3 * found.margin[worst]:+.0f}"
            f"{bar} kA/m, in {block}; {limits}.")


def _trust(found: DemagnetizationMap, state: _Losses) -> str:
    """Say what the answer depends on."""
    reference = found.material.reference_temperature_C
    if state.far:
        first = (f"{'Only that it loses some' if state.sure else 'No'}: the coefficients of the "
                 f"study would make the coercivity {state.far:.2g} times that at "
                 f"{reference:g}\u00a0°C, and hold only nearer to it.")
    else:
        first = ("Yes, as far as coercivity and coefficients of the study are right: data sheets "
                 "state them within some per cent.")
    sentences = [first, "The very edges of blocks are worse than any cell (the option --across "
                 "makes them smaller)." + (
                     "" if _at_edges_alone(found) else
                     f" ± {_percent(found.share_error)} % is what the share of the volume depends "
                     "on the places in the cells that were computed.")]
    if found.along_error:
        sentences.append("The margin's error bar is that of the block's permeability, which is "
                         "solved for in cells (mesh.cells_per_side sets their number).")
    if found.magnet.iron:
        sentences.append("At edges and inner corners of iron H has no bound either: within the "
                         "elements of the iron there its values in cells are not known.")
    if is_nonlinear(found.study):
        sentences.append("At other temperatures the field of the iron is scaled with the "
                         "remanence.")
    if found.material.temperature_C != reference:
        sentences.append(f"The study's remanence counts as that at {reference:g}\u00a0°C.")
    return " ".join(sentences)


def _next_step(found: DemagnetizationMap, state: _Losses) -> tuple[str, str]:
    """Return what to do next, and the command for it."""
    if state.far and not state.sure:
        return ("State coercivity and remanence that were measured nearer to that temperature, and "
                "theirs as reference_temperature_C.", "halbach-fe demagnetization STUDY -o DIR")
    if state.now or state.at_room:
        return ("Choose a grade of a higher coercivity for these blocks (the table on the page "
                f"says which), or keep the magnet {'warmer' if found.worst_when_cold else 'cooler'}"
                ". If it is built already, a measurement shows what it has lost.",
                "halbach-fe diagnose STUDY --measurements MAP -o DIR")
    if found.study.dimension == 3:
        return ("Nothing has to be done at this temperature. Next, see which forces the blocks "
                "feel.", "halbach-fe forces STUDY -o DIR")
    return ("Nothing has to be done at this temperature. Next, see what the tolerances of the "
            "blocks do to the field.", "halbach-fe tolerance STUDY -o DIR")


def _limit_in_words(found: DemagnetizationMap, share: float) -> str:
    """Say at which temperature in °C a share of the volume passes the knee."""
    part = f"{100 * share:g} % of the volume" if share else "the first cell"
    limit, cold = found.limit_temperature(share), found.worst_when_cold
    if math.isfinite(limit):
        return f"{part} passes the knee {'below' if cold else 'at'} {round(limit)} °C"
    if (limit > 0) == cold:
        return f"{part} is past the knee at every temperature"
    return f"{part} never passes the knee" if share else "no cell ever passes the knee"


def page(found: DemagnetizationMap) -> Page:
    """Return the page of the margins of the blocks."""
    summary, blocks, material = demagnetization_summary(found), found.by_block(), found.material
    rows = _worst_block_table(blocks)
    reference_C = f"{material.reference_temperature_C:g} °C"
    grades = dict(zip(found.magnet.demagnetizations, found.magnet.materials, strict=True))
    knees = "; ".join(
        f"at |H| = {1e-3 * knee_now(kind):.0f} kA/m"
        + (f" in blocks of {grades[kind] or 'no grade'}" if len(found.kinds) > 1 else "")
        + f": {kind.squareness:g} times the intrinsic "
        f"coercivity, which is {1e-3 * kind.intrinsic_coercivity_A_per_m:.0f} kA/m at "
        f"{kind.reference_temperature_C:g} °C and changes by "
        f"{100 * kind.coercivity_coefficient_per_K:g} % per kelvin (the remanence by "
        f"{100 * kind.remanence_coefficient_per_K:g} %)" for kind in found.kinds)
    of_all = f"{len(rows)} of {len(blocks)} blocks; all are in demagnetization.csv. "
    return Page("demagnetization", "demagnetization margin", found.study, answer(found), summary, [
        Section([
            "H is the field strength in the nominal magnet along each block's magnetization, in "
            f"{len(found.along)} cells. It is the exact field of the blocks in vacuum plus the "
            "finite-element field that the permeability of the blocks and the iron add. At this "
            f"temperature the knee is {knees}.",
            Text("H diverges logarithmically at the edges of blocks, so that the smallest margin "
                 "falls slightly with smaller cells (--across); shares of the volume converge. Not "
                 "modelled: fields across the easy axis, which demagnetize less, and the field "
                 "change that the loss of one cell causes in others." + (
                     " At other temperatures the field of the iron is scaled with the remanence."
                     if is_nonlinear(found.study) else ""), "small"),
            View(partial(_view, found, blocks), "blocks by their smallest margin to the knee")]),
        Section([
            f"{of_all if len(blocks) > len(rows) else ''}H_cJ needed is the smallest intrinsic "
            f"coercivity at {reference_C} with which no cell of the block is past the knee at "
            f"{material.temperature_C:g} °C.",
            Table(rows, "numbers")], "Blocks with the smallest margins")],
        {"Blocks with the smallest margin": rows},
        figures={
            "demagnetization_map.png": (
                partial(_map_figure, found), "H along the magnetization in the blocks; cells past "
                "the knee, if any, are outlined"),
            "demagnetization_temperature.png": (
                partial(_temperature_figure, found), "Share of the magnet's volume past the knee "
                "against the temperature"),
            "demagnetization_blocks.png": (
                partial(_slots_figure, found), "H along the magnetization by slot: mean of each "
                "block, and smallest value in any of its cells")},
        files={
            "demagnetization.csv": csv_file(
                {key: [row[key] for row in blocks] for key in blocks[0]}, {
                    "study": found.study.name, "temperature_C": str(material.temperature_C)}),
            "demagnetization.vtu": partial(write_vtu, found)})


def _worst_block_table(rows: list[dict[str, Any]]) -> Rows:
    """Return the rows of the few blocks with the smallest margins, as text."""
    return [{"block": block_in_words(row["ring"], row["slot"], row["block"]),
             "mean H in kA/m": f"{1e-3 * row['mean_H_A_per_m']:.0f}",
             "lowest H in kA/m": f"{1e-3 * row['least_H_A_per_m']:.0f}",
             "margin in kA/m": f"{1e-3 * row['margin_A_per_m']:+.0f}",
             "past the knee": f"{100 * row['share_beyond_knee']:.1f} %",
             "H_cJ needed in kA/m": f"{1e-3 * row['needed_coercivity_A_per_m']:.0f}"}
            for row in sorted(rows, key=lambda row: row["margin_A_per_m"])[:LISTED]]


def _layers(found: DemagnetizationMap) -> dict[str, Ints]:
    """Return the numbers of the cells to draw, by title of the panel.

    The panels show the layer of cells nearest to the middle along z and the layer with the smallest
    margin; a single panel if these are the same, or mirror images.
    """
    z = found.cells.middles[:, 2].round(9)
    away = np.abs(z - found.magnet.middle_z_m)
    nearest, least = np.argmin(away), np.argmin(found.margin)
    middle, worst = z[nearest], z[least]
    if np.isclose(away[least], away[nearest]):
        return {f"z = {round(1e3 * worst)} mm" if np.ptp(z) else "": np.flatnonzero(z == worst)}
    return {f"z = {round(1e3 * height)} mm{words}": np.flatnonzero(z == height)
            for height, words in ((middle, ""), (worst, ", smallest margin"))}


def _map_figure(found: DemagnetizationMap) -> Figure:
    """Draw H along the magnetization in layers of cells."""
    layers = _layers(found)
    figure = figure_of(5, 6.2) if len(layers) == 1 else figure_of(3.6)
    limits = 1e-3 * float(found.along.min()), 1e-3 * float(found.along.max())
    thresholds = [-1e-3 * knee_now(kind) for kind in found.kinds]
    axes: list[Axes] = list(figure.subplots(1, len(layers), squeeze=False)[0])
    for axis, (title, cells) in zip(axes, layers.items(), strict=True):
        faces = 1e3 * found.cells.vertices[found.cells.corners[cells, :4]][..., :2]
        values = 1e-3 * found.along[cells]
        drawn = PolyCollection(list(faces), array=values, cmap="cividis", edgecolors="face", lw=0.2)
        drawn.set_clim(*limits)
        axis.add_collection(drawn)
        axis.add_collection(PolyCollection(list(faces[found.margin[cells] < 0]), facecolors="none",
                                           edgecolors=PAST, lw=0.8))
        axis.set(aspect="equal", xlabel="x in mm", ylabel="y in mm", title=title)
        axis.autoscale_view()
    bar = figure.colorbar(drawn, ax=axes, label="H along the magnetization in kA/m")
    for threshold in thresholds:
        if limits[0] < threshold < limits[1]:
            bar.ax.axhline(threshold, color=PAST, lw=2)
    return figure


def _temperature_figure(found: DemagnetizationMap) -> Figure:
    """Draw the share of the volume past the knee against the temperature."""
    # Margin in K by which the temperature axis extends beyond the magnet's temperature and beyond
    # the limit temperature of the last of `SHARES`.
    sweep_k = 40.0
    material = found.material
    figure, axis = chart(3.4)
    limit = found.limit_temperature(SHARES[-1])
    last = [material.temperature_C, limit if math.isfinite(limit) else material.temperature_C]
    ends = ((min(last) - sweep_k, max(*last, material.reference_temperature_C))
            if found.worst_when_cold else
            (min(material.temperature_C, material.reference_temperature_C), max(last) + sweep_k))
    temperature = np.linspace(*ends, 241)
    axis.plot(temperature, 100 * found.share_beyond(temperature), color=POSTERIOR)
    axis.axvline(material.temperature_C, color=PRIOR, ls="--",
                 label=f"temperature of the magnet, {material.temperature_C:g} °C")
    axis.set(xlabel="temperature in °C", ylabel="volume past the knee in %", ylim=(0, None))
    legend_above(figure, axis)
    return figure


def _slots_figure(found: DemagnetizationMap) -> Figure:
    """Draw the mean and the smallest H of every block by slot."""
    rows = found.by_block()
    figure, axis = chart(3.4)
    slots = np.array([row["slot"] for row in rows])
    for key, words, colour, shift in (("mean_H_A_per_m", "mean", POSTERIOR, -0.15),
                                      ("least_H_A_per_m", "smallest", MEASURED, 0.15)):
        values = 1e-3 * np.array([row[key] for row in rows])
        axis.plot(slots + shift, values, "o", ms=4, color=colour, label=words, alpha=0.7)
    for number, kind in enumerate(found.kinds):
        axis.axhline(-1e-3 * knee_now(kind), color=PAST, label="" if number else "knee")
    axis.axhline(0, color=PUBLISHED, lw=0.8)
    axis.set(xlabel="slot", ylabel="H along the\nmagnetization in kA/m")
    legend_above(figure, axis, columns=3)
    return figure


def _view(found: DemagnetizationMap, rows: list[dict[str, Any]]) -> Markup:
    """Return the view of the magnet with blocks coloured by their smallest margin."""
    size, count = found.study.dimension, len(found.blocks)
    magnetization: Floats = np.array([block.magnetization[:size] for block in found.blocks])
    margin, words = np.zeros(count), ["not magnetized"] * count
    for number, row in zip(np.unique(found.cells.block), rows, strict=True):
        margin[number] = 1e-3 * row["margin_A_per_m"]
        words[number] = f"smallest margin {margin[number]:+.0f} kA/m"
    return magnet_view(found.magnet, BlockValues(magnetization, Colours(
        margin, "smallest margin<br>to the knee in kA/m", words,
        (min(0.0, float(margin.min())), max(0.0, float(margin.max()))))))
