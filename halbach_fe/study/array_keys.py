"""Keys of a study that describe the array of permanent-magnet blocks."""

from __future__ import annotations

import warnings
from functools import cached_property
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from halbach_fe.core.errors import HalbachWarning
from halbach_fe.study.free_blocks import FreeBlocks
from halbach_fe.study.materials import (
    STRENGTHS,
    Material,
    doubted_strength,
    grade,
    grade_of,
    with_grade,
    without_old_grade,
)
from halbach_fe.study.types import (
    Angle,
    Displacement,
    Gap,
    Length,
    Place,
    RecoilPermeability,
    Remanence,
    Rotation,
    StudyModel,
    reason,
)


def check_order(multipole_order: int, blocks_per_ring: int) -> None:
    """Refuse a multipole that is not the lowest one in the bore of a ring of N equal blocks.

    The magnetization of block ``i`` is turned by ``(1 + p) i 360/N`` degrees. The sum over blocks
    leaves only the harmonics ``n = p + m N`` >= 1 with integer m (K. Halbach, Nucl. Instrum.
    Methods 169 (1980) 1), each with a field that grows as ``r^(n-1)`` from the axis. In a ring of
    sectors without gaps, all of them are proportional to ``sin((n + 1) pi / N)``, which up to its
    sign is ``sin((p + 1) pi / N)``. Order p is thus

    * absent if N divides p + 1: all blocks are magnetized along the same direction;
    * not the lowest one if N < p: order ``p - N`` or a lower one exceeds it near the axis.

    With N = p the blocks are magnetized alike relative to their own radius. Order p is then the
    lowest, as order 0 has no field in the bore, but weak.

    Parameters
    ----------
    multipole_order : int
        The order p >= 1; 1 is a dipole.
    blocks_per_ring : int
        The number N of blocks.

    Raises
    ------
    ValueError
        If the order is absent or not the lowest one, with the reason and a remedy.
    """
    order, blocks = multipole_order, blocks_per_ring
    if (order + 1) % blocks == 0:
        reason = ("the magnetization makes whole turns from block to block, so that all blocks are "
                  "magnetized in the same direction")
    elif blocks < order:
        lowest = order % blocks or blocks
        reason = f"order {lowest} is in their field too, and exceeds it near the axis"
    else:
        return
    raise ValueError(f"{blocks} blocks cannot make a multipole of order {order}: {reason}; use at "
                     f"least {order + 2} blocks")


MultipoleOrder = Annotated[int, Field(ge=1, le=20)]
BlocksPerRing = Annotated[int, Field(ge=4, le=512)]
MAX_RINGS = 1000

MAX_FACTOR = 2.0
"""Largest size of a `BlockException.magnetization_factor`."""

BlockMoment = Annotated[float, Field(gt=0.0, le=1e6)]


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
    magnet's axis. ``tilt_deg`` is a rotation vector along x and y, about the point of the axis at
    the height of the block's middle, so that the blocks of a ring tilt as one body.

    If several exceptions hold for a block, their displacements and rotations add up, and their
    factors multiply; of every other key, the last value counts. A missing block has no permeability
    either. The reaction of permeability and iron, which adds to the exact field of the blocks,
    takes every block whole and uniformly magnetized; the route ``moments`` takes it where it is
    mounted, the other routes in its nominal place.
    """

    ring: Annotated[int, Field(ge=1)] | None = None
    slot: Annotated[int, Field(ge=1)] | None = None
    recoil_permeability: RecoilPermeability | None = None
    recoil_permeability_across: RecoilPermeability | None = None
    remanence_T: Remanence | None = None
    magnetization_angle_deg: Angle | None = None
    mounted_from: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    magnetization_factor: Annotated[float, Field(ge=-MAX_FACTOR, le=MAX_FACTOR)] = 1.0
    magnetization_gradient: Annotated[float, Field(ge=-1.0, le=1.0)] | None = None
    inner_corner_loss: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    displacement_m: Displacement = (0.0, 0.0, 0.0)
    rotation_deg: Rotation = (0.0, 0.0, 0.0)
    shift_m: Displacement = (0.0, 0.0, 0.0)
    twist_deg: Angle = 0.0
    tilt_deg: tuple[Angle, Angle] = (0.0, 0.0)


class _OfGrade(StudyModel):
    """A table with a grade: another one has a remanence and a permeability of its own."""

    @property
    def doubt(self) -> str:
        """A sentence about a strength that is not that of the table's grade; empty if it is."""
        return doubted_strength(self)

    def with_(self, **changes: Any) -> Self:
        """Return a copy with other values of some keys; see `StudyModel.with_`."""
        changed = super().with_(**without_old_grade(self, changes))
        doubt, of_grade = changed.doubt, doubted_strength(changed)
        # a strength beside its grade is also what the program makes of one that is uncertain
        if doubt not in ("", self.doubt) and ("material" in changes or doubt != of_grade):
            warnings.warn(doubt, HalbachWarning, stacklevel=4)
        return changed


class Ring(_OfGrade):
    """A ring of its own: what differs from the values of the array.

    Every key that is left out has the array's value. Rings without ``z_m`` are stacked along z in
    the order of the file, ``ring_gap_m`` after each of them, and the stack is centred at z = 0;
    rings of different ``layer`` are stacked independently, so that layers lie inside one another.
    ``z_m`` is the middle of a ring that is not part of a stack. ``count`` stands for so many equal
    rings, one after the other.
    """

    count: Annotated[int, Field(ge=1, le=MAX_RINGS)] = 1
    layer: Annotated[int, Field(ge=1, le=100)] = 1
    z_m: Place | None = None
    multipole_order: MultipoleOrder | None = None
    blocks_per_ring: BlocksPerRing | None = None
    inner_radius_m: Length | None = None
    outer_radius_m: Length | None = None
    ring_length_m: Length | None = None
    ring_gap_m: Gap | None = None
    first_block_angle_deg: Angle | None = None
    first_magnetization_angle_deg: Angle | None = None
    recoil_permeability: RecoilPermeability | None = None
    recoil_permeability_across: RecoilPermeability | None = None
    remanence_T: Remanence | None = None
    block_moment_A_m2: BlockMoment | None = None
    block: Block | None = None
    material: Material | None = None

    @model_validator(mode="after")
    def _once(self) -> Ring:
        if self.count > 1:
            raise ValueError("rings that are counted are stacked: leave out z_m, or give every "
                             "ring a table of its own")
        return self

    @model_validator(mode="before")
    @classmethod
    def _with_grade(cls, given: Any) -> Any:
        return with_grade(given) if isinstance(given, dict) else given


PLACEHOLDERS: dict[str, Any] = {"blocks_per_ring": 4, "inner_radius_m": 0.1,
                                "outer_radius_m": 0.2, "block": {"shape": "sector"}}
"""Values for the keys of rings in an array that has free blocks only."""


class Array(_OfGrade):
    """The permanent-magnet array: rings of blocks, free blocks, or both.

    ``rings`` equal rings have ``blocks_per_ring`` = N blocks each. The middle of slot ``i`` (from
    1) is at the angle ``first_block_angle_deg + (i-1) 360/N`` about the z axis. The angle of its
    magnetization is ``first_magnetization_angle_deg + (1 + multipole_order) (i-1) 360/N``
    (K. Halbach, Nucl. Instrum. Methods 169 (1980) 1). Rings are numbered from 1 at the lowest z;
    ``ring_length_m`` is along z, ``ring_gap_m`` lies between rings.

    Rings that differ are listed as tables ``[[array.ring]]`` instead, and numbered in the order of
    the file; a value that all of them give need not be given here. ``free_blocks`` are blocks
    anywhere, from a table; they follow the rings in number. An array of free blocks alone needs no
    other key.

    ``recoil_permeability`` is relative and holds along the easy axis;
    ``recoil_permeability_across`` holds perpendicular to it (default: the same). Exactly one of
    ``remanence_T`` and ``block_moment_A_m2``, the magnetic moment of every block, gives the
    strength. ``material`` names a grade of magnet (``"N42SH"``), which gives the remanence, the
    recoil permeability, ``prior.remanence_sd`` and the keys of ``demagnetization`` where the
    study does not.
    """

    multipole_order: MultipoleOrder = 1
    blocks_per_ring: BlocksPerRing
    rings: Annotated[int, Field(ge=0, le=MAX_RINGS)] = 1
    inner_radius_m: Length
    outer_radius_m: Length
    ring_length_m: Length | None = None
    ring_gap_m: Gap = 0.0
    first_block_angle_deg: Angle = 0.0
    first_magnetization_angle_deg: Angle = 0.0
    recoil_permeability: RecoilPermeability = 1.0
    recoil_permeability_across: RecoilPermeability | None = None
    remanence_T: Remanence | None = None
    block_moment_A_m2: BlockMoment | None = None
    material: Material | None = None
    block: Block
    ring: tuple[Ring, ...] = ()
    free_blocks: FreeBlocks | None = None
    exceptions: tuple[BlockException, ...] = ()

    @property
    def doubt(self) -> str:
        """A sentence about a strength that is not that of the grade, or of no block."""
        found = grade_of(self)
        of_grade = found is not None and self.remanence_T == found.nominal_remanence
        idle = [key for key in ("remanence_T", "block_moment_A_m2")
                if getattr(self, key) is not None]
        if self.rings or not idle or of_grade:
            return super().doubt
        return (f"{idle[0]} of [array] is without effect: all blocks are free, and have a "
                "strength of their own in their table.")

    @model_validator(mode="before")
    @classmethod
    def _with_values_of_rings(cls, given: Any) -> Any:
        """Fill in what the array's rings or free blocks say in place of the array itself."""
        if not isinstance(given, dict):
            return given
        values = with_grade(given | {"material": common_material(given)})
        rings, free = values.get("ring") or (), values.get("free_blocks")
        if rings and isinstance(rings, list | tuple):
            rings = values["ring"] = [one for ring in rings for one in _repeated(ring)]
            values.setdefault("rings", len(rings))
            for key in ("multipole_order", "blocks_per_ring", "inner_radius_m", "outer_radius_m",
                        "block"):
                found = [value for value in (_value(ring, key) for ring in rings)
                         if value is not None]
                if values.get(key) is None and len(found) == len(rings):
                    values[key] = found[0]
            strengths = ("remanence_T", "block_moment_A_m2")
            if all(values.get(key) is None for key in strengths):
                own = [with_grade(ring) if isinstance(ring, dict) else ring for ring in rings]
                if all(any(_value(ring, key) is not None for key in strengths) for ring in own):
                    values |= {key: _value(own[0], key) for key in strengths}
        elif free is not None and _is_empty(values):
            try:
                table = FreeBlocks.model_validate(free)
            except ValidationError:  # reported by the validation of the key itself
                return values | {"rings": 0} | PLACEHOLDERS
            inner, outer = table.radii_m
            values = PLACEHOLDERS | {"inner_radius_m": inner, "outer_radius_m": outer} | values
            values |= {"rings": 0, "free_blocks": table}
        return values

    @model_validator(mode="after")
    def _consistent(self) -> Array:
        if self.outer_radius_m <= self.inner_radius_m:
            raise ValueError(
                f"outer_radius_m ({self.outer_radius_m}) must be larger than inner_radius_m "
                f"({self.inner_radius_m}); exchange or correct them"
            )
        if self.rings == 0 and self.free_blocks is None:
            raise ValueError("an array needs at least one ring, or free_blocks")
        if self.ring:
            if self.rings != len(self.ring):
                raise ValueError(f"rings = {self.rings}, but there are {len(self.ring)} tables "
                                 "[[array.ring]]; leave out `rings`")
            for number in range(1, self.rings + 1):
                try:
                    self.of_ring(number)
                except ValidationError as error:
                    raise ValueError(f"ring {number}: {reason(error)}") from None
        elif self.rings:
            self._check_strength()
            check_order(self.multipole_order, self.blocks_per_ring)
        self._check_names()
        self._check_exceptions()
        return self

    def _check_strength(self) -> None:
        if (self.remanence_T is None) == (self.block_moment_A_m2 is None):
            raise ValueError("give exactly one of remanence_T and block_moment_A_m2")
        if self.block_moment_A_m2 is not None and self.ring_length_m is None:
            raise ValueError("block_moment_A_m2 needs ring_length_m, to know the block's volume")

    def _check_names(self) -> None:
        """Refuse free blocks that have the name of a block of a ring."""
        names = set(self.free_blocks.name) if self.free_blocks is not None else ()
        for ring, count in enumerate(self.blocks_by_ring[:self.rings] if names else (), start=1):
            for slot in range(1, count + 1):
                if (name := block_name(ring, slot)) in names:
                    raise ValueError(f"a free block is called {name}, which is the name of the "
                                     f"block in ring {ring}, slot {slot}; rename it")

    def _check_exceptions(self) -> None:
        sizes = self.blocks_by_ring
        places = set(self.free_blocks.places) if self.free_blocks and self.exceptions else set()
        for exception in self.exceptions:
            for ring, slot, text in (
                    (exception.ring, exception.slot, "an exception names"),
                    (*(exception.mounted_from or (None, None)),
                     "an exception's block was meant for")):
                possible = sizes if ring is None else sizes[ring - 1:ring]
                if not possible or (slot or 1) > max(possible) or (
                        ring is not None and ring > self.rings and slot is not None
                        and (ring - self.rings, slot) not in places):
                    place = ", ".join(f"{name} {number}" for name, number in (
                        ("ring", ring), ("slot", slot)) if number is not None)
                    raise ValueError(f"{text} {place} of an array of {_described(sizes)}")

    @property
    def is_uniform(self) -> bool:
        """Whether the array consists of equal rings only."""
        return not self.ring and self.free_blocks is None

    @property
    def blocks_by_ring(self) -> tuple[int, ...]:
        """Number of blocks of every ring, those of the free blocks last."""
        own = tuple(ring.blocks_per_ring or self.blocks_per_ring for ring in self.ring)
        regular = own or (self.blocks_per_ring,) * self.rings
        return regular + (self.free_blocks.blocks_by_ring if self.free_blocks else ())

    @cached_property
    def grades(self) -> tuple[tuple[str | None, bool], ...]:
        """Grade of every block, None where the study names none, and whether the block has the
        nominal remanence of that grade.
        """
        of_array = (self.material, self.remanence_T)
        found = []
        for number, count in enumerate(self.blocks_by_ring[:self.rings]):
            ring = self.ring[number] if self.ring else None
            stated = ring and (ring.remanence_T or ring.block_moment_A_m2)
            found += count * [of_array if ring is None else (
                ring.material or self.material, ring.remanence_T if stated else self.remanence_T)]
        if table := self.free_blocks:
            empty = (None,) * len(table)
            found += [(name or self.material, remanence) for name, remanence in zip(
                table.material or empty, table.remanence_T or empty, strict=True)]
        return tuple((name, name is not None and remanence == grade(name).nominal_remanence)
                     for name, remanence in found)

    def block_of(self, exception: BlockException) -> tuple[int, int] | None:
        """Return ring and slot of the block that an exception holds for; None if for several."""
        ring = exception.ring or (1 if len(self.blocks_by_ring) == 1 else None)
        return (ring, exception.slot) if ring and exception.slot else None

    def of_ring(self, ring: int) -> Array:
        """Return an array of one ring with the values that hold for a ring (from 1)."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        values.update(rings=1, ring=(), free_blocks=None, exceptions=())
        if self.ring:
            own = {name: value for name, value in self.ring[ring - 1]
                   if name in values and value is not None}
            for one, other in (("remanence_T", "block_moment_A_m2"),
                               ("block_moment_A_m2", "remanence_T")):
                if one in own:
                    values[other] = None
            values.update(own)
        return type(self).model_validate(values)


def _is_empty(array: dict[str, Any]) -> bool:
    """Return whether an array says nothing of rings, so that it has none beside free blocks."""
    return all(array.get(key) is None or array[key] == 0
               for key in ("rings", "blocks_per_ring", "block"))


def common_material(array: dict[str, Any]) -> str | None:
    """Return the grade of an array without one: of its first ring or block, if all name grades."""
    found = [name for name, _ in _materials(array)]
    known = found and all(grade_of({"material": name}) for name in found)
    return found[0] if known and array.get("material") is None else array.get("material")


def remanence_sds(array: dict[str, Any]) -> dict[str, float]:
    """Return the standard deviations of the remanences that follow from grades, as fractions of
    these, by the name of the grade.
    """
    own = grade_of({"material": common_material(array)})
    found = [grade_of({"material": name}) or own for name, is_stated in _materials(array)
             if not is_stated]
    return {one.name: one.remanence_sd for one in found if one is not None}


def _materials(array: dict[str, Any]) -> list[tuple[str | None, bool]]:
    """Return the grade that every ring and free block names, and whether its strength is stated."""
    rings, free = array.get("ring") or (), array.get("free_blocks")
    stated = any(array.get(key) is not None for key in STRENGTHS)
    found = [(_value(ring, "material"), any(_value(ring, key) is not None for key in STRENGTHS) or (
        stated and not _value(ring, "material"))) for ring in rings] if isinstance(
            rings, list | tuple) else []
    if not found and not (free is not None and _is_empty(array)):  # equal rings
        found = [(array.get("material"), stated)]
    columns = {key: _value(free, key) or () for key in ("name", "material", *STRENGTHS)}
    if not all(isinstance(values, list | tuple) for values in columns.values()):
        return found  # reported by the validation of the key itself
    for number in range(len(columns["name"])):
        of_block = {key: values[number] for key, values in columns.items() if number < len(values)}
        found.append((of_block.get("material"), any(
            of_block.get(key) is not None for key in STRENGTHS)))
    return found


def block_name(ring: int, slot: int) -> str:
    """Return the name of a block of a ring: ``r01s05`` is ring 1, slot 5."""
    return f"r{ring:02d}s{slot:02d}"


def _repeated(ring: Any) -> list[Any]:
    """Return the equal rings that a table with ``count`` stands for, each with a count of 1."""
    count = ring.get("count", 1) if isinstance(ring, dict) else 1
    if not isinstance(count, int) or not 1 < count <= MAX_RINGS or ring.get("z_m") is not None:
        return [ring]  # its own validation tells what is wrong
    return [ring | {"count": 1}] * count


def _value(ring: Any, key: str) -> Any:
    """Return the value of a key of a ring, which is a table of the file or already a `Ring`."""
    return ring.get(key) if isinstance(ring, dict) else getattr(ring, key, None)


def _described(sizes: tuple[int, ...]) -> str:
    """Return "3 rings of 16 blocks", or the numbers of blocks of unequal rings."""
    if len(set(sizes)) == 1:
        return f"{len(sizes)} rings of {sizes[0]} blocks"
    return f"{len(sizes)} rings of {', '.join(map(str, sizes))} blocks"
