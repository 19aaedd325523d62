"""Page of `plan`: figures and table of a measurement plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats, azimuths_of, rms
from halbach_fe.design.measurement_plan import MeasurementPlan
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    chart,
    columns_by_axis,
    csv_file,
    figure_of,
    label_logarithmic,
    legend_above,
    linearized,
)
from halbach_fe.report.point_maps import draw_cross_section
from halbach_fe.report.words import counted, fraction, ppm
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

NEARLY = 1.2
"""Uncertainty relative to that of all positions at which fewer of them nearly suffice."""


def plan_summary(plan: MeasurementPlan) -> Plain:
    """Return the content of plan.json: information in nats, standard deviations in A/m."""
    return {
        "points": len(plan.points), "candidates": len(plan.candidates),
        "information": float(plan.gain[-1]),
        "study_points": len(plan.baseline),
        "study_information": float(plan.baseline_gain[-1]),
        "points_with_the_study_information": plan.same_information,
        "mean_sd_over_study_with_as_many_points": plan.volume_ratio,
        "rms_sd_prior": rms(plan.prior_sd), "rms_sd_plan": rms(plan.planned_sd),
        "rms_sd_study_with_as_many_points": rms(plan.baseline_sd),
        **_deviation_summary(plan),
    }


def _deviation_summary(plan: MeasurementPlan) -> Plain:
    """Return what is left unknown of the deviation of |B| as entries of plan.json."""
    if plan.deviation is None:
        return {}
    return {"region": asdict(plan.deviation.region),
            "deviation_sd_ppm": {"prior": plan.deviation.prior, "plan": plan.deviation.planned[-1],
                                 "study_with_as_many_points": _of_study(plan)}}


def _nearly(plan: MeasurementPlan) -> int:
    """Return how many positions leave at most `NEARLY` times the uncertainty of all of them.

    It is that of the deviation of |B|, or of all patterns of blocks in the geometric mean.
    """
    left = _pattern_sd(plan, plan.gain) if plan.deviation is None else plan.deviation.planned
    return int(np.argmax(left <= NEARLY * left[-1])) + 1


def _of_study(plan: MeasurementPlan) -> float:
    """Return the uncertainty in ppm that as many positions of the study leave."""
    assert plan.deviation is not None
    count = min(len(plan.points), len(plan.baseline))
    return float(plan.deviation.baseline[np.searchsorted(plan.baseline_counts, count)])


def answer(plan: MeasurementPlan) -> Answer:
    """Say how much the plan tells beside the study's positions, and what to do next."""
    study = plan.magnet.study
    said = [_which(plan), *(_left_of_patterns(plan) if plan.deviation is None
                            else [_left_of_deviation(plan)]), _beside_all_of_the_study(plan)]
    trust = [
        "Yes, as far as the study's prior and noise are right; what the readings will be makes no "
        "difference to these numbers. Positions that are chosen one after another, as these are, "
        "tell nearly as much as the best choice of all at once.",
        _left_out(study), linearized(study)]
    if _is_worse(plan):
        return Answer(
            "Where should the magnet be measured?", " ".join(filter(None, said)),
            "Only among these candidates: the study's own positions tell more.", "State "
            "plan.candidates that are nearer to the blocks, or leave them out: then those of the "
            "study are taken.", "halbach-fe plan STUDY -o DIR", sound=False)
    step = ("Measure in this order, as far as there is time, and update the blocks. (Set "
            "plan.points for a shorter plan, or plan.candidates for other places.)"
            if _has_all(plan) else "Measure there, and update the blocks."
            if plan.same_information else
            "Measure there, and update the blocks. Ask for more positions (--points) to learn as "
            "much as from all of the study's.")
    return Answer("Where should the magnet be measured?", " ".join(filter(None, said)),
                  " ".join(filter(None, trust)), step,
                  "halbach-fe infer STUDY --measurements MAP -o DIR")


def _has_all(plan: MeasurementPlan) -> bool:
    """Tell whether the plan has all candidates, which it then only orders."""
    return len(plan.points) == len(plan.candidates)


def _which(plan: MeasurementPlan) -> str:
    """Say which positions the plan has, and how many of them nearly suffice."""
    points, nearly = len(plan.points), _nearly(plan)
    if not _has_all(plan):
        return f"At the {counted(points, 'position')} of plan.csv."
    enough = "" if not 1 < nearly < points else (  # a single one only shows that none tells much
        f": the first {nearly} of {points} positions nearly suffice, as the uncertainty "
        f"{'of patterns of blocks ' if plan.deviation is None else ''}that they leave is at most "
        f"{NEARLY:g} times that of all")
    return (f"In the order of plan.csv{enough}. These are all the candidates"
            f"{', the positions of the study' if _is_the_study(plan) else ''}, and the plan only "
            "orders them.")


def _left_of_patterns(plan: MeasurementPlan) -> list[str]:
    """Say what the readings leave unknown of single blocks, and of patterns of blocks."""
    # Uncertainty relative to the prior's from which on the readings tell little of single blocks,
    # and relative to that of as many of the study's positions from which on a plan is hardly better
    vague, little = 0.7, 0.97
    left, of_study = _patterns(plan)
    blocks = rms(plan.planned_sd) / rms(plan.prior_sd)
    rest = ", so that these are better places" if _is_worse(plan) else ", about as far"
    beside = "" if _is_the_study(plan) else (
        f"; with as many of the study's own positions to {fraction(of_study)}"
        f"{'' if left < little * of_study else rest}")
    together, pattern = (
        ("What blocks that deviate together do to the field is known better: the",
         "such a pattern") if left < blocks else ("The", "patterns of blocks"))
    return [
        f"After {'all of ' if _has_all(plan) else ''}them the uncertainty of a block's "
        f"magnetization falls to {fraction(blocks)} of what it is before (rms over the blocks).",
        f"{together} uncertainty of {pattern}, by which the positions are chosen, falls to "
        f"{fraction(left)} (geometric mean){beside}.",
        "So such a map tells little of the single blocks, at whatever positions of these it is "
        "measured." if left > vague else "",
        "Measure the blocks before assembly, or the field nearer to them."
        if left > vague and not _is_worse(plan) else ""]


def _is_worse(plan: MeasurementPlan) -> bool:
    """Tell whether as many of the study's own positions tell clearly more than those chosen."""
    if plan.deviation is not None:
        return bool(plan.deviation.planned[-1] > NEARLY * _of_study(plan))
    left, of_study = _patterns(plan)
    return bool(left > NEARLY * of_study)


def _left_of_deviation(plan: MeasurementPlan) -> str:
    """Say what the readings leave unknown of the deviation of |B| in the study's region."""
    assert plan.deviation is not None
    beside = "" if _is_the_study(plan) else (
        f" (after as many of the study's positions to {ppm(_of_study(plan))})")
    return (f"The deviation of |B| from its mean at a point of {plan.deviation.region.text} is "
            f"known to {ppm(plan.deviation.prior)} ppm rms before, and to "
            f"{ppm(plan.deviation.planned[-1])} after {'all of ' if _has_all(plan) else ''}them"
            f"{beside}.")


def _beside_all_of_the_study(plan: MeasurementPlan) -> str:
    """Compare a choice of positions with all positions of the study; empty if it chose none."""
    if _has_all(plan):
        return ""
    if same := plan.same_information:
        return (f"{counted(same, 'position')} of the plan tell as much as all "
                f"{len(plan.baseline)} of the study.")
    of_all = (fraction(float(_pattern_sd(plan, plan.baseline_gain)[-1]))
              if plan.deviation is None else f"{ppm(plan.deviation.baseline[-1])} ppm rms")
    return (f"All {len(plan.baseline)} positions of the study together tell more than these "
            f"{len(plan.points)}: they leave {of_all}.")


def _left_out(study: Study) -> str:
    """Say what an update with such a map would not know or not use, though the plan counts it."""
    drift = "" if not study.instrument_sd.drift_T else (
        "The drift that [instrument_sd] leaves open is not in them, as it needs the order of the "
        "readings.")
    held_out = "" if study.inference.held_out is None else (
        "All readings count in them: an update leaves more, by what [inference.held_out] sets "
        "aside.")
    return " ".join(filter(None, (drift, held_out)))


def _of_the_stage(instrument: Instrument) -> str:
    """Say how a stage counts that is not in m, or along other axes than the magnet."""
    own, unit = instrument.position_axes, instrument.length_unit_m
    return "" if (own, unit) == (COMPONENTS, 1.0) else (
        f" The stage's own x, y and z are {', '.join(own)} of these, in units of {unit:g} m, as "
        "[instrument] of the study says.")


def page(plan: MeasurementPlan) -> Page:
    """Return the page of the positions to measure."""
    magnet, summary, rows = plan.magnet, plan_summary(plan), plan_table(plan)
    chosen, beside, count = chosen_table(plan), "plan" in rows[0], len(plan.parameters)
    what = ("the largest expected information about the "
            f"{count} components of the magnetizations" if plan.deviation is None else
            f"the largest fall of the sd of the deviation of |B| in {plan.deviation.region.text}")
    by_patterns = ("" if plan.deviation is not None else " The positions are chosen by the sd of "
                   "the patterns; that of a block is what you will know of each.")
    title = ("The plan beside the positions of the study (* with equally many positions)"
             if beside else "What the readings leave unknown")
    return Page("plan", "where to measure", magnet.study, answer(plan), summary, [
        Section([
            Table(rows, "numbers"),
            Text(f"{'* with equally many positions. ' * beside}Sd is the standard deviation after "
                 "the readings. A pattern is a combination of blocks that deviate together; of "
                 f"{count} components there are as many independent patterns, and readings tell "
                 f"much of some and little of others.{by_patterns}", "small"),
            Text(f"Chosen one after another from {len(plan.candidates)} candidates, for {what}. "
                 f"The prior sd of a component is {1e-3 * rms(plan.prior_sd):.3g} kA/m, that with "
                 f"the plan {1e-3 * rms(plan.planned_sd):.3g} kA/m (rms).", "small")]),
        Section([
            "In this order: if you stop early, what is measured tells most. plan.csv has them in "
            f"m, in the axes of the study.{_of_the_stage(magnet.study.instrument)}",
            Table(chosen, "numbers")],
            "The positions to measure", folded=len(chosen) > 30)],
        {title: rows},
        figures={
            "plan_positions.png": (
                partial(_positions_figure, magnet, plan), "Candidate positions, chosen positions "
                "coloured by the order of choice, and the study's own positions as rings"),
            "plan_information.png": (
                partial(_left_figure, plan), "Standard deviation of a pattern of blocks in per "
                "cent of the prior's, in the geometric mean over all patterns, against the number "
                "of positions, for the plan and for evenly spread positions of the study")
            if plan.deviation is None else (
                partial(_left_figure, plan), "Standard deviation of the deviation of |B| in "
                "the study's region against the number of positions, for the plan and for evenly "
                "spread positions of the study"),
            "plan_blocks.png": (
                partial(_block_sd_figure, magnet, plan), "Standard deviation of a block's "
                "magnetization in per cent of the prior's, by slot" + (
                    "" if _only_orders(plan) else ", for the plan and for equally many positions "
                    "of the study"))},
        files={"plan.csv": csv_file({
            "order": range(1, len(plan.points) + 1),
            **columns_by_axis("{}_m", plan.points),
            "information_nats": plan.gain}, {})})


def chosen_table(plan: MeasurementPlan) -> Rows:
    """Return rows of text with the chosen positions in mm, in the order of choice.

    The last column is what is left after a position and all before it.
    """
    left, title = ((100 * _pattern_sd(plan, plan.gain), "sd of a pattern in % of the prior's")
                   if plan.deviation is None
                   else (plan.deviation.planned, "sd of the deviation of |B| in ppm rms"))
    millimetres = (1e3 * plan.points).round(3) + 0.0  # without a sign where it is 0
    return [{"order": str(number), "x in mm": f"{x:.3f}", "y in mm": f"{y:.3f}",
             "z in mm": f"{z:.3f}", title: f"{after:.1f}" if plan.deviation is None else ppm(after)}
            for number, ((x, y, z), after) in enumerate(
                zip(millimetres.tolist(), left.tolist(), strict=True), start=1)]


def _pattern_sd(plan: MeasurementPlan, gain: Floats) -> Floats:
    """Return the sd of a pattern of blocks relative to the prior's, of information in nats.

    It is the geometric mean over all patterns, which are the principal axes of the posterior.
    """
    return np.asarray(np.exp(-gain / len(plan.parameters)))


def _patterns(plan: MeasurementPlan) -> Floats:
    """Return what plan, and as many of the study's positions, leave of the sd of patterns."""
    count = min(len(plan.points), len(plan.baseline))
    return _pattern_sd(plan, np.array([
        plan.gain[-1], plan.baseline_gain[np.searchsorted(plan.baseline_counts, count)]]))


def plan_table(plan: MeasurementPlan) -> Rows:
    """Return rows of text that compare the plan with the positions of the study.

    A plan that only orders these is not compared with itself.
    """
    prior, same = rms(plan.prior_sd), plan.same_information
    patterns = _patterns(plan)
    rows = [
        {"": "positions", "plan": str(len(plan.points)), "the study's": str(len(plan.baseline))},
        {"": "positions that tell as much as all of the study's",
         "plan": str(same) if same else str(len(plan.points)) if _is_the_study(plan)
         else f"more than {len(plan.points)}",
         "the study's": str(len(plan.baseline))},
        {"": "sd of a block's magnetization, relative to the prior's (rms over the blocks)*",
         "plan": fraction(rms(plan.planned_sd) / prior),
         "the study's": fraction(rms(plan.baseline_sd) / prior)},
        {"": "sd of a pattern of blocks, relative to the prior's (geometric mean over all "
         "patterns)*", "plan": fraction(patterns[0]), "the study's": fraction(patterns[1])},
        *([] if plan.deviation is None else [
            {"": "sd of the deviation of |B| in ppm rms*",
             "plan": ppm(plan.deviation.planned[-1]), "the study's": ppm(_of_study(plan))}])]
    if _only_orders(plan):
        rows = [{"": row[""].rstrip("*"), "at all positions": row["plan"]}
                for row in (rows[0], *rows[2:])]
    return rows


def _is_the_study(plan: MeasurementPlan) -> bool:
    """Tell whether the plan has all positions of the study, which then tell as much to rounding."""
    chosen, study = (set(map(tuple, points.round(9).tolist()))
                     for points in (plan.points, plan.baseline))
    return study <= chosen


def _only_orders(plan: MeasurementPlan) -> bool:
    """Tell whether the plan only orders the study's positions."""
    return _is_the_study(plan) and len(plan.points) == len(plan.baseline)


def _positions_figure(magnet: Magnet, plan: MeasurementPlan) -> Figure:
    """Draw all positions in the cross-section, and by z and angle if not in a single plane."""
    flat = np.ptp(plan.candidates[:, 2]) == 0
    figure = figure_of(5.2, 6.4) if flat else figure_of(4.2)
    left, *others = figure.subplots(1, 1 if flat else 2, squeeze=False)[0]
    draw_cross_section(left, magnet)
    shown = _draw_points(left, plan, lambda points: 1e3 * points[:, :2])
    reach = 1.15e3 * float(np.hypot(*np.vstack([plan.candidates, plan.baseline])[:, :2].T).max())
    reach = reach or 1.15e3 * magnet.bore_radius  # of positions on the axis alone
    left.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="x in mm",
             ylabel="y in mm")
    for axis in others:
        shown = _draw_points(axis, plan, lambda points: np.column_stack(
            [1e3 * points[:, 2], np.degrees(azimuths_of(points))]))
        axis.set(xlabel="z in mm", ylabel="angle in degrees")
    figure.colorbar(shown, label="order of choice", ax=[left, *others])
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def _draw_points(
    axis: Axes, plan: MeasurementPlan, place: Callable[[Floats], Floats]
) -> PathCollection:
    """Draw candidates, chosen positions and the study's positions.

    ``place`` maps positions (n, 3) in m to the coordinates (n, 2) of the figure.
    """
    axis.plot(*place(plan.candidates).T, ".", color="#cccccc", ms=2, label="candidates")
    x, y = place(plan.points).T
    shown = axis.scatter(x, y, 28, np.arange(1, len(x) + 1), cmap="viridis", label="chosen",
                         zorder=3)
    axis.plot(*place(plan.baseline).T, "o", mfc="none", color=PRIOR, ms=7, mew=0.8,
              label="positions of the study")
    return shown


def _left_figure(plan: MeasurementPlan) -> Figure:
    """Draw what is left unknown against the number of positions: of the deviation of |B|, or of all
    patterns of blocks in the geometric mean.
    """
    if plan.deviation is None:
        planned, study = (100 * _pattern_sd(plan, gain) for gain in (plan.gain, plan.baseline_gain))
        label = "sd of a pattern in % of the prior's"
    else:
        planned, study = plan.deviation.planned, plan.deviation.baseline
        label = "sd of the deviation of |B| in ppm rms"
    figure, axis = chart(4)
    axis.plot(range(1, len(planned) + 1), planned, color=POSTERIOR, label="plan")
    axis.plot(plan.baseline_counts, study, color=PRIOR,
              label="as many positions of the study, evenly spread")
    axis.axhline(study[-1], color=MEASURED, lw=1.2, ls=":",
                 label=f"all {len(plan.baseline)} positions of the study")
    axis.set(xlabel="positions", ylabel=label, xlim=(0, None), yscale="log")
    label_logarithmic(axis.yaxis)
    legend_above(figure, axis)
    return figure


def _block_sd_figure(magnet: Magnet, plan: MeasurementPlan) -> Figure:
    """Draw the ratio of posterior to prior standard deviations, by slot."""
    figure, axis = chart(4, grid=False)
    slots = np.array([block.slot for block in magnet.blocks])
    places = np.arange(1, max(magnet.blocks_by_ring) + 1)

    def by_slot(sd: Floats) -> Floats:
        """Return the rms over the blocks of each slot; NaN where all of them are missing."""
        uniform = sd[:len(slots) * magnet.dimension]  # not the variations inside blocks
        variance = (uniform**2).reshape(len(slots), -1).sum(axis=1)
        sums = np.array([variance[slots == place].sum() for place in places])
        return np.sqrt(np.where(sums > 0, sums, np.nan))

    before = by_slot(plan.prior_sd)
    bars = [("plan", plan.planned_sd, POSTERIOR, -0.2),
            ("positions of the study", plan.baseline_sd, PRIOR, 0.2)]
    if _only_orders(plan):
        bars = [("at all positions", plan.planned_sd, POSTERIOR, 0.0)]
    for name, sd, colour, shift in bars:
        axis.bar(places + shift, 100 * by_slot(sd) / before, 0.4, color=colour, label=name)
    axis.set(xlabel="slot", ylabel="sd of a block in % of the prior's", ylim=(0, None))
    axis.set_xticks(places[::max(1, len(places) // 16)])
    figure.legend(loc="outside upper center", ncols=2)
    return figure
