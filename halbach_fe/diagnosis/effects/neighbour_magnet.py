"""A neighbouring magnet of the same kind."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.external_field import neighbour_field
from halbach_fe.study.magnet import Neighbour
from halbach_fe.study.model import Study

GAPS_M = (0.03, 0.06, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7)
"""Distances between the facing ends of the two magnets, one candidate place each."""

STEP_M = 1e-4
"""Step of the finite difference with respect to the distance."""


class NeighbourMagnetEffect(Effect):
    """A magnet like this one stands on the same axis.

    A place is the approximate position of its centre along z, on either side. The refinements
    adjust its strength and its distance.
    """

    name = "neighbour_magnet"
    title = "neighbouring magnet"
    kind = "field"
    parameters = (Parameter("strength", "1", 1.0),)
    refinements = (Parameter("stronger", "1", 0.5), Parameter("farther", "m", 0.05))
    unique = True
    applied_in_full = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        if study.dimension == 2:
            return []
        length = 2 * build_magnet(study).array_half_length
        return [Place(at_m=(side * (length + gap),)) for side in (-1, 1) for gap in GAPS_M]

    def representatives(self, places: Sequence[Place]) -> Sequence[Place]:
        """See `Effect.representatives`.

        Near the ends of the magnet all neighbours on one side have similar fields: the middle one
        has a correlation of 0.7 or more with every other one.
        """
        sides = ([place for place in places if side * place.at_m[0] > 0] for side in (-1, 1))
        return [side[len(side) // 2] for side in sides if side]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return neighbour_field(nominal.magnet, Neighbour(z_m=place.at_m[0]), nominal.points)[None]

    def refine(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.refine`."""
        stronger, farther = values[1:]
        here, beyond = (neighbour_field(nominal.magnet, Neighbour(z_m=_centre(place, distance)),
                                        nominal.points)
                        for distance in (farther, farther + STEP_M))
        return np.array([here, (1 + stronger) * (beyond - here) / STEP_M])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        stronger, farther = values[1:] or (0.0, 0.0)
        neighbour = Neighbour(z_m=_centre(place, farther), factor=1 + float(stronger))
        return study.with_(external__neighbours=(*study.external.neighbours, neighbour))


def _centre(place: Place, farther: float) -> float:
    """Return the z in m of the neighbour's centre, ``farther`` m beyond its place."""
    return float(place.at_m[0] + np.sign(place.at_m[0]) * farther)


EFFECTS = (NeighbourMagnetEffect(),)
