"""Glue between neighbouring blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    changed,
    with_array,
    with_remanence,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.model import Study


class AzimuthalGapEffect(Effect):
    """Blocks narrower than nominal, at their mean radius, by the same gap between all."""

    name = "azimuthal_gap"
    title = "gaps between neighbouring blocks"
    kind = "field"
    parameters = (Parameter("gap", "m", 2e-4),)

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        step = 1e-4  # the field is linear in so small a gap
        return (changed(scene, self.apply(scene.study, place, [step])) / step)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        study, gap = with_remanence(study), float(values[0])
        array, block = study.array, study.array.block
        if block.shape == "sector":
            middle = (array.inner_radius_m + array.outer_radius_m) / 2
            change = {"angular_gap_deg": block.angular_gap_deg + float(np.degrees(gap / middle))}
        elif block.shape == "trapezoid":
            change = {"side_gap_m": block.side_gap_m + gap}
        else:
            change = {"width_m": block.width_m - gap}
        return with_array(study, block=block.with_(**change))


EFFECTS = (AzimuthalGapEffect(),)
