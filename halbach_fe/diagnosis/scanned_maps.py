"""The maps of a campaign as effects see them: where, when and by which instrument they were read.

An effect of the magnet is seen by all maps. An effect of the instrument is seen by one map, or by
all maps that share the probe or the stage to which it belongs. A study of a single map is a
campaign of one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.core.errors import MeasurementError
from halbach_fe.diagnosis.effects.base import Effect, Hypothesis, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.inference.infer import with_instruments
from halbach_fe.inference.relinearization import OpenTerms
from halbach_fe.inference.result import InstrumentTerms
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.campaign_maps import maps_of
from halbach_fe.measurement.field_map import has_times, is_total_field, points_of
from halbach_fe.measurement.positions import follows_times
from halbach_fe.measurement.probe_law import (
    check_components,
    check_total_field,
    in_si_and_magnet_axes,
    map_time,
    probe_points,
    sensor_matrix,
)
from halbach_fe.study.measurement_keys import POSE_KEYS, PROBE_KEYS
from halbach_fe.study.model import Study

FieldAt = Callable[[Study, Floats], Floats]
"""Function of a study and points (n, 3) in m that returns B (n, 3) in T of its nominal magnet."""


@dataclass(frozen=True)
class ScannedMap:
    """Where and when the probe was for a map."""

    name: str
    probe: str
    pose: str
    """See `halbach_fe.measurement.campaign_maps.Map`."""
    number: int | None
    """Its number among the maps that the study lists; None if it has the study's own instrument."""
    is_validation: bool
    points: Floats
    """As the map states them, along the magnet's axes. Shape (n, 3), in m."""
    time: Floats
    """From 0 to 1. Shape (n,)."""
    rows: slice
    """Of its points among those of all maps."""
    missing: Bools
    """Which components were not read. Shape (n, 3)."""
    is_total: bool = False
    """Whether it is a map of |B| alone."""
    timed: bool = True
    """Whether it has times; else ``time`` is the order of its rows."""

    def can_have(self, effect: Effect, place: Place, study: Study) -> bool:
        """Tell whether the map can show an effect, and be corrected for it.

        |B| has one sensor, without axes; a planar Hall effect needs all components, and a lag rows
        in the order in which they were read.
        """
        if effect.kind == "field" or effect.of_total_field:
            return self.is_total or not effect.of_total_field
        try:
            for values in np.diag([parameter.sd for parameter in effect.parameters]).tolist():
                instrument = effect.apply(study, place, values).instrument
                if instrument.lag_m and not follows_times(self.points, self.time):
                    return False
                if self.is_total:
                    check_total_field(instrument)
                else:
                    check_components(instrument, self.missing)
        except MeasurementError:
            return False
        return True

    def study_of(self, study: Study) -> Study:
        """Return what a study says about this map alone."""
        if self.number is not None:
            return study.of_map(self.number)
        return study.with_(maps=()) if study.maps else study


@dataclass(frozen=True)
class Campaign:
    """All maps of a diagnosis, and effects seen in them."""

    maps: tuple[ScannedMap, ...]
    """Those that the study lists, or the only one; and the validation map, if there is one."""
    data: xr.Dataset | Mapping[str, xr.Dataset]
    """The maps themselves, without a validation map."""
    blocks: BlockTable | None = None
    """Measured blocks, which a study with effects must be able to have."""

    @classmethod
    def of(
        cls, study: Study, data: xr.Dataset | Mapping[str, xr.Dataset],
        validation_map: xr.Dataset | None = None,
    ) -> Campaign:
        """Return the maps of a study, see `halbach_fe.measurement.campaign_maps.maps_of`."""
        found, first = [], 0
        for number, one in enumerate(maps_of(study, data, validation_map)):
            points = points_of(in_si_and_magnet_axes(one.study.instrument, one.data))
            listed = bool(study.maps) and not one.is_validation
            found.append(ScannedMap(
                one.name, one.probe, one.pose, number if listed else None, one.is_validation,
                points, map_time(one.data), slice(first, first + len(points)),
                np.isnan(one.data["B_T"].values), is_total_field(one.data),
                has_times(one.data)))
            first += len(points)
        return cls(tuple(found), data)

    @property
    def is_listed(self) -> bool:
        """Whether the study lists the maps, so that effects of instruments name theirs."""
        return self.maps[0].number is not None

    @cached_property
    def times(self) -> Floats:
        """Time (n,) of all points."""
        return np.concatenate([one.time for one in self.maps])

    @cached_property
    def stated_points(self) -> Floats:
        """All points (n, 3) in m as the maps state them."""
        return np.vstack([one.points for one in self.maps])

    def points_of(self, study: Study) -> Floats:
        """Return all points (n, 3) in m in the magnet, by the instruments of a study."""
        return np.vstack([probe_points(one.study_of(study).instrument, one.points)
                          for one in self.maps])

    def with_terms(self, study: Study, terms: InstrumentTerms | None) -> Study:
        """Return a study whose instruments have the terms that an inference has found."""
        if terms is None:
            return study
        maps = maps_of(study, self.data)
        open_terms, found = OpenTerms.of(maps), dict(zip(terms.names, terms.change, strict=True))
        return with_instruments(study, open_terms.applied(
            maps, np.array([found[name] for name in open_terms.names])))

    def seen(self, study: Study, fields: Floats) -> Floats:
        """Return what the maps show (k, n, 3) in T of fields (k, n, 3) in T in the magnet's axes,
        by the instruments of a study.
        """
        return np.concatenate([fields[:, one.rows] @ sensor_matrix(
            one.study_of(study).instrument).T for one in self.maps], axis=1)

    def places(self, effect: Effect, study: Study) -> list[Place]:
        """Return the places of an effect: of one of an instrument, in every map, probe or stage.

        Maps that cannot show it have none.
        """
        if effect.kind == "field" or not self.is_listed:
            maps = [one for one in self.maps if not one.is_validation]
            return [place for place in (effect.places(study) if maps else ()) if any(
                one.can_have(effect, place, study) for one in maps)]
        found: dict[Place, list[str]] = {}
        for one in self.maps:
            if one.number is None:
                continue
            own = one.study_of(study)
            for place in effect.places(own):
                if not one.can_have(effect, place, own):
                    continue
                stated = any(other.stage == study.maps[one.number].stage
                             and any(other.stage_shift_sd_m) for other in study.maps)
                for owner in _owners(one, keys_of(effect, place, own), stated):
                    found.setdefault(replace(place, instrument=owner), []).append(one.name)
        return [replace(place, maps=tuple(names)) for place, names in found.items()]

    def scene(
        self, study: Study, field: FieldAt | None = None,
        iron: Callable[[Study, Floats, bool], Floats | None] | None = None,
        magnetizations: Floats | None = None,
    ) -> Scene:
        """Return the nominal magnet of a study at the points of all maps.

        Parameters
        ----------
        field : callable, optional
            Field of the nominal magnet of a study, see `FieldAt`, for effects that need it solved.
        iron : callable, optional
            Change that iron makes to the field, see `NominalFields.solve_iron`.
        magnetizations : ndarray, optional
            See `NominalFields.measured_magnetizations`.
        """
        points = self.points_of(study)  # solved at all of them at once

        def solve(rows: slice) -> Callable[[Study], Floats]:
            def at_rows(changed: Study) -> Floats:
                if field is None:
                    raise AssertionError(f"study {study.name} was not to be solved")
                return field(changed, points)[rows]
            return at_rows

        def solve_iron(rows: slice) -> Callable[[Study, bool], Floats | None]:
            def at_rows(changed: Study, few_modes: bool) -> Floats | None:
                found = None if iron is None else iron(changed, points, few_modes)
                return None if found is None else found[rows]
            return at_rows

        return Scene(self.maps, tuple(NominalFields(
            one.study_of(study), points[one.rows], one.time, solve(one.rows),
            solve_iron=solve_iron(one.rows), measured_magnetizations=magnetizations,
            stated=one.points, of_total_field=one.is_total)
            for one in self.maps))


@dataclass(frozen=True)
class Scene:
    """The nominal magnet of a study, and its field at the points of all maps."""

    maps: tuple[ScannedMap, ...]
    fields: tuple[NominalFields, ...]
    """One for each map, with the part of the study that holds for it."""

    @cached_property
    def points(self) -> Floats:
        """Positions of the probe (n, 3) in m along the magnet's axes."""
        return np.vstack([one.points for one in self.fields])

    @cached_property
    def field(self) -> Floats:
        """Values (n, 3) in T that the maps show of the nominal magnet, without offsets."""
        return np.concatenate([one.field @ _sensors(one).T for one in self.fields])

    @cached_property
    def gradient(self) -> Floats:
        """Change of these values (n, 3, 3) in T/m as the probe moves along the magnet's axes."""
        return np.concatenate([_sensors(one) @ one.gradient for one in self.fields])

    def signature(self, hypothesis: Hypothesis) -> Floats:
        """Return the change of all values (k, n, 3) in T per unit of each parameter."""
        return self.seen(hypothesis, lambda nominal: hypothesis.effect.signature(
            nominal, hypothesis.place))

    def rough_signature(self, hypothesis: Hypothesis) -> Floats | None:
        """Return what all maps show (k, n, 3) in T of `Effect.rough_signature`; None if there is
        none for one of the maps.
        """
        if hypothesis.effect.kind == "instrument":
            return None
        shown: list[Floats] = []
        for nominal in self.fields:
            found = hypothesis.effect.rough_signature(nominal, hypothesis.place)
            if found is None:
                return None
            shown.append(found @ _sensors(nominal).T)
        return np.concatenate(shown, axis=1)

    def derivative(self, hypothesis: Hypothesis, amounts: Floats) -> Floats:
        """Return the change (k + r, n, 3) in T per unit of all amplitudes, see
        `Effect.derivative`.
        """
        return self.seen(hypothesis, lambda nominal: hypothesis.effect.derivative(
            nominal, hypothesis.place, amounts.tolist()))

    def seen(self, hypothesis: Hypothesis, of: Callable[[NominalFields], Floats]) -> Floats:
        """Return what maps show of changes (k, n, 3) in T of an effect; 0 where it does not act.

        Those of an effect of the magnet are changes of the field, those of an instrument changes of
        the values themselves.
        """
        place, is_field = hypothesis.place, hypothesis.effect.kind == "field"
        found = [None if place.maps and one.name not in place.maps else
                 of(nominal) @ _sensors(nominal).T if is_field else of(nominal)
                 for nominal, one in zip(self.fields, self.maps, strict=True)]
        count = next(len(part) for part in found if part is not None)
        return np.concatenate([np.zeros((count, *nominal.points.shape)) if part is None else part
                               for part, nominal in zip(found, self.fields, strict=True)], axis=1)


def _sensors(nominal: NominalFields) -> Floats:
    """Return the matrix (3, 3) from B in the magnet's axes to the values of a map."""
    return sensor_matrix(nominal.study.instrument)


def keys_of(effect: Effect, place: Place, study: Study) -> set[str]:
    """Return the keys of the instrument of a study that an effect changes."""
    changed = effect.apply(study, place, [parameter.sd for parameter in effect.parameters])
    return {key for key, value in changed.instrument if value != getattr(study.instrument, key)}


def _owners(one: ScannedMap, keys: set[str], stated: bool) -> list[str]:
    """Return what may have an effect that changes such keys of the instrument of a map.

    That is the probe or the map. What lies on a stage is moved with the stage, or by itself unless
    it is ``stated`` how far it may have moved: an overlap of maps is a reading, which no effect
    may overrule.
    """
    if keys & set(PROBE_KEYS) and one.probe != one.name:
        return [f"probe {one.probe}"]
    if keys <= set(POSE_KEYS) and one.pose != one.name:
        alone = [] if stated and keys == {"translation_m"} else [f"map {one.name}"]
        return [f"stage {one.pose}", *alone]
    return [f"map {one.name}"]
