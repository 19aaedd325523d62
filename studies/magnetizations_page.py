"""Figure and page that compare inferred magnetizations with the known truth."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats, rms
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    SECOND,
    Page,
    Section,
    Table,
    charts,
    legend_above,
)
from halbach_fe.report.words import best_known, capital, decimals, fraction
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.types import COMPONENTS


def error_summary(magnetizations: Gaussian, truth: Floats) -> dict[str, float]:
    """Return errors of the mean in A/m, and the rms of error over standard deviation."""
    error, sd = magnetizations.mean - truth, magnetizations.sd
    free = sd > 0  # a missing block has no uncertainty
    return {"largest_error_A_per_m": float(np.abs(error).max()),
            "rms_error_A_per_m": rms(error), "z_rms": rms(error[free] / sd[free])}


def expected_spread(magnetizations: Gaussian) -> float:
    """Return the standard deviation of the rms of error over sd that the posterior foretells.

    It is larger than that of independent errors, 1 / sqrt(2 n), because what readings leave open
    are few combinations of magnetizations.
    """
    free = magnetizations.sd > 0
    sd = magnetizations.sd[free]
    correlation = magnetizations.covariance[np.ix_(free, free)] / np.outer(sd, sd)
    return float(np.linalg.norm(correlation) / np.sqrt(2) / free.sum())


def answer(magnet: Magnet, known: Mapping[str, Gaussian], truth: Floats) -> Answer:
    """Say how near the inferred magnetizations are to the true ones; the last of ``known`` counts.

    Error bars hold if the rms of error over standard deviation is within three of its standard
    deviations of 1.
    """
    (before, *_), (name, best) = known.values(), best_known(known)
    size = float(np.sqrt(np.mean(truth**2) * magnet.dimension))
    _, left, ratio = error_summary(best, truth).values()
    first = error_summary(before, truth)["rms_error_A_per_m"]
    spread = expected_spread(best)
    sound = abs(ratio - 1) <= 3 * spread
    return Answer(
        "How near are the inferred magnetizations to the true ones?",
        f"{capital(name)}: {1e-3 * left:.2g} kA/m rms in each component, "
        f"{fraction(left / size)} of a block's magnetization. Before the readings it was "
        f"{1e-3 * first:.2g} kA/m.",
        ("Yes: the" if sound else "No: the") + f" errors are {decimals(ratio, 2)} times the stated "
        f"standard deviations, where 1 ± {decimals(spread, 2)} is expected. The field of the truth "
        "was computed by another program than the one that is tested.",
        "Update a magnet of your own with its map." if sound else
        "Find out what the model lacks before its error bars are believed.",
        f"halbach-fe {'infer' if sound else 'diagnose'} STUDY --measurements MAP -o DIR", sound)


def page(
    magnet: Magnet, known: Mapping[str, Gaussian], truth: Floats, what: str,
    figures: Mapping[str, float] | None = None, ring: int = 1,
) -> Page:
    """Return the page of magnetizations.html, which compares those of a ring with the truth.

    Parameters
    ----------
    known : mapping
        Distributions of the magnetizations in A/m by name; at most three are drawn, the first of
        them (the prior) in orange.
    truth : ndarray, shape (parameters,), in A/m
    what : str
        The page's title.
    figures : mapping, optional
        Further numbers to list, by name.
    ring : int
        The ring that is drawn, counted from 1.
    """
    rows = []
    for name, distribution in known.items():
        largest, left, ratio = error_summary(distribution, truth).values()
        rows.append({"": name, "largest error in kA/m": decimals(1e-3 * largest),
                     "rms error in kA/m": decimals(1e-3 * left),
                     "rms of error / sd": f"{ratio:.2f}"})
    further = [{"": key.replace("_", " "), "value": f"{value:.4g}"}
               for key, value in (figures or {}).items()]
    return Page("magnetizations", what, magnet.study, answer(magnet, known, truth), {}, [
        Section([Table(rows, "numbers")]),
        Section([Table(further, "numbers")], "Further numbers", about=further)], rows=rows,
        figures={"magnetizations.png": (
            partial(_magnetizations_figure, magnet, known, truth, ring), f"Deviation of the "
            f"magnetizations of ring {ring} from nominal: truth, {', '.join(known)}; bars are "
            "standard deviations")}, stored=False)


def _magnetizations_figure(
    magnet: Magnet, known: Mapping[str, Gaussian], truth: Floats, ring: int
) -> Figure:
    """Draw deviations of a ring's magnetizations from nominal, a panel for each component."""
    size = magnet.dimension
    first, slots = sum(magnet.blocks_by_ring[:ring - 1]), magnet.blocks_by_ring[ring - 1]
    part = slice(first * size, (first + slots) * size)
    nominal = magnet.nominal_magnetization[part]
    figure, axes = charts(1 + 2.4 * size, size, sharex=True)
    places = np.arange(1, slots + 1)
    shifts = 0.3 * np.linspace(-0.5, 0.5, len(known))
    for number, axis in enumerate(axes):
        for (name, distribution), colour, shift in zip(
                known.items(), (PRIOR, POSTERIOR, SECOND), shifts, strict=False):
            axis.errorbar(places + shift, 1e-3 * (distribution.mean[part] - nominal)[number::size],
                          1e-3 * distribution.sd[part][number::size], color=colour, fmt="o", ms=4,
                          capsize=2, label=name)
        axis.plot(places, 1e-3 * (truth[part] - nominal)[number::size], "_", color=MEASURED, ms=14,
                  mew=2, label="truth", zorder=3)
        axis.set_ylabel(f"ΔM{COMPONENTS[number]} in kA/m")
    legend_above(figure, axes[0], columns=4)
    axes[-1].set_xlabel("slot")
    axes[-1].set_xticks(places)
    return figure
