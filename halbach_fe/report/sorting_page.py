"""Page of `sort`: figures and table of the assignment of measured blocks to slots."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.core.arrays import slices
from halbach_fe.design.assembly import turn_in_words
from halbach_fe.design.objective import DeviationModel
from halbach_fe.design.ring_catalogue import obstacle
from halbach_fe.design.sorting import SortedBlocks
from halbach_fe.measurement.block_table import write_blocks
from halbach_fe.report.answer import Answer
from halbach_fe.report.homogeneity_page import SIZES
from halbach_fe.report.multipoles_page import (
    DRAWS,
    at_z,
    lacks_main,
    main_in_words,
    multipole_figure,
    of_no_main,
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
    begin_at_zero,
    chart,
    columns_by_axis,
    csv_file,
    legend_above,
)
from halbach_fe.report.shimming_page import LIKELY, LITTLE, aim_of
from halbach_fe.report.words import counted, in_a_row, ppm, probability

T = TypeVar("T")

QUANTILES = (0.025, 0.5, 0.975)
"""Quantiles of the rms of random orders that sort.json states: the outer ones hold 95 % of them, as
all ranges of the page do."""


def _summary(found: SortedBlocks) -> Plain:
    """Return the content of sort.json; rms values are those of the mean."""
    unit = aim_of(found.model).unit
    return {
        "study": found.study.name, **aim_of(found.model).summary(found.limit, dict(zip(
            ("sorted", "unsorted"), found.fields or (found.best, found.numbered), strict=True))),
        "blocks": len(found.table), "left_over": found.left_over,
        "table_order": found.own_order, "turned": [
            {"serial": found.table.serial[row], "ring": int(found.table.ring[row]),
             "slot": int(found.table.slot[row]), "turn_deg": found.turn_deg[row].tolist()}
            for row in _turned_rows(found)],
        f"rms_sorted_{unit}": found.best.rms_of_mean,
        f"rms_unsorted_{unit}": found.numbered.rms_of_mean,
        "random_orders": len(found.random),
        f"rms_random_{unit}": dict(zip(map(str, QUANTILES), np.quantile(
            found.random, QUANTILES).tolist(), strict=True)),
        f"best_random_{unit}": float(found.random.min()),
        "probability_within_limit": _within(found),
    }


def _within(found: SortedBlocks) -> float | None:
    """Return the probability that the sorted blocks meet the limit; None without one."""
    if found.limit is None:
        return None
    normals = np.random.default_rng(1).standard_normal((DRAWS, len(found.best.mean)))
    return float(found.best.share_within(found.limit, normals))


def _limit(found: SortedBlocks) -> str:
    """Say how probably the sorted blocks meet the limit; nothing without one."""
    share = _within(found)
    if share is None or found.limit is None:
        return ""
    return (f" {aim_of(found.model).within(found.limit)} with a probability of "
            f"{probability(share)}."
            f"{' Sorting does not reach that limit.' if share < LIKELY else ''}")


def _turned_rows(found: SortedBlocks) -> list[int]:
    """Return the rows of the blocks that are turned."""
    return [int(row) for row in np.flatnonzero(found.turn_deg.any(axis=1))]


def _turn_table(found: SortedBlocks) -> Rows:
    """Return the rows of the table of turned blocks, as text."""
    rows = []
    for row in _turned_rows(found):
        rows.append({"block": found.table.serial[row], "ring": str(found.table.ring[row]),
                     "slot": str(found.table.slot[row]),
                     "turn": turn_in_words(found.turn_deg[row])})
    return rows


def place_table(found: SortedBlocks) -> Rows:
    """Return the rows of the table of places, each of a few slots of a ring."""
    slots_a_row = 8  # largest number of slots in a row of the table of places
    table, rows = found.table, []
    for ring in np.unique(table.ring).tolist():
        mine = np.flatnonzero(table.ring == ring)
        mine = mine[np.argsort(table.slot[mine], kind="stable")]
        for some in (mine[part] for part in slices(len(mine), slots_a_row)):
            rows.append({"ring": str(ring), "slots": f"{table.slot[some[0]]} to "
                         f"{table.slot[some[-1]]}" if len(some) > 1 else str(table.slot[some[0]]),
                         "blocks, slot by slot": ", ".join(table.serial[row] for row in some)})
    return rows


def order_table(found: SortedBlocks) -> Rows:
    """Return the rows of the table of multipoles or fields, as text."""
    return aim_of(found.model).rows(_compared(
        found, *(found.fields or (found.best, found.numbered))))


def _compared(found: SortedBlocks, best: T, own: T) -> dict[str, T]:
    """Return what is sorted after what is in the table's order; the former alone without choice,
    which needs no name in a table of multipoles.
    """
    only = "" if found.fields is None else "every order"
    return {found.own_order: own, "sorted": best} if _chose(found) else {only: best}


def _chose(found: SortedBlocks) -> bool:
    """Whether there was anything to choose: an order, or turns."""
    return bool((found.has_choice and found.matters) or found.turned)


def answer(found: SortedBlocks) -> Answer:
    """Say what sorting gains over the table's order and over chance, and what to do next."""
    said = _answer(found)
    return said if not found.doubts else replace(
        said, trust=f"Not yet. {' '.join(found.doubts)}", sound=False,
        step="Answer this first, and sort again.",
        command=f"halbach-fe sort STUDY BLOCKS{at_z(found.model)} -o DIR")


def _answer(found: SortedBlocks) -> Answer:
    """Return the answer of a table that is of this magnet."""
    best, own = found.best.rms_of_mean, found.numbered.rms_of_mean
    low, high = np.quantile(found.random, QUANTILES[::2])
    what, unit, text = (aim := aim_of(found.model)).what, aim.rms_unit, aim.size
    sizes = "" if found.fields is None else " ({} instead of {} peak to peak)".format(
        *(ppm(each.peak_to_peak_ppm) for each in found.fields))
    question = "Which block goes into which slot?"
    left = ("" if not found.left_over else
            f" {counted(found.left_over, 'block is', 'blocks are')} left over.")
    if not isinstance(found.model, DeviationModel) and lacks_main(found.numbered):
        return of_no_main(question, f"Not known: {what} {text(own)} {unit}.", "Not in these units",
                          "sort STUDY BLOCKS", found.numbered)
    turned = "" if not found.turned else (
        f" {counted(found.turned, 'block is', 'blocks are')} turned in the slot, as sort.csv says.")
    if found.has_choice and not _chose(found):
        return Answer(
            question, f"It does not matter: {what} {text(best)} {unit} in every order that is "
            f"allowed.{_limit(found)}{left}", f"Yes: {len(found.random)} random orders are alike. "
            + ("Only blocks that are at the same angle may change places, in rings whose fields "
               "add up along z." if all(
                   len(slots) == 1 for slots in found.study.prior.types.values()) else
               "The blocks that may change places are alike as measured, or are so in what is "
               "asked for."),
            f"To have a choice, {_more(found)}. Then sort again.",
            f"halbach-fe sort STUDY BLOCKS{at_z(found.model)} -o DIR")
    if not _chose(found):
        return Answer(
            question, f"Each into the only slot that it fits: there is no choice, and {what} "
            f"{text(best)} {unit}.{_limit(found)}", "Yes: blocks go only into slots of their own "
            "type, as they lie, and here every slot has its own. (halbach-fe shim also turns "
            "blocks upside down.)", "If blocks of some slots are alike, say so in the study "
            f"by prior.types{found.types_in_words}; or measure spare blocks. Then sort "
            "again.",
            f"halbach-fe sort STUDY BLOCKS{at_z(found.model)} -o DIR")
    prior = found.study.prior  # and what the uncertainty of the blocks makes
    spread = float(np.sqrt(max(found.best.rms**2 - found.best.rms_of_mean**2, 0.0)))
    known = ["the measured moments", *(words for words, there in (
        ("the calibration of the coil", prior.calibration_sd > 0),
        ("the mounting", prior.mounting_sd_deg > 0)) if there)]
    orders = (f"in all random orders about {text(low)}" if text(low) == text(high) else
              f"in 95 % of random orders {text(low)} to {text(high)}")
    gains = sorted(1 - best / each for each in (own, float(np.median(found.random))))
    hardly = "" if gains[0] >= LITTLE else (
        "The order of the table is nearly as good already. " if gains[1] >= LITTLE > 1 - best / own
        else "A random order is nearly as good. " if gains[1] >= LITTLE else
        "The order hardly matters: the sorted one is "
        f"{' to '.join(dict.fromkeys(f'{100 * gain:.2g}' for gain in gains))}\u00a0% better than "
        "that of the table or a random one. ")
    return Answer(
        question,
        f"{hardly}The slot of each block is in the table of places, which opens below, and in "
        f"blocks.sorted.csv. In these slots {what} "
        f"{text(best)} {unit}{sizes}; with the blocks {found.own_order} it would be "
        f"{text(own)}, and {orders}.{_limit(found)}{left}{turned}",
        f"Yes. The uncertainty of {in_a_row(known)} makes {text(spread)} {unit} of its own, "
        "added by squares, whatever the order"
        f"{'' if spread <= best else ': more than what sorting leaves'}. Blocks go only into slots "
        f"of their own type{'' if found.turned else ', as they lie'}; halbach-fe shim also turns "
        f"them upside down.{_ordered(found)}",
        "Assemble the magnet in this order, measure it, and update the blocks." if not hardly else
        "Assemble the magnet in this order, or in another one that you write into "
        f"blocks.sorted.csv, measure it, and update the blocks. To gain more, {_more(found)}.",
        "halbach-fe infer STUDY --measurements MAP --blocks DIR/blocks.sorted.csv -o DIR")


def _more(found: SortedBlocks) -> str:
    """Say what gives the search more choice."""
    stated = {frozenset(slots) for slots in found.study.prior.types.values()}
    if stated == {frozenset(slots) for slots in found.alike.values()}:
        return "measure spare blocks: all slots whose blocks are alike take the same ones already"
    return ("let more slots take the same blocks by prior.types of the study"
            f"{found.types_in_words}")


def _ordered(found: SortedBlocks) -> str:
    """Say what no order can change: the field of blocks that are all as ordered."""
    if not isinstance(found.model, DeviationModel):
        return ""
    values = found.model.units(found.model.offset + found.model.matrix @ found.model.nominal)
    return (f" With all blocks as ordered the deviation would be "
            f"{ppm(float(np.linalg.norm(values)))} ppm rms, by the design of the rings: sorting "
            "uses the errors of blocks against it. If what is left is too much, look for another "
            f"design{'' if obstacle(found.study) else ' (halbach-fe design)'} before you assemble "
            "this one.")


def page(found: SortedBlocks) -> Page:
    """Return the page of blocks that were assigned to slots."""
    aim = aim_of(found.model)
    rows, places = order_table(found), place_table(found)
    figures = {} if found.fields else {"sort_multipoles.png": (
        partial(multipole_figure, _compared(found, found.best, found.numbered), found.limit),
        "Unwanted multipoles of the blocks" + (
            " in the order of the table and of the sorted blocks" if _chose(found) else "")
        + ", normal (left) and skew (right); bars are two standard deviations")}
    if found.matters:
        figures["sort_orders.png"] = (
            partial(_random_orders_figure, found), "Histogram of the root mean square of "
            f"{aim.axis} for {len(found.random)} random orders of the blocks; the lines "
            "are the order of the table and the sorted blocks")
    turned = _turned_rows(found)
    files = {"blocks.sorted.csv": partial(write_blocks, found.table)} | ({} if not turned else {
        "sort.csv": csv_file({
            "serial": [found.table.serial[row] for row in turned],
            "ring": found.table.ring[turned], "slot": found.table.slot[turned],
            **columns_by_axis("turn_{}_deg", found.turn_deg[turned])},
            {"content": "blocks that are turned in their slots: rotation vectors along own axes"})})
    by_serial = ("By serial number, as in blocks.sorted.csv"
                 f"{'; the turns of blocks are in a table below' if turned else ''}.")
    return Page("sort", "which block goes into which slot", found.study, answer(found),
                _summary(found), [
        Section(["Blocks go only into slots of their own type."]),
        Section([by_serial, Table(places)], "Which block goes where",
                folded=len(places) > 12),
        Section([_convention(found), Table(rows, aim.table)], aim.title),
        Section([
            "Each is put into its slot as it was measured, and then turned about its own axes. "
            "The moments in blocks.sorted.csv are those of the turned blocks, and its columns "
            "turn_x_deg, turn_y_deg and turn_z_deg have the turns: `halbach-fe cad` says them in "
            "the plan to assemble.",
            Table(_turn_table(found))], "Blocks that are turned in their slots", about=turned)],
        {aim.title: rows}, figures=figures, files=files)


def _convention(found: SortedBlocks) -> str:
    """Return sentences about the table of the page."""
    if isinstance(found.model, DeviationModel):
        return (f"{SIZES} Ranges hold 95 % of the magnets that the uncertainty of the measured "
                "blocks allows.")
    return (f"{reference_text(found.model, found.study)} ± is the standard deviation, "
            f"including the error of the solver. Main multipole of "
            f"{'the sorted' if _chose(found) else 'these'} blocks: "
            f"{main_in_words(found.model, found.best)}.")


def _random_orders_figure(found: SortedBlocks) -> Figure:
    """Draw the histogram of the rms of random orders."""
    figure, axis = chart(3.6, grid=False)
    axis.hist(found.random, 50, color=PUBLISHED, label="random orders")
    axis.axvline(found.numbered.rms_of_mean, color=PRIOR, lw=2, ls="--", label=found.own_order)
    axis.axvline(found.best.rms_of_mean, color=POSTERIOR, lw=2, label="sorted")
    axis.set(xlabel=f"rms of {aim_of(found.model).axis}", ylabel="random orders")
    begin_at_zero(axis)
    legend_above(figure, axis, columns=3)
    return figure
