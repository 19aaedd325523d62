"""Page of `prior`: figure and table of measurements of single blocks."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy import special

from halbach_fe.core.arrays import Floats, radii_of, rms
from halbach_fe.core.numbers import EMPTY_CELL
from halbach_fe.core.untrusted_files import write_hdf5
from halbach_fe.inference.block_prior import DIRECTIONS, NOT_NORMAL, MeasuredPrior, TypeSamples
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    MEASURED,
    PUBLISHED,
    Page,
    Plain,
    Rows,
    Section,
    Table,
    Text,
    charts,
)
from halbach_fe.report.words import counted, fraction, p_value, with_unit

UNITS = (100.0, np.degrees(1.0), np.degrees(1.0))
"""Factors that convert relative deviations to percent (along the magnetization) and to degrees
(across it)."""

PARTS = ("in length", "in direction, in the plane of the ring", "in direction, towards z")
"""Parts of the deviation of a magnetization from the nominal one."""


def type_table(prior: MeasuredPrior) -> Rows:
    """Return the rows of the table of block types, as text: mean ± sd and adjusted p-values.

    Columns of p-values are left out if no type has enough blocks for the test.
    """
    tested = _tested(prior)
    return [
        {"type": samples.label, "blocks": str(len(samples.deviations)),
         **{f"{name} in {unit}": f"{mean:+.2f}{sd}" for name, unit, mean, sd in zip(
             DIRECTIONS, ("%", "°", "°"), _mean_of_type(samples),
             ["" if np.isnan(sd) else f" ± {sd:.2f}" for sd in _sd_of_type(samples)],
             strict=False)},
         **{f"p {name}": EMPTY_CELL if np.isnan(p) else p_value(p)
            for name, p in zip(DIRECTIONS, samples.p, strict=False) if tested}}
        for samples in prior.types]


def _tested(prior: MeasuredPrior) -> bool:
    """Whether any type has enough blocks to test their distribution."""
    return any(not np.isnan(samples.p).all() for samples in prior.types)


def _summary(prior: MeasuredPrior) -> Plain:
    """Return the content of prior.json.

    Deviations are in percent along the nominal magnetization and in degrees across it.
    """
    return {
        "study": prior.magnet.name, "blocks": prior.count, "placed": prior.placed,
        "parameters": len(prior.nominal),
        "rms_sd_A_per_m": rms(prior.gaussian.sd),
        "rms_shift_A_per_m": rms(prior.gaussian.mean - prior.nominal),
        "common_mode_sd": prior.magnet.study.prior.calibration_sd,
        "mounting_sd_deg": prior.magnet.study.prior.mounting_sd_deg,
        "doubts": list(prior.doubts), "far": prior.far,
        "not_normal": [samples.label for samples in prior.types if not samples.normal],
        "types": [
            {"type": samples.label, "n": len(samples.deviations),
             "mean_percent_deg": _mean_of_type(samples).tolist(),
             "sd_percent_deg": _json_list(_sd_of_type(samples)),
             "anderson_darling_p": _json_list(samples.p), "shrinkage": samples.intensity}
            for samples in prior.types],
    }


def parts_table(prior: MeasuredPrior) -> Rows:
    """Return rows of text: how far blocks deviate from the study, and how far they remain unknown,
    along the nominal magnetization, across it, and together.
    """
    size, count = prior.magnet.dimension, len(prior.magnet.blocks)
    nominal = prior.nominal.reshape(count, size)
    there = np.linalg.norm(nominal, axis=1) > 0
    nominal = nominal[there]
    shift = (prior.gaussian.mean - prior.nominal).reshape(count, size)[there]
    covariance = prior.gaussian.covariance.reshape(count, size, count, size)
    own = np.einsum("iaib->iab", covariance)[there]
    axes = _axes(nominal)
    square = np.sum(nominal**2, axis=1)[:, None]
    weight = square / square.mean()
    squares = {
        "deviation from the study": np.einsum("ikb,ib->ik", axes, shift)**2 / square,
        "unknown now (sd)": np.einsum("ika,iab,ikb->ik", axes, own, axes) / square}
    rows = []
    for name, values in squares.items():
        parts = np.sqrt(np.mean(weight * values, axis=0))
        rows.append({"rms over the blocks": name} | {
            PARTS[number]: f"{100 * part:.2f}\u00a0%" if not number else
            f"{np.degrees(part):.2f}° = {100 * part:.2f}\u00a0%"
            for number, part in enumerate(parts.tolist())} | {
            "together": f"{100 * float(np.linalg.norm(parts)):.2f}\u00a0%"})
    return rows


def _axes(nominal: Floats) -> Floats:
    """Return unit vectors (n, dimension, dimension) along magnetizations (n, dimension), across
    them in the plane of the ring, and for three dimensions across both.
    """
    along = nominal / np.linalg.norm(nominal, axis=1)[:, None]
    if nominal.shape[1] == 2:
        return np.stack([along, np.column_stack([-along[:, 1], along[:, 0]])], axis=1)
    # part of a magnetization in the plane of the ring below which it is along z
    along_z = 1e-9
    flat = radii_of(along)[:, None] > along_z
    across = np.where(flat, np.column_stack([-along[:, 1], along[:, 0], 0 * along[:, 0]]),
                      [0.0, 1.0, 0.0])
    across = across / np.linalg.norm(across, axis=1)[:, None]
    return np.stack([along, across, np.cross(along, across)], axis=1)


def answer(prior: MeasuredPrior) -> Answer:
    """Say how the measured blocks deviate from the study, and what to do next."""
    # Part of a standard deviation from which a contribution makes more than half of the variance.
    mostly = 0.5 ** 0.5
    size = rms(prior.nominal)
    spread, shift = rms(prior.gaussian.sd) / size, rms(prior.gaussian.mean - prior.nominal) / size
    strength = float(np.mean(np.concatenate([each.deviations[:, 0] for each in prior.types])))
    weights = prior.nominal / np.sum(prior.nominal**2)  # of the mean strength of all blocks
    common = float(prior.gaussian.sd_of(weights[None])[0])
    side = "stronger" if strength > 0 else "weaker"
    said = (f"On average the {counted(prior.count, 'measured block')} are "
            f"{with_unit(abs(strength), common, '%')} {side} than the study says. "
            "In length and direction together they deviate from it by "
            f"{fraction(shift)} rms, and each is now known to {fraction(spread)}"
            + (", most of which is the calibration of the coil, which all blocks share"
               if common > mostly * spread else "") + ". " + (
                "The place of every block is known: each has its own measurement."
                if prior.placed else "Which block is in which place is not known: all blocks of a "
                "type have its mean and spread."))
    odd = [samples.label for samples in prior.types if not samples.normal]
    tested = _tested(prior)
    trust = ("Yes: it is what the table says. No type has enough blocks to test whether their "
             "deviations are distributed normally."
             if not tested and not prior.placed else "Yes: it is what the table says of each block."
             if not tested else
             "Yes: nothing speaks against normally distributed deviations, which the prior "
             "assumes." if not odd else
             f"Only as mean and spread: the deviations of type {', '.join(odd)} are unlikely to be "
             f"distributed normally (Anderson-Darling test, p below {NOT_NORMAL} after Holm's "
             "correction)."
             + ("" if prior.placed else " The prior treats them as normal nevertheless."))
    if prior.far:
        said += f" {prior.far}"
    if prior.doubts:
        trust = f"Not yet. {' '.join(prior.doubts)}"
    return Answer(
        "What do the measured blocks say about the magnet?", said, trust,
        "Answer this first; then update the magnet with these blocks and a field map."
        if prior.doubts else
        "Update the magnet with these blocks and a field map." if not odd or prior.placed else
        "Add ring and slot of every block to the table: then the distribution does not matter.",
        "halbach-fe infer STUDY --measurements MAP --blocks BLOCKS -o DIR",
        (prior.placed or not odd) and not prior.doubts)


def page(prior: MeasuredPrior) -> Page:
    """Return the page of what measured blocks say about a magnet."""
    magnet, parts, rows = prior.magnet, parts_table(prior), type_table(prior)
    common, mounting = magnet.study.prior.calibration_sd, magnet.study.prior.mounting_sd_deg
    calibration = (
        f"All blocks share a calibration error of {100 * common:.3g} % (sd)." if common > 0 else
        "The study has no `prior.common_mode_sd`: the calibration of the coil is assumed to be "
        "exact.")
    turned = (
        f"Each block may be turned by {mounting:.3g}° (sd) about each axis when mounted."
        if mounting > 0 else "The study has no `prior.mounting_sd_deg`: blocks are assumed to be "
        "mounted without angular errors.")
    table = magnet.array.free_blocks
    types = ("A type is what the table of free blocks of the study calls so; a block that it gives "
             "none is a type by itself."  # see `types_of`
             if table is not None and table.type and not magnet.study.prior.types else
             "A type is a kind of block that fits the slots of [prior.types] of the study; without "
             "it, every slot number is a type.")
    tested = ("" if not _tested(prior) else " p is the p-value of the Anderson-Darling test for "
              "normality, after Holm's correction; – means that there are too few blocks for the "
              "test.")
    figure = {"prior_qq.png": (
        partial(_standardized_deviations_figure, prior), "Quantiles of the standardized deviations "
        "of all blocks from the mean of their type against normal quantiles. The dashed lines are "
        "the 95 % band of each quantile for normally distributed samples of the same sizes")
    } if any(len(samples.deviations) > 2 for samples in prior.types) else {"prior_blocks.png": (
        partial(_deviations_figure, prior), "Deviation of each block from the study's "
        "magnetization: along it, and across it")}
    sizes = [1e-3 * rms(prior.gaussian.mean - prior.nominal), 1e-3 * rms(prior.gaussian.sd)]
    return Page("prior", "prior from measured blocks", magnet.study, answer(prior),
                _summary(prior), [
        Section([f"{calibration} {turned}"]),
        Section([
            "A block differs from the study in the length of its magnetization and in its "
            "direction, by an angle in the plane of its ring"
            f"{' and one towards z' * (magnet.dimension == 3)}. An angle of 1° moves the tip of "
            "the vector by 1.75 % of its length. Together is the length of the difference of the "
            "two vectors: the root of the sum of the squares.",
            Table(parts, "numbers"),
            Text("In each component of the magnetization, deviation and standard deviation are "
                 "{:.3g}\u00a0kA/m and {:.3g}\u00a0kA/m (rms over all components).".format(*sizes),
                 "small")], "How the per cent add up"),
        Section([
            f"{types} Mean ± standard deviation relative to the study's nominal magnetization: "
            f"along it, across it in the plane of the ring, and along z.{tested}",
            Table(rows, "numbers")], "By type")],
        {"Measured blocks relative to the nominal, by type": rows}, figures=figure,
        files={"prior.h5": partial(_write_prior, prior)})


def _write_prior(prior: MeasuredPrior, path: Path) -> None:
    """Write prior.h5."""
    data = xr.Dataset(
        {name: ("parameter", values, {"units": "A/m"}) for name, values in (
            ("nominal", prior.nominal), ("prior_mean", prior.gaussian.mean),
            ("prior_sd", prior.gaussian.sd))},
        coords={"parameter": list(prior.magnet.parameter_names)},
        attrs={"study": prior.magnet.study.model_dump_json()})
    data["prior_covariance"] = (("parameter", "parameter_2"), prior.gaussian.covariance,
                                {"units": "A2/m2"})
    write_hdf5(data, path)


def _mean_of_type(samples: TypeSamples) -> Floats:
    """Return mean deviations in percent and degrees."""
    deviations = samples.deviations
    return np.asarray(deviations.mean(axis=0) * UNITS[:deviations.shape[1]])


def _sd_of_type(samples: TypeSamples) -> Floats:
    """Return sample standard deviations in percent and degrees; NaN for a single block."""
    deviations = samples.deviations
    if len(deviations) < 2:
        return np.full(deviations.shape[1], np.nan)
    return np.asarray(deviations.std(axis=0, ddof=1) * UNITS[:deviations.shape[1]])


def _json_list(values: Floats) -> list[float | None]:
    """Return a list with None in place of NaN, which JSON cannot express."""
    return [None if np.isnan(value) else float(value) for value in values]


def _standardized(samples: Floats) -> Floats:
    """Return samples (n, ...) minus their mean, divided by their sd; 0 if all are equal."""
    spread = samples.std(axis=0, ddof=1)
    return np.asarray((samples - samples.mean(axis=0)) / np.where(spread > 0, spread, 1.0))


def _deviations_figure(prior: MeasuredPrior) -> Figure:
    """Draw the deviations of all blocks, in the order of their types."""
    deviations = np.vstack([samples.deviations for samples in prior.types])
    count = deviations.shape[1]
    figure, axes = charts(1 + 1.8 * count, count, sharex=True)
    for axis, name, unit, factor, values in zip(axes, DIRECTIONS, ("%", "°", "°"), UNITS,
                                                deviations.T, strict=False):
        axis.axhline(0, color=PUBLISHED, lw=0.8)
        axis.plot(np.arange(1, len(values) + 1), factor * values, "o", color=MEASURED, ms=4)
        axis.set_ylabel(f"{name} in {unit}")
    axes[-1].set_xlabel("block, by type")
    axes[-1].locator_params("x", integer=True)
    return figure


def _standardized_deviations_figure(prior: MeasuredPrior) -> Figure:
    """Draw the quantiles of all blocks, each standardized with the mean and sd of its type.

    The simulated samples of the band are standardized in the same way.
    """
    # Number of simulated normal samples from which the band of the figure is taken.
    simulations = 1000
    groups = [samples.deviations for samples in prior.types if len(samples.deviations) > 2]
    figure, axes = charts(3.9, 1, prior.types[0].deviations.shape[1], sharey=True)
    count = sum(len(group) for group in groups)
    expected = special.ndtri((np.arange(count) + 0.5) / count)
    generator = np.random.default_rng(1)
    simulated = np.sort(np.concatenate([
        _standardized(generator.standard_normal((len(group), simulations))) for group in groups
    ]), axis=0)
    band = np.quantile(simulated, [0.025, 0.5, 0.975], axis=1)
    found = np.sort(np.concatenate([_standardized(group) for group in groups]), axis=0)
    for axis, name, values in zip(axes, DIRECTIONS, found.T, strict=False):
        axis.plot(expected, band[1], color=PUBLISHED, lw=0.8)
        axis.plot(expected, band[[0, 2]].T, color=PUBLISHED, lw=0.8, ls="--")
        axis.plot(expected, values, ".", color=MEASURED, ms=4)
        axis.set(title=name, xlabel="normal quantile")
    axes[0].set_ylabel("standardized deviation")
    return figure
