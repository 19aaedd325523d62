"""A gap between two rings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


def _moves(rings: int, seam: int, ring: int) -> float:
    """Return the fraction of the gap above ring ``seam`` by which ring ``ring`` moves along z."""
    if 2 * seam == rings:
        return 0.5 if ring > seam else -0.5
    if 2 * seam > rings:
        return 1.0 if ring > seam else 0.0
    return -1.0 if ring <= seam else 0.0


class RingGapEffect(Effect):
    """A gap opens between the ring of the place and the next one at larger z.

    The rings on the outer side of the gap move away from the magnet's centre; a gap in the middle
    moves both halves by half of it. Which rings have really moved depends on where the others are
    held. Therefore all rings may in addition have moved together along z, which alone is no gap.
    """

    name = "ring_gap"
    title = "gap between two rings"
    kind = "field"
    parameters = (Parameter("gap", "m", 2e-4), Parameter("shift", "m", 1e-4))
    defining = ("gap",)

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        rings = study.array.rings if study.dimension == 3 and study.array.is_uniform else 1
        return [Place(ring) for ring in range(1, rings)]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        total = np.zeros((2, *nominal.points.shape))
        for number, block in enumerate(nominal.blocks):
            change = nominal.block_translation_derivative(number, np.array([0.0, 0.0, 1.0]))
            total[0] += _moves(nominal.study.array.rings, place.ring, block.ring) * change
            total[1] += change
        return total

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        rings, (gap, shift) = study.array.rings, map(float, values)
        moved = {ring: _moves(rings, place.ring, ring) * gap + shift
                 for ring in range(1, rings + 1)}
        return with_exceptions(study, [
            BlockException(ring=ring, shift_m=(0.0, 0.0, length))
            for ring, length in moved.items() if length])


EFFECTS = (RingGapEffect(),)
