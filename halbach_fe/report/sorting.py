"""Figures, table and page of blocks sorted into slots."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.files import write_text
from halbach_fe.design.sorting import Sorted
from halbach_fe.measurement.block_table import write_blocks
from halbach_fe.report.multipoles import multipole_figure, reference_summary, reference_text
from halbach_fe.report.page import POSTERIOR, PRIOR, PUBLISHED, save, write_page
from halbach_fe.response.multipoles import Multipoles, plain, text_table

QUANTILES = (0.01, 0.5, 0.99)


def sort_summary(found: Sorted, limit: float | None) -> dict[str, object]:
    """What a script wants to know of a sorted table; root mean squares are of the mean |c_n|."""
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


def order_table(found: Sorted) -> list[dict[str, str]]:
    """Rows of text, one per order."""
    return text_table(**{found.own_order: found.numbered, "sorted": found.best})


def write_sorted(found: Sorted, limit: float | None, folder: Path) -> None:
    """Write blocks.sorted.csv, sort.json, sort.html and its figures."""
    write_blocks(found.table, folder / "blocks.sorted.csv")
    summary = sort_summary(found, limit)
    write_text(folder / "sort.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    pictures = save({
        "sort_multipoles.png": (
            multipole_figure({found.own_order: found.numbered, "sorted": found.best}, limit),
            "Unwanted multipoles of the table's own order and of the sorted blocks, normal on the "
            "left and skew on the right; bars are two standard deviations"),
        "sort_orders.png": (_histogram(found), "Root mean square of the mean unwanted multipoles "
                            f"of {len(found.random)} random orders, of the table's own order and "
                            "of the sorted blocks"),
    }, folder)
    write_page(folder / "sort.html", "sort.html.j2", pictures, found=found, study=found.study,
               summary=summary, reference=reference_text(found.model), rows=order_table(found),
               spread=float(np.sqrt(np.sum(found.best.root**2) / len(found.best.orders))))


def _rms(known: Multipoles) -> float:
    return float(np.sqrt(np.mean(known.sizes**2)))


def _histogram(found: Sorted) -> Figure:
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    axis.hist(found.random, 50, color=PUBLISHED, label="random orders")
    axis.axvline(_rms(found.numbered), color=PRIOR, lw=2, ls="--", label=found.own_order)
    axis.axvline(_rms(found.best), color=POSTERIOR, lw=2, label="sorted")
    axis.set(xlabel="rms of |c$_n$| in units", ylabel="orders", xlim=(0, None))
    axis.legend()
    return figure
