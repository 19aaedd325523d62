"""Iron around the magnet."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from halbach_fe.blocks import Floats, array_outer_radius
from halbach_fe.effects.base import Effect, Parameter, Place
from halbach_fe.scene import Scene
from halbach_fe.study import IronRing, SteelCurve, Study

PERMEABILITY = 1000.0
"""Of iron that is not saturated, which thickness can stand for: what counts of a thin shield is
their product."""

CLEARANCE_M = 2e-4
"""Between blocks and iron, at least."""

THINNEST_M = 5e-4

STEP_M = 1e-3
"""For derivatives: large over what another mesh changes."""

STEEL = "aisi_1010"
"""Whose H(B) curve stands for any structural steel's."""

NEARER = (0.3, 0.9)
THICKNESSES_M = (0.003, 0.008)
"""Of steel rings that are tried in place of a linear one: they saturate, so that they are as strong
nearer to the blocks, in fractions of its distance."""


BETWEEN, FINE = (-0.3, 1.3), 33
"""And a little beyond."""


class IronRingEffect(Effect):
    """A coaxial tube of soft iron as long as the magnet; the place is its inner and outer radius,
    from which those that fit best are looked for. It is linear first, and once such a ring is
    found, steel that saturates is tried in its place.
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
        blocks = array_outer_radius(study)
        return [Place(at_m=(blocks + gap, blocks + gap + thickness))
                for gap, thickness in ((0.004, 0.002), (0.004, 0.01), (0.004, 0.025),
                                       (0.02, 0.01))]

    def shortlist(
        self, study: Study, mean: Floats, information: Floats, score: Floats
    ) -> Sequence[Place]:
        """See `Effect.shortlist`."""
        ring = study.iron_ring
        if ring is None or ring.curve is not None:
            return self.places(study)
        blocks = array_outer_radius(study)
        inner = [blocks + fraction * (ring.inner_radius_m - blocks) for fraction in NEARER]
        return [Place(at_m=(one, one + thickness), material=STEEL)
                for one in inner for thickness in THICKNESSES_M]

    def between(
        self, places: Sequence[Place], gain: Callable[[Floats], float]
    ) -> Place | None:
        """See `Effect.between`: bilinear between steel rings, by distance and thickness."""
        steel = [number for number, place in enumerate(places) if place.material]
        if len(steel) != len(NEARER) * len(THICKNESSES_M):
            return None
        inner, outer = np.array([places[number].at_m for number in steel]).T
        best, found = -np.inf, places[steel[0]]
        for across in np.linspace(*BETWEEN, FINE):
            for along in np.linspace(*BETWEEN, FINE):
                weights = np.zeros(len(places))
                weights[steel] = np.outer([1 - across, across], [1 - along, along]).ravel()
                now = gain(weights)
                if now > best:
                    radius, thickness = weights[steel] @ inner, weights[steel] @ (outer - inner)
                    best, found = now, Place(at_m=(radius, radius + thickness), material=STEEL)
        return found

    def signature(self, scene: Scene, place: Place) -> Floats:
        """See `Effect.signature`."""
        return (scene.solve(self.apply(scene.study, place, [1.0])) - scene.solved)[None]

    def refine(self, scene: Scene, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.refine`."""
        here = scene.solve(self.apply(scene.study, place, values))
        return np.array([(scene.solve(self.apply(scene.study, place, np.add(
            values, STEP_M * step).tolist())) - here) / STEP_M for step in np.eye(3)[1:]])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        inner, outer = place.at_m
        farther, thicker = values[1:] or (0.0, 0.0)
        thickness = max(outer - inner + thicker, THINNEST_M)
        inner = max(inner + farther, array_outer_radius(study) + CLEARANCE_M)
        curve = SteelCurve(kind="steel", name=place.material) if place.material else None
        return study.model_copy(update={"iron_ring": IronRing(
            inner_radius_m=inner, outer_radius_m=inner + thickness, curve=curve,
            relative_permeability=None if curve else PERMEABILITY)})


EFFECTS = (IronRingEffect(),)
