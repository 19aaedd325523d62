"""Pages of a simulated campaign, and of how near an update came to its truth.

The former shows only what a measurement would give.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.measurement.field_map import TOTAL_COLUMN, is_total_field, points_of
from halbach_fe.measurement.instrument import by_stated_units
from halbach_fe.measurement.observation import TOTAL_LABEL
from halbach_fe.report.answer import Answer
from halbach_fe.report.magnet_view_3d import ViewPoints, view_of_nominal_magnet
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    SECOND,
    Page,
    Section,
    Table,
    View,
    figure_of,
    geometry_figure,
    legend_above,
    stacked_axes,
)
from halbach_fe.report.point_maps import curve, maps_figure
from halbach_fe.report.words import counted, decimals, flux_density, fraction, rms
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.simulate import (
    SimulatedCampaign,
    campaign_files,
    observed_components,
    point_noise,
)

COLOURS = (POSTERIOR, PRIOR, SECOND)


def answer(study: Study, readings: xr.Dataset, held_out: xr.Dataset | None, blocks: int) -> Answer:
    """Say what was simulated, and what to do with it."""
    maps = [readings] + ([] if held_out is None else [held_out])
    largest = max(float(np.nanmax(np.abs(column)))
                  for each in maps for column in _columns(study, each).values())
    more = "" if held_out is None else (
        f", {counted(held_out.sizes['point'], 'more point')} to test predictions (held-out.csv)")
    sigma = _noise(study, readings)
    low, high = float(np.nanmin(sigma)), float(np.nanmax(sigma))
    return Answer(
        "What would a measurement of this magnet give?",
        f"Readings up to {flux_density(largest, 4)} with a noise of {flux_density(low, 2)}"
        f"{'' if np.isclose(low, high) else f' to {flux_density(high, 2)}'}. Simulated are a map "
        f"of {counted(readings.sizes['point'], 'point')} (map.csv){more}, and coil measurements of "
        f"{counted(blocks, 'single block')} (blocks.csv).",
        "Only as a test: the magnet was never built. Its blocks were drawn at random, and "
        "its field was computed with programs other than halbach-fe. A campaign may contain a "
        "hidden error, also of the positions that the map states.",
        "Update the magnet with the map, as if it were measured, then compare with the truth.",
        "halbach-fe infer STUDY --measurements DIR/map.csv --blocks DIR/blocks.csv"
        + (" --held-out DIR/held-out.csv" if held_out is not None else "") + " -o DIR")


def page(campaign: SimulatedCampaign) -> Page:
    """Return the page of a simulated campaign.

    Its files are in the units and along the axes that the study states, the page is in m and T.
    """
    study, blocks = campaign.study, len(campaign.blocks)
    readings, held_out = (  # in m and T, as whoever reads them gets them
        None if data is None else by_stated_units(study.instrument, data)
        for data in (campaign.readings, campaign.held_out))
    assert readings is not None
    maps = {"map": readings} | ({} if held_out is None else {"held out": held_out})
    magnet, points = build_magnet(study), points_of(readings)
    magnitude = 1e3 * np.linalg.norm(list(_columns(study, readings).values()), axis=0)
    view = View(lambda: view_of_nominal_magnet(magnet, ViewPoints(
        points, magnitude, "points of the map", "magnitude of the<br>readings in mT",
        "magnitude of the readings %{customdata:.5g} mT",
        (float(magnitude.min()), float(magnitude.max())))),
        "points of the map by the magnitude of the readings")
    rows = [_map_row(study, name, data) for name, data in maps.items()]
    secret = readings.attrs["truth_sha256"]
    return Page(
        "simulate-measurement", "a simulated measurement campaign", study,
        answer(study, readings, held_out, blocks), {
            "study": study.name, "points": readings.sizes["point"],
            "readings": int(np.isfinite(campaign.without_noise).sum()), "blocks": blocks,
            "model": campaign.truth["model"], "truth_sha256": secret},
        [Section([
            "Magnetizations were drawn at random, the field was computed with programs other than "
            "halbach-fe, and noise was added. The true magnetizations and hidden effects are in "
            "`truth/truth.json`.", Table(rows, "numbers"),
            f"{blocks} single blocks have simulated measurements in a Helmholtz coil. The points "
            "are shown at the positions that the map states; a campaign may contain a hidden error "
            "of these positions. The picture shows the blocks with their nominal geometry and "
            "magnetization.", view], "What was simulated")],
        {"What was measured": rows},
        figures={
            "campaign_field.png": (
                partial(_field_figure, study, maps), "The readings of the map"),
            "campaign_geometry.png": (
                partial(geometry_figure, magnet, points,
                        None if held_out is None else points_of(held_out)),
                "The nominal blocks of the first ring, "
                f"{'the iron, ' if magnet.iron else ''}and the points of the map and the held-out "
                "points")},
        files=campaign_files(campaign), stored=False, stem="campaign",
        provenance={"source": "simulated", "SHA-256 of the truth": secret})


def _map_row(study: Study, name: str, data: xr.Dataset) -> dict[str, str]:
    """Return the row of a map in the page's table."""
    fields, z = _columns(study, data), points_of(data)[:, 2]
    sigma = _noise(study, data)
    return {"points of": name, "number": str(len(z)),
            "components": ", ".join(fields),
            "z in mm": " to ".join(dict.fromkeys(
                f"{1e3 * round(end, 9):.4g}" for end in (z.min(), z.max()))),
            "largest reading": flux_density(float(np.nanmax(np.abs(
                list(fields.values())))), 5),
            "sd of the noise": " to ".join(dict.fromkeys(
                flux_density(float(end), 2) for end in (np.nanmin(sigma), np.nanmax(sigma))))}


def _noise(study: Study, data: xr.Dataset) -> Floats:
    """Return standard deviations (n, 3) in T: the map's if it has them, else the study's."""
    return data["sigma_T"].values if "sigma_T" in data else point_noise(
        study, points_of(data), is_total_field(data))


def _columns(study: Study, data: xr.Dataset) -> dict[str, Floats]:
    """Return the readings (n,) in T of a map, by their names."""
    if is_total_field(data):
        return {TOTAL_LABEL: data[TOTAL_COLUMN].values}
    return {f"B{name}": data["B_T"].values[:, COMPONENTS.index(name)]
            for name in observed_components(study)}


def _field_figure(study: Study, maps: dict[str, xr.Dataset]) -> Figure:
    """Draw the readings of all maps along a line or circle, or those of the map as a map."""
    if any(curve(points_of(data)) is None for data in maps.values()):
        (data, *_) = maps.values()
        return maps_figure(points_of(data), {
            name: 1e3 * column for name, column in _columns(study, data).items()}, "mT")
    figure, (axis,) = stacked_axes(1)
    figure.set_figheight(4)
    for (name, data), marker in zip(maps.items(), (".", "x"), strict=False):
        place, label = curve(points_of(data)) or (np.zeros(0), "")
        for (shown, column), colour in zip(_columns(study, data).items(), COLOURS, strict=False):
            axis.plot(place, 1e3 * column, marker, ms=4, color=colour, label=f"{shown}, {name}")
        axis.set_xlabel(label)
    axis.set_ylabel("reading in mT")
    figure.legend(loc="outside upper center", ncols=2 * len(maps), markerscale=2)
    return figure


def error_summary(magnetizations: Gaussian, truth: Floats) -> dict[str, float]:
    """Return errors of the mean in A/m, and the rms of error over standard deviation."""
    error, sd = magnetizations.mean - truth, magnetizations.sd
    free = sd > 0  # a missing block has no uncertainty
    return {"largest_error_A_per_m": float(np.abs(error).max()),
            "rms_error_A_per_m": rms(error), "z_rms": rms(error[free] / sd[free])}


def expected_spread(magnetizations: Gaussian) -> float:
    """Return the standard deviation of the rms of error over sd that the posterior foretells.

    It is larger than that of independent errors, 1 / sqrt(2 n), because what readings leave open
    are few combinations of magnetizations.
    """
    free = magnetizations.sd > 0
    sd = magnetizations.sd[free]
    correlation = magnetizations.covariance[np.ix_(free, free)] / np.outer(sd, sd)
    return float(np.linalg.norm(correlation) / np.sqrt(2) / free.sum())


def answer_beside_truth(
    magnet: Magnet, known: Mapping[str, Gaussian], truth: Floats
) -> Answer:
    """Say how near the inferred magnetizations are to the true ones; the last of ``known`` counts.

    Error bars hold if the rms of error over standard deviation is within three of its standard
    deviations of 1.
    """
    (before, *_), (name, best) = known.values(), list(known.items())[-1]
    size = float(np.sqrt(np.mean(truth**2) * magnet.dimension))
    _, left, ratio = error_summary(best, truth).values()
    first = error_summary(before, truth)["rms_error_A_per_m"]
    spread = expected_spread(best)
    sound = abs(ratio - 1) <= 3 * spread
    return Answer(
        "How near are the inferred magnetizations to the true ones?",
        f"{name[0].upper()}{name[1:]}: {1e-3 * left:.2g} kA/m rms in each component, "
        f"{fraction(left / size)} of a block's magnetization. Before the readings it was "
        f"{1e-3 * first:.2g} kA/m.",
        ("Yes: the" if sound else "No: the") + f" errors are {decimals(ratio, 2)} times the stated "
        f"standard deviations, where 1 ± {decimals(spread, 2)} is expected. The field of the truth "
        "was computed by another program than the one that is tested.",
        "Update a magnet of your own with its map." if sound else
        "Find out what the model lacks before its error bars are believed.",
        f"halbach-fe {'infer' if sound else 'diagnose'} STUDY --measurements MAP -o DIR", sound)


def page_beside_truth(
    magnet: Magnet, known: Mapping[str, Gaussian], truth: Floats, what: str,
    figures: Mapping[str, float] | None = None, ring: int = 1,
) -> Page:
    """Return the page of magnetizations.html, which compares those of a ring with the truth.

    Parameters
    ----------
    known : mapping
        Distributions of the magnetizations in A/m by name; at most three are drawn, the first of
        them (the prior) in orange.
    truth : ndarray, shape (parameters,), in A/m
    what : str
        The page's title.
    figures : mapping, optional
        Further numbers to list, by name.
    ring : int
        The ring that is drawn, counted from 1.
    """
    rows = []
    for name, distribution in known.items():
        largest, rms, ratio = error_summary(distribution, truth).values()
        rows.append({"": name, "largest error in kA/m": decimals(1e-3 * largest),
                     "rms error in kA/m": decimals(1e-3 * rms),
                     "rms of error / sd": f"{ratio:.2f}"})
    further = [{"": key.replace("_", " "), "value": f"{value:.4g}"}
               for key, value in (figures or {}).items()]
    said = answer_beside_truth(magnet, known, truth)
    return Page("magnetizations", what, magnet.study, said, {}, [
        Section([Table(rows, "numbers")]),
        Section([Table(further, "numbers")] if further else [], "Further numbers")], rows=rows,
        figures={"magnetizations.png": (
            partial(_magnetizations_figure, magnet, known, truth, ring), f"Deviation of the "
            f"magnetizations of ring {ring} from nominal: truth, {', '.join(known)}; bars are "
            "standard deviations")}, stored=False)


def _magnetizations_figure(
    magnet: Magnet, known: Mapping[str, Gaussian], truth: Floats, ring: int
) -> Figure:
    """Draw deviations of a ring's magnetizations from nominal, a panel for each component."""
    size = magnet.dimension
    first, slots = sum(magnet.blocks_by_ring[:ring - 1]), magnet.blocks_by_ring[ring - 1]
    part = slice(first * size, (first + slots) * size)
    blocks = magnet.blocks[first:first + slots]
    nominal = np.concatenate([block.magnetization[:size] for block in blocks])
    figure = figure_of(1 + 2.4 * size)
    axes = figure.subplots(size, 1, sharex=True)
    places = np.arange(1, slots + 1)
    shifts = 0.3 * np.linspace(-0.5, 0.5, len(known))
    for axis, component in zip(axes, range(size), strict=True):
        def in_kiloamperes_per_m(values: Floats, component: int = component) -> Floats:
            return np.asarray(1e-3 * values[component::size])

        for (name, distribution), colour, shift in zip(
                known.items(), (PRIOR, POSTERIOR, SECOND), shifts, strict=False):
            axis.errorbar(places + shift, in_kiloamperes_per_m(distribution.mean[part] - nominal),
                          in_kiloamperes_per_m(distribution.sd[part]), color=colour, fmt="o", ms=4,
                          capsize=2, label=name)
        axis.plot(places, in_kiloamperes_per_m(truth[part] - nominal), "_", color=MEASURED, ms=14,
                  mew=2, label="truth", zorder=3)
        axis.set_ylabel(f"ΔM{COMPONENTS[component]} in kA/m")
        axis.grid(alpha=0.3)
    legend_above(figure, axes[0], columns=4)
    axes[-1].set_xlabel("slot")
    axes[-1].set_xticks(places)
    return figure
