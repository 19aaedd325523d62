"""Keys of a study that describe the inference: prior, held-out readings, plan, maps, and what is
uncertain beside the blocks, ``[[uncertain]]``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Union

from pydantic import BaseModel, BeforeValidator, Field, model_validator

from halbach_fe.study.materials import Material
from halbach_fe.study.measurement_keys import Instrument, InstrumentSd, NoiseSettings, Positions
from halbach_fe.study.types import (
    COMPONENTS,
    MAX_POINTS,
    Component,
    Coordinate,
    Gap,
    Length,
    Line,
    PositionSd,
    ReferenceTemperature,
    RemanenceCoefficient,
    StudyModel,
)

if TYPE_CHECKING:
    from halbach_fe.study.model import Study


class Prior(StudyModel):
    """Prior standard deviations of the blocks' magnetizations about their nominal values.

    ``magnitude_sd`` and ``common_mode_sd`` are fractions of the nominal magnetization. The
    deviation of ``magnitude_sd`` is independent from block to block; that of ``common_mode_sd`` is
    shared by all blocks (an error of the data sheet, or of the Helmholtz coil's calibration).
    Without it blocks share what ``remanence_sd`` has for their grade: that of its data sheet, where
    their remanence is that of the grade.
    ``direction_sd_deg`` is the standard deviation of the angle of the magnetization, in each of the
    two directions perpendicular to the easy axis.

    With ``variation_sd`` the magnetization along the easy axis varies inside the blocks: its
    deviation, a fraction of the nominal magnetization, has this standard deviation at every place,
    and those of two places of a block at the distance d have the correlation
    ``exp(-d^2 / (2 variation_length_m^2))``. In 3D and without iron only.

    ``mounting_sd_deg`` is the standard deviation of the rotation of a mounted block about each
    axis.

    With a block table, the measured moments of the single blocks (see
    `halbach_fe.measurement.block_table`), these replace ``magnitude_sd``, ``direction_sd_deg`` and
    ``remanence_sd``; ``common_mode_sd`` and ``mounting_sd_deg`` still apply. ``types`` lists the
    slots of every block type; by default every slot is a type of its own, labelled by its number.
    With ``temperature_coefficient_per_K`` and ``reference_temperature_C``, moments are corrected to
    the reference temperature by ``m(T) = m(T_ref) (1 + coefficient (T - T_ref))``.
    """

    magnitude_sd: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.01
    direction_sd_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 1.0
    common_mode_sd: Annotated[float, Field(ge=0.0, lt=1.0)] | None = None
    remanence_sd: dict[Material, Annotated[float, Field(ge=0.0, lt=1.0)]] = {}  # noqa: RUF012
    variation_sd: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    variation_length_m: Length | None = None
    mounting_sd_deg: Annotated[float, Field(ge=0.0, lt=90.0)] = 0.0
    types: dict[Line, Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]] = {}  # noqa: RUF012
    temperature_coefficient_per_K: RemanenceCoefficient | None = None
    reference_temperature_C: ReferenceTemperature | None = None

    @property
    def calibration_sd(self) -> float:
        """That of the coil of measured blocks, of which a data sheet says nothing."""
        return self.common_mode_sd or 0.0

    @property
    def shared_sd(self) -> float:
        """The largest that blocks share which nobody has measured."""
        return (max(self.remanence_sd.values(), default=0.0) if self.common_mode_sd is None
                else self.common_mode_sd)

    @model_validator(mode="after")
    def _consistent(self) -> Prior:
        if (self.temperature_coefficient_per_K is None) != (self.reference_temperature_C is None):
            raise ValueError("give temperature_coefficient_per_K and reference_temperature_C "
                             "together, or neither")
        if (self.variation_sd > 0) != (self.variation_length_m is not None):
            raise ValueError("give variation_sd and variation_length_m together, or neither")
        return self


class HeldOut(StudyModel):
    """Held-out readings, which the update does not use and only predicts.

    A reading is held out if any of these keys selects it. ``every`` groups the readings into
    windows of ``window`` consecutive z positions and selects the last of every ``every`` windows;
    a table without any key means ``every = 2``. ``radii_m`` selects readings at these distances
    from the axis, ``components`` selects components of B, and ``z_ranges_m`` selects readings
    between a lower and an upper limit of z. ``scan_lines_every`` selects the middle one of every so
    many lines of the scan, the same ones that `halbach-fe check` holds out.
    """

    every: Annotated[int, Field(ge=2, le=1000)] | None = None
    window: Annotated[int, Field(ge=1, le=100_000)] = 1
    radii_m: tuple[Gap, ...] = ()
    components: tuple[Component, ...] = ()
    z_ranges_m: tuple[tuple[Coordinate, Coordinate], ...] = ()
    scan_lines_every: Annotated[int, Field(ge=2, le=1000)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _windows(cls, given: Any) -> Any:
        alone = isinstance(given, dict) and not given.keys() - {"window"}
        return given | {"every": 2} if alone else given

    @model_validator(mode="after")
    def _consistent(self) -> HeldOut:
        if self.every is None and self.window > 1:
            raise ValueError("window needs every, because the last of every so many windows is "
                             "held out; give every too")
        for low, high in self.z_ranges_m:
            if low > high:
                raise ValueError(f"z_ranges_m must be pairs of a lower and an upper limit, not "
                                 f"[{low}, {high}]")
        return self


class ExcludedReading(StudyModel):
    """Components of B in one row of the map that are excluded from the inference.

    Rows are numbered from 1. A row number in place of this table excludes all components.
    """

    row: Annotated[int, Field(ge=1)]
    components: Annotated[tuple[Component, ...], Field(min_length=1)] = COMPONENTS


def _row_or_table(value: Any) -> Any:
    """Expand a row number to the table of that row."""
    return {"row": value} if isinstance(value, int) else value


class Inference(StudyModel):
    """Readings that the inference does not use.

    Readings of ``held_out`` are predicted, as a test of the model. Those of ``excluded_readings``,
    outliers for example, are neither used nor predicted. Their components are along the magnet's
    axes, after the axes of the map have been converted (see Instrument).
    """

    held_out: HeldOut | None = None
    excluded_readings: tuple[
        Annotated[ExcludedReading, BeforeValidator(
            _row_or_table, json_schema_input_type=Union[int, ExcludedReading])], ...] = ()  # noqa: UP007


class Plan(StudyModel):
    """Settings of `halbach-fe plan`, which chooses the most informative measurement positions.

    ``points`` is the number of positions to choose (default: as many as ``observation`` has, or
    all candidates if these are fewer), ``candidates`` the positions to choose from (default: those
    of ``observation``).
    """

    points: Annotated[int, Field(ge=1, le=100_000)] | None = None
    candidates: tuple[Positions, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Plan:
        total = sum(one.size for one in self.candidates)
        if total > MAX_POINTS:
            raise ValueError(f"candidates may have {MAX_POINTS} points together, not {total}")
        return self


RESULTS = ("run.json", "study.registered.toml")
"""Files beside which `halbach-fe register` makes a folder for every map."""


class MapSettings(StudyModel):
    """One of several maps of the magnet.

    ``file`` is its path from the folder of the study file. ``instrument``, ``instrument_sd``,
    ``noise`` and ``inference`` replace the study's tables of the same name as a whole for this map;
    where they are left out, those of the study hold. Maps that name the same ``probe`` share its
    terms (crosstalk, gain, nonlinearity and places of the sensors), which are then estimated from
    all of them together; otherwise every map has a probe of its own. Maps that name the same
    ``stage`` were made on one that was not mounted anew between them. They move and turn in the
    magnet together, but for ``stage_shift_sd_m``: the prior standard deviations of an own shift of
    this map along the three axes of the stage, whose origin was set anew. `halbach-fe register`
    finds shifts from nothing whose standard deviation is 1 mm or more.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    file: Annotated[Line, Field(min_length=1, max_length=4096)]
    probe: Annotated[Line, Field(min_length=1, max_length=100)] | None = None
    stage: Annotated[Line, Field(min_length=1, max_length=100)] | None = None
    stage_shift_sd_m: tuple[PositionSd, PositionSd, PositionSd] = (0.0, 0.0, 0.0)
    instrument: Instrument | None = None
    instrument_sd: InstrumentSd | None = None
    noise: NoiseSettings | None = None
    inference: Inference | None = None

    @model_validator(mode="after")
    def _consistent(self) -> MapSettings:
        if self.name in RESULTS:
            raise ValueError(f"the name '{self.name}' of a map is that of a file of results")
        if "\0" in self.file:
            raise ValueError("file must be a path")
        if self.stage is None and any(self.stage_shift_sd_m):
            raise ValueError("stage_shift_sd_m needs a stage that other maps share")
        return self


OF_INSTRUMENTS = ("instrument.", "maps[")
"""Beginnings of the names of numbers that describe an instrument, and not the magnet."""

OF_READINGS = re.compile(
    r"array\.|iron\.|iron_ring\.|external\.|demagnetization\.|"
    r"(maps\[\d+\]\.)?instrument\.(?!length_unit_m$|flux_density_unit_T$)")
"""Beginnings of the names of numbers that change readings. Units change the numbers of a file."""

Derivative = Annotated[float, Field(allow_inf_nan=False)]


class Uncertain(StudyModel):
    """An amplitude of the study whose value is uncertain, and estimated with the blocks.

    ``sd`` is its standard deviation about what the study says, as it was known without the map.
    ``change`` says what a unit of the amplitude changes: numbers of the study by their names, with
    elements of lists counted from 1 (``"array.exceptions[1].shift_m[3]"``), and their changes.
    Changes of the magnet are parameters of its posterior, in units of ``sd``; changes of an
    instrument widen the error bars of the blocks. One amplitude changes either the magnet or
    instruments. `halbach-fe diagnose` writes such tables for the amplitudes that it finds.
    """

    name: Annotated[Line, Field(min_length=1, max_length=200)]
    sd: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    change: Annotated[dict[Line, Derivative], Field(min_length=1)]

    @property
    def is_of_instrument(self) -> bool:
        """Whether it changes instruments, rather than the magnet."""
        return all(name.startswith(OF_INSTRUMENTS) for name in self.change)


def check_uncertain(study: Study) -> None:
    """Check that every name is that of a number of the study, and no amplitude is listed twice.

    Raises
    ------
    ValueError
        If one is not, or an amplitude changes nothing, or both the magnet and an instrument.
    """
    names = [one.name for one in study.uncertain]
    for one in study.uncertain:
        if names.count(one.name) > 1:
            raise ValueError(f"every table [[uncertain]] needs a name of its own, but two of them "
                             f"have '{one.name}'")
        if not any(one.change.values()):
            raise ValueError(f"uncertain '{one.name}' changes all its numbers by 0; give the "
                             "change of each per unit of the amplitude")
        of_instrument = [name.startswith(OF_INSTRUMENTS) for name in one.change]
        if any(of_instrument) and not all(of_instrument):
            raise ValueError(f"uncertain '{one.name}' changes both the magnet and an instrument; "
                             "give each of them a table of its own")
        idle = next((name for name in one.change if not _changes_readings(study, name)), None)
        if idle is not None:
            raise ValueError(
                f"uncertain '{one.name}' changes '{idle}', which no update estimates; name numbers "
                "of the magnet (array, iron, iron_ring, external; demagnetization if it is "
                "irreversible) or of an instrument" + (
                    ": gain, or z_scale and radius_scale, in place of a unit"
                    if "_unit_" in idle else ""))
        for name in one.change:
            if study.maps or not name.startswith("maps["):  # else it is the study of one of them
                _check_number(study, name)


def _changes_readings(study: Study, name: str) -> bool:
    """Return whether readings can depend on the number of a name."""
    losses = study.demagnetization is not None and study.demagnetization.irreversible
    return bool(OF_READINGS.match(name)) and (losses or not name.startswith("demagnetization."))


def _check_number(study: Study, name: str) -> None:
    """Check that a name is that of a number that a study states."""
    value: Any = study
    hint = ""
    for step in _steps(name):
        known = dict(_parts(value))
        near = [] if step in known else difflib.get_close_matches(
            str(step), [key for key in known if isinstance(key, str)], 1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        if known and isinstance(step, int) and step not in known:
            hint = f"; its elements are [1] to [{len(known)}]"
        value = known.get(step)
        if value is None:
            break
    if isinstance(value, tuple) and value and isinstance(value[0], float):
        hint = f"; it has {len(value)} of them, the first of which is '{name}[1]'"
    if not isinstance(value, float):
        raise ValueError(f"uncertain.change names '{name}', which must be a number with a "
                         f"fraction that the study states{hint}")


def shifted(study: Study, uncertain: Uncertain, amount: float) -> Study:
    """Return a study in which an uncertain amplitude is larger by an amount.

    Raises
    ------
    StudyError
        If the result is no valid study.
    """
    found: Study = _with_changes(study.with_(uncertain=()), {
        tuple(_steps(name)): amount * change for name, change in uncertain.change.items()})
    return found


def number_changes(one: Any, other: Any, name: str = "") -> dict[str, float]:
    """Return by how much the numbers of two studies differ, by their names.

    Raises
    ------
    ValueError
        If they differ in something that is no number with a fraction.

    Examples
    --------
    >>> number_changes([1.0, {"b": 2.0}], [1.0, {"b": 2.5}])
    {'[2].b': 0.5}
    """
    if one is other or one == other:
        return {}
    both = list(_parts(one)), list(_parts(other))
    if [key for key, _ in both[0]] == [key for key, _ in both[1]] and both[0]:
        found: dict[str, float] = {}
        for (key, first), (_, second) in zip(*both, strict=True):
            inner = f"{name}[{key}]" if isinstance(key, int) else f"{name}.{key}".lstrip(".")
            found |= number_changes(first, second, inner)
        return found
    if isinstance(one, float) and isinstance(other, float):
        return {name: other - one}
    raise ValueError(f"{name} differs, and is no number")


def _parts(value: Any) -> Iterator[tuple[str | int, Any]]:
    """Yield the keys of a table, or the numbers of a list from 1, with what is there."""
    if isinstance(value, BaseModel):
        yield from ((key, getattr(value, key)) for key in type(value).model_fields)
    elif isinstance(value, dict):
        yield from value.items()
    elif isinstance(value, list | tuple):
        yield from enumerate(value, start=1)


def _steps(name: str) -> Iterator[str | int]:
    """Yield the keys and numbers of elements of which a name consists."""
    for key, number in re.findall(r"([^.\[\]]+)|\[(\d+)\]", name):
        if key:
            yield key
        else:
            yield int(number)


def _with_changes(value: Any, changes: Mapping[tuple[str | int, ...], float]) -> Any:
    """Return a value with some of its numbers changed, by the steps to them.

    Numbers that depend on each other are changed together.
    """
    if () in changes:
        return value + changes[()]
    parts = dict(_parts(value))
    for first in {steps[0] for steps in changes}:
        parts[first] = _with_changes(parts[first], {
            steps[1:]: change for steps, change in changes.items() if steps[0] == first})
    if isinstance(value, StudyModel):
        return value.with_(**{str(key): part for key, part in parts.items()
                              if part is not getattr(value, str(key))})
    return parts if isinstance(value, dict) else type(value)(parts.values())
