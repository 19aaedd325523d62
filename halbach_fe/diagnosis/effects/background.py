"""A uniform magnetic field from outside the magnet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, added
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.model import Study


class BackgroundEffect(Effect):
    """A uniform field is added to that of the magnet, such as that of the earth."""

    name = "background"
    title = "uniform background field"
    kind = "field"
    is_divisible = False
    parameters = (
        Parameter("x", "T", 0.0001), Parameter("y", "T", 0.0001), Parameter("z", "T", 0.0001),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.tile(np.eye(3)[:, None], (1, len(nominal.points), 1))

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        total = tuple(added(study.external.background_T, values))
        return study.with_(external__background_T=total)


EFFECTS = (BackgroundEffect(),)
