"""Blocks in another slot or turn than meant, the slots into which they can be moved, and the
rotations that leave a block's shape unchanged.

A sector or a trapezoid can be turned by 180 degrees about its radial axis. A cuboid can be turned
by 180 degrees about each of its axes, and by 90 degrees about an axis across which the two sides
are equal. A block fits a slot if it has the slot's shape, and its nominal magnetization points in
the direction that the design requires there, after the block is moved to the slot (in the
orientation of its shape there) and turned by one of these rotations.

The "own axes" of a block are the axes of its shape: radial (or along the design magnetization),
transverse and along z.

The turns and moves after which blocks fit a slot are found by their shapes, so that they exist for
rings and free blocks alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Bools, Floats, Ints, unit_circle
from halbach_fe.geometry.array_layout import exceptions_of, magnetization_factor, nominal_blocks
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z, rotation_matrix
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import outline_contains
from halbach_fe.geometry.symmetry import corners_of, distance_apart
from halbach_fe.study.array_keys import MAX_FACTOR, Array, BlockException

LARGEST_ANGLE = np.radians(2.0)
"""Largest angle in rad between the nominal magnetization of a block that fits a slot and the
direction that the design requires there. Rotations in the exceptions of a study are smaller. The
effect of a move on the field is computed from the inferred magnetizations, whatever this angle
is."""

SAME_SIZE = 1e-6
"""Relative difference up to which two sides of a cuboid count as equal."""


@dataclass(frozen=True)
class Mounts:
    """Slots of a magnet, and the data that decide which blocks fit them."""

    places: tuple[tuple[int, int], ...]
    """Ring and slot of each slot, both counted from 1. As (ring, slot)."""
    frames: Floats
    """Rotations from the own axes of a slot's shape to the axes of the magnet.
    Shape (slots, 3, 3)."""
    turns: Floats
    """Rotations of a block, in its own axes, that leave some shape unchanged. The first is the
    identity. Shape (turns, 3, 3)."""
    allowed: Bools
    """Which of them leave the shape of the block in a slot unchanged. Shape (turns, slots)."""
    designed: Floats
    """Directions of the design magnetization of each slot, in own axes. Shape (slots, 3)."""
    current: Floats
    """Directions of the nominal magnetization of the block that is in each slot now, in own axes; 0
    where the block is missing. Shape (slots, 3)."""
    kinds: Ints
    current_kinds: Ints
    """Kind of block that the design requires in each slot, and kind of the block that is there now.
    Blocks of the same shape, remanence and recoil permeabilities are of the same kind.
    Shape (slots,)."""

    def fits(self, directions: Floats, kinds: Ints) -> Bools:
        """Return which blocks fit which slots, shape (turns, slots, blocks).

        Parameters
        ----------
        directions : ndarray, shape (blocks, 3)
            Directions of the nominal magnetizations of the blocks, in own axes.
        kinds : ndarray of int, shape (blocks,)
        """
        same_kind = self.kinds[:, None] == kinds
        return np.array([
            same_kind & allowed[:, None]
            & (self.designed @ turn @ directions.T > np.cos(LARGEST_ANGLE))
            for turn, allowed in zip(self.turns, self.allowed, strict=True)])

    def carried(self, to: int, turn: int) -> Floats:
        """Return the rotation (3, 3) from the own axes of a moved block to those of the magnet.

        ``to`` is the number of the slot, ``turn`` that of the turn (see `turns`).
        """
        return np.asarray(self.frames[to] @ self.turns[turn])

    def turn_deg(self, turn: int) -> tuple[float, float, float]:
        """Return a turn as a rotation vector along the block's own axes, in degrees."""
        return rotation_deg(self.turns[turn])


def mounts_of(magnet: Magnet) -> Mounts:
    """Return the slots of a magnet with its present blocks."""
    meant, built = as_meant(magnet).blocks, magnet.blocks
    frames = np.array([block.shape_axes for block in meant])
    shapes, own_turns = _shapes(meant)
    kinds = _kinds(meant, shapes)
    sources = np.array([source for source, _ in mountings(magnet)])
    cube = (1.0, 1.0, 1.0)  # sides of a cube, which all other blocks' turns leave unchanged as well
    every = shape_turns(cube)
    found = np.array([[any(np.array_equal(turn, own) for own in turns) for turns in own_turns]
                      for turn in every])
    some = found.any(axis=1)
    return Mounts(
        tuple(block.place for block in meant), frames, every[some],
        found[some][:, shapes], _directions(meant, frames), _directions(built, frames),
        kinds, kinds[sources])


def shape_turns(sides: tuple[float, float, float] | None) -> Floats:
    """Return the rotations (n, 3, 3) that leave a shape unchanged; the first is the identity.

    ``sides``: sides of a cuboid; None for a shape whose inner and outer face differ, such as a
    sector.
    """
    turns = Rotation.create_group("O").as_matrix().round()
    if sides is None:
        turns = turns[[np.array_equal(turn, np.diag(np.diag(turn))) and turn[0, 0] == 1
                       for turn in turns]]
    else:
        turned = np.abs(turns) @ np.array(sides)
        turns = turns[np.isclose(turned, sides, SAME_SIZE, 0).all(axis=1)]
    angle = np.linalg.norm(Rotation.from_matrix(turns).as_rotvec(), axis=1)
    return np.asarray(turns[np.argsort(angle, kind="stable")])


def _shapes(blocks: Sequence[MagnetBlock]) -> tuple[Ints, list[Floats]]:
    """Return equal numbers for blocks of equal shape, (blocks,), and the turns of each shape."""
    known: list[tuple[Floats, tuple[bool, ...]]] = []
    numbers, turns = np.empty(len(blocks), int), []
    for place, block in enumerate(blocks):
        corners, arcs = _outline_corners(block), tuple(edge.arc for edge in block.outline)
        number = next((number for number, (other, others) in enumerate(known) if arcs == others
                       and np.allclose(corners, other, 0, SAME_SIZE * np.ptp(corners[:-1]))),
                      len(known))
        if number == len(known):
            known.append((corners, arcs))
            turns.append(_turns_of(corners, any(arcs)))
        numbers[place] = number
    return numbers, turns


def _outline_corners(block: MagnetBlock) -> Floats:
    """Return the corners (n + 1, 2) of a block's outline in its own axes, about their mean, in m.

    The last row is its length along z; a block of a cross-section is longer than it is wide.
    """
    corners = np.array([[*edge.start, 0.0] for edge in block.outline])
    if block.label is None:
        corners = corners @ block.shape_axes
    corners -= corners.mean(axis=0)
    length = 2 * float(np.ptp(corners)) if np.isinf(block.z_max) else block.z_max - block.z_min
    return np.vstack([corners[:, :2], [length, 0.0]])


def _turns_of(corners: Floats, arcs: bool) -> Floats:
    """Return the turns (n, 3, 3) that leave a shape unchanged, from its `_outline_corners`."""
    outline, length = corners[:-1], float(corners[-1, 0])
    tolerance = SAME_SIZE * float(np.ptp(outline))
    half = np.abs(outline).max(axis=0)
    if len(outline) == 4 and not arcs and np.allclose(np.abs(outline), half, 0, tolerance):
        return shape_turns((2 * float(half[0]), 2 * float(half[1]), length))
    mirrored = outline * [1.0, -1.0]
    if all(np.linalg.norm(outline - corner, axis=1).min() < tolerance for corner in mirrored):
        return shape_turns(None)
    return np.eye(3)[None]


def _directions(blocks: Sequence[MagnetBlock], frames: Floats) -> Floats:
    """Return directions of the nominal magnetizations in own axes; 0 for missing blocks."""
    vectors = np.array([block.magnetization for block in blocks])
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.einsum("nji,nj->ni", frames, vectors / np.where(size > 0, size, 1.0))


def _kinds(blocks: Sequence[MagnetBlock], shapes: Ints) -> Ints:
    """Return equal numbers for blocks of equal shape, remanence and recoil permeabilities."""
    kinds = [(shape, *(float(f"{value:.9g}") for value in properties(block)[:3]))
             for block, shape in zip(blocks, shapes.tolist(), strict=True)]
    numbers = {kind: number for number, kind in enumerate(dict.fromkeys(kinds))}
    return np.array([numbers[kind] for kind in kinds])


# --- mounted otherwise than meant, and moved to another slot

def mountings(magnet: Magnet) -> list[tuple[int, Floats]]:
    """Return by block its intended place, and how its magnetization follows from the one there.

    Returns
    -------
    list of (int, ndarray)
        Number of the place (from 0, in the order of `Magnet.blocks`) that the block was made for,
        and the matrix (3, 3) that turns the magnetization it would have there into the
        magnetization that it has where it is mounted. The matrix is 0 for a missing block.
    """
    of_block, found = exceptions_of(magnet.array), []
    for block in magnet.blocks:
        ring, slot = block.mounted_from or block.place
        number = magnet.number_of(ring, slot)
        turn = rotation_matrix(block.rotation_rad) @ block.carried_from(magnet.blocks[number])
        factor = magnetization_factor(of_block(block.ring, block.slot))
        found.append((number, factor * turn))
    return found


def as_meant(magnet: Magnet) -> Magnet:
    """Return the magnet with every block present, unrotated, and in the slot it was made for."""
    meant = {"mounted_from": None, "magnetization_factor": 1.0, "rotation_deg": (0.0, 0.0, 0.0),
             "twist_deg": 0.0, "tilt_deg": (0.0, 0.0)}
    return magnet.with_(array__exceptions=tuple(
        exception.with_(**meant) for exception in magnet.array.exceptions))


def is_as_meant(block: MagnetBlock, meant: MagnetBlock, angle: float) -> bool:
    """Tell whether a block has the magnetization and the shape that are meant for its slot, however
    it came there.

    They may differ by what a turn by ``angle`` in rad makes; ``meant`` is the block of `as_meant`.
    """
    turned = np.linalg.norm(np.cross(block.magnetization, meant.magnetization))
    if np.arctan2(turned, np.dot(block.magnetization, meant.magnetization)) > angle:
        return False
    size = 2 if np.isinf(block.z_max) else 3  # a block of a cross-section has no ends
    corners, others = (each[:, :size] - each[:, :size].mean(axis=0)
                       for each in (corners_of(block), corners_of(meant)))
    chord = 2 * np.sin(angle / 2) * np.linalg.norm(others, axis=1).max()
    return distance_apart(corners, others) <= chord


def rotation_deg(turn: Floats) -> tuple[float, float, float]:
    """Return the rotation vector in degrees of a matrix (3, 3), rounded to 1e-9 degrees."""
    x, y, z = (np.degrees(Rotation.from_matrix(turn).as_rotvec()).round(9) + 0.0).tolist()
    return x, y, z


PARALLEL = 1e-3
"""Difference of unit vectors up to which two directions of a block are one."""

OF_A_BLOCK = ("remanence_T", "recoil_permeability", "recoil_permeability_across",
              "magnetization_gradient", "inner_corner_loss")
"""Keys of an exception that a block takes along, but for its factor; in the order of
`properties`."""


def remounted(
    magnet: Magnet, moved: Iterable[tuple[int, int, Floats]], renewed: Iterable[int] = ()
) -> Magnet | None:
    """Return the magnet after blocks are moved.

    The moves are entered in the study as exceptions (``mounted_from`` and ``rotation_deg``), in
    place of what exceptions said of how these blocks were mounted before. A block takes the
    exceptions of its material and strength along; those of a slot's position stay.

    Parameters
    ----------
    moved : iterable of (int, int, ndarray)
        For each moved block, its new and its old slot (counted from 0, ring by ring), and the
        matrix (3, 3) that maps its magnetization in the old slot to that in the new slot, along
        the axes of the magnet.
    renewed : iterable of int, optional
        Slots (counted from 0) that new blocks are put into, as they are designed.

    Returns
    -------
    Magnet or None
        None if the exceptions of a study cannot express the moves.
    """
    before, old, of_block = mountings(magnet), magnet.blocks, exceptions_of(magnet.array)
    moved, nominal = list(moved), nominal_blocks(magnet.array, magnet.dimension)
    kept = _of_positions(magnet, [*(to for to, _, _ in moved), *renewed])
    still, of_slot = magnet.with_(array__exceptions=kept).blocks, exceptions_of(
        magnet.array.with_(exceptions=kept))
    # tolerance for matrices and properties that must be equal; rounding errors are 1e-15
    exact = 1e-9
    exceptions, expected = [], {}
    for to, source, matrix in moved:
        meant, earlier = before[source]
        total = matrix @ earlier
        factor, left = (magnetization_factor(of(block.ring, block.slot)) for of, block in (
            (of_block, old[source]), (of_slot, still[to])))
        here = rotation_about_z(np.radians(old[to].angle_deg))  # axes of `rotation_deg`
        if abs(factor) > MAX_FACTOR * abs(left):
            return None
        changed: dict[str, Any] = {"magnetization_factor": factor / left if left else 1.0}
        if factor:
            carried = old[to].carried_from(old[meant])
            turned = total / factor @ carried.T
            vector = np.array(rotation_deg(here.T @ turned @ here)) - np.degrees(
                here.T @ still[to].rotation_rad)
            changed |= {"rotation_deg": vector.round(9) + 0.0,
                        **_taken_along(old[source], factor, still[to], left)}
            direction = turned.T @ matrix @ old[source].easy_axis
            if not np.allclose(direction, carried @ nominal[meant].easy_axis, 0, exact):
                changed["magnetization_angle_deg"] = np.degrees(
                    np.arctan2(direction[1], direction[0])).round(9)
        exceptions.append(BlockException.model_validate({
            "ring": old[to].ring, "slot": old[to].slot,
            "mounted_from": old[meant].place, **changed}))
        expected[to] = source, meant, total, matrix @ old[source].polarization
    after_all = magnet.with_(array__exceptions=(*kept, *exceptions))
    after, new = mountings(after_all), after_all.blocks
    for to, (source, meant, total, polarization) in expected.items():
        same = after[to][0] == meant and np.allclose(after[to][1], total, 0, exact) and np.allclose(
            new[to].polarization, polarization, 0, exact)
        if not same or new[to].displacement_m != old[to].displacement_m or not np.allclose(
                properties(new[to]), properties(old[source]), exact, 0):
            return None
    return after_all


def _of_positions(magnet: Magnet, slots: Iterable[int]) -> tuple[BlockException, ...]:
    """Return the exceptions of a magnet, without what those of single slots (counted from 0) say of
    the block that is there and how it is mounted.
    """
    if any(name.startswith("array.exceptions") for one in magnet.study.uncertain
           for name in one.change):  # by their numbers
        return magnet.array.exceptions
    places = {magnet.blocks[slot].place for slot in slots}
    left = {name: field.default for name, field in BlockException.model_fields.items()
            if name in (*OF_A_BLOCK, "magnetization_factor", "mounted_from", "rotation_deg")}
    kept = [one.with_(**left) if magnet.array.block_of(one) in places else one
            for one in magnet.array.exceptions]
    return tuple(one for one in kept
                 if one.model_dump(exclude_defaults=True).keys() - {"ring", "slot"})


def _taken_along(
    block: MagnetBlock, factor: float, there: MagnetBlock, left: float
) -> dict[str, float]:
    """Return what an exception says of a moved block where it is other than the block of its slot.

    ``factor`` and ``left`` are the magnetization factors of the two, which are not part of it.
    """
    own, other = (np.array(properties(each)) / [divisor, 1.0, 1.0, 1.0, 1.0]
                  for each, divisor in ((block, factor), (there, left)))
    differs = ~np.isclose(own, other, 1e-9, 0)
    differs[2] |= differs[1]  # the permeability alone holds in all directions
    return {name: value for name, value, unlike in zip(
        OF_A_BLOCK, own.tolist(), differs.tolist(), strict=True) if unlike}


def properties(block: MagnetBlock) -> tuple[float, ...]:
    """Return the properties that a block keeps when it is moved."""
    return (block.remanence, block.recoil_permeability, block.recoil_permeability_across,
            block.gradient, block.corner_loss)


Turn = tuple[tuple[float, float, float], ...]
"""A rotation matrix, row by row."""


@dataclass(frozen=True)
class Move:
    """A move of many blocks from slot to slot."""

    words: str
    """What is moved, and how."""
    pairs: tuple[tuple[int, int], ...]
    """Number from 0 of a block's slot, and of the slot from which the block that is there comes."""
    turn: Turn | None
    """Rotation of these blocks; None if each turns with the shape of its slot, see
    `MagnetBlock.carried_from`."""


@lru_cache(maxsize=4096)
def turns_in_slot(block: MagnetBlock) -> tuple[Turn, ...]:
    """Return the turns of a block about its middle after which it fits its slot.

    Of those that turn its magnetization into the same direction the smallest is returned, and none
    that leaves it as it is. Turns by right angles about the axes of the shape are tried, and those
    from edge to edge.
    """
    axes = block.shape_axes
    tried = list(Rotation.create_group("O"))
    edges = len(block.outline)
    most_edges = 12  # number of edges of an outline up to which turns from edge to edge are tried
    if edges <= most_edges:
        tried += [Rotation.from_euler("z", 2 * np.pi * k / edges) for k in range(1, edges)]
    found: list[tuple[Turn, Floats]] = []
    corners = corners_of(block)
    for turn in sorted(tried, key=lambda each: float(each.magnitude())):
        matrix = axes @ turn.as_matrix() @ axes.T
        direction = matrix @ np.array(block.easy_axis)
        known = [np.array(block.easy_axis), *(each for _, each in found)]
        nearest = min(np.linalg.norm(direction - each) for each in known)
        if nearest > PARALLEL and _fits(
                block, _shrink(corners) @ matrix.T + corners.mean(axis=0)):
            found.append((_matrix_rows(matrix), direction))
    return tuple(turn for turn, _ in found)


def turns_over(block: MagnetBlock) -> tuple[Turn, ...]:
    """Return the half turns of a block about its middle after which it fits its slot and is
    magnetized the opposite way: about axes of its shape, and of a round one about any.
    """
    easy, corners = np.array(block.easy_axis), corners_of(block)
    found: list[Turn] = []
    for axis in (*block.shape_axes.T, np.cross(easy, block.shape_axes[:, 2])):
        size = float(np.linalg.norm(axis))
        if size < PARALLEL or abs(axis @ easy) > PARALLEL:
            continue
        matrix = 2 * np.outer(axis, axis) / size**2 - np.eye(3)
        if _fits(block, _shrink(corners) @ matrix.T + corners.mean(axis=0)) and not any(
                np.allclose(matrix, each, 0, PARALLEL) for each in found):
            found.append(_matrix_rows(matrix))
    return tuple(found)


def moves_of_rings(magnet: Magnet, kind: str) -> dict[str, Move]:
    """Return the moves of rings, and of half of them, after which every block fits its slot.

    ``kind``: ``exchanged``, ``turned`` (from slot to slot about z; where slots are turned otherwise
    than their places, also the blocks without their holder) or ``upside down``.
    """
    return _moves(_drop_exceptions(magnet.array), magnet.dimension, kind)


def _drop_exceptions(array: Array) -> Array:
    """Return an array without its exceptions, whose blocks are all in their slots."""
    return array.with_(exceptions=()) if array.exceptions else array


@lru_cache(maxsize=32)
def _moves(array: Array, dimension: int, kind: str) -> dict[str, Move]:
    blocks = nominal_blocks(array, dimension)
    every: dict[int, list[int]] = {}
    for number, block in enumerate(blocks):
        every.setdefault(block.ring, []).append(number)
    groups = {f"ring {ring}": numbers for ring, numbers in every.items() if len(numbers) > 2}
    # numbers of blocks in a ring, and of rings, up to which moves of rings are tried
    most_in_ring, most_rings = 64, 40
    if dimension == 2 or not 1 <= len(groups) <= most_rings or max(
            map(len, groups.values())) > most_in_ring:
        return {}
    rings = dict(groups)
    several = len(groups) > 1  # a whole magnet that is turned is an error of another kind
    if len(groups) > 3:
        names = list(groups)
        for name, part in (("the lower half", names[:len(names) // 2]),
                           ("the upper half", names[-(len(names) // 2):])):
            groups[name] = [number for each in part for number in groups[each]]
    tried = (_exchanges(blocks, groups) if kind == "exchanged"
             else [*_turns(blocks, groups, kind)] if several else [])
    if kind == "turned":
        tried = [*tried, *_fillings(blocks, rings)]
    return {move.words: move for move in tried}


def _exchanges(
    blocks: Sequence[MagnetBlock], groups: dict[str, list[int]]
) -> Iterator[Move]:
    """Yield the exchanges of two rings, or of the halves, each of which moves along z."""
    names, still = list(groups), np.eye(3)
    for number, one in enumerate(names):
        for other in names[:number]:
            if ("half" in one) != ("half" in other):
                continue
            way = _middle(blocks, groups[one]) - _middle(blocks, groups[other])
            up = _pairs(blocks, (groups[other], groups[one]), still, way)
            down = _pairs(blocks, (groups[one], groups[other]), still, -way)
            if up is not None and down is not None and not {*groups[one]} & {*groups[other]}:
                yield Move(f"{other} and {one}", (*up, *down), _matrix_rows(still))


def _turns(
    blocks: Sequence[MagnetBlock], groups: dict[str, list[int]], kind: str
) -> Iterator[Move]:
    """Yield the turns of a ring, or of a half, about z, or by half a turn about an axis across."""
    for name, numbers in groups.items():
        middle = _middle(blocks, numbers)
        rings = {blocks[number].ring for number in numbers}
        count = len(numbers) // len(rings)
        for k in range(0 if kind == "upside down" else 1, count):
            if kind == "turned":
                turn = Rotation.from_euler("z", 2 * np.pi * k / count)
                words = f"{name} {_by_slots(k, count)}"
            else:
                angle = np.pi * k / count + np.radians(blocks[numbers[0]].angle_deg)
                turn = Rotation.from_rotvec(np.pi * unit_circle(angle))
                words = f"{name} about {np.degrees(angle) % 180:.4g}° from x"
            pairs = _pairs(blocks, (numbers, numbers), turn.as_matrix(),
                           middle - turn.apply(middle))
            if pairs is not None:
                yield Move(words, pairs, _matrix_rows(turn.as_matrix()))


def _fillings(
    blocks: Sequence[MagnetBlock], rings: dict[str, list[int]]
) -> Iterator[Move]:
    """Yield rings that were filled from another slot on, where slots are turned otherwise than
    their places, as those of bars along the magnetization.
    """
    for name, numbers in rings.items():
        count = len(numbers)
        for k in range(1, count):
            turn = Rotation.from_euler("z", 2 * np.pi * k / count).as_matrix()
            pairs = _pairs(blocks, (numbers, numbers), turn, np.zeros(3), with_shape=True)
            if pairs is not None and not all(
                    np.allclose(blocks[to].carried_from(blocks[source]), turn)
                    for to, source in pairs):
                yield Move(f"the blocks of {name} {_by_slots(k, count)} each", pairs, None)


def _by_slots(k: int, count: int) -> str:
    """Describe a turn by ``k`` of ``count`` slots."""
    signed = k if k <= count // 2 else k - count
    return f"by {signed:+d} slot{'s' if abs(signed) > 1 else ''}"


def _pairs(
    blocks: Sequence[MagnetBlock], groups: tuple[list[int], list[int]], turn: Floats,
    shift: Floats, with_shape: bool = False
) -> tuple[tuple[int, int], ...] | None:
    """Return slot and source of the blocks of a group that is moved to the slots of another one.

    None if a block does not fit there. Blocks turn by ``turn``, or ``with_shape`` as their slots.
    """
    source, to = groups
    if len(source) != len(to):
        return None
    places = np.array([blocks[number].middle for number in to])
    found = []
    for number in source:
        corners = corners_of(blocks[number])
        there = turn @ blocks[number].middle + shift
        slot = to[int(np.linalg.norm(places - there, axis=1).argmin())]
        moved = (_shrink(corners) + corners.mean(axis=0)) @ turn.T + shift
        if with_shape:
            moved = _shrink(corners) @ blocks[slot].carried_from(blocks[number]).T + (
                turn @ corners.mean(axis=0) + shift)
        if not _fits(blocks[slot], moved):
            return None
        found.append((slot, number))
    return tuple(found) if len({slot for slot, _ in found}) == len(to) else None


def _fits(block: MagnetBlock, shrunk: Floats) -> bool:
    """Tell whether points (n, 3) in m of a body that was shrunk all lie in the slot of a block.

    None of them is on its surface, so that the distance from it, see `MagnetBlock.contains`, need
    not be known.
    """
    places = block.to_frame(shrunk)
    if not ((places[:, 2] > block.z_min) & (places[:, 2] < block.z_max)).all():
        return False
    return bool(outline_contains(block.outline, places[:, :2]).all())


def _shrink(corners: Floats) -> Floats:
    """Return corners (n, 3) about their middle, of a body that is slightly smaller."""
    # A body whose size is reduced by this factor lies within its slot wherever it fits: slots are
    # wider than blocks by about a hundredth, and edges of a block may differ by as much
    reduction = 0.99
    return np.asarray(reduction * (corners - corners.mean(axis=0)))


def _middle(blocks: Sequence[MagnetBlock], numbers: Sequence[int]) -> Floats:
    """Return the point (3,) in m on the axis in the middle of some blocks."""
    heights = [blocks[number].middle[2] for number in numbers]
    return np.array([0.0, 0.0, (min(heights) + max(heights)) / 2])


def _matrix_rows(matrix: Floats) -> Turn:
    """Return a matrix as a tuple."""
    rows = matrix.round(12) + 0.0
    return tuple((float(a), float(b), float(c)) for a, b, c in rows)
