"""Hidden effects of the magnet: geometry, magnetization, materials, surroundings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.hidden_effects.effect_types import (
    HiddenEffect,
    HiddenParameter,
    Site,
    draw_direction,
    draw_length,
    draw_number,
    draw_place,
    log_uniform,
    signed_log_uniform,
)
from halbach_fe.synthetic.iron import FroehlichLaw, TrueIron, Tube
from halbach_fe.synthetic.knee_losses import with_knee_losses
from halbach_fe.synthetic.shapes import PrismBody, SectorBody
from halbach_fe.synthetic.true_magnet import (
    Body,
    BodyPart,
    MagnetCopy,
    SoftSphere,
    TrueMagnet,
    vector,
)

BLOCK = (HiddenParameter("ring"), HiddenParameter("slot"))
SMCO = -3.5e-4
"""Temperature coefficient of the remanence of Sm2Co17 in 1/K."""

Change = Callable[[Body], Body]


def _bodies(magnet: TrueMagnet, change: Change,
            selected: Callable[[Body], bool] = bool) -> TrueMagnet:
    """Return the magnet with some of its bodies changed, by default all."""
    return replace(magnet, bodies=tuple(
        change(body) if selected(body) else body for body in magnet.bodies))


def _at(ring: float, slot: float) -> Callable[[Body], bool]:
    """Return a function that tells whether a body is the block of a ring and slot."""
    return lambda body: (body.ring, body.slot) == (ring, slot)


def _of_ring(ring: float) -> Callable[[Body], bool]:
    """Return a function that tells whether a body belongs to a ring."""
    return lambda body: body.ring == ring


def _is_there(body: Body) -> bool:
    """Tell whether a block is not missing."""
    return any(body.remanence)


def _moved(body: Body, shift: tuple[float, ...]) -> Body:
    return replace(body, displacement=vector(np.add(body.displacement, shift)))


def _moved_along_its_axes(body: Body, shift: tuple[float, ...]) -> Body:
    return _moved(body, vector(Rotation.from_euler("z", body.angle).apply(shift)))


def _scaled(body: Body, factor: float) -> Body:
    return replace(body, remanence=vector(np.array(body.remanence) * factor))


# --- materials ---------------------------------------------------------------------------------


def iron_ring(
    magnet: TrueMagnet, site: Site, inner: float, outer: float, permeability: float,
    saturation: float
) -> TrueMagnet:
    """Add an iron tube as long as the magnet; without saturation its permeability is constant."""
    if outer <= inner or permeability == 1:
        return magnet
    law = FroehlichLaw(permeability, saturation) if saturation else permeability
    return replace(magnet, iron=TrueIron((Tube(inner, outer, site.half_length),), law))


def _draw_iron(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    corner = site.outer  # and of trapezoids, the outermost radius
    if site.is_uniform:
        corner = site.outer / np.cos(np.pi / site.slots)
    inner = corner + site.scale * log_uniform(generator, 0.002, 0.02)
    return (inner, inner + site.scale * log_uniform(generator, 0.003, 0.02),
            log_uniform(generator, 200, 3000), float(generator.uniform(1.6, 2.2)))


def recoil_permeability(magnet: TrueMagnet, site: Site, more: float) -> TrueMagnet:
    """Raise the recoil permeability of all blocks in all directions, at the same remanence."""
    return _bodies(magnet, lambda body: replace(body, along=body.along + more,
                                                across=body.across + more), _is_there)


def recoil_permeability_across(magnet: TrueMagnet, site: Site, more: float) -> TrueMagnet:
    """Raise the recoil permeability of all blocks across their easy axes only."""
    return _bodies(magnet, lambda body: replace(body, across=body.across + more), _is_there)


def _draw_recoil(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    lowest = 1 - site.permeability  # no magnet has a recoil permeability below 1
    draw = signed_log_uniform if lowest < -0.01 else log_uniform
    return (max(draw(generator, 0.01, 0.06), lowest),)


# --- geometry ----------------------------------------------------------------------------------


def block_displaced(magnet: TrueMagnet, site: Site, ring: float, slot: float, radial: float,
                    azimuthal: float, z: float) -> TrueMagnet:
    """Displace one block along its own axes."""
    return _bodies(magnet, lambda body: _moved_along_its_axes(body, (radial, azimuthal, z)),
                   _at(ring, slot))


def block_turned(magnet: TrueMagnet, site: Site, ring: float, slot: float, radial: float,
                 azimuthal: float, z: float) -> TrueMagnet:
    """Turn one block about its middle by a rotation vector along its own axes."""
    def turned(body: Body) -> Body:
        turn = Rotation.from_rotvec(
            Rotation.from_euler("z", body.angle).apply([radial, azimuthal, z]))
        return replace(body, rotation=vector(
            (turn * Rotation.from_rotvec(body.rotation)).as_rotvec()))

    return _bodies(magnet, turned, _at(ring, slot))


def radial_gap(magnet: TrueMagnet, site: Site, distance: float) -> TrueMagnet:
    """Move all blocks outwards."""
    return _bodies(magnet, lambda body: _moved_along_its_axes(body, (distance, 0.0, 0.0)))


def azimuthal_gap(magnet: TrueMagnet, site: Site, distance: float) -> TrueMagnet:
    """Make all blocks narrower by ``distance``, half of it on each side.

    The positions of the blocks stay. Sectors lose the angle that corresponds to the distance at
    their mean radius.
    """
    def thinner(body: Body) -> Body:
        shape = body.shape
        if isinstance(shape, SectorBody):
            less: SectorBody | PrismBody = replace(
                shape, half_angle=shape.half_angle - distance / 2 / shape.middle)
        else:
            assert isinstance(shape, PrismBody)  # as all other blocks of rings
            less = replace(shape, inner_width=shape.inner_width - distance,
                           outer_width=shape.outer_width - distance)
        return replace(body, shape=less, meshed_shape=body.meshed_shape or shape)

    return _bodies(magnet, thinner)


def ring_gap(magnet: TrueMagnet, site: Site, seam: float, distance: float) -> TrueMagnet:
    """Move all rings beyond a seam along z; seam 1 is between the first two rings."""
    return _bodies(magnet, lambda body: _moved(body, (0.0, 0.0, distance)),
                   lambda body: body.ring > seam)


def ring_twisted(magnet: TrueMagnet, site: Site, ring: float, angle: float) -> TrueMagnet:
    """Turn one ring about the z axis."""
    turn = Rotation.from_euler("z", angle)

    def twisted(body: Body) -> Body:
        return replace(
            body, displacement=vector(turn.apply(body.position) - body.centre),
            rotation=vector((turn * Rotation.from_rotvec(body.rotation)).as_rotvec()))

    return _bodies(magnet, twisted, _of_ring(ring))


def ring_shifted(magnet: TrueMagnet, site: Site, ring: float, x: float, y: float) -> TrueMagnet:
    """Displace one ring across the axis."""
    return _bodies(magnet, lambda body: _moved(body, (x, y, 0.0)), _of_ring(ring))


def ring_shifted_along(magnet: TrueMagnet, site: Site, ring: float, z: float) -> TrueMagnet:
    """Displace one ring along the axis."""
    return _bodies(magnet, lambda body: _moved(body, (0.0, 0.0, z)), _of_ring(ring))


def ring_tilted(magnet: TrueMagnet, site: Site, ring: float, x: float, y: float) -> TrueMagnet:
    """Turn one ring about its middle by a rotation vector across the axis."""
    turn = Rotation.from_rotvec([x, y, 0.0])

    def tilted(body: Body) -> Body:
        centre = np.array([0.0, 0.0, body.centre[2]])
        return replace(
            body, displacement=vector(
                turn.apply(body.position - centre) + centre - np.array(body.centre)),
            rotation=vector((turn * Rotation.from_rotvec(body.rotation)).as_rotvec()))

    return _bodies(magnet, tilted, _of_ring(ring))


def halves_apart(magnet: TrueMagnet, site: Site, slot: float, apart: float, sideways: float,
                 z: float) -> TrueMagnet:
    """Move both sides of a plane through the axis, half a slot beyond a slot's middle, apart."""
    own = [body for body in magnet.bodies if body.ring == 1]
    beside = next(body for body in own if body.slot == slot)
    direction = np.arctan2(*beside.centre[1::-1]) + np.pi / len(own) + np.pi / 2
    normal = np.array([np.cos(direction), np.sin(direction), 0.0])
    shift = apart * normal + sideways * np.cross([0, 0, 1], normal) + [0, 0, z]
    return _bodies(magnet, lambda body: _moved(
        body, vector(np.sign(normal @ body.centre) / 2 * shift)))


def ring_demagnetized(magnet: TrueMagnet, site: Site, ring: float, fraction: float) -> TrueMagnet:
    """Take a fraction off the magnetization of all blocks of a ring."""
    return _bodies(magnet, lambda body: _scaled(body, 1 - fraction), _of_ring(ring))


def inner_radius(magnet: TrueMagnet, site: Site, more: float) -> TrueMagnet:
    """Increase the inner radius of all blocks by ``more``; their outer faces stay."""
    def shorter(body: Body) -> Body:
        shape = body.shape
        if isinstance(shape, SectorBody):
            less: SectorBody | PrismBody = replace(shape, inner=shape.inner + more)
        else:
            assert isinstance(shape, PrismBody)  # as all other blocks of rings
            slope = (shape.outer_width - shape.inner_width) / shape.depth
            less = replace(shape, depth=shape.depth - more,
                           inner_width=shape.inner_width + slope * more)
        step = vector(Rotation.from_euler("z", body.angle).apply([more / 2, 0.0, 0.0]))
        return replace(body, shape=less, centre=vector(np.add(body.centre, step)))

    return _bodies(magnet, shorter)


def magnet_length(magnet: TrueMagnet, site: Site, fraction: float) -> TrueMagnet:
    """Make all rings, and the distances between them, longer by a fraction."""
    def longer(body: Body) -> Body:
        x, y, z = body.centre
        return replace(body, centre=(x, y, z * (1 + fraction)),
                       shape=replace(body.shape, length=body.shape.length * (1 + fraction)))

    return _bodies(magnet, longer)


# --- magnetization -----------------------------------------------------------------------------


def blocks_swapped(magnet: TrueMagnet, site: Site, ring: float, slot: float, other_ring: float,
                   other_slot: float) -> TrueMagnet:
    """Exchange two blocks; each keeps its magnetization in the axes of its faces."""
    first, second = (int(ring), int(slot)), (int(other_ring), int(other_slot))
    return _exchanged(magnet, {first: second, second: first})


def _exchanged(magnet: TrueMagnet, sources: Mapping[tuple[int, int], tuple[int, int]]
               ) -> TrueMagnet:
    """Return the magnet with blocks from other places, by ring and slot."""
    bodies = {(body.ring, body.slot): body for body in magnet.bodies}

    def as_other(body: Body) -> Body:
        other = bodies[sources[body.ring, body.slot]]
        turn = body.carried_from(other)
        return replace(body, remanence=vector(turn.apply(other.remanence)),
                       easy_axis=vector(turn.apply(other.easy_axis)),
                       along=other.along, across=other.across, parts=other.parts)

    return _bodies(magnet, as_other, lambda body: (body.ring, body.slot) in sources)


def rings_swapped(magnet: TrueMagnet, site: Site, ring: float, other_ring: float) -> TrueMagnet:
    """Exchange two rings of as many blocks, slot by slot."""
    first, second = int(ring), int(other_ring)
    sources = {(here, slot): (there, slot) for here, there in ((first, second), (second, first))
               for slot in site.slots_of(first)}
    return _exchanged(magnet, sources)


def rings_turned(magnet: TrueMagnet, site: Site, ring: float, slots: float) -> TrueMagnet:
    """Turn one ring about the axis by whole slots."""
    own = site.slots_of(ring)
    return _exchanged(magnet, {(int(ring), slot): (int(ring), own[number - int(slots)])
                               for number, slot in enumerate(own)})


def block_put_in_wrongly(magnet: TrueMagnet, site: Site, ring: float, slot: float, radial: float,
                         azimuthal: float, z: float) -> TrueMagnet:
    """Turn one block in its slot by a rotation vector along its own axes, after which it fits.

    The body's faces stay where they are; its magnetization turns.
    """
    turn = Rotation.from_rotvec([radial, azimuthal, z])
    return _bodies(magnet, lambda body: replace(
        body, remanence=vector(turn.apply(body.remanence)),
        easy_axis=vector(turn.apply(body.easy_axis))), _at(ring, slot))


def block_flipped(magnet: TrueMagnet, site: Site, ring: float, slot: float) -> TrueMagnet:
    """Reverse the magnetization of one block."""
    return _bodies(magnet, lambda body: _scaled(body, -1.0), _at(ring, slot))


def block_missing(magnet: TrueMagnet, site: Site, ring: float, slot: float) -> TrueMagnet:
    """Remove one block."""
    return _bodies(magnet, lambda body: replace(_scaled(body, 0.0), along=1.0, across=1.0),
                   _at(ring, slot))


def block_demagnetized(
    magnet: TrueMagnet, site: Site, ring: float, slot: float, fraction: float
) -> TrueMagnet:
    """Take a fraction off the magnetization of one block."""
    return _bodies(magnet, lambda body: _scaled(body, 1 - fraction), _at(ring, slot))


def corners_demagnetized(magnet: TrueMagnet, site: Site, fraction: float) -> TrueMagnet:
    """Take a fraction off the magnetization of both inner corners of all blocks."""
    # Size of an inner corner of a block. It is the fraction of the block's thickness, counted from
    # inside, and of its half width, counted from the side.
    corner = (0.1, 0.2)
    depth, width = corner
    parts = (BodyPart((0.0, depth), (-1.0, width - 1.0), 1 - fraction),
             BodyPart((0.0, depth), (1.0 - width, 1.0), 1 - fraction))
    return _bodies(magnet, lambda body: replace(body, parts=(*body.parts, *parts)))


def knee(magnet: TrueMagnet, site: Site, coercivity: float, squareness: float) -> TrueMagnet:
    """Take off what a knee of the demagnetization curve lets the blocks' own field take."""
    return with_knee_losses(magnet, MU_0 * coercivity, squareness)


def magnetization_gradient(
    magnet: TrueMagnet, site: Site, ring: float, slot: float, fraction: float
) -> TrueMagnet:
    """Make the inner half of a block's thickness weaker by a fraction, and the outer one stronger.

    Ring and slot 0 stand for all blocks.
    """
    parts = (BodyPart((0.0, 0.5), (-1.0, 1.0), 1 - fraction),
             BodyPart((0.5, 1.0), (-1.0, 1.0), 1 + fraction))
    return _bodies(magnet, lambda body: replace(body, parts=(*body.parts, *parts)),
                   bool if (ring, slot) == (0, 0) else _at(ring, slot))


def _draw_gradient(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    if generator.random() < 0.5:
        return 0.0, 0.0, signed_log_uniform(generator, 0.005, 0.03)
    return *draw_place(site, generator), signed_log_uniform(generator, 0.02, 0.1)


def temperature(magnet: TrueMagnet, site: Site, change: float, coefficient: float) -> TrueMagnet:
    """Change the temperature of the whole magnet."""
    return _bodies(magnet, lambda body: _scaled(body, 1 + coefficient * change))


def temperature_gradient(magnet: TrueMagnet, site: Site, change: float,
                         coefficient: float) -> TrueMagnet:
    """Let the temperature rise along y by ``change`` from one side of the magnet to the other."""
    return _bodies(magnet, lambda body: _scaled(
        body, 1 + coefficient * change * body.position[1] / (2 * site.outer)))


# --- surroundings ------------------------------------------------------------------------------


def background(magnet: TrueMagnet, site: Site, x: float, y: float, z: float) -> TrueMagnet:
    """Add a uniform field."""
    return replace(magnet, background=vector(np.add(magnet.background, (x, y, z))))


def neighbour_magnet(magnet: TrueMagnet, site: Site, distance: float) -> TrueMagnet:
    """Add a copy of the magnet on its axis, with ``distance`` between the facing ends.

    A negative distance puts the copy at lower z.
    """
    shift = np.sign(distance) * (2 * site.half_length + abs(distance))
    return replace(magnet, copies=(*magnet.copies, MagnetCopy(float(shift))))


def _draw_neighbour(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    """Draw a distance that keeps the neighbour beyond the points of the map."""
    gap = signed_log_uniform(generator, 0.5, 2.0) * site.outer
    end = site.z_max if gap > 0 else -site.z_min
    return (float(gap + np.sign(gap) * max(end - site.half_length, 0.0)),)


def ferromagnetic_object(
    magnet: TrueMagnet, site: Site, x: float, y: float, z: float, volume: float
) -> TrueMagnet:
    """Add a small sphere of soft iron, which the field at its place magnetizes."""
    return replace(magnet, objects=(*magnet.objects, SoftSphere((x, y, z), volume)))


def _draw_object(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    """Draw a sphere in the bore between probe and blocks, or outside the array if it has no room.

    Its volume is such that it changes the field at the nearest probe by a small fraction.
    """
    radius = (site.radius + site.inner) / 2 if site.radius < site.inner else 2 * site.outer
    angle = generator.uniform(0, 2 * np.pi)
    z = generator.uniform(max(site.z_min, -site.half_length), min(site.z_max, site.half_length))
    room = abs(site.inner - site.radius) / 2
    # a dipole of moment 3 V B / mu_0 changes the field at a distance d by up to 6 V B / (4 pi d^3)
    volume = log_uniform(generator, 5e-4, 5e-3) * 4 * np.pi / 6 * room**3
    return (float(radius * np.cos(angle)), float(radius * np.sin(angle)),
            float(z) if site.dimension == 3 else 0.0, volume)


# --- the list ----------------------------------------------------------------------------------


def _draw_displacement(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    amount = site.scale * log_uniform(generator, 2e-4, 1e-3)
    return *draw_place(site, generator), *(
        amount * value for value in draw_direction(generator, site.dimension))


def _draw_turn(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    axis = draw_direction(generator) if site.dimension == 3 else (0.0, 0.0, 1.0)
    amount = signed_log_uniform(generator, 0.02, 0.08)
    return *draw_place(site, generator), *(amount * value for value in axis)


def _draw_swap(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    ring, slot = draw_place(site, generator)
    slots = site.slots_of(ring)
    step = generator.integers(1, len(slots)) if len(slots) > 1 else 0
    return ring, slot, ring, float(slots[(slots.index(int(slot)) + step) % len(slots)])


def _draw_two(count: int, generator: np.random.Generator) -> tuple[float, ...]:
    """Draw two different numbers from 1."""
    first, second = 1 + generator.choice(count, 2, replace=False)
    return float(first), float(second)


def _draw_shift(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    amount = site.scale * log_uniform(generator, 1e-4, 5e-4)
    ring, _ = draw_place(site, generator)
    return ring, *(amount * value for value in draw_direction(generator, 2)[:2])


M, RAD, PER_K = "m", "rad", "1/K"
OWN_AXES = ("radial", "azimuthal", "z")
LOST = HiddenParameter("fraction", least=0.0, most=1.0)
PERMEABILITY = HiddenParameter("change", least=-0.5, most=10.0)

EFFECTS = (
    HiddenEffect("iron_ring", "field",
                 (HiddenParameter("inner_radius", M, 1e-4, 100.0),
                  HiddenParameter("outer_radius", M, 1e-4, 100.0),
                  HiddenParameter("relative_permeability", least=1.0, most=1e6),
                  HiddenParameter("saturation_polarization", "T", 0.0, 3.0)),
                 _draw_iron, iron_ring,
                 needs=("no iron",)),
    HiddenEffect("recoil_permeability", "field", (PERMEABILITY,), _draw_recoil,
                 recoil_permeability, of_blocks=True),
    HiddenEffect("recoil_permeability_across", "field", (PERMEABILITY,),
                 draw_number(0.03, 0.15, False), recoil_permeability_across, of_blocks=True),
    HiddenEffect("block_displaced", "field",
                 (*BLOCK, *(HiddenParameter(name, M) for name in OWN_AXES)), _draw_displacement,
                 block_displaced),
    HiddenEffect("block_turned", "field",
                 (*BLOCK, *(HiddenParameter(name, RAD) for name in OWN_AXES)), _draw_turn,
                 block_turned),
    HiddenEffect("radial_gap", "field", (HiddenParameter("distance", M),),
                 draw_length(5e-5, 4e-4, False), radial_gap),
    HiddenEffect("azimuthal_gap", "field", (HiddenParameter("distance", M),),
                 draw_length(5e-5, 4e-4, False), azimuthal_gap, needs=("equal rings",),
                 of_blocks=True),
    HiddenEffect("ring_gap", "field", (HiddenParameter("seam"), HiddenParameter("distance", M)),
                 lambda site, generator: (float(generator.integers(1, site.rings)),
                                          site.scale * log_uniform(generator, 5e-5, 5e-4)),
                 ring_gap, needs=("3d", "rings", "equal rings")),
    HiddenEffect("ring_twisted", "field", (HiddenParameter("ring"), HiddenParameter("angle", RAD)),
                 lambda site, generator: (draw_place(site, generator)[0],
                                          signed_log_uniform(generator, 1e-3, 1e-2)), ring_twisted,
                 needs=("3d", "rings")),
    HiddenEffect("ring_shifted", "field",
                 (HiddenParameter("ring"), HiddenParameter("x", M), HiddenParameter("y", M)),
                 _draw_shift, ring_shifted, needs=("3d", "rings")),
    HiddenEffect("ring_shifted_along", "field",
                 (HiddenParameter("ring"), HiddenParameter("z", M)),
                 lambda site, generator: (draw_place(site, generator)[0],
                                          site.scale * signed_log_uniform(generator, 2e-4, 1e-3)),
                 ring_shifted_along, needs=("3d", "rings")),
    HiddenEffect("ring_tilted", "field",
                 (HiddenParameter("ring"), HiddenParameter("x", RAD), HiddenParameter("y", RAD)),
                 lambda site, generator: (
                     draw_place(site, generator)[0],
                     *(log_uniform(generator, 1e-3, 5e-3) * value
                       for value in draw_direction(generator, 2)[:2])),
                 ring_tilted, needs=("3d", "rings")),
    HiddenEffect("ring_demagnetized", "field", (HiddenParameter("ring"), LOST),
                 lambda site, generator: (draw_place(site, generator)[0],
                                          log_uniform(generator, 0.02, 0.08)),
                 ring_demagnetized, needs=("3d", "rings")),
    HiddenEffect("halves_apart", "field",
                 (HiddenParameter("slot"), HiddenParameter("apart", M),
                  HiddenParameter("sideways", M), HiddenParameter("z", M)),
                 lambda site, generator: (
                     draw_place(site, generator)[1],
                     site.scale * log_uniform(generator, 2e-4, 1e-3), 0.0, 0.0),
                 halves_apart, needs=("3d", "equal rings")),
    HiddenEffect("blocks_swapped", "field",
                 (*BLOCK, HiddenParameter("other_ring"), HiddenParameter("other_slot")), _draw_swap,
                 blocks_swapped),
    HiddenEffect("block_put_in_wrongly", "field",
                 (*BLOCK, *(HiddenParameter(name, RAD) for name in OWN_AXES)),
                 lambda site, generator: (*draw_place(site, generator), np.pi, 0.0, 0.0),
                 block_put_in_wrongly),
    HiddenEffect("rings_swapped", "field",
                 (HiddenParameter("ring"), HiddenParameter("other_ring")),
                 lambda site, generator: _draw_two(site.rings, generator), rings_swapped,
                 needs=("3d", "rings", "equal rings")),
    HiddenEffect("rings_turned", "field", (HiddenParameter("ring"), HiddenParameter("slots")),
                 lambda site, generator: (draw_place(site, generator)[0], 1.0), rings_turned,
                 needs=("3d", "rings")),
    HiddenEffect("block_flipped", "field", BLOCK, draw_place, block_flipped),
    HiddenEffect("block_missing", "field", BLOCK, draw_place, block_missing),
    HiddenEffect("block_demagnetized", "field", (*BLOCK, LOST),
                 lambda site, generator: (*draw_place(site, generator),
                                          log_uniform(generator, 0.04, 0.3)),
                 block_demagnetized),
    HiddenEffect("corners_demagnetized", "field", (LOST,),
                 draw_number(0.03, 0.3, False), corners_demagnetized, needs=("four edges",)),
    HiddenEffect("magnetization_gradient", "field",
                 (*BLOCK, HiddenParameter("fraction", least=-1.0, most=1.0)),
                 _draw_gradient, magnetization_gradient, needs=("four edges",), of_blocks=True),
    HiddenEffect("temperature", "field",  # from room temperature, not below absolute zero
                 (HiddenParameter("change", "K", least=-293.0),
                  HiddenParameter("coefficient", PER_K)),
                 lambda site, generator: (signed_log_uniform(generator, 2, 15), SMCO), temperature),
    HiddenEffect("temperature_gradient", "field",
                 (HiddenParameter("change", "K"), HiddenParameter("coefficient", PER_K)),
                 lambda site, generator: (signed_log_uniform(generator, 3, 15), SMCO),
                 temperature_gradient),
    HiddenEffect("inner_radius", "field", (HiddenParameter("change", M),), draw_length(1e-4, 6e-4),
                 inner_radius, needs=("equal rings",), of_blocks=True),
    HiddenEffect("length", "field", (HiddenParameter("fraction", least=-0.5, most=0.5),),
                 draw_number(5e-4, 4e-3),
                 magnet_length, needs=("3d", "equal rings"), of_blocks=True),
    HiddenEffect("background", "field", tuple(HiddenParameter(name, "T") for name in "xyz"),
                 lambda site, generator: tuple(
                     float(value) for value in log_uniform(generator, 5e-5, 5e-4)
                     * np.array(draw_direction(generator, site.dimension))), background),
    HiddenEffect("neighbour_magnet", "field", (HiddenParameter("distance", M, -100.0, 100.0),),
                 _draw_neighbour, neighbour_magnet, needs=("3d",)),
    HiddenEffect("ferromagnetic_object", "field",
                 (*(HiddenParameter(name, M) for name in "xyz"),
                  HiddenParameter("volume", "m^3", 1e-12)),
                 _draw_object, ferromagnetic_object, needs=("3d",)),
    HiddenEffect("knee", "field",
                 (HiddenParameter("coercivity", "A/m", 1.0),
                  HiddenParameter("squareness", least=0.01, most=1.0)),
                 lambda site, generator: (generator.uniform(5.0e5, 5.8e5),
                                          generator.uniform(0.8, 0.9)),
                 knee, needs=("3d", "vacuum", "few blocks", "four edges")),
)
