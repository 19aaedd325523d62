"""Iron around the magnet."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.blocks import Floats, array_outer_radius
from halbach_fe.effects.base import Effect, Parameter, Place
from halbach_fe.scene import Scene
from halbach_fe.study import IronRing, SteelCurve, Study

STEEL = "aisi_1010"


class IronRingEffect(Effect):
    """A coaxial tube of soft iron; the place is its inner and outer radius."""

    name = "iron_ring"
    title = "iron ring around the magnet"
    kind = "field"
    parameters = (Parameter("strength", "1", 1.0),)
    discrete = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        if study.iron_ring is not None:
            return []
        blocks = array_outer_radius(study)
        return [Place(at_m=(blocks + gap, blocks + gap + thickness))
                for gap, thickness in ((0.004, 0.002), (0.004, 0.01), (0.004, 0.025),
                                       (0.02, 0.01))]

    def signature(self, scene: Scene, place: Place) -> Floats:
        """See `Effect.signature`."""
        return (scene.solve(self.apply(scene.study, place, [1.0])) - scene.solved)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        inner, outer = place.at_m
        return study.model_copy(update={"iron_ring": IronRing(
            inner_radius_m=inner, outer_radius_m=outer, curve=SteelCurve(
                kind="steel", name=STEEL))})


EFFECTS = (IronRingEffect(),)
