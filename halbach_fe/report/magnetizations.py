"""Figure and page of magnetizations that are known, beside what was inferred of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.blocks import Floats
from halbach_fe.report.page import MEASURED, POSTERIOR, PRIOR, save, write_page
from halbach_fe.study import COMPONENTS
from halbach_fe.update import Update


def write_magnetizations(
    update: Update, truth: Floats, folder: Path, figures: Mapping[str, object], what: str,
    ring: int = 1,
) -> None:
    """Write magnetizations.html and magnetizations.png of a ring, truth (parameters,) in A/m."""
    pictures = save({"magnetizations.png": (
        _figure(update, truth, ring), f"Deviation of the magnetizations of ring {ring} from "
        "nominal: truth, prior and posterior with their standard deviations")}, folder)
    rows = []
    for name, one in (("prior", update.prior), ("posterior", update.posterior)):
        error = one.mean - truth
        rows.append((name, float(np.abs(error).max()), float(np.sqrt(np.mean(error**2))),
                     float(np.sqrt(np.mean((error / one.sd) ** 2)))))
    write_page(folder / "magnetizations.html", "magnetizations.html.j2", pictures,
               study=update.study, rows=rows, figures=figures, what=what)


def _figure(update: Update, truth: Floats, ring: int) -> Figure:
    size = update.study.dimension
    slots = update.study.array.blocks_per_ring
    part = slice((ring - 1) * slots * size, ring * slots * size)
    nominal = update.response.nominal[part]
    figure = Figure(figsize=(8, 1 + 2.4 * size), layout="constrained")
    axes = figure.subplots(size, 1, sharex=True)
    places = np.arange(1, slots + 1)
    for axis, component in zip(axes, range(size), strict=True):
        def of(values: Floats, component: int = component) -> Floats:
            return np.asarray(1e-3 * values[component::size])

        for name, one, colour, shift in (("prior", update.prior, PRIOR, -0.15),
                                         ("posterior", update.posterior, POSTERIOR, 0.15)):
            axis.errorbar(places + shift, of(one.mean[part] - nominal), of(one.sd[part]),
                          color=colour, fmt="o", ms=4, capsize=2, label=name)
        axis.plot(places, of(truth[part] - nominal), "_", color=MEASURED, ms=14, mew=2,
                  label="truth", zorder=3)
        axis.set_ylabel(f"ΔM{COMPONENTS[component]} in kA/m")
        axis.grid(alpha=0.3)
    axes[0].legend(ncols=3, fontsize="small")
    axes[-1].set_xlabel("slot")
    axes[-1].set_xticks(places)
    return figure
