"""Blocks whose recoil permeability differs from the nominal one."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_array, with_remanence
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.model import Study


class RecoilPermeabilityEffect(Effect):
    """All blocks have another recoil permeability, and the same remanence.

    It changes in all directions, or along the easy axis only if the study has a separate value
    across the easy axis.
    """

    name = "recoil_permeability"
    title = "recoil permeability of the blocks"
    kind = "field"
    parameters = (Parameter("difference", "1", 0.05),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        step = 0.02  # upwards, since no recoil permeability is below 1
        raised = nominal.solve(self.apply(nominal.study, place, [step]))
        return ((raised - nominal.finite_element_field) / step)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        value = study.array.recoil_permeability + float(values[0])
        across = study.array.recoil_permeability_across
        return with_array(with_remanence(study), recoil_permeability=value,
                          recoil_permeability_across=across)


EFFECTS = (RecoilPermeabilityEffect(),)
