"""Free blocks of a magnet: their shapes and poses from the columns of a table."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.blocks import MagnetBlock, rotation_matrix, vector
from halbach_fe.geometry.outline import Outline, closed_outline
from halbach_fe.study.array import Array
from halbach_fe.study.free_blocks import REMANENCE_VECTOR, SIZES, FreeBlocks, Shape


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
        angles = np.pi / 4 * np.array([-3, -1, 1, 3])
        corners = size["radius_m"] * np.column_stack([np.cos(angles), np.sin(angles)])
        return closed_outline(corners, arcs=(0, 1, 2, 3))
    if shape == "polygon":
        angles = 2 * np.pi / size["sides"] * np.arange(size["sides"])
        return closed_outline(size["radius_m"] * np.column_stack([np.cos(angles), np.sin(angles)]))
    widths = ((size["size_y_m"],) * 2 if shape == "cuboid"
              else (size["inner_width_m"], size["outer_width_m"]))
    depth = size["size_x_m"] / 2
    return closed_outline(np.array([
        (-depth, -widths[0] / 2), (depth, -widths[1] / 2), (depth, widths[1] / 2),
        (-depth, widths[0] / 2)]))


def sector_outline(inner: float, outer: float, start: float, stop: float) -> Outline:
    """Return the outline of an annular sector between two radii in m and two angles in rad.

    Arcs longer than half a turn are cut in two, since an edge's end points do not tell its sweep.
    """
    angles = np.linspace(start, stop, 2 if stop - start < 0.99 * np.pi else 4)
    there = outer * np.column_stack([np.cos(angles), np.sin(angles)])
    back = inner * np.column_stack([np.cos(angles), np.sin(angles)])[::-1]
    count = len(angles)
    arcs = (*range(1, count), *range(count + 1, 2 * count))
    return closed_outline(np.vstack([back[-1:], there, back[:-1]]), arcs)


def counter_clockwise(corners: Floats) -> Floats:
    """Return the corners (n, 2) of a polygon in the order in which it runs counter-clockwise."""
    x, y = corners.T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    return corners if area > 0 else corners[::-1]
