"""Iron that saturates."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.magnet import IronRing, SteelCurve
from halbach_fe.study.model import Study

STEEL = "aisi_1010"

SOLID = "scalar_potential"
"""The route of iron that saturates."""


class IronSaturationEffect(Effect):
    """The H(B) curve of a structural steel in place of a constant permeability."""

    name = "iron_saturation"
    title = "saturation of the iron ring"
    kind = "field"
    parameters = (Parameter("strength", "1", 1.0),)
    certain = True
    discrete = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        ring = study.iron_ring
        return [Place()] if ring is not None and ring.curve is None else []

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`; both on the same mesh."""
        solid = scene.study.solver.with_(route=SOLID)
        before = scene.study if scene.study.dimension == 2 else scene.study.with_(solver=solid)
        return (scene.solve(self.apply(before, place, [1.0])) - scene.solve(before))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        ring = study.iron_ring
        if ring is None:
            return study
        return study.with_(iron_ring=IronRing(
            inner_radius_m=ring.inner_radius_m, outer_radius_m=ring.outer_radius_m,
            length_m=ring.length_m, curve=SteelCurve(kind="steel", name=STEEL)))


EFFECTS = (IronSaturationEffect(),)
