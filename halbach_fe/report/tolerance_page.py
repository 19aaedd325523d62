"""Page of `tolerance`: multipoles or homogeneity that result from those of the blocks."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from halbach_fe.core.arrays import Floats
from halbach_fe.design.ring_catalogue import obstacle
from halbach_fe.design.tolerance import QUANTILES, HomogeneityTolerance, Tolerance
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import types_of
from halbach_fe.report.answer import Answer
from halbach_fe.report.homogeneity_page import SIZES, solver_error_text
from halbach_fe.report.multipoles_page import (
    at_z,
    lacks_main,
    main_in_words,
    of_no_main,
    only_of_orders,
    reference_summary,
    reference_text,
)
from halbach_fe.report.page import (
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    attributes,
    begin_at_zero,
    chart,
    charts,
    legend_above,
    linearized,
)
from halbach_fe.report.words import decimals, ppm, share_in_words, whole, within_a_sentence
from halbach_fe.response.multipoles import plain
from halbach_fe.study.inference_keys import Prior
from halbach_fe.study.model import Study

ENOUGH = 0.9
"""Share of the magnets within the limit from which the tolerances suffice."""

OF_THE_DESIGN = 0.9
"""Largest multipole, or rms deviation, of the magnet as ordered, relative to what half of the
magnets have at most, from which on the answer says that it is the design's. (Tolerances add by
squares: a tenth of a deviation is half of it.)"""


def _multipole_summary(found: Tolerance) -> Plain:
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


def _multipole_quantiles(found: Tolerance) -> Rows:
    """Return a row of text for each order n."""
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
    # part of its standard deviation below which a mean is 0 in the table
    least = 5e-3
    return "0" if size < least * sd else f"{size:.3g}"


def answer(found: Tolerance | HomogeneityTolerance) -> Answer:
    """Say how large the multipoles of the magnets are, how many meet the limit, and what next."""
    if isinstance(found, HomogeneityTolerance):
        return _homogeneity_answer(found)
    half, most = np.quantile(found.largest, (0.5, 0.95))
    worst = found.model.orders[int(np.argmax(found.quantiles[1]))]
    said = (f"Half of the magnets have all unwanted multipoles below {decimals(half)} units of "
            f"1e-4, 95 % below {decimals(most)}; the largest is mostly that of order {worst}.")
    ordered = float(found.known.sizes.max())
    if ordered > OF_THE_DESIGN * half:
        made = _made_by_tolerances(found)
        said = (f"{made}{within_a_sentence(said) if made else said} That is the magnet as "
                f"designed ({decimals(ordered)} units with blocks as ordered), to which their "
                "tolerances add little.")
    said += only_of_orders(found.model)
    share = found.share
    if share is not None:
        said = (f"{share_in_words(share, found.share_sd)} of the magnets "
                f"have all unwanted multipoles within {found.limit:g} units. {said}")
    question = "Which multipoles do the tolerances of the blocks make?"
    if lacks_main(found.known):
        return of_no_main(question, said, "Not in these units", "tolerance STUDY",
                          found.known)
    return Answer(question, said, f"{_trust(found)} {whole(len(found.sizes))} magnets were drawn.",
                  *_next_step(found), sound=not found.table_doubts)


def _next_step(found: Tolerance | HomogeneityTolerance, of_design: str = "") -> tuple[str, str]:
    """Return the next step, and its command; ``of_design`` is the step if the design, not the
    blocks, makes most of the errors.
    """
    if found.table_doubts:
        return ("Answer what is asked of the table of blocks, correct it or the study, and ask "
                "again.", f"halbach-fe tolerance STUDY --blocks BLOCKS{at_z(found.model)} -o DIR")
    if found.share is not None and found.share >= ENOUGH:
        return ("The tolerances suffice: build the magnet, measure it, and update its blocks.",
                "halbach-fe infer STUDY --measurements MAP -o DIR")
    if of_design:
        return (of_design, "halbach-fe design STUDY -o DIR" if obstacle(found.study) is None else
                "halbach-fe sort STUDY BLOCKS -o DIR")
    if all(len(blocks) == 1 for blocks in types_of(build_magnet(found.study)).values()):
        return ("Every slot is a type of its own, so that no blocks can change places: state in "
                "prior.types which slots take the same ones, then sort measured blocks.",
                f"halbach-fe sort STUDY BLOCKS{at_z(found.model)} -o DIR")
    measure = "Measure the blocks before assembly, and see" if found.table_doubts is None else "See"
    return (f"{measure} what sorting them into the slots that they fit gains.",
            f"halbach-fe sort STUDY BLOCKS{at_z(found.model)} -o DIR")


def _trust(found: Tolerance | HomogeneityTolerance) -> str:
    """Say what the drawn magnets rest on: the study's tolerances, or a table of blocks."""
    if found.table_doubts:
        return f"Not yet. {' '.join(found.table_doubts)}"
    if found.table_doubts is None:
        return (f"Yes, as far as the study's prior is right: "
                f"{tolerances_in_words(found.study.prior)}")
    return ("Yes, as far as the table of measured blocks is right, from which the magnets were "
            f"drawn. {NOMINAL}")


def _made_by_tolerances(found: Tolerance) -> str:
    """Name the largest multipole that the design does not make; empty if it makes all of them."""
    half, most = found.quantiles[1:3]
    own = found.known.sizes < half / 2
    if not own.any():
        return ""
    number = int(np.argmax(np.where(own, half, 0.0)))
    return ("The largest multipole that only the tolerances make is "
            f"c_{found.model.orders[number]}: below {decimals(half[number])} units in half of the "
            f"magnets, below {decimals(most[number])} in 95 %. With what the design makes: ")


def page(found: Tolerance | HomogeneityTolerance) -> Page:
    """Return the page of magnets that were drawn at random."""
    if isinstance(found, HomogeneityTolerance):
        return _homogeneity_page(found)
    rows = _multipole_quantiles(found)
    return Page(
        "tolerance", "multipoles to expect from the tolerances", found.study, answer(found),
        _multipole_summary(found), [Section([
            _drawn(found.study, whole(len(found.sizes))),
            f"{reference_text(found.model, found.study)} Means and standard deviations are "
            "computed in closed form, quantiles from the random magnets; standard deviations "
            "include the error of the solver, quantiles do not. “95 % below” is the size that "
            "|c_n| stays below in 95 % of them. Main multipole: "
            f"{main_in_words(found.model, found.known)}.",
            Table(rows, "numbers"), linearized(found.study)])],
        {"Multipoles |c_n| in units of 1e-4": rows},
        figures={
            "tolerance_sizes.png": (
                partial(_size_quantiles_figure, found), "Unwanted multipoles |c_n| of the "
                "simulated magnets: median, with bars from the 5 % to the 95 % quantile"),
            "tolerance_largest.png": (
                partial(_largest_multipole_figure, found), "Share of the simulated magnets whose "
                "largest unwanted multipole is below a limit")})


def _homogeneity_page(found: HomogeneityTolerance) -> Page:
    """Return the page of the homogeneity of magnets that were drawn at random."""
    region, rows = found.model.region.text, _homogeneity_quantiles(found)
    return Page(
        "tolerance", "homogeneity to expect from the tolerances", found.study, answer(found),
        _homogeneity_summary(found), [
            Section([_drawn(found.study, str(len(found.rms_ppm)))]),
            Section([SIZES, Table(rows, "turned"), linearized(found.study)],
                    f"The field in {region}")],
        {f"Deviations of |B| in {region}": rows},
        figures={"tolerance_ppm.png": (
            partial(_deviation_figure, found), "Share of the simulated magnets whose field "
            "deviates from its mean by less than a limit, rms (left) and peak to peak (right)")})


def _drawn(study: Study, draws: str) -> str:
    """Say what was drawn."""
    mounting = study.prior.mounting_sd_deg
    return (f"{draws} magnets were drawn at random. The magnetizations of their blocks are "
            "distributed as in the prior" + (
                f", and mounting turns each block by a random angle with an sd of {mounting:.3g}° "
                "about each axis" if mounting > 0 else "")
            + ". Shapes and positions of the blocks are nominal.")


def _size_quantiles_figure(found: Tolerance) -> Figure:
    """Draw median and quantiles of |c_n| by order."""
    figure, axis = chart(3.6)
    place = np.arange(len(found.model.orders))
    low, middle, high = found.quantiles[:3]
    axis.errorbar(place, middle, [middle - low, high - middle], fmt="o", color=POSTERIOR, capsize=4)
    if found.limit is not None:
        axis.axhline(found.limit, color=PRIOR, ls="--", label="limit")
        legend_above(figure, axis)
    axis.set_xticks(place, [f"c$_{{{order}}}$" for order in found.model.orders])
    axis.set(ylabel="|c$_n$| in units", ylim=(0, None))
    return figure


def _largest_multipole_figure(found: Tolerance) -> Figure:
    """Draw the distribution function of the largest |c_n|."""
    figure, axis = chart(3.6)
    _draw_shares(axis, found.largest)
    if found.limit is not None:
        axis.axvline(found.limit, color=PRIOR, ls="--", label="limit")
        legend_above(figure, axis)
    axis.axhline(1, color=PUBLISHED, lw=0.8)
    axis.set(xlabel="limit of all |c$_n$| in units", ylabel="share of magnets", ylim=(0, 1.02))
    begin_at_zero(axis)
    axis.ticklabel_format(axis="x", useOffset=False)
    return figure


def _draw_shares(axis: Axes, values: Floats) -> None:
    """Draw the share of magnets with at most each of some values (draws,)."""
    axis.plot(np.sort(values), np.arange(1, len(values) + 1) / len(values), color=POSTERIOR)


def _homogeneity_summary(found: HomogeneityTolerance) -> Plain:
    """Return the content of tolerance.json."""
    return {
        "study": found.study.name, "region": asdict(found.model.region),
        "draws": len(found.rms_ppm), "limit_ppm": found.limit,
        "as_ordered": attributes(found.ordered, "mean_T", "rms_ppm", "peak_to_peak_ppm"),
        **{f"{name}_quantiles": _by_quantile(np.quantile(getattr(found, name), QUANTILES))
           for name in ("mean_T", "rms_ppm", "peak_to_peak_ppm")},
        "solver_error_ppm": found.model.solver_error_ppm,
        "share_within_limit": found.share, "share_sd": found.share_sd,
    }


def _homogeneity_quantiles(found: HomogeneityTolerance) -> Rows:
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


def _homogeneity_answer(found: HomogeneityTolerance) -> Answer:
    """Say how homogeneous the magnets are, how many meet the limit, and what next."""
    (half, most), (wide, widest) = (np.quantile(values, (0.5, 0.95)) for values in (
        found.rms_ppm, found.peak_to_peak_ppm))
    said = (f"Half of the magnets deviate by less than {ppm(half)} ppm rms ({ppm(wide)} peak to "
            f"peak) from their mean field in {found.model.region.text}, 95 % by less than "
            f"{ppm(most)} ({ppm(widest)}). With all blocks as ordered it is "
            f"{ppm(found.ordered.rms_ppm)} ppm rms.")
    share = found.share
    if share is not None and found.limit is not None:
        said = (f"{share_in_words(share, found.share_sd)} of the magnets "
                f"are within {ppm(found.limit)} ppm rms. {said}")
    of_design = "" if found.ordered.rms_ppm <= OF_THE_DESIGN * half else (
        "Look for a better design first: perfect blocks would leave "
        f"{100 * found.ordered.rms_ppm / half:.3g} % of this deviation. Sorting measured blocks "
        "can use their errors against it, but takes only a part of it away.")
    text, small = solver_error_text(found.model, half)
    return Answer(
        "How homogeneous is the field that the tolerances of the blocks leave?", said,
        f"{_trust(found)} {whole(len(found.rms_ppm))} magnets were drawn. {text}",
        *_next_step(found, of_design), sound=small and not found.table_doubts)


NOMINAL = ("Shapes and places count as nominal: what their tolerances make comes on top of these "
           "numbers.")


def tolerances_in_words(prior: Prior) -> str:
    """Say which tolerances of the blocks were drawn, and which were not, in sentences."""
    shared = ({f"those of {name}": sd for name, sd in prior.remanence_sd.items()}
              if prior.common_mode_sd is None else {"all of them": prior.common_mode_sd})
    together = "".join(
        f", {which} together by {100 * sd:.3g} %" for which, sd in shared.items() if sd > 0)
    mounted = (f", and mounting turns each block by {prior.mounting_sd_deg:.3g}°"
               if prior.mounting_sd_deg > 0 else "")
    return (f"each block varies by {100 * prior.magnitude_sd:g} % and "
            f"{prior.direction_sd_deg:g}°{together}{mounted}. {NOMINAL}")


def _deviation_figure(found: HomogeneityTolerance) -> Figure:
    """Draw the distribution functions of the rms and of the peak-to-peak deviation."""
    figure, (left, right) = charts(3.6, 1, 2, sharey=True)
    for axis, values, ordered, name in (
            (left, found.rms_ppm, found.ordered.rms_ppm, "rms"),
            (right, found.peak_to_peak_ppm, found.ordered.peak_to_peak_ppm, "peak to peak")):
        _draw_shares(axis, values)
        axis.axvline(ordered, color=PUBLISHED, lw=1.2, ls=":", label="all blocks as ordered")
        axis.set(xlabel=f"{name} deviation in ppm", ylim=(0, 1.02))
        axis.xaxis.set_major_locator(MaxNLocator(4))  # numbers of five digits side by side
    left.set_ylabel("share of magnets")
    if found.limit is not None:
        left.axvline(found.limit, color=PRIOR, ls="--", label="limit")
    for axis in (left, right):
        begin_at_zero(axis)
    legend_above(figure, left)
    return figure
