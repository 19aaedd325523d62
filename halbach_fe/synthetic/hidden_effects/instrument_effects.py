"""Hidden effects of the mapper and its probe, and gross errors.

These are a wrong magnet or place of measurement, and a wrongly recorded map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.study.types import COMPONENTS
from halbach_fe.synthetic.faulty_instrument import FaultyInstrument
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
    log_uniform,
    parameters,
    signed_log_uniform,
)
from halbach_fe.synthetic.true_magnet import Ball, Body, TrueMagnet, vector

Apply = Callable[..., FaultyInstrument]
"""Function of an instrument, the site and the values that returns the instrument with them."""


def _plus(fault: str, *entry: int) -> Apply:
    """Return the effect that adds its values to a fault, or to one entry of it."""
    def apply(instrument: FaultyInstrument, site: Site, *values: float) -> FaultyInstrument:
        total = np.array(getattr(instrument, fault), float)
        total[entry] += values if total[entry].ndim else values[0]
        return replace(instrument, **{fault: _tuples(total.tolist())})
    return apply


def _tuples(values: Any) -> Any:
    return tuple(map(_tuples, values)) if isinstance(values, list) else values


def _set(fault: str) -> Apply:
    """Return the effect that sets a fault to its values."""
    return lambda instrument, site, *values: replace(
        instrument, **{fault: values if len(values) > 1 else values[0]})


def _turned(axis: int) -> Apply:
    """Return the effect that turns the mapper about the origin, together with the probe."""
    def apply(instrument: FaultyInstrument, site: Site, angle: float) -> FaultyInstrument:
        turn = Rotation.from_rotvec(angle * np.eye(3)[axis])
        return replace(
            instrument, translation=vector(turn.apply(instrument.translation)),
            rotation=vector((turn * Rotation.from_rotvec(instrument.rotation)).as_rotvec()))
    return apply


def _sagging(instrument: FaultyInstrument, site: Site, distance: float) -> FaultyInstrument:
    """Let the arm sag at its far end, that of the largest z."""
    return replace(instrument, sag=(instrument.sag[0] + distance, site.z_min, site.z_max))


def _draw_vector(low: float, high: float) -> Draw:
    """Return a function that draws a vector in m, its length between limits that are scaled."""
    def draw(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
        amount = site.scale * log_uniform(generator, low, high)
        return tuple(amount * value for value in draw_direction(generator, site.dimension))

    return draw


def _fault(name: str, stated: str, draw: Draw, apply: Apply, *needs: Need,
           **limits: Any) -> HiddenEffect:
    """Return an effect of the instrument, whose parameters are stated as in `parameters`."""
    return HiddenEffect(name, "instrument", parameters(stated, **limits), draw, instrument=apply,
                        needs=needs)


NUMBERED = tuple(enumerate(COMPONENTS))
STRETCH = {"fraction": (-0.5, 1.0)}

FAULTS = (
    *(_fault(f"gain_{name}", "fraction", draw_number(5e-4, 1e-2), _plus("gain", sensor), name,
             fraction=(-0.9, 10.0)) for sensor, name in NUMBERED),
    *(_fault(f"offset_{name}", "value T", draw_number(5e-5, 1e-3), _plus("offset", sensor), name)
      for sensor, name in NUMBERED),
    *(_fault(f"sensor_position_{name}", "x m, y m, z m", _draw_vector(3e-4, 3e-3),
             _plus("sensors", sensor), name) for sensor, name in NUMBERED),
    # a sensor picks up a fraction of another component
    *(_fault(f"misalignment_{name}{of}", "fraction", draw_number(1e-3, 1e-2),
             _plus("axes", sensor, other), name, "axes", *(("3d",) if of == "z" else ()))
      for sensor, name in NUMBERED for other, of in NUMBERED if sensor != other),
    _fault("planar_hall", "value 1/T", draw_number(1e-3, 1e-2), _plus("planar_hall"), "3d",
           "axes"),
    _fault("quadratic_nonlinearity", "value 1/T", draw_number(1e-3, 1e-2), _plus("quadratic")),
    _fault("cubic_nonlinearity", "value 1/T^2", draw_number(2e-3, 2e-2), _plus("cubic")),
    _fault("mapper_translation", "x m, y m, z m", _draw_vector(2e-4, 2e-3), _plus("translation"),
           x=METRES, y=METRES, z=METRES),
    _fault("mapper_roll", "angle rad", draw_number(5e-4, 5e-3), _turned(2)),
    _fault("mapper_tilt_x", "angle rad", draw_number(5e-4, 5e-3), _turned(0), "3d"),
    _fault("mapper_tilt_y", "angle rad", draw_number(5e-4, 5e-3), _turned(1), "3d"),
    _fault("z_scale", "fraction", draw_number(2e-4, 3e-3), _plus("z_scale"), "3d", **STRETCH),
    _fault("radius_scale", "fraction", draw_number(1e-3, 1e-2), _plus("radius_scale"), "circles",
           **STRETCH),
    _fault("arm_sag", "distance m", draw_length(3e-4, 3e-3, False), _sagging, "3d"),
    _fault("eccentric_circle", "distance m, angle rad",
           lambda site, generator: (site.scale * log_uniform(generator, 2e-4, 2e-3),
                                    float(generator.uniform(-np.pi, np.pi))),
           _set("run_out"), "circles"),
    _fault("drift", "value T", draw_number(1e-4, 1e-3), _plus("drift")),
    _fault("gain_drift", "change", draw_number(5e-4, 5e-3), _plus("gain_drift")),
    _fault("lag", "distance m", draw_length(1e-4, 5e-4, False), _plus("lag"), "3d"),
    _fault("slow_readings", "fraction, rows",
           lambda site, generator: (log_uniform(generator, 1e-3, 1e-2), 0.0), _set("memory"),
           fraction=(-0.5, 0.5), rows=(0.0,)),
    _fault("vibration", "distance m", draw_length(5e-5, 5e-4, False), _set("vibration"),
           distance=(0.0, 0.1)),
    _fault("outliers", "fraction, value T",
           lambda site, generator: (log_uniform(generator, 3e-3, 2e-2),
                                    log_uniform(generator, 1e-3, 1e-2)), _set("outliers"),
           fraction=(0.0, 1.0)))
"""What an instrument may do wrong, see the faults of `FaultyInstrument`."""


def _swapped(instrument: FaultyInstrument, site: Site, *numbers: float) -> FaultyInstrument:
    """Exchange two components, counted from 1."""
    order = list(instrument.order)
    i, j = (int(number) - 1 for number in numbers)
    order[i], order[j] = order[j], order[i]
    return replace(instrument, order=(order[0], order[1], order[2]))


def _draw_swap(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    first, second = sorted(generator.choice(3 if site.dimension == 3 else 2, 2, replace=False))
    return float(first + 1), float(second + 1)


def _sign_flipped(instrument: FaultyInstrument, site: Site, axis: float) -> FaultyInstrument:
    """Record a component, counted from 1, with the wrong sign."""
    signs = np.array(instrument.signs)
    signs[int(axis) - 1] *= -1
    return replace(instrument, signs=vector(signs))


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
        body if isinstance(body, Ball) or any(body.turn) else
        replace(body, half_length=body.half_length + more * pitch / 2)
        for body in magnet.iron.bodies))
    return replace(magnet, iron=iron, bodies=tuple(
        replace(body, centre=vector(np.add(body.centre, (0, 0, -more * pitch / 2))))
        for body in bodies))


def _gross(name: str, stated: str, draw: Draw, apply: Apply, *needs: Need,
           check: Check | None = None, **limits: Any) -> HiddenEffect:
    """Return a gross error of the instrument."""
    return replace(_fault(name, stated, draw, apply, *needs, **limits), group="gross", check=check)


def _of_two_axes(_: Site, values: Values) -> Refused:
    """Refuse an axis that is exchanged with itself."""
    return None if values["first"] != values["second"] else (
        "second", "another axis than the first", values["second"])


def _nothing(site: Site, generator: np.random.Generator) -> tuple[float, ...]:
    """Draw the values of an effect without parameters."""
    return ()


GROSS_ERRORS = (
    # on another radius; a line on the axis becomes one beside it
    _gross("wrong_radius", "change m", lambda site, generator: (
        signed_log_uniform(generator, 0.05, 0.2) * (
             site.radius if site.radius > 0 else site.inner),), _plus("radius_error"),
         change=METRES),
    _gross("swapped_axes", "first, second", _draw_swap, _swapped, "axes", check=_of_two_axes),
    _gross("sign_flipped_axis", "axis", lambda site, generator: (
        float(1 + "xyz".index(generator.choice(site.components))),), _sign_flipped, "axes"),
    _gross("millimetres", "", _nothing, lambda instrument, site: replace(
        instrument, length_unit=1000.0)),
    _gross("millitesla", "", _nothing, lambda instrument, site: replace(
        instrument, field_unit=1000.0)),
    # measured from the other end, with the probe's axes as they should be
    _gross("reversed_z", "", _nothing, lambda instrument, site: replace(
        instrument, reversed_z=not instrument.reversed_z), "3d"),
    HiddenEffect("rotated_by_one_block", "gross", parameters("blocks"),
                 lambda site, generator: (float(generator.choice([-1.0, 1.0])),),
                 rotated_by_one_block, needs=("equal rings",)),
    HiddenEffect("wrong_ring_count", "gross", parameters("more"),
                 lambda site, generator: (float(generator.choice([-1.0, 1.0]))
                                          if site.rings > 1 else 1.0,),
                 wrong_ring_count, needs=("3d", "equal rings")),
)

EFFECTS = (*FAULTS, *GROSS_ERRORS)
