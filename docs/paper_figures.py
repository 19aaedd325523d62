"""Draw figures 2, 3 and 4 of the paper with ours beside them, for the page "The paper's figures".

Theirs are the published tables under studies/; ours are results of `make study-linear-3d`,
`make study-nonlinear-2d` and `make demo`. A figure whose results are not there is left out::

    python docs/paper_figures.py [RESULTS] [FOLDER]      # default: results, docs/_static/paper
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.posterior_files import read_posterior
from halbach_fe.report.page import MEASURED, POSTERIOR, PRIOR, PUBLISHED, SECOND
from halbach_fe.study.reader import read_study

DOCS = Path(__file__).parent
STUDIES = DOCS.parent / "studies"
COLOURS = {"prior": PRIOR, "posterior from B": POSTERIOR, "posterior from Fourier": SECOND}
PUBLISHED_NAMES = dict(zip(COLOURS, ("prior", "posterior_B", "posterior_F"), strict=True))
RING = 5

Deviations = Mapping[str, tuple[Floats, Floats]]
"""Deviations from nominal and their standard deviations, in A/m, by what they are."""


def published(path: Path, rows: slice = slice(None)) -> tuple[Deviations, Floats]:
    """Return the paper's distributions of a component of the blocks, and its truth, in A/m."""
    table = np.genfromtxt(path, delimiter=",", names=True)[rows]
    found = {name: (table[f"{theirs}_mean_A_per_m"],
                    np.abs(table[f"{theirs}_edge_1_A_per_m"]
                           - table[f"{theirs}_edge_2_A_per_m"]) / 2)
             for name, theirs in PUBLISHED_NAMES.items()
             if f"{theirs}_mean_A_per_m" in (table.dtype.names or ())}
    return found, table["truth_A_per_m"]


def panel(axis: Axes, found: Deviations, truth: Floats) -> None:
    """Draw deviations of the blocks of a ring in kA/m."""
    slots = np.arange(1, len(truth) + 1)
    for shift, (name, (mean, sd)) in zip((-0.2, 0.0, 0.2), found.items(), strict=False):
        axis.errorbar(slots + shift, 1e-3 * mean, 1e-3 * sd, fmt="o", ms=3, capsize=2, lw=1,
                      color=COLOURS[name], label=name)
    axis.plot(slots, 1e-3 * truth, "_", color=MEASURED, ms=12, mew=2, label="truth", zorder=3)
    axis.grid(alpha=0.3)


def beside(panels: Mapping[str, list[tuple[Deviations, Floats]]]) -> Figure:
    """Draw a row for each component, with the paper's panel at the left of ours."""
    figure = Figure(figsize=(10, 2.6 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 2, sharex=True, sharey="row")
    for row, (component, pair) in zip(axes, panels.items(), strict=True):
        for axis, one in zip(row, pair, strict=True):
            panel(axis, *one)
        row[0].set_ylabel(f"Δ{component} in kA/m")
    for axis, title in zip(axes[0], ("the paper", "halbach-fe"), strict=True):
        axis.set_title(title)
        axis.legend(fontsize=7, ncols=2)
    for axis in axes[-1]:
        axis.set_xlabel("block")
    return figure


def figure_2(results: Path) -> Figure:
    """Draw ring 5 of the linear validation: its magnets are different draws from like priors."""
    magnet = build_magnet(read_study(STUDIES / "linear-3d" / "study.toml"))
    from_b, from_f = (read_posterior(magnet, results / "linear-3d" / reading / "posterior.h5")
                      for reading in "BF")
    nominal = magnet.nominal_magnetization
    truth = np.loadtxt(STUDIES / "linear-3d" / "truth.csv", delimiter=",", skiprows=1).ravel()
    ours = {"prior": from_b["prior"], "posterior from B": from_b["posterior"],
            "posterior from Fourier": from_f["posterior"]}
    first = 3 * sum(magnet.blocks_by_ring[:RING - 1])
    panels = {}
    for component, name in ((0, "Mx"), (2, "Mz")):
        part = slice(first + component, first + 3 * magnet.blocks_by_ring[RING - 1], 3)
        here = {what: (one.mean[part] - nominal[part], one.sd[part]) for what, one in ours.items()}
        panels[name] = [published(STUDIES / "linear-3d" / f"fig2_linear_ring5_d{name}.csv"),
                        (here, truth[part] - nominal[part])]
    return beside(panels)


def figure_3(results: Path) -> Figure:
    """Draw the non-linear validation, of the truth that the paper publishes."""
    folder = STUDIES / "nonlinear-2d"
    nominal = np.concatenate([block.magnetization[:2] for block in build_magnet(
        read_study(folder / "study.toml")).blocks])
    ours = np.genfromtxt(results / "nonlinear-2d" / "paper" / "sampled.csv", delimiter=",",
                         names=True, usecols=(1, 2))
    panels = {}
    for component, name in enumerate(("Mx", "My")):
        theirs = published(folder / "fig3_nonlinear_2d_dM.csv",
                           slice(16 * component, 16 * (component + 1)))
        here = {"prior": theirs[0]["prior"], "posterior from B": (
            ours["mean_A_per_m"][component::2] - nominal[component::2],
            ours["sd_A_per_m"][component::2])}
        panels[name] = [theirs, (here, theirs[1])]
    return beside(panels)


def figure_4(results: Path) -> Figure:
    """Draw the relative errors of B_x along the first FASER dipole, before and after the update."""
    paper = np.genfromtxt(STUDIES / "faser" / "fig4_faser_on_axis.csv", delimiter=",", names=True)
    ours = np.genfromtxt(results / "demo" / "inferred" / "prediction.csv", delimiter=",",
                         names=True)
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    for axis, title, before, after in (
            (left, "the paper", paper["rel_error_prior"], paper["rel_error_posterior_F"]),
            (right, "halbach-fe: a line beside the axis", *(
                np.abs(ours[name] / ours["measured_T"] - 1)
                for name in ("prior_mean_T", "posterior_mean_T")))):
        axis.semilogy(paper["z_index"], before, color=PUBLISHED, label="before the update")
        axis.semilogy(paper["z_index"], after, color=POSTERIOR, lw=1, label="after it")
        axis.set(title=title, xlabel="index of the reading", ylim=(1e-6, 2))
        axis.grid(alpha=0.3)
    apart = ours["held_out"] > 0
    right.plot(paper["z_index"][apart], np.abs(ours["posterior_mean_T"] / ours["measured_T"] - 1)[
        apart], ".", color=POSTERIOR, label="of readings that were held out")
    left.set_ylabel("relative error of B_x")
    right.legend(fontsize=7)
    return figure


def main(results: Path, folder: Path) -> None:
    """Write one PNG per figure whose results are there."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in (("figure-2", figure_2), ("figure-3", figure_3), ("figure-4", figure_4)):
        try:
            figure = draw(results)
        except (OSError, HalbachError) as error:
            print(f"{name} is left out: {error}")  # noqa: T201
            continue
        figure.savefig(folder / f"{name}.png", dpi=90, pil_kwargs={"optimize": True},
                       metadata={"Software": None})
        print(folder / f"{name}.png")  # noqa: T201


if __name__ == "__main__":
    folders = [Path("results"), DOCS / "_static" / "paper"]
    main(*map(Path, sys.argv[1:3]), *folders[len(sys.argv[1:3]):])
