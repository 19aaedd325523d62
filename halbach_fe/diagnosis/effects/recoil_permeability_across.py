"""Blocks whose recoil permeability differs from the nominal one across the easy axis."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.diagnosis.effects.base import Place, with_array, with_exceptions
from halbach_fe.diagnosis.effects.recoil_permeability import RecoilPermeabilityEffect
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class RecoilPermeabilityAcrossEffect(RecoilPermeabilityEffect):
    """All blocks have another recoil permeability across their easy axes."""

    name = "recoil_permeability_across"
    title = "recoil permeability of the blocks across the easy axis"

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        array = study.array
        if not array.is_uniform:
            return with_exceptions(study, [BlockException(
                ring=block.ring, slot=block.slot, recoil_permeability_across=max(
                    1.0, block.recoil_permeability_across + float(values[0])))
                for block in build_magnet(study).blocks])
        present = array.recoil_permeability_across or array.recoil_permeability
        return with_array(study, recoil_permeability_across=present + float(values[0]))


EFFECTS = (RecoilPermeabilityAcrossEffect(),)
