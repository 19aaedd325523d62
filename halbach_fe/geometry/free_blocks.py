"""Free blocks: from the columns of a table to blocks, and from the blocks of any magnet to a table.

The table of `blocks_table` describes the magnet as built: displaced, rotated and weakened blocks
become free blocks of their own place and remanence, and missing blocks are left out. `build_magnet`
of a study with this table gives the same field in vacuum, and the same permeabilities.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, polygon_area, unit_circle
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z, rotation_matrix, vector
from halbach_fe.geometry.outline import Outline, circle, closed_outline, trapezoid_corners
from halbach_fe.study.array import Array
from halbach_fe.study.free_blocks import COLUMNS, REMANENCE_VECTOR, SIZES, FreeBlocks, Shape

if TYPE_CHECKING:
    from halbach_fe.geometry.magnet import Magnet


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
    return [*(["iron"] if magnet.iron else []), *magnet.external.stated]


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
