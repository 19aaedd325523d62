"""Blocks whose recoil permeability differs from the nominal one across the easy axis."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Place, with_array, with_exceptions
from halbach_fe.diagnosis.effects.recoil_permeability import STEP, RecoilPermeabilityEffect
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.formulation_choice import choose_route
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study, iron_of


class RecoilPermeabilityAcrossEffect(RecoilPermeabilityEffect):
    """All blocks have another recoil permeability across their easy axes."""

    name = "recoil_permeability_across"
    title = "recoil permeability of the blocks across the easy axis"

    def rough_signature(self, nominal: NominalFields, place: Place) -> Floats | None:
        """See `Effect.rough_signature`: it leaves out the iron, if that takes most of the time."""
        study = nominal.study
        raised = self.apply(study, place, [STEP])
        if iron_of(study) is None or choose_route(
                build_magnet(raised), nominal.points) != "moments":
            return None
        bare = nominal.solve(study.with_(iron_ring=None, iron=None))
        return ((nominal.solve(raised.with_(iron_ring=None, iron=None)) - bare) / STEP)[None]

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
