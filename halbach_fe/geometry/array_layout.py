"""The layout of an array: position, shape and nominal magnetization of every block."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from halbach_fe.core.arrays import unit_circle
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z, rotation_matrix, vector
from halbach_fe.geometry.free_blocks import nominal_free_blocks
from halbach_fe.geometry.outline import Outline, closed_outline, trapezoid_corners
from halbach_fe.study.array import Array, BlockException
from halbach_fe.study.materials import MU_0


def blocks_of_array(array: Array, dimension: int) -> tuple[MagnetBlock, ...]:
    """Build all blocks of an array, ring by ring, slot by slot; free blocks follow the rings.

    The rings of a cross-section (``dimension`` 2) extend from z = -inf to +inf.

    Raises
    ------
    StudyError
        If a block cannot be built as described.
    """
    nominal = nominal_blocks(array, dimension)
    if not array.exceptions:
        return nominal
    places = {block.place: block for block in nominal}
    of_block = exceptions_of(array)
    return tuple(_with_exceptions(block, of_block(block.ring, block.slot), places)
                 for block in nominal)


@lru_cache(maxsize=4)  # which a magnet and its check for overlaps both need
def nominal_blocks(array: Array, dimension: int) -> tuple[MagnetBlock, ...]:
    """Build the blocks of an array without the deviations that its exceptions describe."""
    blocks: list[MagnetBlock] = []
    outlines: dict[Array, tuple[Outline, ...]] = {}
    for ring, limits in enumerate(ring_limits(array, dimension), start=1):
        own = array.of_ring(ring) if array.ring else array
        if own not in outlines:
            outlines[own] = tuple(outline_of_slot(own, slot)
                                  for slot in range(1, own.blocks_per_ring + 1))
        blocks += [_nominal_block(own, ring, slot, outline, limits)
                   for slot, outline in enumerate(outlines[own], start=1)]
    if array.free_blocks is not None:
        blocks += nominal_free_blocks(array, dimension)
    return tuple(blocks)


def _nominal_block(
    array: Array, ring: int, slot: int, outline: Outline, limits: tuple[float, float]
) -> MagnetBlock:
    """Return one block of a ring with the values of its array.

    ``outline`` and ``limits`` (of z, in m) are its nominal place.
    """
    direction = np.radians(magnetization_angle_deg(array, slot))
    permeability = array.recoil_permeability
    block = MagnetBlock(
        ring=ring, slot=slot, outline=outline, z_min=limits[0], z_max=limits[1],
        easy_axis=(float(np.cos(direction)), float(np.sin(direction)), 0.0),
        remanence=array.remanence_T or np.nan, recoil_permeability=permeability,
        recoil_permeability_across=array.recoil_permeability_across or permeability,
        angle_deg=position_angle_deg(array, slot), facing_deg=facing_angle_deg(array, slot))
    if array.remanence_T is None:
        block = replace(block, remanence=_remanence_of_moment(array, block))
    return block


def _with_exceptions(
    block: MagnetBlock, exceptions: Sequence[BlockException],
    places: dict[tuple[int, int], MagnetBlock],
) -> MagnetBlock:
    """Return a nominal block with the deviations of its exceptions.

    ``places`` are all nominal blocks, by ring and slot.
    """
    if not exceptions:
        return block
    changed: dict[str, Any] = {}
    permeability, across = block.recoil_permeability, block.recoil_permeability_across
    remanence, easy_axis = block.remanence, np.array(block.easy_axis)
    for exception in exceptions:
        if exception.mounted_from is not None:
            changed["mounted_from"] = exception.mounted_from
            meant = places[exception.mounted_from]
            easy_axis = block.carried_from(meant) @ meant.easy_axis
        if exception.magnetization_angle_deg is not None:
            direction = np.radians(exception.magnetization_angle_deg)
            easy_axis = unit_circle(direction)
        if exception.recoil_permeability is not None:
            permeability = across = exception.recoil_permeability
        across = exception.recoil_permeability_across or across
        remanence = exception.remanence_T or remanence
        if exception.magnetization_gradient is not None:
            changed["gradient"] = exception.magnetization_gradient
        if exception.inner_corner_loss is not None:
            changed["corner_loss"] = exception.inner_corner_loss
    factor = magnetization_factor(exceptions)
    if factor == 0.0:  # there is no block, so there is no permeability either
        permeability = across = 1.0
    block = replace(
        block, easy_axis=vector(easy_axis), remanence=remanence * factor,
        recoil_permeability=permeability, recoil_permeability_across=across, **changed)
    if (block.gradient or block.corner_loss) and not block.has_four_edges:
        raise StudyError(
            f"Input `array.exceptions` of study must give magnetization_gradient and "
            f"inner_corner_loss for blocks with four edges only, of which two are straight; "
            f"instead block {block.name} has other ones. Leave the keys out there.")
    return _displaced(block, exceptions)


def _displaced(block: MagnetBlock, exceptions: Sequence[BlockException]) -> MagnetBlock:
    """Return the block displaced and rotated by its exceptions; its easy axis rotates with it."""
    axes = rotation_matrix((0.0, 0.0, np.radians(block.angle_deg)))
    displacement, rotation = np.zeros(3), np.zeros(3)
    for exception in exceptions:
        twist = np.array([0.0, 0.0, np.radians(exception.twist_deg)])
        displacement += axes @ exception.displacement_m + exception.shift_m
        tilt = np.radians([*exception.tilt_deg, 0.0])
        arm = block.middle * [1.0, 1.0, 0.0]  # from the axis, also of a tilt
        displacement += sum(rotation_matrix(vector(turn)) @ arm - arm for turn in (twist, tilt))
        rotation += axes @ np.radians(exception.rotation_deg) + twist + tilt
    if not (displacement.any() or rotation.any()):
        return block
    return replace(block, displacement_m=vector(displacement), rotation_rad=vector(rotation),
                   easy_axis=vector(rotation_matrix(vector(rotation)) @ block.easy_axis))


def exceptions_of(array: Array) -> Callable[[int, int], list[BlockException]]:
    """Return a function of ring and slot, which returns the exceptions that hold for a block, in
    the order of the study.

    They are sorted once: oval rings of thousands of blocks have an exception for each.
    """
    found = defaultdict[tuple[int | None, int | None], list[int]](list)
    for number, exception in enumerate(array.exceptions):
        found[exception.ring, exception.slot].append(number)

    def of_block(ring: int, slot: int) -> list[BlockException]:
        return [array.exceptions[number] for number in sorted(
            number for place in product((None, ring), (None, slot))
            for number in found.get(place, ()))]

    return of_block


def magnetization_factor(exceptions: Sequence[BlockException]) -> float:
    """Return the product of the magnetization factors of a block's exceptions."""
    return float(np.prod([exception.magnetization_factor for exception in exceptions]))


def position_angle_deg(array: Array, slot: int) -> float:
    """Return the angle about the z axis of the middle of slot ``slot`` (from 1) of equal rings."""
    return array.first_block_angle_deg + (slot - 1) * 360.0 / array.blocks_per_ring


def magnetization_angle_deg(array: Array, slot: int) -> float:
    """Return the angle of the nominal magnetization of slot ``slot`` (from 1) to the x axis."""
    turn = (1 + array.multipole_order) * (slot - 1) * 360.0 / array.blocks_per_ring
    return array.first_magnetization_angle_deg + turn


def facing_angle_deg(array: Array, slot: int) -> float:
    """Return the angle to the x axis of the thickness of the block in slot ``slot`` (from 1)."""
    if array.block.shape == "cuboid" and array.block.orientation == "magnetization":
        return magnetization_angle_deg(array, slot)
    return position_angle_deg(array, slot)


def ring_limits(array: Array, dimension: int) -> list[tuple[float, float]]:
    """Return the z limits in m of every ring, without free blocks; they are infinite in 2D.

    Rings are stacked layer by layer, and each stack is centred at z = 0, see
    `halbach_fe.study.array.Ring`.
    """
    if dimension == 2:
        return [(-np.inf, np.inf)] * array.rings
    if not array.ring:
        if not array.rings:
            return []
        assert array.ring_length_m is not None  # the study model guarantees it
        pitch = array.ring_length_m + array.ring_gap_m
        length = array.rings * pitch - array.ring_gap_m
        starts = -length / 2 + pitch * np.arange(array.rings)
        return [(float(z), float(z + array.ring_length_m)) for z in starts]
    limits: list[tuple[float, float]] = [(0.0, 0.0)] * array.rings
    stacks: defaultdict[int, list[tuple[int, float, float]]] = defaultdict(list)
    for number, ring in enumerate(array.ring):
        length = ring.ring_length_m or array.ring_length_m or np.nan  # one of them is given
        if ring.z_m is not None:
            limits[number] = (ring.z_m - length / 2, ring.z_m + length / 2)
            continue
        gap = array.ring_gap_m if ring.ring_gap_m is None else ring.ring_gap_m
        stacks[ring.layer].append((number, length, gap))
    for stack in stacks.values():
        total = sum(length + gap for _, length, gap in stack) - stack[-1][2]
        z = -total / 2
        for number, length, gap in stack:
            limits[number] = (z, z + length)
            z += length + gap
    return limits


def _remanence_of_moment(array: Array, block: MagnetBlock) -> float:
    """Return the remanence B_r = mu_0 m / V in T of a block with the remanent moment m.

    A Helmholtz coil measures a smaller moment of a single block: self-demagnetization divides it by
    1 + N (mu_r - 1), with the demagnetizing factor N, at most some 2 %. The nominal moment of a
    study is not corrected for that.

    StudyError if the remanence is larger than that of any magnet material.
    """
    assert array.block_moment_A_m2 is not None  # the study model guarantees both
    assert array.ring_length_m is not None
    remanence = MU_0 * array.block_moment_A_m2 / (block.area * array.ring_length_m)
    if remanence > 2.0:
        raise StudyError(
            f"Input `array.block_moment_A_m2` of study must be the moment of a block with a "
            f"remanence of up to 2 T; instead received {array.block_moment_A_m2:g}, which makes "
            f"{remanence:.3g} T in this block's volume. Check moment, radii and ring length."
        )
    return remanence


def outline_of_slot(array: Array, slot: int) -> Outline:
    """Return the outline of the block in slot ``slot``, counter-clockwise, in m.

    Raises
    ------
    StudyError
        If the gap between blocks leaves them no width.
    """
    middle = np.radians(position_angle_deg(array, slot))
    half_pitch = np.pi / array.blocks_per_ring
    inner, outer, block = array.inner_radius_m, array.outer_radius_m, array.block
    if block.shape == "sector":
        half = half_pitch - np.radians(block.angular_gap_deg) / 2
        if half <= 0:
            raise StudyError(
                f"Input `array.block.angular_gap_deg` of study must be less than the pitch of "
                f"{np.degrees(2 * half_pitch):g} deg; instead received {block.angular_gap_deg:g}."
                " Reduce the gap or the number of blocks."
            )
        corners = [(r, middle + s * half) for r, s in
                   ((inner, -1), (outer, -1), (outer, 1), (inner, 1))]
        local = np.array([(r * np.cos(a), r * np.sin(a)) for r, a in corners])
        return closed_outline(local, arcs=(1, 3))
    if block.shape == "trapezoid":
        # The side faces are parallel to the limits of the sector, at half a gap from them.
        inset = block.side_gap_m / 2 / np.cos(half_pitch)
        widths = [r * np.tan(half_pitch) - inset for r in (inner, outer)]
        if widths[0] <= 0:
            raise StudyError(
                f"Input `array.block.side_gap_m` of study must leave the block some width at the "
                f"inner radius; instead received {block.side_gap_m:g}. Reduce the gap."
            )
        local = trapezoid_corners((inner, outer), (widths[0], widths[1]))
        return closed_outline(local @ rotation_about_z(middle)[:2, :2].T)
    half_width, half_depth = block.width_m / 2, (outer - inner) / 2
    local = trapezoid_corners((-half_depth, half_depth), (half_width, half_width))
    facing = np.radians(facing_angle_deg(array, slot))
    centre = (inner + outer) / 2 * unit_circle(middle)[:2]
    return closed_outline(local @ rotation_about_z(facing)[:2, :2].T + centre)
