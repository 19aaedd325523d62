"""Blocks whose corners at the bore are demagnetized."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.blocks import Floats
from halbach_fe.effects.base import Effect, Parameter, Place, changed, with_exceptions
from halbach_fe.scene import Scene
from halbach_fe.study import BlockException, Study


class CornersDemagnetized(Effect):
    """Loss of the inner corners of all blocks."""

    name = "corners_demagnetized"
    title = "demagnetized corners at the bore"
    kind = "field"
    parameters = (Parameter("loss", "1", 0.1),)

    def signature(self, scene: Scene, place: Place) -> Floats:
        """See `Effect.signature`."""
        return changed(scene, self.apply(scene.study, place, [0.5]))[None] / 0.5

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        there = study.array.exceptions[-1].inner_corner_loss if study.array.exceptions else None
        return with_exceptions(study, [BlockException(
            inner_corner_loss=(there or 0.0) + float(values[0]))])


EFFECTS = (CornersDemagnetized(),)
