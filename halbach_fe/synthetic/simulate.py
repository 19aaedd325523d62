"""A synthetic measurement campaign: blocks drawn from the prior, their table, maps, and the truth.

magpylib computes the field of the blocks in vacuum, and NGSolve the field that permeability and
iron add; see `halbach_fe.synthetic.magpylib_field` and `halbach_fe.synthetic.reaction` for the
cases that have methods of their own. halbach-fe's model of the field is not used, so that it can be
tested on the result.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib.metadata import version as version_of
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, spread
from halbach_fe.core.errors import HalbachWarning, StudyError, must_be
from halbach_fe.core.files import write_text
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.progress import Progress
from halbach_fe.measurement.block_table import BlockTable, write_blocks
from halbach_fe.measurement.field_map import field_map, total_field_map, write_map
from halbach_fe.measurement.positions import between, points_from
from halbach_fe.measurement.reading_noise import noise_regions
from halbach_fe.study.external_keys import check_apart
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.hidden_effects import (
    RequestedEffect,
    choose_effects,
    doubt_size,
    instrument_with,
    with_effects,
)
from halbach_fe.synthetic.hidden_effects.effect_types import ChosenEffect, Site, site_of
from halbach_fe.synthetic.hidden_effects.instrument_effects import (
    IDEAL_AXES,
    FaultyInstrument,
    columns,
    stated_places,
    stated_readings,
)
from halbach_fe.synthetic.magpylib_field import no_progress, vacuum_field
from halbach_fe.synthetic.ngsolve_reaction import USUAL_ORDER, Elements, moment_field
from halbach_fe.synthetic.reaction import (
    by_elements,
    lone_moment_matrix,
    lost_field,
    reaction_field,
)
from halbach_fe.synthetic.shapes import Shape
from halbach_fe.synthetic.true_magnet import (
    ZERO_VECTOR,
    Body,
    TrueMagnet,
    check_room,
    distance_from,
    in_places,
    in_words,
    vector,
)
from halbach_fe.synthetic.true_magnet_of_study import beside_magnet, magnet_of

COIL_SD = 0.001
"""Noise of a Helmholtz coil relative to the moment; usual coils reach 0.1 %."""

DIGITS = 12
"""Decimals of fields in T.

Rounding to 1e-12 T makes the files depend on the seed only, and not on the order in which
processors sum.
"""

SECONDS = 1.0
"""Time in s between two readings; the held-out points are measured after the map."""

IDEAL = Instrument()

LARGEST_CSV = 5e6 / 20
"""Count of numbers in a map, of some 20 characters each, from which it is written as HDF5."""


@dataclass(frozen=True)
class SimulatedCampaign(ShownInNotebook):
    """The measurements of a synthetic campaign, and the truth behind them.

    Attributes
    ----------
    study : Study
    readings, held_out : xarray.Dataset
        The two maps, see `halbach_fe.measurement.field_map`. The held-out map is None if the study
        has one point only.
    blocks : BlockTable
        Moments of the single blocks, measured in a Helmholtz coil.
    truth : dict
        The magnetizations, hidden effects and other numbers that were drawn, as plain data.
    without_noise : ndarray, shape (n, 3)
        Readings of the map before noise was added, in the field unit of the record; (n, 1) of a map
        of |B|.
    magnet : TrueMagnet
        The magnet that was measured, with what is hidden in it.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> campaign = hf.simulate_measurement(hf.read_study("dipole.toml"))
    >>> campaign.without_noise.shape, len(campaign.blocks)
    ((24, 3), 16)
    """

    study: Study
    readings: xr.Dataset
    held_out: xr.Dataset | None
    blocks: BlockTable
    truth: dict[str, object]
    without_noise: Floats
    magnet: TrueMagnet


def simulate_campaign(
    study: Study, seed: int, coil_sd: float = COIL_SD, hide: Sequence[RequestedEffect] = (),
    hide_random: int = 0, elements: Elements | None = None, progress: Progress = no_progress,
    placed: BlockTable | None = None, magnitude: bool = False,
) -> SimulatedCampaign:
    """Draw a magnet, measure it, and describe the truth.

    Parameters
    ----------
    seed : int
        Seed of all random numbers.
    coil_sd : float
        Noise of the Helmholtz coil, relative to the nominal moment.
    hide : sequence of RequestedEffect
        Effects that the truth has and the study does not, with their values or None if these are to
        be drawn. They are applied in this order.
    hide_random : int
        Number of further effects that are drawn at random.
    elements : Elements, optional
        Resolution of NGSolve's mesh.
    progress : callable
        Function that receives the amount of work that magpylib has done and its total.
    placed : BlockTable, optional
        The blocks of this seed in other places, in which they are then assembled: what `sort` made
        of the table of an earlier simulation. Its places become those of the campaign's table.
    magnitude : bool
        Whether the probe reads |B| alone, as that of an NMR teslameter does. It has the gain, the
        offset and the place of the sensor of Bx, and no axes.

    Raises
    ------
    MeasurementError
        If ``placed`` is not a table of these blocks, or leaves places empty.
    StudyError
        If the study does not state the noise of its readings, measures at a point inside a
        material, or cannot have one of the effects, or if its magnet cannot be simulated.
    ExtraMissingError
        If magpylib or NGSolve is not installed.
    """
    if study.demagnetization is not None and study.demagnetization.irreversible:
        raise StudyError(must_be(
            "`demagnetization.irreversible`", f"study {study.name}",
            "left out of a simulated measurement", "true",
            "The programs that simulate the truth know no irreversible losses."))
    if study.maps:
        raise StudyError(must_be(
            "`maps`", f"study {study.name}", "left out of a simulated measurement, which is of one "
            "map", f"a list of {len(study.maps)}"))
    if magnitude and study.observation.quantity != "flux_density":
        raise StudyError(must_be("`observation.quantity`", f"study {study.name}",
                                 "flux_density for a map of |B|", study.observation.quantity))
    points, others = points_from(study.observation.positions), between(study.observation.positions)
    sigma = point_noise(study, np.vstack([points, others]), magnitude)
    blocks, coil, noise, effects, faults = streams(seed)
    nominal = magnet_of(study)
    site = replace(site_of(study, nominal), is_of_length=magnitude)
    hidden = choose_effects(site, hide, hide_random, effects)
    drawn = draw_magnet(study, nominal, blocks)
    table, calibration = coil_table(study, nominal, with_effects(
        drawn.single, site, hidden, single=True), coil_sd, coil)
    if placed is not None:
        drawn, table = replace(drawn, single=in_places(drawn.single, table, placed)), placed
    mounted = drawn.mounted
    magnet, instrument = with_hidden(study, mounted, hidden, site, seed), instrument_with(
        site, hidden)
    for asked in hidden[:len(hide)]:
        doubt_size(site, asked)
    nominal_places = np.vstack([points, others])
    check_apart(study.external, nominal_places, study.name)
    offsets = real_places(study, nominal_places, noise) - nominal_places
    recorded, readings = measured(
        magnet, instrument, points, others, elements, faults, progress, offsets, study.instrument,
        magnitude)
    if elements not in (None, Elements()) and not magnet.is_vacuum and by_elements(magnet):
        _warn_of_elements(magnet, points, elements, float(np.nanmin(sigma)))
    common = drawn.common.tolist()
    truth: dict[str, object] = {
        "study": study.name, "seed": seed, "model": model_of(magnet),
        "effects": [effect.plain() for effect in hidden],
        "common_mode": common[0] if len({*common}) == 1 else common,
        "coil_calibration": calibration, "coil_sd": coil_sd,
        "noise_free": {"largest_T": float(np.linalg.norm(readings, axis=1).max()),
                       "rms_T": np.sqrt(np.mean(readings**2, axis=0)).round(DIGITS).tolist()},
        "blocks": magnetizations(mounted.bodies),
    }
    if magnet.neighbours:
        truth["blocks_of_neighbours"] = magnetizations(magnet.neighbours)
    if stated := study.instrument.model_dump(mode="json", exclude_defaults=True):
        truth["stated_instrument"] = stated
    if magnet.bodies != mounted.bodies:
        truth["blocks_with_effects"] = magnetizations(magnet.bodies)
    seal = {"source": "synthetic", "study": study.name, "halbach_fe": version_of("halbach-fe"),
            "truth_sha256": hashlib.sha256(truth_text(truth).encode()).hexdigest()}
    unit, exact = instrument.field_unit, readings[:len(points)].copy()
    readings += unit * np.nan_to_num(sigma) * noise.standard_normal(readings.shape)
    maps = [_map(study, recorded[part], readings[part], unit * sigma[part], seal)
            .assign(time_s=("point", SECONDS * np.arange(len(recorded))[part]))
            for part in (slice(len(points)), slice(len(points), None))]
    return SimulatedCampaign(study, maps[0], maps[1] if len(others) else None, table, truth, exact,
                             magnet)


def _warn_of_elements(
    magnet: TrueMagnet, points: Floats, elements: Elements, noise: float
) -> None:
    """Warn if elements of a further order change the field at some points by more than the noise in
    T.
    """
    compared = 500  # largest number of points
    points = spread(points, compared)
    order = elements.order or USUAL_ORDER[magnet.dimension]
    own, finer = (reaction_field(magnet, points, replace(elements, order=each))
                  for each in (order, order + 1))
    change = np.abs(finer - own)
    if change.max() > noise:
        rms, most, noise_uT = 1e6 * np.sqrt(np.mean(change**2)), 1e6 * change.max(), 1e6 * noise
        warnings.warn(
            f"The simulated field is rougher than its noise of {noise_uT:.3g} µT: elements of "
            f"order {order + 1} change it by {rms:.3g} µT rms, and by {most:.3g} µT at most, the "
            "same for every reading of a place. Leave --order and --element-size out, take smaller "
            "elements, or state more noise.", HalbachWarning, stacklevel=3)


def simulate_delivery(study: Study, seed: int, coil_sd: float = COIL_SD) -> BlockTable:
    """Return the measured single blocks of `simulate_campaign`, without hidden effects or a map."""
    blocks, coil, *_ = streams(seed)
    nominal = magnet_of(study)
    return coil_table(study, nominal, draw_magnet(study, nominal, blocks).single, coil_sd, coil)[0]


def streams(seed: int) -> list[np.random.Generator]:
    """Return separate streams of random numbers for blocks, coil, noise, effects and instrument.

    A further draw from one does not change the others.
    """
    return [np.random.default_rng(part) for part in np.random.SeedSequence(seed).spawn(5)]


def measured(
    magnet: TrueMagnet, instrument: FaultyInstrument, points: Floats, others: Floats,
    elements: Elements | None, generator: np.random.Generator, progress: Progress,
    offsets: Floats | None = None, stated: Instrument = IDEAL, magnitude: bool = False,
) -> tuple[Floats, Floats]:
    """Return the recorded points and readings without noise, both (n, 3); of |B|, (n, 1).

    The ``points`` of the map come first, the held-out points ``others`` last. ``offsets`` (n, 3) in
    m, along the axes of the stage, displace the probe from each of them. The ``stated`` instrument,
    which the study describes, has these faults too; its units and axes are not those of the result.
    """
    nominal = np.vstack([points, others])
    maps = [part for part in (points, others) if len(part)]
    places = instrument.places(nominal, generator)
    if stated != IDEAL:
        places = places + np.concatenate(
            [stated_places(stated, part) - part for part in maps], axis=1)
    if offsets is not None:  # the same for all sensors
        places = places + Rotation.from_rotvec(stated.rotation_rad).apply(offsets)
    # the three sensors are usually in one place, whose field is then computed once
    distinct, inverse = np.unique(places.reshape(-1, 3), axis=0, return_inverse=True)
    check_air(magnet, places, len(points))
    fields = true_field(magnet, distinct, elements, progress)[inverse].reshape(places.shape)
    time = np.arange(len(nominal)) / max(1, len(points) - 1)
    if magnitude:
        fields, instrument = _lengths(fields, instrument)
        stated = stated.model_copy(update={"rotation_rad": ZERO_VECTOR})
    if stated != IDEAL:
        fields = _as_stated(stated, fields, [len(part) for part in maps])
    recorded, readings = instrument.record(
        nominal, instrument.readings(fields, time, generator))
    return recorded, readings.round(DIGITS)[:, :1 if magnitude else 3]


def with_hidden(
    study: Study, before: TrueMagnet, hidden: Sequence[ChosenEffect], site: Site, seed: int
) -> TrueMagnet:
    """Return a magnet with hidden effects.

    Raises
    ------
    StudyError
        If they move something to where something is already, or one of them changes no reading of
        the map.
    """
    magnet = with_effects(before, site, hidden)
    if hidden:
        check_room(magnet, before)
        _check_seen(study, before, magnet, hidden, site, seed)
    return magnet


def _check_seen(
    study: Study, before: TrueMagnet, magnet: TrueMagnet, hidden: Sequence[ChosenEffect],
    site: Site, seed: int,
) -> None:
    """Raise a StudyError if one of the hidden effects changes no reading of the map.

    An effect of the magnet is looked for in the field of its sources in vacuum at some of the
    points; what it does to materials that answer counts as a change. For an effect of the
    instrument it is the readings of a field without symmetry, of the magnet's size.

    Parameters
    ----------
    before, magnet : TrueMagnet
        The magnet without and with all effects.
    """
    unseen = 1e-3  # of the noise: 1e5 readings together do not show it
    compared = 200  # largest number of points at which the effects of the magnet are looked for
    points = points_from(study.observation.positions)
    sigma = point_noise(study, points, site.is_of_length)
    some = np.unique(np.linspace(0, len(points) - 1, compared).astype(int))

    def field(one: TrueMagnet, but: Collection[Body] = ()) -> Floats:
        """Return B at some points of a magnet in vacuum, without the blocks that another has."""
        found = true_field(replace(one.in_vacuum, bodies=tuple(
            body for body in one.in_vacuum.bodies if body not in but)), points[some])
        return np.linalg.norm(found, axis=1)[:, None] if site.is_of_length else found

    size = float(np.abs(field(before)).max()) or 1.0
    slopes = size * np.random.default_rng(0).uniform(-1, 1, (3, 4))
    slopes[magnet.dimension:] = slopes[:, magnet.dimension:3] = 0.0

    def shown(effects: Sequence[ChosenEffect]) -> Floats:
        """Return recorded points and readings of the field without symmetry, over the noise."""
        instrument, generator = instrument_with(site, effects), streams(seed)[4]
        places = instrument.places(points, generator)
        fields = places @ slopes[:, :3].T / site.outer + slopes[:, 3]
        if site.is_of_length:
            fields, instrument = _lengths(fields, instrument)
        recorded, readings = instrument.record(points, instrument.readings(
            fields, np.linspace(0.0, 1.0, len(points)), generator))
        return np.hstack([recorded / site.outer, readings[:, :sigma.shape[1]] / sigma])

    def changed(one: ChosenEffect) -> bool:
        """Tell whether the readings are others with an effect than with all others alone."""
        others = [each for each in hidden if each is not one]
        if one.effect.instrument is not None:
            return bool((np.abs(shown(hidden) - shown(others)) > unseen).any())
        if one.effect.name == "knee":  # which takes minutes
            change = lost_field(magnet.losses, points[some])
        else:
            now, without = (with_effects(before, site, [
                each for each in effects if each.effect.name != "knee"])
                for effects in (hidden, others))
            if now.answers != without.answers:
                return True
            same = ({*now.in_vacuum.bodies} & {*without.in_vacuum.bodies}
                    if not (now.objects or site.is_of_length) else ())
            change = field(now, same) - field(without, same)
        return bool((np.abs(change) > unseen * sigma[some]).any())

    for one in hidden:
        if not changed(one):
            values = ", ".join(f"{value:g}" for value in one.values)
            raise StudyError(must_be(
                f"--hide {one.effect.name}", "the study", "an effect that readings of the map show",
                f"{f'{values}, which' if values else 'one that'} changes none of them by a "
                "thousandth of its noise", "Choose another place or value, or leave it out."))


def _lengths(
    fields: Floats, instrument: FaultyInstrument
) -> tuple[Floats, FaultyInstrument]:
    """Return |B|, and the instrument that reads it: as the single sensor of Bx, without axes."""
    return np.linalg.norm(fields, axis=2)[..., None] * [1.0, 0.0, 0.0], replace(
        instrument, rotation=ZERO_VECTOR, axes=IDEAL_AXES, order=(0, 1, 2), signs=(1.0, 1.0, 1.0))


def _as_stated(stated: Instrument, fields: Floats, counts: Sequence[int]) -> Floats:
    """Return fields (3, n, 3) in T that an ideal probe shows as the stated one shows ``fields``.

    The readings of maps of so many points each follow each other.
    """
    shown = np.vstack([stated_readings(stated, part, np.linspace(0.0, 1.0, part.shape[1]))
                       for part in np.split(fields, np.cumsum(counts)[:-1], axis=1)])
    return np.broadcast_to(shown, fields.shape)


def true_field(
    magnet: TrueMagnet, points: Floats, elements: Elements | None = None,
    progress: Progress = no_progress
) -> Floats:
    """Return B (n, 3) in T of a magnet and its surroundings, at points (n, 3) in m in air."""
    spheres = np.array([sphere.place for sphere in magnet.objects]).reshape(-1, 3)
    everywhere = np.vstack([points, spheres])
    field = (vacuum_field(magnet.all_bodies, everywhere, progress)
             + reaction_field(magnet, everywhere, elements, progress)
             + _external_field(magnet, everywhere, progress)
             + lost_field(magnet.losses, everywhere))
    result = field[:len(points)]
    for sphere, own in zip(magnet.objects, field[len(points):], strict=True):
        result = result + moment_field(np.array([sphere.place]), 3 * sphere.volume * own[None],
                                       points)
    return result


def _external_field(magnet: TrueMagnet, points: Floats, progress: Progress) -> Floats:
    """Return B (n, 3) in T of the sources outside the magnet, to which nothing reacts."""
    field = magnet.background + vacuum_field(magnet.neighbours, points, progress)
    for place, moment in magnet.dipoles:
        field += moment_field(np.array([place]), MU_0 * np.array([moment]), points)
    return field


def model_of(magnet: TrueMagnet) -> dict[str, str]:
    """Return the programs that compute a magnet's field, with their versions."""
    own = f"halbach_fe.synthetic {version_of('halbach-fe')}"
    programs = {"vacuum": f"magpylib {version_of('magpylib')}" if magnet.dimension == 3
                else f"closed form of {own}"}
    if not magnet.is_vacuum:
        programs["reaction"] = (f"NGSolve {version_of('ngsolve')}" if by_elements(magnet)
                                else f"Gauss points of {own}")
    return programs


def point_noise(study: Study, points: Floats, magnitude: bool = False) -> Floats:
    """Return the standard deviations (n, 3) in T of the components at points (n, 3) in m, or those
    of their ``magnitude``, (n, 1).

    They are NaN for components that the study does not observe. If the study observes Fourier
    coefficients, its sigma is theirs; the variance of a coefficient of n points is 2/n times that
    of a point.

    Raises
    ------
    StudyError
        If the study has no noise regions.
    """
    if study.noise is None or not study.noise.regions:
        raise StudyError(must_be("`noise`", f"study {study.name}",
                                 "given for a simulated measurement", "nothing",
                                 "Add [[noise.regions]]."))
    sigma = np.array([region.sigma_T for region in study.noise.regions])
    if magnitude:
        return sigma[noise_regions(study.noise, points[:, 2], ("",) * len(points))][:, None]
    result = np.full((len(points), 3), np.nan)
    for number, name in enumerate(COMPONENTS):
        if name in observed_components(study):
            result[:, number] = sigma[noise_regions(study.noise, points[:, 2],
                                                    (name,) * len(points))]
    if study.observation.quantity == "fourier_coefficients":
        result *= np.sqrt(study.observation.positions.angles / 2)
    return result


def observed_components(study: Study) -> tuple[str, ...]:
    """Return the components of B that a study's readings consist of."""
    observed = study.observation
    return ("x", "y") if observed.quantity == "fourier_coefficients" else observed.components


def real_places(study: Study, points: Floats, generator: np.random.Generator) -> Floats:
    """Return the true points (n, 3) in m of the probe, drawn about the nominal ``points``.

    They are the nominal ones if the study states no uncertainty of its positions.
    """
    if study.noise is None or study.noise.position_sd_m is None:
        return points
    sd = np.array(study.noise.position_sd_m)
    return np.asarray(points + sd * generator.standard_normal(points.shape))


def check_air(magnet: TrueMagnet, places: Floats, count: int) -> None:
    """Raise a StudyError if a place (..., n, 3) in m of a sensor is in or on blocks or iron.

    The first ``count`` of the n readings are those of the map, the others are held out.
    """
    # Distance in m from a surface up to which a point is on it: rounding errors of the coordinates
    # of turned bodies are less, and magpylib's field jumps by the remanence within them.
    surface_m = 1e-9
    points = places.reshape(-1, 3)
    inside = magnet.holds(points)
    for beside in np.vstack([np.eye(3), -np.eye(3)]) * surface_m:
        inside |= magnet.holds(points + beside)

    def at(number: int) -> str:
        reading, (x, y, z) = number % places.shape[-2], points[number]
        name = (f"reading {reading + 1} of the map" if reading < count else
                f"held-out reading {reading - count + 1}")
        return f"{name} at ({x:g}, {y:g}, {z:g}) m"

    if inside.any():
        first = int(np.argmax(inside))
        deep, body = max((-float(distance_from(solid, points[[first]], magnet.dimension)[0]),
                          in_words(solid)) for solid in magnet.solids)
        where = f"{1e3 * deep:.3g} mm inside" if deep > surface_m else "on the surface of"
        raise StudyError(must_be(
            "`observation.positions`", "the study", "in air, as must the held-out points halfway "
            "between them and the points to which hidden effects take the probe",
            f"{at(first)}, {where} {body}",
            f"Move it off by {1e3 * max(deep, 1e-6):.3g} mm or more."))
    for sphere in magnet.objects:
        away = np.linalg.norm(points - sphere.place, axis=1)
        if away.min() <= sphere.radius:
            raise StudyError(must_be(
                "--hide ferromagnetic_object", "the study", "a sphere that no probe touches",
                f"one of radius {1e3 * sphere.radius:.3g} mm, whose middle is "
                f"{1e3 * away.min():.3g} mm from {at(int(np.argmin(away)))}",
                "Move it away from all readings by more than its radius, or make its volume "
                "smaller."))


def _map(
    study: Study, points: Floats, readings: Floats, sigma: Floats, seal: dict[str, str]
) -> xr.Dataset:
    """Return a map of the components that the study observes, or of |B| from readings (n, 1).

    ``seal`` holds the attributes of the map, among them the hash of the truth.
    """
    # the noise of flux densities is stated in the study, that of single points behind Fourier
    # coefficients is not
    known = None if study.observation.quantity == "flux_density" else sigma
    file = study.instrument  # states the units and axes of the map
    if known is not None:
        known = np.abs(columns(file.field_axes, known, file.flux_density_unit_T))
    places = columns(file.position_axes, points, file.length_unit_m)
    places = places if file.length_unit_m == 1 else places.round(DIGITS)
    if readings.shape[1] == 1:
        return total_field_map(
            places, (readings[:, 0] / file.flux_density_unit_T).round(DIGITS), attributes=seal)
    shown = np.where([name in observed_components(study) for name in COMPONENTS], readings, np.nan)
    field = columns(file.field_axes, shown, file.flux_density_unit_T).round(DIGITS)
    return field_map(places, field, known, seal)


def truth_text(truth: dict[str, object]) -> str:
    """Return the truth as JSON text, the text whose hash the maps name."""
    return json.dumps(truth, indent=1, allow_nan=False) + "\n"


def campaign_files(campaign: SimulatedCampaign) -> dict[str, Callable[[Path], None]]:
    """Return how each file of a campaign is written, by its name.

    These are blocks.csv, map and held-out (.csv, or .h5 if large), and truth/truth.json.
    """
    maps = {f"{name}{'.csv' if 9 * data.sizes['point'] < LARGEST_CSV else '.h5'}":
            partial(write_map, data)
            for name, data in (("map", campaign.readings), ("held-out", campaign.held_out))
            if data is not None}

    return {"blocks.csv": partial(write_blocks, campaign.blocks), **maps,
            "truth/truth.json": partial(write_text, text=truth_text(campaign.truth))}


def write_campaign(campaign: SimulatedCampaign, folder: Path) -> list[Path]:
    """Write the files of a campaign to a folder, and return their paths."""
    files = campaign_files(campaign)
    for name, write in files.items():
        write(folder / name)
    return [folder / name for name in files]


def moments(bodies: tuple[Body, ...], length: float) -> Floats:
    """Return the moments (n, 3) in A m^2 of single bodies, each in its own axes.

    Bodies of infinite length are given the finite ``length`` in m. Bodies of the same shape and
    permeability share their `lone_moment_matrix`, which is good to some 1e-4.
    """
    found = []
    for body in bodies:
        shape, seat = body.shape, body.seat_orientation.as_matrix()
        if np.isinf(shape.length):
            shape = replace(shape, length=length)
        tensor = seat.T @ body.permeability @ seat
        matrix = _known_matrix(shape, tuple((tensor.round(12) + 0.0).ravel().tolist()))
        own = body.seat_orientation.inv().apply(body.remanence) * body.mean_factor
        found.append(body.seat_orientation.apply(matrix @ own))
    return np.array(found)


@lru_cache(maxsize=4096)
def _known_matrix(shape: Shape, permeability: tuple[float, ...]) -> Floats:
    """Return `lone_moment_matrix`, cached; ``permeability`` is the tensor row by row.

    The tensor does not depend on the sign of the easy axis, so opposite blocks share a matrix.
    """
    return lone_moment_matrix(shape, np.reshape(permeability, (3, 3)))


@dataclass(frozen=True)
class DrawnMagnet:
    """A magnet whose blocks have the errors that were drawn for them."""

    single: TrueMagnet
    """The blocks before they are mounted."""
    turns: tuple[Rotation, ...]
    """Error of the mounting in each place, along the magnet's axes."""
    common: Floats
    """Deviation that every magnetization has in common with others, relative to the nominal.
    Shape (blocks,)."""

    @property
    def mounted(self) -> TrueMagnet:
        """The blocks in the magnet, with the errors of their mounting."""
        return replace(self.single, bodies=tuple(
            body.with_magnetization(turn.apply(body.magnetization))
            for body, turn in zip(self.single.bodies, self.turns, strict=True)))


def draw_magnet(study: Study, nominal: TrueMagnet, generator: np.random.Generator) -> DrawnMagnet:
    """Draw the magnetizations of all blocks, and the errors of their mounting, from the prior.

    Blocks of neighbouring magnets are others, with deviations of their own.

    Warns
    -----
    HalbachWarning
        If the prior lets magnetizations vary inside blocks, which the truth cannot have.
    """
    if study.prior.variation_sd:
        warnings.warn(f"The blocks that are drawn for study {study.name} are uniformly magnetized: "
                      "`prior.variation_sd` is left out.", HalbachWarning, stacklevel=2)
    own = _drawn(study, nominal.bodies, generator)
    beside = tuple(body for each in study.external.neighbours for body in beside_magnet(
        each, _drawn(study, nominal.bodies, generator).mounted.bodies))
    return replace(own, single=replace(nominal, bodies=own.single.bodies, neighbours=beside))


def _drawn(study: Study, nominal: tuple[Body, ...], generator: np.random.Generator) -> DrawnMagnet:
    """Draw the blocks of the magnet or of a neighbour."""
    prior = study.prior
    shared = study.shared_sds
    common = (shared * generator.standard_normal(shared.shape[1])).sum(axis=1)
    single, turns = [], []
    for body, together in zip(nominal, common, strict=True):
        deviation = generator.standard_normal(3) * [
            prior.magnitude_sd, *2 * [np.radians(prior.direction_sd_deg)]]
        turn = np.radians(prior.mounting_sd_deg) * generator.standard_normal(3)
        if study.dimension == 2:
            deviation[2] = turn[0] = turn[1] = 0.0
        single.append(_deviating(body, deviation + np.array([together, 0.0, 0.0])))
        turns.append(Rotation.from_rotvec(turn))
    return DrawnMagnet(TrueMagnet(study.dimension, tuple(single)), tuple(turns), common)


def _deviating(body: Body, deviation: Floats) -> Body:
    """Return the body with another magnetization M.

    ``deviation`` (3,) is the change as fractions of M: along M, perpendicular to it in the plane of
    the ring, and perpendicular to both, which is along z unless M leaves the plane.
    """
    nominal = body.magnetization
    size = np.linalg.norm(nominal)
    if not size:  # the block is missing
        return body
    along = nominal / size
    across = np.cross([0, 0, 1], along)
    # sine of the angle to the magnet's axis below which a magnetization has no direction across
    along_z = 1e-6
    if np.linalg.norm(across) < along_z:
        across = np.cross([0, 1, 0], along)
    across /= np.linalg.norm(across)
    axes = size * np.array([along, across, np.cross(along, across)])
    return body.with_magnetization(nominal + deviation @ axes)


def coil_table(
    study: Study, nominal: TrueMagnet, single: TrueMagnet, coil_sd: float,
    generator: np.random.Generator
) -> tuple[BlockTable, float]:
    """Measure the moments of the single blocks in a Helmholtz coil before they are mounted.

    Ring and slot are those that a block was made for. Missing blocks are left out.

    Parameters
    ----------
    nominal, single : TrueMagnet
        The nominal blocks, and those that are measured before they are mounted.
    coil_sd : float
        Noise of every component, relative to the nominal moment.

    Returns
    -------
    table : BlockTable
    calibration : float
        Relative error of the coil, drawn with the standard deviation ``prior.calibration_sd``. It
        is the same for all blocks, whose moments are measured too small if it is positive.
    """
    length = study.array.ring_length_m or study.array.outer_radius_m  # of infinite blocks
    there: dict[tuple[int, int], int] = {}
    for number, body in enumerate(nominal.bodies):
        if any(body.remanence):
            there.setdefault(body.made_for or (body.ring, body.slot), number)
    bodies = _before_mounting(nominal, there.values())
    true = moments(_before_mounting(single, there.values()), length)
    sigma = coil_sd * np.linalg.norm(moments(bodies, length), axis=1)
    calibration = float(study.prior.calibration_sd * generator.standard_normal())
    measured = true / (1 + calibration) + sigma[:, None] * generator.standard_normal(true.shape)
    # the last digits differ from solve to solve
    digits = 10 - int(np.log10(np.abs(measured).max()))
    label = {slot: name for name, slots in study.prior.types.items() for slot in slots}
    reference = study.prior.reference_temperature_C
    shapes = [replace(body.shape, length=length) if np.isinf(body.shape.length) else body.shape
              for body in bodies]
    return BlockTable(
        serial=tuple(f"B{number + 1:04d}" for number in there.values()),
        type=tuple(label.get(slot) or body.type or ("" if body.name else str(slot))
                   for (_, slot), body in zip(there, bodies, strict=True)),
        ring=np.array([ring for ring, _ in there]), slot=np.array([slot for _, slot in there]),
        moment=measured.round(digits), sigma=sigma.round(digits),
        volume=np.array([shape.volume for shape in shapes]),
        temperature=np.full(len(bodies), np.nan if reference is None else reference),
        attributes={"source": "synthetic"}), calibration


def _before_mounting(magnet: TrueMagnet, numbers: Iterable[int]) -> tuple[Body, ...]:
    """Return some bodies, by number, without what happened to their magnetizations later."""
    return tuple(replace(body, remanence=vector(np.array(body.remanence) / body.factor))
                 for body in (magnet.bodies[number] for number in numbers))


def magnetizations(bodies: Sequence[Body]) -> list[dict[str, object]]:
    """Return the magnetization of every block, in A/m, as plain data."""
    return [{"ring": body.ring, "slot": body.slot,
             "magnetization_A_per_m": list(vector(body.magnetization.round(6)))}
            for body in bodies]
