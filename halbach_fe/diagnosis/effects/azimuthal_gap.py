"""Gaps between neighbouring blocks, such as layers of glue."""

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
    """All blocks are narrower than nominal, which leaves the same gap between all neighbours.

    The gap is measured at the mean radius of the blocks.
    """

    name = "azimuthal_gap"
    title = "gaps between neighbouring blocks"
    kind = "field"
    parameters = (Parameter("gap", "m", 2e-4),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return [Place()] if study.array.is_uniform else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        step = 1e-4  # small enough for the field to be linear in the gap
        return (changed(nominal, self.apply(nominal.study, place, [step])) / step)[None]

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
