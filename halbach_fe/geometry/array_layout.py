"""The layout of an array: position, shape and nominal magnetization of every block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.blocks import MagnetBlock, rotation_matrix, vector
from halbach_fe.geometry.outline import Outline, check_overlaps, closed_outline, plane_rotation
from halbach_fe.study.magnet import Array, BlockException
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study


def blocks_of_array(study: Study) -> tuple[MagnetBlock, ...]:
    """Build all blocks of a study, ring by ring (lowest z first), slot by slot.

    The single ring of a 2D study extends from z = -inf to +inf.

    Raises
    ------
    StudyError
        If neighbouring blocks overlap.
    """
    array = study.array
    outlines = [outline_of_slot(array, slot) for slot in range(1, array.blocks_per_ring + 1)]
    check_overlaps(tuple(outlines))
    return tuple(
        _block(array, ring, slot, outline, limits)
        for ring, limits in enumerate(ring_limits(study), start=1)
        for slot, outline in enumerate(outlines, start=1))


def _block(
    array: Array, ring: int, slot: int, outline: Outline, limits: tuple[float, float]
) -> MagnetBlock:
    """Return one block, with the array's values and those of its exceptions.

    ``outline`` and ``limits`` (of z, in m) are its nominal place.
    """
    exceptions = exceptions_of(array, ring, slot)
    angle, remanence = magnetization_angle_deg(array, slot), array.remanence_T
    permeability = array.recoil_permeability
    across = array.recoil_permeability_across or permeability
    meant: tuple[int, int] | None = None
    gradient = corner_loss = 0.0
    for exception in exceptions:
        if exception.mounted_from is not None:
            meant = exception.mounted_from
            angle = (magnetization_angle_deg(array, meant[1]) + position_angle_deg(array, slot)
                     - position_angle_deg(array, meant[1]))
        if exception.magnetization_angle_deg is not None:
            angle = exception.magnetization_angle_deg
        if exception.recoil_permeability is not None:
            permeability = across = exception.recoil_permeability
        across = exception.recoil_permeability_across or across
        remanence = exception.remanence_T or remanence
        if exception.magnetization_gradient is not None:
            gradient = exception.magnetization_gradient
        if exception.inner_corner_loss is not None:
            corner_loss = exception.inner_corner_loss
    direction = np.radians(angle)
    easy_axis = np.array([np.cos(direction), np.sin(direction), 0.0])
    block = MagnetBlock(
        ring=ring, slot=slot, outline=outline, z_min=limits[0], z_max=limits[1],
        easy_axis=vector(easy_axis), remanence=np.nan if remanence is None else remanence,
        recoil_permeability=permeability, recoil_permeability_across=across, gradient=gradient,
        corner_loss=corner_loss, mounted_from=meant)
    if remanence is None:
        block = replace(block, remanence=_remanence_of_moment(array, block))
    factor = magnetization_factor(exceptions)
    if factor != 1.0:
        block = replace(block, remanence=block.remanence * factor)
    return _displaced(block, array, exceptions)


def _displaced(
    block: MagnetBlock, array: Array, exceptions: Sequence[BlockException]
) -> MagnetBlock:
    """Return the block displaced and rotated by its exceptions; its easy axis rotates with it."""
    axes = rotation_matrix((0.0, 0.0, np.radians(position_angle_deg(array, block.slot))))
    displacement, rotation = np.zeros(3), np.zeros(3)
    for exception in exceptions:
        twist = np.array([0.0, 0.0, np.radians(exception.twist_deg)])
        displacement += axes @ exception.displacement_m + exception.shift_m
        displacement += rotation_matrix(vector(twist)) @ block.middle - block.middle
        rotation += axes @ np.radians(exception.rotation_deg) + twist
    if not (displacement.any() or rotation.any()):
        return block
    return replace(block, displacement_m=vector(displacement), rotation_rad=vector(rotation),
                   easy_axis=vector(rotation_matrix(vector(rotation)) @ block.easy_axis))


def exceptions_of(array: Array, ring: int, slot: int) -> list[BlockException]:
    """Return the exceptions that hold for a block, in the order of the study."""
    return [exception for exception in array.exceptions
            if exception.ring in (None, ring) and exception.slot in (None, slot)]


def magnetization_factor(exceptions: Sequence[BlockException]) -> float:
    """Return the product of the magnetization factors of a block's exceptions."""
    return float(np.prod([exception.magnetization_factor for exception in exceptions]))


def position_angle_deg(array: Array, slot: int) -> float:
    """Return the angle about the z axis of the middle of slot ``slot`` (from 1)."""
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


def ring_limits(study: Study) -> list[tuple[float, float]]:
    """Return the z limits in m of every ring; the array is centred at z = 0, infinite in 2D."""
    array = study.array
    if study.dimension == 2:
        return [(-np.inf, np.inf)]
    assert array.ring_length_m is not None  # the study model guarantees it
    pitch = array.ring_length_m + array.ring_gap_m
    length = array.rings * pitch - array.ring_gap_m
    starts = -length / 2 + pitch * np.arange(array.rings)
    return [(float(z), float(z + array.ring_length_m)) for z in starts]


def _remanence_of_moment(array: Array, block: MagnetBlock) -> float:
    """Return the remanence B_r = mu_0 m / V in T of a block with the remanent moment m.

    A Helmholtz coil measures a smaller moment of a single block: self-demagnetization divides it by
    1 + N (mu_r - 1), with the demagnetizing factor N, at most some 2 %. The nominal moment of a
    study is not corrected for that.

    Raises
    ------
    StudyError
        If the remanence is larger than that of any magnet material.
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
        local = np.array([(inner, -widths[0]), (outer, -widths[1]),
                          (outer, widths[1]), (inner, widths[0])])
        return closed_outline(local @ plane_rotation(middle).T)
    half_width, half_depth = block.width_m / 2, (outer - inner) / 2
    local = np.array([(-half_depth, -half_width), (half_depth, -half_width),
                      (half_depth, half_width), (-half_depth, half_width)])
    facing = np.radians(facing_angle_deg(array, slot))
    centre = (inner + outer) / 2 * np.array([np.cos(middle), np.sin(middle)])
    return closed_outline(local @ plane_rotation(facing).T + centre)
