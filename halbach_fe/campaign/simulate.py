"""A synthetic measurement campaign: block table, map, held-out map, and the truth.

The field is by magpylib, and by NGSolve what permeability and iron add; halbach-fe's own model of
the field has no part in it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.block_table import BlockTable, write_blocks
from halbach_fe.campaign.blocks import coil_table, draw, magnetizations
from halbach_fe.campaign.bodies import Floats, Magnet, magnet_of
from halbach_fe.campaign.extras import version_of
from halbach_fe.campaign.positions import between
from halbach_fe.campaign.reaction import Elements, reaction_field
from halbach_fe.campaign.vacuum import Progress, silent, vacuum_field
from halbach_fe.errors import StudyError, must_be
from halbach_fe.field_map import atomic, field_map, write_map
from halbach_fe.observation import noise_regions, points_from
from halbach_fe.study import COMPONENTS, Study

COIL_SD = 0.001
"""Noise of a Helmholtz coil over the moment; usual coils reach 0.1 %."""

DIGITS = 12
"""Fields are kept to 1e-12 T: the same seed gives the same files, whatever the order in which two
processors sum."""

LARGEST_CSV = 5e6 / 20
"""Numbers in a map, of some 20 characters each, beyond which it is HDF5."""

Field = Callable[[Magnet, Floats], Floats]


@dataclass(frozen=True)
class Campaign:
    """What was measured, and what is known of it.

    Attributes
    ----------
    readings, held_out : xarray.Dataset
        See `halbach_fe.field_map`; no held-out map where the study has one point only.
    blocks : BlockTable
    truth : dict
        As plain data.
    """

    readings: xr.Dataset
    held_out: xr.Dataset | None
    blocks: BlockTable
    truth: dict[str, object]


def simulate(
    study: Study, seed: int, coil_sd: float = COIL_SD, elements: Elements | None = None,
    progress: Progress = silent,
) -> Campaign:
    """Build, measure and describe one magnet.

    Raises
    ------
    StudyError
        If the study does not say how noisy its readings are, or measures inside of material.
    ExtraMissingError
        If magpylib or NGSolve is not installed.
    """
    points, others = points_from(study.observation.positions), between(study.observation.positions)
    sigma, other_sigma = point_noise(study, points), point_noise(study, others)
    blocks, coil, noise, other_noise = (np.random.default_rng(part) for part in
                                        np.random.SeedSequence(seed).spawn(4))
    nominal = magnet_of(study)
    drawn = draw(study, nominal, blocks)
    table, calibration = coil_table(study, nominal, drawn.single, coil_sd, coil)
    magnet = drawn.mounted
    check_air(study, magnet, np.vstack([points, others]))
    places = [real_places(study, one, generator)
              for one, generator in ((points, noise), (others, other_noise))]
    field = field_of(magnet, np.vstack(places), elements, progress).round(DIGITS)
    truth: dict[str, object] = {
        "study": study.name, "seed": seed, "model": model_of(magnet),
        "common_mode": drawn.common, "coil_calibration": calibration, "coil_sd": coil_sd,
        "effects": [], "blocks": magnetizations(magnet),
        "noise_free": {"largest_T": float(np.linalg.norm(field, axis=1).max()),
                       "rms_T": np.sqrt(np.mean(field**2, axis=0)).round(DIGITS).tolist()},
    }
    seal = {"source": "synthetic", "study": study.name, "halbach_fe": version_of("halbach-fe"),
            "truth_sha256": hashlib.sha256(truth_text(truth).encode()).hexdigest()}
    at, other = field[:len(points)], field[len(points):]
    return Campaign(
        _measured(study, points, at, sigma, noise, seal),
        _measured(study, others, other, other_sigma, other_noise, seal) if len(others) else None,
        table, truth)


def field_of(
    magnet: Magnet, points: Floats, elements: Elements | None = None, progress: Progress = silent
) -> Floats:
    """B (n, 3) in T of a magnet at points (n, 3) in m in air."""
    return (vacuum_field(magnet.bodies, points, progress)
            + reaction_field(magnet, points, elements) + magnet.background)


def model_of(magnet: Magnet) -> dict[str, str]:
    """Which programs make a magnet's field, with their versions."""
    programs = {"vacuum": f"magpylib {version_of('magpylib')}"}
    if not magnet.is_vacuum:
        programs["reaction"] = f"NGSolve {version_of('ngsolve')}"
    return programs


def point_noise(study: Study, points: Floats) -> Floats:
    """Standard deviation (n, 3) in T of the components at points (n, 3) in m.

    Fourier coefficients of n points have 2/n of the points' variance, and the study's sigma is
    theirs.
    """
    if study.noise is None or not study.noise.regions:
        raise StudyError(must_be("`noise.regions`", f"study {study.name}",
                                 "given for a simulated measurement", "nothing",
                                 "Add [[noise.regions]]."))
    sigma = np.array([region.sigma_T for region in study.noise.regions])
    fourier = study.observation.quantity == "fourier_coefficients"
    names = ["" if fourier or name not in observed(study) else name for name in COMPONENTS]
    chosen = sigma[noise_regions(study.noise, np.repeat(points[:, 2], 3), names * len(points))]
    if study.observation.quantity == "fourier_coefficients":
        chosen = chosen * np.sqrt(study.observation.positions.angles / 2)
    return chosen.reshape(-1, 3)


def observed(study: Study) -> tuple[str, ...]:
    """Components that the study's map holds."""
    if study.observation.quantity == "fourier_coefficients":
        return "x", "y"
    return study.observation.components


def real_places(study: Study, points: Floats, generator: np.random.Generator) -> Floats:
    """Where the probe was, (n, 3) in m, in place of points that are uncertain."""
    if study.noise is None or study.noise.position_sd_m is None:
        return points
    sd = np.array(study.noise.position_sd_m)
    return np.asarray(points + sd * generator.standard_normal(points.shape))


def check_air(study: Study, magnet: Magnet, points: Floats) -> None:
    """Refuse points inside of material."""
    inside = magnet.holds(points)
    if inside.any():
        x, y, z = points[int(np.argmax(inside))]
        raise StudyError(must_be(
            "`observation.positions`", f"study {study.name}", "in air, as those half a step between"
            " them", f"({x:g}, {y:g}, {z:g}) m, inside magnet or iron"))


def _measured(
    study: Study, points: Floats, field: Floats, sigma: Floats, generator: np.random.Generator,
    seal: dict[str, str],
) -> xr.Dataset:
    """A map with noise, of the components that the study observes."""
    noise = sigma * generator.standard_normal(field.shape)
    readings = np.where([name in observed(study) for name in COMPONENTS], field + noise, np.nan)
    # the study tells the noise of flux densities itself
    known = None if study.observation.quantity == "flux_density" else sigma
    return field_map(points, readings.round(DIGITS), known, seal)


def truth_text(truth: dict[str, object]) -> str:
    """The truth as it is written, and sealed."""
    return json.dumps(truth, indent=1, allow_nan=False) + "\n"


def write_campaign(campaign: Campaign, folder: Path) -> list[Path]:
    """Write blocks.csv, map and held-out (.csv, or .h5 if large), and truth/truth.json."""
    write_blocks(campaign.blocks, folder / "blocks.csv")
    written = [folder / "blocks.csv"]
    for name, data in (("map", campaign.readings), ("held-out", campaign.held_out)):
        if data is None:
            continue
        path = folder / f"{name}{'.csv' if 9 * data.sizes['point'] < LARGEST_CSV else '.h5'}"
        write_map(data, path)
        written.append(path)
    written.append(folder / "truth" / "truth.json")
    with atomic(written[-1]) as temporary:
        temporary.write_text(truth_text(campaign.truth), encoding="utf-8")
    return written
