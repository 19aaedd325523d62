"""Figures, table and page of the homogeneity that results from the tolerances of the blocks."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.design.ring_catalogue import obstacle
from halbach_fe.design.tolerance import QUANTILES, HomogeneityTolerance
from halbach_fe.report.answer import Answer
from halbach_fe.report.homogeneity import SIZES, solver_error_text
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
from halbach_fe.report.words import ppm, share_in_words, whole
from halbach_fe.study.inference import Prior

ENOUGH = 0.9
"""Share of the magnets within the limit from which the tolerances suffice."""


def homogeneity_tolerance_summary(found: HomogeneityTolerance) -> dict[str, object]:
    """Return the content of tolerance.json."""
    return {
        "study": found.study.name, "region": asdict(found.model.region),
        "draws": len(found.rms_ppm), "limit_ppm": found.limit,
        "as_ordered": {"mean_T": found.ordered.mean_T, "rms_ppm": found.ordered.rms_ppm,
                       "peak_to_peak_ppm": found.ordered.peak_to_peak_ppm},
        **{f"{name}_quantiles": dict(zip(map(str, QUANTILES), np.quantile(
            values, QUANTILES).tolist(), strict=True)) for name, values in (
                ("mean_T", found.mean_T), ("rms_ppm", found.rms_ppm),
                ("peak_to_peak_ppm", found.peak_to_peak_ppm))},
        "solver_error_ppm": found.model.solver_error_ppm,
        "share_within_limit": found.share, "share_sd": found.share_sd,
    }


def homogeneity_quantiles(found: HomogeneityTolerance) -> list[dict[str, str]]:
    """Return a row of text for the rms deviation, the one peak to peak, and the mean field."""
    def row(name: str, ordered: str, texts: list[str]) -> dict[str, str]:
        return {"": name, "as ordered": ordered} | {
            f"{100 * q:g} % below": text for q, text in zip(QUANTILES, texts, strict=True)}

    def quantiles(values: Floats) -> list[float]:
        return np.quantile(values, QUANTILES).tolist()

    return [
        row("rms in ppm", ppm(found.ordered.rms_ppm), list(map(ppm, quantiles(found.rms_ppm)))),
        row("peak to peak in ppm", ppm(found.ordered.peak_to_peak_ppm),
            list(map(ppm, quantiles(found.peak_to_peak_ppm)))),
        row("mean field in mT", f"{1e3 * found.ordered.mean_T:.5g}",
            [f"{1e3 * value:.5g}" for value in quantiles(found.mean_T)])]


OF_THE_DESIGN = 0.9
"""Share of the deviation from which on it is the design's, and tolerances hardly add to it. (They
add by squares: a tenth of it is half of the deviation.)"""


def homogeneity_tolerance_answer(found: HomogeneityTolerance) -> Answer:
    """Say how homogeneous the magnets are, how many meet the limit, and what next."""
    (half, most), (wide, widest) = (np.quantile(values, (0.5, 0.95)) for values in (
        found.rms_ppm, found.peak_to_peak_ppm))
    said = (f"Half of the magnets deviate by less than {ppm(half)} ppm rms ({ppm(wide)} peak to "
            f"peak) from their mean field in {found.model.region.text}, 95 % by less than "
            f"{ppm(most)} ({ppm(widest)}). With all blocks as ordered it is "
            f"{ppm(found.ordered.rms_ppm)} ppm rms.")
    share, prior = found.share, found.study.prior
    if share is not None and found.limit is not None:
        said = (f"{share_in_words(share, found.share_sd)} of the magnets "
                f"are within {ppm(found.limit)} ppm rms. {said}")
    enough = share is not None and share >= ENOUGH
    step = (("The tolerances suffice: build the magnet, measure it, and update its blocks.",
             "halbach-fe infer STUDY --measurements MAP -o DIR") if enough else
            ("Look for a better design first: perfect blocks would leave "
             f"{100 * found.ordered.rms_ppm / half:.3g} % of this deviation. Sorting measured "
             "blocks can use their errors against it, but takes only a part of it away.",
             "halbach-fe design STUDY -o DIR" if obstacle(found.study) is None else
             "halbach-fe sort STUDY BLOCKS -o DIR")
            if found.ordered.rms_ppm > OF_THE_DESIGN * half else
            ("Measure the blocks before assembly, and see what sorting them into the slots that "
             "they fit gains.",
             "halbach-fe sort STUDY BLOCKS -o DIR"))
    text, small = solver_error_text(found.model, half)
    return Answer(
        "How homogeneous is the field that the tolerances of the blocks leave?", said,
        f"Yes, as far as the study's prior is right: {tolerances_in_words(prior)} "
        f"{whole(len(found.rms_ppm))} magnets were drawn. {text}", *step,
        sound=small)


def tolerances_in_words(prior: Prior) -> str:
    """Say which tolerances of the blocks were drawn, and which were not, in sentences."""
    together = (f", all of them together by {100 * prior.common_mode_sd:g} %"
                if prior.common_mode_sd > 0 else "")
    mounted = (f", and mounting turns each block by {prior.mounting_sd_deg:.3g}°"
               if prior.mounting_sd_deg > 0 else "")
    return (f"each block varies by {100 * prior.magnitude_sd:g} % and "
            f"{prior.direction_sd_deg:g}°{together}{mounted}. Shapes and places count as nominal: "
            "what their tolerances make comes on top of these numbers.")


@own_style
def write_homogeneity_tolerance(found: HomogeneityTolerance, folder: Path) -> None:
    """Write tolerance.json, tolerance.html and its figure."""
    summary = homogeneity_tolerance_summary(found)
    write_text(folder / "tolerance.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    pictures = save({"tolerance_ppm.png": (
        _figure(found), "Share of the simulated magnets whose field deviates from its mean by less "
        "than a limit, rms (left) and peak to peak (right)")}, folder)
    write_page(folder / "tolerance.html", "homogeneity_tolerance.html.j2", pictures,
               study=found.study, draws=len(found.rms_ppm), convention=SIZES,
               answer=homogeneity_tolerance_answer(found), region=found.model.region.text,
               rows=homogeneity_quantiles(found))


def _figure(found: HomogeneityTolerance) -> Figure:
    """Draw the distribution functions of the rms and of the peak-to-peak deviation."""
    figure = figure_of(3.6)
    left, right = figure.subplots(1, 2, sharey=True)
    for axis, values, ordered, name in (
            (left, found.rms_ppm, found.ordered.rms_ppm, "rms"),
            (right, found.peak_to_peak_ppm, found.ordered.peak_to_peak_ppm, "peak to peak")):
        axis.plot(np.sort(values), np.arange(1, len(values) + 1) / len(values), color=POSTERIOR)
        axis.axvline(ordered, color=PUBLISHED, lw=1.2, ls=":", label="all blocks as ordered")
        axis.set(xlabel=f"{name} deviation in ppm", ylim=(0, 1.02))
        axis.grid(alpha=0.3)
        axis.xaxis.set_major_locator(MaxNLocator(4))  # numbers of five digits side by side
    left.set_ylabel("share of magnets")
    if found.limit is not None:
        left.axvline(found.limit, color=PRIOR, ls="--", label="limit")
    for axis in (left, right):
        begin_at_zero(axis)
    legend_above(figure, left)
    return figure
