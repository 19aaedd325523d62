"""Figure, table and page of a prior from measured blocks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import scipy.stats as stats
import xarray as xr
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.core.hdf5 import write_hdf5
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.block_prior import DIRECTIONS, NOT_NORMAL, MeasuredPrior, TypeSamples
from halbach_fe.report.page import MEASURED, PUBLISHED, save, write_page

UNITS = (100.0, np.degrees(1.0), np.degrees(1.0))
"""From relative deviations to percent along the magnetization and degrees across it."""

NOTHING = "–"
SIMULATIONS = 1000


def type_table(prior: MeasuredPrior) -> list[dict[str, str]]:
    """Rows of the table of types, as text: mean ± sd, and the adjusted p-values."""
    return [
        {"type": one.label, "n": str(len(one.deviations)),
         **{f"{name} in {unit}": f"{mean:+.2f} ± {sd}" for name, unit, mean, sd in zip(
             DIRECTIONS, ("%", "°", "°"), _mean(one),
             [NOTHING if np.isnan(sd) else f"{sd:.2f}" for sd in _sd(one)], strict=False)},
         **{f"p {name}": NOTHING if np.isnan(p) else f"{p:.2g}"
            for name, p in zip(DIRECTIONS, one.p, strict=False)}}
        for one in prior.types]


def prior_summary(magnet: Magnet, prior: MeasuredPrior) -> dict[str, object]:
    """What a script wants to know of a prior; percent along the nominal magnetization, degrees
    across it.
    """
    return {
        "study": magnet.name, "blocks": prior.count, "placed": prior.placed,
        "parameters": len(prior.nominal),
        "rms_sd_A_per_m": float(np.sqrt(np.mean(prior.gaussian.sd**2))),
        "rms_shift_A_per_m": float(np.sqrt(np.mean((prior.gaussian.mean - prior.nominal) ** 2))),
        "common_mode_sd": magnet.study.prior.common_mode_sd,
        "mounting_sd_deg": magnet.study.prior.mounting_sd_deg,
        "not_normal": [one.label for one in prior.types if not one.normal],
        "types": [
            {"type": one.label, "n": len(one.deviations),
             "mean_percent_deg": _mean(one).tolist(), "sd_percent_deg": _listed(_sd(one)),
             "anderson_darling_p": _listed(one.p), "shrinkage": one.intensity}
            for one in prior.types],
    }


def write_prior(magnet: Magnet, prior: MeasuredPrior, folder: Path) -> None:
    """Write prior.h5, prior.json, prior.html and its figure."""
    data = xr.Dataset(
        {name: ("parameter", values, {"units": "A/m"}) for name, values in (
            ("nominal", prior.nominal), ("prior_mean", prior.gaussian.mean),
            ("prior_sd", prior.gaussian.sd))},
        coords={"parameter": list(magnet.parameter_names)},
        attrs={"study": magnet.study.model_dump_json()})
    data["prior_covariance"] = (("parameter", "parameter_2"), prior.gaussian.covariance,
                                {"units": "A2/m2"})
    write_hdf5(data, folder / "prior.h5")
    summary = prior_summary(magnet, prior)
    write_text(folder / "prior.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    pictures = save({"prior_qq.png": (
        _quantiles(prior), "Standardized deviations of all blocks from the mean of their type "
        "against normal quantiles; each point of normal samples of the same numbers lies between "
        "the dashed lines 95 times in 100")}, folder)
    write_page(folder / "prior.html", "prior.html.j2", pictures, study=magnet.study, prior=prior,
               summary=summary, rows=type_table(prior), level=NOT_NORMAL)


def _mean(one: TypeSamples) -> Floats:
    return np.asarray(one.deviations.mean(axis=0) * UNITS[:one.deviations.shape[1]])


def _sd(one: TypeSamples) -> Floats:
    """NaN for a single block."""
    if len(one.deviations) < 2:
        return np.full(one.deviations.shape[1], np.nan)
    return np.asarray(one.deviations.std(axis=0, ddof=1) * UNITS[:one.deviations.shape[1]])


def _listed(values: Floats) -> list[float | None]:
    return [None if np.isnan(value) else float(value) for value in values]


def _standardized(samples: Floats) -> Floats:
    """Samples (n, ...) of one type, less their mean, over their sd; 0 if they are all the same."""
    spread = samples.std(axis=0, ddof=1)
    return np.asarray((samples - samples.mean(axis=0)) / np.where(spread > 0, spread, 1.0))


def _quantiles(prior: MeasuredPrior) -> Figure:
    """Types standardized with their own mean and sd, which the band takes into account."""
    groups = [one.deviations for one in prior.types if len(one.deviations) > 2]
    figure = Figure(figsize=(10, 3.9), layout="constrained")
    axes = figure.subplots(1, prior.types[0].deviations.shape[1], sharey=True, squeeze=False)[0]
    if not groups:
        axes[0].text(0.5, 0.5, "fewer than three blocks of every type", ha="center",
                     transform=axes[0].transAxes)
        return figure
    count = sum(len(group) for group in groups)
    expected = stats.norm.ppf((np.arange(count) + 0.5) / count)
    generator = np.random.default_rng(1)
    simulated = np.sort(np.concatenate([
        _standardized(generator.standard_normal((len(group), SIMULATIONS))) for group in groups
    ]), axis=0)
    band = np.quantile(simulated, [0.025, 0.5, 0.975], axis=1)
    found = np.sort(np.concatenate([_standardized(group) for group in groups]), axis=0)
    for axis, name, values in zip(axes, DIRECTIONS, found.T, strict=False):
        axis.plot(expected, band[1], color=PUBLISHED, lw=0.8)
        axis.plot(expected, band[[0, 2]].T, color=PUBLISHED, lw=0.8, ls="--")
        axis.plot(expected, values, ".", color=MEASURED, ms=4)
        axis.set(title=name, xlabel="normal quantile")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("standardized deviation")
    return figure
