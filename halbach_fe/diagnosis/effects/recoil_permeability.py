"""Blocks whose recoil permeability differs from the nominal one."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import (
    Effect,
    Parameter,
    Place,
    with_array,
    with_exceptions,
    with_remanence,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study

STEP = 0.02
"""Step of the difference by the permeability: upwards, since none is below 1."""


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
        raised = nominal.solve(self.apply(nominal.study, place, [STEP]))
        return ((raised - nominal.finite_element_field) / STEP)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        array, change = study.array, float(values[0])
        if not array.is_uniform:
            return with_exceptions(study, [BlockException(
                ring=block.ring, slot=block.slot,
                recoil_permeability=max(1.0, block.recoil_permeability + change))
                for block in build_magnet(study).blocks])
        return with_array(with_remanence(study),
                          recoil_permeability=array.recoil_permeability + change,
                          recoil_permeability_across=array.recoil_permeability_across)


EFFECTS = (RecoilPermeabilityEffect(),)
