"""Keys of a study that describe the magnet: blocks, iron, what is around it."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import (
    Field,
    model_validator,
)

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
    """A sector of an annulus; ``angular_gap_deg`` is the free angle between neighbours."""

    shape: Literal["sector"]
    angular_gap_deg: Annotated[float, Field(ge=0.0, lt=360.0)] = 0.0


class TrapezoidBlock(StudyModel):
    """A trapezoid with flat faces at the inner and the outer radius.

    ``side_gap_m`` is the clearance between the parallel side faces of neighbours.
    """

    shape: Literal["trapezoid"]
    side_gap_m: Gap = 0.0


class CuboidBlock(StudyModel):
    """A cuboid, radially from the inner to the outer radius of the array, ``width_m`` wide.

    ``orientation`` says what its faces follow: the block's ``position`` angle, or its
    ``magnetization`` angle, as is usual in arrays built from magnetized cubes.
    """

    shape: Literal["cuboid"]
    width_m: Length
    orientation: Literal["position", "magnetization"] = "position"


Block = Annotated[SectorBlock | TrapezoidBlock | CuboidBlock, Field(discriminator="shape")]


class BlockException(StudyModel):
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


class Array(StudyModel):
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


class TableCurve(StudyModel):
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


class SteelCurve(StudyModel):
    """A curve that comes with halbach-fe, by name."""

    kind: Literal["steel"]
    name: str

    @model_validator(mode="after")
    def _known(self) -> SteelCurve:
        if self.name not in materials.steels():
            raise ValueError(f"no steel is called '{self.name}'; there are "
                             f"{', '.join(materials.steels())}")
        return self


class FroehlichKennellyCurve(StudyModel):
    """B = mu_0 H + J_s H / (H + h), h following from the initial permeability."""

    kind: Literal["froehlich_kennelly"]
    initial_relative_permeability: Annotated[float, Field(ge=2.0, le=1e6)]
    saturation_polarization_T: Annotated[float, Field(ge=0.01, le=materials.MAX_POLARIZATION)]

    @model_validator(mode="after")
    def _possible(self) -> FroehlichKennellyCurve:
        materials.froehlich_kennelly(self.initial_relative_permeability,
                                     self.saturation_polarization_T)
        return self


class BrauerCurve(StudyModel):
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


class IronRing(StudyModel):
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


class Neighbour(StudyModel):
    """Another magnet like this one, in vacuum: its middle on the axis at ``z_m``, turned about the
    axis, and stronger or weaker by ``factor``.
    """

    z_m: Coordinate
    turn_deg: Angle = 0.0
    factor: Annotated[float, Field(ge=-10.0, le=10.0)] = 1.0


class PointDipole(StudyModel):
    """A magnetized object, as a point."""

    position_m: Point
    moment_A_m2: tuple[Moment, Moment, Moment]


class External(StudyModel):
    """Fields that are not the magnet's, added to it: they magnetize no iron."""

    background_T: FluxDensityVector = (0.0, 0.0, 0.0)
    neighbours: tuple[Neighbour, ...] = ()
    dipoles: tuple[PointDipole, ...] = ()


class Demagnetization(StudyModel):
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
