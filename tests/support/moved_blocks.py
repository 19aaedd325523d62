"""The moves of `shim`, done by hand on the bodies of a simulated magnet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.synthetic.true_magnet_of_study import vector


def moved(bodies, loose, shimmed, remount=None):
    """True bodies once the moves are done by hand: each body goes, as it is before it is mounted,
    to its new place, turned into that slot's direction and about its own axes; ``remount`` draws
    the turn of its new mounting.
    """
    result = list(bodies)
    for step in shimmed.steps:
        for one in step.move.placements:
            body, slot = loose[one.block], bodies[one.to]
            facing = slot.angle + getattr(slot.shape, "turn", 0.0)
            own = Rotation.from_rotvec(np.radians(shimmed.mounts.turn_deg(one.turn)))
            axes = Rotation.from_euler("z", facing)
            there = replace(
                body, ring=slot.ring, slot=slot.slot, centre=slot.centre,
                angle=facing - getattr(body.shape, "turn", 0.0),
                rotation=vector((axes * own * axes.inv()).as_rotvec()))
            if remount is not None:
                there = there.with_magnetization(remount().apply(there.magnetization))
            result[one.to] = there
    return result


def unturned(bodies, loose, shimmed):
    """The same moves done wrongly: magnetizations go to their slots without being turned."""
    result = list(bodies)
    for step in shimmed.steps:
        for one in step.move.placements:
            result[one.to] = bodies[one.to].with_magnetization(loose[one.block].magnetization)
    return result
