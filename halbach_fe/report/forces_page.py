"""Page of `forces`: those on the blocks of a magnet."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.design.forces import Forces, Loads
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.outline import along_edges, at_heights
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    LISTED,
    MEASURED,
    POSTERIOR,
    PRIOR,
    SMALL,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    columns_by_axis,
    csv_file,
    figure_of,
)
from halbach_fe.report.words import counted, decimals, in_a_row, place_of, with_unit
from halbach_fe.study.types import COMPONENTS

NEGLIGIBLE = 1e-9
"""Forces in N below which there is none."""


def answer(found: Forces) -> Answer:
    """Say how large the forces are in place and during the assembly, and what to do next."""
    question = "Which forces act on the blocks?"
    hot = "" if found.magnet.study.demagnetization is not None else (
        ": put a table [demagnetization] with temperature_C into the study")
    plan = (f"Plan tools and glue for these forces; see what heat does to the blocks{hot}.",
            "halbach-fe demagnetization STUDY -o DIR")
    worst = int(np.argmax(found.in_place.magnitude))
    size = found.in_place.magnitude[worst]
    if size < NEGLIGIBLE:
        return Answer(question, f"No block feels a force. {_mass(found)}",
                      "Yes: nothing else is there.", *plan)
    block = found.blocks[worst]
    text = ["In the finished magnet the largest force is "
            f"{_newton(size)} (as heavy as {_heavy(size)}), on "
            f"{place_of(block)}, {direction_in_words(block, found.in_place.force_N[worst])}."
            f"{_as_large(found, worst)}"]
    if len(found.blocks) > 1:
        next_one = int(np.argmax(found.inserted.magnitude))
        inserted, block = found.inserted.magnitude[next_one], found.blocks[next_one]
        text.append(
            "While it is assembled block by block, the largest is on "
            f"{place_of(block)}, the {_ordinal(int(found.step[next_one]))} of {len(found.blocks)}, "
            f"when it has come to its place: {_newton(inserted)} ({_heavy(inserted)}), "
            f"{direction_in_words(block, found.inserted.force_N[next_one])}.")
    error = float(found.in_place.error_N[worst])
    # error of a force, relative to it, above which the answer is not to be trusted
    rough = 0.1
    integration = f"integration {'with the mesh of the iron' if found.magnet.iron else 'itself'}"
    return Answer(
        question, " ".join([*text, *_on_rings(found), _mass(found)]),
        "Yes, for the blocks of the study, at rest in their places: a block that is 1 % stronger "
        "feels 1 % more, and one that comes nearer to its neighbours than its place is may feel "
        f"more. The {integration} is right to {_newton(error)}.", *plan,
        sound=error <= rough * size, numbers=(("largest force in place", _newton(size)),))


def _on_rings(found: Forces) -> list[str]:
    """Say which force the blocks of a ring feel together: what holds the rings has to bear it."""
    # Part of the largest force on a block below which a ring as a whole feels none worth a word: a
    # block's own force is not known better, as its strength is not.
    whole_ring = 0.01
    rings = np.array([block.ring for block in found.blocks])
    together = {ring: found.in_place.force_N[rings == ring].sum(axis=0)
                for ring in np.unique(rings).tolist()}
    ring, force = max(together.items(), key=lambda each: float(np.linalg.norm(each[1])))
    size = float(np.linalg.norm(force))
    if len(together) < 2 or size < whole_ring * found.in_place.magnitude.max():
        return []
    return [f"Together the blocks of ring {ring} are pushed by {_newton(size)} "
            f"({_heavy(size)}) along {_numbers(force / size)}: what holds the rings has to bear "
            "that."]


def _numbers(unit: Floats) -> str:
    """Return the components of a unit vector (3,) as text."""
    return "(x, y, z: {})".format(", ".join(
        f"{value:+.2f}" for value in unit.round(2) + 0.0).replace("-", "−"))


def _as_large(found: Forces, worst: int) -> str:
    """Name the other blocks whose force is as large as that of the block ``worst``, by symmetry."""
    size = found.in_place.magnitude
    slots: dict[int, list[str]] = {}
    labels: list[str] = []
    # part of the largest force by which others may be smaller that are as large for who assembles
    equal = 1e-3
    for number in np.flatnonzero(size >= (1 - equal) * size[worst]).tolist():
        block = found.blocks[number]
        if number != worst and block.label:
            labels.append(block.label)
        elif number != worst:
            slots.setdefault(block.ring, []).append(str(block.slot))
    count = len(labels) + sum(map(len, slots.values()))
    if not count:
        return ""
    places = {f"ring {ring}, slot": own for ring, own in slots.items()}
    named = "; ".join(f"{noun}{'s' if len(own) > 1 else ''} {in_a_row(own)}"
                      for noun, own in (places | {"block": labels}).items() if own)
    return (f" It is as large on {counted(count, 'other block')}"
            f"{f': {named}' if count < LISTED else ''}.")


def _mass(found: Forces) -> str:
    """Return mass and price of all blocks in words."""
    words = f"The blocks weigh {found.mass_kg.sum():.4g} kg"
    return words + ("." if found.cost is None else f" and cost {found.cost:.4g} in the currency "
                    f"of the price, at {found.price_per_kg:g} per kg.")


def _newton(size: float) -> str:
    """Return a force as text, without an exponent."""
    return f"{size:.0f}\u00a0N" if size >= 100 else f"{decimals(size)}\u00a0N"


def _heavy(size: float) -> str:
    """Return the mass whose weight a force in N is."""
    mass = size / 9.80665  # standard gravity in m/s^2
    value, unit = (mass, "kg") if mass >= 1 else (1e3 * mass, "g")
    return f"{value:.0f} {unit}" if value >= 10 else f"{value:.2g} {unit}"


def _ordinal(number: int) -> str:
    """Return 1st, 2nd, 3rd and so on."""
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(
        number % 10, "th")
    return f"{number}{ending}"


def direction_in_words(block: MagnetBlock, vector: Floats) -> str:
    """Return the direction of a vector (3,) seen from the magnet's axis, and its unit vector."""
    main = 0.9  # component of a direction beyond which a direction in words has no other part
    unit = vector / np.linalg.norm(vector)
    x, y, _ = block.middle
    radius = float(np.hypot(x, y))
    radial = np.array([x, y, 0.0]) / radius if radius else np.array([1.0, 0.0, 0.0])
    azimuthal = np.array([-radial[1], radial[0], 0.0])
    parts = sorted([(float(unit @ radial), "away from the axis", "towards the axis"),
                    (float(unit @ azimuthal), "counter-clockwise", "clockwise"),
                    (float(unit[2]), "along +z", "along −z")], key=lambda part: -abs(part[0]))
    if not radius:
        parts = sorted(((float(unit[k]), f"along +{name}", f"along −{name}")
                        for k, name in enumerate(COMPONENTS)), key=lambda part: -abs(part[0]))
    words = [plus if size > 0 else minus for size, plus, minus in parts]
    text = words[0] if abs(parts[0][0]) > main else f"{words[0]} and {words[1]}"
    return f"{text} {_numbers(unit)}"


def _rows(found: Forces) -> Rows:
    """Return a row of text for each of the largest forces in place."""
    rows = []
    for number in np.argsort(-found.in_place.magnitude, kind="stable")[:LISTED]:
        block, size = found.blocks[number], found.in_place.magnitude[number]
        rows.append({
            "block": place_of(block),
            "force": with_unit(size, float(found.in_place.error_N[number]), "N"),
            "direction": (direction_in_words(block, found.in_place.force_N[number])
                          if size > NEGLIGIBLE else "none"),
            "torque": decimals(float(np.linalg.norm(found.in_place.torque_Nm[number])))
            + "\u00a0Nm",
            "as it is inserted": _newton(float(found.inserted.magnitude[number])),
            "inserted as the": _ordinal(int(found.step[number]))})
    return rows


def _iron_rows(found: Forces) -> Rows:
    """Return a row of text for the force on each body of iron."""
    if found.iron is None:
        return []
    sizes = np.linalg.norm(found.iron.force_N, axis=1)
    return [{"iron": name, "force": with_unit(size, error, "N"),
             "direction (x, y, z)": _numbers(force / size) if size > error else "none that is sure"}
            for name, force, size, error in zip(
                found.iron.names, found.iron.force_N, sizes.tolist(),
                found.iron.error_N.tolist(), strict=True)]


def _on_iron(found: Forces) -> Section:
    """Return the section about the forces on the iron; empty without iron."""
    rows = _iron_rows(found)
    if found.magnet.iron and not rows:
        return Section(["The forces on the iron are not computed beside `external.dipoles` and "
                        "`external.neighbours`."], "Forces on the iron")
    return Section([
        Table(rows),
        "What blocks, coils and the other bodies of iron do to each body in the finished magnet: "
        "what holds it has to bear that. Bodies that touch, or that no plane separates, have one "
        "force together. ± is the change from a coarser mesh of the iron, and from longer pieces "
        "of coils."], "Forces on the iron",
        about=rows)


def _summary(found: Forces) -> Plain:
    """Return the content of forces.json."""
    def largest(loads: Loads) -> Plain:
        number = int(np.argmax(loads.magnitude))
        return {"block": found.blocks[number].name, "size_N": float(loads.magnitude[number]),
                "error_N": float(loads.error_N[number]),
                "force_N": loads.force_N[number].tolist(),
                "torque_Nm": loads.torque_Nm[number].tolist(),
                "error_Nm": float(loads.error_Nm[number])}

    return {
        "study": found.magnet.name, "blocks": len(found.blocks),
        "largest_in_place": largest(found.in_place), "largest_inserted": largest(found.inserted),
        "imbalance_N": found.imbalance_N, "mass_kg": float(found.mass_kg.sum()),
        "price_per_kg": found.price_per_kg, "cost": found.cost} | (
        {} if found.iron is None else {"iron": [
            {"name": name, "force_N": force, "error_N": error} for name, force, error in zip(
                found.iron.names, found.iron.force_N.tolist(), found.iron.error_N.tolist(),
                strict=True)]})


def _columns(found: Forces) -> dict[str, Iterable[object]]:
    """Return the columns of forces.csv."""
    columns: dict[str, Iterable[object]] = {
        "block": [block.name for block in found.blocks],
        "ring": [block.ring for block in found.blocks],
        "slot": [block.slot for block in found.blocks], "step": found.step,
        "mass_kg": found.mass_kg}
    for prefix, loads in (("", found.in_place), ("inserted_", found.inserted)):
        columns |= {**columns_by_axis(f"{prefix}F{{}}_N", loads.force_N),
                    f"{prefix}error_N": loads.error_N,
                    **columns_by_axis(f"{prefix}T{{}}_Nm", loads.torque_Nm),
                    f"{prefix}error_Nm": loads.error_Nm}
    return columns


def _drawn_ring(found: Forces) -> list[int]:
    """Return the indices of the blocks of the ring with the largest force."""
    ring = found.blocks[int(np.argmax(found.in_place.magnitude))].ring
    return [number for number, block in enumerate(found.blocks) if block.ring == ring]


def _is_numbered(found: Forces) -> bool:
    """Tell whether the blocks of the ring that is drawn have their numbers."""
    # largest number of blocks of a ring that have their numbers in the figure
    most_numbered = 48
    return len(_drawn_ring(found)) <= most_numbered


def forces_figure(found: Forces) -> Figure:
    """Draw the ring with the largest force, and the forces by the order of insertion."""
    figure = figure_of(8.8)
    above, below = figure.subplots(2, 1, height_ratios=(2, 1))
    _draw_ring(above, found)
    order = found.order
    step = np.arange(1, len(order) + 1)
    below.plot(step, found.in_place.magnitude[order], "o", ms=4, color=PRIOR,
               label="with all others in place")
    below.plot(step, found.inserted.magnitude[order], "-", lw=1, color=POSTERIOR,
               label="as the next one to be inserted")
    below.set(xlabel="step of the assembly", ylabel="force in N", ylim=(0, None))
    below.grid(alpha=0.3)
    below.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    return figure


def round_below(size: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that a number reaches."""
    power = 10.0 ** np.floor(np.log10(size))
    return float(max(step * power for step in (1, 2, 5) if step * power <= size))


def _draw_ring(axis: Axes, found: Forces) -> None:
    """Draw the blocks of the ring with the largest force, coloured, with arrows of their forces."""
    size = found.in_place.magnitude
    chosen = _drawn_ring(found)
    corners = [1e3 * block.from_frame(at_heights(
        along_edges(block.outline, 9), (block.z_min + block.z_max) / 2))[:, :2]
        for block in (found.blocks[number] for number in chosen)]
    colours = Normalize(0, float(size[chosen].max()) or 1.0)
    if _is_numbered(found):
        outside = 1.1 * max(float(np.hypot(*corner.T).max()) for corner in corners)
        for number in chosen:
            block, (x, y, _) = found.blocks[number], found.blocks[number].middle
            if radius := float(np.hypot(x, y)):
                axis.text(outside * x / radius, outside * y / radius, str(block.slot),
                          ha="center", va="center", fontsize=SMALL)
    axis.add_collection(PolyCollection(
        corners, array=size[chosen], cmap="Blues", norm=colours, edgecolor="#777777", lw=0.6))
    middles = np.array([corner.mean(axis=0) for corner in corners])
    extent, largest = float(np.abs(np.vstack(corners)).max()), float(size[chosen].max())
    flat = found.in_place.force_N[chosen, :2]
    # part of the largest force from which its part in the plane is drawn: less cannot be seen
    seen = 0.02
    if np.linalg.norm(flat, axis=1).max() > max(NEGLIGIBLE, seen * largest):
        # as long as the whole force: where forces are along z, arrows are short
        per_newton = 0.3 * extent / largest
        drawn = axis.quiver(*middles.T, *(per_newton * flat.T), angles="xy", scale_units="xy",
                            scale=1, color=PRIOR, width=0.005, edgecolor=MEASURED, lw=0.3)
        shown = round_below(largest)
        axis.quiverkey(drawn, 0.2, 0.04, per_newton * shown, _newton(shown), labelpos="E",
                       coordinates="axes", fontproperties={"size": SMALL})
    axis.figure.colorbar(ScalarMappable(colours, "Blues"), ax=axis, label="force in N",
                         location="bottom", shrink=0.6)
    reach = 1.3 * extent
    axis.set(aspect="equal", xlabel="x in mm", ylabel="y in mm", xlim=(-reach, reach),
             ylim=(-reach, reach), title=f"ring {found.blocks[chosen[0]].ring}")


def page(found: Forces) -> Page:
    """Return the page of the forces on the blocks."""
    iron, rows = bool(found.magnet.iron), _rows(found)
    permeable = "" if found.magnet.is_vacuum else (
        "Every block has the mean of the polarization that its permeability gives it in the "
        "finished magnet; how it varies inside the block is left out.")
    return Page(
        "forces", "forces on the blocks", found.magnet.study, answer(found), _summary(found), [
            Section([
                Table(rows),
                f"Forces are those of the field of all other blocks{', of the iron' * iron} and of "
                "external sources on a block; torques are about its centre of mass. ± is the error "
                "of the quadrature"
                f"{' and the change from a coarser mesh of the iron' * iron}. The last two columns "
                "are the force on the block when it is inserted, with only the blocks "
                "before it in place, and its place in that order"
                f"{'; the iron is not there yet' * iron}. The forces of all blocks on each other "
                f"add up to {_newton(found.imbalance_N)}; Newton's third law makes it zero.",
                permeable], "The largest forces in place"), _on_iron(found)],
        {"Largest forces in place": rows} | (
            {"Forces on the iron": _iron_rows(found)} if found.iron else {}),
        figures={"forces.png": (
            partial(forces_figure, found), "Above: forces in place in the ring of the largest one; "
            "arrows show their part in the plane"
            f"{', numbers are slots' if _is_numbered(found) else ''}. Below: forces in the order "
            "of the assembly")},
        files={"forces.csv": csv_file(_columns(found), {"study": found.magnet.name})})
