"""Keys of a study that describe the inference: prior, held-out readings, the plan."""

from __future__ import annotations

from typing import Annotated, Any, Union

from pydantic import (
    BeforeValidator,
    Field,
    model_validator,
)

from halbach_fe.study.measurement import Positions
from halbach_fe.study.types import (
    COMPONENTS,
    Component,
    Coordinate,
    Gap,
    Line,
    StudyModel,
    Temperature,
)


class Prior(StudyModel):
    """What is known of the blocks before the map: sd about the nominal magnetization.

    ``magnitude_sd`` and ``common_mode_sd`` are fractions of the nominal magnetization: the first
    is independent from block to block, the second shared by all (the calibration of the
    Helmholtz coil, or a nominal value that is off). ``direction_sd_deg`` holds for each of the
    two directions across the easy axis.

    Where the blocks themselves were measured (`halbach_fe.measurement.block_table`), their moments
    take the place of ``magnitude_sd`` and ``direction_sd_deg``, and the rest holds:
    ``mounting_sd_deg`` is how far each block may be turned about each axis when it is mounted.
    ``types`` are the slots of each type of block (default: each slot is a type, its number the
    label). Moments m are taken to the reference temperature by ``m(T) = m(T_ref) (1 + coefficient
    (T - T_ref))``, if both are given.
    """

    magnitude_sd: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.01
    direction_sd_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 1.0
    common_mode_sd: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    mounting_sd_deg: Annotated[float, Field(ge=0.0, lt=90.0)] = 0.0
    types: dict[Line, Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]] = {}  # noqa: RUF012
    temperature_coefficient_per_K: Annotated[float, Field(ge=-0.01, le=0.01)] | None = None
    reference_temperature_C: Temperature | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Prior:
        if (self.temperature_coefficient_per_K is None) != (self.reference_temperature_C is None):
            raise ValueError("give temperature_coefficient_per_K and reference_temperature_C "
                             "together, or neither")
        return self


class HeldOut(StudyModel):
    """Which readings are kept from the update and only predicted: all that any key names.

    Readings are grouped in runs of ``window`` consecutive z positions; the last of every
    ``every`` runs is held out (without any key: of every 2). ``radii_m`` are distances from the
    axis, ``z_ranges_m`` pairs of limits.
    """

    every: Annotated[int, Field(ge=2, le=1000)] | None = None
    window: Annotated[int, Field(ge=1, le=100_000)] = 1
    radii_m: tuple[Gap, ...] = ()
    components: tuple[Component, ...] = ()
    z_ranges_m: tuple[tuple[Coordinate, Coordinate], ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _windows(cls, given: Any) -> Any:
        alone = isinstance(given, dict) and not given.keys() - {"window"}
        return given | {"every": 2} if alone else given

    @model_validator(mode="after")
    def _consistent(self) -> HeldOut:
        if self.every is None and self.window > 1:
            raise ValueError("window needs every: the last of how many windows is held out?")
        for low, high in self.z_ranges_m:
            if low > high:
                raise ValueError(f"z_ranges_m must be pairs of a lower and an upper limit, not "
                                 f"[{low}, {high}]")
        return self


class ExcludedReading(StudyModel):
    """Components, or all, of a row of the map, from 1; its number alone stands for all."""

    row: Annotated[int, Field(ge=1)]
    components: Annotated[tuple[Component, ...], Field(min_length=1)] = COMPONENTS


def _row_or_table(value: Any) -> Any:
    return {"row": value} if isinstance(value, int) else value


class Inference(StudyModel):
    """How the update is done and judged.

    ``excluded_readings`` are neither used nor predicted, as outliers should be. Their components
    are those of the magnet's axes.
    """

    held_out: HeldOut | None = None
    excluded_readings: tuple[
        Annotated[ExcludedReading, BeforeValidator(
            _row_or_table, json_schema_input_type=Union[int, ExcludedReading])], ...] = ()  # noqa: UP007


class Plan(StudyModel):
    """What `halbach-fe plan` chooses from (default: the observation's positions), and how many
    points (default: as many as the observation has).
    """

    points: Annotated[int, Field(ge=1, le=100_000)] | None = None
    candidates: tuple[Positions, ...] = ()
