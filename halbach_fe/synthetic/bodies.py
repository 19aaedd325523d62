"""The true magnet of a study: its blocks, iron and external sources, from the study's keys.

Everything is built from the keys without `halbach_fe.geometry`, so that an error of the geometry of
halbach-fe cannot hide in the synthetic data as well.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study.array import Array, Block
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.synthetic.block_exceptions import mounted
from halbach_fe.synthetic.free_bodies import free_bodies
from halbach_fe.synthetic.iron import iron_of_study
from halbach_fe.synthetic.shapes import PrismBody, SectorBody
from halbach_fe.synthetic.true_magnet import Body, TrueMagnet, VacuumNeighbour, vector


@dataclass(frozen=True)
class RingValues:
    """The values of one ring: its own, and those of the array where it has none.

    The names are those of `halbach_fe.study.array.Ring`, of which exactly one strength is given.
    """

    multipole_order: int
    blocks_per_ring: int
    inner_radius_m: float
    outer_radius_m: float
    ring_length_m: float | None
    ring_gap_m: float
    first_block_angle_deg: float
    first_magnetization_angle_deg: float
    recoil_permeability: float
    recoil_permeability_across: float | None
    remanence_T: float | None
    block_moment_A_m2: float | None
    block: Block


def magnet_of(study: Study) -> TrueMagnet:
    """Return the nominal magnet of a study, with the deviations that its exceptions describe.

    Raises
    ------
    StudyError
        If a block cannot be as the study describes it.
    """
    array, dimension = study.array, study.dimension
    rings = [ring_values(array, ring) for ring in range(1, array.rings + 1)]
    bodies = tuple(_body(values, ring, slot, z, dimension)
                   for ring, (values, z) in enumerate(zip(
                       rings, _ring_middles(array, rings, dimension), strict=True), start=1)
                   for slot in range(1, values.blocks_per_ring + 1))
    if array.free_blocks is not None:
        bodies += free_bodies(array, dimension)
    nominal = TrueMagnet(dimension, bodies)
    external = study.external
    return replace(
        nominal, bodies=mounted(bodies, array.exceptions),
        iron=iron_of_study(study, nominal.half_length), background=external.background_T,
        neighbours=tuple(VacuumNeighbour(each.z_m, float(np.radians(each.turn_deg)), each.factor)
                         for each in external.neighbours),
        dipoles=tuple((each.position_m, each.moment_A_m2) for each in external.dipoles))


def ring_values(array: Array, ring: int) -> RingValues:
    """Return the values that hold for a ring (from 1)."""
    keys = RingValues.__dataclass_fields__
    values = {key: getattr(array, key) for key in keys}
    if array.ring:
        own = {key: value for key in keys
               if (value := getattr(array.ring[ring - 1], key)) is not None}
        if "remanence_T" in own or "block_moment_A_m2" in own:
            values |= {"remanence_T": None, "block_moment_A_m2": None}
        values |= own
    return RingValues(**values)


def _ring_middles(array: Array, rings: list[RingValues], dimension: int) -> list[float]:
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


def _body(values: RingValues, ring: int, slot: int, z: float, dimension: int) -> Body:
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


def _shape(values: RingValues, length: float, facing: float) -> SectorBody | PrismBody:
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
