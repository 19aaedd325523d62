"""Page of `multipoles`, and the parts that other pages with multipoles share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from halbach_fe.api import MultipoleTables
from halbach_fe.core.arrays import Floats
from halbach_fe.core.numbers import in_a_row
from halbach_fe.geometry.array_layout import nominal_blocks
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.report.answer import Answer, agreement, of_a_conflict
from halbach_fe.report.page import (
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SECOND,
    Drawn,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    charts,
    csv_file,
    legend_above,
    linearized,
)
from halbach_fe.report.words import (
    best_known,
    capital,
    decimals,
    faults_in_words,
    probability,
    with_error,
    with_unit,
)
from halbach_fe.response.multipoles import (
    DEFAULT_ORDERS,
    MultipoleModel,
    Multipoles,
    met,
    plain,
    text_table,
)
from halbach_fe.study.model import Study, iron_of

MultipoleTable = tuple[MultipoleModel, Mapping[str, Multipoles]]
"""A reference (circle or integral along z), and the multipoles there of magnets by name."""

CONVENTION = "B_y + i B_x = sum (B_n + i A_n) ((x + i y) / R)^(n - 1); n = 1 is the dipole"

DRAWS = 10_000
"""Number of samples of the multipoles from which the probability of being within a limit is
estimated, with a standard error of 0.5 % at most."""

COLOURS = (PRIOR, POSTERIOR, SECOND)
MARKERS = ("o", "s", "^")


def reference_summary(model: MultipoleModel, limit: float | None) -> Plain:
    """Return the reference of multipoles as entries of a JSON file."""
    return {"radius_m": model.radius, "z_m": model.z, "integrated_along_z": model.integrated,
            "main_order": model.main, "orders": list(model.orders),
            "uniform_field_left_out_T": list(model.left_out_T),
            "axes_turned_by_rad": model.turn, "limit_units": limit,
            "nominal_main": model.nominal_main, "main_unit": model.unit}


def reference_text(model: MultipoleModel, study: Study, absolute: bool = False) -> str:
    """Return sentences that state the reference and the convention of multipoles, and which orders
    of the magnet as designed are higher than those of the table. ``absolute`` ones have no units
    of the main multipole.
    """
    units = (f"m{model.unit}, as there is no main multipole" if absolute else
             "units of 1e-4 of the main multipole")
    # M blocks make orders N + k M and, if circles are in short rings or materials answer, k M - N
    local = not model.integrated and model.z is not None
    answers = iron_of(study) is not None or any(
        block.is_permeable for block in nominal_blocks(study.array, study.dimension))
    own = [count + (-1 if local or answers else 1) * model.main
           for count in study.array.blocks_by_ring]
    # bodies of iron make any order
    higher = "" if study.array.free_blocks or study.iron or min(own) <= max(model.orders) else (
        f" The lowest unwanted order of rings as designed is {min(own)}, not in the table.")
    uniform = "" if not any(model.left_out_T) else (
        " The uniform field external.background_T is left out: its integral along all of z is "
        "infinite.")
    where = ("of the field integrated along z" if model.integrated
             else "of the cross-section" if model.z is None
             # the middle of a magnet is 0 to rounding
             else f"at z = {decimals(1e3 * model.z, 4)} mm (Fourier coefficients of B_r)")
    return (f"Multipoles {where}, at the reference radius of {1e3 * model.radius:.4g} mm, in "
            f"{units} (order {model.main}; European convention, order 1 is "
            "the dipole). b_n and a_n are the normal and the skew one of order n, in axes turned "
            "about z such that the main multipole of the nominal magnet is normal."
            f"{higher}{uniform}")


def multipole_figure(
    magnets: Mapping[str, Multipoles], limit: float | None, unit: str = "units of 1e-4",
) -> Figure:
    """Draw b_n and a_n of magnets by name, with error bars of two standard deviations."""
    figure, axes = charts(3.8, 1, 2, sharey=True)
    orders = next(iter(magnets.values())).orders
    place = np.arange(len(orders))
    # horizontal distance between the markers of different magnets at the same order
    shift = 0.18
    for letter, part, axis in zip("ba", (slice(len(orders)), slice(len(orders), None)), axes,
                                  strict=True):
        for number, (name, known) in enumerate(magnets.items()):
            axis.errorbar(place + shift * (number - (len(magnets) - 1) / 2), known.mean[part],
                          2 * known.sd[part], fmt=MARKERS[number], color=COLOURS[number], ms=5,
                          capsize=3, label=name or None)
        axis.axhline(0, color=PUBLISHED, lw=0.8)
        for sign in (-1, 1) if limit is not None else ():
            axis.axhline(sign * (limit or 0.0), color=PUBLISHED, lw=0.8, ls="--",
                         label="limit of |c_n|" if sign > 0 else None)
        axis.set_xticks(place, [f"{letter}$_{{{order}}}$" for order in orders])
    axes[0].set_ylabel(unit)
    if limit is not None or len(magnets) > 1 or "" not in magnets:
        legend_above(figure, axes[1], columns=4)
    return figure


def multipole_csv(study: Study, tables: Sequence[MultipoleTable]) -> Callable[[Path], None]:
    """Return how multipoles.csv is written, with a row per magnet, reference and order."""
    rows = [{"magnet": name, "where": _location(model), "radius_m": model.radius,
             "z_m": np.nan if model.z is None else model.z, "n": row["n"], "b_units": row["b"],
             "b_sd_units": row["b_sd"], "a_units": row["a"], "a_sd_units": row["a_sd"],
             "main": known.main, "main_sd": known.main_sd, "main_unit": model.unit}
            for model, magnets in tables for name, known in magnets.items()
            for row in known.table()]
    radii = dict.fromkeys(model.radius for model, _ in tables)
    return csv_file({key: [row[key] for row in rows] for key in rows[0]}, {
        "study": study.name, "convention": CONVENTION
        + "; local ones are the Fourier coefficients of B_r on the circle, sum A_n cos(n phi) "
        "+ B_n sin(n phi)" * any(_location(model) == "local" for model, _ in tables),
        "reference_radius_m": ", ".join(f"{radius:g}" for radius in radii),
        "units": f"1e-4 of the main multipole, of order {tables[0][0].main}, along axes in "
        "which the nominal one is normal",
        "axes_turned_by_rad": ", ".join(dict.fromkeys(
            f"{model.turn:.9g}" for model, _ in tables))})


def _location(model: MultipoleModel) -> str:
    """Return the name of the kind of reference."""
    return "integrated" if model.integrated else "cross-section" if model.z is None else "local"


def middle_circle(tables: Sequence[MultipoleTable], magnet: Magnet) -> MultipoleTable:
    """Return the circle nearest to the middle of the magnet, and of those the largest."""
    return min(tables, key=lambda table: (
        abs((table[0].z or 0.0) - magnet.middle_z_m), -table[0].radius))


def main_field_in_words(tables: Sequence[MultipoleTable], magnet: Magnet) -> str:
    """Say how strong the best known magnet's main multipole is; empty without tables.

    Of a dipole that is its field, of a quadrupole its gradient, of others the field at a radius. In
    2D they are those in the middle. In 3D they are those of the circle nearest to it: in a short
    magnet the harmonic of a circle changes with its radius otherwise than a multipole.
    """
    if not tables:
        return ""
    model, magnets = middle_circle(tables, magnet)
    _, known = best_known(magnets)
    circle = f"r = {1e3 * model.radius:.4g}\u00a0mm"
    local = model.z is not None
    where = "In the middle" if model.z is None else (
        f"On the circle {circle} at z = {decimals(1e3 * model.z, 4)}\u00a0mm")
    name, scale, unit = {
        1: ("dipole harmonic" if local else "dipole field", 1e3, "mT"),
        2: ("gradient, by the quadrupole harmonic," if local else "gradient", 1 / model.radius,
            "T/m")}.get(model.main, (f"main multipole, of order {model.main},", 1e3,
                                     "mT" if local else f"mT at {circle}"))
    size = (with_error(scale * known.main, scale * known.main_sd) if known.main_sd > 0
            else decimals(scale * known.main, 4))
    return f"{where} the {name} is {size}\u00a0{unit}."


def sections_of_circles(
    tables: Sequence[MultipoleTable], magnet: Magnet, origin: str, error: str,
    warning: Sequence[Text] = (),
) -> list[Section]:
    """Return what a page says of the multipoles of full circles; nothing without any.

    ``origin`` says of what circle they are, and ``error`` what their error bars are.
    """
    if not tables:
        return []
    model, magnets = middle_circle(tables, magnet)
    mains = "; ".join(f"{name} {main_in_words(model, known)}" for name, known in magnets.items())
    nearest = " and the z nearest to the middle" if magnet.dimension == 3 else ""
    others = "" if len(tables) == 1 else (
        f" multipoles.csv has all {len(tables)} circles, each in units of the main multipole at "
        f"its radius{nearest}.")
    return [Section([
        *warning, f"{reference_text(model, magnet.study)}{error} Main multipole: {mains}. {origin}"
        f"{others}", Table(text_table(**magnets), "numbers")], "Multipoles")]


def _summary(
    study: Study, tables: Sequence[MultipoleTable], limit: float | None
) -> Plain:
    """Return the content of multipoles.json."""
    return {"study": study.name, "tables": [
        {"reference": reference_summary(model, limit),
         **{name: plain(known, model.unit) | ({} if limit is None else {
             "probability_within_limit": _probability_within(known, limit)})
            for name, known in magnets.items()}} for model, magnets in tables]}


def _probability_within(known: Multipoles, limit: float) -> float:
    """Return the probability that all unwanted multipoles are within a limit in units."""
    normals = np.random.default_rng(1).standard_normal((DRAWS, 2 * len(known.orders)))
    return met(known.sizes_of(normals), limit)


def answer(
    tables: Sequence[MultipoleTable], limit: float | None, disagreement: str | None = None,
    study: Study | None = None, axis_beside: str = "",
) -> Answer:
    """Say how large the unwanted multipoles of the best known magnet are, and what to do next.

    ``study`` tells which blocks are not as designed, see `faults_in_words`, and for what blocks
    would be moved; ``axis_beside`` is that of the magnet.
    """
    measured = "posterior" in tables[0][1]
    said = " ".join(_largest(table, limit, alone=len(tables) == 1) for table in tables)
    question = "Which unwanted multipoles does the field have?"
    said += only_of_orders(tables[0][0])
    lacking = [lacks_main(best_known(magnets)[1]) for _, magnets in tables]
    if axis_beside:
        return Answer(question, said, "Only as those of the field about the z axis, which lies "
                      "beside the magnet.", axis_beside,
                      "halbach-fe multipoles STUDY -o DIR", sound=False)
    if all(lacking):
        return of_no_main(question, said, "Only as absolute numbers", "multipoles STUDY",
                          best_known(tables[0][1])[1])
    if any(lacking):
        said += " Where there is no main multipole, units of 1e-4 of it mean nothing."
    if not measured:
        return Answer(
            question, said, "Yes, for the magnet as ordered, not as it was built: ± is what the "
            "tolerances of its blocks (the study's prior) and the solver leave open.",
            "Measure it, update its blocks, and ask again with --posterior and the posterior.h5 of "
            "that update.",
            "halbach-fe infer STUDY --measurements MAP -o DIR")
    if disagreement:
        return of_a_conflict(question, said, disagreement)
    faults = "" if study is None else faults_in_words(study)
    main = tables[lacking.index(False)][0]  # the others are refused where blocks are moved
    options = at_z(main) if study is None or study.homogeneity is None else ""
    return Answer(
        question, said, f"{agreement(disagreement)} ± is what map, prior and solver leave open.",
        "If these multipoles are too large, "
        + (f"first put right in the magnet what is not as designed ({faults}), or "
           if faults else "") + "look for blocks to swap or to turn.",
        f"halbach-fe shim STUDY --measurements MAP{options} -o DIR")


def at_z(model: object) -> str:
    """Return the option by which another command asks for multipoles on the circle of a model;
    empty if they are integrated along z, of a cross-section, or if the model is of none.
    """
    if not isinstance(model, MultipoleModel) or model.z is None:
        return ""
    return f" --at-z-m {round(model.z, 9) + 0.0:g}"


def multipole_rows(magnets: Mapping[str, Multipoles]) -> Rows:
    """Return the rows of `text_table`, with |c_n| of the last magnet, which the answer states."""
    name, known = best_known(magnets)
    rows = text_table(**magnets)
    return [row | {f"|c_n| {name}": (
        "main" if "main" in row.values() else with_error(float(size), float(sd)))}
            for row, size, sd in zip(rows, known.sizes, _size_sd(known), strict=True)]


def _size_sd(known: Multipoles) -> Floats:
    """Return standard deviations (k,) of |c_n| in units.

    That of the part along the mean c_n where this is large, because the part across it only turns
    c_n; the rms of both parts where the mean is 0. The weights are the squares of mean and parts.
    """
    normal, skew = known.mean.reshape(2, -1)
    covariance = known.covariance + np.diag(known.error**2)
    (bb, ba), (_, aa) = covariance.reshape(2, len(normal), 2, -1).diagonal(axis1=1, axis2=3)
    along = normal**2 * bb + 2 * normal * skew * ba + skew**2 * aa  # times the mean's square
    total, square = bb + aa, known.sizes**2
    return np.asarray(np.sqrt((along + total**2 / 2)
                              / np.maximum(square + total, np.finfo(float).tiny)))


def of_no_main(
    question: str, said: str, trust: str, command: str, known: Multipoles
) -> Answer:
    """Return an answer in units of a main multipole that `lacks_main`; ``trust`` begins its trust.

    ``command`` is that of the answer, a verb of halbach-fe with its inputs. If one of the other
    multipoles is the magnet's, as of a quadrupole whose order the study does not state, the advice
    is to state it.
    """
    others = known.absolute
    largest = int(others.sizes.argmax())
    # Size of another multipole relative to the main one, and to its own standard deviation, from
    # which it is the magnet's: errors of blocks make all of them about as large.
    far_above_main, certain = 10.0, 5.0
    if others.sizes[largest] > max(far_above_main * 1e3 * known.main,
                                   certain * float(_size_sd(others)[largest])):
        order = known.orders[largest]
        return Answer(
            question, said, f"{trust}: the tables are in units of 1e-4 of a main multipole that "
            f"is not there, and so is any limit in such units. That of order {order} is far "
            "larger.", f"If this is a magnet of order {order}, state it in the study, "
            f"multipole_order = {order} below [array], and ask again.",
            f"halbach-fe {command} -o DIR", sound=False)
    return Answer(
        question, said, f"{trust}: the tables are in units of 1e-4 of a main multipole that "
        "cancels, as along an undulator, and so is any limit in such units.",
        "Ask on a circle where there is a main field: set Z to the middle of a pole.",
        f"halbach-fe {command} --at-z-m Z -o DIR", sound=False)


def only_of_orders(model: MultipoleModel) -> str:
    """Say of which orders multipoles are, if not of all that are given without being asked for."""
    if {*DEFAULT_ORDERS} - {model.main} <= {*model.orders}:
        return ""
    orders = in_a_row([str(order) for order in model.orders])
    if len(model.orders) == 1:
        return f" Only order {orders} was asked for."
    return f" Only orders {orders} were asked for."


def lacks_main(known: Multipoles) -> bool:
    """Tell whether the main multipole is 0 within its error, as of an undulator along its axis.

    Units of 1e-4 of it mean nothing then.
    """
    # Size of the main multipole, in its standard deviations, up to which there is none.
    main_from_sd = 3.0
    return known.main <= main_from_sd * known.main_sd


def _largest(table: MultipoleTable, limit: float | None, alone: bool) -> str:
    """Describe the last magnet of a table, which is the best known of them, in sentences."""
    model, magnets = table
    _, known = best_known(magnets)
    spread = _size_sd(known)
    worst = int(np.argmax(np.hypot(known.sizes, spread)))  # of nominal magnets all means are small
    sd = float(spread[worst])
    if lacks_main(known):
        others = known.absolute
        spread = _size_sd(others)
        worst = int(np.argmax(np.hypot(others.sizes, spread)))
        size, own = (1e3 * float(each[worst]) for each in (others.sizes, spread))
        return (f"{capital(place_of(model))}: there is no main multipole, of order "
                f"{model.main}, but for errors of the blocks, {main_in_words(model, known)}. "
                f"The largest other one, of order {known.orders[worst]}, is "
                f"{with_error(size, own)}\u00a0µ{model.unit} itself.")
    where = "" if alone else (
        "Of the field integrated along z, " if model.integrated else f"On {place_of(model)}, ")
    start = f"{where}the largest unwanted multipole " + (
        "is that" if known.sizes[worst] > sd else "is not known: it may be that")
    text = (f"{capital(start)} of order {known.orders[worst]} with "
            f"{with_error(float(known.sizes[worst]), sd)} units, which are 1e-4 of the main one, "
            f"{main_in_words(model, known)}.")
    if limit is not None:
        text += (f" All unwanted multipoles are within {limit:g} units with a probability of "
                 f"{probability(_probability_within(known, limit))}.")
    return text


def place_of(model: MultipoleModel) -> str:
    """Return the reference in words: a circle, or the field integrated along z."""
    if model.integrated:
        return f"the field integrated along z, at a radius of {1e3 * model.radius:.4g} mm"
    where = ("" if model.z is None  # the middle of a magnet is 0 to rounding
             else f" at z = {decimals(1e3 * model.z, 4)} mm")
    return f"the circle of {1e3 * model.radius:.4g} mm{where}"


def main_in_words(model: MultipoleModel, known: Multipoles) -> str:
    """Return the main multipole and its standard deviation in mT, or mT m if integrated."""
    return with_unit(known.main, known.main_sd, f"m{model.unit}")


def page(found: MultipoleTables) -> Page:
    """Return the page of the multipoles of a magnet."""
    study, sections = found.magnet.study, []
    figures: dict[str, tuple[Callable[[], Figure], str]] = {}
    tables: dict[str, Rows] = {}
    for model, magnets in found.tables:
        limit, unit, file = found.limit, "units of 1e-4", f"multipoles_{_location(model)}.png"
        if lacks := lacks_main(best_known(magnets)[1]):
            limit, unit = None, f"m{model.unit}"
            magnets = {name: known.absolute for name, known in magnets.items()}
        where = ("integrated along z" if model.integrated else
                 "of the cross-section" if model.z is None else f"on {place_of(model)}")
        rows = tables[f"Multipoles in {unit}, {where}"] = multipole_rows(magnets)
        sections.append(Section([
            f"{reference_text(model, study, lacks)} ± is the standard deviation, including the "
            "error of the solver; |c_n| is the size of b_n and a_n together.",
            Table(rows, "numbers"), Drawn(file)], _location(model).capitalize()))
        figures[file] = partial(multipole_figure, magnets, limit, unit), (
            "Unwanted multipoles, normal (left) and skew (right); bars are two standard deviations")
    return Page(
        "multipoles", "multipoles", study,
        answer(found.tables, found.limit, found.disagreement, study, found.magnet.axis_beside),
        _summary(study, found.tables, found.limit),
        [*sections, Section([*found.left_out, linearized(study)])], tables, figures=figures,
        shown=tuple(figures),
        files={"multipoles.csv": multipole_csv(study, found.tables)})
