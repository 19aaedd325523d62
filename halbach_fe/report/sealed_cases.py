"""Page on the diagnosis of sealed cases: effects that were hidden in simulated campaigns.

It compares the hidden effects with the identified ones, stated probabilities with frequencies, and
the fit of held-out readings before and after.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.report.page import POSTERIOR, PRIOR, PUBLISHED, own_style, save, write_page
from halbach_fe.study.model import Study

Confusion = Mapping[tuple[str, tuple[str, ...]], int]
"""Number of cases by the effect that was hidden alone, and by the names of an identified effect and
its alternatives."""


@own_style
def write_sealed_cases(
    study: Study, results: Sequence[Mapping[str, Any]], rates: Mapping[str, float],
    reliability: Sequence[Mapping[str, float]], naming: Sequence[Mapping[str, float]],
    confusion: Confusion, folder: Path,
) -> None:
    """Write sealed_cases.html and its figures.

    Parameters
    ----------
    study : Study
    results : sequence of mapping
        Result of each case, with the keys case, named, unknown, chi2_before and chi2_after.
    rates : mapping
        Success rates by name.
    reliability : sequence of mapping
        Bins of stated probabilities: mean stated probability (stated), frequency of the effects
        (happened), and number of statements (statements).
    naming : sequence of mapping
        The same of the likeliest effect of each case only.
    confusion : mapping
        See `Confusion`.
    folder : Path
    """
    drawn = {
        "confusion.png": (
            _confusion(confusion), "Number of cases by the effect that was hidden alone and by the "
            "effect that was identified. Effects that a map cannot distinguish count as one"),
        "reliability.png": (
            _reliability({"every effect": reliability, "the likeliest effect": naming}),
            "How often effects were present, against the probability that was stated: every effect "
            "of every case, and the likeliest one of each case. Bars are binomial 95 % intervals. "
            "The expected calibration error is the mean distance of the points on the right from "
            "the line, weighted with their numbers of statements"),
        "gap.png": (
            _gap(results), "Chi² per held-out reading of every case, before and after the "
            "diagnosis; the band is 0.9 to 1.1")}
    write_page(folder / "sealed_cases.html", "sealed_cases.html.j2", save(drawn, folder),
               study=study, cases=len(results),
               rates=[{"figure": name.replace("_", " "), "value": f"{value:.3g}"}
                      for name, value in rates.items()],
               rows=[{"case": case["case"], "identified": ", ".join(
                   " or ".join(names) for names in case["named"]) or "nothing",
                   "unknown": case["unknown"] or "", "chi² before": f"{case['chi2_before']:.3g}",
                   "after": f"{case['chi2_after']:.3g}"} for case in results])


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
    figure = Figure(figsize=(3 + 0.22 * len(columns), 2.5 + 0.2 * len(hidden)),
                    layout="constrained")
    axis = figure.subplots()
    axis.imshow(np.where(counts, counts, np.nan), cmap="Blues", vmin=0, vmax=counts.max())
    for row, column in np.argwhere(counts):
        axis.text(column, row, f"{counts[row, column]:.0f}", ha="center", va="center", fontsize=7,
                  color="white" if counts[row, column] > counts.max() / 2 else "black")
    axis.set(xlabel="identified", ylabel="hidden")
    axis.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    axis.set_yticks(range(len(hidden)), hidden, fontsize=7)
    return figure


def _reliability(kinds: Mapping[str, Sequence[Mapping[str, float]]]) -> Figure:
    """Draw stated probability against frequency, with the binomial 95 % interval, side by side."""
    figure = Figure(figsize=(4.6 * len(kinds), 4.4), layout="constrained")
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
                          textcoords="offset points", xytext=(6, -10), fontsize=8)
        axis.set(title=kind, xlabel="probability stated", ylabel="frequency", xlim=(-0.03, 1.06),
                 ylim=(-0.06, 1.06))
    return figure


def _gap(results: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw chi-squared of held-out readings before and after, with cases sorted by the former."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    ordered = sorted(results, key=lambda case: case["chi2_before"])
    axis.axhspan(0.9, 1.1, color=PUBLISHED, alpha=0.4, lw=0)
    axis.semilogy([case["chi2_before"] for case in ordered], ".", color=PRIOR, label="before")
    axis.semilogy([case["chi2_after"] for case in ordered], ".", color=POSTERIOR, label="after")
    axis.set(xlabel="case", ylabel="chi² per held-out reading")
    axis.legend()
    return figure
