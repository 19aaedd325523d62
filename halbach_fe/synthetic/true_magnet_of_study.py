"""The true magnet of a study: its blocks, iron and external sources, from the study's keys.

Everything is built from the keys without `halbach_fe.geometry`, so that an error of the geometry of
halbach-fe cannot hide in the synthetic data as well.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import unit_circle
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study.array_keys import Array, BlockException
from halbach_fe.study.external_keys import Neighbour
from halbach_fe.study.free_blocks import FreeBlocks
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.synthetic.shapes import (
    CylinderBody,
    PolygonBody,
    PrismBody,
    SectorBody,
    Shape,
    shoelace,
)
from halbach_fe.synthetic.true_magnet import Body, BodyPart, TrueMagnet, iron_of_study, vector


def free_bodies(array: Array, dimension: int) -> tuple[Body, ...]:
    """Return the nominal bodies of an array's free blocks, in the order of their table.

    Raises
    ------
    StudyError
        If a block of a cross-section lies off its plane, or one of three dimensions has no length.
    """
    table = array.free_blocks
    assert table is not None  # the caller has checked it
    return tuple(_free_body(array, table, number, dimension) for number in range(len(table)))


def _free_body(array: Array, table: FreeBlocks, number: int, dimension: int) -> Body:
    # Distance in m from the magnet's axis within which a block has no angle about it.
    on_axis = 1e-9
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
    shape, seat = _free_shape(given, table.shape[number], length)
    pose = Rotation.from_rotvec(turn)
    centre = place + pose.apply([seat.real, seat.imag, 0.0])
    x, y, _ = centre + pose.apply([shape.pivot.real, shape.pivot.imag, 0.0])
    angle = float(np.arctan2(y, x)) if np.hypot(x, y) >= on_axis else 0.0
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


def _free_shape(given: Any, kind: str, length: float) -> tuple[Shape, complex]:
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


def mounted(bodies: tuple[Body, ...], exceptions: Sequence[BlockException]) -> tuple[Body, ...]:
    """Return nominal bodies with the deviations that exceptions describe.

    Raises
    ------
    StudyError
        If a block without four edges is to have a gradient or a loss at its corners.
    """
    if not exceptions:
        return bodies
    nominal = {(body.ring, body.slot): body for body in bodies}
    found = []
    for body in bodies:
        own = [exception for exception in exceptions
               if (exception.ring or body.ring, exception.slot or body.slot) == (
                   body.ring, body.slot)]
        found.append(_moved(_magnetized(body, own, nominal), own) if own else body)
    return tuple(found)


def uneven_parts(
    shape: Shape, gradient: float, corner_loss: float, name: str
) -> tuple[BodyPart, ...]:
    """Return the parts of a block whose magnetization deviates.

    ``gradient`` is the magnetization of the outer half minus that of the inner half relative to
    their mean, ``corner_loss`` the fraction that both corners at the bore have lost.

    Raises
    ------
    StudyError
        If the shape has not four edges.
    """
    corner_share = 1 / 6  # extent of a corner at the bore relative to a block's width and thickness
    if not (gradient or corner_loss):
        return ()
    if not shape.has_four_edges:
        raise StudyError(must_be(f"magnetization_gradient and inner_corner_loss of block {name}",
                                 "study", "those of a shape of four edges", "another shape",
                                 "Leave the keys out there."))
    side = 2 * corner_share
    halves = (BodyPart((0.0, 0.5), (-1.0, 1.0), 1 - gradient / 2),
              BodyPart((0.5, 1.0), (-1.0, 1.0), 1 + gradient / 2))
    corners = (BodyPart((0.0, corner_share), (-1.0, side - 1.0), 1 - corner_loss),
               BodyPart((0.0, corner_share), (1.0 - side, 1.0), 1 - corner_loss))
    return (halves if gradient else ()) + (corners if corner_loss else ())


def _magnetized(
    body: Body, exceptions: Sequence[BlockException], nominal: dict[tuple[int, int], Body]
) -> Body:
    """Return the body with the materials and magnetization of its exceptions."""
    easy = np.array(body.easy_axis)
    strength = float(easy @ body.remanence)
    along, across, factor, made_for = body.along, body.across, 1.0, None
    gradient = next((2 * (part.factor - 1) for part in body.parts if part.u == (0.5, 1.0)), 0.0)
    loss = next((1 - part.factor for part in body.parts if part.v != (-1.0, 1.0)), 0.0)
    for exception in exceptions:
        if exception.mounted_from is not None:  # the magnetization turns with the faces
            made_for = exception.mounted_from
            easy = body.carried_from(nominal[made_for]).apply(nominal[made_for].easy_axis)
        if exception.magnetization_angle_deg is not None:
            direction = np.radians(exception.magnetization_angle_deg) - body.angle
            easy = unit_circle(direction)
        if exception.remanence_T is not None:
            strength = exception.remanence_T
        if exception.recoil_permeability is not None:
            along = across = exception.recoil_permeability
        if exception.recoil_permeability_across is not None:
            across = exception.recoil_permeability_across
        if exception.magnetization_gradient is not None:
            gradient = exception.magnetization_gradient
        if exception.inner_corner_loss is not None:
            loss = exception.inner_corner_loss
        factor *= exception.magnetization_factor
    if factor == 0:  # the block is missing
        along = across = 1.0
    name = body.name or f"in ring {body.ring}, slot {body.slot}"
    return replace(body, remanence=vector(strength * factor * easy), easy_axis=vector(easy),
                   along=along, across=across, factor=factor, made_for=made_for,
                   parts=uneven_parts(body.shape, gradient, loss, name))


def _moved(body: Body, exceptions: Sequence[BlockException]) -> Body:
    """Return the body displaced and rotated by its exceptions.

    A block is rotated about the mean of its corners. Displacements add up, and so do rotation
    vectors.
    """
    own = Rotation.from_euler("z", body.angle)
    pivot = body.shape.pivot
    arm = body.nominal_orientation.apply([pivot.real, pivot.imag, 0.0])
    middle = arm + body.centre
    shift, turn = np.zeros(3), np.zeros(3)
    for exception in exceptions:
        twist = np.radians([0.0, 0.0, exception.twist_deg])
        shift += own.apply(exception.displacement_m) + exception.shift_m
        shift += Rotation.from_rotvec(twist).apply(middle) - middle
        tilt = np.radians([*exception.tilt_deg, 0.0])
        centre = np.array([0.0, 0.0, middle[2]])
        shift += Rotation.from_rotvec(tilt).apply(middle - centre) - (middle - centre)
        turn += own.apply(np.radians(exception.rotation_deg)) + twist + tilt
    if not (shift.any() or turn.any()):
        return body
    shift += arm - Rotation.from_rotvec(turn).apply(arm)
    return replace(body, displacement=vector(shift), rotation=vector(turn))


def magnet_of(study: Study) -> TrueMagnet:
    """Return the nominal magnet of a study, with the deviations that its exceptions describe.

    Raises
    ------
    StudyError
        If a block cannot be as the study describes it.
    """
    array, dimension = study.array, study.dimension
    rings = [array.of_ring(ring) if array.ring else array for ring in range(1, array.rings + 1)]
    bodies = tuple(_body(values, ring, slot, z, dimension)
                   for ring, (values, z) in enumerate(zip(
                       rings, _ring_middles(array, rings, dimension), strict=True), start=1)
                   for slot in range(1, values.blocks_per_ring + 1))
    if array.free_blocks is not None:
        bodies += free_bodies(array, dimension)
    nominal = TrueMagnet(dimension, bodies)
    external = study.external
    if external.coils:
        raise StudyError(must_be("`external.coils`", f"study {study.name}",
                                 "left out to simulate a campaign", "given",
                                 "The field of the magnet can be computed with them."))
    bodies = mounted(bodies, array.exceptions)
    return replace(
        nominal, bodies=bodies,
        iron=iron_of_study(study, nominal.half_length), background=external.background_T,
        neighbours=tuple(body for each in external.neighbours
                         for body in beside_magnet(each, bodies)),
        dipoles=tuple((each.position_m, each.moment_A_m2) for each in external.dipoles))


def beside_magnet(neighbour: Neighbour, bodies: tuple[Body, ...]) -> tuple[Body, ...]:
    """Return the blocks of a magnet where a neighbour has them, with their remanences there."""
    turn = float(np.radians(neighbour.turn_deg))
    return tuple(replace(
        body.turned(turn).lifted(neighbour.z_m),
        remanence=vector(neighbour.factor * np.array(body.remanence))) for body in bodies)


def _ring_middles(array: Array, rings: list[Array], dimension: int) -> list[float]:
    """Return the middle of every ring along z in m.

    Rings of a layer are stacked in their order, each stack centred at z = 0.
    """
    if dimension == 2:
        return [0.0] * len(rings)
    stacks: defaultdict[int, list[int]] = defaultdict(list)
    middles = np.zeros(len(rings))
    for number in range(len(rings)):
        own = array.ring[number] if array.ring else None
        if own is not None and own.z_m is not None:
            middles[number] = own.z_m
        else:
            stacks[own.layer if own else 1].append(number)
    for stack in stacks.values():
        lengths = np.array([rings[number].ring_length_m or 0.0 for number in stack])
        gaps = np.array([rings[number].ring_gap_m for number in stack])
        starts = np.concatenate([[0.0], np.cumsum(lengths + gaps)[:-1]])
        middles[stack] = starts + lengths / 2 - (starts[-1] + lengths[-1]) / 2
    return middles.tolist()


def _body(values: Array, ring: int, slot: int, z: float, dimension: int) -> Body:
    step = 2 * np.pi / values.blocks_per_ring
    angle = np.radians(values.first_block_angle_deg) + (slot - 1) * step
    direction = np.radians(values.first_magnetization_angle_deg) + (
        slot - 1) * (values.multipole_order + 1) * step
    along = values.recoil_permeability
    across = values.recoil_permeability_across or along
    length = np.inf if dimension == 2 else float(values.ring_length_m or 0.0)
    shape = _shape(values, length, direction - angle)
    remanence = values.remanence_T
    if remanence is None:
        assert values.block_moment_A_m2 is not None  # a ring has the remanence or the moment
        solid = replace(shape, length=float(values.ring_length_m or 0.0))
        remanence = MU_0 * values.block_moment_A_m2 / solid.volume
    middle = (values.inner_radius_m + values.outer_radius_m) / 2
    easy = (float(np.cos(direction - angle)), float(np.sin(direction - angle)), 0.0)
    return Body(ring, slot, shape, float(angle),
                (float(middle * np.cos(angle)), float(middle * np.sin(angle)), z),
                vector(remanence * np.array(easy)), easy, along, across)


def _shape(values: Array, length: float, facing: float) -> SectorBody | PrismBody:
    inner, outer, block = values.inner_radius_m, values.outer_radius_m, values.block
    half = np.pi / values.blocks_per_ring
    if block.shape == "sector":
        half -= np.radians(block.angular_gap_deg) / 2
        if half <= 0:
            raise StudyError(must_be("`array.block.angular_gap_deg`", "study",
                                     "less than the pitch of the blocks",
                                     f"{block.angular_gap_deg:g}", "Reduce the gap."))
        return SectorBody(inner, outer, float(half), length)
    if block.shape == "trapezoid":
        clearance = block.side_gap_m / np.cos(half)
        inside, outside = (2 * radius * np.tan(half) - clearance for radius in (inner, outer))
        if inside <= 0:
            raise StudyError(must_be("`array.block.side_gap_m`", "study",
                                     "so small that blocks have some width at the inner radius",
                                     f"{block.side_gap_m:g}", "Reduce the gap."))
        return PrismBody(outer - inner, float(inside), float(outside), length)
    turn = facing if block.orientation == "magnetization" else 0.0
    return PrismBody(outer - inner, block.width_m, block.width_m, length, float(turn))
