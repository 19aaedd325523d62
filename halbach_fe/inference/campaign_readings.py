"""The readings of all maps of a campaign, stacked: values, noise, operator, and what is held out.

Some of them an update has not seen as a whole: those of another map, or the ends of the map. Where
two maps overlap, the readings of one are compared with what an update by the other alone predicts
there, by the covariance of prediction, noise, and what is not known about the instruments. A magnet
is judged where nobody measured: by a map, or ends of the only one, that are left out. Lines that
are held out between others say nothing of that.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from itertools import permutations
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints, rms
from halbach_fe.core.errors import HalbachWarning, MeasurementError, must_be
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.surface import is_cross_section
from halbach_fe.inference.result import (
    ALL_READINGS,
    FEWEST_READINGS,
    HELD_OUT,
    HELD_OUT_MAP,
    TRAINING,
    LeftOut,
    Overlap,
    Stretch,
)
from halbach_fe.measurement.campaign_maps import SAME_PLACE_M, SAME_READING, SHARED, Map, repeated
from halbach_fe.measurement.field_map import (
    TOTAL_COLUMN,
    is_total_field,
    points_of,
    total_contradiction,
)
from halbach_fe.measurement.observation_operator import (
    Observation,
    concatenate,
    excluded_components,
    held_out_readings,
    observe,
    observe_total,
)
from halbach_fe.measurement.positions import point_spacing
from halbach_fe.measurement.probe_law import (
    field_read,
    in_si_and_magnet_axes,
    probe_points,
    remove_nonlinear_part,
    sensor_matrix,
    total_without_nonlinear_part,
)
from halbach_fe.measurement.reading_noise import noise_regions, reading_noise
from halbach_fe.response.response_matrix import Response, StoredMatrix
from halbach_fe.solver.exact_block_field import external_field, field_of
from halbach_fe.stats import posteriors
from halbach_fe.stats.gaussian import Gaussian, NoiseCovariance
from halbach_fe.stats.posteriors import Rows, row_slices
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS, MIN_SIGMA_T

BY_CHANCE = 0.15
"""Share of a held-out map's readings that may equal those that update the model: more than readings
at the same points do by chance."""

Noises = dict[str, NoiseCovariance]
"""Noise of the readings of a map, by its name."""


@dataclass(frozen=True)
class Readings:
    """The readings of some maps, one map after the other."""

    observation: Observation
    values: Floats
    """Shape (readings,), in T."""
    noise: NoiseCovariance
    parts: tuple[str, ...]
    regions: tuple[str, ...]
    maps: tuple[str, ...]
    """Part (`TRAINING`, `HELD_OUT` or `HELD_OUT_MAP`), noise region and map of each reading."""
    vectors: Observation
    """The same with all components of B in place of each reading of |B|."""
    directions: dict[str, Floats] = field(default_factory=dict)
    """For each map of |B| the unit vectors of the field about which |B| is linearized, as a probe
    of three components would show them. Shape (n, 3)."""

    @cached_property
    def total(self) -> NDArray[np.bool_]:
        """Which readings (readings,) are |B|."""
        return self.observation.of_total_field

    @cached_property
    def first(self) -> Ints:
        """Number (readings,) of each reading, or of its first component, among `vectors`."""
        width = np.where(self.total, 3, 1)
        return np.asarray(np.cumsum(width) - width)

    @cached_property
    def projection(self) -> sparse.csr_array:
        """Matrix from `vectors` to the readings."""
        width = np.where(self.total, 3, 1)
        values = np.ones(int(width.sum()))
        values[np.repeat(self.total, width)] = self.observation.directions.ravel()
        return sparse.csr_array((values, np.arange(len(values)), np.append(0, np.cumsum(width))),
                                shape=(len(width), len(values)))

    def of_components(self, values: Floats) -> Floats:
        """Return B (k, 3) in T of all readings of |B| from those of `vectors`."""
        return np.asarray(values[self.first[self.total][:, None] + np.arange(3)])

    def projected(self, model: Response, folder: Path) -> Response:
        """Return the response of the readings from that of `vectors`.

        A large matrix is stored in a folder.
        """
        if not self.total.any():
            return model
        shape = len(self.total), len(model.parameters)

        def part(rows: slice) -> Floats:
            own = self.projection[rows]
            used, place = np.unique(own.indices, return_inverse=True)
            return np.asarray(sparse.csr_array(
                (own.data, place, own.indptr), shape=(own.shape[0], len(used)))
                @ model.matrix[used])

        matrix = part(slice(None)) if isinstance(model.matrix, np.ndarray) else StoredMatrix.of(
            map(part, row_slices(*shape)), shape, folder / "response-of-magnitude.npy")
        # error bars of a component are already those of the vector at its point
        return replace(model, matrix=matrix, offset=self.projection @ model.offset,
                       error=model.error[self.first],
                       of_neighbours=self.projection @ model.of_neighbours,
                       shared_error=(self.projection @ model.shared_error.T).T)

    @property
    def training(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Mask (readings,) of the readings that update the model."""
        return np.array(self.parts) == TRAINING


def read_campaign(
    magnet: Magnet, maps: Sequence[Map], known: Noises | None = None,
    estimated: Sequence[MagnetBlock] | None = None,
    directions: Mapping[str, Floats] | None = None,
) -> Readings:
    """Return the readings of all maps, by the instrument of each.

    Parameters
    ----------
    known : dict, optional
        Noise of the same maps with little other poses, which is not computed again; what is
        computed is added.
    estimated : sequence of MagnetBlock, optional
        Blocks with the magnetizations as they are estimated, in whose gradient uncertain positions
        make noise; by default the nominal ones.
    directions : dict of str to ndarray, shape (k, 3), optional
        Unit vectors at the readings of each map of |B|, see `Readings`; by default those of the
        nominal blocks in vacuum.

    Raises
    ------
    StudyError
        If neither study nor map state the noise.
    MeasurementError
        If a map does not fit the study.
    """
    several = sum(not one.is_validation for one in maps) > 1
    noises = {} if known is None else known
    blocks = magnet.blocks if estimated is None else estimated
    found = [_read(magnet, one, several, noises, blocks, (directions or {}).get(one.name))
             for one in maps]
    if magnet.dimension == 2:
        _check_plane(np.concatenate([each.observation.points for each in found]), "map")
    return reduce(_stacked, found)


def warn_of_another_gain(maps: Sequence[Map]) -> None:
    """Warn of a column of |B| that is the length of the components neither as they were read nor
    as the instrument is known.
    """
    several = sum(not one.is_validation for one in maps) > 1
    for one in maps:
        instrument = one.study.instrument
        data = in_si_and_magnet_axes(instrument, one.data)
        if total_contradiction(data) and (contradiction := total_contradiction(
                data.assign(B_T=data["B_T"].copy(data=field_read(instrument, data))))):
            where = one.name if one.is_validation or not several else f"map {one.name}"
            warnings.warn(f"The {where.removeprefix('the ')}: {contradiction}", HalbachWarning,
                          stacklevel=3)


def _check_plane(points: Floats, where: str) -> None:
    """Raise a MeasurementError if the points (n, 3) in m of a 2D study are at several heights."""
    heights = points[:, 2]
    if not is_cross_section(points):
        raise MeasurementError(must_be(
            "points", where, "in one plane for a 2D study",
            f"z from {heights.min():g} to {heights.max():g} m",
            "Use a 3D study, or one circle of the map."))


def _doubt_field_along_z(field: Floats, where: str) -> None:
    """Warn if readings (n, 3) in T have a Bz, which no magnet of a 2D study makes."""
    # Largest Bz of a map of a 2D study relative to its other components: that of a probe that is
    # turned by 3 degrees, far more than usual.
    of_the_plane = 0.05
    read = np.isfinite(field)
    along, across = (np.abs(field[:, part][read[:, part]]).max(initial=0.0)
                     for part in (slice(2, 3), slice(0, 2)))
    if along > of_the_plane * across:
        warnings.warn(
            f"The {where} reads Bz up to {along:.3g} T, but a 2D study has no field along z: these "
            "readings say nothing about its blocks. If the field is real, use a 3D study; if its "
            "columns are exchanged, state instrument.field_axes.", HalbachWarning, stacklevel=2)


def check_validation_map(readings: Readings, study: Study) -> None:
    """Refuse a held-out map of readings that update the model: it is no test of it.

    Raises
    ------
    MeasurementError
        If many of its readings are in the map that updates the model, unless the study holds
        all of these out.

    Warns
    -----
    HalbachWarning
        If some are.
    """
    observation, parts = readings.observation, np.array(readings.parts)
    noise = [region.sigma_T for region in study.noise.regions] if study.noise else []
    sigma = min([float(readings.noise.sd.min()), *noise])  # without that of positions, if stated
    numbers = np.unique(observation.labels, return_inverse=True)[1]
    rows = np.column_stack([numbers, observation.positions, readings.values])
    tolerance = np.array([0.5, *[SAME_PLACE_M] * 3, max(SAME_READING * sigma, MIN_SIGMA_T)])
    own = rows[parts == HELD_OUT_MAP]
    shared = int(repeated(own, rows[parts == TRAINING], tolerance).sum())
    if shared <= BY_CHANCE * len(own):
        return
    if repeated(own, rows[parts != HELD_OUT_MAP], tolerance).sum() > SHARED * len(own):
        raise MeasurementError(must_be(
            "--held-out", f"study {study.name}", "a map of other readings than those that update "
            "the model", "the same readings", "Hold back readings before the "
            "update (`inference.held_out`), or leave --held-out out."))
    warnings.warn(
        f"{shared} of {len(own)} readings of the held-out map update the model too: their "
        "predictions are no test.", HalbachWarning, stacklevel=2)


def _read(
    magnet: Magnet, one: Map, several: bool, noises: Noises, blocks: Sequence[MagnetBlock],
    directions: Floats | None,
) -> Readings:
    """Return the readings of a map; ``several`` puts its name into error messages and regions."""
    study, where = one.study, one.name if one.is_validation or not several else f"map {one.name}"
    called = where if several else f"the {where}"
    magnet = magnet.with_study(study)
    data = in_si_and_magnet_axes(study.instrument, one.data)
    measured = _measured(one, data, where)
    if is_total_field(data):
        shown = total_without_nonlinear_part(study.instrument, data)
        directions = _at_all(measured[:, 0], directions, magnet, points_of(data))
        observation, vectors = (observe_total(study, points_of(data), measured[:, 0], given, where)
                                for given in (directions, None))
    else:
        directions, shown = None, remove_nonlinear_part(study.instrument, data)
        observation = vectors = observe(study, points_of(data), measured, where)
    if magnet.dimension == 2:
        _check_plane(observation.points, where)
        _doubt_field_along_z(data["B_T"].values, where)
    places = _places_in_air(magnet, observation.points, data.sizes["point"], where)
    observation, vectors = (replace(each, points=places) for each in (observation, vectors))
    if one.is_validation:
        parts = (HELD_OUT_MAP,) * len(observation)
    else:
        held_out = held_out_readings(study, observation, where)
        parts = tuple(np.where(held_out, HELD_OUT, TRAINING).tolist())
    regions = (ALL_READINGS,) * len(observation)
    if study.noise is not None and study.noise.regions:
        names = [region.name for region in study.noise.regions]
        regions = tuple(names[i] for i in noise_regions(
            study.noise, observation.positions[:, 2], observation.components, called))
    if several:
        single = len(set(regions)) == 1
        regions = tuple(one.name if single else f"{one.name}: {region}" for region in regions)
    values = (observation.read(np.nan_to_num(shown)) if directions is None
              else shown[observation.map_rows])
    if one.name not in noises:
        noises[one.name] = reading_noise(
            replace(magnet, blocks=tuple(blocks)), observation, data, called)
    return Readings(observation, values, noises[one.name], parts, regions,
                    (one.name,) * len(observation), vectors,
                    {} if directions is None else {one.name: directions})


def _measured(one: Map, data: xr.Dataset, where: str) -> NDArray[np.bool_]:
    """Return which components (n, 3) of a map are used; of |B|, all three or none."""
    values = data["B_T"].values
    total = is_total_field(data)
    if total:
        values = np.repeat(data[TOTAL_COLUMN].values[:, None], 3, axis=1)
    measured = ~np.isnan(values)
    if not one.is_validation:
        excluded = excluded_components(one.study, data.sizes["point"], where)
        measured &= ~(excluded.any(axis=1, keepdims=True) if total else excluded)
    if not measured.any():
        raise MeasurementError(must_be(
            "readings", where, "some that the study does not exclude", "none",
            "Correct `inference.excluded_readings`."))
    if not np.any(values[measured]):
        raise MeasurementError(must_be(
            "flux densities", where, "those of a magnet", "zero at all points",
            "Was the probe connected? Correct the map."))
    return measured


def _at_all(
    measured: NDArray[np.bool_], directions: Floats | None, magnet: Magnet, points: Floats
) -> Floats:
    """Return directions (n, 3) at all points of a map from those at its readings (k, 3).

    By default they are those of the field of the blocks in vacuum, as a probe shows it.
    """
    if directions is not None:
        found = np.tile([1.0, 0.0, 0.0], (len(points), 1))
        found[measured] = directions
        return found
    places = probe_points(magnet.study.instrument, points)
    shown = field_of(magnet.blocks, places) + external_field(magnet, places)
    return unit_vectors(shown @ sensor_matrix(magnet.study.instrument).T)


def unit_vectors(vectors: Floats) -> Floats:
    """Return the directions (n, 3) of vectors (n, 3); that of a zero is along x."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(size > 0, vectors / np.where(size > 0, size, 1.0), [1.0, 0.0, 0.0])


def _places_in_air(magnet: Magnet, points: Floats, rows: int, where: str) -> Floats:
    """Return sensors' points (n, 3) in m, those on a face of magnet or iron just outside.

    Raises
    ------
    MeasurementError
        If a point is not in air. ``rows`` is the number of the map's rows.

    Warns
    -----
    HalbachWarning
        If a point is on a face.
    """
    places = magnet.surroundings(points)
    refused = places.refusal()
    if refused is not None:
        first, _, what, hint = refused
        x, y, z = points[first]
        sensors = len(points) // rows
        count = places.no_air.reshape(-1, sensors).any(axis=1).sum()
        raise MeasurementError(must_be(
            f"reading {first // sensors + 1}", where, "at a point in air",
            f"({x:g}, {y:g}, {z:g}) m, {what} ({count} such readings)",
            hint or "Check the study's radii and the map's axes and units."))
    remark = places.on_faces()
    if remark is not None:
        warnings.warn(remark, HalbachWarning, stacklevel=4)
    return places.points


def _stacked(first: Readings, second: Readings) -> Readings:
    """Return the readings of some maps, followed by those of others, of independent noise."""
    return Readings(
        concatenate(first.observation, second.observation),
        np.concatenate([first.values, second.values]), first.noise.stacked_with(second.noise),
        first.parts + second.parts, first.regions + second.regions, first.maps + second.maps,
        concatenate(first.vectors, second.vectors), first.directions | second.directions)


NEAR = 0.87
"""Distance from the nearest point of another map, in units of that map's spacing, up to which maps
overlap: half the diagonal of a cell of its grid."""

END = 0.15
"""Part of the length of a single map that is left out at each end."""

STRETCHES = 7
"""Number of parts of a map that was left out, along its longest axis, that are told apart."""


def overlaps(
    matrix: Rows, residual: Floats, errors: NoiseCovariance, prior: Gaussian, readings: Readings
) -> tuple[Overlap, ...]:
    """Return the agreement of all pairs of maps that overlap, in both directions.

    Parameters
    ----------
    matrix : Rows, shape (readings, parameters)
        Response of the readings to all parameters, those of instruments too.
    residual : ndarray, shape (readings,), in T
        Readings less the constant part of the model.
    errors : NoiseCovariance
        Noise of the readings and error of the solver.
    prior : Gaussian
        Of all parameters.
    """
    maps, training = np.array(readings.maps), readings.training
    held_out = np.array(readings.parts) == HELD_OUT
    places, stated = readings.observation.places, readings.observation.positions
    near: dict[tuple[str, str], np.ndarray] = {}
    for name, by in permutations(dict.fromkeys(maps[training].tolist()), 2):
        theirs = maps == by
        spacing = point_spacing(np.unique(stated[theirs], axis=0))  # three readings to a point
        chosen = (maps == name) & (KDTree(places[theirs]).query(places)[0] <= NEAR * spacing)
        if (chosen & held_out).any():
            chosen &= held_out
        if chosen.any():
            near[name, by] = chosen
    found = []
    for by in dict.fromkeys(by for _, by in near):
        rows = np.flatnonzero(training & (maps == by))
        updated = posteriors.update(
            matrix, residual[rows], errors.subset(rows), prior, rows).distribution
        for (name, other), chosen in near.items():
            if other != by:
                continue
            index = np.flatnonzero(chosen)
            response = matrix[index]
            off = residual[index] - response @ updated.mean
            root = response @ updated.root
            white = posteriors.whitened(off, errors.subset(index), root.__getitem__,
                                             root.shape[1])
            found.append(Overlap(name, by, len(index), bool(held_out[index].all()),
                                 rms(off), float(np.mean(white**2))))
    return tuple(found)


def left_out(
    matrix: Rows, residual: Floats, errors: NoiseCovariance, prior: Gaussian, readings: Readings
) -> tuple[LeftOut, ...]:
    """Return how an update by the others predicts each map, or that by its middle the ends of one.

    The arguments are those of `overlaps`. The response is the one of the update by all readings.
    Where a map lies and what only its probe does, no other map tells: the rms, not chi-squared, is
    that with these terms fitted to the map itself.
    """
    found = []
    # largest number of readings that are compared: chi-squared of 4 000 is known to 2 %
    most = 4000
    for name, chosen in _regions(readings).items():
        rows, index = np.flatnonzero(readings.training & ~chosen), np.flatnonzero(chosen)
        if min(len(rows), len(index)) < FEWEST_READINGS:
            continue
        index = index[::-(-len(index) // most)]
        updated = posteriors.update(
            matrix, residual[rows], errors.subset(rows), prior, rows).distribution
        response, noise = matrix[index], errors.subset(index)
        off, root = residual[index] - response @ updated.mean, response @ updated.root
        white = posteriors.whitened(off, noise, root.__getitem__, root.shape[1])
        own = ~np.any([matrix[rows[each]].any(axis=0) for each in posteriors.row_slices(
            len(rows), response.shape[1])], axis=0)
        fitted = posteriors.update(response, residual[index], noise, updated).distribution
        off = off - response[:, own] @ (fitted.mean - updated.mean)[own]
        allowed = np.hypot(np.linalg.norm(np.where(own, 0.0, response) @ updated.root, axis=1),
                           noise.sd)
        found.append(LeftOut(name, len(index), rms(off), rms(noise.sd), rms(allowed),
                             float(np.mean(white**2)), _stretches(
                                 readings.observation.places[index], off, noise.sd)))
    return tuple(found)


def _stretches(places: Floats, off: Floats, noise: Floats) -> tuple[Stretch, ...]:
    """Return how far readings (n,) at places (n, 3) in m are off, along their longest axis."""
    axis = int(np.argmax(np.ptp(places, axis=0)))
    along = places[:, axis]
    limits = np.linspace(along.min(), along.max(), STRETCHES + 1)[1:-1]
    owner = np.searchsorted(limits, along)
    return tuple(
        Stretch(COMPONENTS[axis], float(along[rows].min()), float(along[rows].max()), len(rows),
                rms(off[rows]), rms(noise[rows]))
        for rows in (np.flatnonzero(owner == number) for number in range(STRETCHES))
        if len(rows) >= FEWEST_READINGS)


def _regions(readings: Readings) -> dict[str, NDArray[np.bool_]]:
    """Return the masks (readings,) of what is left out, by the name of a map; of one map, its ends
    along the longest axis.
    """
    maps, own = np.array(readings.maps), np.array(readings.parts) != HELD_OUT_MAP
    names = list(dict.fromkeys(maps[own].tolist()))
    if len(names) > 1:
        return {name: own & (maps == name) for name in names}
    places = readings.observation.places
    along = places[:, int(np.argmax(np.ptp(places[own], axis=0)))]
    low, high = along[own].min(), along[own].max()
    return {"": own & (np.abs(along - (low + high) / 2) > (0.5 - END) * (high - low))}
