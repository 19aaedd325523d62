"""A ring or layer that is displaced along the axis."""

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


class RingShiftedAlongEffect(Effect):
    """One of several rings is displaced along z. Blocks of a table at one height are a ring."""

    name = "ring_shifted_along"
    title = "displacement of a ring along the axis"
    kind = "field"
    parameters = (Parameter("z", "m", 3e-4),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        rings = each_ring(study)
        return rings if len(rings) > 1 else []  # all rings together are a displaced mapper

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.asarray(sum(nominal.block_translation_derivative(number, np.array([0, 0, 1.0]))
                              for number in blocks_at(nominal, place)))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring, shift_m=(0.0, 0.0, float(values[0])))])


EFFECTS = (RingShiftedAlongEffect(),)
