"""Demagnetized corners of the blocks at the bore."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    can_be_uneven,
    changed,
    with_exceptions,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class CornersDemagnetizedEffect(Effect):
    """Both inner corners of all blocks have lost a fraction of their magnetization.

    The study's ``inner_corner_loss`` defines the size of a corner.
    """

    name = "corners_demagnetized"
    title = "demagnetized corners at the bore"
    kind = "field"
    parameters = (Parameter("loss", "1", 0.1),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return [Place()] if all(map(can_be_uneven, build_magnet(study).blocks)) else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return changed(nominal, self.apply(nominal.study, place, [0.5]))[None] / 0.5

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        # the last exception that applies to all blocks sets the loss the study has already
        present = next((exception.inner_corner_loss
                        for exception in reversed(study.array.exceptions)
                        if exception.inner_corner_loss is not None
                        and not (exception.ring or exception.slot)), 0.0)
        return with_exceptions(study, [BlockException(
            inner_corner_loss=present + float(values[0]))])


EFFECTS = (CornersDemagnetizedEffect(),)
