"""Figures, table and page of a measurement plan."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.design.measurement_plan import MeasurementPlan
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.report.page import POSTERIOR, PRIOR, PUBLISHED, draw_magnet, save, write_page


def plan_summary(plan: MeasurementPlan) -> dict[str, object]:
    """What a script wants to know of a plan; information in nats, lengths in A/m."""
    return {
        "points": len(plan.points), "candidates": len(plan.candidates),
        "information": float(plan.gain[-1]),
        "study_points": len(plan.baseline),
        "study_information": float(plan.baseline_gain[-1]),
        "points_with_the_study_information": plan.same_information,
        "mean_sd_over_study_with_as_many_points": plan.volume_ratio,
        "rms_sd_prior": _rms(plan.prior_sd), "rms_sd_plan": _rms(plan.planned_sd),
        "rms_sd_study_with_as_many_points": _rms(plan.baseline_sd),
    }


def write_plan(magnet: Magnet, plan: MeasurementPlan, folder: Path) -> None:
    """Write plan.csv, plan.json, plan.html and its figures."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["order", "x_m", "y_m", "z_m", "information_nats"])
    writer.writerows([number, *point, gain] for number, (point, gain) in enumerate(
        zip(plan.points.tolist(), plan.gain.tolist(), strict=True), start=1))
    write_text(folder / "plan.csv", table.getvalue())
    summary = plan_summary(plan)
    write_text(folder / "plan.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    pictures = save({
        "plan_positions.png": (_positions(magnet, plan), "Candidates, chosen positions coloured by "
                               "their order, and the study's own positions as rings"),
        "plan_information.png": (_information(plan), "Expected information against the number of "
                                 "points, for the plan and for as many of the study's positions"),
        "plan_blocks.png": (_blocks(magnet, plan),
                            "Standard deviation of the blocks' magnetizations"
                            " after the measurement over that before, by slot, for the plan and "
                            "for as many of the study's positions"),
    }, folder)
    write_page(folder / "plan.html", "plan.html.j2", pictures, study=magnet.study, plan=plan,
               summary=summary)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _positions(magnet: Magnet, plan: MeasurementPlan) -> Figure:
    flat = np.ptp(plan.candidates[:, 2]) == 0
    figure = Figure(figsize=(6.4, 5.2) if flat else (10, 5.2), layout="constrained")
    left, *others = figure.subplots(1, 1 if flat else 2, squeeze=False)[0]
    draw_magnet(left, magnet)
    shown = _show(left, plan, lambda points: 1e3 * points[:, :2])
    reach = 1.15e3 * float(np.hypot(*np.vstack([plan.candidates, plan.baseline])[:, :2].T).max())
    left.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="x in mm",
             ylabel="y in mm")
    for axis in others:
        shown = _show(axis, plan, lambda points: np.column_stack(
            [points[:, 2], np.degrees(np.arctan2(points[:, 1], points[:, 0]))]))
        axis.set(xlabel="z in m", ylabel="angle in degrees")
    figure.colorbar(shown, label="order of choice", ax=[left, *others])
    return figure


def _show(axis: Axes, plan: MeasurementPlan, place: Callable[[Floats], Floats]) -> PathCollection:
    """Candidates, chosen and the study's points where ``place`` puts them."""
    axis.plot(*place(plan.candidates).T, ".", color="#cccccc", ms=2, label="candidates")
    x, y = place(plan.points).T
    shown = axis.scatter(x, y, 28, np.arange(1, len(x) + 1), cmap="viridis", label="chosen",
                         zorder=3)
    axis.plot(*place(plan.baseline).T, "o", mfc="none", color=PRIOR, ms=7, mew=0.8, label="study")
    axis.legend(loc="upper right", fontsize="small")
    return shown


def _information(plan: MeasurementPlan) -> Figure:
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    axis.plot(range(1, len(plan.gain) + 1), plan.gain, color=POSTERIOR, label="plan")
    axis.plot(plan.baseline_counts, plan.baseline_gain, color=PRIOR,
              label="positions of the study")
    axis.axhline(plan.baseline_gain[-1], color=PUBLISHED, lw=0.8, ls=":")
    axis.set(xlabel="points", ylabel="expected information in nats", xlim=(0, None), ylim=(0, None))
    axis.grid(alpha=0.3)
    axis.legend()
    return figure


def _blocks(magnet: Magnet, plan: MeasurementPlan) -> Figure:
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    slots = np.array([block.slot for block in magnet.blocks])
    places = np.arange(1, magnet.array.blocks_per_ring + 1)

    def by_slot(sd: Floats) -> Floats:
        variance = (sd**2).reshape(len(slots), -1).sum(axis=1)
        return np.sqrt([variance[slots == place].mean() for place in places])

    before = by_slot(plan.prior_sd)
    for name, sd, colour, shift in (("plan", plan.planned_sd, POSTERIOR, -0.2),
                                    ("positions of the study", plan.baseline_sd, PRIOR, 0.2)):
        axis.bar(places + shift, by_slot(sd) / before, 0.4, color=colour, label=name)
    axis.set(xlabel="slot", ylabel="sd after / sd before", ylim=(0, 1))
    axis.set_xticks(places[::max(1, len(places) // 16)])
    axis.legend()
    return figure
