"""Effects on the material of all blocks: permeability and temperature."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.solver.formulation_choice import choose_route
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study, iron_of

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
    is_solved = True
    parameters = (Parameter("difference", "1", 0.05),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        raised = nominal.solve(self.apply(nominal.study, place, [STEP]))
        return ((raised - nominal.finite_element_field) / STEP)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        array, change = study.array, float(values[0])
        if not array.is_uniform:
            return with_exceptions(study, [BlockException(
                ring=block.ring, slot=block.slot,
                recoil_permeability=max(1.0, block.recoil_permeability + change))
                for block in build_magnet(study).blocks])
        return with_array(with_remanence(study),
                          recoil_permeability=array.recoil_permeability + change,
                          recoil_permeability_across=array.recoil_permeability_across)


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
        array = study.array
        if not array.is_uniform:
            return with_exceptions(study, [BlockException(
                ring=block.ring, slot=block.slot, recoil_permeability_across=max(
                    1.0, block.recoil_permeability_across + float(values[0])))
                for block in build_magnet(study).blocks])
        present = array.recoil_permeability_across or array.recoil_permeability
        return with_array(study, recoil_permeability_across=present + float(values[0]))


TYPICAL_COEFFICIENT_PER_K = -1e-3
"""Temperature coefficient of the remanence of NdFeB; that of SmCo is about a third of it."""


def coefficient(study: Study) -> float:
    """Return the relative change of the remanence per kelvin.

    That is the coefficient of the study's prior, or a typical one if the study has none.
    """
    return study.prior.temperature_coefficient_per_K or TYPICAL_COEFFICIENT_PER_K


class TemperatureEffect(Effect):
    """The temperature of the whole magnet differs, which scales all magnetizations alike."""

    name = "temperature"
    title = "temperature of the magnet"
    kind = "field"
    parameters = (Parameter("difference", "K", 10.0),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return coefficient(nominal.study) * nominal.block_fields.sum(axis=0)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return with_exceptions(study, [BlockException(
            magnetization_factor=1.0 + coefficient(study) * float(values[0]))])


class TemperatureGradientEffect(Effect):
    """The temperature varies linearly across the magnet.

    The parameters are the differences between the axis and the outer radius, along x and y.
    """

    name = "temperature_gradient"
    title = "temperature gradient across the magnet"
    kind = "field"
    parameters = (Parameter("x", "K", 3.0), Parameter("y", "K", 3.0),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        centres = np.array([block.middle[:2] for block in nominal.blocks])
        weights = coefficient(nominal.study) * centres / _outer_radius(nominal.magnet)
        return np.einsum("bk,bnc->knc", weights, nominal.block_fields)

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        magnet, exceptions = build_magnet(study), []
        blocks, radius = magnet.blocks, _outer_radius(magnet)
        uniform = study.array.is_uniform  # then one exception serves a slot of all rings
        for block in blocks[:study.array.blocks_per_ring] if uniform else blocks:
            middle = block.middle[:2] / radius
            exceptions.append(BlockException(
                ring=None if uniform else block.ring, slot=block.slot, magnetization_factor=float(
                    1.0 + coefficient(study) * (middle @ np.asarray(values)))))
        return with_exceptions(study, exceptions)


def _outer_radius(magnet: Magnet) -> float:
    """Return the outer radius of the blocks in m."""
    array = magnet.array
    return array.outer_radius_m if array.is_uniform else magnet.array_outer_radius


EFFECTS = (RecoilPermeabilityEffect(), RecoilPermeabilityAcrossEffect(), TemperatureEffect(),
           TemperatureGradientEffect())
