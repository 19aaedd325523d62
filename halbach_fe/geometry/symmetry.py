"""Symmetry of the array: blocks that are images of a source block, and turns of equal blocks.

The field of a source block, solved once, serves all its copies. F(x) is the matrix that maps the
magnetization of a block to B at x. Magnetization and B are axial vectors. The field matrix of a
block rotated by R is therefore ``F'(x) = R F(R^-1 x) R^T``, and of a block reflected by S in a
plane ``F'(x) = S F(S x) S``: the sign of axial vectors under reflection cancels.

`symmetry_images` returns the turns by which a magnet is turned onto itself, so that no field map
tells its blocks apart.

Blocks may be mounted in another place or turn than meant: `mountings`. The turns and moves after
which they fit a slot are found by their shapes, so that they exist for rings and free blocks alike.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, Ints, unit_circle
from halbach_fe.geometry.array_layout import exceptions_of, magnetization_factor, nominal_blocks
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z, rotation_matrix
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Outline, at_heights, outline_contains, points_on
from halbach_fe.study.array_keys import MAX_FACTOR, Array, BlockException
from halbach_fe.study.external_keys import External

_HASH_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd numbers with well-mixed bits, which combine three rounded coordinates to a hash."""


@dataclass(frozen=True)
class SymmetryImage:
    """The reflection and rotation that map a source block to one of its copies."""

    source: int
    """Number of the source block."""
    turn: float = 0.0
    """Rotation about z, after the reflection. In rad."""
    mirrored: bool = False
    """Whether the source is reflected in the plane z = 0."""

    def to_source(self, points: Floats) -> Floats:
        """Return points (n, 3) moved by the inverse map, from the copy to the source."""
        found = points @ rotation_about_z(self.turn)
        return found * [1, 1, -1] if self.mirrored else found

    def from_source(self, field: Floats) -> Floats:
        """Return the field of the copy from the field of the source at the `to_source` points.

        ``field`` (..., 3, k): B per unit of magnetization along the first k axes (x, y in a
        cross-section).
        """
        size = field.shape[-1]
        turn = rotation_about_z(self.turn)
        if self.mirrored:
            sign = np.array([1.0, 1.0, -1.0])
            field = field * sign[:, None] * sign[:size]
        return np.asarray(turn @ field @ turn[:size, :size].T)


def unique_points(points: Floats) -> tuple[Floats, Ints]:
    """Return the distinct points (u, 3), and the index (n,) among them of each point (n, 3)."""
    grid_m = 1e-12  # grid in m that coordinates are rounded to before points are compared
    grid = np.round(points / grid_m).astype(np.int64)
    with np.errstate(over="ignore"):  # sorting one hash is faster than sorting three coordinates
        key = (grid.astype(np.uint64) * _HASH_FACTORS).sum(axis=1)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    found = points[first]
    if np.abs(found[inverse] - points).max(initial=0) > 2 * grid_m:  # two points share a hash
        found, inverse = np.unique(grid, axis=0, return_inverse=True)
        return found * grid_m, inverse.reshape(-1)
    return found, inverse.reshape(-1)


@dataclass(frozen=True)
class Symmetry:
    """The blocks of a study as images of a few source blocks."""

    images: tuple[SymmetryImage, ...]
    """One image per block, in the order of the blocks."""

    @cached_property
    def sources(self) -> tuple[int, ...]:
        """Numbers of the source blocks, whose fields have to be computed, in ascending order."""
        return tuple(sorted({image.source for image in self.images}))

    def source_points(self, points: Floats) -> tuple[Floats, list[Ints]]:
        """Return the points at which the fields of the source blocks are needed.

        The fields of all blocks at ``points`` follow from them, see `SymmetryImage.from_source`.

        Returns
        -------
        union : ndarray, shape (u, 3), in m
            The distinct points over all images.
        index : list of ndarray of int, shape (n,)
            For each block, which of them are the `SymmetryImage.to_source` of ``points``.
        """
        distinct = list(dict.fromkeys((image.turn, image.mirrored) for image in self.images))
        seen = [SymmetryImage(0, *motion).to_source(points) for motion in distinct]
        union, inverse = unique_points(np.vstack(seen))
        index = dict(zip(distinct, inverse.reshape(len(distinct), len(points)), strict=True))
        return union, [index[image.turn, image.mirrored] for image in self.images]


def no_symmetry(magnet: Magnet) -> Symmetry:
    """Return the trivial symmetry, in which every block is its own source."""
    return Symmetry(tuple(SymmetryImage(number) for number in range(len(magnet.blocks))))


def symmetry_of(magnet: Magnet) -> Symmetry:
    """Return the symmetry under rotations about z by whole blocks and reflection in z = 0.

    The shapes and permeabilities of the blocks decide, and whether coaxial iron is its own mirror
    image; their magnetizations may differ, because fields are computed per unit of magnetization.
    Rings that differ, free blocks and poles of iron have no symmetry here.
    """
    if not magnet.array.is_uniform or not magnet.iron_is_axisymmetric:
        return no_symmetry(magnet)
    blocks = magnet.blocks
    slots, rings = magnet.array.blocks_per_ring, magnet.array.rings
    tensors = np.array([b.recoil_tensor for b in blocks]).reshape(rings, slots, 3, 3)
    outlines = [block.outline for block in blocks[:slots]]
    pitch = 2 * np.pi / slots
    period = next(k for k in range(1, slots + 1) if slots % k == 0 and _is_periodic(
        outlines, tensors, k, pitch))
    ends = np.array([(body.inner_radius, body.outer_radius, body.z_min, body.z_max)
                     for body in magnet.iron]).reshape(-1, 4)
    mirror = magnet.dimension == 3 and _equal(tensors, tensors[::-1]) and (
        not len(ends) or _coincide(ends, ends[:, [0, 1, 3, 2]] * [1, 1, -1, -1]))
    images = []
    for number in range(len(blocks)):
        ring, slot = divmod(number, slots)
        mirrored = mirror and 2 * ring >= rings
        source = (rings - 1 - ring if mirrored else ring) * slots + slot % period
        images.append(SymmetryImage(source, (slot - slot % period) * pitch, mirrored))
    return Symmetry(tuple(images))


def _is_periodic(outlines: list[Outline], tensors: Floats, step: int, pitch: float) -> bool:
    """Tell whether a rotation by ``step`` slots maps all shapes and permeabilities onto themselves.

    ``pitch`` is the angle in rad between neighbouring slots.
    """
    space = rotation_about_z(step * pitch)
    if not _equal(np.roll(space @ tensors @ space.T, step, axis=1), tensors):
        return False
    turn = space[:2, :2]
    return all(_coincide(_ends(outline) @ turn.T, _ends(other))
               for outline, other in zip(outlines, outlines[step:] + outlines[:step], strict=True))


def _equal(tensors: Floats, others: Floats) -> bool:
    """Tell whether permeability tensors agree up to the rounding of their rotations."""
    return bool(np.abs(tensors - others).max() < 1e-12)


def _ends(outline: Outline) -> Floats:
    return np.array([edge.start for edge in outline])


def _coincide(corners: Floats, others: Floats) -> bool:
    """Tell whether two sets of points (n, d) in m are the same but for the rounding of turns."""
    return _apart(corners, others) < 1e-9


def _apart(corners: Floats, others: Floats) -> float:
    """Return how far two sets of points (n, d) in m are apart, in any order."""
    distance = np.linalg.norm(corners[:, None] - others[None], axis=2)
    return float(max(distance.min(axis=0).max(), distance.min(axis=1).max()))


def block_images(magnet: Magnet, turn: Floats, sign: int = 1) -> tuple[int, ...] | None:
    """Return the number from 0 of the equal block onto which each block is turned.

    ``turn`` (3, 3) is a rotation about the origin of the magnet. With a ``sign`` of -1 the turned
    block must have the reversed magnetization of the one that is there. None if a block has no
    equal one there. Magnets with iron or fields from outside, cross-sections and blocks of uneven
    magnetization are never said to be equal to themselves after a turn.
    """
    blocks = magnet.blocks
    if (magnet.iron or magnet.dimension == 2 or magnet.external != External() or any(
            block.gradient or block.corner_loss for block in blocks)):
        return None
    corners = [_corners(block) for block in blocks]
    moments = np.array([block.polarization for block in blocks])
    middles = np.array([each.mean(axis=0) for each in corners])
    found = []
    # distance of corners in m, and difference of remanences in T, up to which blocks are equal:
    # more than the rounding of any study, and less than any deviation that is given
    same_m, same_T = 1e-7, 1e-7
    for number, block in enumerate(blocks):
        there = int(np.linalg.norm(middles - turn @ middles[number], axis=1).argmin())
        if (_apart(corners[number] @ turn.T, corners[there]) > same_m
                or np.abs(sign * turn @ moments[number] - moments[there]).max() > same_T
                or _permeabilities(block) != _permeabilities(blocks[there])):
            return None
        found.append(there)
    return tuple(found)


def symmetry_images(magnet: Magnet) -> list[tuple[int, ...]]:
    """Return what `block_images` says of every turn that brings the magnet onto itself.

    Turns by right angles are tried, and those that bring a ring of blocks onto itself, alone and
    with half a turn about x.
    """
    turns = [each for each in Rotation.create_group("O").as_matrix() if np.trace(each) < 2.9]
    count = max(Counter(block.ring for block in magnet.blocks).values(), default=0)
    most_in_ring = 64  # number of blocks of a ring up to which turns from block to block are tried
    if count <= most_in_ring:
        for number in range(count):
            about_z = Rotation.from_euler("z", 2 * np.pi * number / count)
            turns += [about_z.as_matrix(), (about_z * Rotation.from_euler(
                "x", np.pi)).as_matrix()][not number:]
    images = dict.fromkeys(image for turn in turns if (image := block_images(magnet, turn)))
    return list(images)


def _permeabilities(block: MagnetBlock) -> tuple[float, float]:
    """Return the relative permeabilities of a block."""
    return block.recoil_permeability, block.recoil_permeability_across


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
                       for each in (_corners(block), _corners(meant)))
    chord = 2 * np.sin(angle / 2) * np.linalg.norm(others, axis=1).max()
    return _apart(corners, others) <= chord


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
    corners = _corners(block)
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
    easy, corners = np.array(block.easy_axis), _corners(block)
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
        corners = _corners(blocks[number])
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


@lru_cache(maxsize=4096)
def _corners(block: MagnetBlock) -> Floats:
    """Return points (n, 3) in m on the edges of a block; of an infinite one, at |z| of 1 m."""
    ends = (-1.0, 1.0) if np.isinf(block.z_max) else (block.z_min, block.z_max)
    corners = block.from_frame(at_heights(points_on(block.outline), *ends))
    corners.flags.writeable = False
    return corners


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
