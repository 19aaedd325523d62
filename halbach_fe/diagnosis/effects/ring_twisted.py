"""A ring that is rotated about the magnet's axis."""

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


class RingTwistedEffect(Effect):
    """One ring is rotated about the magnet's axis."""

    name = "ring_twisted"
    title = "rotation of a ring about the axis"
    kind = "field"
    parameters = (Parameter("angle", "rad", 2e-3),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return each_ring(study)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        axis = np.array([0.0, 0.0, 1.0])
        return np.asarray(sum(nominal.block_rotation_derivative(number, axis, np.zeros(3))
                              for number in blocks_at(nominal, place)))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(
            ring=place.ring, twist_deg=float(np.degrees(values[0])))])


EFFECTS = (RingTwistedEffect(),)
