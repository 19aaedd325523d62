"""The page of a simulation-based calibration, with its rank histograms."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Ints
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import POSTERIOR, PUBLISHED, Page, Section, Table, Text, figure_of
from halbach_fe.report.words import counted, fraction, p_value

CONTROL = "control: "
"""Beginning of the name of a posterior that is wrong on purpose."""


def answer(results: Mapping[str, Mapping[str, Any]]) -> Answer:
    """Say whether the error bars of the posteriors hold, and whether the test can tell."""
    tested = {name: row for name, row in results.items() if not name.startswith(CONTROL)}
    controls = {name: row for name, row in results.items() if name.startswith(CONTROL)}
    off = [name for name, row in tested.items() if not row["as_expected"]]
    passed = [name.removeprefix(CONTROL) for name, row in controls.items()
              if not row["as_expected"]]
    shown = "; ".join(
        f"{name}: p = {p_value(row['p_value'])} of {counted(row['repeats'], 'magnet')}"
        for name, row in tested.items())
    said = ("Yes: the true magnetizations lie among the draws of the posterior as often as they "
            f"should ({shown})." if not off else "No: the true magnetizations do not lie among the "
            f"draws as they should for {' and '.join(off)} ({shown}).")
    trust = (f"Yes: {counted(len(controls), 'control')} with a wrong posterior had to fail the "
             "same test, and did. A smaller error may go unnoticed; more magnets sharpen "
             "the test." if not passed else "No: a wrong posterior passes the test as well "
             f"({'; '.join(passed)}), so that it can tell too little. Draw more magnets.")
    return Answer(
        "Are the error bars of the inferred magnetizations as wide as they should be?", said, trust,
        "Find out why before any error bar is believed." if off else
        "Update a magnet with its map.",
        "" if off else "halbach-fe infer STUDY --measurements MAP -o DIR", not off and not passed)


def page(
    ranks: Mapping[str, Ints], draws: int, results: Mapping[str, Mapping[str, Any]],
) -> Page:
    """Return the page of a calibration, whose calibration.json has the results.

    Parameters
    ----------
    ranks : mapping
        For each kind of posterior, the ranks of the true parameters among the posterior draws,
        shape (repeats, parameters).
    draws : int
        Number of posterior draws per repeat.
    results : mapping
        Rows of the page's table by kind of posterior.
    """
    rows = calibration_rows(results)
    return Page("calibration", "Simulation-based calibration", None, answer(results), results, [
        Section([Table(rows, "numbers"), Text(
            "True magnetizations are drawn from the prior. Their field is not that of the model "
            "that is tested: it is a closed form where the iron is linear, and that of a finer "
            "mesh where it saturates. The probe reads it with noise, at positions that are moved "
            "by the stated standard deviation. If the posterior is right, the rank of the true "
            "value among the posterior draws is uniformly distributed; p is the probability of "
            "ranks as uneven as these, over all parameters. The controls use wrong posteriors and "
            "must fail this test.", "small")])], rows=rows, figures={"ranks.png": (
        partial(_ranks_figure, ranks, draws), "Ranks of the true parameters among draws of the "
        "posterior, all parameters together; a calibrated posterior gives the horizontal line")})


def _ranks_figure(ranks: Mapping[str, Ints], draws: int) -> Figure:
    """Draw the histogram of the ranks for every kind of posterior."""
    bins = 10  # of each histogram, as of the test
    panels_in_a_row = 3  # more would be unreadable on a narrow screen
    columns = min(panels_in_a_row, len(ranks))
    rows = -(-len(ranks) // columns)
    figure = figure_of(2.8 * rows, 3.2 * columns)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(ranks):]:
        axis.remove()
    for axis, (name, case_ranks) in zip(axes, ranks.items(), strict=False):
        edges = np.linspace(0, draws + 1, bins + 1)
        axis.hist(case_ranks.ravel(), edges, density=True, color=POSTERIOR)
        axis.axhline(1 / (draws + 1), color=PUBLISHED)
        axis.set(title="\n".join(wrap(name, 28)), xlabel="rank of the true value", yticks=[])
        axis.title.set_fontsize(9)
    return figure


def calibration_rows(results: Mapping[str, Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return a row of text for each posterior."""
    return [{"posterior": name, "magnets": str(row["repeats"]),
             "model's stated error, of the noise": fraction(row["model_error_over_noise"]),
             "p-value": p_value(row["p_value"]),
             "as expected": "yes" if row["as_expected"] else "no"}
            for name, row in results.items()]
