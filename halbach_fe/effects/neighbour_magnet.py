"""Another magnet near by."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.blocks import Floats, array_half_length
from halbach_fe.effects.base import Effect, Parameter, Place
from halbach_fe.external import neighbour_field
from halbach_fe.scene import Scene
from halbach_fe.study import Neighbour, Study

GAPS_M = (0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.7)
"""Between the magnets."""


class NeighbourMagnet(Effect):
    """A magnet like this one on the same axis, as far away as the place says."""

    name = "neighbour_magnet"
    title = "neighbouring magnet"
    kind = "field"
    parameters = (Parameter("factor", "1", 1.0),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        if study.dimension == 2:
            return []
        length = 2 * array_half_length(study)
        return [Place(at_m=(side * (length + gap),)) for side in (-1, 1) for gap in GAPS_M]

    def signature(self, scene: Scene, place: Place) -> Floats:
        """See `Effect.signature`."""
        return neighbour_field(scene.study, Neighbour(z_m=place.at_m[0]), scene.points,
                               order=4)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        neighbour = Neighbour(z_m=place.at_m[0], factor=float(values[0]))
        return study.model_copy(update={"external": study.external.model_copy(update={
            "neighbours": (*study.external.neighbours, neighbour)})})


EFFECTS = (NeighbourMagnet(),)
