"""Keys of a study that describe the measurement: positions, instrument and its priors, noise."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from halbach_fe.study.types import (
    COMPONENTS,
    MAX_POINTS,
    Axes,
    Component,
    Coordinate,
    Displacement,
    FluxDensityVector,
    Fraction,
    Fractions,
    GridCount,
    Length,
    Line,
    Offset,
    Point,
    PositionSd,
    RadiusScale,
    RotationVector,
    Sigma,
    StudyModel,
    Unit,
    one_or_list,
)


class Instrument(StudyModel):
    """Known errors and conventions of the field mapper, which are corrected before a map is used.

    Units and axes. Coordinates in the map are multiples of ``length_unit_m``, and B and its sigma
    multiples of ``flux_density_unit_T`` (0.001 and 0.001 for mm and mT). The map's columns x, y, z
    are coordinates along ``position_axes`` of the magnet, its columns Bx, By, Bz components along
    ``field_axes``: with ``field_axes = ["y", "-x", "z"]`` the column Bx holds the magnet's By, and
    the column By holds its -Bx.

    Positions. Where the map says r, the sensor of component i was at
    ``T(s(r) + sensor_position_m[i])``. The map s multiplies the distance from the axis by
    ``1 + radius_scale`` and adds ``radius_offset_m`` to it (along x for points on the axis). For
    points off the axis at the angle phi it also adds
    ``eccentricity_m[0] cos phi + eccentricity_m[1] sin phi`` to the distance. It multiplies z by
    ``1 + z_scale`` and lowers y by the sag of the arm, which grows with the square of the distance
    from the map's smallest z and is ``arm_sag_m`` at its largest z. It displaces every point by
    ``lag_m`` against the step from the row before, but for the first of a line or circle: rows are
    in the order of the scan. T rotates by the rotation vector ``rotation_rad`` about the origin,
    then translates by ``translation_m``.

    Readings. With B' the components of B along the rotated axes, the reading of component i is
    ``(1 + gain_i) B'_i + sum_j crosstalk_ij B'_j + planar_hall_i B'_j B'_k + quadratic_i B'_i^2
    + cubic_i B'_i^3 + offset_i + drift_i t + gain_drift t B'_i``, where j and k are the two other
    components and t runs from 0 to 1 over the map (by its column time_s, or by the order of its
    rows); ``gain_drift`` is that of a magnet, or of all sensors, that get warmer. The key ``zx`` of
    ``crosstalk`` is the sensitivity of the z sensor to B'_x. A slow instrument shows
    ``(1 - memory) r_i + memory m_i`` in place of the reading r_i of a row, with m the mean of the
    readings before, in the order of the scan: of the last one, or of all with weights that fall by
    a factor e within ``memory_rows`` rows. The reading of a map of |B| is
    ``(1 + gain) |B| + quadratic |B|^2 + cubic |B|^3 + offset + drift t + gain_drift t |B|``:
    the three entries of these keys are equal, those of ``sensor_position_m`` too; besides,
    ``memory`` alone changes it.
    """

    length_unit_m: Unit = 1.0
    flux_density_unit_T: Unit = 1.0
    position_axes: Axes = ("x", "y", "z")
    field_axes: Axes = ("x", "y", "z")
    translation_m: Point = (0.0, 0.0, 0.0)
    rotation_rad: RotationVector = (0.0, 0.0, 0.0)
    z_scale: Fraction = 0.0
    radius_scale: RadiusScale = 0.0
    radius_offset_m: Offset = 0.0
    eccentricity_m: tuple[Offset, Offset] = (0.0, 0.0)
    arm_sag_m: Offset = 0.0
    lag_m: Offset = 0.0
    sensor_position_m: tuple[Displacement, Displacement, Displacement] = (
        (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    gain: Fractions = (0.0, 0.0, 0.0)
    crosstalk: dict[Literal["xy", "xz", "yx", "yz", "zx", "zy"], Fraction] = {}  # noqa: RUF012
    planar_hall_per_T: Fractions = (0.0, 0.0, 0.0)
    quadratic_per_T: Fractions = (0.0, 0.0, 0.0)
    cubic_per_T2: Fractions = (0.0, 0.0, 0.0)
    offset_T: FluxDensityVector = (0.0, 0.0, 0.0)
    drift_T: FluxDensityVector = (0.0, 0.0, 0.0)
    gain_drift: Fraction = 0.0
    memory: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    memory_rows: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> Instrument:
        for name in ("position_axes", "field_axes"):
            axes = getattr(self, name)
            if {axis[-1] for axis in axes} != set(COMPONENTS):
                raise ValueError(f"{name} must name x, y and z once each, but is {list(axes)}")
        return self


SmallSd = Annotated[float, Field(ge=0.0, le=0.1, allow_inf_nan=False)]

PROBE_KEYS = ("crosstalk", "gain", "sensor_position_m", "planar_hall_per_T", "quadratic_per_T",
              "cubic_per_T2")
"""Keys of an instrument that belong to its probe, and may be shared by several maps. All others
belong to a map: its pose and its stage, and the offsets, which change from day to day."""

POSE_KEYS = ("translation_m", "rotation_rad")
"""Keys of an instrument that say how a map lies in the magnet."""


class InstrumentSd(StudyModel):
    """Prior standard deviations of the terms of the instrument that are estimated with the blocks.

    A term of which 0 is stated (the default) is exactly what ``instrument`` says. The others are
    parameters of the update, like the magnetizations, and widen the error bars of these.
    ``translation_m`` is the standard deviation of the place of the map's middle along each axis of
    the magnet, ``rotation_rad`` that of the turn of the map about each axis through its middle. The
    others are those of each component of the instrument's keys of the same name. State what was
    known without the map, so that the same readings are not counted twice. `halbach-fe register`
    writes this table: of the pose that it found, at least ten of its error bars.
    """

    translation_m: PositionSd = 0.0
    rotation_rad: SmallSd = 0.0
    crosstalk: SmallSd = 0.0
    gain: SmallSd = 0.0
    offset_T: SmallSd = 0.0
    sensor_position_m: PositionSd = 0.0
    drift_T: SmallSd = 0.0


class LinePositions(StudyModel):
    """``count`` equally spaced points from ``start_m`` to ``end_m``, both included."""

    kind: Literal["line"]
    start_m: Point
    end_m: Point
    count: Annotated[int, Field(ge=1, le=MAX_POINTS)]

    @property
    def size(self) -> int:
        """Number of points."""
        return self.count


class CirclePositions(StudyModel):
    """Circles about the z axis, with ``angles`` equally spaced points each.

    There is one circle for each radius in ``radius_m`` (a value or a list) at each of ``count``
    positions z, equally spaced from ``z_min_m`` to ``z_max_m``, both included.
    """

    kind: Literal["circles"]
    radius_m: Annotated[tuple[Length, ...], Field(min_length=1), one_or_list(Length)]
    angles: Annotated[int, Field(ge=1, le=10_000)]
    z_min_m: Coordinate = 0.0
    z_max_m: Coordinate = 0.0
    count: Annotated[int, Field(ge=1, le=100_000)] = 1

    @model_validator(mode="after")
    def _consistent(self) -> CirclePositions:
        if self.z_max_m < self.z_min_m or (self.count > 1) != (self.z_max_m > self.z_min_m):
            raise ValueError(
                f"{self.count} circles between z_min_m = {self.z_min_m} and "
                f"z_max_m = {self.z_max_m} make no sense; one circle needs equal limits, "
                "several need z_min_m < z_max_m"
            )
        if len(set(self.radius_m)) < len(self.radius_m):
            raise ValueError(f"radius_m must name each radius once, but is {self.radius_m}")
        if self.size > MAX_POINTS:
            raise ValueError(f"circles may have {MAX_POINTS} points together, not {self.size}")
        return self

    @property
    def size(self) -> int:
        """Number of points."""
        return len(self.radius_m) * self.angles * self.count


class GridPositions(StudyModel):
    """A regular grid with ``count`` points along x, y and z, from ``start_m`` to ``end_m``.

    Both limits are included; an axis with a single point needs equal limits. In the order of the
    points z changes fastest, x slowest.
    """

    kind: Literal["grid"]
    start_m: Point
    end_m: Point
    count: tuple[GridCount, GridCount, GridCount]

    @model_validator(mode="after")
    def _consistent(self) -> GridPositions:
        for axis, start, end, count in zip(COMPONENTS, self.start_m, self.end_m, self.count,
                                           strict=True):
            if end < start or (count > 1) != (end > start):
                raise ValueError(
                    f"{count} points from {axis} = {start} to {end} make no sense; one point "
                    "needs equal limits, several need start_m < end_m")
        if self.size > MAX_POINTS:
            raise ValueError(f"a grid may have {MAX_POINTS} points, not {self.size}")
        return self

    @property
    def size(self) -> int:
        """Number of points."""
        return math.prod(self.count)


class PointPositions(StudyModel):
    """A list of points."""

    kind: Literal["points"]
    points_m: Annotated[tuple[Point, ...], Field(min_length=1, max_length=MAX_POINTS)]

    @property
    def size(self) -> int:
        """Number of points."""
        return len(self.points_m)


Positions = Annotated[
    LinePositions | CirclePositions | GridPositions | PointPositions, Field(discriminator="kind")
]


class FluxDensity(StudyModel):
    """Observe components of B at points, in tesla."""

    quantity: Literal["flux_density"]
    components: Annotated[tuple[Component, ...], Field(min_length=1)] = COMPONENTS
    positions: Positions


class FourierCoefficients(StudyModel):
    """Observe the Fourier coefficients of the radial flux density on circles, in tesla.

    They are A_1..A_K and B_1..B_K of ``B_r = sum_k A_k cos(k phi) + B_k sin(k phi)``, with K given
    by ``harmonics``.
    """

    quantity: Literal["fourier_coefficients"]
    harmonics: Annotated[int, Field(ge=1, le=1000)]
    positions: CirclePositions

    @model_validator(mode="after")
    def _resolved(self) -> FourierCoefficients:
        if self.positions.angles <= 2 * self.harmonics:
            raise ValueError(
                f"{self.harmonics} harmonics need more than {2 * self.harmonics} angles on the "
                f"circle, not {self.positions.angles}"
            )
        return self


ObservationSettings = Annotated[FluxDensity | FourierCoefficients, Field(discriminator="quantity")]


class NoiseRegion(StudyModel):
    """A region in z whose readings have the same standard deviation ``sigma_T``.

    A reading belongs to the first region that contains its z and lists its component. A limit that
    is left out does not restrict the region. Reports combine regions that have the same name.
    """

    name: Annotated[Line, Field(min_length=1, max_length=100)]
    z_min_m: Coordinate | None = None
    z_max_m: Coordinate | None = None
    components: Annotated[tuple[Component, ...], Field(min_length=1)] = COMPONENTS
    sigma_T: Sigma

    @model_validator(mode="after")
    def _consistent(self) -> NoiseRegion:
        if self.z_min_m is not None and self.z_max_m is not None and self.z_min_m >= self.z_max_m:
            raise ValueError(f"z_min_m ({self.z_min_m}) must be below z_max_m ({self.z_max_m})")
        return self

    def holds(self, other: NoiseRegion) -> bool:
        """Return whether all readings of another region lie in this one."""
        (low, high), (least, most) = (
            (-math.inf if one.z_min_m is None else one.z_min_m,
             math.inf if one.z_max_m is None else one.z_max_m) for one in (self, other))
        return low <= least and most <= high and {*other.components} <= {*self.components}


class NoiseSettings(StudyModel):
    """Standard deviation of the readings, and of their positions.

    ``regions`` give the standard deviation of a reading; a map with a sigma of its own replaces
    them. ``position_sd_m`` is the standard deviation of every point's position along x, y and z of
    the stage, which are columns of a file as ``instrument.position_axes`` names them (a single
    value holds for all three). The position uncertainty adds to the noise of
    both: it changes the readings of a point by the local gradient of the field, all components of
    the point together, which is much in the fringe field and little in the homogeneous field.
    """

    regions: tuple[NoiseRegion, ...] = ()
    position_sd_m: Annotated[tuple[PositionSd, ...], one_or_list(PositionSd)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> NoiseSettings:
        if not self.regions and self.position_sd_m is None:
            raise ValueError("give regions, position_sd_m, or both")
        for number, region in enumerate(self.regions):
            if before := next((one for one in self.regions[:number] if one.holds(region)), None):
                raise ValueError(
                    f"the first region that holds a reading counts, and '{before.name}', which "
                    f"comes first, holds all of '{region.name}'; put the narrower one first, or "
                    "leave one out")
        if self.position_sd_m is not None and len(self.position_sd_m) not in (1, 3):
            raise ValueError(f"position_sd_m must be one value or three, for x, y and z, not "
                             f"{len(self.position_sd_m)}")
        return self
