"""Figure and page of magnetizations that are known, beside what was inferred of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.report.page import MEASURED, POSTERIOR, PRIOR, SECOND, save, write_page
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.types import COMPONENTS


def scores(one: Gaussian, truth: Floats) -> dict[str, float]:
    """Errors of a distribution's mean, in A/m, and rms of error over standard deviation."""
    error = one.mean - truth
    return {"largest_error_A_per_m": float(np.abs(error).max()),
            "rms_error_A_per_m": float(np.sqrt(np.mean(error**2))),
            "z_rms": float(np.sqrt(np.mean((error / one.sd) ** 2)))}


def write_magnetizations(
    magnet: Magnet, known: Mapping[str, Gaussian], truth: Floats, folder: Path, what: str,
    files: str, figures: Mapping[str, object] | None = None, ring: int = 1,
) -> None:
    """Write magnetizations.html, and magnetizations.png of a ring.

    Parameters
    ----------
    known : mapping
        Distributions of the magnetizations in A/m by name, the first (the prior) in orange.
    truth : ndarray, shape (parameters,), in A/m
    what : str
        The page's title.
    files : str
        What stands beside the page for machines.
    figures : mapping, optional
        Other numbers to list.
    ring : int
        Whose magnetizations are drawn.
    """
    pictures = save({"magnetizations.png": (
        _figure(magnet, known, truth, ring), f"Deviation of the magnetizations of ring {ring} from "
        f"nominal: truth, {', '.join(known)}, with their standard deviations")}, folder)
    rows = [(name, *scores(one, truth).values()) for name, one in known.items()]
    write_page(folder / "magnetizations.html", "magnetizations.html.j2", pictures,
               study=magnet.study, rows=rows, figures=figures or {}, what=what, machine_files=files)


def _figure(magnet: Magnet, known: Mapping[str, Gaussian], truth: Floats, ring: int) -> Figure:
    size = magnet.dimension
    slots = magnet.array.blocks_per_ring
    part = slice((ring - 1) * slots * size, ring * slots * size)
    blocks = magnet.blocks[(ring - 1) * slots:ring * slots]
    nominal = np.concatenate([block.magnetization[:size] for block in blocks])
    figure = Figure(figsize=(8, 1 + 2.4 * size), layout="constrained")
    axes = figure.subplots(size, 1, sharex=True)
    places = np.arange(1, slots + 1)
    shifts = 0.3 * np.linspace(-0.5, 0.5, len(known))
    for axis, component in zip(axes, range(size), strict=True):
        def of(values: Floats, component: int = component) -> Floats:
            return np.asarray(1e-3 * values[component::size])

        for (name, one), colour, shift in zip(known.items(), (PRIOR, POSTERIOR, SECOND), shifts,
                                              strict=False):
            axis.errorbar(places + shift, of(one.mean[part] - nominal), of(one.sd[part]),
                          color=colour, fmt="o", ms=4, capsize=2, label=name)
        axis.plot(places, of(truth[part] - nominal), "_", color=MEASURED, ms=14, mew=2,
                  label="truth", zorder=3)
        axis.set_ylabel(f"ΔM{COMPONENTS[component]} in kA/m")
        axis.grid(alpha=0.3)
    axes[0].legend(ncols=4, fontsize="small")
    axes[-1].set_xlabel("slot")
    axes[-1].set_xticks(places)
    return figure
