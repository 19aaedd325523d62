"""Sentences, figures, table and page of Maxwell's check of a field map."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import atomic, write_text
from halbach_fe.measurement.field_map import FIELD_COLUMNS, points_of, readings_sha256, write_map
from halbach_fe.measurement.map_check import MapCheck
from halbach_fe.measurement.tables import write_csv
from halbach_fe.report.page import MEASURED, POSTERIOR, SECOND, own_style, save, write_page
from halbach_fe.study.types import COMPONENTS

VIOLATED = 0.02
"""A map whose floor is above this share of the largest field does not obey Maxwell's equations."""

REMAINS = 0.3
"""Correlation of neighbouring residuals from which they are no noise."""

ROWS_NAMED = 10
"""Number of broken rows that are listed by number."""


def sentences(check: MapCheck) -> list[str]:
    """Return what the check found, the answer first."""
    found = [verdict(check)]
    if check.is_reoriented:
        shown = ", ".join(f"column B{column} is {_component(name)}"
                          for column, name in zip(COMPONENTS, check.orientation, strict=True))
        found.append(f"The map obeys with other axes than it names: {shown} (or all of them with "
                     "the opposite sign, which no map can show).")
    if check.alike:
        found.append(f"{len(check.alike)} other orientations fit as well: " + "; ".join(
            ", ".join(_component(name) for name in names) for names in check.alike[:5])
            + (" ..." if len(check.alike) > 5 else "") + ".")
    for kind, rows in check.broken.items():
        numbers = ", ".join(map(str, rows[:ROWS_NAMED]))
        more = f" and {len(rows) - ROWS_NAMED} more" if len(rows) > ROWS_NAMED else ""
        found.append(f"Left out because {BROKEN[kind]}: row{'s' if len(rows) > 1 else ''} "
                     f"{numbers}{more}.")
    terms = [f"{term.name} {term.value:.3g} ± {term.sd:.1g} {term.unit}"
             for term in check.terms if term.found]
    if terms:
        found.append("The instrument is not what the map assumes: " + "; ".join(terms) + ".")
    noise = f"The noise of a reading is {_field(check.noise_T)}"
    if check.position_noise_m * 1e6 >= 1:
        noise += (", and where the field is steep, readings scatter like positions that are "
                  f"{check.position_noise_m * 1e6:.0f} µm off")
    found.append(noise + ".")
    if check.structure > REMAINS:
        found.append(f"What remains is no noise: neighbouring residuals have a correlation of "
                     f"{check.structure:.2f}. Something that this check does not know, such as a "
                     "probe that moves in its holder, is still in the map.")
    return found


BROKEN = {"zero": "all components are zero",
          "repeated": "the readings are those of the row before, at another place",
          "spike": "far off the field of all others"}


def verdict(check: MapCheck) -> str:
    """Return the answer in a sentence."""
    if not check.suffices:
        return (f"The map cannot tell: {1 - check.redundancy:.0%} of its readings are needed to "
                "describe any field in its region. Measure in a volume, with a smaller spacing.")
    share = check.floor_rms_T / check.size_T
    size = (f"{_field(check.floor_rms_T)} rms on scan lines that were held out, "
            f"{_share(share)} of the largest field ({_field(check.size_T)})")
    if share > VIOLATED:
        return f"The map does not obey div B = 0 and curl B = 0: they leave {size}."
    wrong = [term.name for term in check.terms if term.determined and not term.plausible]
    if wrong:
        return (f"The map does not obey div B = 0 and curl B = 0 with any likely instrument: it "
                f"would take an impossible one ({wrong[0]}"
                f"{f' and {len(wrong) - 1} more' if len(wrong) > 1 else ''}), which leaves {size}.")
    return (f"The map obeys div B = 0 and curl B = 0 to {size}. No model of the magnet can explain "
            "it any better.")


def _component(name: str) -> str:
    """Return the name of a component with its sign, -Bz of ``-z``."""
    return f"{name[:-1].replace('-', '−')}B{name[-1]}"


def _field(value: float) -> str:
    """Return a flux density with a unit that suits it."""
    return f"{value:.3g} T" if value >= 0.1 else (
        f"{value * 1e3:.2g} mT" if value >= 1e-4 else f"{value * 1e6:.2g} µT")


def _share(value: float) -> str:
    """Return a part of 1 in % or ppm."""
    return f"{value:.2%}" if value >= 1e-3 else f"{value * 1e6:.0f} ppm"


def instrument_table(check: MapCheck) -> list[dict[str, str]]:
    """Return rows of text: every parameter of the instrument with its uncertainty."""
    return [{"parameter": term.name,
             "value": f"{term.value:.2f} ± {term.sd:.2f} {term.unit}" if term.determined else "–",
             "": "found" if term.found else "" if term.determined
             else "this map cannot tell" if term.predictive
             else "left out: scan lines are predicted as well without it"}
            for term in check.terms]


def residual_table(check: MapCheck) -> list[dict[str, str]]:
    """Return rows of text: rms residuals of the columns in mT, and by region."""
    def row(name: str, values: Floats | tuple[float, float, float]) -> dict[str, str]:
        return {"rms residual in mT": name} | {
            f"B{column}": f"{1e3 * value:.3g}" for column, value in zip(
                COMPONENTS, values, strict=True)}

    axis, windows = check.windows
    return [row("the map as it is given", check.rms_as_given_T),
            row("with its axes and its instrument", check.rms_T),
            row("scan lines that were held out", check.floor_T),
            *(row(f"{axis} from {1e3 * low:.0f} to {1e3 * high:.0f} mm", values)
              for low, high, values in windows)]


@own_style
def write_map_check(
    data: xr.Dataset, check: MapCheck, folder: Path, provenance: Mapping[str, str]
) -> None:
    """Write check.json, check.csv, check.html, its figures, oriented_map.csv if it differs, and
    corrected_map.csv if the map can tell.
    """
    points = points_of(data)
    write_text(folder / "check.json", json.dumps(check_summary(data, check), indent=1,
                                                  allow_nan=False) + "\n")
    with atomic(folder / "check.csv") as temporary:
        write_csv(dict(zip(("x_m", "y_m", "z_m"), points.T, strict=True)) | {
            f"residual_{name}": column for name, column in zip(
                FIELD_COLUMNS, check.residual_T.T, strict=True)} | {
            "left_out": check.excluded.astype(int)}, {}, temporary)
    files = ["check.json", "check.csv"]
    if check.is_reoriented or check.excluded.any():
        write_map(oriented(data, check), folder / "oriented_map.csv")
        files.append("oriented_map.csv")
    if check.suffices:
        write_map(corrected(data, check), folder / "corrected_map.csv")
        files.append("corrected_map.csv")
    figures = {
        "check_slices.png": (_slices(points, np.asarray(data["B_T"].values), check), (
            "A slice through the middle of the map: every column as it was measured, and its "
            "residual from the field that obeys Maxwell's equations. Crosses are rows that were "
            "left out")),
        "check_readings.png": (_readings(check), (
            "Residuals in the order of the map: noise is the same everywhere, a probe that moves "
            "makes steps and waves"))}
    write_page(folder / "check.html", "map_check.html.j2", save(figures, folder),
               provenance=provenance, check=check, found=sentences(check), files=", ".join(files),
               instrument=instrument_table(check), residuals=residual_table(check))


def check_summary(data: xr.Dataset, check: MapCheck) -> dict[str, object]:
    """Return the results as plain data, with `readings_sha256` of the maps to which they belong."""
    maps = {"map": data, "oriented_map": oriented(data, check)}
    if check.suffices:
        maps["corrected_map"] = corrected(data, check)
    return check.plain() | {
        "maps_sha256": {name: readings_sha256(one) for name, one in maps.items()}}


def oriented(data: xr.Dataset, check: MapCheck) -> xr.Dataset:
    """Return the map without broken rows, with its columns along the axes that they belong to."""
    kept = data.isel(point=np.flatnonzero(~check.excluded))
    turned = kept.copy(deep=True)
    for column, name in enumerate(check.orientation):
        axis, sign = COMPONENTS.index(name[-1]), -1.0 if name.startswith("-") else 1.0
        turned["B_T"][:, axis] = sign * kept["B_T"].values[:, column]
        if "sigma_T" in kept:
            turned["sigma_T"][:, axis] = kept["sigma_T"].values[:, column]
    return turned


def corrected(data: xr.Dataset, check: MapCheck) -> xr.Dataset:
    """Return the map that a probe without errors would have made, without broken rows."""
    turned = oriented(data, check)
    turned["B_T"] = turned["B_T"].copy(data=check.corrected_T[~check.excluded])
    return turned


def _slices(points: Floats, field: Floats, check: MapCheck) -> Figure:
    """Draw the columns and their residuals in the plane of the two longest axes."""
    first, second, third = np.argsort(-np.ptp(points, axis=0))
    middle = points[np.argmin(np.abs(points[:, third] - np.median(points[:, third]))), third]
    plane = np.abs(points[:, third] - middle) <= 0.5 * check.spacing_m
    figure = Figure(figsize=(9, 7), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True, sharey=True)
    where = 1e3 * points[plane][:, [first, second]].T
    out = check.excluded[plane]
    for column, row in enumerate(axes):
        residual = np.where(check.excluded, np.nan, check.residual_T[:, column])[plane]
        limit = float(np.nanquantile(np.abs(residual), 0.98)) if np.isfinite(
            residual).any() else 1.0
        for axis, values, colours, name in (
                (row[0], 1e3 * field[plane, column], {"cmap": "viridis"}, "in mT"),
                (row[1], 1e6 * residual, {"cmap": "RdBu_r", "vmin": -1e6 * limit,
                                          "vmax": 1e6 * limit}, "residual in µT")):
            drawn = axis.scatter(*where, c=values, s=18, marker="s", **colours)
            axis.plot(*where[:, out], "x", color=MEASURED, ms=4)
            figure.colorbar(drawn, ax=axis, label=f"B{COMPONENTS[column]} {name}")
        row[0].set_ylabel(f"{COMPONENTS[second]} in mm")
    for axis in axes[-1]:
        axis.set_xlabel(f"{COMPONENTS[first]} in mm")
    figure.suptitle(f"{COMPONENTS[third]} = {1e3 * middle:.1f} mm")
    return figure


def _readings(check: MapCheck) -> Figure:
    """Draw the residuals of every column in the order of the map."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    axis = figure.subplots()
    number = np.arange(1, len(check.residual_T) + 1)
    for values, name, colour in zip(check.residual_T.T, COMPONENTS,
                                    (POSTERIOR, SECOND, MEASURED), strict=True):
        axis.plot(number[~check.excluded], 1e6 * values[~check.excluded], ".", ms=2.5,
                  color=colour, label=f"B{name}")
    axis.set_xlabel("row of the map")
    axis.set_ylabel("residual in µT")
    axis.grid(alpha=0.3)
    axis.legend(markerscale=4)
    return figure
