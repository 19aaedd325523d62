"""Figures, table and page of moves that shim a magnet."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.design.shimming import STOPS, Placement, Shim, Step
from halbach_fe.inference.result import InferenceResult
from halbach_fe.report.multipoles import multipole_figure, reference_summary, reference_text
from halbach_fe.report.page import POSTERIOR, PUBLISHED, SECOND, draw_magnet, save, write_page
from halbach_fe.response.multipoles import plain, text_table
from halbach_fe.study.edit import edited_text


def shim_summary(shim: Shim, update: InferenceResult) -> dict[str, object]:
    """What a script wants to know of a shim."""
    unit = shim.model.unit
    return {
        "study": shim.study.name, "reference": reference_summary(shim.model, shim.limit),
        "before": plain(shim.before, unit), "after": plain(shim.after, unit),
        "moves": [_plain_step(shim, step) for step in shim.steps],
        "stop": shim.stop, "moves_there_are": shim.tried,
        "probability_within_limit": None if shim.within is None else {
            "before": shim.within[0], "after": shim.within[1]},
        "mounting_sd_deg": shim.study.prior.mounting_sd_deg,
        "prior_conflict": update.prior_conflict, "prior_conflict_limit": update.conflict_limit,
    }


def _plain_step(shim: Shim, step: Step) -> dict[str, object]:
    return {"kind": step.move.kind,
            "blocks": [_plain_placement(shim, one) for one in step.move.placements],
            "gain_units2": step.gain, "gain_sd_units2": step.gain_sd,
            "rms_after_units": _rms(step)}


def _plain_placement(shim: Shim, one: Placement) -> dict[str, object]:
    places = shim.mounts.places
    spare = one.block - len(places)
    return {"from": list(places[one.block]) if spare < 0 else None,
            "spare": shim.spares[spare] if spare >= 0 else None, "to": list(places[one.to]),
            "turn_deg": list(shim.mounts.turn_deg(one.turn))}


def _rms(step: Step) -> float:
    return float(np.sqrt(step.after.expected_square / len(step.after.orders)))


def move_table(shim: Shim) -> list[dict[str, str]]:
    """Rows of text, a move each."""
    return [{"move": f"{number}: {step.move.kind}",
             "blocks": "; ".join(_text(shim, one) for one in step.move.placements),
             "gain in units²": f"{step.gain:.0f} ± {step.gain_sd:.0f}",
             "rms after": f"{_rms(step):.3g}"} for number, step in enumerate(shim.steps, start=1)]


def _text(shim: Shim, one: Placement) -> str:
    places = shim.mounts.places
    ring, slot = places[one.to]
    spare = one.block - len(places)
    source = (f"spare {shim.spares[spare]}" if spare >= 0
              else "ring {} slot {}".format(*places[one.block]))
    where = "in place" if one.block == one.to else f"to ring {ring} slot {slot}"
    vector = np.array(shim.mounts.turn_deg(one.turn))
    angle = float(np.linalg.norm(vector))
    if not angle:
        return f"{source} {where}"
    axis = vector / angle
    block = shim.study.array.block
    follows = block.shape == "cuboid" and block.orientation == "magnetization"
    own = ("magnetization's", "transverse", "axial") if follows else (
        "radial", "azimuthal", "axial")
    names = [name for name, part in zip(own, axis, strict=True) if abs(part) > 1 - 1e-6]
    about = names[0] if names else "(" + ", ".join(f"{part:.3g}" for part in axis) + ")"
    sign = -1 if names and axis.sum() < 0 else 1
    return f"{source} {where}, then turned by {sign * angle:.0f}° about its {about} axis"


def write_shim(shim: Shim, update: InferenceResult, text: str, folder: Path) -> None:
    """Write shim.json, shim.html and its figures, and study.shimmed.toml from the study file's
    text, if blocks are moved and the study can say so.
    """
    summary = shim_summary(shim, update)
    shimmed = shim.shimmed_study
    note = f"shimmed: {len(shim.steps)} moves"
    summary["study_file"] = "study.shimmed.toml" if shimmed else None
    if shimmed:
        write_text(folder / "study.shimmed.toml", edited_text(text, [(shimmed, note)]))
    write_text(folder / "shim.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    figures = {"shim_multipoles.png": (
        multipole_figure({"before": shim.before, "after": shim.after}, shim.limit),
        "Unwanted multipoles before and after the moves, normal on the left and skew on the right; "
        "bars are two standard deviations")}
    if shim.steps:
        figures |= {
            "shim_moves.png": (_moves(shim), "Where blocks go: lines join blocks that are swapped, "
                               "rings are turned in place, squares replaced; numbers are those of "
                               "the moves"),
            "shim_gain.png": (_gain(shim), "Root mean square of the unwanted multipoles after each "
                              "move, uncertainty included")}
    write_page(folder / "shim.html", "shim.html.j2", save(figures, folder), study=shim.study,
               shim=shim, summary=summary, moves=move_table(shim), stop=STOPS[shim.stop],
               reference=reference_text(shim.model), conflict=update.prior_conflict
               > update.conflict_limit, rows=text_table(before=shim.before, after=shim.after))


def _moves(shim: Shim) -> Figure:
    """In one ring as the cross-section, in several as rings and slots."""
    flat = shim.study.array.rings == 1
    figure = Figure(figsize=(6, 6) if flat else (9, 4.6), layout="constrained")
    axis = figure.subplots()
    if flat:
        draw_magnet(axis, shim.magnet)
        where = 1e3 * np.array([block.middle[:2] for block in shim.magnet.blocks])
        axis.set(aspect="equal", xlabel="x in mm", ylabel="y in mm")
    else:
        where = np.array(shim.mounts.places, float)
        axis.plot(*where.T, ".", color="#cccccc", ms=3)
        axis.set(xlabel="ring", ylabel="slot")
        for numbers in (axis.xaxis, axis.yaxis):
            numbers.set_major_locator(MaxNLocator(integer=True))
    for number, step in enumerate(shim.steps, start=1):
        _draw(axis, where[[one.to for one in step.move.placements]], step, str(number))
    return figure


def _draw(axis: Axes, ends: Floats, step: Step, label: str) -> None:
    kind = step.move.kind
    if kind == "swap":
        axis.plot(*ends.T, "-o", color=POSTERIOR, lw=1.2, ms=5)
    else:
        axis.plot(*ends.T, "o" if kind == "turn" else "s", mfc="none", ms=11, mew=1.8,
                  color=SECOND if kind == "turn" else PUBLISHED)
    for end in ends:
        axis.annotate(label, end, xytext=(6, 6), textcoords="offset points", fontsize="small",
                      fontweight="bold")


def _gain(shim: Shim) -> Figure:
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    axis = figure.subplots()
    size = len(shim.before.orders)
    squares = [one.expected_square for one in (shim.before, *(step.after for step in shim.steps))]
    axis.plot(np.sqrt(np.array(squares) / size), "-o", color=POSTERIOR)
    axis.set(xlabel="moves", ylabel="rms of |c$_n$| in units", ylim=(0, None))
    axis.set_xticks(range(len(squares)))
    axis.grid(alpha=0.3)
    return figure
