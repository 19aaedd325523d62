"""Gross errors: a wrong magnet or place of measurement, or a wrongly recorded map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.synthetic.faulty_instrument import FaultyInstrument
from halbach_fe.synthetic.hidden_effects.effect_types import (
    HiddenEffect,
    HiddenParameter,
    Site,
    signed_log_uniform,
)
from halbach_fe.synthetic.true_magnet import Body, TrueMagnet, vector

NOTHING: tuple[float, ...] = ()
"""Values of an effect without parameters."""


def wrong_radius(instrument: FaultyInstrument, site: Site, more: float) -> FaultyInstrument:
    """Let the probe run on another radius; a line on the axis becomes one beside it."""
    return replace(instrument, radius_error=instrument.radius_error + more)


def swapped_axes(instrument: FaultyInstrument, site: Site, first: float,
                 second: float) -> FaultyInstrument:
    """Exchange two components, counted from 1."""
    order = list(instrument.order)
    i, j = int(first) - 1, int(second) - 1
    order[i], order[j] = order[j], order[i]
    return replace(instrument, order=(order[0], order[1], order[2]))


def _draw_swap(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    first, second = sorted(generator.choice(3 if site.dimension == 3 else 2, 2, replace=False))
    return float(first + 1), float(second + 1)


def sign_flipped_axis(instrument: FaultyInstrument, site: Site, axis: float) -> FaultyInstrument:
    """Record a component, counted from 1, with the wrong sign."""
    signs = np.array(instrument.signs)
    signs[int(axis) - 1] *= -1
    return replace(instrument, signs=vector(signs))


def _draw_axis(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    return (float(1 + "xyz".index(generator.choice(site.components))),)


def millimetres(instrument: FaultyInstrument, site: Site) -> FaultyInstrument:
    """Record positions in mm."""
    return replace(instrument, length_unit=1000.0)


def millitesla(instrument: FaultyInstrument, site: Site) -> FaultyInstrument:
    """Record fields in mT."""
    return replace(instrument, field_unit=1000.0)


def reversed_z(instrument: FaultyInstrument, site: Site) -> FaultyInstrument:
    """Measure the magnet from its other end, with the probe's axes as they should be."""
    return replace(instrument, reversed_z=not instrument.reversed_z)


def rotated_by_one_block(magnet: TrueMagnet, site: Site, blocks: float) -> TrueMagnet:
    """Turn the magnet about its axis by the angle of one block, or of several."""
    angle = blocks * 2 * np.pi / site.slots
    turn = Rotation.from_euler("z", angle)

    def turned(body: Body) -> Body:
        """Turn a body's nominal place as well, so that the mesh of the reaction turns too."""
        return replace(body, angle=body.angle + angle, centre=vector(turn.apply(body.centre)),
                       displacement=vector(turn.apply(body.displacement)),
                       rotation=vector(turn.apply(body.rotation)))

    return replace(magnet, bodies=tuple(turned(body) for body in magnet.bodies))


def wrong_ring_count(magnet: TrueMagnet, site: Site, more: float) -> TrueMagnet:
    """Add ``more`` rings like the last, or remove rings, and centre the magnet at z = 0."""
    last = [body for body in magnet.bodies if body.ring == site.rings]
    first = next(body for body in magnet.bodies if body.ring == 1)
    length = first.shape.length
    pitch = (last[0].centre[2] - first.centre[2]) / (site.rings - 1) if site.rings > 1 else length
    bodies = [body for body in magnet.bodies if body.ring <= site.rings + more]
    for number in range(1, int(more) + 1):
        bodies += [replace(body, ring=site.rings + number,
                           centre=vector(np.add(body.centre, (0, 0, number * pitch))))
                   for body in last]
    iron = magnet.iron and replace(magnet.iron, bodies=tuple(
        replace(body, half_length=body.half_length + more * pitch / 2)
        for body in magnet.iron.bodies))
    return replace(magnet, iron=iron, bodies=tuple(
        replace(body, centre=vector(np.add(body.centre, (0, 0, -more * pitch / 2))))
        for body in bodies))


EFFECTS = (
    HiddenEffect("wrong_radius", "gross", (HiddenParameter("change", "m"),),
                 lambda site, generator: (signed_log_uniform(generator, 0.05, 0.2) * (
                     site.radius if site.radius > 0 else site.inner),), instrument=wrong_radius),
    HiddenEffect("swapped_axes", "gross", (HiddenParameter("first"), HiddenParameter("second")),
                 _draw_swap, instrument=swapped_axes),
    HiddenEffect("sign_flipped_axis", "gross", (HiddenParameter("axis"),), _draw_axis,
                 instrument=sign_flipped_axis),
    HiddenEffect("millimetres", "gross", (), lambda site, generator: NOTHING,
                 instrument=millimetres),
    HiddenEffect("millitesla", "gross", (), lambda site, generator: NOTHING, instrument=millitesla),
    HiddenEffect("reversed_z", "gross", (), lambda site, generator: NOTHING, instrument=reversed_z,
                 needs=("3d",)),
    HiddenEffect("rotated_by_one_block", "gross", (HiddenParameter("blocks"),),
                 lambda site, generator: (float(generator.choice([-1.0, 1.0])),),
                 rotated_by_one_block, needs=("equal rings",)),
    HiddenEffect("wrong_ring_count", "gross", (HiddenParameter("more"),),
                 lambda site, generator: (float(generator.choice([-1.0, 1.0]))
                                          if site.rings > 1 else 1.0,),
                 wrong_ring_count, needs=("3d", "equal rings")),
)
