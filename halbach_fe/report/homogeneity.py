"""Table, figures and page of the homogeneity of a field."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from halbach_fe.api import HomogeneityResult
from halbach_fe.core.files import atomic, write_text
from halbach_fe.measurement.tables import write_csv
from halbach_fe.report.page import POSTERIOR, PUBLISHED, own_style, save, write_page
from halbach_fe.response.homogeneity import PPM, Homogeneity, Slice

CONVENTION = (
    "B_n = sum (r/R)^l P_lm(cos theta) (a_lm cos(m phi) + b_lm sin(m phi)) about the centre, B_n "
    "along the mean field, theta from the z axis, R the sphere's radius, P_lm semi-normalized "
    "(Schmidt) without the phase (-1)^m")

ROUNDING = 1e-9
"""Size below which a harmonic is zero but for rounding, relative to the largest one."""

LISTED = 12
"""Number of the harmonics on the page and the terminal: the largest ones."""


def verdict(found: HomogeneityResult) -> str:
    """Return the answer in words, for the magnet that is known best."""
    name, best = list(found.by_name.items())[-1]
    text = (f"In {found.model.region.text} the field is {_field(best)}; it deviates by "
            f"{ppm(best.rms_ppm)} ppm rms and {ppm(best.peak_to_peak_ppm)} ppm peak to peak")
    low, middle, high = map(ppm, best.rms_range_ppm)
    if name != "prior":
        return f"{text} (95 % of what the {name} allows: {low} to {high} ppm rms)."
    return (f"{text} if all blocks are as ordered. Of magnets whose blocks vary as the study says, "
            f"half have more than {middle} ppm rms, and 95 % have {low} to {high} ppm.")


def _known_as(name: str) -> str:
    """Return words for the mean of a distribution of the magnetizations."""
    return {"prior": "of the magnet as ordered", "posterior": "of the measured magnet"}.get(
        name, f"of the {name}")


def ppm(value: float) -> str:
    """Return a number of ppm as text, without an exponent."""
    return f"{value:,.0f}".replace(",", "\u202f") if abs(value) >= 1000 else f"{value:.3g}"


def _field(known: Homogeneity) -> str:
    """Return mean field and standard deviation as text, in mT."""
    return f"{1e3 * known.mean_T:.6g} ± {1e3 * known.mean_sd_T:.2g} mT"


def homogeneity_rows(found: HomogeneityResult) -> list[dict[str, str]]:
    """Return a row of text per distribution of the magnetizations."""
    rows = []
    for name, known in found.by_name.items():
        direction = ", ".join(f"{value:+.5f}" for value in known.direction.round(5) + 0.0)
        ranges = {
            "rms, 95 % of magnets in ppm": known.rms_range_ppm,
            "peak to peak, 95 % of magnets in ppm": known.peak_to_peak_range_ppm}
        rows.append({
            "magnet": name, "mean field": _field(known),
            "direction": f"({direction}) ± {1e3 * known.direction_sd_rad:.2g} mrad",
            "rms in ppm": ppm(known.rms_ppm),
            "peak to peak in ppm": ppm(known.peak_to_peak_ppm),
            **{key: f"{ppm(low)} to {ppm(high)}" for key, (low, _, high) in ranges.items()}})
    return rows


def harmonic_rows(found: HomogeneityResult) -> list[dict[str, str]]:
    """Return a row of text for each of the largest harmonics; none if there are no harmonics."""
    names = list(found.by_name)
    best = found.by_name[names[-1]].harmonics
    order = sorted(range(len(best)), key=lambda number: -abs(best[number].ppm))[:LISTED]
    rows = []
    for number in order:
        if abs(best[number].ppm) < ROUNDING * abs(best[order[0]].ppm):
            break  # symmetry makes the others zero
        row = {"harmonic": best[number].name, "l": str(best[number].degree),
               "m": str(best[number].order)}
        for name in names:
            term = found.by_name[name].harmonics[number]
            sign = "+" if term.ppm > 0 else ""
            row[f"{name} in ppm"] = f"{sign}{ppm(term.ppm)} ± {ppm(term.sd_ppm)}"
        rows.append(row)
    return rows


def homogeneity_summary(found: HomogeneityResult) -> dict[str, object]:
    """Return the content of homogeneity.json."""
    return {
        "study": found.magnet.name, "region": asdict(found.model.region),
        "solver_error_ppm": found.model.solver_error_ppm,
        "harmonics_convention": CONVENTION,
        **{name: asdict(known) | {"direction": known.direction.tolist()}
           for name, known in found.by_name.items()}}


def slices_figure(slices: list[Slice], mean_T: float) -> Figure:
    """Draw the deviation of |B| in three planes through the centre, in ppm."""
    figure = Figure(figsize=(11, 3.7), layout="constrained")
    deviations = [PPM * (each.size_T / mean_T - 1) for each in slices]
    largest = max(float(np.nanquantile(np.abs(each), 0.98)) for each in deviations) or 1.0
    levels = np.linspace(-largest, largest, 21)
    axes = figure.subplots(1, 3)
    for axis, each, deviation in zip(axes, slices, deviations, strict=True):
        names = [name for name in "xyz" if name != each.across]
        axis.contourf(1e3 * each.first_m, 1e3 * each.second_m, deviation, levels, cmap="RdBu_r",
                      extend="both")
        lines = axis.contour(1e3 * each.first_m, 1e3 * each.second_m, deviation, levels[::4],
                             colors="black", linewidths=0.5)
        axis.clabel(lines, fmt=ppm, fontsize=7)
        axis.set_aspect("equal")
        axis.set_xlabel(f"{names[0]} in mm")
        axis.set_ylabel(f"{names[1]} in mm")
    colours = ScalarMappable(Normalize(-largest, largest), "RdBu_r")
    figure.colorbar(colours, ax=axes, label="|B| over its mean, in ppm", shrink=0.9)
    return figure


def harmonics_figure(known: Homogeneity) -> Figure:
    """Draw the amplitudes of all harmonics, with error bars of two standard deviations."""
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    axis = figure.subplots()
    place = np.arange(len(known.harmonics))
    axis.bar(place, [each.ppm for each in known.harmonics], color=POSTERIOR, width=0.7)
    axis.errorbar(place, [each.ppm for each in known.harmonics],
                  2 * np.array([each.sd_ppm for each in known.harmonics]), fmt="none",
                  color="black", capsize=2, lw=0.8)
    axis.axhline(0, color=PUBLISHED, lw=0.8)
    axis.set_xticks(place, [each.name for each in known.harmonics], rotation=90, fontsize=7)
    axis.set_ylabel("ppm of the mean field")
    axis.grid(alpha=0.3, axis="y")
    axis.set_xlim(-1, len(place))
    return figure


@own_style
def write_homogeneity(
    found: HomogeneityResult, folder: Path, provenance: Mapping[str, str]
) -> None:
    """Write homogeneity.json, harmonics.csv, homogeneity.html and its figures."""
    name, best = list(found.by_name.items())[-1]
    write_text(folder / "homogeneity.json",
               json.dumps(homogeneity_summary(found), indent=1, allow_nan=False) + "\n")
    figures = {"homogeneity.png": (
        slices_figure(found.model.slices(found.distributions[name].mean), best.mean_T),
        "Deviation of |B| from its mean over the region, in planes through its centre, "
        f"{_known_as(name)}")}
    if best.harmonics:
        figures["harmonics.png"] = (
            harmonics_figure(best), f"Spherical harmonics {_known_as(name)}; bars are two standard "
            "deviations")
        with atomic(folder / "harmonics.csv") as temporary:
            write_csv({
                "magnet": [own for own, known in found.by_name.items() for _ in known.harmonics],
                **{key: [getattr(each, key) for known in found.by_name.values()
                         for each in known.harmonics]
                   for key in ("degree", "order", "letter", "ppm", "sd_ppm")}}, {
                "study": found.magnet.name, "convention": CONVENTION}, temporary)
    write_page(folder / "homogeneity.html", "homogeneity.html.j2", save(figures, folder),
               study=found.magnet.study, provenance=provenance, verdict=verdict(found),
               region=found.model.region.text, rows=homogeneity_rows(found),
               harmonics=harmonic_rows(found), convention=CONVENTION,
               solver_error=f"{found.model.solver_error_ppm:.2g}")
