"""Figures, table and page of the assignment of measured blocks to slots."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.files import write_text
from halbach_fe.design.sorting import SortedBlocks
from halbach_fe.measurement.block_table import write_blocks
from halbach_fe.report.multipoles import multipole_figure, reference_summary, reference_text
from halbach_fe.report.page import POSTERIOR, PRIOR, PUBLISHED, own_style, save, write_page
from halbach_fe.response.multipoles import Multipoles, plain, text_table

QUANTILES = (0.01, 0.5, 0.99)
"""Quantiles of the rms of random orders that sort.json states."""


def sort_summary(found: SortedBlocks, limit: float | None) -> dict[str, object]:
    """Return the content of sort.json; the rms values are of the |c_n| of the mean."""
    unit = found.model.unit
    return {
        "study": found.study.name, "reference": reference_summary(found.model, limit),
        "blocks": len(found.table), "left_over": found.left_over,
        "table_order": found.own_order,
        "sorted": plain(found.best, unit), "unsorted": plain(found.numbered, unit),
        "rms_sorted_units": _rms(found.best), "rms_unsorted_units": _rms(found.numbered),
        "random_orders": len(found.random),
        "rms_random_units": dict(zip(map(str, QUANTILES), np.quantile(
            found.random, QUANTILES).tolist(), strict=True)),
        "best_random_units": float(found.random.min()),
    }


def order_table(found: SortedBlocks) -> list[dict[str, str]]:
    """Return the rows of the table of multipoles, as text."""
    return text_table(**{found.own_order: found.numbered, "sorted": found.best})


@own_style
def write_sorted(found: SortedBlocks, limit: float | None, folder: Path) -> None:
    """Write blocks.sorted.csv, sort.json, sort.html and its figures."""
    write_blocks(found.table, folder / "blocks.sorted.csv")
    summary = sort_summary(found, limit)
    write_text(folder / "sort.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    pictures = save({
        "sort_multipoles.png": (
            multipole_figure({found.own_order: found.numbered, "sorted": found.best}, limit),
            "Unwanted multipoles of the blocks in the order of the table and of the sorted blocks, "
            "normal (left) and skew (right); bars are two standard deviations"),
        "sort_orders.png": (
            _random_orders_figure(found), "Histogram of the root mean square of the unwanted "
            f"multipoles for {len(found.random)} random orders of the blocks; the lines are the "
            "order of the table and the sorted blocks"),
    }, folder)
    write_page(folder / "sort.html", "sort.html.j2", pictures, found=found, study=found.study,
               summary=summary, reference=reference_text(found.model), rows=order_table(found),
               spread=float(np.sqrt(np.sum(found.best.root**2) / len(found.best.orders))))


def _rms(known: Multipoles) -> float:
    """Return the rms of the |c_n| of the mean, in units."""
    return float(np.sqrt(np.mean(known.sizes**2)))


def _random_orders_figure(found: SortedBlocks) -> Figure:
    """Draw the histogram of the rms of random orders."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    axis.hist(found.random, 50, color=PUBLISHED, label="random orders")
    axis.axvline(_rms(found.numbered), color=PRIOR, lw=2, ls="--", label=found.own_order)
    axis.axvline(_rms(found.best), color=POSTERIOR, lw=2, label="sorted")
    axis.set(xlabel="rms of |c$_n$| in units", ylabel="random orders", xlim=(0, None))
    axis.legend()
    return figure
