"""Keys of a study that describe the magnet: its blocks, its iron ring, and external sources."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from halbach_fe.study import materials
from halbach_fe.study.types import (
    Angle,
    Coordinate,
    Displacement,
    FluxDensityVector,
    Gap,
    Length,
    Line,
    Moment,
    Point,
    RecoilPermeability,
    Remanence,
    Rotation,
    StudyModel,
    Temperature,
)


class SectorBlock(StudyModel):
    """A block that is a sector of an annulus.

    ``angular_gap_deg`` is the angle between the side faces of neighbouring blocks.
    """

    shape: Literal["sector"]
    angular_gap_deg: Annotated[float, Field(ge=0.0, lt=360.0)] = 0.0


class TrapezoidBlock(StudyModel):
    """A block that is a trapezoid with flat faces at the inner and the outer radius.

    ``side_gap_m`` is the distance between the facing, parallel side faces of neighbouring blocks.
    """

    shape: Literal["trapezoid"]
    side_gap_m: Gap = 0.0


class CuboidBlock(StudyModel):
    """A cuboid block: as thick as the array's outer minus inner radius, and ``width_m`` wide.

    With ``orientation = "position"`` the block's thickness is along the radius. With
    ``"magnetization"`` it is along the nominal magnetization of its slot, as is usual in arrays
    that are built from magnetized cubes.
    """

    shape: Literal["cuboid"]
    width_m: Length
    orientation: Literal["position", "magnetization"] = "position"


Block = Annotated[SectorBlock | TrapezoidBlock | CuboidBlock, Field(discriminator="shape")]


class BlockException(StudyModel):
    """Deviations of some blocks from the array's common values.

    The exception holds for the blocks of ``ring``, of ``slot``, or for the one block of both; with
    neither key it holds for all blocks.

    Material: ``remanence_T``, ``recoil_permeability`` and ``recoil_permeability_across`` replace
    the array's values; ``recoil_permeability`` alone holds in all directions.

    Magnetization: ``magnetization_angle_deg`` replaces the direction of the magnetization and
    leaves the block's shape as it is. ``mounted_from`` names the ring and slot that the block was
    made for; its magnetization keeps the direction that it has relative to the block.
    ``magnetization_factor`` multiplies the magnetization: 0 for a missing block, -1 for a block
    that was mounted upside down. ``magnetization_gradient`` is the magnetization of the outer half
    minus that of the inner half of the block, as a fraction of their mean. ``inner_corner_loss`` is
    the fraction of the magnetization that the two corners at the bore have lost, each over a sixth
    of the block's width and a sixth of its thickness.

    Position: ``displacement_m`` displaces the block along its own radial, azimuthal and axial
    direction, and ``rotation_deg`` is a rotation vector along the same axes, about the block's
    middle. ``shift_m`` displaces the block along x, y and z, and ``twist_deg`` rotates it about the
    magnet's axis.

    If several exceptions hold for a block, their displacements and rotations add up, and their
    factors multiply; of every other key, the last value counts. The finite-element part of the
    field, which is only the reaction of permeability and iron, treats every block as if it were in
    its nominal place, whole and uniformly magnetized.
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


class Array(StudyModel):
    """The permanent-magnet array: ``rings`` equal rings of ``blocks_per_ring`` = N blocks.

    The middle of slot ``i`` (from 1) is at the angle ``first_block_angle_deg + (i-1) 360/N`` about
    the z axis. The angle of its magnetization is ``first_magnetization_angle_deg +
    (1 + multipole_order) (i-1) 360/N`` (K. Halbach, Nucl. Instrum. Methods 169 (1980) 1). Rings are
    numbered from 1 at the lowest z; ``ring_length_m`` is along z, ``ring_gap_m`` lies between
    rings.

    ``recoil_permeability`` is relative and holds along the easy axis;
    ``recoil_permeability_across`` holds perpendicular to it (default: the same). Exactly one of
    ``remanence_T`` and ``block_moment_A_m2``, the magnetic moment of every block, gives the
    strength.
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
        for exception in self.exceptions:
            ring, slot = exception.ring or 1, exception.slot or 1
            if ring > self.rings or slot > self.blocks_per_ring:
                raise ValueError(
                    f"an exception names ring {exception.ring}, slot {exception.slot} of an array "
                    f"of {self.rings} rings of {self.blocks_per_ring} blocks")
            ring, slot = exception.mounted_from or (1, 1)
            if ring > self.rings or slot > self.blocks_per_ring:
                raise ValueError(
                    f"an exception's block was meant for ring {ring}, slot {slot} of an array of "
                    f"{self.rings} rings of {self.blocks_per_ring} blocks")
        return self


class TableCurve(StudyModel):
    """A magnetization curve as a table of H in A/m and B in T.

    The table is either the CSV file ``file``, with the header ``H_A_per_m,B_T`` (its path is
    relative to the study's folder), or the two lists ``H_A_per_m`` and ``B_T``. When a study is
    read, the numbers of the file replace its name.
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


class SteelCurve(StudyModel):
    """A magnetization curve that comes with halbach-fe, by name."""

    kind: Literal["steel"]
    name: str

    @model_validator(mode="after")
    def _known(self) -> SteelCurve:
        if self.name not in materials.steels():
            raise ValueError(f"no steel is called '{self.name}'; there are "
                             f"{', '.join(materials.steels())}")
        return self


class FroehlichKennellyCurve(StudyModel):
    """The magnetization curve B = mu_0 H + J_s H / (H + h) of Froehlich and Kennelly.

    J_s is the saturation polarization; h follows from the initial relative permeability.
    """

    kind: Literal["froehlich_kennelly"]
    initial_relative_permeability: Annotated[float, Field(ge=2.0, le=1e6)]
    saturation_polarization_T: Annotated[float, Field(ge=0.01, le=materials.MAX_POLARIZATION)]

    @model_validator(mode="after")
    def _possible(self) -> FroehlichKennellyCurve:
        materials.froehlich_kennelly(self.initial_relative_permeability,
                                     self.saturation_polarization_T)
        return self


class BrauerCurve(StudyModel):
    """Brauer's magnetization curve H = (k1 exp(k2 B^2) + k3) B.

    Where dH/dB would exceed that of vacuum, the curve continues with the slope of vacuum.
    """

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


class IronRing(StudyModel):
    """A coaxial iron tube outside the array.

    The iron has either a constant ``relative_permeability`` or a magnetization ``curve``.
    ``length_m`` is along z, centred at z = 0 (default: as long as the array).
    """

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


class Neighbour(StudyModel):
    """Another magnet with the same blocks, in vacuum, on the same axis.

    Its middle is at ``z_m``; it is rotated by ``turn_deg`` about the axis, and its magnetizations
    are those of this magnet multiplied by ``factor``.
    """

    z_m: Coordinate
    turn_deg: Angle = 0.0
    factor: Annotated[float, Field(ge=-10.0, le=10.0)] = 1.0


class PointDipole(StudyModel):
    """A distant magnetized object, approximated by a point dipole."""

    position_m: Point
    moment_A_m2: tuple[Moment, Moment, Moment]


class External(StudyModel):
    """Fields of sources outside the magnet, added to its field.

    ``background_T`` is uniform. The reaction of iron and blocks to external fields is neglected.
    """

    background_T: FluxDensityVector = (0.0, 0.0, 0.0)
    neighbours: tuple[Neighbour, ...] = ()
    dipoles: tuple[PointDipole, ...] = ()


class Demagnetization(StudyModel):
    """Resistance of the magnet material to demagnetization, and the temperature to assess it at.

    Remanence (of ``array``) and intrinsic coercivity are the data-sheet values at
    ``reference_temperature_C``; both change linearly with temperature, by the fraction
    ``..._coefficient_per_K`` per kelvin. ``temperature_C`` is the highest temperature of the
    magnet. The knee of the demagnetization curve is at ``squareness`` times the intrinsic
    coercivity, where the polarization is a tenth below the remanence (H_k of IEC 60404-8-1).
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
                raise ValueError(f"{name}_coefficient_per_K ({coefficient}) makes the {name} zero "
                                 f"or negative at {self.temperature_C:g} °C; use a fraction per "
                                 "kelvin, not per cent, and a temperature the linear law holds for")
        return self
