"""A magnet that is longer or shorter than nominal."""

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


class LengthEffect(Effect):
    """The length of the magnet differs, each ring by an equal share of the difference."""

    name = "length"
    title = "length of the magnet"
    kind = "field"
    parameters = (Parameter("difference", "m", 1e-3),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return [Place()] if study.dimension == 3 and study.array.is_uniform else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        step = 1e-3
        return (changed(nominal, self.apply(nominal.study, place, [step])) / step)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        study = with_remanence(study)
        length = study.array.ring_length_m
        assert length is not None  # in three dimensions a study has a ring length
        return with_array(study, ring_length_m=length + float(values[0]) / study.array.rings)


EFFECTS = (LengthEffect(),)
