"""The study file: one TOML document that says everything about a magnet and its measurement.

Keys carry their unit (``inner_radius_m``, ``sigma_T``). Unknown keys are errors. The models are
frozen: a study is a value, and everything downstream is a function of it.

The convention for magnetization, used everywhere in halbach-fe, is that of
``nu(|B|) B = H + M``. In a block of recoil permeability mu_r therefore
``M = B_r / (mu_0 mu_r)``, with B_r the remanence: M is neither ``B_r / mu_0`` nor the
magnetization at the working point.
"""

from __future__ import annotations

import difflib
import math
import tomllib
import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from halbach_fe import materials
from halbach_fe.errors import StudyError, must_be
from halbach_fe.materials import MU_0 as MU_0
from halbach_fe.materials import Curve

MAX_LENGTH_M = 10.0
MIN_LENGTH_M = 1e-4
MAX_POINTS = 1_000_000
MAX_EXPLAINED = 1e9  # by a wrong unit

# The limits exist to catch a wrong unit (mm for m, mT for T), not to say what is sensible.
Length = Annotated[float, Field(ge=MIN_LENGTH_M, le=MAX_LENGTH_M, allow_inf_nan=False)]
Gap = Annotated[float, Field(ge=0.0, le=MAX_LENGTH_M, allow_inf_nan=False)]
Coordinate = Annotated[
    float, Field(ge=-10 * MAX_LENGTH_M, le=10 * MAX_LENGTH_M, allow_inf_nan=False)]
Remanence = Annotated[float, Field(gt=0.0, le=2.0, allow_inf_nan=False)]
RecoilPermeability = Annotated[float, Field(ge=1.0, le=2.0)]
Angle = Annotated[float, Field(ge=-720.0, le=720.0, allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Offset = Annotated[float, Field(ge=-0.1, le=0.1, allow_inf_nan=False)]
Displacement = tuple[Offset, Offset, Offset]
Rotation = tuple[Angle, Angle, Angle]
Moment = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=-0.5, le=0.5, allow_inf_nan=False)]
Fractions = tuple[Fraction, Fraction, Fraction]
RadiusScale = Annotated[float, Field(ge=-0.9, le=2.0, allow_inf_nan=False)]
Unit = Annotated[float, Field(ge=1e-9, le=1e3, allow_inf_nan=False)]
SignedAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
Axes = tuple[SignedAxis, SignedAxis, SignedAxis]
FluxDensityOffset = Annotated[float, Field(ge=-1.0, le=1.0, allow_inf_nan=False)]
FluxDensityVector = tuple[FluxDensityOffset, FluxDensityOffset, FluxDensityOffset]
GridCount = Annotated[int, Field(ge=1, le=10_000)]
PositionSd = Annotated[float, Field(ge=0.0, le=0.01, allow_inf_nan=False)]
Temperature = Annotated[float, Field(ge=-273.15, le=500.0, allow_inf_nan=False)]
Component = Literal["x", "y", "z"]
COMPONENTS: tuple[Component, ...] = ("x", "y", "z")


def _one_or_list(kind: Any) -> BeforeValidator:
    """Let a single value stand for a list of one."""
    return BeforeValidator(lambda value: value if isinstance(value, list | tuple) else (value,),
                           json_schema_input_type=Union[kind, list[kind]])  # noqa: UP007


def _one_line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("control characters are not allowed here")
    return text


def _lines(text: str) -> str:
    for line in text.split("\n"):
        _one_line(line.replace("\t", " "))
    return text


Line = Annotated[str, AfterValidator(_one_line)]
"""Text that is shown on terminals, in pages, in tables."""
Lines = Annotated[str, AfterValidator(_lines)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SectorBlock(_Model):
    """A sector of an annulus; ``angular_gap_deg`` is the free angle between neighbours."""

    shape: Literal["sector"]
    angular_gap_deg: Annotated[float, Field(ge=0.0, lt=360.0)] = 0.0


class TrapezoidBlock(_Model):
    """A trapezoid with flat faces at the inner and the outer radius.

    ``side_gap_m`` is the clearance between the parallel side faces of neighbours.
    """

    shape: Literal["trapezoid"]
    side_gap_m: Gap = 0.0


class CuboidBlock(_Model):
    """A cuboid, radially from the inner to the outer radius of the array, ``width_m`` wide.

    ``orientation`` says what its faces follow: the block's ``position`` angle, or its
    ``magnetization`` angle, as is usual in arrays built from magnetized cubes.
    """

    shape: Literal["cuboid"]
    width_m: Length
    orientation: Literal["position", "magnetization"] = "position"


Block = Annotated[SectorBlock | TrapezoidBlock | CuboidBlock, Field(discriminator="shape")]


class BlockException(_Model):
    """What is different in the blocks of one ring, or one slot, or both, from the array's.

    ``magnetization_angle_deg`` turns the magnetization, never the shape. A recoil permeability
    alone is that in all directions. ``mounted_from`` is the ring and slot that the block was meant
    for: its magnetization comes with it, in its own axes.

    ``magnetization_factor`` is 0 for a block that is missing, -1 for one upside down.
    ``magnetization_gradient`` is by how much the magnetization of the outer half exceeds that of
    the inner one, as a fraction of their mean; ``inner_corner_loss`` the fraction that both corners
    of the bore have lost, over a sixth of the block's width and a sixth of its thickness.

    A block stands off its place by ``displacement_m`` along its own axes (radial, azimuthal,
    axial), turned by ``rotation_deg`` about them through its middle; ``shift_m`` is along x, y, z,
    and ``twist_deg`` turns it about the magnet's axis. Several exceptions of a block add up in
    these, and multiply in ``magnetization_factor``; of the other keys the last counts. Finite
    elements, which know the reaction of permeability and iron only, take blocks to be in their
    places, whole and uniform.
    """

    ring: Annotated[int, Field(ge=1)] | None = None
    slot: Annotated[int, Field(ge=1)] | None = None
    recoil_permeability: RecoilPermeability | None = None
    recoil_permeability_across: RecoilPermeability | None = None
    remanence_T: Remanence | None = None
    magnetization_angle_deg: Angle | None = None
    mounted_from: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    magnetization_factor: Annotated[float, Field(ge=-2.0, le=2.0)] = 1.0
    magnetization_gradient: Annotated[float, Field(ge=-1.0, le=1.0)] | None = None
    inner_corner_loss: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    displacement_m: Displacement = (0.0, 0.0, 0.0)
    rotation_deg: Rotation = (0.0, 0.0, 0.0)
    shift_m: Displacement = (0.0, 0.0, 0.0)
    twist_deg: Angle = 0.0


class Array(_Model):
    """The permanent-magnet array, in general: ``rings`` equal rings of ``blocks_per_ring`` blocks.

    Block ``i`` (from 1) sits at ``first_block_angle_deg + (i-1) 360/N``; its magnetization turns
    ``1 + multipole_order`` times faster (K. Halbach, Nucl. Instrum. Methods 169 (1980) 1), from
    ``first_magnetization_angle_deg``. Rings are numbered from 1 at the lowest z.
    ``recoil_permeability`` is relative and holds along the easy axis, and across it unless
    ``recoil_permeability_across`` says otherwise.
    """

    multipole_order: Annotated[int, Field(ge=1, le=20)] = 1
    blocks_per_ring: Annotated[int, Field(ge=4, le=512)]
    rings: Annotated[int, Field(ge=1, le=1000)] = 1
    inner_radius_m: Length
    outer_radius_m: Length
    ring_length_m: Length | None = None
    ring_gap_m: Gap = 0.0
    first_block_angle_deg: Angle = 0.0
    first_magnetization_angle_deg: Angle = 0.0
    recoil_permeability: RecoilPermeability = 1.0
    recoil_permeability_across: RecoilPermeability | None = None
    remanence_T: Remanence | None = None
    block_moment_A_m2: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    block: Block
    exceptions: tuple[BlockException, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Array:
        if self.outer_radius_m <= self.inner_radius_m:
            raise ValueError(
                f"outer_radius_m ({self.outer_radius_m}) must be larger than inner_radius_m "
                f"({self.inner_radius_m}); exchange or correct them"
            )
        if (self.remanence_T is None) == (self.block_moment_A_m2 is None):
            raise ValueError("give exactly one of remanence_T and block_moment_A_m2")
        if self.block_moment_A_m2 is not None and self.ring_length_m is None:
            raise ValueError("block_moment_A_m2 needs ring_length_m, to know the block's volume")
        for one in self.exceptions:
            if (one.ring or 1) > self.rings or (one.slot or 1) > self.blocks_per_ring:
                raise ValueError(
                    f"an exception names ring {one.ring}, slot {one.slot} of an array of "
                    f"{self.rings} rings of {self.blocks_per_ring} blocks")
            ring, slot = one.mounted_from or (1, 1)
            if ring > self.rings or slot > self.blocks_per_ring:
                raise ValueError(
                    f"an exception's block was meant for ring {ring}, slot {slot} of an array of "
                    f"{self.rings} rings of {self.blocks_per_ring} blocks")
        return self


class TableCurve(_Model):
    """H(B) as a table, in a CSV file (``H_A_per_m,B_T``, its path from the study's folder) or here.

    Read from a file, the study holds its numbers.
    """

    kind: Literal["table"]
    file: Annotated[Line, Field(min_length=1, max_length=4000)] | None = None
    H_A_per_m: tuple[float, ...] = ()
    B_T: tuple[float, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> TableCurve:
        if self.file is None:
            if not (self.H_A_per_m or self.B_T):
                raise ValueError("give a file, or H_A_per_m and B_T")
            materials.table_curve(np.array(self.H_A_per_m), np.array(self.B_T))
        elif self.H_A_per_m or self.B_T:
            raise ValueError("give either a file, or H_A_per_m and B_T, not both")
        return self


class SteelCurve(_Model):
    """A curve that comes with halbach-fe, by name."""

    kind: Literal["steel"]
    name: str

    @model_validator(mode="after")
    def _known(self) -> SteelCurve:
        if self.name not in materials.steels():
            raise ValueError(f"no steel is called '{self.name}'; there are "
                             f"{', '.join(materials.steels())}")
        return self


class FroehlichKennellyCurve(_Model):
    """B = mu_0 H + J_s H / (H + h), h following from the initial permeability."""

    kind: Literal["froehlich_kennelly"]
    initial_relative_permeability: Annotated[float, Field(ge=2.0, le=1e6)]
    saturation_polarization_T: Annotated[float, Field(ge=0.01, le=materials.MAX_POLARIZATION)]

    @model_validator(mode="after")
    def _possible(self) -> FroehlichKennellyCurve:
        materials.froehlich_kennelly(self.initial_relative_permeability,
                                     self.saturation_polarization_T)
        return self


class BrauerCurve(_Model):
    """H = (k1 exp(k2 B^2) + k3) B, as far as its slope stays below that of vacuum."""

    kind: Literal["brauer"]
    k1_m_per_H: Annotated[float, Field(gt=0.0, le=1e6)]
    k2_per_T2: Annotated[float, Field(gt=0.0, le=100.0)]
    k3_m_per_H: Annotated[float, Field(ge=0.0, le=1e6)]

    @model_validator(mode="after")
    def _possible(self) -> BrauerCurve:
        materials.brauer(self.k1_m_per_H, self.k2_per_T2, self.k3_m_per_H)
        return self


IronCurve = Annotated[TableCurve | SteelCurve | FroehlichKennellyCurve | BrauerCurve,
                      Field(discriminator="kind")]


class IronRing(_Model):
    """A coaxial iron tube outside the array, of constant permeability or with an H(B) curve."""

    inner_radius_m: Length
    outer_radius_m: Length
    length_m: Length | None = None
    relative_permeability: Annotated[float, Field(ge=1.0, le=1e6)] | None = None
    curve: IronCurve | None = None

    @model_validator(mode="after")
    def _consistent(self) -> IronRing:
        if self.outer_radius_m <= self.inner_radius_m:
            raise ValueError(
                f"outer_radius_m ({self.outer_radius_m}) must be larger than inner_radius_m "
                f"({self.inner_radius_m})"
            )
        if (self.relative_permeability is None) == (self.curve is None):
            raise ValueError("give exactly one of relative_permeability and curve")
        return self


class Neighbour(_Model):
    """Another magnet like this one, in vacuum: its middle on the axis at ``z_m``, turned about the
    axis, and stronger or weaker by ``factor``.
    """

    z_m: Coordinate
    turn_deg: Angle = 0.0
    factor: Annotated[float, Field(ge=-10.0, le=10.0)] = 1.0


class PointDipole(_Model):
    """A magnetized object, as a point."""

    position_m: Point
    moment_A_m2: tuple[Moment, Moment, Moment]


class External(_Model):
    """Fields that are not the magnet's, added to it: they magnetize no iron."""

    background_T: FluxDensityVector = (0.0, 0.0, 0.0)
    neighbours: tuple[Neighbour, ...] = ()
    dipoles: tuple[PointDipole, ...] = ()


class Instrument(_Model):
    """How the mapper's readings differ from B where it says it was; taken out of the map before
    anything else is done with it.

    First what is written in the map is put right. Its coordinates and its sigma and B count in
    ``length_unit_m`` and ``flux_density_unit_T`` (0.001 if they are in mm and mT). Its columns x,
    y, z are along ``position_axes`` of the magnet, and Bx, By, Bz along ``field_axes``: with
    ``field_axes = ["y", "-x", "z"]`` the column of Bx holds By, and that of By -Bx.

    The probe was at ``r' = T(s(r))`` where the map says r: s stretches the distance from the axis
    by ``1 + radius_scale``, adds ``radius_offset_m`` to it (on the axis along x), and off the axis
    at the angle phi ``eccentricity_m[0] cos phi + eccentricity_m[1] sin phi``, stretches z by
    ``1 + z_scale`` and lets the arm sag towards -y, by ``arm_sag_m`` at the far end (largest z of
    the map), with the square of the distance from the near one; T turns by ``rotation_rad`` (a
    rotation vector) about the origin and moves by ``translation_m``.
    The sensor of component i is ``sensor_position_m[i]`` from there. With B' the field in the
    turned axes, the reading of component i is
    ``(1 + gain_i) B'_i + sum_j crosstalk_ij B'_j + planar_hall_i B'_j B'_k + quadratic_i B'_i^2
    + cubic_i B'_i^3 + offset_i + drift_i t``, j and k being the other two, and t running from 0 to
    1 over the map (its time_s, or its order). ``crosstalk`` is by name: ``zx`` is what the z sensor
    sees of x.
    """

    length_unit_m: Unit = 1.0
    flux_density_unit_T: Unit = 1.0
    position_axes: Axes = ("x", "y", "z")
    field_axes: Axes = ("x", "y", "z")
    translation_m: Displacement = (0.0, 0.0, 0.0)
    rotation_rad: Fractions = (0.0, 0.0, 0.0)
    z_scale: Fraction = 0.0
    radius_scale: RadiusScale = 0.0
    radius_offset_m: Offset = 0.0
    eccentricity_m: tuple[Offset, Offset] = (0.0, 0.0)
    arm_sag_m: Offset = 0.0
    sensor_position_m: tuple[Displacement, Displacement, Displacement] = (
        (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    gain: Fractions = (0.0, 0.0, 0.0)
    crosstalk: dict[Literal["xy", "xz", "yx", "yz", "zx", "zy"], Fraction] = {}
    planar_hall_per_T: Fractions = (0.0, 0.0, 0.0)
    quadratic_per_T: Fractions = (0.0, 0.0, 0.0)
    cubic_per_T2: Fractions = (0.0, 0.0, 0.0)
    offset_T: FluxDensityVector = (0.0, 0.0, 0.0)
    drift_T: FluxDensityVector = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _consistent(self) -> Instrument:
        for name in ("position_axes", "field_axes"):
            axes = getattr(self, name)
            if {axis[-1] for axis in axes} != set(COMPONENTS):
                raise ValueError(f"{name} must name x, y and z once each, but is {list(axes)}")
        return self


class Mesh(_Model):
    """Element sizes. In 3D the cross-section is extruded in layers along z.

    ``meridian_size_m`` is that of the (r, z) half-plane, for rotationally symmetric materials
    (default: a twelfth of the blocks' radial thickness).
    """

    block_size_m: Length
    bore_size_m: Length | None = None
    layers_per_ring: Annotated[int, Field(ge=1, le=100)] = 2
    meridian_size_m: Length | None = None
    growth: Annotated[float, Field(gt=1.0, le=4.0)] = 1.4


class OpenBoundary(_Model):
    """Where the field is cut off. Elements grow geometrically towards it, so far is cheap."""

    radius_m: Annotated[float, Field(ge=MIN_LENGTH_M, le=100 * MAX_LENGTH_M)] | None = None
    half_length_m: Annotated[float, Field(ge=MIN_LENGTH_M, le=100 * MAX_LENGTH_M)] | None = None


class LinePositions(_Model):
    """``count`` equally spaced points from ``start_m`` to ``end_m``, both included."""

    kind: Literal["line"]
    start_m: Point
    end_m: Point
    count: Annotated[int, Field(ge=1, le=MAX_POINTS)]


class CirclePositions(_Model):
    """Circles about the z axis: ``angles`` points each, at ``count`` positions along z, of one
    radius or of each of several.
    """

    kind: Literal["circles"]
    radius_m: Annotated[tuple[Length, ...], Field(min_length=1), _one_or_list(Length)]
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
        return self


class GridPositions(_Model):
    """A regular grid of ``count`` points along x, y and z, from ``start_m`` to ``end_m``, both
    included; one point along an axis needs equal limits. z changes fastest, x slowest.
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
        if math.prod(self.count) > MAX_POINTS:
            raise ValueError(f"a grid may have {MAX_POINTS} points, not {math.prod(self.count)}")
        return self


class PointPositions(_Model):
    """A list of points."""

    kind: Literal["points"]
    points_m: Annotated[tuple[Point, ...], Field(min_length=1)]


Positions = Annotated[
    LinePositions | CirclePositions | GridPositions | PointPositions, Field(discriminator="kind")
]


class FluxDensity(_Model):
    """Observe components of B at points, in tesla."""

    quantity: Literal["flux_density"]
    components: Annotated[tuple[Component, ...], Field(min_length=1)] = COMPONENTS
    positions: Positions


class FourierCoefficients(_Model):
    """Observe A_1..A_K, B_1..B_K of B_r on circles: B_r = sum A_k cos(k phi) + B_k sin(k phi)."""

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


Observation = Annotated[FluxDensity | FourierCoefficients, Field(discriminator="quantity")]


class NoiseRegion(_Model):
    """A z window with one standard deviation per reading, of all components or of some.

    The first region that fits a reading is used. A limit that is left out is none. Regions of one
    name are one region in reports.
    """

    name: Annotated[Line, Field(min_length=1, max_length=100)]
    z_min_m: Coordinate | None = None
    z_max_m: Coordinate | None = None
    components: Annotated[tuple[Component, ...], Field(min_length=1)] = COMPONENTS
    sigma_T: Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)]

    @model_validator(mode="after")
    def _consistent(self) -> NoiseRegion:
        if self.z_min_m is not None and self.z_max_m is not None and self.z_min_m >= self.z_max_m:
            raise ValueError(f"z_min_m ({self.z_min_m}) must be below z_max_m ({self.z_max_m})")
        return self


class Noise(_Model):
    """Measurement noise by region, which a map that carries its own sigma overrides, and what the
    positions add to either.

    ``position_sd_m`` is how far each point may be from where the map has it, along x, y and z
    (one value: the same along each). It moves a reading by the local gradient of the nominal
    field, all components of a point together: much in the fringe, little in the homogeneous field.
    """

    regions: tuple[NoiseRegion, ...] = ()
    position_sd_m: Annotated[tuple[PositionSd, ...], _one_or_list(PositionSd)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Noise:
        if not self.regions and self.position_sd_m is None:
            raise ValueError("give regions, position_sd_m, or both")
        if self.position_sd_m is not None and len(self.position_sd_m) not in (1, 3):
            raise ValueError(f"position_sd_m must be one value or three, for x, y and z, not "
                             f"{len(self.position_sd_m)}")
        return self


class Prior(_Model):
    """What is known of the blocks before the map: sd about the nominal magnetization.

    ``magnitude_sd`` and ``common_mode_sd`` are fractions of the nominal magnetization: the first
    is independent from block to block, the second shared by all (the calibration of the
    Helmholtz coil, or a nominal value that is off). ``direction_sd_deg`` holds for each of the
    two directions across the easy axis.

    Where the blocks themselves were measured (`halbach_fe.block_table`), their moments take the
    place of ``magnitude_sd`` and ``direction_sd_deg``, and the rest holds: ``mounting_sd_deg`` is
    how far each block may be turned about each axis when it is mounted. ``types`` are the slots of
    each type of block (default: each slot is a type, its number the label). Moments m are taken to
    the reference temperature by ``m(T) = m(T_ref) (1 + coefficient (T - T_ref))``, if both are
    given.
    """

    magnitude_sd: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.01
    direction_sd_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 1.0
    common_mode_sd: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    mounting_sd_deg: Annotated[float, Field(ge=0.0, lt=90.0)] = 0.0
    types: dict[Line, Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]] = {}
    temperature_coefficient_per_K: Annotated[float, Field(ge=-0.01, le=0.01)] | None = None
    reference_temperature_C: Temperature | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Prior:
        if (self.temperature_coefficient_per_K is None) != (self.reference_temperature_C is None):
            raise ValueError("give temperature_coefficient_per_K and reference_temperature_C "
                             "together, or neither")
        return self


class HeldOut(_Model):
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


class ExcludedReading(_Model):
    """Components, or all, of a row of the map, from 1; its number alone stands for all."""

    row: Annotated[int, Field(ge=1)]
    components: Annotated[tuple[Component, ...], Field(min_length=1)] = COMPONENTS


def _row_or_table(value: Any) -> Any:
    return {"row": value} if isinstance(value, int) else value


class Inference(_Model):
    """How the update is done and judged.

    ``excluded_readings`` are neither used nor predicted, as outliers should be. Their components
    are those of the magnet's axes.
    """

    held_out: HeldOut | None = None
    excluded_readings: tuple[
        Annotated[ExcludedReading, BeforeValidator(
            _row_or_table, json_schema_input_type=Union[int, ExcludedReading])], ...] = ()  # noqa: UP007


class Demagnetization(_Model):
    """What the magnet material withstands, by its data sheet at the reference temperature, and the
    hottest it gets.

    The knee is at ``squareness`` times the intrinsic coercivity: there the polarization has lost a
    tenth (H_k of IEC 60404-8-1). Remanence and intrinsic coercivity change linearly with
    temperature, by the fraction of a coefficient per kelvin.
    """

    intrinsic_coercivity_A_per_m: Annotated[float, Field(ge=1e4, le=1e7)]
    squareness: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    remanence_coefficient_per_K: Annotated[float, Field(ge=-0.01, le=0.01)]
    coercivity_coefficient_per_K: Annotated[float, Field(ge=-0.02, le=0.02)]
    reference_temperature_C: Temperature = 20.0
    temperature_C: Temperature = 20.0

    @model_validator(mode="after")
    def _consistent(self) -> Demagnetization:
        for name, coefficient in (("remanence", self.remanence_coefficient_per_K),
                                  ("coercivity", self.coercivity_coefficient_per_K)):
            if 1 + coefficient * (self.temperature_C - self.reference_temperature_C) <= 0:
                raise ValueError(f"{name}_coefficient_per_K ({coefficient}) leaves nothing of it "
                                 f"at {self.temperature_C:g} °C; use a fraction per kelvin, not "
                                 "per cent, and a temperature the linear law holds for")
        return self


class Plan(_Model):
    """What `halbach-fe plan` chooses from (default: the observation's positions), and how many
    points (default: as many as the observation has).
    """

    points: Annotated[int, Field(ge=1, le=100_000)] | None = None
    candidates: tuple[Positions, ...] = ()


class Solver(_Model):
    """``reaction``: exact field of the blocks plus the finite-element reaction of permeability
    and iron. ``direct``: the finite-element field as it is.

    ``route`` is how a 3D reaction is computed: ``azimuthal_modes``, one (r, z) problem per mode,
    for rotationally symmetric materials (sectors without gaps); ``edge_elements``, curl-curl in
    3D, for any geometry; ``scalar_potential``, its dual, of second order, for any geometry too.
    ``auto`` takes the first where it can, the scalar potential elsewhere, and edge elements for
    ``direct``. ``edge_order`` is the order of the edge elements. ``symmetry`` lets one block stand
    for those that turning and mirroring the magnet puts in its place.
    """

    method: Literal["reaction", "direct"] = "reaction"
    route: Literal["auto", "azimuthal_modes", "edge_elements", "scalar_potential"] = "auto"
    edge_order: Literal[1, 2] = 1
    symmetry: bool = True


FIELD_KEYS = {"dimension", "array", "iron_ring", "external", "mesh", "open_boundary", "solver"}
"""All that a solved field depends on."""


class Study(_Model):
    """A magnet, how it is discretized, how it is measured, and what is known beforehand."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    description: Lines = ""
    dimension: Literal[2, 3] = 3
    array: Array
    iron_ring: IronRing | None = None
    external: External = External()
    instrument: Instrument = Instrument()
    mesh: Mesh
    open_boundary: OpenBoundary = OpenBoundary()
    solver: Solver = Solver()
    observation: Observation
    noise: Noise | None = None
    prior: Prior = Prior()
    inference: Inference = Inference()
    plan: Plan = Plan()
    demagnetization: Demagnetization | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Study:
        if self.dimension == 3 and self.array.ring_length_m is None:
            raise ValueError("a 3D study needs array.ring_length_m")
        if self.dimension == 2 and self.array.rings != 1:
            raise ValueError("a 2D study is a cross-section: array.rings must be 1")
        held_out, regions = self.inference.held_out, self.noise.regions if self.noise else ()
        by_component = {
            "noise.regions": any(set(one.components) != set(COMPONENTS) for one in regions),
            "inference.held_out": bool(held_out and held_out.components)}
        for key, named in by_component.items():
            if named and self.observation.quantity == "fourier_coefficients":
                raise ValueError(f"{key} may name components of flux_density only; Fourier "
                                 "coefficients have none")
        slots = sorted(slot for one in self.prior.types.values() for slot in one)
        if self.prior.types and slots != list(range(1, self.array.blocks_per_ring + 1)):
            raise ValueError(f"prior.types must name every slot from 1 to "
                             f"{self.array.blocks_per_ring} once, but names {slots}")
        for name, size in self.mesh:
            if name.endswith("size_m") and size is not None and size > self.array.outer_radius_m:
                raise ValueError(f"mesh.{name} ({size}) must not be larger than the array "
                                 f"({self.array.outer_radius_m}); is it in millimetres?")
        return self


def read_study(path: str | Path) -> Study:
    """Read and validate a study file.

    Raises
    ------
    StudyError
        With one sentence that names the file, the key, what was expected and what to do.
    """
    path = Path(path)
    where = f"study file {path}"
    try:
        raw = path.read_bytes()
    except OSError as error:
        reason = error.strerror or str(error)
        raise StudyError(
            must_be("path", where, "a readable file", f"'{reason}'", "Check the path.")
        ) from None
    if not raw.strip():
        raise StudyError(
            must_be("content", where, "a TOML document", "an empty file",
                    "Start from one of the files under studies/.")
        )
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise StudyError(
            must_be("encoding", where, "UTF-8", f"byte 0x{raw[error.start]:02x} at {error.start}",
                    "Save it as UTF-8 text.")
        ) from None
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise StudyError(must_be("syntax", where, "TOML of a few levels", "hundreds of them")
                         ) from None
    except ValueError as error:  # of TOML, or of an integer with thousands of digits
        raise StudyError(
            must_be("syntax", where, "complete TOML", f"'{error}'", "Correct that line.")
        ) from None
    return _with_table(parse_study(document, where), path.parent, where)


def parse_study(document: dict[str, Any], where: str = "study") -> Study:
    """Validate a study given as nested dictionaries; raise StudyError as `read_study` does."""
    try:
        return Study.model_validate(document)
    except ValidationError as error:
        raise StudyError(_sentence(error, where)) from None


def curve_of(study: Study) -> Curve | None:
    """The iron ring's magnetization curve, if it has one."""
    curve = study.iron_ring and study.iron_ring.curve
    if not curve:
        return None
    if curve.kind == "brauer":
        return materials.brauer(curve.k1_m_per_H, curve.k2_per_T2, curve.k3_m_per_H)
    if curve.kind == "froehlich_kennelly":
        return materials.froehlich_kennelly(curve.initial_relative_permeability,
                                            curve.saturation_polarization_T)
    if curve.kind == "steel":
        table = materials.read_table(materials.steels()[curve.name])
    elif curve.file is None:
        table = curve.H_A_per_m, curve.B_T
    else:  # no file, no folder that the path would start from
        raise StudyError(must_be("`iron_ring.curve.file`", f"study {study.name}",
                                 "read together with the study's own file", f"'{curve.file}'",
                                 "Use read_study, or give H_A_per_m and B_T."))
    return materials.table_curve(np.array(table[0]), np.array(table[1]))


def is_nonlinear(study: Study) -> bool:
    """Tell whether the field is no linear function of the magnetizations."""
    return study.iron_ring is not None and study.iron_ring.curve is not None


def _with_table(study: Study, folder: Path, where: str) -> Study:
    """The study with the numbers of its H(B) file in place of the file's name."""
    ring = study.iron_ring
    if ring is None or ring.curve is None or ring.curve.kind != "table" or not ring.curve.file:
        return study
    path = folder / ring.curve.file
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ValueError("it must be a file")  # a device may have no end
        field, flux_density = materials.read_table(path)
        table = TableCurve(kind="table", H_A_per_m=field, B_T=flux_density)
    except OSError as error:
        raise StudyError(must_be("`iron_ring.curve.file`", where, "a readable file",
                                 f"{str(path)!r} ({error.strerror})",
                                 "Give its path from the study's folder.")) from None
    except ValueError as error:
        reason = (error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
                  if isinstance(error, ValidationError) else error)
        raise StudyError(must_be("`iron_ring.curve.file`", where, "a table of H(B)",
                                 f"{str(path)!r}, which cannot be used: {reason}")) from None
    return study.model_copy(update={"iron_ring": ring.model_copy(update={"curve": table})})


def _sentence(error: ValidationError, where: str) -> str:
    """Turn the first of pydantic's complaints into our sentence, and count the others."""
    errors = error.errors(include_url=False)
    # An unknown key is the likeliest cause of the others (a misspelt key is also a missing one).
    errors.sort(key=lambda e: e["type"] != "extra_forbidden")
    first = errors[0]
    key, model = _locate(first["loc"])
    received, kind = first.get("input"), first["type"]
    hint = ""
    if kind == "extra_forbidden":
        expected = "a known key"
        name = str(first["loc"][-1])
        near = difflib.get_close_matches(name, model.model_fields if model else [], 1, 0.5)
        hint = (f"Did you mean `{near[0]}`?" if near
                else f"Known keys here: {', '.join(model.model_fields)}." if model else "")
        received = f"`{name}`"
    elif kind == "missing":
        expected, received = "given", "nothing"
        hint = "Add the key."
    elif kind == "value_error":
        expected = "consistent"
        received = first["msg"].removeprefix("Value error, ")
        sentence = f"Input `{key or 'the whole'}` of {where} must be {expected}: {received}."
        return sentence + _more(errors)
    else:
        expected = first["msg"].removeprefix("Input should be ").lower()
        if isinstance(received, int | float) and not isinstance(received, bool):
            hint = _unit_hint(key, received)
        elif isinstance(received, dict | list):
            received = "a table" if isinstance(received, dict) else "a list"
        else:
            received = repr(received)
    return must_be(f"`{key}`", where, expected, received, hint) + _more(errors)


def _more(errors: list[Any]) -> str:
    return f" ({len(errors) - 1} more in this file.)" if len(errors) > 1 else ""


def _unit_hint(key: str, value: float) -> str:
    """Guess a unit that is wrong by a factor of 1000."""
    if not abs(value) < MAX_EXPLAINED:
        return "Correct the value."
    wrong = {"_m": "millimetres", "_T": "millitesla"}
    key = key.partition("[")[0] if key.endswith("]") else key
    for suffix, unit in wrong.items():
        if key.endswith(suffix) and abs(value) > 1:
            return f"Was it meant in {unit}? Then write {value / 1000:g}."
    if key.endswith("_m") and 0 < abs(value) < MIN_LENGTH_M:
        return f"Was it meant in kilometres? Then write {value * 1000:g}."
    return "Correct the value."


def _locate(location: tuple[int | str, ...]) -> tuple[str, type[BaseModel] | None]:
    """Return the dotted key of a pydantic location, and the model that holds its last part.

    pydantic puts the tag of a discriminated union into the location; a user never wrote it.
    """
    models: list[type[BaseModel]] = [Study]
    owner: type[BaseModel] | None = Study
    parts: list[str] = []
    for part in location:
        if isinstance(part, int):
            parts[-1] += f"[{part}]"
            continue
        tagged = [m for m in models if len(models) > 1 and part in _tags(m)]
        if tagged:
            models = owner_models = tagged
            owner = owner_models[0]
            continue
        owner = models[0] if models else None
        parts.append(part)
        field = owner.model_fields.get(part) if owner else None
        models = _models_in(field.annotation) if field else []
    return ".".join(parts), owner


def _tags(model: type[BaseModel]) -> set[str]:
    return {
        str(value)
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
        for value in get_args(field.annotation)
    }


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """All models mentioned in an annotation, in order."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (Union, types.UnionType, Annotated, tuple):
        return [model for arg in get_args(annotation) for model in _models_in(arg)]
    return []
