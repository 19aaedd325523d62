"""Page of `shim`: figures and table of the moves of blocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from halbach_fe.core.arrays import Floats
from halbach_fe.design.objective import DeviationModel
from halbach_fe.design.shimming import STOPS, Placement, Shim, Step
from halbach_fe.report.answer import Answer
from halbach_fe.report.homogeneity_page import SIZES, homogeneity_rows, plain_homogeneity
from halbach_fe.report.multipoles_page import (
    at_z,
    lacks_main,
    main_in_words,
    multipole_figure,
    of_no_main,
    reference_summary,
    reference_text,
)
from halbach_fe.report.page import (
    POSTERIOR,
    PUBLISHED,
    SECOND,
    SMALL,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    chart,
    legend_above,
    linearized,
)
from halbach_fe.report.point_maps import draw_cross_section
from halbach_fe.report.words import counted, in_a_row, place_of, ppm, probability, with_unit
from halbach_fe.response.multipoles import MultipoleModel, plain, text_table

T = TypeVar("T")

LITTLE = 0.05
"""Part of the rms below which the gain of all moves, or of an order, is called hardly worth it."""

LIKELY = 0.5
"""Probability below which the answer says that a limit is not reached."""

STUDY_FILE = "study.shimmed.toml"

DRAWN_AS = {"swap": "blocks that are exchanged", "cycle": "blocks that change places in a cycle",
            "turn": "block that is turned in place", "replace": "block that is replaced"}
"""Names of the kinds of moves in the picture of all moves."""


def _summary(shim: Shim) -> Plain:
    """Return the content of shim.json."""
    return {
        "study": shim.study.name, **aim_of(shim.model).summary(shim.limit, dict(zip(
            ("before", "after"), shim.fields or (shim.before, shim.after), strict=True))),
        "moves": [_step_summary(shim, step) for step in shim.steps],
        "stop": shim.stop, "moves_there_are": shim.tried,
        "probability_within_limit": None if shim.within is None else {
            "before": shim.within[0], "after": shim.within[1]},
        "mounting_sd_deg": shim.study.prior.mounting_sd_deg,
        "prior_conflict": shim.result.prior_conflict,
        "prior_conflict_limit": shim.result.conflict_limit,
        "study_file": STUDY_FILE if shim.shimmed_study else None,
    }


class Aim(NamedTuple):
    """What blocks are moved for, in words: small multipoles, or a homogeneous field."""

    what: str
    """Subject and verb of what is made small."""
    values: str
    squares: str
    """The same as a noun, and its sum of squares."""
    unit: str
    """The unit of a value in names of JSON files."""
    rms_unit: str
    """The unit of the rms of all values in sentences."""
    title: str
    """Title of the table of the values."""
    axis: str
    label: str
    """Name of their rms in figures of orders and of moves."""
    table: str
    """Kind of the table, see `Table`."""
    verb: str
    """The command that shows the values."""
    size: Callable[[float], str]
    """Text of an rms."""
    within: Callable[[float], str]
    """What a limit asks for, in words."""
    reference: Callable[[float | None], Plain]
    plain: Callable[[Any], Plain]
    """What the values of all magnets refer to, with a limit, and those of one, in a JSON file."""
    rows: Callable[[Mapping[str, Any]], Rows]
    """Rows of text with the values of magnets by name."""

    def summary(self, limit: float | None, values: Mapping[str, Any]) -> Plain:
        """Return the values of magnets by name, and what they refer to, for a JSON file."""
        return {**self.reference(limit), **{name: self.plain(each)
                                            for name, each in values.items()}}


def aim_of(model: MultipoleModel | DeviationModel) -> Aim:
    """Return what a model is of."""
    if isinstance(model, DeviationModel):
        region = model.homogeneity.region
        return Aim(
            f"the deviation of |B| in {region.text} is", "the deviation of |B|",
            "the mean square deviation of |B|", "ppm", "ppm rms",
            f"Deviations of |B| in {region.text}", "the deviation of |B| in ppm",
            "rms deviation of |B| in ppm", "turned", "homogeneity", ppm,
            lambda limit: f"The deviation is within {ppm(limit)} ppm rms",
            lambda limit: {"region": asdict(region), "limit_ppm": limit}, plain_homogeneity,
            homogeneity_rows)
    return Aim(
        "the unwanted multipoles are", "the unwanted multipoles", "the sum of all |c_n|²", "units",
        "units of 1e-4 rms", "Multipoles in units of 1e-4",
        "the unwanted multipoles in units of 1e-4", "rms of |c$_n$| in units of 1e-4", "numbers",
        "multipoles", "{:.3g}".format,
        lambda limit: f"All unwanted multipoles are within {limit:g} units",
        lambda limit: {"reference": reference_summary(model, limit)},
        lambda known: plain(known, model.unit), lambda values: text_table(**values))


def _reason_against(shim: Shim) -> str:
    """Say why the moves should not be made as they are listed; empty if they should."""
    if shim.result.disagreement:
        return ("Do not make these moves yet: they follow from an update that disagrees with its "
                "map. They are listed as what would be done if it were right.")
    if _gained(shim) < LITTLE:
        return ("These moves are hardly worth the work: they are listed as what would be done for "
                "so small a gain.")
    return ""


def _gained(shim: Shim) -> float:
    """Return by which part of itself the moves lower the rms."""
    before, after = _sizes(shim)
    return 1 - after / before


def _sizes(shim: Shim) -> tuple[float, float]:
    """Return the rms before and after the moves, including the uncertainty.

    That of a field is not the linearized one by which the moves were chosen.
    """
    if shim.fields is None:
        return shim.before.rms, shim.after.rms
    before, after = (known.rms_range_ppm[1] for known in shim.fields)
    return before, after


def _sizes_by_move(shim: Shim) -> Floats:
    """Return the rms (1 + moves,) before the moves and after each of them."""
    return np.array([known.rms for known in (shim.before, *(step.after for step in shim.steps))])


def _step_summary(shim: Shim, step: Step) -> Plain:
    """Return a move and its gain as entries of shim.json."""
    unit = aim_of(shim.model).unit
    return {"kind": step.move.kind,
            "blocks": [_placement_summary(shim, placement) for placement in step.move.placements],
            f"gain_{unit}2": step.gain, f"gain_sd_{unit}2": step.gain_sd,
            f"rms_after_{unit}": step.after.rms}


def _placement_summary(shim: Shim, placement: Placement) -> Plain:
    """Return where a block comes from, where it goes and how it is turned, for shim.json."""
    places = shim.mounts.places
    spare = placement.block - len(places)
    return {"from": list(places[placement.block]) if spare < 0 else None,
            "spare": shim.spares[spare] if spare >= 0 else None, "to": list(places[placement.to]),
            "turn_deg": list(shim.mounts.turn_deg(placement.turn))}


def _move_table(shim: Shim) -> Rows:
    """Return the rows of the table of moves, as text."""
    aim = aim_of(shim.model)
    return [{"move": f"{number}: {step.move.kind}",
             "blocks": "; ".join(_placement_text(shim, placement)
                                 for placement in step.move.placements),
             f"rms after in {aim.unit}{_how(shim)}": aim.size(step.after.rms),
             "gain in its sd": f"{step.gain / step.gain_sd:.1f}" if step.gain_sd else "exact"}
            for number, step in enumerate(shim.steps, start=1)]


def _how(shim: Shim) -> str:
    """Return how the rms after each move was computed, if otherwise than in the answer."""
    return "" if shim.fields is None else ", linearized"


def _compared(shim: Shim, before: T, after: T) -> dict[str, T]:
    """Return what is before and after the moves by its name; without moves there is one magnet,
    which needs no name in a table of multipoles.
    """
    only = "" if shim.fields is None else "as it is"
    return {"before": before, "after": after} if shim.steps else {only: before}


def _placement_text(shim: Shim, placement: Placement) -> str:
    """Return where a block comes from, where it goes and how it is turned, in words."""
    spare = placement.block - len(shim.mounts.places)
    blocks = shim.magnet.blocks
    source = f"spare {shim.spares[spare]}" if spare >= 0 else place_of(blocks[placement.block])
    stays = placement.block == placement.to
    where = "in place" if stays else f"to {place_of(blocks[placement.to])}"
    vector = np.array(shim.mounts.turn_deg(placement.turn))
    angle = float(np.linalg.norm(vector))
    if not angle:
        return f"{source} {where}"
    axis = vector / angle
    array, block = shim.study.array, shim.study.array.block
    follows = block.shape == "cuboid" and block.orientation == "magnetization"
    own = (("own x", "own y", "own z") if not array.is_uniform
           else ("magnetization's", "transverse", "axial") if follows
           else ("radial", "azimuthal", "axial"))
    names = [name for name, part in zip(own, axis, strict=True) if abs(part) > 1 - 1e-6]
    about = names[0] if names else "(" + ", ".join(f"{part:.3g}" for part in axis) + ")"
    sign = -1 if names and axis.sum() < 0 else 1
    return (f"{source} {where}, {'' if stays else 'then '}turned by {sign * angle:.0f}° about its "
            f"{about} axis")


def answer(shim: Shim) -> Answer:
    """Say which moves are worthwhile and what they gain, and what to do next."""
    question = "Which blocks should be exchanged, turned or replaced?"
    aim = aim_of(shim.model)
    before, after = (aim.size(rms) for rms in _sizes(shim))
    what, unit = aim.what, aim.rms_unit
    if shim.steps:
        moves = counted(len(shim.steps), "move")
        ranged = "" if shim.fields is None else " (95 %: {} to {})".format(
            *map(ppm, shim.fields[1].rms_range_ppm[::2]))
        said = (f"{what} expected to fall from {before} to {after} {unit}{ranged}, including the "
                "uncertainty.")
        if shim.result.disagreement:
            said = ("No block yet: model and map disagree. If the model were right, with "
                    f"{moves} {said}")
        elif _gained(shim) < LITTLE:
            said = (f"No block: with {moves} {said} That is {100 * _gained(shim):.2g} %, hardly "
                    "worth the work.")
        else:
            said = (f"With {moves} of blocks {said}{_first_moves(shim)}{_together(shim)}"
                    f"{_remainder(shim)}")
    else:
        said = ((f"No move is worthwhile{_of_possible(shim)}. Leave it as it is: "
                 if any(shim.tried.values()) else "No move was tried: ")
                + f"{what} {before} {unit}, including the uncertainty{_unknown_part(shim)}.")
    if shim.within is not None and shim.limit is not None:
        first, last = map(probability, shim.within)
        said += f" {aim.within(shim.limit)} with a probability of {first}"
        said += f" before and {last} after." if shim.steps else "."
        if shim.steps and shim.within[1] < LIKELY:
            said += " These moves do not reach that limit."
    ended = f"The search ended because {STOPS[shim.stop]}."
    if shim.result.disagreement:
        return Answer(question, said,
                      f"No. Model and measurement disagree. {shim.result.disagreement}",
                      "Find out what the study lacks before any block is moved.",
                      "halbach-fe diagnose STUDY --measurements MAP -o DIR", sound=False)
    if shim.fields is None and lacks_main(shim.before):
        return of_no_main(question, said, "Not in these units", "shim STUDY --measurements MAP",
                          shim.before)
    make = ("Make the moves in their order, measure again, and update study.shimmed.toml."
            if shim.shimmed_study else "Make the moves in their order, and measure again.")
    if shim.unsaid:
        make = (f"No {STUDY_FILE} is written: magnetization_factor of the study's exceptions of "
                "whole rings or slots is too small, or 0, for the blocks that come there. State it "
                "block by block (ring and slot), and shim again before any block is moved.")
    if shim.result.reservation and shim.steps:
        make = "Find out what it is, and update again, before any block is moved."
    elif _reason_against(shim):
        make = f"Leave the magnet as it is. If the gain is worth the work after all: {make}"
    mounted = "" if not shim.steps or shim.study.prior.mounting_sd_deg > 0 else (
        " That blocks are turned a little when they are mounted again is left out, as the study "
        "has no prior.mounting_sd_deg.")
    return Answer(
        question, said,
        f"{shim.result.reservation or 'Yes. Model and map agree.'} {ended}{mounted}", *(
            (make,
             f"halbach-fe shim STUDY --measurements MAP{at_z(shim.model)} -o DIR"
             if shim.unsaid else
             f"halbach-fe infer {'DIR/study.shimmed.toml' if shim.shimmed_study else 'STUDY'} "
             "--measurements NEW_MAP -o DIR") if shim.steps else
            (f"See the {aim.verb} of the magnet as it is.",
             f"halbach-fe {aim.verb} STUDY --posterior POSTERIOR -o DIR")),
        sound=not shim.result.reservation)


def _of_possible(shim: Shim) -> str:
    """Say how many moves there are in the magnet, of which kinds."""
    kinds = {"swap": "exchange", "cycle": "cycle", "turn": "turn", "replace": "replacement"}
    found = [counted(count, kinds[kind]) for kind, count in shim.tried.items() if count]
    return f": of {in_a_row(found)}, none gains more than its uncertainty" if found else ""


def _first_moves(shim: Shim) -> str:
    """Say how few of the moves make most of the gain, if not all of them are needed for that."""
    sizes = _sizes_by_move(shim)
    part = (sizes[0] - sizes) / (sizes[0] - sizes[-1])
    # part of the gain of all moves that the first of them make, which the answer names
    most = 0.9
    first = int(np.argmax(part >= most))
    if first == len(shim.steps):
        return ""
    return (f" The first {'one makes' if first == 1 else f'{first} make'} "
            f"{100 * part[first]:.0f}\u00a0% of that gain: stop after "
            f"{'it' if first == 1 else 'them'} if a move costs more than the rest is worth.")


def _together(shim: Shim) -> str:
    """Name the moves that gain only together, as the first of them alone would be a loss."""
    sizes = _sizes_by_move(shim)
    said, last = "", 0
    for first in np.flatnonzero(np.diff(sizes) > 0):
        less = sizes[first + 1:] < sizes[first]
        if first < last or not less.any():
            continue
        last = int(first) + 1 + int(np.argmax(less))
        moves = in_a_row([str(number) for number in range(first + 1, last + 1)])
        said += f" Moves {moves} gain only together: make all of them, or none."
    return said


def _remainder(shim: Shim) -> str:
    """Name the multipole that is most of what remains, if it is; the moves do not lower it."""
    if shim.fields is not None:
        return ""
    squares = shim.after.mean**2
    number = int(np.argmax(squares))
    if squares[number] < shim.after.expected_square / 2:
        return ""
    orders = shim.after.orders
    name = f"{'b' if number < len(orders) else 'a'}_{orders[number % len(orders)]}"
    return (f" What remains is mostly {name}, {shim.after.mean[number]:+.3g} units (before: "
            f"{shim.before.mean[number]:+.3g}).")


def _unknown_part(shim: Shim) -> str:
    """Say how much of the rms is uncertainty, if that is most of it; with its unit."""
    known = shim.before.rms_of_mean
    if known**2 > shim.before.rms**2 / 2:
        return ""
    aim = aim_of(shim.model)
    return (f", which is most of it: {aim.size(known)} {aim.unit} are known to be there. Measured "
            "blocks (--blocks) or a map at more places would tell more")


def page(shim: Shim) -> Page:
    """Return the page of moves of blocks.

    It has the study with the moves entered as exceptions, if blocks are moved and a study can
    describe these moves.
    """
    against = _reason_against(shim)
    move_title = "Moves that would be made" if against else "Moves"
    aim, moves = aim_of(shim.model), _move_table(shim)
    rows = aim.rows(_compared(shim, *(shim.fields or (shim.before, shim.after))))
    sections = [Section([_convention(shim), Table(rows, aim.table), linearized(shim.study)],
                        aim.title)]
    figures = {} if shim.fields else {"shim_multipoles.png": (
        partial(multipole_figure, _compared(shim, shim.before, shim.after), shim.limit),
        f"Unwanted multipoles{' before and after the moves' if shim.steps else ''}, normal (left) "
        "and skew (right); bars are two standard deviations")}
    if shim.steps:
        sections.insert(0, Section([
            Text(against, "warning"), _of_the_moves(shim), Table(moves)], move_title))
        figures |= {
            "shim_moves.png": (
                partial(_moves_figure, shim), f"{move_title}, with their numbers in the table"),
            "shim_gain.png": (
                partial(_gain_figure, shim), f"Root mean square of {aim.values} after each "
                "move, including the uncertainty")}
    shimmed, note = shim.shimmed_study, f"shimmed: {len(shim.steps)} moves"
    return Page("shim", "how to shim it", shim.study, answer(shim), _summary(shim), sections,
                {move_title: moves, aim.title: rows}, rows, figures, new_study=(
        None if shimmed is None else (STUDY_FILE, lambda: [(shimmed, note)])))


def _of_the_moves(shim: Shim) -> str:
    """Say in which order the moves are listed, and what their gain is."""
    mounting = shim.study.prior.mounting_sd_deg
    return (
        "The moves are listed in the order in which they were chosen; the gain is the expected "
        f"decrease of {aim_of(shim.model).squares}, in units "
        "of its own standard deviation (sd). The list ends before moves of less than 1; of those "
        "with 1, one in six turns out to gain nothing, of those with 2, one in forty. " + (
            "The rms after each is linearized about the field as it is; that of the table of the "
            "field is not. " if shim.fields is not None else "") + "A block is "
        "first moved to its new slot in the orientation of that slot, then turned about its own "
        "axes. " + (
            f"Mounting a block again turns it by a random angle with an sd of {mounting:.3g}° "
            "about each axis, which all uncertainties include." if mounting > 0 else
            "The study has no `prior.mounting_sd_deg`: blocks are assumed to be mounted again "
            "without angular errors."))


def _convention(shim: Shim) -> str:
    """Return sentences about the table of the page."""
    if isinstance(shim.model, DeviationModel):
        return (f"{SIZES} Ranges contain the uncertainty of the blocks after the update; after the "
                "moves also that of mounting and of replaced blocks.")
    known = _compared(shim, shim.before, shim.after)
    when = {name: f" {name}" if shim.steps else "" for name in known}
    main = ", ".join(f"{main_in_words(shim.model, each)}{when[name]}"
                     for name, each in known.items())
    roll = ", ".join(f"{with_unit(each.roll, each.roll_sd, 'mrad')}{when[name]}"
                     for name, each in known.items())
    return (f"{reference_text(shim.model, shim.study)} ± is the standard deviation, "
            f"including the error of the solver. Main multipole: {main}. It "
            f"is rotated about the z axis by {roll}.")


def _moves_figure(shim: Shim) -> Figure:
    """Draw the moves in the cross-section, or for several rings in a grid of rings and slots."""
    flat = len(shim.magnet.blocks_by_ring) == 1
    figure, axis = chart(6, 6, grid=False) if flat else chart(4.6, grid=False)
    if flat:
        draw_cross_section(axis, shim.magnet)
        where = 1e3 * np.array([block.middle[:2] for block in shim.magnet.blocks])
        axis.set(aspect="equal", xlabel="x in mm", ylabel="y in mm")
    else:
        where = np.array(shim.mounts.places, float)
        axis.plot(*where.T, ".", color="#cccccc", ms=3)
        axis.set(xlabel="ring", ylabel="slot")
        axis.margins(0.06, 0.12)
        for numbers in (axis.xaxis, axis.yaxis):
            numbers.set_major_locator(MaxNLocator(integer=True))
    for number, step in enumerate(shim.steps, start=1):
        slots = [placement.to for placement in step.move.placements]
        _draw_move(axis, where[slots], step, str(number))
    legend_above(figure, axis, columns=4)
    return figure


def _draw_move(axis: Axes, ends: Floats, step: Step, label: str) -> None:
    """Draw a move at the slots (1 to 3, 2) where its blocks go."""
    kind = step.move.kind
    if kind in ("swap", "cycle"):
        axis.plot(*ends.T, "o", color=POSTERIOR, ms=5, label=DRAWN_AS[kind])
        ways = list(zip(ends, np.roll(ends, -1, axis=0), strict=True))
        # Arcs, of which two in one ring are told apart; to the left, as numbers are at the right.
        for start, end in ways[:1] if kind == "swap" else ways:
            axis.annotate("", end, start, arrowprops={
                "arrowstyle": "-", "color": POSTERIOR, "lw": 1.2,
                "connectionstyle": f"arc3,rad={0.25 * np.sign(end[1] - start[1])}"})
    else:
        axis.plot(*ends.T, "o" if kind == "turn" else "s", mfc="none", ms=11, mew=1.8,
                  color=SECOND if kind == "turn" else PUBLISHED, label=DRAWN_AS[kind])
    for end in ends:
        axis.annotate(label, end, xytext=(6, 6), textcoords="offset points", fontsize=SMALL,
                      fontweight="bold")


def _gain_figure(shim: Shim) -> Figure:
    """Draw the rms of the values against the number of moves."""
    figure, axis = chart(3.4)
    sizes = _sizes_by_move(shim)
    axis.plot(sizes, "-o", color=POSTERIOR)
    axis.set(xlabel="moves", ylim=(0, 1.08 * max(sizes)), ylabel=aim_of(shim.model).label)
    axis.set_xticks(range(len(sizes)))
    return figure
