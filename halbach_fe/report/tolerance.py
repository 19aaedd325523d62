"""Figures, table and page of the multipoles that result from the tolerances of the blocks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.design.tolerance import QUANTILES, Tolerance
from halbach_fe.report.multipoles import reference_summary, reference_text
from halbach_fe.report.page import POSTERIOR, PRIOR, PUBLISHED, own_style, save, write_page
from halbach_fe.response.multipoles import plain


def tolerance_summary(found: Tolerance) -> dict[str, object]:
    """Return the content of tolerance.json."""
    shares = found.shares
    return {
        "study": found.study.name, "reference": reference_summary(found.model, found.limit),
        "draws": len(found.sizes), "closed_form": plain(found.known, found.model.unit),
        "main_quantiles": _by_quantile(np.quantile(found.main, QUANTILES)),
        "sizes": [{"n": order, "quantiles_units": _by_quantile(column),
                   "share_within_limit": None if shares is None else float(shares[i])}
                  for i, (order, column) in enumerate(zip(
                      found.model.orders, found.quantiles.T, strict=True))],
        "share_within_limit": found.share, "share_sd": found.share_sd,
    }


def _by_quantile(values: Floats) -> dict[str, float]:
    """Return values by the name of their quantile."""
    return dict(zip(map(str, QUANTILES), values.tolist(), strict=True))


def quantile_table(found: Tolerance) -> list[dict[str, str]]:
    """Return the rows of the table of multipoles, as text, one for each order n."""
    size, sd = len(found.model.orders), found.known.sd
    rows = []
    for i, order in enumerate(found.model.orders):
        row = {"n": str(order), "|c_n| of the mean": f"{found.known.sizes[i]:.3g}",
               "sd of b_n": f"{sd[i]:.3g}", "sd of a_n": f"{sd[size + i]:.3g}"}
        row |= {f"{100 * q:g} % below": f"{value:.3g}"
                for q, value in zip(QUANTILES, found.quantiles[:, i], strict=True)}
        if found.shares is not None:
            row["within the limit"] = f"{100 * found.shares[i]:.3g} %"
        rows.append(row)
    return rows


@own_style
def write_tolerance(found: Tolerance, folder: Path) -> None:
    """Write tolerance.json, tolerance.html and its figures."""
    summary = tolerance_summary(found)
    write_text(folder / "tolerance.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    pictures = save({
        "tolerance_sizes.png": (
            _size_quantiles_figure(found), "Unwanted multipoles |c_n| of the simulated magnets: "
            "median, with bars from the 5 % to the 95 % quantile"),
        "tolerance_largest.png": (
            _largest_multipole_figure(found), "Share of the simulated magnets whose largest "
            "unwanted multipole is below a limit"),
    }, folder)
    write_page(folder / "tolerance.html", "tolerance.html.j2", pictures, found=found,
               study=found.study, summary=summary, reference=reference_text(found.model),
               rows=quantile_table(found))


def _size_quantiles_figure(found: Tolerance) -> Figure:
    """Draw median and quantiles of |c_n| by order."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    place = np.arange(len(found.model.orders))
    low, middle, high = found.quantiles[:3]
    axis.errorbar(place, middle, [middle - low, high - middle], fmt="o", color=POSTERIOR, capsize=4)
    if found.limit is not None:
        axis.axhline(found.limit, color=PRIOR, ls="--", label="limit")
        axis.legend()
    axis.set_xticks(place, [f"c$_{{{order}}}$" for order in found.model.orders])
    axis.set(ylabel="|c$_n$| in units", ylim=(0, None))
    axis.grid(alpha=0.3)
    return figure


def _largest_multipole_figure(found: Tolerance) -> Figure:
    """Draw the distribution function of the largest |c_n|."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    largest = np.sort(found.sizes.max(axis=1))
    axis.plot(largest, np.arange(1, len(largest) + 1) / len(largest), color=POSTERIOR)
    if found.limit is not None:
        axis.axvline(found.limit, color=PRIOR, ls="--", label="limit")
        axis.legend(loc="lower right")
    axis.axhline(1, color=PUBLISHED, lw=0.8)
    axis.set(xlabel="limit of all |c$_n$| in units", ylabel="share of magnets", ylim=(0, 1.02),
             xlim=(0, None))
    axis.grid(alpha=0.3)
    return figure
