"""Page of `design`: the study of a design, its table and figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from halbach_fe.design.ring_design import Designed, RingDesign
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report.answer import Answer
from halbach_fe.report.homogeneity_page import SIZES, slices_figure
from halbach_fe.report.page import (
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SMALL,
    Drawn,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    attributes,
    chart,
    csv_file,
    legend_above,
)
from halbach_fe.report.words import PERCENT_FROM, counted, in_a_row, ppm, relative

STUDY_FILE = "study.designed.toml"


def answer(found: Designed) -> Answer:
    """Say which rings are best, what a stronger design has, and what to do next."""
    best, region = found.best, found.region.text
    start = "" if found.reached else ("No design reaches what is asked. The one that misses it by "
                                      "least: ")
    text = [f"{start}{best.blocks} blocks in {_count(found.best)} make {1e3 * best.mean_T:.4g} mT "
            f"in {region}; |B| deviates from it by {ppm(best.rms_ppm)} ppm rms and "
            f"{ppm(best.peak_to_peak_ppm)} ppm peak to peak. They weigh {best.mass_kg:.3g} kg."]
    stronger = [one for one in found.front if one.mean_T > best.mean_T]
    if stronger:
        text.append("The next stronger design of the table makes "
                    f"{1e3 * stronger[0].mean_T:.4g} mT with "
                    f"{ppm(stronger[0].peak_to_peak_ppm)} ppm peak to peak.")
    if best.peak_to_peak_ppm > 1e6 * PERCENT_FROM:
        text.append(f"That varies by {relative(1e-6 * best.peak_to_peak_ppm)}: it is no "
                    "homogeneous field.")
    least, question = smallest(found), f"Which rings make a homogeneous field in {region}?"
    if beside := beside_the_rings(found):
        return Answer(
            question, " ".join(text), f"No. {beside}",
            "State a region between the rings: its middle by --centre-m, or as centre_m of "
            "[homogeneity] in the study. What these rings make elsewhere, homogeneity says.",
            "halbach-fe design STUDY -o DIR", sound=False)
    return Answer(
        question, " ".join(text),
        (f"Yes, as the design of the {least} that the search found, which does not prove that "
         "there is no better one. These are blocks as ordered: their tolerances leave more."
         f"{at_limits(found)}")
        if found.reached else "No. What was asked for is excluded by the limits of [design].",
        "See what the tolerances of the blocks leave of it." if found.reached else
        "Allow more mass, a lower field or more kinds of rings in [design], or a smaller region.",
        f"halbach-fe {'homogeneity DIR/' + STUDY_FILE if found.reached else 'design STUDY'} -o DIR",
        found.reached)


def beside_the_rings(found: Designed) -> str:
    """Say that the middle of the region is not within the rings, or nothing."""
    magnet = build_magnet(found.study)
    x, y, z = np.array(found.region.centre_m) - magnet.middle_m
    low, high = np.array(magnet.array_ends) - magnet.middle_z_m
    beyond, off = max(low - z, z - high), np.hypot(x, y) - magnet.free_radius
    if max(beyond, off) <= 0:
        return ""
    where = (f"{1e3 * beyond:.3g} mm beyond the end of the rings" if beyond > 0 else
             f"{1e3 * off:.3g} mm outside of the bore")
    return (f"The middle of the region is {where}: the numbers are those of the stray field there, "
            "and not of what rings are for.")


def at_limits(found: Designed) -> str:
    """Say which radii of the best design are the first or last that [design] allows, if any are."""
    assert found.study.design is not None
    layers, said = found.study.design.layer, []
    for number, layer in enumerate(layers):
        radii = [ring.radius_m for z, option in zip(
            found.best.z_m, found.best.rings, strict=True) if (ring := option[number]) is not None
            for _ in range(1 if z == 0 else 2)]
        of = f" of layer {number + 1}" if len(layers) > 1 else ""
        for word, end in (("smallest", min(layer.radii_m)), ("largest", max(layer.radii_m))):
            count = int(np.isclose(radii, end).sum())
            if count and len(layer.radii_m) > 1:
                said.append(f"{counted(count, 'ring has', 'rings have')} the {word} "
                            f"radius{of} that [design] allows, {1e3 * end:.6g}\u00a0mm")
    return f" {in_a_row(said)}: radii beyond that may be better." if said else ""


def smallest(found: Designed) -> str:
    """Return in words what makes a design the best one: the objective of the study's [design]."""
    rms = found.study.design is not None and found.study.design.objective == "rms"
    return "smallest rms" if rms else "smallest peak to peak"


def _count(design: RingDesign) -> str:
    """Return the number of rings in words."""
    rings = sum((1 if z == 0 else 2) * sum(ring is not None for ring in option)
                for z, option in zip(design.z_m, design.rings, strict=True))
    return counted(rings, "ring")


def _design_rows(found: Designed) -> Rows:
    """Return a row of text for every design, by its field."""
    return [{
        "design": f"best: {smallest(found)}" if one is found.best else "",
        "mean field": f"{1e3 * one.mean_T:.5g} mT",
        "peak to peak in ppm": ppm(one.peak_to_peak_ppm), "rms in ppm": ppm(one.rms_ppm),
        "blocks": str(one.blocks), "mass": f"{one.mass_kg:.4g} kg"} for one in found.front]


def _ring_rows(found: Designed) -> Rows:
    """Return a row of text for every place of the best design, from the middle upwards."""
    best = found.best
    rows = []
    for z, option in zip(best.z_m, best.rings, strict=True):
        row = {"z": f"{'±' if z else ''}{1e3 * z:.4g} mm"}
        for layer, ring in enumerate(option, start=1):
            name = f"layer {layer}" if len(option) > 1 else "ring"
            row[name] = "empty" if ring is None else (
                f"{ring.blocks} blocks of {1e3 * ring.size_m:.4g} mm at {1e3 * ring.radius_m:.6g} "
                "mm")
        rows.append(row)
    return rows


def _summary(found: Designed) -> Plain:
    """Return the content of design.json."""
    def plain(one: RingDesign) -> Plain:
        places = [{"z_m": float(z), "rings": [ring and asdict(ring) for ring in option]}
                  for z, option in zip(one.z_m, one.rings, strict=True)]
        return {**attributes(one, "mean_T", "rms_ppm", "peak_to_peak_ppm", "mass_kg", "blocks"),
                "places": places}

    return {"study": found.study.name, "region": asdict(found.region), "reached": found.reached,
            "best": plain(found.best), "designs": [plain(one) for one in found.front]}


def _columns(found: Designed) -> dict[str, Iterable[object]]:
    """Return the columns of rings.csv, with a row for every ring."""
    rings = found.study.array.ring
    return {"ring": range(1, len(rings) + 1),
            **{name: [getattr(ring, name) for ring in rings] for name in (
                "z_m", "inner_radius_m", "outer_radius_m", "ring_length_m", "blocks_per_ring")}}


def front_figure(found: Designed) -> Figure:
    """Draw the deviation of all designs over their field."""
    figure, axis = chart(3.6)
    field = [1e3 * one.mean_T for one in found.front]
    axis.plot(field, [one.peak_to_peak_ppm for one in found.front], "o-", color=PRIOR,
              label="peak to peak")
    axis.plot(field, [one.rms_ppm for one in found.front], "s--", color=PUBLISHED, label="rms")
    axis.plot(1e3 * found.best.mean_T, found.best.peak_to_peak_ppm, "o", ms=11, color=POSTERIOR,
              label=f"the best design ({smallest(found)})")
    axis.set(xlabel="mean field in mT", ylabel="deviation in ppm", yscale="log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))  # others would touch each other
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: ppm(value)))
    axis.yaxis.set_minor_formatter(NullFormatter())
    legend_above(figure, axis, columns=3)
    return figure


def side_figure(found: Designed) -> Figure:
    """Draw the rings of the best design from the side, and the region."""
    rings = found.study.array.ring
    length = max(ring.z_m or 0.0 for ring in rings) - min(ring.z_m or 0.0 for ring in rings)
    shape = length / max(ring.outer_radius_m or length for ring in rings)
    figure, axis = chart(3.6, max(1.5 + 3.0 * shape, 5.0), grid=False)
    for ring in rings:
        assert ring.z_m is not None  # those of a design are not stacked
        assert ring.ring_length_m is not None
        assert ring.inner_radius_m is not None
        assert ring.outer_radius_m is not None
        axis.add_patch(Rectangle(
            (1e3 * (ring.z_m - ring.ring_length_m / 2), 1e3 * ring.inner_radius_m),
            1e3 * ring.ring_length_m, 1e3 * (ring.outer_radius_m - ring.inner_radius_m),
            facecolor=PRIOR, edgecolor="white"))
        axis.annotate(str(ring.blocks_per_ring), (1e3 * ring.z_m, 1e3 * ring.outer_radius_m),
                      ha="center", va="bottom", fontsize=SMALL)
    centre, half = found.region.centre_m, found.region.half_axes_m
    t = np.linspace(0, np.pi, 91)
    if found.region.shape == "cylinder":
        z, r = np.array([-1, -1, 1, 1]), np.array([0, 1, 1, 0])
    else:
        z, r = np.cos(t), np.sin(t)
    axis.fill(1e3 * (centre[2] + half[2] * z), 1e3 * half[0] * r, color=POSTERIOR, alpha=0.2,
              label=f"region: {found.region.text}")
    axis.set(xlabel="z in mm", ylabel="radius in mm")
    axis.autoscale_view()
    axis.set_ylim(0, 1.08 * axis.get_ylim()[1])  # with room for the numbers
    axis.set_aspect("equal")
    figure.legend(loc="outside upper center", frameon=False)
    return figure


def page(found: Designed) -> Page:
    """Return the page of a search for rings, with the study of the best design."""
    settings, best, rows, rings = (
        found.study.design, smallest(found), _design_rows(found), _ring_rows(found))
    between = ("" if settings is None or not settings.between_radii else
               " Only the best design has radii between those that the study lists.")
    return Page("design", "design", found.study, answer(found), _summary(found), [
        Section([Text("The designed rings take the place of the array of the study.", "small"),
                 Drawn("slices.png")]),
        Section([
            Drawn("front.png"), Table(rows),
            f"{SIZES} The search itself works for the component along the main field, which "
            "differs from |B| by the components across it, to second order. Each row has the "
            f"{best} that the search found for its field, and the best design has it of all; a "
            f"local search does not prove that there is no better one.{between}"],
            "All designs, by their field"),
        Section([Table(rings), "Radii are those of the blocks' middles. Places at z and \u2212z "
                 "hold equal rings."], f"The rings of the best design ({best})")],
        {f"Designs, by their field in {found.region.text}": rows,
         "The rings of the best design": rings},
        figures={
            "rings.png": (
                partial(side_figure, found), f"The rings of the best design ({best}) from the "
                "side, with their numbers of blocks, and the region whose field is to be "
                "homogeneous"),
            "slices.png": (
                partial(slices_figure, found.slices, found.best.mean_T),
                "Deviation of |B| from its mean, in planes through the region's centre"),
            "front.png": (
                partial(front_figure, found), "What more field costs: designs of larger fields")},
        files={"rings.csv": csv_file(_columns(found), {"study": found.study.name})},
        new_study=(STUDY_FILE, lambda: [(found.study, "found by halbach-fe design")]))
