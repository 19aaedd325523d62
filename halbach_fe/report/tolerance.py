"""Figures, table and page of the multipoles that result from the tolerances of the blocks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.design.tolerance import QUANTILES, HomogeneityTolerance, Tolerance
from halbach_fe.report.answer import Answer
from halbach_fe.report.homogeneity_tolerance import (
    ENOUGH,
    homogeneity_quantiles,
    homogeneity_tolerance_answer,
    homogeneity_tolerance_summary,
    tolerances_in_words,
    write_homogeneity_tolerance,
)
from halbach_fe.report.multipoles import (
    lacks_main,
    main_in_words,
    of_no_main,
    reference_summary,
    reference_text,
)
from halbach_fe.report.page import (
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    begin_at_zero,
    figure_of,
    legend_above,
    own_style,
    save,
    write_page,
)
from halbach_fe.report.words import share_in_words, whole
from halbach_fe.response.multipoles import plain

LEAST_OF_SD = 5e-3
"""Part of its standard deviation below which a mean is 0 in the table."""


OF_THE_DESIGN = 0.9
"""Largest multipole of the magnet as ordered, relative to what half of the magnets have at most,
from which on the answer says that it is the design's."""


def tolerance_summary(found: Tolerance | HomogeneityTolerance) -> dict[str, object]:
    """Return the content of tolerance.json."""
    if isinstance(found, HomogeneityTolerance):
        return homogeneity_tolerance_summary(found)
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


def table_title(found: Tolerance | HomogeneityTolerance) -> str:
    """Return the title of `quantile_table`."""
    return (f"Deviations of |B| in {found.model.region.text}"
            if isinstance(found, HomogeneityTolerance) else
            "Multipoles |c_n| in units of 1e-4")


def quantile_table(found: Tolerance | HomogeneityTolerance) -> list[dict[str, str]]:
    """Return the rows of the table as text: of multipoles one for each order n."""
    if isinstance(found, HomogeneityTolerance):
        return homogeneity_quantiles(found)
    size, sd = len(found.model.orders), found.known.sd
    rows = []
    for i, order in enumerate(found.model.orders):
        within = {} if found.shares is None else {
            "within the limit": f"{100 * found.shares[i]:.3g} %"}
        row = {"n": str(order), **within, "|c_n| of the mean magnet": _size(found, i),
               "sd of b_n": f"{sd[i]:.3g}", "sd of a_n": f"{sd[size + i]:.3g}"}
        row |= {f"{100 * q:g} % below": f"{value:.3g}"
                for q, value in zip(QUANTILES, found.quantiles[:, i], strict=True)}
        rows.append(row)
    return rows


def _size(found: Tolerance, number: int) -> str:
    """Return |c_n| of the mean as text: 0 if it is small beside what the tolerances make.

    What symmetry forbids is 0 but for the mesh.
    """
    size, sd = found.known.sizes[number], found.known.sd.reshape(2, -1)[:, number].max()
    return "0" if size < LEAST_OF_SD * sd else f"{size:.3g}"


def answer(found: Tolerance | HomogeneityTolerance) -> Answer:
    """Say how large the multipoles of the magnets are, how many meet the limit, and what next."""
    if isinstance(found, HomogeneityTolerance):
        return homogeneity_tolerance_answer(found)
    largest = found.sizes.max(axis=1)
    half, most = np.quantile(largest, (0.5, 0.95))
    worst = found.model.orders[int(np.argmax(found.quantiles[1]))]
    said = (f"Half of the magnets have all unwanted multipoles below {half:.3g} units of 1e-4, "
            f"95 % below {most:.3g}; the largest is mostly that of order {worst}.")
    ordered = float(found.known.sizes.max())
    if ordered > OF_THE_DESIGN * half:
        made = _made_by_tolerances(found)
        said = (f"{made}{said[0].lower() if made else said[0]}{said[1:]} That is the magnet as "
                f"designed ({ordered:.3g} units with blocks as ordered), to which their "
                "tolerances add little.")
    share, prior = found.share, found.study.prior
    if share is not None:
        said = (f"{share_in_words(share, found.share_sd)} of the magnets "
                f"have all unwanted multipoles within {found.limit:g} units. {said}")
    question = "Which multipoles do the tolerances of the blocks make?"
    if lacks_main(found.known):
        return of_no_main(question, said, "Not in these units", "tolerance STUDY")
    step = (("Measure the blocks before assembly, and see what sorting them into the slots that "
             "they fit gains.",
             "halbach-fe sort STUDY BLOCKS -o DIR") if share is None or share < ENOUGH else
            ("The tolerances suffice: build the magnet, measure it, and update its blocks.",
             "halbach-fe infer STUDY --measurements MAP -o DIR"))
    return Answer(
        question, said,
        f"Yes, as far as the study's prior is right: {tolerances_in_words(prior)} "
        f"{whole(len(found.sizes))} magnets were drawn.", *step)


def _made_by_tolerances(found: Tolerance) -> str:
    """Name the largest multipole that the design does not make; empty if it makes all of them."""
    half, most = found.quantiles[1:3]
    own = found.known.sizes < half / 2
    if not own.any():
        return ""
    number = int(np.argmax(np.where(own, half, 0.0)))
    return ("The largest multipole that only the tolerances make is "
            f"c_{found.model.orders[number]}: below {half[number]:.3g} units in half of the "
            f"magnets, below {most[number]:.3g} in 95 %. With what the design makes: ")


@own_style
def write_tolerance(found: Tolerance | HomogeneityTolerance, folder: Path) -> None:
    """Write tolerance.json, tolerance.html and its figures."""
    if isinstance(found, HomogeneityTolerance):
        write_homogeneity_tolerance(found, folder)
        return
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
               study=found.study, answer=answer(found),
               reference=reference_text(found.model, found.study),
               rows=quantile_table(found), draws=whole(len(found.sizes)),
               main=main_in_words(found.model, found.known))


def _size_quantiles_figure(found: Tolerance) -> Figure:
    """Draw median and quantiles of |c_n| by order."""
    figure = figure_of(3.6)
    axis = figure.subplots()
    place = np.arange(len(found.model.orders))
    low, middle, high = found.quantiles[:3]
    axis.errorbar(place, middle, [middle - low, high - middle], fmt="o", color=POSTERIOR, capsize=4)
    if found.limit is not None:
        axis.axhline(found.limit, color=PRIOR, ls="--", label="limit")
        legend_above(figure, axis)
    axis.set_xticks(place, [f"c$_{{{order}}}$" for order in found.model.orders])
    axis.set(ylabel="|c$_n$| in units", ylim=(0, None))
    axis.grid(alpha=0.3)
    return figure


def _largest_multipole_figure(found: Tolerance) -> Figure:
    """Draw the distribution function of the largest |c_n|."""
    figure = figure_of(3.6)
    axis = figure.subplots()
    largest = np.sort(found.sizes.max(axis=1))
    axis.plot(largest, np.arange(1, len(largest) + 1) / len(largest), color=POSTERIOR)
    if found.limit is not None:
        axis.axvline(found.limit, color=PRIOR, ls="--", label="limit")
        legend_above(figure, axis)
    axis.axhline(1, color=PUBLISHED, lw=0.8)
    axis.set(xlabel="limit of all |c$_n$| in units", ylabel="share of magnets", ylim=(0, 1.02))
    begin_at_zero(axis)
    axis.ticklabel_format(axis="x", useOffset=False)
    axis.grid(alpha=0.3)
    return figure
