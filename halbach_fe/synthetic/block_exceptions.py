"""What the exceptions of a study change in the true bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study.array import BlockException
from halbach_fe.synthetic.shapes import Shape
from halbach_fe.synthetic.true_magnet import Body, BodyPart, vector

CORNER_SHARE = 1 / 6
"""Extent of a corner at the bore relative to a block's width and thickness."""


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
    if not (gradient or corner_loss):
        return ()
    if not shape.has_four_edges:
        raise StudyError(must_be(f"magnetization_gradient and inner_corner_loss of block {name}",
                                 "study", "those of a shape of four edges", "another shape",
                                 "Leave the keys out there."))
    side = 2 * CORNER_SHARE
    halves = (BodyPart((0.0, 0.5), (-1.0, 1.0), 1 - gradient / 2),
              BodyPart((0.5, 1.0), (-1.0, 1.0), 1 + gradient / 2))
    corners = (BodyPart((0.0, CORNER_SHARE), (-1.0, side - 1.0), 1 - corner_loss),
               BodyPart((0.0, CORNER_SHARE), (1.0 - side, 1.0), 1 - corner_loss))
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
            easy = np.array([np.cos(direction), np.sin(direction), 0.0])
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
        turn += own.apply(np.radians(exception.rotation_deg)) + twist
    if not (shift.any() or turn.any()):
        return body
    shift += arm - Rotation.from_rotvec(turn).apply(arm)
    return replace(body, displacement=vector(shift), rotation=vector(turn))
