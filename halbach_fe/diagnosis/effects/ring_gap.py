"""A gap between two rings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.model import Study


def _moves(rings: int, seam: int, ring: int) -> float:
    """By how much of the gap above ring ``seam`` a ring moves."""
    if 2 * seam == rings:
        return 0.5 if ring > seam else -0.5
    if 2 * seam > rings:
        return 1.0 if ring > seam else 0.0
    return -1.0 if ring <= seam else 0.0


class RingGapEffect(Effect):
    """A gap above a ring, which moves what is beyond it away from the magnet's middle."""

    name = "ring_gap"
    title = "gap between two rings"
    kind = "field"
    parameters = (Parameter("gap", "m", 2e-4),)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        rings = study.array.rings if study.dimension == 3 else 1
        return [Place(ring) for ring in range(1, rings)]

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        total = np.zeros_like(scene.points)
        for number, block in enumerate(scene.blocks):
            total += scene.moved(number, np.array([0.0, 0.0, _moves(
                scene.study.array.rings, place.ring, block.ring)]))
        return total[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        rings = study.array.rings
        return with_exceptions(study, [
            BlockException(ring=ring, shift_m=(0.0, 0.0, share * float(values[0])))
            for ring in range(1, rings + 1) if (share := _moves(rings, place.ring, ring))])


EFFECTS = (RingGapEffect(),)
