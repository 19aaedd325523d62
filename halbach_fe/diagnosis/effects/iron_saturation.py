"""Saturation of an iron ring that the study describes as linear."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.solver.formulation_choice import choose_route
from halbach_fe.study.iron import IronRing, SteelCurve
from halbach_fe.study.model import Study

SOFTER = 0.5
"""Permeability of linear iron, relative to the study's, that stands for iron that saturates: it
conducts less flux too."""

STEEL = "aisi_1010"
"""Steel whose H(B) curve stands for that of structural steels."""

SOLID = "scalar_potential"
"""Solver route of iron that saturates, unless one of `BOTH` applies."""

BOTH = ("cross_section", "moments")
"""Solver routes of linear and of saturating iron."""


class IronSaturationEffect(Effect):
    """The iron follows the H(B) curve of a structural steel, not a constant permeability."""

    name = "iron_saturation"
    title = "saturation of the iron ring"
    kind = "field"
    parameters = (Parameter("strength", "1", 1.0),)
    is_binary = True
    applied_in_full = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        ring = study.iron_ring
        return [Place()] if ring is not None and ring.curve is None else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        study = before = nominal.study
        if choose_route(nominal.magnet, nominal.points) not in BOTH:
            # linear iron by the same route, so that both fields have the same mesh
            before = study.with_(solver__route=SOLID)
        return (nominal.solve(self.apply(before, place, [1.0])) - nominal.solve(before))[None]

    def rough_signature(self, nominal: NominalFields, place: Place) -> Floats | None:
        """See `Effect.rough_signature`."""
        ring = nominal.study.iron_ring
        if ring is None or ring.relative_permeability is None:
            return None
        permeability = ring.relative_permeability
        if permeability == 1.0 or choose_route(nominal.magnet, nominal.points) in BOTH:
            return None  # nothing is softer than what conducts no flux
        softer = nominal.study.with_(iron_ring=ring.with_(
            relative_permeability=1 + SOFTER * (permeability - 1)))
        return (nominal.solve(softer) - nominal.finite_element_field)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        ring = study.iron_ring
        if ring is None:
            return study
        return study.with_(iron_ring=IronRing(
            inner_radius_m=ring.inner_radius_m, outer_radius_m=ring.outer_radius_m,
            length_m=ring.length_m, curve=SteelCurve(kind="steel", name=STEEL)))


EFFECTS = (IronSaturationEffect(),)
