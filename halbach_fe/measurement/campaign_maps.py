"""The maps of a campaign: one magnet, many maps, each with an instrument of its own."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, box_middle
from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError, must_be
from halbach_fe.core.interface import typed
from halbach_fe.measurement.field_map import (
    TOTAL_COLUMN,
    TOTAL_SIGMA_COLUMN,
    checked_map,
    is_total_field,
    points_of,
    read_map,
)
from halbach_fe.measurement.formats.import_export import refuse_units_twice
from halbach_fe.measurement.observation_operator import study_for_validation_map
from halbach_fe.measurement.positions import follows_times
from halbach_fe.measurement.probe_law import in_si_and_magnet_axes, turn_of
from halbach_fe.study.measurement_keys import InstrumentSd
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS, MIN_SIGMA_T

Data = xr.Dataset | Mapping[str, xr.Dataset]
"""The only map, or the maps that a study lists, by name."""

ONLY_MAP, VALIDATION_MAP = "map", "held-out map"
"""Names of the map of a study that lists none, and of another map that is only predicted."""

NOT_READ_T = 1e3
"""What stands for a component that was not read, where rows of maps are compared."""

GIVEN = "`data`"
"""What error messages call the map of a study that lists none, unless it comes from a file."""

SAME_PLACE_M, SAME_READING = 1e-6, 0.15
"""Differences up to which two readings are one, in m and in units of their noise: that of two ways
of rounding. A component that was read again differs less in 8 % of all cases, all three of them in
0.1 %."""

SHARED = 0.4
"""Share of a map's readings that another map may have too. Repeated readings are often equal if
the device shows few digits: in 28 % of all cases if the last one counts as much as the noise."""

SAME_DIGITS_T = 1e-12
"""Difference up to which two readings are the same digit for digit: units were converted."""

COARSE = 0.25
"""Smallest step between readings, in units of their noise, from which a device shows so few digits
that readings at a place repeat: then repetitions prove nothing."""

FEWEST_COPIES, BY_CHANCE = 8, 1e-6
"""Smallest count of rows that are copies of others from which a map is refused, and the probability
below which so many repetitions are no chance."""


@dataclass(frozen=True)
class Map:
    """A map, and what the study says about it."""

    name: str
    data: xr.Dataset
    study: Study
    """The study of this map alone."""
    middle_m: Floats
    """Middle of its points in the coordinates that the map states. Shape (3,)."""
    pivot_m: Floats
    """The point, in the same coordinates, that the uncertain pose shifts and turns about: its own
    middle, or that of the first map on the same stage. Shape (3,)."""
    probe: str
    """Name of its probe. Maps of one probe share its terms."""
    pose: str
    """Name of the stage or of the map whose pose it shares, mostly its own."""
    offsets: str
    """Name of the map whose offsets and drift it has, mostly its own."""
    shift_sd_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Prior standard deviations of an own shift along the axes of the stage."""
    is_validation: bool = False
    """Whether it is predicted but does not update the model."""


@typed
def read_maps(study: Study, folder: str | Path = ".") -> dict[str, xr.Dataset]:
    """Read the maps that a study lists.

    Parameters
    ----------
    study : Study
    folder : str or Path
        Folder of the study file, from which the paths of the maps start.

    Returns
    -------
    dict of str to Dataset
        The maps by their names, each as `read_map` returns it.

    Raises
    ------
    MeasurementError
        If a file cannot be read as a map, or two files hold the same readings.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> study = hf.read_study("dipole.toml").with_(maps=[
    ...     {"name": "body", "file": "map.csv"}])
    >>> list(hf.read_maps(study))
    ['body']
    """
    return different_maps(study, {one.name: Path(folder) / one.file for one in study.maps})


def different_maps(study: Study, files: Mapping[str, Path]) -> dict[str, xr.Dataset]:
    """Read the files of a study's maps, by name, as `read_maps` does."""
    found = {name: read_map(file) for name, file in files.items()}
    for number, (name, data) in enumerate(found.items()):
        refuse_units_twice(data, study.of_map(number).instrument, files[name])
    if found:
        maps_of(study, found)
    return found


def maps_of(
    study: Study, data: Data,
    validation_map: xr.Dataset | None = None
) -> list[Map]:
    """Return the maps of a study, each with the part of the study that holds for it.

    Parameters
    ----------
    data : Dataset or dict of str to Dataset
        The only map of a study that lists none, or the maps that it lists, by name.
    validation_map : Dataset, optional
        Another map, which is only predicted. It has the study's own instrument.

    Raises
    ------
    StudyError
        If the study lists maps but a single one is given, or the other way round.
    MeasurementError
        If a map holds what no map does, or two maps have the same readings.
    """
    data = check_maps(study, data)
    if isinstance(data, xr.Dataset):
        middle = _middle(study, data)
        _refuse_copies(ONLY_MAP, data, study)
        refuse_unordered(ONLY_MAP, data, study)
        found = [Map(ONLY_MAP, data, study, middle, middle, ONLY_MAP, ONLY_MAP, ONLY_MAP)]
    else:
        found = []
        for number, one in enumerate(study.maps):
            own = study.of_map(number)
            middle = _middle(own, data[one.name])
            _refuse_copies(one.name, data[one.name], own)
            refuse_unordered(one.name, data[one.name], own)
            found.append(Map(one.name, data[one.name], own, middle, middle, one.probe or one.name,
                             one.stage or one.name, one.name, one.stage_shift_sd_m))
        refuse_shared({one.name: _rows(one.data, one.study) for one in found})
        _refuse_mixed_probes(found)
    if validation_map is not None:
        validation_map = checked_map(validation_map, VALIDATION_MAP)
        own = study_for_validation_map(study.with_(maps=()), validation_map)
        first = found[0]
        _refuse_copies(VALIDATION_MAP, validation_map, own)
        refuse_unordered(VALIDATION_MAP, validation_map, own)
        shared = not study.maps  # with the only map; among several it has an instrument of its own
        middle = _middle(own, validation_map)
        found.append(Map(
            VALIDATION_MAP, validation_map, own, middle, middle, *(
                (first.probe, first.pose, first.offsets) if shared else (VALIDATION_MAP,) * 3),
            is_validation=True))
    return with_pivots(found)


def refuse_unordered(name: str, data: xr.Dataset, study: Study) -> None:
    """Raise a MeasurementError if a study has a lag, and a map's rows are not as they were read.

    A lag is along the way of the stage, from row to row.
    """
    if not study.instrument.lag_m or "time_s" not in data or follows_times(
            points_of(data), data["time_s"].values):
        return
    raise MeasurementError(must_be(
        f"rows of `{name}`", f"study {study.name}", "in the order of the column time_s, since the "
        "study states a lag of the readings behind the stage (instrument.lag_m)",
        "rows between which the stage moved otherwise", "Sort the table by time_s."))


def check_maps(study: Study, data: object) -> xr.Dataset | dict[str, xr.Dataset]:
    """Return the maps that are given after `checked_map`, if they are those that a study lists.

    Raises
    ------
    StudyError
        If they are not.
    MeasurementError
        If a map holds what no map does.
    """
    if isinstance(data, xr.Dataset) or not isinstance(data, Mapping):
        data = checked_map(data, GIVEN)
        if study.maps:
            raise StudyError(must_be(
                "`maps`", f"study {study.name}", "left out, or the only maps of the campaign",
                "a list, and another map beside it",
                "Read the listed maps (in Python by read_maps), or remove the list."))
        return data
    if list(data) != [one.name for one in study.maps] or not data:
        raise StudyError(must_be(
            "`maps`", f"study {study.name}", "those that are given, by name",
            f"{', '.join(one.name for one in study.maps) or 'none'} for "
            f"{', '.join(map(str, data)) or 'none'}", "Read them by read_maps."))
    return {name: checked_map(one, name) for name, one in data.items()}


def with_pivots(maps: Sequence[Map]) -> list[Map]:
    """Return maps that turn about the middle of the first one of their stage."""
    first = {one.pose: one for one in reversed(maps)}
    return [one if first[one.pose] is one else
            replace(one, pivot_m=_seen_from(one.study, first[one.pose])) for one in maps]


def repeated(rows: Floats, others: Floats, tolerance: Floats) -> NDArray[np.bool_]:
    """Return which rows (n, k) are others (m, k) too, within the tolerance (k,) of each column."""
    if not len(others):
        return np.zeros(len(rows), bool)
    distance, _ = KDTree(others / tolerance).query(
        rows / tolerance, p=np.inf, distance_upper_bound=1.0)
    return np.isfinite(distance)


def _refuse_copies(name: str, data: xr.Dataset, study: Study) -> None:
    """Raise a MeasurementError if many rows of a map are others again, digit for digit.

    Repeated readings at a place differ by their noise, unless the device shows few digits.
    """
    points, field, noise = _rows(data, study)
    blank = np.nan_to_num(field, nan=NOT_READ_T)
    order = np.lexsort(np.hstack([blank, points]).T)
    here, read = points[order], blank[order]
    # rows that are alike follow each other
    again = (here[1:] == here[:-1]).all(axis=1)
    copied = again & (np.abs(read[1:] - read[:-1]) <= SAME_DIGITS_T).all(axis=1)
    count = int(copied.sum())
    if count and _no_chance(count, int(again.sum()), field, noise):
        row = int(max(order[np.flatnonzero(copied)[0]:][:2])) + 1
        _refuse(count, must_be(
            f"rows of `{name}`", f"study {study.name}", "readings of their own, as the same "
            "readings must not count twice", f"{count} of {len(points)} rows that are another row "
            f"again, digit for digit, such as row {row}", "Remove the copies; repeated "
            "measurements differ by their noise."))
    count, offset = _copies_with_offset(points, blank, noise)
    if count:
        _refuse(count, must_be(
            f"rows of `{name}`", f"study {study.name}", "readings of their own, as the same "
            "readings must not count twice", f"{count} of {len(points)} rows that are another row "
            f"again, but for an offset of {1e6 * np.abs(offset).max():.3g}\u00a0\u00b5T that all "
            "share", "Remove the copies; repeated measurements differ by their noise, too."))
    for axis, component in enumerate(COMPONENTS):
        count, pairs = _mirrored(points, blank, axis)
        if count > SHARED * pairs and _no_chance(count, pairs, field, noise):
            warnings.warn(
                f"{count} of {len(points)} rows of `{name}` of study {study.name} are others "
                f"mirrored along {component}, digit for digit but for signs. If symmetry made "
                "them, and no probe, leave them out: they count twice, and hide what is not "
                "symmetric in the magnet.", HalbachWarning, stacklevel=2)


def _mirrored(points: Floats, field: Floats, axis: int) -> tuple[int, int]:
    """Return how many rows are others mirrored in the middle of the map along an axis.

    Signs of components do not matter. The second number is that of all pairs of such places.
    """
    image = points.copy()
    image[:, axis] = points[:, axis].min() + points[:, axis].max() - points[:, axis]
    distance, other = KDTree(points).query(image, distance_upper_bound=SAME_PLACE_M)
    first = np.flatnonzero(np.isfinite(distance) & (other > np.arange(len(points))))
    alike = (np.abs(field[first]) == np.abs(field[other[first]])).all(axis=1)
    return int(alike.sum()), len(first)


def _copies_with_offset(points: Floats, field: Floats, noise: float) -> tuple[int, Floats]:
    """Return how many rows of a map are earlier ones at the same place, but for an offset (k,) in T
    that all share; 0 if chance may have made them.

    After a zero was taken off, values were rounded once more, to a neighbouring step.
    """
    most_visits = 8  # of a place, apart from each other, that are compared
    order = np.lexsort(points.T)  # of equal places the earlier row comes first
    here, read = points[order], field[order]
    step = np.array([_steps(column).min(initial=np.inf) for column in field.T])
    within = np.where(np.isfinite(step), step, 0.0) + SAME_DIGITS_T
    for apart in range(1, most_visits):
        same = (here[apart:] == here[:-apart]).all(axis=1)
        if not same.any():
            break
        difference = (read[apart:] - read[:-apart])[same]
        offset = np.median(difference, axis=0)
        count = int((np.abs(difference - offset) <= within).all(axis=1).sum())
        # one of them is what the offset is taken from, and proves nothing
        if _no_chance(count - 1, len(difference) - 1, field, noise, steps=3):
            return count, offset
    return 0, np.zeros(field.shape[1])


def _refuse(copies: int, sentence: str) -> None:
    """Raise a MeasurementError of copies of readings, or warn if so few hardly change a result."""
    if copies >= FEWEST_COPIES:
        raise MeasurementError(sentence)
    warnings.warn(f"{sentence} Until then these count twice.", HalbachWarning, stacklevel=2)


def _no_chance(copies: int, pairs: int, field: Floats, noise: float, steps: int = 1) -> bool:
    """Return whether ``copies`` of ``pairs`` of readings (n, 3) at a place are alike by no chance.

    Two readings that are rounded to steps q have the same digits with the probability
    ``q / (2 sqrt(pi) sigma)``, for q below the noise sigma, and any of some ``steps`` that are next
    to each other with so many times that.
    """
    if not copies or noise <= 0:
        return False
    alike = 1.0
    for column in field.T:
        found = _steps(column)
        if len(found):
            ratio = steps * float(found.min()) / noise
            alike *= 1.0 if ratio > COARSE else ratio / (2 * np.sqrt(np.pi))
    return bool(special.bdtrc(copies - 1, pairs, alike) < BY_CHANCE)


def _steps(column: Floats) -> Floats:
    """Return the differences (m,) between values (n,) that follow each other in size."""
    steps = np.diff(np.unique(column[np.isfinite(column)]))
    return steps[steps > SAME_DIGITS_T]


def refuse_shared(
    maps: Mapping[str, tuple[Floats, Floats, float]], where: str = "the campaign"
) -> None:
    """Raise a MeasurementError if many readings of a map are in another one too.

    ``maps`` are points (n, 3) in m, values (n, k) in T and typical noise in T of each, by its name.
    """
    for (one, (points, field, noise)), (other, (places, values, sigma)) in combinations(
            maps.items(), 2):
        both = np.isfinite(field).any(axis=0) & np.isfinite(values).any(axis=0)
        sides = []
        for position, reading in ((points, field), (places, values)):
            read = np.isfinite(reading[:, both]).any(axis=1)
            blank = np.nan_to_num(reading[read][:, both], nan=NOT_READ_T)
            sides.append(np.hstack([position[read], blank]))
        tolerance = np.append(np.full(3, SAME_PLACE_M), np.full(
            both.sum(), max(SAME_READING * min(noise, sigma), MIN_SIGMA_T)))
        fewer, more = sorted(sides, key=len)
        shared = int(repeated(fewer, more, tolerance).sum())
        offset = _offset(fewer, more)
        beside = int(repeated(fewer - np.append(np.zeros(3), offset), more, tolerance).sum())
        shifted, shared = beside > shared, max(beside, shared)
        exact = np.append(np.full(3, SAME_PLACE_M), np.full(both.sum(), SAME_DIGITS_T))
        copies = int(repeated(fewer, more, exact).sum())
        there = int(repeated(fewer[:, :3], more[:, :3], exact[:3]).sum())
        of_fewer = field if fewer is sides[0] else values
        rounded = shared > SHARED * len(fewer)
        if rounded or _no_chance(copies, there, of_fewer[:, both], min(noise, sigma)):
            count = max(shared, FEWEST_COPIES) if rounded else copies
            _refuse(count, must_be(
                f"`maps` '{one}' and '{other}'", where,
                "different maps, as the same readings must not count twice",
                f"the same readings in {shared if rounded else copies} of {len(fewer)} rows" + (
                    f", but for an offset of {1e6 * np.abs(offset).max():.3g}\u00a0\u00b5T that "
                    "all share" if shifted and rounded else ""),
                "Remove one of them, or these rows of one."))


def _offset(rows: Floats, others: Floats) -> Floats:
    """Return by how much values (k,) of rows (n, 3 + k) and others (m, 3 + k) at the same places
    differ in the median.

    Copies of which a zero was taken off scatter no more about it than copies do.
    """
    if not len(rows) or not len(others):
        return np.zeros(rows.shape[1] - 3)
    distance, nearest = KDTree(others[:, :3]).query(
        rows[:, :3], distance_upper_bound=SAME_PLACE_M)
    near = np.isfinite(distance)
    if not near.any():
        return np.zeros(rows.shape[1] - 3)
    return np.asarray(np.median(rows[near, 3:] - others[nearest[near], 3:], axis=0))


def _refuse_mixed_probes(maps: Sequence[Map]) -> None:
    """Raise a StudyError if a map of |B| shares its probe with one of components."""
    for one, other in combinations(maps, 2):
        if one.probe == other.probe and is_total_field(one.data) != is_total_field(other.data):
            raise StudyError(must_be(
                f"`maps.probe` of '{one.name}' and '{other.name}'", "the campaign",
                "different, as one map is of |B| and the other of components", f"'{one.probe}'",
                "Leave `probe` out for one of them."))


def _rows(data: xr.Dataset, study: Study) -> tuple[Floats, Floats, float]:
    """Return points (n, 3) in m, values (n, 4) in T and typical noise in T of a map.

    Both are in SI units and along the axes of the magnet; the last value is |B| of a map of |B|
    alone. The noise is 0 if nothing states it.
    """
    data = in_si_and_magnet_axes(study.instrument, data)
    alone = is_total_field(data)
    total = data[TOTAL_COLUMN].values if alone else np.full(data.sizes["point"], np.nan)
    field = np.column_stack([data["B_T"].values, total])
    noise = [region.sigma_T for region in study.noise.regions] if study.noise else []
    if alone and TOTAL_SIGMA_COLUMN in data:
        noise = [float(np.median(data[TOTAL_SIGMA_COLUMN].values[np.isfinite(total)]))]
    elif "sigma_T" in data:
        noise = [float(np.median(data["sigma_T"].values[np.isfinite(field[:, :3])]))]
    return points_of(data), field, min(noise, default=0.0)


def with_paths_from(study: Study, before: Path, after: Path) -> Study:
    """Return a study whose maps are found from another folder than before."""
    return study.with_(maps=tuple(
        one.with_(file=os.path.relpath(before / one.file, after)) for one in study.maps))


def refuse_several_maps(study: Study, verb: str) -> None:
    """Raise a StudyError if a study lists maps, for what works with a single map only."""
    if study.maps:
        raise StudyError(must_be(
            "`maps`", f"study {study.name}", f"left out, since {verb} takes a single map",
            f"a list of {len(study.maps)}",
            "Give it a study of one of the maps, with that map's instrument."))


def refuse_open_instruments(study: Study, verb: str) -> None:
    """Raise a StudyError if terms of an instrument are to be estimated, where that cannot be."""
    whole = [study.of_map(number) for number in range(len(study.maps))] or [study]
    if any(one.instrument_sd != InstrumentSd() for one in whole):
        raise StudyError(must_be(
            "`instrument_sd`", f"study {study.name}", f"left out, for {verb}", "a table",
            "State the instrument that halbach-fe infer found (study.updated.toml) without it."))


def refuse_uncertain(study: Study, verb: str) -> None:
    """Raise a StudyError if amplitudes are to be estimated, where that cannot be."""
    if study.uncertain:
        raise StudyError(must_be(
            "`uncertain`", f"study {study.name}", f"left out, for {verb}", "a table",
            "Remove the tables [[uncertain]]: the amplitudes are then exactly what the study "
            "says."))


def _seen_from(study: Study, first: Map) -> Floats:
    """Return the middle (3,) in m of the first map on a stage, in the coordinates of another."""
    one, other = first.study.instrument, study.instrument
    place = turn_of(one).apply(first.middle_m) + one.translation_m
    return np.asarray(turn_of(other).inv().apply(
        place - other.translation_m))


def _middle(study: Study, data: xr.Dataset) -> Floats:
    return box_middle(points_of(in_si_and_magnet_axes(study.instrument, data)))
