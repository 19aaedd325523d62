"""Blocks whose corners at the bore are demagnetized."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, changed, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.model import Study


class CornersDemagnetizedEffect(Effect):
    """Loss of the inner corners of all blocks."""

    name = "corners_demagnetized"
    title = "demagnetized corners at the bore"
    kind = "field"
    parameters = (Parameter("loss", "1", 0.1),)

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return changed(scene, self.apply(scene.study, place, [0.5]))[None] / 0.5

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        there = next((one.inner_corner_loss for one in reversed(study.array.exceptions)
                      if one.inner_corner_loss is not None and not (one.ring or one.slot)), 0.0)
        return with_exceptions(study, [BlockException(
            inner_corner_loss=there + float(values[0]))])


EFFECTS = (CornersDemagnetizedEffect(),)
