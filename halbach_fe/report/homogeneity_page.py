"""Page of `homogeneity`, and what pages say of the field outside of the magnet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse, Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from halbach_fe.api import HomogeneityResult
from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.core.numbers import in_a_row
from halbach_fe.design.ring_catalogue import obstacle
from halbach_fe.inference.map_homogeneity import HELD_OUT_PART, POOR
from halbach_fe.report.answer import Answer, agreement, of_a_conflict
from halbach_fe.report.page import (
    LISTED,
    POSTERIOR,
    PUBLISHED,
    SECOND,
    SMALL,
    Drawn,
    Figures,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    chart,
    csv_file,
    figure_of,
)
from halbach_fe.report.words import best_known, decimals, flux_density, ppm, with_error, with_unit
from halbach_fe.response.homogeneity import PPM, Homogeneity, HomogeneityModel, Slice
from halbach_fe.response.region import default_centre
from halbach_fe.response.stray_field import NEAREST, StrayField

CONVENTION = (
    "B_n = sum (r/R)^l P_lm(cos theta) (a_lm cos(m phi) + b_lm sin(m phi)) about the centre, B_n "
    "along the mean field, theta from the z axis, R the sphere's radius, P_lm semi-normalized "
    "(Schmidt) without the phase (-1)^m")

SIZES = ("Deviations are those of |B| from its mean over the volume; the rms is over the volume, "
         "peak to peak over all points of surface and volume. Errors of blocks add to both, so "
         "that the nominal magnet may have less than all that are likely.")

MAP_ROWS = ("Those of the map are of a fit of its readings by solid harmonics, without "
            "any magnet; the held-out part are readings that do not update the magnet.")

ROUNDING = 1e-9
"""Size below which a harmonic is zero but for rounding, relative to the largest one."""

LEAST_OF_SD = 5e-3
"""Part of its standard deviation below which a number is 0 in tables."""

DRAWN = 24
"""Number of the harmonics in the figure: the largest ones, with names that can be read."""


def answer(found: HomogeneityResult) -> Answer:
    """Say how homogeneous the field of the best known magnet is, and what to do next."""
    # Deviation in ppm rms from which a tray of small magnets is not advised: 64 cubes of 4 mm in a
    # magnet of 80 cubes of 12 mm took 6600 ppm away, of 77000.
    too_large_for_a_tray = 1e4
    name, best = best_known(found.by_name)
    question = f"How homogeneous is the field in {found.model.region.text}?"
    low, middle, high = map(ppm, best.rms_range_ppm)
    likely = "" if name == "prior" or _cancels(best) or found.disagreement else (
        f" (95 %: {low} to {high})")
    text = (f"The mean of |B| is {_field(best)}; |B| deviates from it by {ppm(best.rms_ppm)} ppm "
            f"rms{likely} and {ppm(best.peak_to_peak_ppm)} ppm peak to peak")
    if name == "prior" and not _cancels(best):
        text += " if all blocks are as ordered"
    text += _of_map(found)
    if _cancels(best):
        region = found.model.region
        x, y, z = region.centre_m
        reach = region.half_axes_m[2]
        step = ("See its multipoles.", "halbach-fe multipoles STUDY -o DIR")
        if found.magnet.study.array.multipole_order == 1:  # a dipole whose main multipole is none
            step = ("See the field on a line through the region.", "halbach-fe field STUDY "
                    f"--from-m {x:g} {y:g} {z - reach:g} --to-m {x:g} {y:g} {z + reach:g} -o DIR")
        return Answer(
            question, f"{text}.", "Only as a property of |B|: the mean of the vector B over this "
            "region is 0 but for errors of the blocks, as in a multipole.", *step, sound=False)
    trust, small = solver_error_text(found.model, best.rms_ppm)
    numbers = (("mean field", flux_density(best.mean_T, 4)),
               ("rms deviation", f"{ppm(best.rms_ppm)}\u00a0ppm"))
    if name != "prior" and found.disagreement:
        return of_a_conflict(question, f"{text}.", found.disagreement)
    step = ("If that is too much, put [shim_tray] into the study and fill the tray with small "
            "magnets.", "halbach-fe shim-tray STUDY --posterior POSTERIOR -o DIR")
    reason = agreement(found.disagreement)
    if name == "prior":
        step = ("Measure it, and update its blocks with the map; then ask again with --posterior "
                "and the posterior.h5 that this command writes into its DIR:",
                "halbach-fe infer STUDY --measurements MAP -o DIR")
        text += (f". Of magnets whose blocks vary as the study says, half have more than {middle} "
                 f"ppm rms, and 95 % have {low} to {high} ppm")
        reason = "Yes, as far as the study's tolerances are right: it is no measured magnet."
    if best.rms_ppm > too_large_for_a_tray:
        step = _better_design(found, best.rms_ppm)
    return Answer(question, f"{text}.", f"{reason} {trust}", *step, small, numbers=numbers)


def _better_design(found: HomogeneityResult, rms_ppm: float) -> tuple[str, str]:
    """Say what to do about the deviation of a magnet as designed, and the command for it."""
    study, (x, y, z) = found.magnet.study, found.model.region.centre_m
    part = f"A deviation of {decimals(1e-4 * rms_ppm, 2)} % is that of the "
    tray = "Small magnets in a tray cannot make up for it."
    if obstacle(study) is not None:  # halbach-fe design would refuse this magnet
        there = ("" if (x, y, z) == default_centre(found.magnet) else
                 f" --centre-m {x:g} {y:g} {z:g}")
        return (f"{part}magnet as designed, not of its errors: move its blocks, or look at a "
                f"smaller region: set R, its radius. {tray}",
                f"halbach-fe homogeneity STUDY --sphere-m R{there} -o DIR")
    stated = "" if study.design is not None else ", by a table [design] in the study"
    return (f"{part}rings, not of their errors: look for better rings{stated}, or for a smaller "
            f"region. {tray}", "halbach-fe design STUDY -o DIR")


def _of_map(found: HomogeneityResult) -> str:
    """Say what the map itself has, of readings that did not update the magnet if there are some."""
    remarks = "".join(f". {remark.rstrip('.')}" for remark in _map_remarks(found))
    if not found.of_map or found.map_misfit > POOR:
        return remarks
    name, known = best_known(found.of_map)
    low, _, high = map(ppm, known.rms_range_ppm)
    return (f"; a fit to the {'held-out ' if name == HELD_OUT_PART else ''}readings alone has "
            f"{ppm(known.rms_ppm)} ppm rms (95 %: {low} to {high}){remarks}")


def _map_remarks(found: HomogeneityResult) -> list[str]:
    """Return sentences: what the map does not tell, and that its fit cannot be relied on."""
    return [*found.map_remarks, *[
        f"The fit of the map finds {found.map_misfit:.2g} times the stated noise: its readings "
        "are too far apart for the field between them, or noisier than stated. What the map "
        "itself has is uncertain beyond its error bars."
    ] * bool(found.of_map and found.map_misfit > POOR)]


def solver_error_text(model: HomogeneityModel, rms_ppm: float) -> tuple[str, bool]:
    """Return a sentence about the solver's error beside an rms deviation, and if it is smaller."""
    error = model.solver_error_ppm
    small = error <= rms_ppm
    doubt = f" {model.sampling.doubt}".rstrip()
    return ("The field of given blocks is exact: no mesh is needed." if not error else
            f"The solver's own error, {ppm(error)} ppm rms, is {'' if small else 'not '}below "
            f"the deviation of {ppm(rms_ppm)}.") + doubt, small


def _known_as(name: str) -> str:
    """Return words for the mean of a distribution of the magnetizations."""
    return {"prior": "of the magnet as ordered", "posterior": "of the measured magnet"}.get(
        name, f"of the {name}")


def _field(known: Homogeneity) -> str:
    """Return mean field and standard deviation as text, in mT."""
    return with_unit(known.mean_T, known.mean_sd_T, "mT")


def direction_in_words(unit: Floats, sd_rad: float) -> str:
    """Return the axis next to a unit vector (3,), and its angle from that axis, which is left out
    if it is 0 beside its standard deviation.
    """
    main = int(np.argmax(np.abs(unit)))
    off = float(np.arctan2(np.linalg.norm(np.delete(unit, main)), abs(unit[main])))
    axis = f"along {'-' if unit[main] < 0 else '+'}{'xyz'[main]}"
    if off <= LEAST_OF_SD * sd_rad:
        return f"{axis} ± {decimals(1e3 * sd_rad, 2)}\u00a0mrad"
    return f"{axis}, {with_unit(off, sd_rad, 'mrad')} off it"


def _cancels(known: Homogeneity) -> bool:
    """Whether the mean of B has no direction, as in a multipole."""
    # Standard deviation of the angle of the mean of B from which it has no direction: in a
    # multipole that mean is what the errors of the blocks leave.
    no_direction_rad = 0.5
    return known.direction_sd_rad > no_direction_rad


def homogeneity_rows(by_name: Mapping[str, Homogeneity]) -> Rows:
    """Return a row of text per distribution of the magnetizations."""
    rows = []
    for name, known in by_name.items():
        ranges = {
            "rms, 95 % range in ppm": known.rms_range_ppm,
            "peak to peak, 95 % range in ppm": known.peak_to_peak_range_ppm}
        rows.append({
            "magnet": f"{name}, {known.components} alone" if known.components else name,
            "mean of |B|": _field(known),
            "direction of the mean B": "not measured" if known.components
            else "none: it cancels"
            if _cancels(known) else direction_in_words(known.direction, known.direction_sd_rad),
            "rms in ppm": ppm(known.rms_ppm),
            "peak to peak in ppm": ppm(known.peak_to_peak_ppm),
            **{key: f"{ppm(low)} to {ppm(high)}" for key, (low, _, high) in ranges.items()}})
    return rows


def harmonic_rows(found: HomogeneityResult) -> Rows:
    """Return a row of text for each of the largest harmonics; none if B has no direction."""
    names = list(found.by_name)
    best = () if _cancels(found.by_name[names[-1]]) else found.by_name[names[-1]].harmonics
    shown = {**found.by_name, **found.of_map}
    order = sorted(range(len(best)), key=lambda number: -abs(best[number].ppm))[:LISTED]
    rows = []
    for number in order:
        if abs(best[number].ppm) < ROUNDING * abs(best[order[0]].ppm):
            break  # symmetry makes the others zero
        row = {"harmonic": best[number].name, "l": str(best[number].degree),
               "m": str(best[number].order)}
        for name, known in shown.items():
            term = known.harmonics[number]
            value = term.ppm if abs(term.ppm) > LEAST_OF_SD * term.sd_ppm else 0.0
            row[f"{name} in ppm"] = _ppm_with_sd(value, term.sd_ppm)
        rows.append(row)
    return rows


def _ppm_with_sd(value: float, sd: float) -> str:
    """Return a number of ppm with its sign and standard deviation, both to the same digit."""
    places = 0 if sd >= 10 or not sd else int(np.clip(1 - np.floor(np.log10(sd)), 0, 3))
    rounded, spread = (f"{size:,.{places}f}".replace(",", "\u202f")
                       for size in (abs(value), sd))
    sign = "" if not float(f"{value:.{places}f}") else "+" if value > 0 else "-"
    return f"{sign}{rounded} ± {spread}"


def plain_homogeneity(known: Homogeneity) -> Plain:
    """Return a homogeneity as plain data for JSON."""
    return asdict(known) | {"direction": known.direction.tolist()}


def homogeneity_summary(found: HomogeneityResult) -> Plain:
    """Return the content of homogeneity.json."""
    return {
        "study": found.magnet.name, "region": asdict(found.model.region),
        "solver_error_ppm": found.model.solver_error_ppm,
        "harmonics_convention": CONVENTION,
        "stray_field": None if found.stray_field is None else found.stray_field.summary(),
        **{name: plain_homogeneity(known) for name, known in found.by_name.items()},
        "map_misfit": found.map_misfit if found.of_map else None,
        "map_remarks": _map_remarks(found),
        "of_map": {name: plain_homogeneity(known) for name, known in found.of_map.items()}}


def _deviations(slices: list[Slice], mean_T: float) -> tuple[list[Floats], Bools]:
    """Return deviations of |B| in ppm in every slice, and which pixels are in the ellipse in it."""
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, len(slices[0].first_m))])
    return [PPM * (each.size_T / mean_T - 1) for each in slices], x**2 + y**2 <= 1


def largest_shown(slices: list[Slice], mean_T: float) -> float:
    """Return the deviation in ppm at which the colours of `slices_figure` end."""
    deviations, within = _deviations(slices, mean_T)
    return max(float(np.nanquantile(np.abs(each[within]), 0.98)) for each in deviations) or 1.0


def slices_figure(slices: list[Slice], mean_T: float, largest: float | None = None) -> Figure:
    """Draw the deviation of |B| in three planes through the centre, in ppm.

    Colours and lines are of what lies in the ellipse within each slice, which is drawn: beyond it,
    in the corners, the field of a homogeneous magnet deviates many times more. Colours end at
    ``largest`` in ppm, by default at `largest_shown`.
    """
    figure = figure_of(6.0)
    deviations, within = _deviations(slices, mean_T)
    largest = largest or largest_shown(slices, mean_T)
    levels = np.linspace(-largest, largest, 21)
    round_levels = MaxNLocator(nbins=6, steps=[1, 2, 5, 10]).tick_values(-largest, largest)
    *axes, last = figure.subplots(2, 2).ravel()
    for axis, each, deviation in zip(axes, slices, deviations, strict=True):
        axis.contourf(1e3 * each.first_m, 1e3 * each.second_m, deviation, levels, cmap="RdBu_r",
                      extend="both")
        lines = axis.contour(1e3 * each.first_m, 1e3 * each.second_m,
                             np.where(within, deviation, np.nan), round_levels,
                             colors="black", linewidths=0.5)
        axis.clabel(lines, fmt=ppm, fontsize=SMALL)
        middle = [float(np.mean(1e3 * own[[0, -1]])) for own in (each.first_m, each.second_m)]
        axis.add_patch(Ellipse(
            (middle[0], middle[1]), *(1e3 * float(np.ptp(own)) for own in (
                each.first_m, each.second_m)), fill=False, ec="black", lw=0.8, ls="--"))
        _of_plane(axis, each.across)
    colours = ScalarMappable(Normalize(-largest, largest), "RdBu_r")
    last.set_axis_off()
    last.legend(handles=[Line2D([], [], color="black", lw=0.8, ls="--", label="the region")],
                loc="upper center", frameon=False)
    figure.colorbar(colours, cax=last.inset_axes((0.05, 0.5, 0.9, 0.07)), extend="both",
                    orientation="horizontal", label="|B| over its mean, in ppm",
                    ticks=MaxNLocator(4))
    return figure


def _of_plane(axis: Axes, across: str) -> None:
    """Label the axes of a plane, drawn to scale, that is across an axis of the magnet."""
    first, second = (name for name in "xyz" if name != across)
    axis.set(aspect="equal", xlabel=f"{first} in mm", ylabel=f"{second} in mm")


def harmonics_figure(known: Homogeneity) -> Figure:
    """Draw the largest harmonics by degree, with error bars of two standard deviations."""
    figure, axis = chart(3.4, grid=False)
    largest = sorted(sorted(range(len(known.harmonics)),
                            key=lambda number: -abs(known.harmonics[number].ppm))[:DRAWN])
    shown = [known.harmonics[number] for number in largest]
    place = np.arange(len(shown))
    axis.bar(place, [each.ppm for each in shown], color=POSTERIOR, width=0.7)
    axis.errorbar(place, [each.ppm for each in shown],
                  2 * np.array([each.sd_ppm for each in shown]), fmt="none",
                  color="black", capsize=2, lw=0.8)
    axis.axhline(0, color=PUBLISHED, lw=0.8)
    axis.set_xticks(place, [each.name for each in shown], rotation=90)
    axis.set_ylabel("ppm of the mean field")
    axis.grid(alpha=0.3, axis="y")
    axis.set_xlim(-1, len(place))
    return figure


def page(found: HomogeneityResult) -> Page:
    """Return the page of the homogeneity of a magnet's field."""
    name, best = best_known(found.by_name)
    every, region = {**found.by_name, **found.of_map}, found.model.region.text
    rows, harmonics = homogeneity_rows(every), harmonic_rows(found)
    figures: dict[str, tuple[Callable[[], Figure], str]] = {"homogeneity.png": (
        partial(slices_figure, found.model.slices(found.distributions[name]), best.mean_T),
        "Deviation of |B| from its mean over the region (dashed), in planes through its "
        f"centre, {_known_as(name)}")}
    files = {}
    if harmonics:
        figures["harmonics.png"] = (
            partial(harmonics_figure, best), f"The largest spherical harmonics {_known_as(name)}, "
            "by degree; bars are two standard deviations")
        files["harmonics.csv"] = csv_file({
            "magnet": [own for own, known in every.items() for _ in known.harmonics],
            **{key: [getattr(each, key) for known in every.values() for each in known.harmonics]
               for key in ("degree", "order", "letter", "ppm", "sd_ppm")}},
            {"study": found.magnet.name, "convention": CONVENTION})
    remarks = " ".join(filter(None, (
        SIZES, "Ranges hold 95 % of the magnets drawn from the prior or posterior.",
        MAP_ROWS if found.of_map else "", *_map_remarks(found),
        "" if (own := f"{found.model.solver_error_ppm:.2g}") == "0" else
        f"The solver's own error is {own} ppm rms for a component.")))
    return Page(
        "homogeneity", "homogeneity", found.magnet.study, answer(found),
        homogeneity_summary(found), [
            Section([remarks, Table(rows, "turned")], f"The field in {region}"),
            Section([
                "The largest ones, on the sphere's surface, in ppm of the mean field. "
                f"{CONVENTION}.", Table(harmonics, "numbers"), Drawn("harmonics.png")],
                "Spherical harmonics", about=harmonics),
            *sections_of_stray(found.stray_field, drawn=True)],
        {f"The field in {region}": rows, "Spherical harmonics in ppm of the mean field": harmonics,
         stray_title(found.stray_field): stray_rows(found.stray_field)},
        figures={**figures, **stray_pictures(found.stray_field)}, files=files)


STRAY_FIGURE = "stray_field.png"


def line_name(stray: StrayField) -> str:
    """Return the name of the line at which |B| falls to the limit."""
    return f"{decimals(1e3 * stray.limit_T)}\u00a0mT line"


def sections_of_stray(
    stray: StrayField | None, drawn: bool = False, warning: Sequence[Text] = ()
) -> list[Section]:
    """Return the section of a page about the field outside; none if there is nothing to say.

    ``drawn`` tells whether the figure of `stray_pictures` is in it.
    """
    if stray is None:
        return []
    said = stray.unknown or (
        f"The largest distances at which |B| reaches {decimals(1e3 * stray.limit_T)}\u00a0mT, the "
        "usual limit of access to rooms of MRI magnets. The field is that of the magnet alone, "
        f"without shields or external fields. {_left_out(stray)}".rstrip() + ("" if not any(
            reach.sd_m for reach in (stray.radial, stray.axial) if reach) else
        " Without ± the standard deviation is below 0.5 mm."))
    rows = stray_rows(stray)
    figure = [Drawn(STRAY_FIGURE)] if drawn and rows else []
    return [Section([*warning, said, Table(rows), *figure],
                    f"Outside of the magnet: the {line_name(stray)}")]


def _left_out(stray: StrayField) -> str:
    """Say that the study has other sources; empty if it has none."""
    return (f"The study has {in_a_row(stray.left_out)} besides, with which it may reach "
            "farther." if stray.left_out else "")


def stray_title(stray: StrayField | None) -> str:
    """Return the title of the table of `stray_rows`."""
    return "Outside of the magnet" + (
        f", without {in_a_row(stray.left_out)}" if stray and stray.left_out else "")


def stray_rows(stray: StrayField | None) -> Rows:
    """Return a row of text for the sides of the magnet and one for its ends; none if unknown."""
    if stray is None or stray.unknown:
        return []
    rows = []
    middle = f"the plane z = {1e3 * stray.middle_z_m:.4g}" + (
        " mm, its middle" if stray.middle_z_m else "")
    for name, whence, own, reach in (
            ("beside the magnet", "the z axis", stray.radius_m, stray.radial),
            ("beyond its ends", middle, stray.half_length_m, stray.axial)):
        if reach is None:
            near = 1e3 * NEAREST * stray.radius_m
            rows.append({
                line_name(stray): name, "farthest": f"less than {1e3 * own + near:.3g}\u00a0mm",
                "from": whence, "from the magnet": f"less than {near:.2g}\u00a0mm", "at": ""})
            continue
        place = ", ".join(f"{1e3 * one:.0f}" for one in np.round(reach.at_m, 3) + 0.0)
        rows.append({
            line_name(stray): name, "farthest": f"{distance_text(reach.distance_m, reach.sd_m)}",
            "from": whence, "from the magnet": f"{1e3 * (reach.distance_m - own):.0f}\u00a0mm",
            "at": f"({place}) mm"})
    return rows


def distance_text(distance_m: float, sd_m: float) -> str:
    """Return a distance in mm, with its standard deviation if it is 0.5 mm or more."""
    text = with_error(round(1e3 * distance_m), 1e3 * sd_m) if sd_m >= 5e-4 else (
        f"{1e3 * distance_m:.0f}")
    return f"{text}\u00a0mm"


def stray_pictures(stray: StrayField | None) -> Figures:
    """Return figure and caption of the field outside by file name; none if it is unknown."""
    if stray is None or stray.unknown:
        return {}
    return {STRAY_FIGURE: (partial(stray_figure, stray), (
        f"|B| outside of the magnet in planes through its middle, in mT. Thick: the "
        f"{line_name(stray)}; dashed: the largest distances"))}


def stray_figure(stray: StrayField) -> Figure:
    """Draw lines of equal |B| around the magnet in three planes, in mm and mT."""
    others_t = (1e-4, 2e-4, 1e-3, 5e-3, 2e-2)  # flux densities of the thinner lines of the figure
    figure = figure_of(6.6)
    axes = figure.subplots(2, 2).ravel()
    radius, half, middle = (
        1e3 * each for each in (stray.radius_m, stray.half_length_m, stray.middle_z_m))
    reached = [reach.distance_m for reach in (stray.radial, stray.axial) if reach]
    # half width of the figure's planes, relative to the largest distance of the line
    around = 1.15
    widest = 1e3 * (around * max(reached) if reached else max(
        float(np.abs(plane.first_m).max()) for plane in stray.planes))
    for axis, plane in zip(axes[:-1], stray.planes, strict=True):
        first, second = 1e3 * plane.first_m, 1e3 * plane.second_m
        size = np.log(np.maximum(plane.size_T, min(*others_t, stray.limit_T) / 10))  # may be 0
        sides = [1e3 * reach.distance_m if reach else 0.0 for reach in (stray.radial, stray.axial)]
        looks: tuple[dict[str, Any], ...] = (
            {"color": "#cccccc", "lw": 0}, {"fill": False, "ls": "--", "lw": 0.8, "color": SECOND})
        for (out, up), look in zip(((radius, half), sides), looks, strict=True):
            if out and plane.across == "z":
                axis.add_patch(Circle((0, 0), out, **look))
            elif out and up:
                axis.add_patch(Rectangle((-out, middle - up), 2 * out, 2 * up, **look))
        low, high = float(plane.size_T.min()), float(plane.size_T.max())
        thin = [value for value in others_t if low < value < high and value != stray.limit_T]
        if thin:
            lines = axis.contour(first, second, size, np.log(thin), colors="#777777",
                                 linewidths=0.6, linestyles="solid")
            axis.clabel(lines, fmt=lambda level: decimals(1e3 * float(np.exp(level)), 2),
                        fontsize=SMALL)
        if low < stray.limit_T < high:
            axis.contour(first, second, size, [np.log(stray.limit_T)], colors=POSTERIOR,
                         linewidths=2, linestyles="solid")
        _of_plane(axis, plane.across)
        along = 0.0 if plane.across == "z" else middle
        axis.set(xlim=(-widest, widest), ylim=(along - widest, along + widest))
        axis.grid(alpha=0.3)
    _explain(axes[-1], stray)
    return figure


def _explain(axis: Axes, stray: StrayField) -> None:
    """Say in an empty panel what is drawn in the others."""
    axis.set_axis_off()
    shown = [Patch(color="#cccccc", label="cylinder around the magnet"),
             Line2D([], [], color=POSTERIOR, lw=2, label=line_name(stray)),
             Line2D([], [], color="#777777", lw=0.6, label="other |B|, in mT")]
    if stray.radial:
        shown.append(Line2D([], [], color=SECOND, lw=0.8, ls="--",
                            label="largest distances of that line\nfrom the z axis and the middle"))
    axis.legend(handles=shown, loc="center", frameon=False)
