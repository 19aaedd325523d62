"""Blocks whose recoil permeability is another."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_array, with_remanence
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.study.model import Study


class RecoilPermeabilityEffect(Effect):
    """Of all blocks and all directions, or along the easy axis."""

    name = "recoil_permeability"
    title = "recoil permeability of the blocks"
    kind = "field"
    parameters = (Parameter("difference", "1", 0.05),)

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        step = 0.02  # upwards: below 1 there is none
        return ((scene.solve(self.apply(scene.study, place, [step])) - scene.solved) / step)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        value = study.array.recoil_permeability + float(values[0])
        across = study.array.recoil_permeability_across
        return with_array(with_remanence(study), recoil_permeability=value,
                          recoil_permeability_across=across)


EFFECTS = (RecoilPermeabilityEffect(),)
