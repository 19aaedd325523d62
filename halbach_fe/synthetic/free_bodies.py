"""The true bodies of free blocks, from the columns of their table."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study.array import Array
from halbach_fe.study.free_blocks import FreeBlocks
from halbach_fe.synthetic.block_exceptions import uneven_parts
from halbach_fe.synthetic.shapes import (
    CylinderBody,
    PolygonBody,
    PrismBody,
    SectorBody,
    Shape,
    shoelace,
)
from halbach_fe.synthetic.true_magnet import Body, vector

ON_AXIS = 1e-9
"""Distance in m from the magnet's axis within which a block has no angle about it."""


def free_bodies(array: Array, dimension: int) -> tuple[Body, ...]:
    """Return the nominal bodies of an array's free blocks, in the order of their table.

    Raises
    ------
    StudyError
        If a block of a cross-section lies off its plane, or one of three dimensions has no length.
    """
    table = array.free_blocks
    assert table is not None  # the caller has checked it
    return tuple(_body(array, table, number, dimension) for number in range(len(table)))


def _body(array: Array, table: FreeBlocks, number: int, dimension: int) -> Body:
    def given(column: str, default: Any) -> Any:
        """Return the cell of a column, or a default where it is empty."""
        value = table.value(column, number)
        return default if value is None else value

    place = np.array([given(column, 0.0) for column in ("x_m", "y_m", "z_m")])
    turn = np.radians([given(f"rotation_{axis}_deg", 0.0) for axis in "xyz"])
    length = given("size_z_m", None) if dimension == 3 else np.inf
    name = table.name[number]
    if length is None:
        raise StudyError(must_be(f"`array.free_blocks.size_z_m` of block {name}", "study",
                                 "given, since the study is 3D", "an empty cell"))
    if dimension == 2 and (place[2] or turn[:2].any()):
        raise StudyError(must_be(f"`array.free_blocks` of block {name}", "study",
                                 "in the plane z = 0 and turned about z only, since the study is "
                                 "2D", "another place", "Use dimension = 3."))
    shape, seat = _shape(given, table.shape[number], length)
    pose = Rotation.from_rotvec(turn)
    centre = place + pose.apply([seat.real, seat.imag, 0.0])
    x, y, _ = centre + pose.apply([shape.pivot.real, shape.pivot.imag, 0.0])
    angle = float(np.arctan2(y, x)) if np.hypot(x, y) >= ON_AXIS else 0.0
    own = Rotation.from_euler("z", -angle)
    strength = given("remanence_T", None)
    easy = pose.apply([1.0, 0.0, 0.0])
    if strength is None:
        remanence = np.array([given(f"remanence_{axis}_T", 0.0) for axis in "xyz"])
        strength = float(np.linalg.norm(remanence))
        easy = remanence / strength if strength else easy
    along = given("recoil_permeability", array.recoil_permeability)
    ring, slot = table.places[number]
    return Body(
        array.rings + ring, slot, shape, angle, vector(centre),
        vector(strength * own.apply(easy)), vector(own.apply(easy)), along,
        given("recoil_permeability_across", array.recoil_permeability_across or along),
        parts=uneven_parts(shape, given("magnetization_gradient", 0.0),
                           given("inner_corner_loss", 0.0), name),
        seat=vector((own * pose).as_rotvec()), name=name, type=given("type", ""))


def _shape(given: Any, kind: str, length: float) -> tuple[Shape, complex]:
    """Return a block's shape and, from the table's origin, the place x + iy in m of the shape's."""
    if kind == "cuboid":
        width = given("size_y_m", None)
        return PrismBody(given("size_x_m", None), width, width, length), 0j
    if kind == "trapezoid":
        return PrismBody(given("size_x_m", None), given("inner_width_m", None),
                         given("outer_width_m", None), length), 0j
    if kind == "sector":
        sector = SectorBody(given("inner_radius_m", None), given("outer_radius_m", None),
                            float(np.radians(given("angle_deg", None)) / 2), length)
        return sector, complex(sector.middle)
    if kind == "cylinder":
        return CylinderBody(given("radius_m", None), length), 0j
    if kind == "polygon":
        sides = given("sides", None)
        corners = given("radius_m", None) * np.exp(2j * np.pi * np.arange(sides) / sides)
        return PolygonBody(tuple(corners.tolist()), length), 0j
    corners = np.array([complex(x, y) for x, y in given("outline_m", None)])
    if shoelace(corners) < 0:
        corners = corners[::-1]
    middle = complex(corners.mean())
    return PolygonBody(tuple((corners - middle).tolist()), length), middle
