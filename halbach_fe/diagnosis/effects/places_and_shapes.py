"""Effects on the shape of rings, and on where the rings and blocks are, as rows.

The signature of a shape is the difference that it makes to the blocks in vacuum, divided by a step
within which that is linear. Rings that move keep their shape: their signature is the sum over the
blocks that move.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    blocks_at,
    changed,
    each_block,
    each_ring,
    together,
    unchecked_blocks,
    with_array,
    with_exceptions,
    with_remanence,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.array_layout import ring_limits
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.study.array_keys import Array, BlockException
from halbach_fe.study.model import Study

X, Y, Z = np.eye(3)
OWN_AXES = ("radial", "azimuthal", "axial")

TOUCHING_M = 1e-9
"""Distance along z up to which rings touch: sums of their lengths differ by rounding."""


@dataclass(frozen=True, eq=False)
class ShapeRow(Effect):
    """Keys of the array differ, in all equal rings alike, or in one of rings that the study lists.

    ``keys`` returns them for an array of equal rings, by the amplitude.
    """

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    step: float
    keys: Callable[[Array, float], dict[str, Any]]
    dimensions: tuple[int, ...] = (2, 3)

    def places(self, study: Study) -> Sequence[Place]:
        array = study.array
        if study.dimension not in self.dimensions or array.free_blocks is not None:
            return []
        return [Place()] if array.is_uniform else [
            Place(ring) for ring in range(1, array.rings + 1)
            if array.of_ring(ring).remanence_T is not None]  # a moment holds for a volume

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return changed(nominal, self.apply(nominal.study, place, [self.step]))[None] / self.step

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        study, amount = with_remanence(study), float(values[0])
        if not place.ring:
            return with_array(study, **self.keys(study.array, amount))
        rings, keys = list(study.array.ring), self.keys(study.array.of_ring(place.ring), amount)
        rings[place.ring - 1] = rings[place.ring - 1].with_(**keys)
        # what all rings state is for the array what the first of them states
        first = {key: value for key, value in keys.items() if place.ring == 1 and all(
            getattr(ring, key) is not None for ring in study.array.ring)}
        return with_array(study, ring=tuple(rings), **first)


@dataclass(frozen=True, eq=False)
class MoveRow(Effect):
    """Blocks move as they are.

    ``by_block`` returns the change (k, n, 3) in T per unit of each amplitude that a block, by its
    number, makes; ``moved`` the exceptions by the amplitudes. Blocks at the place move, or all.
    Of the places, ``few`` that are evenly chosen are compared first, or all.
    """

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    where: Callable[[Study], Sequence[Place]]
    by_block: Callable[[NominalFields, Place, int], Sequence[Floats]]
    moved: Callable[[Study, Place, Sequence[float]], Sequence[BlockException]]
    defining: tuple[str, ...] = ()
    relative_odds: float = 1.0
    moves_all: bool = False
    few: int = 0

    def places(self, study: Study) -> Sequence[Place]:
        return self.where(study)

    def representatives(self, places: Sequence[Place]) -> Sequence[Place]:
        return places[::max(1, len(places) // self.few)] if self.few else places

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        moving = range(len(nominal.blocks)) if self.moves_all else blocks_at(nominal.blocks, place)
        return np.sum([self.by_block(nominal, place, number) for number in moving], axis=0)

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return with_exceptions(study, self.moved(study, place, [float(value) for value in values]))


def _narrower(array: Array, gap: float) -> dict[str, Any]:
    """Leave a gap between neighbours, which of sectors is measured at the mean radius."""
    block, middle = array.block, (array.inner_radius_m + array.outer_radius_m) / 2
    key, change = {"sector": ("angular_gap_deg", float(np.degrees(gap / middle))),
                   "trapezoid": ("side_gap_m", gap)}.get(block.shape, ("width_m", -gap))
    return {"block": block.with_(**{key: getattr(block, key) + change})}


def _longer(array: Array, more: float) -> dict[str, Any]:
    """Lengthen all rings alike."""
    assert array.ring_length_m is not None  # in three dimensions a study has a ring length
    return {"ring_length_m": array.ring_length_m + more / array.rings}


def _along(*directions: Floats) -> Callable[[NominalFields, Place, int], list[Floats]]:
    """Return what a block that moves along each of some directions (3,) changes."""
    return lambda nominal, place, number: [
        nominal.block_translation_derivative(number, direction) for direction in directions]


def _outwards(nominal: NominalFields, place: Place, number: int) -> list[Floats]:
    """Return what a block changes that moves away from the axis."""
    angle = np.radians(nominal.blocks[number].angle_deg)
    return _along(np.cos(angle) * X + np.sin(angle) * Y)(nominal, place, number)


def _out_and_in(nominal: NominalFields, place: Place, number: int) -> list[Floats]:
    """Return what a block changes whose ring is pressed oval, along x and between the axes."""
    (change,) = _outwards(nominal, place, number)
    return [part * change for part in _oval(nominal.blocks[number].angle_deg)]


def _oval(angle_deg: float) -> tuple[float, float]:
    """Return how far a block is moved outwards by an oval along x, and by one at 45 degrees."""
    turn = 2 * np.radians(angle_deg)
    return float(np.cos(turn)), float(np.sin(turn))


def _ovals_of(study: Study, place: Place, values: Sequence[float]) -> list[BlockException]:
    """Return the displacements of the blocks of oval rings, by slots if the rings are equal."""
    blocks = unchecked_blocks(study)
    return [BlockException(**where, displacement_m=(float(np.dot(values, _oval(angle))), 0.0, 0.0))
            for where, angle in together(blocks, {
                number: block.angle_deg for number, block in enumerate(blocks)})]


def _own_axes(nominal: NominalFields, number: int) -> Floats:
    """Return the radial, azimuthal and axial direction (3, 3) of a block, by rows."""
    return rotation_matrix((0.0, 0.0, np.radians(nominal.blocks[number].angle_deg))).T


def _along_its_axes(nominal: NominalFields, place: Place, number: int) -> list[Floats]:
    """Return what a block changes that moves along its own axes."""
    return _along(*_own_axes(nominal, number))(nominal, place, number)


def _about_its_axes(nominal: NominalFields, place: Place, number: int) -> list[Floats]:
    """Return what a block changes that turns about its own axes through its centre."""
    return [_turning(nominal, number, axis, nominal.blocks[number].mounted_middle)
            for axis in _own_axes(nominal, number)]


def _about_z(nominal: NominalFields, place: Place, number: int) -> list[Floats]:
    """Return what a block changes that turns about the magnet's axis."""
    return [_turning(nominal, number, Z, np.zeros(3))]


def _about_its_middle(nominal: NominalFields, place: Place, number: int) -> list[Floats]:
    """Return what a block changes that tilts about x and y with its ring."""
    return [_turning(nominal, number, axis, nominal.blocks[number].middle * Z) for axis in (X, Y)]


def _turning(nominal: NominalFields, number: int, axis: Floats, centre: Floats) -> Floats:
    """Return what a block changes per rad by which an exception rotates it about a point.

    Rotation vectors add up: a block that is rotated already turns about another axis.
    """
    block, step = nominal.blocks[number], 1e-6
    more = Rotation.from_rotvec(block.rotation_rad + step * axis)
    turn = (more * Rotation.from_rotvec(block.rotation_rad).inv()).as_rotvec() / step
    there = block.mounted_middle
    return (nominal.block_rotation_derivative(number, turn, there)
            + nominal.block_translation_derivative(number, np.cross(axis, there - centre)))


def _several_rings(study: Study) -> list[Place]:
    """Return a place for every ring, unless there is only one: that is a displaced mapper."""
    return rings if len(rings := each_ring(study)) > 1 else []


def _seams(study: Study) -> list[Place]:
    """Return a place for every plane across the axis that passes between rings, none in two
    dimensions. Its ring is the first one below; rings of all layers are on either side.
    """
    if study.dimension == 2 or study.array.free_blocks is not None:
        return []
    bottom, top = np.array(ring_limits(study.array, study.dimension)).T
    found: dict[bytes, Place] = {}
    for ring, plane in enumerate(top, start=1):
        beyond = bottom > plane - TOUCHING_M
        if beyond.any() and (beyond | (top < plane + TOUCHING_M)).all():
            found.setdefault(beyond.tobytes(), Place(ring))
    return list(found.values())


def _apart(study: Study, place: Place) -> Floats:
    """Return the fractions (rings,) of the gap above a ring by which rings move along z.

    The outer side of a gap moves away from the middle of the magnet, both of one in the middle.
    """
    bottom, top = np.array(ring_limits(study.array, study.dimension)).T
    beyond = bottom > top[place.ring - 1] - TOUCHING_M
    height = top[~beyond].max() + bottom[beyond].min() - top.max() - bottom.min()
    return beyond - (0.5 if abs(height) < TOUCHING_M else 1.0 if height < 0 else 0.0)


def _apart_and_along(nominal: NominalFields, place: Place, number: int) -> list[Floats]:
    """Return what a block changes by a gap, and by a displacement of all blocks along z."""
    (change,) = _along(Z)(nominal, place, number)
    return [_apart(nominal.study, place)[nominal.blocks[number].ring - 1] * change, change]


def _gap_of(study: Study, place: Place, values: Sequence[float]) -> list[BlockException]:
    """Return the displacements of the rings that a gap and a common shift move."""
    gap, shift = values
    return [BlockException(ring=ring, shift_m=(0.0, 0.0, share * gap + shift))
            for ring, share in enumerate(_apart(study, place).tolist(), start=1)]


def _planes(study: Study) -> list[Place]:
    """Return the planes through the axis that pass between the blocks of every ring, none in two
    dimensions; ``at_m`` is the angle in degrees of the normal.
    """
    if study.dimension == 2:
        return []
    blocks = [block for block in unchecked_blocks(study) if block.remanence]
    middles = np.array([block.middle[:2] for block in blocks])
    counts = Counter(block.ring for block in blocks)
    # distance from the plane of a block beside it, at least: half of that of a regular ring
    least = np.sin(np.pi / 2 / np.array([counts[block.ring] for block in blocks]))
    first = [block.angle_deg for block in blocks if block.ring == blocks[0].ring]
    pitch, on_axis_m = 360 / len(first), 1e-9
    angles = sorted({round((angle + pitch / 2 + 90) % 180, 6) for angle in first})
    radius = np.hypot(*middles.T)
    return [Place(at_m=(angle,), words=f"at the plane whose normal is at {angle:.4g}°")
            for angle in angles if radius.min() > on_axis_m and (
                np.abs(middles @ _in_plane(angle)[0][:2]) > least * radius).all()]


def _in_plane(angle_deg: float) -> Floats:
    """Return normal, direction across the axis, and axis (3, 3) of a plane through the axis."""
    angle = np.radians(angle_deg)
    normal = np.cos(angle) * X + np.sin(angle) * Y
    return np.array([normal, np.cross(Z, normal), Z])


def _side(middle: Floats, place: Place) -> float:
    """Return 1/2 of a block beyond a plane, and -1/2 of others."""
    return 0.5 if middle @ _in_plane(place.at_m[0])[0] > 0 else -0.5


def _half(nominal: NominalFields, place: Place, number: int) -> list[Floats]:
    """Return what a block changes that moves with its half of the magnet."""
    side = _side(nominal.blocks[number].middle, place)
    return [side * change for change in _along(*_in_plane(place.at_m[0]))(nominal, place, number)]


def _halves_of(study: Study, place: Place, values: Sequence[float]) -> list[BlockException]:
    """Return the displacements of both halves, by slots if these are the same in all rings."""
    shift, blocks = np.array(values) @ _in_plane(place.at_m[0]), unchecked_blocks(study)
    sides = {number: _side(block.middle, place) for number, block in enumerate(blocks)}
    return [BlockException(**where, shift_m=tuple((side * shift).tolist()))
            for where, side in together(blocks, sides)]


BLOCK_DISPLACED = MoveRow(
    "block_displaced", "displacement of a block", tuple(
        Parameter(name, "m", 2e-4) for name in OWN_AXES), each_block, _along_its_axes,
    lambda study, place, values: [BlockException(
        ring=place.ring, slot=place.slot, displacement_m=(values[0], values[1], values[2]))])

EFFECTS = (
    BLOCK_DISPLACED,
    MoveRow("block_turned", "rotation of a block", tuple(
        Parameter(name, "rad", 0.02) for name in OWN_AXES), each_block, _about_its_axes,
            lambda study, place, values: [BlockException(
                ring=place.ring, slot=place.slot,
                rotation_deg=tuple(np.degrees(values).tolist()))]),
    ShapeRow("inner_radius", "inner radius of the blocks", (Parameter("difference", "m", 3e-4),),
             1e-4, lambda array, more: {"inner_radius_m": array.inner_radius_m + more}),
    ShapeRow("length", "length of the magnet", (Parameter("difference", "m", 1e-3),), 1e-3,
             _longer, dimensions=(3,)),
    ShapeRow("azimuthal_gap", "gaps between neighbouring blocks", (Parameter("gap", "m", 2e-4),),
             1e-4, _narrower),
    MoveRow("radial_gap", "common radial displacement of the blocks",
            (Parameter("gap", "m", 2e-4, minimum=0.0),),  # inwards the blocks would overlap
            lambda study: [Place()], _outwards, lambda study, place, values: [
                BlockException(displacement_m=(values[0], 0.0, 0.0))]),
    MoveRow("ring_shifted", "displacement of a ring across the axis",
            (Parameter("x", "m", 3e-4), Parameter("y", "m", 3e-4)), each_ring, _along(X, Y),
            lambda study, place, values: [
                BlockException(ring=place.ring, shift_m=(values[0], values[1], 0.0))]),
    # blocks of a table at one height are a ring; all rings together are a displaced mapper
    MoveRow("ring_shifted_along", "displacement of a ring along the axis",
            (Parameter("z", "m", 3e-4),), _several_rings, _along(Z),
            lambda study, place, values: [
                BlockException(ring=place.ring, shift_m=(0.0, 0.0, values[0]))]),
    MoveRow("ring_twisted", "rotation of a ring about the axis",
            (Parameter("angle", "rad", 2e-3),), each_ring, _about_z,
            lambda study, place, values: [
                BlockException(ring=place.ring, twist_deg=float(np.degrees(values[0])))]),
    # a shim of 0.1 mm at one side of a ring of 10 cm is 1 mrad
    MoveRow("ring_tilted", "tilt of a ring", (
        Parameter("x", "rad", 2e-3), Parameter("y", "rad", 2e-3)), _several_rings,
            _about_its_middle, lambda study, place, values: [BlockException(
                ring=place.ring, tilt_deg=tuple(np.degrees(values).tolist()))]),
    MoveRow("rings_oval", "oval rings", (Parameter("along x", "m", 2e-4),
                                         Parameter("at 45 degrees", "m", 2e-4)),
            lambda study: [Place()], _out_and_in, _ovals_of, moves_all=True),
    # of a magnet that opens; what both halves share is a displaced mapper. Planes that are 30
    # degrees apart leave five of six blocks in the same half.
    MoveRow("halves_apart", "displacement of half the magnet", (
        Parameter("apart", "m", 2e-4), Parameter("sideways", "m", 2e-4),
        Parameter("axial", "m", 2e-4)), _planes, _half, _halves_of, moves_all=True,
            few=6),
    # Which rings a gap has moved depends on where the others are held. Therefore all of them may
    # have moved along z as well, which alone is no gap.
    MoveRow("ring_gap", "gap between two rings",
            (Parameter("gap", "m", 2e-4), Parameter("shift", "m", 1e-4)),
            _seams, _apart_and_along, _gap_of, defining=("gap",), moves_all=True),
    # One map of a magnet without iron cannot tell that from a displaced mapper; several maps, iron
    # or other sources can. A stack of ten rings that is held at one end instead of its middle is
    # displaced by some tenths of a millimetre. Magnets are assembled once, while every map has a
    # mapper that was set up for it: hence the odds.
    MoveRow("magnet_shifted", "all blocks displaced along z together", (Parameter("z", "m", 5e-4),),
            lambda study: [Place()] if study.dimension == 3 else [], _along(Z),
            lambda study, place, values: [BlockException(shift_m=(0.0, 0.0, values[0]))],
            relative_odds=1 / 20))
