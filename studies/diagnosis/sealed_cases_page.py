"""Page on the diagnosis of sealed cases: effects that were hidden in simulated campaigns.

It compares the hidden effects with the identified ones, stated probabilities with frequencies, and
the fit of held-out readings before and after.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from halbach_fe.core.numbers import EMPTY_CELL
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SMALL,
    Page,
    Section,
    Table,
    Text,
    figure_of,
    legend_above,
)
from halbach_fe.report.words import counted, fraction
from halbach_fe.study.model import Study

Confusion = Mapping[tuple[str, tuple[str, ...]], int]
"""Number of cases by the effect that was hidden alone, and by the names of an identified effect and
its alternatives."""

RATES = {
    "hidden alone, and named": ("naming_rate_single", "single_cases"),
    "both of a pair named": ("naming_rate_pairs", "pair_cases"),
    "clean campaigns with a false name": ("false_alarm_rate", "clean_cases"),
    "causes outside the catalogue noticed": ("unknown_rate", "outside_cases"),
    "held-out readings explained afterwards": ("heldout_recovered_rate", "recovered_of"),
    "wrong names beside a yes": ("yes_beside_wrong", "cases"),
    "rolls, centres and slopes within 95 % error bars": ("axis_coverage", "axis_numbers"),
    "control: named with shuffled labels": ("control_naming_rate_shuffled_labels", ""),
    "control: false alarms without tolerances of the blocks":
        ("control_false_alarm_rate_without_blocks", "")}
"""Rates in words, with their own names and those of the numbers of cases."""

LEAST_SHUFFLED, LEAST_ALARMS = 0.2, 0.5
"""A scoring that calls more shuffled labels right, and cases that alarm a detector without
tolerances less often, can tell nothing."""

WANTED, FALSE = 0.9, 0.1
"""Least share of effects that a diagnosis must name to be used, and most false names."""


def answer(rates: Mapping[str, float]) -> Answer:
    """Say how often hidden effects were named, how sure that is, and whether the controls fail."""
    def share(name: str) -> str:
        rate, cases = (rates[key] for key in RATES[name])
        if not cases:
            return "none tried"
        low, high = (stats.binomtest(round(rate * cases), round(cases))
                     .proportion_ci(method="exact"))
        return (f"{fraction(rate)} of {cases:.0f} (95 % interval {fraction(low)} to "
                f"{fraction(high)})")

    shuffled, alarms = (rates[RATES[name][0]] for name in list(RATES)[-2:])
    untried = [name for name, rate in (("shuffled labels", shuffled), (
        "a detector without tolerances of the blocks", alarms)) if np.isnan(rate)]
    fooled = shuffled > LEAST_SHUFFLED or alarms < LEAST_ALARMS
    trust = ("No: a control that must fail does not." if fooled else
             f"Not wholly: too few cases to try {' and '.join(untried)}, which must fail."
             if untried else
             f"Yes: shuffled labels count as named in {fraction(shuffled)} of the cases, and a "
             f"detector that takes the blocks for perfect raises {fraction(alarms)} false alarms, "
             "as these controls must.")
    good = (not rates["naming_rate_single"] < WANTED and not rates["false_alarm_rate"] > FALSE)
    return Answer(
        "Does the diagnosis find what is hidden, and only that?",
        f"Of the effects that were hidden alone and can be detected at all it names "
        f"{share('hidden alone, and named')}; it names something false in "
        f"{share('clean campaigns with a false name')} clean campaigns.",
        f"{trust} The fields are those of other programs than the one that explains them.",
        "Diagnose a map of your own.", "halbach-fe diagnose STUDY --measurements MAP -o DIR",
        sound=good and not fooled and not untried)


def rate_rows(rates: Mapping[str, float]) -> list[dict[str, str]]:
    """Return a row of text for each rate."""
    return [{"what": what,
             "share": EMPTY_CELL if np.isnan(rates[rate]) else fraction(rates[rate]),
             "of cases": f"{rates[cases]:.0f}" if cases else EMPTY_CELL}
            for what, (rate, cases) in RATES.items()]


def title_of_hidden(name: str) -> str:
    """Return an effect in words, with the sensor if it is of one: gain_x is one of Bx."""
    for effect in catalogue():
        if effect.name == name:
            return effect.title
        if effect.name[:-2] == name:
            return re.sub("the B[xyz] sensor", "a sensor", effect.title)
    return name.replace("_", " ")


def page(
    study: Study, results: Sequence[Mapping[str, Any]], rates: Mapping[str, float],
    reliability: Sequence[Mapping[str, float]], naming: Sequence[Mapping[str, float]],
    confusion: Confusion,
) -> Page:
    """Return the page of sealed cases, whose rates and bins are in summary.json.

    Parameters
    ----------
    results : sequence of mapping
        Result of each case, with the keys hidden, outside, named, unknown, chi2_before and
        chi2_after.
    rates : mapping
        Success rates by name.
    reliability : sequence of mapping
        Bins of stated probabilities: mean stated probability (stated), frequency of the effects
        (happened), and number of statements (statements).
    naming : sequence of mapping
        The same of the likeliest effect of each case only.
    confusion : mapping
        See `Confusion`.
    """
    rows = [{
        "hidden": " and ".join(map(title_of_hidden, case["hidden"])) or (
            f"outside the catalogue: {case['outside']}" if case["outside"] else "nothing"),
        "named": "; ".join(" or ".join(map(title_of_hidden, names)) for names in case["named"])
        or ("something unknown" if case["unknown"] else "nothing"),
        "chi² before": f"{case['chi2_before']:.3g}", "after": f"{case['chi2_after']:.3g}"}
        for case in results]
    title = "is what is hidden found, and only that?"
    return Page("sealed-cases", title, study, answer(rates), {}, [
        Section([Table(rate_rows(rates), "numbers"), Text(
            f"{counted(len(results), 'simulated campaign')} of magnets and maps that were drawn: "
            "fields by magpylib and NGSolve, never by the model that explains them. A case counts "
            "as detectable if the hidden effect's own log Bayes factor is above 5; effects that a "
            "map cannot tell apart count as one. The two controls must fail: labels that are "
            "shuffled, and a detector that does not integrate the blocks out.", "small")]),
        Section([Table(rows)], "Every case")], rows=rows, figures={
        "confusion.png": (
            partial(_confusion, confusion), "Number of cases by the effect that was hidden alone "
            "and by the effect that was identified. Effects that a map cannot distinguish count as "
            "one"),
        "reliability.png": (
            partial(_reliability, {"every effect": reliability, "the likeliest effect": naming}),
            "How often effects were present, against the probability that was stated: every effect "
            "of every case, and the likeliest one of each case. Bars are binomial 95 % intervals. "
            "The expected calibration error is the mean distance of the points on the right from "
            "the line, weighted with their numbers of statements"),
        "gap.png": (
            partial(_gap, results), "Chi² per held-out reading of every case, before and after the "
            "diagnosis; the band is 0.9 to 1.1")}, stored=False)


def _confusion(confusion: Confusion) -> Figure:
    """Draw the number of cases for each hidden effect and each name that was given to it."""
    if not confusion:
        return Figure()
    hidden = sorted({truth for truth, _ in confusion})
    called = [next((name for name in names if name == truth or name[:-2] == truth), names[0])
              for truth, names in confusion]
    bases = [name[:-2] if name[:-2] in hidden else name for name in called]
    columns = [*(name for name in hidden if name in bases),
               *sorted(set(bases) - set(hidden))]
    counts = np.zeros((len(hidden), len(columns)))
    for ((truth, _), count), base in zip(confusion.items(), bases, strict=True):
        counts[hidden.index(truth), columns.index(base)] += count
    figure = Figure(figsize=(4.5 + 0.22 * len(columns), 3.5 + 0.2 * len(hidden)),
                    layout="constrained")
    axis = figure.subplots()
    axis.imshow(np.where(counts, counts, np.nan), cmap="Blues", vmin=0, vmax=counts.max())
    for row, column in np.argwhere(counts):
        axis.text(column, row, f"{counts[row, column]:.0f}", ha="center", va="center",
                  fontsize=SMALL,
                  color="white" if counts[row, column] > counts.max() / 2 else "black")
    axis.set(xlabel="identified", ylabel="hidden")
    axis.set_xticks(range(len(columns)), map(title_of_hidden, columns), rotation=90, fontsize=SMALL)
    axis.set_yticks(range(len(hidden)), map(title_of_hidden, hidden), fontsize=SMALL)
    return figure


def _reliability(kinds: Mapping[str, Sequence[Mapping[str, float]]]) -> Figure:
    """Draw stated probability against frequency, with the binomial 95 % interval, side by side."""
    figure = figure_of(4.4, 4.6 * len(kinds))
    for axis, (kind, rows) in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds.items(),
                                  strict=True):
        stated = np.array([row["stated"] for row in rows])
        counts = np.array([row["statements"] for row in rows])
        spread = 1.96 * np.sqrt(stated * (1 - stated) / np.maximum(counts, 1))
        axis.plot([0, 1], [0, 1], color=PUBLISHED)
        axis.errorbar(stated, stated, np.vstack([np.minimum(spread, stated),
                                                 np.minimum(spread, 1 - stated)]),
                      fmt="none", ecolor=PUBLISHED, capsize=3)
        axis.plot(stated, [row["happened"] for row in rows], "o", color=POSTERIOR)
        for row in rows:
            axis.annotate(f"{row['statements']:.0f}", (row["stated"], row["happened"]),
                          textcoords="offset points", xytext=(6, -10), fontsize=SMALL)
        axis.set(title=kind, xlabel="probability stated", ylabel="frequency", xlim=(-0.03, 1.06),
                 ylim=(-0.06, 1.06))
    return figure


def _gap(results: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw chi-squared of held-out readings before and after, with cases sorted by the former."""
    figure = figure_of(3.6)
    axis = figure.subplots()
    ordered = sorted(results, key=lambda case: case["chi2_before"])
    axis.axhspan(0.9, 1.1, color=PUBLISHED, alpha=0.4, lw=0)
    axis.semilogy([case["chi2_before"] for case in ordered], ".", color=PRIOR, label="before")
    axis.semilogy([case["chi2_after"] for case in ordered], ".", color=POSTERIOR, label="after")
    axis.set(xlabel="case", ylabel="chi² per held-out reading")
    legend_above(figure, axis)
    return figure
