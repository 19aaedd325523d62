"""An iron ring around the magnet that the study does not contain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.iron import IronRing
from halbach_fe.study.model import Study, iron_of

PERMEABILITY = 1000.0
"""Relative permeability that every candidate ring is given.

It is typical of iron that is not saturated. No other value is tried, because a thin shield acts by
the product of permeability and thickness, and the thickness is varied.
"""

CLEARANCE_M = 2e-4
"""Smallest distance between blocks and iron."""

THINNEST_M = 5e-4
"""Smallest thickness of a ring."""

WEAKEST = 0.1
"""Smallest strength, relative to the whole ring at one of the places, of what may be a ring. A ring
is applied in full: of one that is found with 2 % of its strength, for a small error that looks like
it, 98 % would be wrong in the next round. Around the magnet of studies/diagnosis, the thinnest ring
of `THINNEST_M` has 0.5 of the strength of one of 10 mm, one of 25 mm 1.02; a ring 0.1 m off the
blocks has 0.19, and one 0.2 m off 0.05: that one is no candidate."""

STEP_M = 5e-4
"""Step of the finite differences with respect to the refinements."""


class IronRingEffect(Effect):
    """A coaxial tube of soft iron as long as the magnet surrounds it.

    A place is a pair of inner and outer radius, and the refinements adjust both. The iron is
    linear: iron that saturates is not a candidate, and is identified as a linear tube that is
    thicker and farther out.
    """

    name = "iron_ring"
    title = "iron ring around the magnet"
    kind = "field"
    parameters = (Parameter("strength", "1", 1.0, minimum=WEAKEST),)
    refinements = (Parameter("farther_out", "m", 0.01), Parameter("thicker", "m", 0.005))
    unique = True
    applied_in_full = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        if iron_of(study) is not None:
            return []
        blocks = build_magnet(study).array_outer_radius
        return [Place(at_m=(blocks + gap, blocks + gap + thickness))
                for gap, thickness in ((0.004, 0.002), (0.004, 0.01), (0.004, 0.025),
                                       (0.02, 0.01))]

    def representatives(self, places: Sequence[Place]) -> Sequence[Place]:
        """See `Effect.representatives`.

        All rings shorten the fringe field, by more than ten times what a map can show. One of
        middle thickness has a correlation of 0.8 or more with every other one.
        """
        return places[1:2] or places

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return nominal.change_by_iron(self.apply(nominal.study, place, [1.0]))[None]

    def refine(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.refine`."""
        here = nominal.solve(self.apply(nominal.study, place, values))
        return np.array([(nominal.solve(self.apply(nominal.study, place, np.add(
            values, STEP_M * step).tolist())) - here) / STEP_M for step in np.eye(3)[1:]])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        inner, outer = place.at_m
        farther, thicker = values[1:] or (0.0, 0.0)
        thickness = max(outer - inner + thicker, THINNEST_M)
        inner = max(inner + farther, build_magnet(study).array_outer_radius + CLEARANCE_M)
        return study.with_(iron_ring=IronRing(
            inner_radius_m=inner, outer_radius_m=inner + thickness,
            relative_permeability=PERMEABILITY))


EFFECTS = (IronRingEffect(),)
