"""The page of a simulation-based calibration, with its rank histograms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Ints
from halbach_fe.report.page import POSTERIOR, PUBLISHED, own_style, save, write_page
from halbach_fe.stats.sbc import BINS


@own_style
def write_calibration(
    ranks: Mapping[str, Ints], draws: int, results: Mapping[str, Mapping[str, object]],
    folder: Path,
) -> None:
    """Write calibration.html and ranks.png.

    Parameters
    ----------
    ranks : mapping
        For each kind of posterior, the ranks of the true parameters among the posterior draws,
        shape (repeats, parameters).
    draws : int
        Number of posterior draws per repeat.
    results : mapping
        Rows of the page's table by kind of posterior.
    folder : Path
    """
    figure = Figure(figsize=(3.6 * len(ranks), 3.2), layout="constrained")
    for axis, (name, case_ranks) in zip(figure.subplots(1, len(ranks), squeeze=False)[0],
                                   ranks.items(), strict=True):
        edges = np.linspace(0, draws + 1, BINS + 1)
        axis.hist(case_ranks.ravel(), edges, density=True, color=POSTERIOR)
        axis.axhline(1 / (draws + 1), color=PUBLISHED)
        axis.set(title=name, xlabel="rank of the true value", yticks=[])
        axis.title.set_fontsize(9)
    pictures = save({"ranks.png": (figure, "Ranks of the true parameters among draws of the "
                                   "posterior, all parameters together; a calibrated posterior "
                                   "gives the horizontal line")},
                    folder)
    write_page(folder / "calibration.html", "calibration.html.j2", pictures, results=results)
