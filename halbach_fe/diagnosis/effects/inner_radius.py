"""A bore that is wider or narrower than nominal."""

from __future__ import annotations

from collections.abc import Sequence

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


class InnerRadiusEffect(Effect):
    """The inner radius of all blocks differs, while their outer radius is nominal."""

    name = "inner_radius"
    title = "inner radius of the blocks"
    kind = "field"
    parameters = (Parameter("difference", "m", 3e-4),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return [Place()] if study.array.is_uniform else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        step = 1e-4
        return (changed(nominal, self.apply(nominal.study, place, [step])) / step)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        study = with_remanence(study)
        return with_array(study, inner_radius_m=study.array.inner_radius_m + float(values[0]))


EFFECTS = (InnerRadiusEffect(),)
