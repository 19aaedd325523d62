"""The whole magnet displaced along its axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class MagnetShiftedEffect(Effect):
    """All blocks are displaced along z together, relative to where the study says.

    One map of a magnet without iron cannot tell that from a displaced mapper; several maps, iron
    or other sources can. A stack of ten rings that is held at one end instead of its middle is
    displaced by some tenths of a millimetre. Magnets are assembled once, while every map has a
    mapper that was set up for it.
    """

    name = "magnet_shifted"
    title = "all blocks displaced along z together"
    kind = "field"
    parameters = (Parameter("z", "m", 5e-4),)
    relative_odds = 1 / 20

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return [Place()] if study.dimension == 3 else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.asarray(-nominal.gradient[:, :, 2][None])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        return with_exceptions(study, [BlockException(shift_m=(0.0, 0.0, float(values[0])))])


EFFECTS = (MagnetShiftedEffect(),)
