"""Iron around the magnet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.magnet import IronRing
from halbach_fe.study.model import Study

PERMEABILITY = 1000.0
"""Of iron that is not saturated, which thickness can stand for: what counts of a thin shield is
their product."""

CLEARANCE_M = 2e-4
"""Between blocks and iron, at least."""

THINNEST_M = 5e-4

STEP_M = 5e-4
"""For derivatives."""


class IronRingEffect(Effect):
    """A coaxial tube of soft iron as long as the magnet; the place is its inner and outer radius,
    from which those that fit best are looked for. It is linear: for one that saturates a
    thicker tube farther out is found, and no saturating one is looked for.
    """

    name = "iron_ring"
    title = "iron ring around the magnet"
    kind = "field"
    parameters = (Parameter("strength", "1", 1.0),)
    refinements = (Parameter("farther_out", "m", 0.01), Parameter("thicker", "m", 0.005))
    only = True
    discrete = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        if study.iron_ring is not None:
            return []
        blocks = build_magnet(study).array_outer_radius
        return [Place(at_m=(blocks + gap, blocks + gap + thickness))
                for gap, thickness in ((0.004, 0.002), (0.004, 0.01), (0.004, 0.025),
                                       (0.02, 0.01))]

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return (scene.solve(self.apply(scene.study, place, [1.0])) - scene.solved)[None]

    def refine(self, scene: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.refine`."""
        here = scene.solve(self.apply(scene.study, place, values))
        return np.array([(scene.solve(self.apply(scene.study, place, np.add(
            values, STEP_M * step).tolist())) - here) / STEP_M for step in np.eye(3)[1:]])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        inner, outer = place.at_m
        farther, thicker = values[1:] or (0.0, 0.0)
        thickness = max(outer - inner + thicker, THINNEST_M)
        inner = max(inner + farther, build_magnet(study).array_outer_radius + CLEARANCE_M)
        return study.with_(iron_ring=IronRing(
            inner_radius_m=inner, outer_radius_m=inner + thickness,
            relative_permeability=PERMEABILITY))


EFFECTS = (IronRingEffect(),)
