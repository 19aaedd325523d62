"""The plan to assemble a magnet: which block goes where and which way round, and its holder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, StudyError, must_be
from halbach_fe.core.interface import ShownInNotebook, typed
from halbach_fe.design.holder import HeldBlock, Plate, overlapping, plates
from halbach_fe.geometry.array_layout import blocks_of_table, blocks_table
from halbach_fe.geometry.blocks import MagnetBlock, block_in_words, rotation_about_z
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import (
    Outline,
    Prism,
    at_heights,
    outline_centroid,
    points_on,
    upright,
)
from halbach_fe.geometry.remounting import as_meant, mountings
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.study.array_keys import block_name
from halbach_fe.study.design_keys import Holder
from halbach_fe.study.free_blocks import SIZES

_TURNS = tuple(Rotation.create_group("O").as_matrix().round())
"""The 24 rotations that bring a cube onto itself."""


@dataclass(frozen=True)
class Kind:
    """Blocks that are ordered together, as they are equal from their own axes."""

    number: int
    """From 1."""
    sizes: dict[str, Any]
    """Columns ``shape``, ``size_z_m`` and others of a table of free blocks."""
    solid: Prism
    """A block in its own frame."""
    direction: Floats
    """Unit vector of the magnetization along its own axes. Shape (3,)."""
    remanence_T: float
    material: str | None
    """Grade."""
    count: int

    @property
    def identity(self) -> tuple[object, ...]:
        """Sizes, grade and magnetization, rounded to what a supplier can make."""
        # directions that differ by less than about this belong to blocks of one kind
        same_deg = 0.05
        steps = np.round(self.direction / np.radians(same_deg)) + 0.0
        return (tuple((column, _rounded(value)) for column, value in self.sizes.items()),
                self.material, tuple(steps.tolist()), round(self.remanence_T, 6))

    @property
    def part(self) -> tuple[object, ...]:
        """The first `identity` of the block in all positions in which its outline is the same: a
        cube has 24, a cylinder any about its axis, and others those of `_turns_of`.
        """
        sizes, direction = self.sizes, self.direction
        if sizes["shape"] == "cylinder":
            direction = np.array([np.hypot(*direction[:2]), 0.0, direction[2]])
        if sizes["shape"] != "cuboid":
            return min(replace(self, direction=turn @ direction).identity
                       for turn in _turns_of(self.solid.outline))
        sides = ("size_x_m", "size_y_m", "size_z_m")
        lengths = np.array([sizes[side] for side in sides])
        return min(replace(self, direction=turn @ direction, sizes=sizes | dict(
            zip(sides, (np.abs(turn) @ lengths).tolist(), strict=True))).identity
            for turn in _TURNS)

    @property
    def shape(self) -> str:
        """Shape and size in words, along x, y and z of its own axes."""
        def mm(column: str) -> str:
            return f"{1e3 * self.sizes[column]:.5g}"

        height = mm("size_z_m")
        return {
            "cuboid": lambda: f"cuboid {mm('size_x_m')} × {mm('size_y_m')} × {height} mm",
            "sector": lambda: (f"sector of radii {mm('inner_radius_m')} and "
                               f"{mm('outer_radius_m')} mm, {self.sizes['angle_deg']:.4g}°, "
                               f"{height} mm high"),
            "trapezoid": lambda: (f"trapezoid {mm('size_x_m')} × {mm('inner_width_m')} to "
                                  f"{mm('outer_width_m')} × {height} mm"),
            "cylinder": lambda: f"cylinder of radius {mm('radius_m')} mm, {height} mm high",
            "polygon": lambda: (f"polygon of {self.sizes['sides']} corners at "
                                f"{mm('radius_m')} mm, {height} mm high"),
            "prism": lambda: f"prism of {len(self.solid.outline)} corners, {height} mm high",
        }[self.sizes["shape"]]()

    @property
    def magnetized(self) -> str:
        """Direction of the magnetization in words, from its own axes."""
        x, y, z = self.direction
        rise, turn = round(float(np.degrees(np.arcsin(z))), 1), round(
            float(np.degrees(np.arctan2(y, x))), 1)
        if abs(rise) > 89.9:
            return f"along {'−' * (rise < 0)}z"
        along = {0.0: "x", 180.0: "−x", -180.0: "−x", 90.0: "y", -90.0: "−y"}.get(turn)
        text = f"along {along}" if along else (
            f"{abs(turn):g}° from x towards {'−' * (turn < 0)}y")
        return text + (f", {abs(rise):g}° towards {'−' * (rise < 0)}z" if rise else "")


@lru_cache(maxsize=4096)  # most blocks of a magnet have the outline of another one
def _turns_of(outline: Outline) -> tuple[Floats, ...]:
    """Return the rotations (3, 3) that bring a prism onto itself, about its axis and upside down.

    Every one brings the corner that is farthest from the middle to a corner.
    """
    same_m = 1e-7  # to which sizes are rounded
    corners = points_on(outline) - outline_centroid(outline)
    tree, angle = cKDTree(corners), np.arctan2(*corners.T[::-1])
    farthest, found = int(np.argmax(np.hypot(*corners.T))), []
    for over in (1, -1):
        for to in angle:
            turn = rotation_about_z(to - over * angle[farthest]) @ np.diag([1.0, over, over])
            if tree.query(corners @ turn[:2, :2].T)[0].max() < same_m:
                found.append(turn)
    return tuple(found)


@dataclass(frozen=True)
class AssembledBlock:
    """A block in its place."""

    block: MagnetBlock
    """In a frame of its own."""
    kind: Kind
    serial: str
    """Serial number; empty if it is not known."""
    measured_axes: Floats | None
    """Axes in which the moment of a measured block is given, as columns; None for a block whose
    magnetization is inverted. They are turned with the block. Shape (3, 3)."""
    plate: Plate | None = None
    """The plate that holds it."""
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector, along its own axes, by which a sorted block is turned in its place from how
    it was measured."""

    @property
    def up(self) -> str:
        """Which of its measured axes is up; empty if that is not known."""
        if not self.serial or self.measured_axes is None:
            return ""
        axis = int(np.argmax(np.abs(self.measured_axes[2])))
        sign = "" if self.measured_axes[2, axis] > 0 else "−"
        return f"{sign}{'xyz'[axis]}"

    @property
    def name(self) -> str:
        """Place in words, and the serial number."""
        words = block_in_words(self.block.ring, self.block.slot, self.block.name)
        return f"{words}, {self.serial}" if self.serial else words

    @property
    def has_own_name(self) -> bool:
        """Whether it is a free block with a name, not one that ring and slot name."""
        return self.block.name != block_name(self.block.ring, self.block.slot)

    @cached_property
    def direction(self) -> Floats:
        """Unit vector of the magnetization along the axes of the magnet, (3,)."""
        return np.array(self.block.easy_axis) * np.sign(self.block.remanence)

    @property
    def angle_deg(self) -> float:
        """Angle of the block's middle about the z axis; 0 on the axis."""
        return self.block.angle_deg

    @property
    def magnetization_angle_deg(self) -> float:
        """Angle of the magnetization to the x axis, in the plane of the ring."""
        x, y, _ = self.direction
        return float(np.degrees(np.arctan2(y, x)))

    @property
    def from_radius_deg(self) -> float:
        """Angle of the magnetization from the radius outwards, from -180 to 180."""
        turn = self.magnetization_angle_deg - self.angle_deg
        return float(180.0 - (180.0 - turn) % 360.0)

    @property
    def elevation_deg(self) -> float:
        """Angle of the magnetization above the plane of the ring."""
        return float(np.degrees(np.arcsin(np.clip(self.direction[2], -1.0, 1.0))))

    @property
    def way_round(self) -> str:
        """Where the north pole of the block points, which of its measured axes is up, and how it is
        turned in its place.
        """
        turn, rise = round(self.from_radius_deg, 1), round(self.elevation_deg, 1)
        if abs(rise) > 84:
            north = "up" if rise > 0 else "down"
        else:
            side = "counter-clockwise" if turn > 0 else "clockwise"
            north = {0.0: "outwards", 180.0: "inwards", 90.0: side, -90.0: side}.get(
                -turn if turn == -180.0 else turn + 0.0, f"{abs(turn):g}° from outwards, {side}")
            if rise:
                north += f", {abs(rise):g}° {'up' if rise > 0 else 'down'}"
        turned = f"; turned by {turn_in_words(self.turn_deg)}" if any(self.turn_deg) else ""
        return f"north {north}" + (f"; its {self.up} up" if self.up else "") + turned


def turn_in_words(turn_deg: Sequence[float]) -> str:
    """Return a rotation vector (3,) in degrees, along a block's own axes, in words."""
    angle = float(np.linalg.norm(turn_deg))
    axis = np.round(np.array(turn_deg) / angle, 6)
    if np.count_nonzero(axis) == 1:
        along = int(np.argmax(np.abs(axis)))
        return f"{'−' * bool(axis[along] < 0)}{angle:.0f}° about its own {'xyz'[along]}"
    return f"{angle:.0f}° about ({', '.join(f'{part:.3g}' for part in axis + 0.0)}) of its own axes"


@dataclass(frozen=True)
class Assembly(ShownInNotebook):
    """The plan to assemble a magnet.

    Attributes
    ----------
    magnet : Magnet
    holder : Holder
        The study's, or else one of usual sizes.
    kinds : tuple of Kind
    blocks : tuple of AssembledBlock
        All that are there, ring by ring.
    plates : tuple of Plate
        Different plates of the holder.
    reasons : tuple of str
        Why there is no plate for some blocks.
    left_over : int
        Number of measured blocks without a place.
    """

    magnet: Magnet
    holder: Holder
    kinds: tuple[Kind, ...]
    blocks: tuple[AssembledBlock, ...]
    plates: tuple[Plate, ...]
    reasons: tuple[str, ...]
    left_over: int = 0

    @property
    def ordered_as(self) -> tuple[int, ...]:
        """For each kind the number of the first kind that is the same `Kind.part`, turned over or
        about; perhaps its own.
        """
        first: dict[object, int] = {}
        return tuple(first.setdefault(kind.part, kind.number) for kind in self.kinds)


@typed
def cad(magnet: Magnet, blocks: BlockTable | None = None) -> Assembly:
    """Design the holder of a magnet, and plan its assembly.

    `halbach_fe.write_report` writes the solids as STEP and STL files, the table and the page.

    Parameters
    ----------
    magnet : Magnet
        Its study may ask for a holder by the table ``holder``. Without it, plates of usual sizes
        are designed where they can be made.
    blocks : BlockTable, optional
        Measured blocks in their places, as `halbach_fe.sort` assigns them. Their serial numbers
        name the blocks.

    Returns
    -------
    Assembly

    Raises
    ------
    StudyError
        If the study is 2D, or asks for a holder that cannot be made.
    MeasurementError
        If the table does not fit the study, or says nothing about places.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> plan = hf.cad(hf.build_magnet(hf.read_study("mri.toml")))
    >>> plan.blocks[0].name, plan.blocks[0].way_round, plan.reasons
    ('ring 1, slot 1', 'north counter-clockwise', ())
    """
    if magnet.dimension == 2:
        raise StudyError(must_be("`dimension`", f"study {magnet.name}", "3 for solids", "2",
                                 "Use dimension = 3, and give array.ring_length_m."))
    for body in magnet.iron:
        if body.sphere or not body.in_place:
            raise StudyError(must_be(
                "`iron.bodies`", f"study {magnet.name}", "tubes, boxes, and prisms without "
                "holes, all without centre_m, step_m and rotation_deg, for solids",
                _kind_in_words(body), "Leave it out."))
    there = [number for number, block in enumerate(magnet.blocks) if block.remanence]
    most_blocks = 20_000  # largest number of blocks: their STEP file has 15 MB
    if len(there) > most_blocks:
        raise StudyError(must_be("`array`", f"study {magnet.name}", f"of at most {most_blocks} "
                                 "blocks for solids", str(len(there))))
    serials, turns = _of_table(magnet, blocks)
    table = blocks_table(magnet)
    own = blocks_of_table(table)
    kinds, members = _kinds(table, own)
    axes = _measured_axes(magnet, turns)
    solids = [upright(block) for block in own]
    found, reasons = _plates(magnet, own, solids)
    plate_of = {number: plate for plate in found for copy in plate.blocks for number in copy}
    return Assembly(
        magnet, magnet.study.holder or Holder(), kinds,
        tuple(AssembledBlock(block, kinds[members[number]], serials.get(original, ""),
                             axes[original], plate_of.get(number),
                             turns.get(original, (0.0, 0.0, 0.0)))
              for number, (block, original) in enumerate(zip(own, there, strict=True))),
        found, reasons, 0 if blocks is None else int(np.sum(blocks.ring == 0)))


def _kind_in_words(body: IronSolid) -> str:
    """Return what a body of iron is that has no solid."""
    if body.sphere:
        return "a sphere"
    if body.profile is not None:
        return "a body of the kind 'revolved'"
    if body.holes:
        return "a prism with holes"
    if body.triangles is not None:
        return "a body of the kind 'stl'"
    return "a body with centre_m, step_m or rotation_deg"


def _plates(
    magnet: Magnet, blocks: Sequence[MagnetBlock], solids: Sequence[Prism | None]
) -> tuple[tuple[Plate, ...], tuple[str, ...]]:
    """Return the plates for the blocks, and why there is none for some of them."""
    held = [None if solid is None else HeldBlock(number, block.name, solid,
                                np.array(block.easy_axis) * np.sign(block.remanence))
            for number, (block, solid) in enumerate(zip(blocks, solids, strict=True))]
    groups, tilted, alone = [], 0, 0
    for together in overlapping([_z_limits(block) for block in blocks]):
        group = [one for number in together if (one := held[number]) is not None]
        if len(group) < len(together):
            tilted += len(together)
        elif len(group) == 1:
            alone += 1
        else:
            groups.append(group)
    reasons = [f"{count} block{'s' * (count > 1)} {why}" for count, why in (
        (tilted, "at heights where a block is tilted"), (alone, "alone at their heights")) if count]
    if not groups:
        return (), tuple(reasons)
    holder = magnet.study.holder
    found, more = plates(groups, holder or Holder(), magnet.iron,
                         None if holder is None else magnet.name)
    return found, (*reasons, *more)


def _z_limits(block: MagnetBlock) -> tuple[float, float]:
    """Return the lowest and the highest z of a block in m."""
    corners = np.array([edge.start for edge in block.outline])
    z = block.from_frame(at_heights(corners, block.z_min, block.z_max))[:, 2]
    return float(z.min()), float(z.max())


def _of_table(
    magnet: Magnet, table: BlockTable | None
) -> tuple[dict[int, str], dict[int, tuple[float, float, float]]]:
    """Return serial number and turn of the block in every slot, by the number of the slot from 0.

    The table names the place that a block was made for.

    MeasurementError if the table does not fit the study, or says nothing about places.
    """
    if table is None:
        return {}, {}
    if not table.ring.any():
        raise MeasurementError(must_be(
            "ring and slot", table.source, "given, to know which block goes where", "none",
            "halbach-fe sort assigns blocks to slots: give its blocks.sorted.csv."))
    prior_from_blocks(magnet, table)  # which refuses blocks of another magnet
    row_of = {place: row for row, place in enumerate(table.places)}
    rows = {number: row_of[magnet.blocks[source].place]
            for number, (source, matrix) in enumerate(mountings(magnet)) if matrix.any()}
    turns = {} if table.turn_deg is None else {
        number: (float(x), float(y), float(z)) for number, row in rows.items()
        for x, y, z in table.turn_deg[[row]]}
    return {number: table.serial[row] for number, row in rows.items()}, turns


def _measured_axes(
    magnet: Magnet, turns: Mapping[int, tuple[float, float, float]]
) -> list[Floats | None]:
    """Return the axes of every block in which its moment is measured, as columns (3, 3).

    They are the axes of its shape, which turn with a block that is mounted elsewhere or rotated,
    or that is turned in its place (``turns``, by its number).
    """
    meant, found = as_meant(magnet).blocks, []
    for number, (source, matrix) in enumerate(mountings(magnet)):
        factor = np.cbrt(np.linalg.det(matrix))
        own = Rotation.from_rotvec(turns.get(number, np.zeros(3)), degrees=True).as_matrix()
        found.append(matrix / factor @ meant[source].shape_axes @ own if factor > 0 else None)
    return found


def _kinds(
    table: dict[str, list[Any]], blocks: Sequence[MagnetBlock]
) -> tuple[tuple[Kind, ...], list[int]]:
    """Return the kinds of blocks, and the number of the kind (from 0) of every block."""
    shapes = {column for sizes in SIZES.values() for column in sizes} | {"shape", "size_z_m"}
    found: dict[object, Kind] = {}
    keys = []
    for number, block in enumerate(blocks):
        sizes = {column: values[number] for column, values in table.items()
                 if column in shapes and values[number] is not None}
        material = table["material"][number] if "material" in table else None
        direction = block.axes.T @ block.easy_axis * np.sign(block.remanence)
        new = Kind(len(found) + 1, sizes, Prism(block.outline, block.z_min, block.z_max), direction,
                   abs(block.remanence), material, 0)
        keys.append(new.identity)
        kind = found.get(new.identity, new)
        found[new.identity] = replace(kind, count=kind.count + 1)
    order = {key: number for number, key in enumerate(found)}
    return tuple(found.values()), [order[key] for key in keys]


def _rounded(value: object) -> object:
    """Return a size to 0.1 µm, or an outline of such."""
    if isinstance(value, float):
        return round(value, 7)
    return tuple(map(_rounded, value)) if isinstance(value, tuple) else value
