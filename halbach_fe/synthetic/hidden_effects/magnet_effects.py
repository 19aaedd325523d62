"""Hidden effects of the magnet: geometry, magnetization, materials, surroundings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import unit_circle
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.hidden_effects.effect_types import (
    METRES,
    Check,
    Draw,
    HiddenEffect,
    Need,
    Refused,
    Site,
    Values,
    draw_direction,
    draw_length,
    draw_number,
    draw_place,
    log_uniform,
    parameters,
    signed_log_uniform,
)
from halbach_fe.synthetic.reaction import with_knee_losses
from halbach_fe.synthetic.shapes import PrismBody, SectorBody
from halbach_fe.synthetic.true_magnet import (
    Body,
    BodyPart,
    FroehlichLaw,
    MagnetCopy,
    SoftSphere,
    TrueIron,
    TrueMagnet,
    Tube,
    vector,
)

SMCO = -3.5e-4
"""Temperature coefficient of the remanence of Sm2Co17 in 1/K."""

Change = Callable[[Body], Body]
Apply = Callable[..., TrueMagnet]
"""Function of a magnet, the site and the values that returns the magnet with the effect."""


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
    return _ring_turned(magnet, ring, Rotation.from_euler("z", angle))


def _ring_turned(magnet: TrueMagnet, ring: float, turn: Rotation) -> TrueMagnet:
    """Turn one ring about its middle."""
    def turned(body: Body) -> Body:
        centre = np.array([0.0, 0.0, body.centre[2]])
        return replace(
            body, displacement=vector(
                turn.apply(body.position - centre) + centre - np.array(body.centre)),
            rotation=vector((turn * Rotation.from_rotvec(body.rotation)).as_rotvec()))

    return _bodies(magnet, turned, _of_ring(ring))


def ring_shifted(magnet: TrueMagnet, site: Site, ring: float, x: float, y: float) -> TrueMagnet:
    """Displace one ring across the axis."""
    return _bodies(magnet, lambda body: _moved(body, (x, y, 0.0)), _of_ring(ring))


def ring_shifted_along(magnet: TrueMagnet, site: Site, ring: float, z: float) -> TrueMagnet:
    """Displace one ring along the axis."""
    return _bodies(magnet, lambda body: _moved(body, (0.0, 0.0, z)), _of_ring(ring))


def ring_tilted(magnet: TrueMagnet, site: Site, ring: float, x: float, y: float) -> TrueMagnet:
    """Turn one ring about its middle by a rotation vector across the axis."""
    return _ring_turned(magnet, ring, Rotation.from_rotvec([x, y, 0.0]))


def halves_apart(magnet: TrueMagnet, site: Site, slot: float, apart: float, sideways: float,
                 z: float) -> TrueMagnet:
    """Move both sides of a plane through the axis, half a slot beyond a slot's middle, apart."""
    own = [body for body in magnet.bodies if body.ring == 1]
    beside = next(body for body in own if body.slot == slot)
    direction = np.arctan2(*beside.centre[1::-1]) + np.pi / len(own) + np.pi / 2
    normal = unit_circle(direction)
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

    A negative distance puts the copy at lower z. `with_effects` gives it its bodies.
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
    low, high = sorted((  # between magnet and map if these are at other heights
        max(site.z_min, -site.half_length), min(site.z_max, site.half_length)))
    z = generator.uniform(low, high)
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


def _draw_two_rings(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    first, second = 1 + generator.choice(site.rings, 2, replace=False)
    return float(first), float(second)


def _draw_shift(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    amount = site.scale * log_uniform(generator, 1e-4, 5e-4)
    ring, _ = draw_place(site, generator)
    return ring, *(amount * value for value in draw_direction(generator, 2)[:2])


def _draw_ring(draw: Callable[[Site, np.random.Generator], float]) -> Draw:
    """Return a function that draws a ring, and a number by another function."""
    return lambda site, generator: (draw_place(site, generator)[0], draw(site, generator))


def _around(site: Site, values: Values) -> Refused:
    """Refuse iron that is not around the magnet."""
    inner, outer = values["inner_radius"], values["outer_radius"]
    if inner < site.outer:
        return ("inner_radius", f"at least the outer radius of the magnet, {site.outer:g} m", inner)
    return None if outer > inner else ("outer_radius", f"above inner_radius, {inner:g} m", outer)


def _leaves_blocks(site: Site, values: Values) -> Refused:
    """Refuse a change of the inner radius that leaves no bore, or no blocks."""
    thickness, change = site.outer - site.inner, values["change"]
    return None if abs(change) < min(site.inner, thickness) else (
        "change", f"smaller than the inner radius ({site.inner:g} m) and the thickness of the "
        f"blocks ({thickness:g} m)", change)


def _keeps_direction(_: Site, values: Values) -> Refused:
    """Refuse a change of temperature that reverses the magnetization."""
    return None if abs(values["change"] * values["coefficient"]) < 1 else (
        "coefficient", "a fraction per kelvin that does not reverse the magnetization",
        values["coefficient"])


def _beside(_: Site, values: Values) -> Refused:
    """Refuse a neighbouring magnet in the place of this one."""
    nearest_m = 1e-3
    return None if abs(values["distance"]) >= nearest_m else (
        "distance", f"at least {nearest_m:g} m on either side", values["distance"])


def _of_two_blocks(_: Site, values: Values) -> Refused:
    """Refuse a block that changes places with itself."""
    return None if (values["ring"], values["slot"]) != (
        values["other_ring"], values["other_slot"]) else (
        "other_slot", "that of another block", values["other_slot"])


def _effect(name: str, stated: str, draw: Draw, apply: Apply, *needs: Need,
            of_blocks: bool = False, check: Check | None = None, **limits: Any) -> HiddenEffect:
    """Return an effect of the magnet, whose parameters are stated as in `parameters`."""
    return HiddenEffect(name, "field", parameters(stated, **limits), draw, apply, needs=needs,
                        of_blocks=of_blocks, check=check)


RADIUS, LOST, PERMEABILITY = (1e-4, 10.0), (0.0, 1.0), (-0.5, 10.0)

EFFECTS = (
    _effect("iron_ring", "inner_radius m, outer_radius m, relative_permeability, "
            "saturation_polarization T", _draw_iron, iron_ring, "no iron", check=_around,
            inner_radius=RADIUS, outer_radius=RADIUS, relative_permeability=(1.0, 1e6),
            saturation_polarization=(0.0, 3.0)),
    _effect("recoil_permeability", "change", _draw_recoil, recoil_permeability, of_blocks=True,
            change=PERMEABILITY),
    _effect("recoil_permeability_across", "change", draw_number(0.03, 0.15, False),
            recoil_permeability_across, of_blocks=True, change=PERMEABILITY),
    _effect("block_displaced", "ring, slot, radial m, azimuthal m, z m", _draw_displacement,
            block_displaced),
    _effect("block_turned", "ring, slot, radial rad, azimuthal rad, z rad", _draw_turn,
            block_turned),
    _effect("radial_gap", "distance m", draw_length(5e-5, 4e-4, False), radial_gap),
    _effect("azimuthal_gap", "distance m", draw_length(5e-5, 4e-4, False), azimuthal_gap,
            "equal rings", of_blocks=True),
    _effect("ring_gap", "seam, distance m", lambda site, generator: (
        float(generator.integers(1, site.rings)), site.scale * log_uniform(generator, 5e-5, 5e-4)),
        ring_gap, "3d", "rings", "equal rings"),
    _effect("ring_twisted", "ring, angle rad", _draw_ring(
        lambda site, generator: signed_log_uniform(generator, 1e-3, 1e-2)), ring_twisted, "3d",
        "rings"),
    _effect("ring_shifted", "ring, x m, y m", _draw_shift, ring_shifted, "3d", "rings"),
    _effect("ring_shifted_along", "ring, z m", _draw_ring(
        lambda site, generator: site.scale * signed_log_uniform(generator, 2e-4, 1e-3)),
        ring_shifted_along, "3d", "rings"),
    _effect("ring_tilted", "ring, x rad, y rad", lambda site, generator: (
        draw_place(site, generator)[0], *(log_uniform(generator, 1e-3, 5e-3) * value
                                          for value in draw_direction(generator, 2)[:2])),
        ring_tilted, "3d", "rings"),
    _effect("ring_demagnetized", "ring, fraction", _draw_ring(
        lambda site, generator: log_uniform(generator, 0.02, 0.08)), ring_demagnetized, "3d",
        "rings", fraction=LOST),
    _effect("halves_apart", "slot, apart m, sideways m, z m", lambda site, generator: (
        draw_place(site, generator)[1], site.scale * log_uniform(generator, 2e-4, 1e-3), 0.0, 0.0),
        halves_apart, "3d", "equal rings"),
    _effect("blocks_swapped", "ring, slot, other_ring, other_slot", _draw_swap, blocks_swapped,
            check=_of_two_blocks),
    _effect("block_put_in_wrongly", "ring, slot, radial rad, azimuthal rad, z rad",
            lambda site, generator: (*draw_place(site, generator), np.pi, 0.0, 0.0),
            block_put_in_wrongly),
    _effect("rings_swapped", "ring, other_ring", _draw_two_rings, rings_swapped, "3d", "rings",
            "equal rings"),
    _effect("rings_turned", "ring, slots", _draw_ring(lambda site, generator: 1.0), rings_turned,
            "3d", "rings"),
    _effect("block_flipped", "ring, slot", draw_place, block_flipped),
    _effect("block_missing", "ring, slot", draw_place, block_missing),
    _effect("block_demagnetized", "ring, slot, fraction", lambda site, generator: (
        *draw_place(site, generator), log_uniform(generator, 0.04, 0.3)), block_demagnetized,
        fraction=LOST),
    _effect("corners_demagnetized", "fraction", draw_number(0.03, 0.3, False),
            corners_demagnetized, "four edges", fraction=LOST),
    _effect("magnetization_gradient", "ring, slot, fraction", _draw_gradient,
            magnetization_gradient, "four edges", of_blocks=True, ring=(0.0,), slot=(0.0,),
            fraction=(-1.0, 1.0)),
    _effect("temperature", "change K, coefficient 1/K", lambda site, generator: (
        signed_log_uniform(generator, 2, 15), SMCO), temperature, check=_keeps_direction,
        change=(-293.0,)),  # from room temperature, not below absolute zero
    _effect("temperature_gradient", "change K, coefficient 1/K", lambda site, generator: (
        signed_log_uniform(generator, 3, 15), SMCO), temperature_gradient, check=_keeps_direction),
    _effect("inner_radius", "change m", draw_length(1e-4, 6e-4), inner_radius, "equal rings",
            of_blocks=True, check=_leaves_blocks),
    _effect("length", "fraction", draw_number(5e-4, 4e-3), magnet_length, "3d", "equal rings",
            of_blocks=True, fraction=(-0.5, 0.5)),
    _effect("background", "x T, y T, z T", lambda site, generator: tuple(
        float(value) for value in log_uniform(generator, 5e-5, 5e-4)
        * np.array(draw_direction(generator, site.dimension))), background),
    _effect("neighbour_magnet", "distance m", _draw_neighbour, neighbour_magnet, "3d",
            check=_beside, distance=(-10.0, 10.0)),
    _effect("ferromagnetic_object", "x m, y m, z m, volume m^3", _draw_object,
            ferromagnetic_object, "3d", x=METRES, y=METRES, z=METRES,
            volume=(1e-12,)),
    _effect("knee", "coercivity A/m, squareness", lambda site, generator: (
        generator.uniform(5.0e5, 5.8e5), generator.uniform(0.8, 0.9)), knee, "3d", "vacuum",
        "few blocks", "four edges", coercivity=(1e4, 1e7), squareness=(0.01, 1.0)))
