"""Blocks whose recoil permeability differs across the easy axis."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.blocks import Floats
from halbach_fe.effects.base import Effect, Parameter, Place, with_array
from halbach_fe.scene import Scene
from halbach_fe.study import Study


class RecoilPermeabilityAcross(Effect):
    """Of all blocks, across their easy axes."""

    name = "recoil_permeability_across"
    title = "recoil permeability of the blocks across the easy axis"
    kind = "field"
    parameters = (Parameter("difference", "1", 0.05),)

    def signature(self, scene: Scene, place: Place) -> Floats:
        """See `Effect.signature`."""
        step = 0.02  # upwards: below 1 there is none
        return ((scene.solve(self.apply(scene.study, place, [step])) - scene.solved) / step)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        array = study.array
        there = array.recoil_permeability_across or array.recoil_permeability
        return with_array(study, recoil_permeability_across=max(1.0, there + float(values[0])))


EFFECTS = (RecoilPermeabilityAcross(),)
