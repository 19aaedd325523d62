"""The layout of an array: position, shape and nominal magnetization of every block.

Free blocks come from the columns of a table, and the blocks of any magnet go into one. That of
`blocks_table` describes the magnet as built: displaced, rotated and weakened blocks become free
blocks of their own place and remanence, and missing blocks are left out. `build_magnet` of a study
with this table gives the same field in vacuum, and the same permeabilities.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, polygon_area, unit_circle
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z, rotation_matrix, vector
from halbach_fe.geometry.outline import Outline, circle, closed_outline, trapezoid_corners
from halbach_fe.study.array_keys import Array, BlockException
from halbach_fe.study.free_blocks import COLUMNS, REMANENCE_VECTOR, SIZES, FreeBlocks, Shape
from halbach_fe.study.materials import MU_0

if TYPE_CHECKING:
    from halbach_fe.geometry.magnet import Magnet


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
    `halbach_fe.study.array_keys.Ring`.
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


def nominal_free_blocks(array: Array, dimension: int) -> list[MagnetBlock]:
    """Build the free blocks of an array, in the order of their table.

    Values that the table leaves out are those of the array. In 2D, blocks are infinitely long.

    Raises
    ------
    StudyError
        If a block of a 2D study lies off the plane or is tilted, or one of a 3D study has no
        length.
    """
    table = array.free_blocks
    assert table is not None  # the caller has checked it
    permeability = table.numbers("recoil_permeability", array.recoil_permeability)
    default = array.recoil_permeability_across or np.nan
    across = table.numbers("recoil_permeability_across", default)
    across = np.where(np.isnan(across), permeability, across)
    if dimension == 2:
        _check_plane(table)
        half = np.full(len(table), np.inf)
    else:
        half = table.numbers("size_z_m", np.nan) / 2
        if np.isnan(half).any():
            name = table.name[int(np.argmax(np.isnan(half)))]
            raise StudyError(f"Input `array.free_blocks.size_z_m` of study must be given for every "
                             f"block of a 3D study; instead it is missing for block {name}.")
    origins, rotations = table.origins_m, table.rotations_rad
    gradient = table.numbers("magnetization_gradient", 0.0)
    loss = table.numbers("inner_corner_loss", 0.0)
    strengths = np.column_stack([table.numbers(column, np.nan) for column in REMANENCE_VECTOR])
    own = table.numbers("remanence_T", np.nan)
    blocks = []
    for number, (ring, slot) in enumerate(table.places):
        axes = rotation_matrix(vector(rotations[number]))
        remanence, easy_axis = float(own[number]), axes[:, 0]
        if np.isnan(remanence):
            remanence = float(np.linalg.norm(strengths[number]))
            easy_axis = strengths[number] / remanence if remanence else easy_axis
        outline = free_outline(table, number)
        corners = np.array([[*edge.start, 0.0] for edge in outline])
        x, y, _ = axes @ corners.mean(axis=0) + origins[number]
        if np.hypot(x, y) < 1e-9:  # a block on the axis has no angle about it
            x, y = 1.0, 0.0
        blocks.append(MagnetBlock(
            ring=array.rings + ring, slot=slot, outline=outline, z_min=-float(half[number]),
            z_max=float(half[number]), easy_axis=vector(easy_axis), remanence=remanence,
            recoil_permeability=float(permeability[number]),
            recoil_permeability_across=float(across[number]), gradient=float(gradient[number]),
            corner_loss=float(loss[number]), origin_m=vector(origins[number]),
            orientation_rad=vector(rotations[number]), label=table.name[number],
            angle_deg=float(np.degrees(np.arctan2(y, x))),
            facing_deg=float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))))
    return blocks


def _check_plane(table: FreeBlocks) -> None:
    """Refuse blocks of a cross-section that lie off the plane z = 0, or are tilted."""
    tilted = (table.rotations_rad[:, :2] != 0).any(axis=1)
    off = tilted | (np.array(table.z_m) != 0)
    if off.any():
        name = table.name[int(np.argmax(off))]
        raise StudyError(f"Input `array.free_blocks` of study must lie in the plane z = 0 and turn "
                         f"about z only, since the study is 2D; instead block {name} does not. Use "
                         "dimension = 3.")


def free_outline(table: FreeBlocks, number: int) -> Outline:
    """Return the outline of a free block in its own (x, y) plane, counter-clockwise, in m.

    Shapes of four edges begin at the inner end of the face at negative y, as blocks of rings do.
    """
    shape = table.shape[number]
    return _outline(shape, tuple(table.value(column, number) for column in SIZES[shape]))


@lru_cache(maxsize=4096)  # tables of many blocks have few shapes
def _outline(shape: Shape, sizes: tuple[Any, ...]) -> Outline:
    """Return the outline of a shape of given `SIZES`."""
    if shape == "prism":
        return closed_outline(counter_clockwise(np.array(sizes[0])))
    size = dict(zip(SIZES[shape], sizes, strict=True))
    if shape == "sector":
        half = np.radians(size["angle_deg"]) / 2
        return sector_outline(size["inner_radius_m"], size["outer_radius_m"], -half, half)
    if shape == "cylinder":
        return circle(size["radius_m"])
    if shape == "polygon":
        angles = 2 * np.pi / size["sides"] * np.arange(size["sides"])
        return closed_outline(size["radius_m"] * unit_circle(angles)[:, :2])
    widths = ((size["size_y_m"],) * 2 if shape == "cuboid"
              else (size["inner_width_m"], size["outer_width_m"]))
    depth = size["size_x_m"] / 2
    return closed_outline(trapezoid_corners((-depth, depth), (widths[0] / 2, widths[1] / 2)))


def sector_outline(inner: float, outer: float, start: float, stop: float) -> Outline:
    """Return the outline of an annular sector between two radii in m and two angles in rad.

    Arcs longer than half a turn are cut in two, since an edge's end points do not tell its sweep.
    """
    angles = np.linspace(start, stop, 2 if stop - start < 0.99 * np.pi else 4)
    there = outer * unit_circle(angles)[:, :2]
    back = inner * unit_circle(angles)[:, :2][::-1]
    count = len(angles)
    arcs = (*range(1, count), *range(count + 1, 2 * count))
    return closed_outline(np.vstack([back[-1:], there, back[:-1]]), arcs)


def counter_clockwise(corners: Floats) -> Floats:
    """Return the corners (n, 2) of a polygon in the order in which it runs counter-clockwise."""
    return corners if polygon_area(corners) > 0 else corners[::-1]


RELATIVE_ROUNDING = 1e-12
"""Relative differences up to this are rounding."""

PLACE = ("x_m", "y_m", "z_m")
TURN = ("rotation_x_deg", "rotation_y_deg", "rotation_z_deg")


def beside_blocks(magnet: Magnet) -> list[str]:
    """Return in words what a magnet has besides blocks, which no table of blocks contains."""
    return [*(["iron"] if magnet.iron else []), *magnet.external.stated,
            *(["irreversible losses"] if magnet.has_losses else [])]


def blocks_table(magnet: Magnet) -> dict[str, list[Any]]:
    """Return the blocks of a magnet as columns of a table of free blocks.

    Blocks of rings become sectors, trapezoids or cuboids; free blocks keep their shape. Numbers of
    ring and slot stay. The remanence is a vector along the magnet's axes, so that any direction and
    sign is exact.

    Returns
    -------
    dict of list
        Columns by name, see `halbach_fe.study.free_blocks.FreeBlocks`; None where a block has no
        value. Columns without any value are left out.

    Raises
    ------
    StudyError
        If an exception tilts a block of a cross-section.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> columns = blocks_table(hf.build_magnet(hf.read_study("dipole.toml")))
    >>> columns["shape"][0], columns["name"][:2]
    ('sector', ['r01s01', 'r01s02'])
    """
    table = magnet.array.free_blocks
    first = len(magnet.blocks) - (len(table) if table else 0)
    rows = []
    for number, block in enumerate(magnet.blocks):
        if not (block.remanence or block.is_permeable):
            continue  # a missing block has no effect on the field
        if table is not None and number >= first:
            row = _free_row(block, table, number - first)
        else:
            row = _ring_row(block)
            row["material"] = magnet.materials[number]
        rows.append(row | _material(block))
    columns = {column: [row.get(column) for row in rows] for column in COLUMNS}
    return {column: values for column, values in columns.items()
            if any(value is not None for value in values)}


def blocks_of_table(columns: dict[str, list[Any]]) -> tuple[MagnetBlock, ...]:
    """Return the blocks of a table from `blocks_table`, each in a frame of its own.

    The x axis of the frame of a block of a ring is along its thickness; its origin is in the middle
    of the block, of a sector on the axis of its arcs. They are blocks of a 3D magnet.
    """
    return tuple(nominal_free_blocks(Array.model_validate({"free_blocks": columns}), 3))


def _material(block: MagnetBlock) -> dict[str, Any]:
    """Return the columns of number, remanence and permeability of any block."""
    remanence = block.polarization.tolist()
    return {
        "name": block.name, "ring": block.ring, "slot": block.slot,
        **dict(zip(REMANENCE_VECTOR, remanence, strict=True)),
        "recoil_permeability": block.recoil_permeability,
        "recoil_permeability_across": block.recoil_permeability_across,
        "magnetization_gradient": block.gradient or None,
        "inner_corner_loss": block.corner_loss or None}


def _ring_row(block: MagnetBlock) -> dict[str, Any]:
    """Return the columns of shape and pose of a block of a ring."""
    sizes, centre, angle = _shape(block.outline)
    axes = block.axes @ rotation_about_z(angle)
    if np.isinf(block.z_max):
        origin = block.axes @ [*centre.tolist(), 0.0] + block.position
        return sizes | _flat_pose(block, origin, axes)
    origin = block.axes @ [*centre.tolist(), (block.z_min + block.z_max) / 2] + block.position
    return sizes | _pose(origin, axes) | {"size_z_m": block.z_max - block.z_min}


def _free_row(block: MagnetBlock, table: FreeBlocks, number: int) -> dict[str, Any]:
    """Return the columns of shape and pose of a free block, as the table has them."""
    columns = ("type", "shape", "material", *(c for sizes in SIZES.values() for c in sizes))
    row: dict[str, Any] = {column: table.value(column, number)
                           for column in (*columns, "size_z_m")}
    if block.in_place:
        return row | {column: table.value(column, number) or 0.0 for column in (*PLACE, *TURN)}
    if not np.isinf(block.z_max):
        return row | _pose(block.position, block.axes)
    if block.axes[2, 2] < 0 and row["outline_m"] is not None:
        row["outline_m"] = tuple((x, -y) for x, y in row["outline_m"])
    return row | _flat_pose(block, block.position, block.axes)


def _pose(origin: Floats, axes: Floats) -> dict[str, float]:
    """Return the columns of the place and the rotation vector of a frame."""
    turn = Rotation.from_matrix(axes).as_rotvec(degrees=True)
    return dict(zip((*PLACE, *TURN), [*origin.tolist(), *turn.tolist()], strict=True))


def _flat_pose(block: MagnetBlock, origin: Floats, axes: Floats) -> dict[str, float]:
    """Do the same for an infinite block, which has no height, and no upper and lower end.

    A block that is turned over is its own mirror image: about its x axis all shapes but prisms are
    symmetric.
    """
    if abs(axes[2, 2]) < 1 - RELATIVE_ROUNDING:
        raise StudyError(
            f"Input `array.exceptions` of study must not tilt a block that is exported from a 2D "
            f"study; instead block {block.name} is tilted. Use dimension = 3.")
    turn = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    return dict(zip((*PLACE, *TURN), [*origin[:2].tolist(), 0.0, 0.0, 0.0, turn], strict=True))


def _shape(outline: Outline) -> tuple[dict[str, Any], Floats, float]:
    """Return the shape of a block of a ring and its place in the plane.

    Returns
    -------
    sizes : dict
        Columns ``shape`` and those of its size.
    centre : ndarray, shape (2,), in m
        Origin of the block's own axes; that of a sector is on the axis of its arcs.
    angle : float, in rad
        Angle of its own x axis.
    """
    corners = np.array([edge.start for edge in outline])
    if outline[1].arc:
        start, sweep = outline[1].angles
        sizes = {"shape": "sector", "inner_radius_m": outline[3].radius,
                 "outer_radius_m": outline[1].radius, "angle_deg": float(np.degrees(sweep))}
        return sizes, np.zeros(2), start + sweep / 2
    inner, outer = (corners[0] + corners[3]) / 2, (corners[1] + corners[2]) / 2
    depth = outer - inner
    widths = outline[3].length, outline[1].length
    size = float(np.hypot(*depth))
    sizes = {"shape": "trapezoid", "size_x_m": size, "inner_width_m": widths[0],
             "outer_width_m": widths[1]}
    if abs(widths[1] - widths[0]) <= RELATIVE_ROUNDING * size:
        sizes = {"shape": "cuboid", "size_x_m": size, "size_y_m": float(np.mean(widths))}
    return sizes, (inner + outer) / 2, float(np.arctan2(depth[1], depth[0]))
