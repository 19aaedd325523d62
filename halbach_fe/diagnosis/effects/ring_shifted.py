"""A ring that is displaced across the axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    blocks_at,
    each_ring,
    with_exceptions,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class RingShiftedEffect(Effect):
    """One ring is displaced along x and y."""

    name = "ring_shifted"
    title = "displacement of a ring across the axis"
    kind = "field"
    parameters = (Parameter("x", "m", 3e-4), Parameter("y", "m", 3e-4),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return each_ring(study)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.array([sum(nominal.block_translation_derivative(number, axis)
                             for number in blocks_at(nominal, place))
                         for axis in np.eye(3)[:2]])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring, shift_m=(float(values[0]), float(values[1]), 0.0))])


EFFECTS = (RingShiftedEffect(),)
