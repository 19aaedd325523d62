"""Updates of readings that are not linear, by terms of instruments and of |B|: their derivatives.

The terms of the instruments are parameters of the update, beside the magnetizations. The readings
are linear in small changes of the terms, by the gradient of the field of the magnet as it is
estimated. The update is therefore repeated about what it found, until the terms are at rest.

A probe of |B| shows the length of B. About a field B_0 it is the component along B_0, but for
``|c|^2 / 2 |B_0|`` by the deviation c across it. Here too an update is repeated about what it has
found. What is not known of c bends the readings: its mean square over 2 |B_0| counts as noise,
which makes readings of a weak field count little until an update knows the field there.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError, must_be
from halbach_fe.inference.campaign_readings import Readings, unit_vectors
from halbach_fe.measurement.campaign_maps import ONLY_MAP, Map, with_pivots
from halbach_fe.measurement.field_map import is_total_field, points_of
from halbach_fe.measurement.observation_operator import Observation
from halbach_fe.measurement.probe_law import (
    APART,
    DRIFTS,
    NAMES,
    OFFSETS,
    POSE,
    SENSORS,
    by_terms,
    field_at_sensors,
    in_si_and_magnet_axes,
    map_time,
    prior_sd,
    remove_nonlinear_part,
    seen,
    sensor_matrix,
    sensor_positions,
    total_without_nonlinear_part,
    turn_of,
    with_terms,
)
from halbach_fe.response.block_variation import STEP
from halbach_fe.response.response_matrix import Response
from halbach_fe.stats.gaussian import CovarianceFactor, Gaussian, NoiseCovariance, root_matrix
from halbach_fe.stats.posteriors import Rows, predict
from halbach_fe.study.inference_keys import shifted
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS


@dataclass(frozen=True)
class OpenTerms:
    """The terms of the instruments of some maps that are not known exactly."""

    names: tuple[str, ...]
    """Of each term, after the name of its map, stage or probe: ``fringe.translation_x_m``."""
    sd: Floats
    """Prior standard deviations. Shape (terms,)."""
    effects: tuple[Floats, ...]
    """For each map, how the open terms change the terms of its instrument (see `NAMES`). Maps of
    one probe or stage share open terms. Shape (30, terms)."""
    shifts: tuple[Floats, ...]
    """For each map, how the open terms shift it along the axes of its stage. Shape (3, terms)."""

    @classmethod
    def of(cls, maps: Sequence[Map]) -> OpenTerms:
        """Return the open terms of all maps."""
        known: dict[str, float] = {}
        of_terms, of_shifts = [], []
        for one in maps:
            owners = np.array([one.probe] * len(NAMES), object)
            owners[POSE], owners[OFFSETS], owners[DRIFTS] = one.pose, one.offsets, one.offsets
            terms = [f"{owner}.{name}" for owner, name in zip(owners, NAMES, strict=True)]
            shifts = [f"{one.name}.stage_shift_{axis}_m" for axis in COMPONENTS]
            sd = np.append(prior_sd(one.study.instrument_sd), one.shift_sd_m)
            if is_total_field(one.data):
                terms, sd = of_total_field(terms, sd)
            for name, value in zip(terms + shifts, sd.tolist(), strict=True):
                if value > 0:
                    known.setdefault(name, value)
            of_terms.append(terms)
            of_shifts.append(shifts)
        names = np.array(list(known))
        return cls(tuple(known), np.array(list(known.values())), *(
            tuple((np.array(rows)[:, None] == names).astype(float) for rows in every)
            for every in (of_terms, of_shifts)))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def counted(self) -> Floats:
        """Matrix (terms, terms) to the terms as they count: sensors relative to their mean."""
        found = np.eye(len(self))
        for effect in self.effects:
            sensors = np.flatnonzero(effect[SENSORS].any(axis=0))
            if len(sensors):
                found[np.ix_(sensors, sensors)] = np.kron(APART, np.eye(3))
        return found

    def of_poses(self, maps: Sequence[Map]) -> Floats:
        """Return how the terms shift the middles of the maps and turn them (maps, 6, terms)."""
        found = []
        for number, one in enumerate(maps):
            shift, turn = np.split(self._effect(number, one)[POSE], 2)
            arm = turn_of(one.study.instrument).apply(one.middle_m - one.pivot_m)
            found.append(np.concatenate([shift + np.cross(turn.T, arm).T, turn]))
        return np.array(found)

    def _effect(self, number: int, one: Map) -> Floats:
        """Return how the terms change those of a map's instrument (30, terms), shifts included."""
        effect = self.effects[number].copy()
        effect[:3] += turn_of(one.study.instrument).as_matrix() @ self.shifts[number]
        return effect

    def applied(self, maps: Sequence[Map], changes: Floats) -> list[Map]:
        """Return the maps after changes (terms,) of the instruments.

        Raises
        ------
        MeasurementError
            If the terms become larger than an instrument may have.
        """
        found = []
        for one, effect, shift in zip(maps, self.effects, self.shifts, strict=True):
            try:
                instrument = with_terms(one.study.instrument, one.pivot_m, effect @ changes)
            except StudyError:
                own = np.flatnonzero(effect.any(axis=0))
                worst = own[np.argmax(np.abs(changes / self.sd)[own])]
                where = one.name if one.name == ONLY_MAP else f"map {one.name}"
                raise MeasurementError(must_be(
                    "readings", where, "those of an instrument that is roughly known",
                    f"readings for which {self.names[worst]} changes by {changes[worst]:.3g}, "
                    f"{abs(changes[worst]) / self.sd[worst]:.0f} standard deviations",
                    "Are they in another unit, or of another magnet? See halbach-fe check and "
                    "register.")) from None
            own = turn_of(instrument).apply(shift @ changes)
            x, y, z = (own + instrument.translation_m).tolist()
            found.append(replace(one, study=one.study.with_(
                instrument=instrument.with_(translation_m=(x, y, z)))))
        return with_pivots(found)

    def together(self, before: Floats, change: Floats) -> Floats:
        """Return changes (terms,) that are as two after each other; turns do not add up."""
        found = before + change
        for effect in self.effects:
            turn = effect[POSE][3:]
            both = Rotation.from_rotvec(turn @ change) * Rotation.from_rotvec(turn @ before)
            own = turn.any(axis=0)
            found[own] = both.as_rotvec() @ turn[:, own]
        return found

    def columns(
        self, field: Callable[[Floats], Floats], maps: Sequence[Map], readings: Readings
    ) -> Floats:
        """Return the derivatives (readings, terms) of the readings by the open terms.

        ``field`` takes points (n, 3) in m and returns B (n, 3) in T of the magnet as it is
        estimated.
        """
        found = []
        for number, one in enumerate(maps):
            instrument = one.study.instrument
            data = in_si_and_magnet_axes(instrument, one.data)
            points = points_of(data)
            at_sensors, gradient = field_at_sensors(field, sensor_positions(instrument, points))
            changes = by_terms(instrument, points, one.pivot_m, map_time(data), at_sensors,
                               gradient)
            if is_total_field(one.data):  # along the field, whose three parts are one number
                along = readings.directions[one.name][:, :, None] / 3
                changes[:, :, OFFSETS] = along
                changes[:, :, DRIFTS] = along * map_time(data)[:, None, None]
            found.append(changes.reshape(3 * len(points), -1) @ self._effect(number, one))
        return readings.observation.read(np.concatenate(found).T.reshape(len(self), -1, 3)).T


def of_total_field(terms: list[str], sd: Floats) -> tuple[list[str], Floats]:
    """Return names and standard deviations of the terms of a probe of |B|.

    Its gain, offset and drift are one number each, and it has neither axes nor several sensors.
    """
    found, sd = terms.copy(), sd.copy()
    for number, name in enumerate(NAMES[:len(terms)]):
        kind = name.split("_", 1)[0]
        if kind in ("gain", "offset", "drift"):
            unit = "" if kind == "gain" else "_T"
            found[number] = terms[number].removesuffix(name) + kind + unit
        elif kind in ("crosstalk", "sensor"):
            sd[number] = 0.0
    return found, sd


def open_columns(
    study: Study, field: Callable[[Floats], Floats], maps: Sequence[Map], readings: Readings
) -> Floats:
    """Return the readings (n, terms) in T per prior standard deviation of all that is open about
    the instruments: their terms, then amplitudes of the study; see `amplitude_columns`.
    """
    terms, found = OpenTerms.of(maps), [np.zeros((len(readings.values), 0))]
    if len(terms):
        found.append(terms.columns(field, maps, readings) * terms.sd)
    if any(one.is_of_instrument for one in study.uncertain):
        found.append(amplitude_columns(study, field, maps, readings))
    return np.hstack(found)


def amplitude_columns(
    study: Study, field: Callable[[Floats], Floats], maps: Sequence[Map], readings: Readings
) -> Floats:
    """Return the derivatives (readings, amplitudes) in T by what is uncertain of the instruments.

    They are per standard deviation, see `halbach_fe.study.inference_keys.Uncertain`, of what a
    reading shows less what is subtracted from it.

    Parameters
    ----------
    study : Study
        With the instruments as they are estimated.
    field : callable
        See `OpenTerms.columns`.
    """
    uncertain = [one for one in study.uncertain if one.is_of_instrument]
    sides = [[shifted(study, one, sign * STEP * one.sd) for sign in (1, -1)] for one in uncertain]
    found = []
    for number, one in enumerate(maps):
        data = in_si_and_magnet_axes(one.study.instrument, one.data)
        before = sensor_positions(one.study.instrument, points_of(data))
        at = (before, *field_at_sensors(field, before))
        along = readings.directions.get(one.name) if is_total_field(data) else None

        def off(other: Study, number: int = number, data: xr.Dataset = data,
                at: tuple[Floats, Floats, Floats] = at, along: Floats | None = along,
                listed: bool = not one.is_validation) -> Floats:
            own = (other.of_map(number).instrument if other.maps and listed
                   else other.instrument)  # which a held-out map has
            try:
                return shown_less_read(own, data, at, along)
            except MeasurementError:
                if listed:
                    raise
                return 0 * at[0][:, 0]  # what a probe of such a held-out map cannot have

        found.append(np.array([(off(more) - off(less)) / (2 * STEP)
                               for more, less in sides]).reshape(-1, len(before), 3))
    return readings.observation.read(np.concatenate(found, axis=1)).T


def shown_less_read(
    own: Instrument, data: xr.Dataset, at: tuple[Floats, Floats, Floats], along: Floats | None
) -> Floats:
    """Return what sensors show by an instrument, less the values (n, 3) in T that are read by it.

    ``at`` are places of sensors, near which they are, with field and gradient there, see
    `field_at_sensors`. What a map of |B| reads is along directions ``along`` (n, 3).
    """
    before, at_sensors, gradient = at
    away = sensor_positions(own, points_of(data)) - before
    shown = seen(sensor_matrix(own), at_sensors + np.einsum("nscj,nsj->nsc", gradient, away))
    if along is None:
        return shown - np.nan_to_num(remove_nonlinear_part(own, data))
    return along * (np.sum(along * shown, axis=1) - np.nan_to_num(
        total_without_nonlinear_part(own, data)))[:, None]


def readings_of_field(
    field: Callable[[Floats], Floats], maps: Sequence[Map], observation: Observation
) -> Floats:
    """Return the readings (n,) in T of a field, without offset and drift.

    ``field`` takes points (n, 3) in m and returns B (n, 3) in T.
    """
    found = []
    for one in maps:
        instrument = one.study.instrument
        points = points_of(in_si_and_magnet_axes(instrument, one.data))
        sensors = sensor_positions(instrument, points)
        found.append(seen(sensor_matrix(instrument),
                          field(sensors.reshape(-1, 3)).reshape(sensors.shape)))
    return observation.read(np.concatenate(found))


@dataclass(frozen=True)
class Beside:
    """The rows of a matrix (n, m), with columns (n, k) beside it. See `Rows`."""

    matrix: Rows
    columns: Floats

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, rows: NDArray[np.int64]) -> Floats:
        return np.hstack([self.matrix[rows], self.columns[rows]])


def of_the_first(
    distributions: Sequence[Gaussian], count: int, beside: int = 0
) -> list[Gaussian]:
    """Return the distributions of the first parameters of some that share an outer root, with so
    many beside that follow them.
    """
    found = [each.split(count, beside) for each in distributions]
    outer = root_matrix(found[0].root)
    for number, each in enumerate(found):
        assert isinstance(each.root, CovarianceFactor)
        found[number] = replace(each, root=replace(each.root, outer=outer))
    return found


AT_REST = 0.1
"""Change of a reading of |B| by other directions, and of its bend, up to which they are at rest, in
units of the noise."""


@dataclass(frozen=True)
class Magnitudes:
    """The field about which readings of |B| are linear."""

    directions: dict[str, Floats] = field(default_factory=dict)
    """Unit vectors of the field at the readings of each map of |B|; empty for those of the nominal
    blocks. Shape (k, 3)."""
    turned: Floats = field(default_factory=lambda: np.zeros(0))
    """How far |B| is from its length along the directions before; 0 for components.
    Shape (readings,), in T."""
    bend: Floats = field(default_factory=lambda: np.zeros(0))
    """By what is left unknown of the field across, see the module; empty before the first update.
    Shape (readings,), in T."""

    def about(
        self, readings: Readings, vectors: Response, model: Response, prior: Gaussian
    ) -> Magnitudes:
        """Return these with the bend by a prior, unless an update has found it already."""
        if len(self.bend) or not readings.total.any():
            return self
        return replace(self.updated(readings, vectors, model, prior), directions=self.directions)

    def updated(
        self, readings: Readings, vectors: Response, model: Response, found: Gaussian
    ) -> Magnitudes:
        """Return the field of a distribution of all parameters, those of the blocks first.

        ``vectors`` is the response of `Readings.vectors`, ``model`` that of the readings.
        """
        if not readings.total.any():
            return self
        mean, sd = _predicted(vectors, found)
        along = _predicted(model, found)[1][readings.total]
        here = readings.of_components(mean)
        size = np.linalg.norm(here, axis=1)
        across = np.sqrt(np.maximum(
            np.sum(readings.of_components(sd)**2, axis=1) - along**2, 0.0))
        bend, turned = np.zeros(len(readings.total)), np.zeros(len(readings.total))
        # no length differs from that along a direction by more than the part across it
        # field below which no direction is known
        tiny_T = 1e-12
        bend[readings.total] = across * np.minimum(1.0, across / np.maximum(2 * size, tiny_T))
        turned[readings.total] = size - (readings.projection @ mean)[readings.total]
        maps = np.array(readings.maps)[readings.total]
        return Magnitudes({name: unit_vectors(here[maps == name]) for name in readings.directions},
                          turned, bend)

    def is_near(self, before: Magnitudes, noise: Floats) -> bool:
        """Tell whether an update about these finds the same, by the noise (readings,) in T."""
        return not len(self.bend) or bool((
            np.maximum(np.abs(self.turned), np.abs(self.bend - before.bend))
            <= AT_REST * noise).all())

    def with_bend(self, noise: NoiseCovariance) -> NoiseCovariance:
        """Return the noise of the readings with their bend."""
        return noise.with_independent_errors(self.bend) if len(self.bend) else noise


def bent(readings: Readings, vectors: Response, model: Response, found: Gaussian) -> Floats:
    """Return |B| less its length along the directions (readings,) in T, of the mean of a
    distribution of all parameters; 0 for components.
    """
    if not readings.total.any():
        return np.zeros(len(readings.total))
    return Magnitudes().updated(readings, vectors, model, found).turned


def warn_of_bent_readings(readings: Readings, magnitudes: Magnitudes) -> None:
    """Warn of readings of |B| that what is not known of the field across it bends noticeably."""
    if not len(magnitudes.bend):
        return
    # bend of a reading, in units of its noise, from which it is named
    bent = 0.3
    bent_ones = np.flatnonzero(magnitudes.bend > bent * readings.noise.sd)
    if len(bent_ones):
        least = bent_ones[np.argmin(readings.values[bent_ones])]
        x, y, z = (1e3 * readings.observation.positions[least]).tolist()
        warnings.warn(
            f"What is left unknown across the field bends {len(bent_ones)} of "
            f"{int(readings.total.sum())} readings of |B| by over {bent:g} of their noise, "
            f"such as {1e3 * readings.values[least]:.3g} mT at ({x:.4g}, {y:.4g}, {z:.4g}) mm. "
            "They count with more noise: components of B at some points would tell.",
            HalbachWarning, stacklevel=3)


def _predicted(model: Response, found: Gaussian) -> tuple[Floats, Floats]:
    """Return mean and sd (readings,) in T of a response by a distribution of all parameters, those
    of the blocks first.
    """
    rest = np.zeros((len(model.offset), len(found.mean) - len(model.parameters)))
    mean, sd = predict(Beside(model.matrix, rest), found)
    return model.offset + mean, sd
