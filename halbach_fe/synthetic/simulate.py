"""A synthetic measurement campaign: block table, map, held-out map, and the truth.

The field is by magpylib, and by NGSolve what permeability and iron add; halbach-fe's own model of
the field has no part in it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.files import atomic
from halbach_fe.measurement.block_table import BlockTable, write_blocks
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.reading_noise import noise_regions
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.bodies import TrueMagnet, magnet_of
from halbach_fe.synthetic.drawn_blocks import coil_table, draw_magnet, magnetizations
from halbach_fe.synthetic.extras import version_of
from halbach_fe.synthetic.hidden_effects import Wanted, chosen, instrument_with, with_effects
from halbach_fe.synthetic.hidden_effects.kinds import site_of
from halbach_fe.synthetic.instrument import FaultyInstrument
from halbach_fe.synthetic.magpylib_field import Progress, silent, vacuum_field
from halbach_fe.synthetic.ngsolve_reaction import Elements, moment_field, reaction_field
from halbach_fe.synthetic.positions import between

COIL_SD = 0.001
"""Noise of a Helmholtz coil over the moment; usual coils reach 0.1 %."""

DIGITS = 12
"""Fields are kept to 1e-12 T: the same seed gives the same files, whatever the order in which two
processors sum."""

SECONDS = 1.0
"""Between two readings; held-out points are measured after the map."""

LARGEST_CSV = 5e6 / 20
"""Numbers in a map, of some 20 characters each, beyond which it is HDF5."""


@dataclass(frozen=True)
class SimulatedCampaign:
    """What was measured, and what is known of it.

    Attributes
    ----------
    readings, held_out : xarray.Dataset
        See `halbach_fe.measurement.field_map`; no held-out map where the study has one point only.
    blocks : BlockTable
    truth : dict
        As plain data.
    without_noise : ndarray, shape (n, 3)
        The readings of the map, as they would be without it.
    """

    readings: xr.Dataset
    held_out: xr.Dataset | None
    blocks: BlockTable
    truth: dict[str, object]
    without_noise: Floats


def simulate_campaign(
    study: Study, seed: int, coil_sd: float = COIL_SD, hide: Sequence[Wanted] = (),
    hide_random: int = 0, elements: Elements | None = None, progress: Progress = silent,
) -> SimulatedCampaign:
    """Build, measure and describe one magnet.

    Parameters
    ----------
    hide : sequence of pairs
        Effects, and their values unless those are to be drawn; they are applied in this order.
    hide_random : int
        How many more effects are drawn.

    Raises
    ------
    StudyError
        If the study does not say how noisy its readings are, measures inside of material, or cannot
        have an effect.
    ExtraMissingError
        If magpylib or NGSolve is not installed.
    """
    points, others = points_from(study.observation.positions), between(study.observation.positions)
    sigma = point_noise(study, np.vstack([points, others]))
    blocks, coil, noise, effects, faults = (  # what one draws does not change the others
        np.random.default_rng(part) for part in np.random.SeedSequence(seed).spawn(5))
    nominal = magnet_of(study)
    site = site_of(study, nominal)
    hidden = chosen(site, hide, hide_random, effects)
    drawn = draw_magnet(study, nominal, blocks)
    table, calibration = coil_table(study, nominal, with_effects(
        drawn.single, site, hidden, single=True), coil_sd, coil)
    magnet, instrument = with_effects(drawn.mounted, site, hidden), instrument_with(site, hidden)
    nominal_places = np.vstack([points, others])
    offsets = real_places(study, nominal_places, noise) - nominal_places
    recorded, readings = measured(
        magnet, instrument, points, others, elements, faults, progress, offsets)
    truth: dict[str, object] = {
        "study": study.name, "seed": seed, "model": model_of(magnet),
        "effects": [one.plain() for one in hidden],
        "common_mode": drawn.common, "coil_calibration": calibration, "coil_sd": coil_sd,
        "noise_free": {"largest_T": float(np.linalg.norm(readings, axis=1).max()),
                       "rms_T": np.sqrt(np.mean(readings**2, axis=0)).round(DIGITS).tolist()},
        "blocks": magnetizations(drawn.mounted),
    }
    if magnet.bodies != drawn.mounted.bodies:
        truth["blocks_with_effects"] = magnetizations(magnet)
    seal = {"source": "synthetic", "study": study.name, "halbach_fe": version_of("halbach-fe"),
            "truth_sha256": hashlib.sha256(truth_text(truth).encode()).hexdigest()}
    unit, exact = instrument.field_unit, readings[:len(points)].copy()
    readings += unit * np.nan_to_num(sigma) * noise.standard_normal(readings.shape)
    maps = [_map(study, recorded[part], readings[part], unit * sigma[part], seal)
            .assign(time_s=("point", SECONDS * np.arange(len(recorded))[part]))
            for part in (slice(len(points)), slice(len(points), None))]
    return SimulatedCampaign(maps[0], maps[1] if len(others) else None, table, truth, exact)


def measured(
    magnet: TrueMagnet, instrument: FaultyInstrument, points: Floats, others: Floats,
    elements: Elements | None, generator: np.random.Generator, progress: Progress,
    offsets: Floats | None = None,
) -> tuple[Floats, Floats]:
    """What is written down: points and readings without noise, both (n, 3), of the map and the
    held-out points, one after the other; the probe was ``offsets`` (n, 3) in m from there.
    """
    nominal = np.vstack([points, others])
    places = instrument.places(nominal, generator)
    if offsets is not None:
        places = places + offsets  # of all sensors
    # mostly the three sensors are in one place
    distinct, inverse = np.unique(places.reshape(-1, 3), axis=0, return_inverse=True)
    check_air(magnet, distinct)
    fields = true_field(magnet, distinct, elements, progress)[inverse].reshape(places.shape)
    time = np.arange(len(nominal)) / max(1, len(points) - 1)
    recorded, readings = instrument.record(
        nominal, instrument.readings(fields, time, generator))
    return recorded, readings.round(DIGITS)


def true_field(
    magnet: TrueMagnet, points: Floats, elements: Elements | None = None,
    progress: Progress = silent
) -> Floats:
    """B (n, 3) in T of a magnet at points (n, 3) in m in air."""
    spheres = np.array([one.place for one in magnet.objects]).reshape(-1, 3)
    everywhere = np.vstack([points, spheres])
    field = (vacuum_field(magnet.all_bodies, everywhere, progress)
             + reaction_field(magnet, everywhere, elements) + magnet.background)
    result = field[:len(points)]
    for sphere, own in zip(magnet.objects, field[len(points):], strict=True):
        result = result + moment_field(np.array([sphere.place]), 3 * sphere.volume * own[None],
                                       points)
    return result


def model_of(magnet: TrueMagnet) -> dict[str, str]:
    """Which programs make a magnet's field, with their versions."""
    programs = {"vacuum": f"magpylib {version_of('magpylib')}"}
    if not magnet.is_vacuum:
        programs["reaction"] = f"NGSolve {version_of('ngsolve')}"
    return programs


def point_noise(study: Study, points: Floats) -> Floats:
    """Standard deviations (n, 3) in T of the components at points (n, 3) in m; NaN of those that
    the study does not observe.

    Fourier coefficients of n points have 2/n of the points' variance, and the study's sigma is
    theirs.
    """
    if study.noise is None or not study.noise.regions:
        raise StudyError(must_be("`noise`", f"study {study.name}",
                                 "given for a simulated measurement", "nothing",
                                 "Add [[noise.regions]]."))
    sigma = np.array([region.sigma_T for region in study.noise.regions])
    result = np.full((len(points), 3), np.nan)
    for number, name in enumerate(COMPONENTS):
        if name in observed_components(study):
            result[:, number] = sigma[noise_regions(study.noise, points[:, 2],
                                                    (name,) * len(points))]
    if study.observation.quantity == "fourier_coefficients":
        result *= np.sqrt(study.observation.positions.angles / 2)
    return result


def observed_components(study: Study) -> tuple[str, ...]:
    """Which components of B a study's readings are made of."""
    observed = study.observation
    return ("x", "y") if observed.quantity == "fourier_coefficients" else observed.components


def real_places(study: Study, points: Floats, generator: np.random.Generator) -> Floats:
    """Where the probe was, (n, 3) in m, in place of points that are uncertain."""
    if study.noise is None or study.noise.position_sd_m is None:
        return points
    sd = np.array(study.noise.position_sd_m)
    return np.asarray(points + sd * generator.standard_normal(points.shape))


def check_air(magnet: TrueMagnet, points: Floats) -> None:
    """Refuse points inside of material."""
    inside = magnet.holds(points)
    if inside.any():
        x, y, z = points[int(np.argmax(inside))]
        raise StudyError(must_be(
            "`observation.positions`", "the study", "in air, as those half a step between them and "
            "where hidden effects take the probe", f"({x:g}, {y:g}, {z:g}) m, inside magnet or "
            "iron"))


def _map(
    study: Study, points: Floats, readings: Floats, sigma: Floats, seal: dict[str, str]
) -> xr.Dataset:
    """A map of the components that the study observes."""
    # the study tells the noise of flux densities itself
    known = None if study.observation.quantity == "flux_density" else sigma
    shown = np.where([name in observed_components(study) for name in COMPONENTS], readings, np.nan)
    return field_map(points, shown.round(DIGITS), known, seal)


def truth_text(truth: dict[str, object]) -> str:
    """The truth as it is written, and sealed."""
    return json.dumps(truth, indent=1, allow_nan=False) + "\n"


def write_campaign(campaign: SimulatedCampaign, folder: Path) -> list[Path]:
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
