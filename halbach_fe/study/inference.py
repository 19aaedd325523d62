"""Keys of a study that describe the inference: prior, held-out readings, measurement plan."""

from __future__ import annotations

from typing import Annotated, Any, Union

from pydantic import BeforeValidator, Field, model_validator

from halbach_fe.study.measurement import Positions
from halbach_fe.study.types import (
    COMPONENTS,
    MAX_POINTS,
    Component,
    Coordinate,
    Gap,
    Length,
    Line,
    ReferenceTemperature,
    RemanenceCoefficient,
    StudyModel,
)


class Prior(StudyModel):
    """Prior standard deviations of the blocks' magnetizations about their nominal values.

    ``magnitude_sd`` and ``common_mode_sd`` are fractions of the nominal magnetization. The
    deviation of ``magnitude_sd`` is independent from block to block; that of ``common_mode_sd`` is
    shared by all blocks (an error of the data sheet, or of the Helmholtz coil's calibration).
    ``direction_sd_deg`` is the standard deviation of the angle of the magnetization, in each of the
    two directions perpendicular to the easy axis.

    With ``variation_sd`` the magnetization along the easy axis varies inside the blocks: its
    deviation, a fraction of the nominal magnetization, has this standard deviation at every place,
    and those of two places of a block at the distance d have the correlation
    ``exp(-d^2 / (2 variation_length_m^2))``. In 3D and without iron only.

    The other keys concern a block table, the measured moments of the single blocks (see
    `halbach_fe.measurement.block_table`). With a block table, the measured moments replace
    ``magnitude_sd`` and ``direction_sd_deg``; ``common_mode_sd`` still applies.
    ``mounting_sd_deg`` is the standard deviation of the rotation of a mounted block about each
    axis. ``types`` lists the slots of every block type; by default every slot is a type of its own,
    labelled by its number. With ``temperature_coefficient_per_K`` and ``reference_temperature_C``,
    moments are corrected to the reference temperature by
    ``m(T) = m(T_ref) (1 + coefficient (T - T_ref))``.
    """

    magnitude_sd: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.01
    direction_sd_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 1.0
    common_mode_sd: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    variation_sd: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    variation_length_m: Length | None = None
    mounting_sd_deg: Annotated[float, Field(ge=0.0, lt=90.0)] = 0.0
    types: dict[Line, Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]] = {}  # noqa: RUF012
    temperature_coefficient_per_K: RemanenceCoefficient | None = None
    reference_temperature_C: ReferenceTemperature | None = None

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

    ``points`` is the number of positions to choose (default: as many as ``observation`` has),
    ``candidates`` the positions to choose from (default: those of ``observation``).
    """

    points: Annotated[int, Field(ge=1, le=100_000)] | None = None
    candidates: tuple[Positions, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Plan:
        total = sum(one.size for one in self.candidates)
        if total > MAX_POINTS:
            raise ValueError(f"candidates may have {MAX_POINTS} points together, not {total}")
        return self
