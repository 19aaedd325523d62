"""Blocks of any magnet as a table of free blocks, where they really are.

The table describes the magnet as built: displaced, rotated and weakened blocks become free blocks
of their own place and remanence, and missing blocks are left out. `build_magnet` of a study with
this table gives the same field in vacuum, and the same permeabilities.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.free_blocks import nominal_free_blocks
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Outline
from halbach_fe.geometry.symmetry import rotation_about_z
from halbach_fe.study.array import Array
from halbach_fe.study.free_blocks import COLUMNS, REMANENCE_VECTOR, SIZES, FreeBlocks

ROUNDING = 1e-12
"""Relative differences up to this are rounding."""

PLACE = ("x_m", "y_m", "z_m")
TURN = ("rotation_x_deg", "rotation_y_deg", "rotation_z_deg")


def blocks_table(magnet: Magnet) -> dict[str, list[Any]]:
    """Return the blocks of a magnet as columns of a table of free blocks.

    Blocks of rings become sectors, trapezoids or cuboids; free blocks keep their shape. Numbers of
    ring and slot stay. The remanence is a vector along the magnet's axes, so that any direction and
    sign is exact.

    Parameters
    ----------
    magnet : Magnet

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
    table, array = magnet.array.free_blocks, magnet.array
    first = len(magnet.blocks) - (len(table) if table else 0)
    rows = []
    materials = [array.of_ring(ring).material if array.ring else array.material
                 for ring in range(1, array.rings + 1)]
    for number, block in enumerate(magnet.blocks):
        if not block.remanence and block.recoil_permeability == 1.0 and block.isotropic:
            continue  # a missing block has no effect on the field
        if table is not None and number >= first:
            row = _free_row(block, table, number - first)
        else:
            row = _ring_row(block)
            row["material"] = materials[block.ring - 1]
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
    remanence = (np.array(block.easy_axis) * block.remanence).tolist()
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
    if abs(axes[2, 2]) < 1 - ROUNDING:
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
    if abs(widths[1] - widths[0]) <= ROUNDING * size:
        sizes = {"shape": "cuboid", "size_x_m": size, "size_y_m": float(np.mean(widths))}
    return sizes, (inner + outer) / 2, float(np.arctan2(depth[1], depth[0]))
