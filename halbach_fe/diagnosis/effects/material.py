"""Effects on the material of all blocks: permeability, temperature, and losses by the knee."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachError
from halbach_fe.diagnosis.effects.base import (
    Effect,
    MagnetizationEffect,
    Parameter,
    Place,
    together,
    unchecked_blocks,
    with_array,
    with_exceptions,
    with_remanence,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.moments.cells import cells_of
from halbach_fe.solver.moments.solve import KneeLaw
from halbach_fe.solver.routes import choose_route
from halbach_fe.study.array_keys import BlockException
from halbach_fe.study.materials import MOST_SQUARE, MU_0, Demagnetization, grade_of
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
    is_solved = True
    parameters = (Parameter("difference", "1", 0.05),)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        raised = nominal.solve(self.apply(nominal.study, place, [STEP]))
        return ((raised - nominal.finite_element_field) / STEP)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return _with_permeabilities(study, lambda along, across: {
            "recoil_permeability": along + float(values[0]), "recoil_permeability_across": across})


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
        return _with_permeabilities(study, lambda along, across: {
            "recoil_permeability_across": (across or along) + float(values[0])})


def _with_permeabilities(
    study: Study, keys: Callable[[float, float | None], dict[str, float | None]]
) -> Study:
    """Return the study with keys by what the relative permeabilities are along the easy axis, and
    across it where that is another value, or is stated by exceptions: of the array, or else of
    blocks.
    """
    array = study.array
    if array.is_uniform and not any(one.recoil_permeability or one.recoil_permeability_across
                                    for one in array.exceptions):
        return with_array(with_remanence(study), **keys(
            array.recoil_permeability, array.recoil_permeability_across))
    blocks, is_stated = unchecked_blocks(study), any(
        one.recoil_permeability_across for one in array.exceptions)
    present = {number: (block.recoil_permeability, block.recoil_permeability_across
                        if is_stated or not block.isotropic else None)
               for number, block in enumerate(blocks) if block.remanence}
    return with_exceptions(study, [BlockException.model_validate(where | keys(*both))
                                   for where, both in together(blocks, present)])


TYPICAL_COEFFICIENT_PER_K = -1e-3
"""Temperature coefficient of the remanence of NdFeB; that of SmCo is about a third of it."""


def coefficient(study: Study) -> float:
    """Return the relative change of the remanence per kelvin.

    That is the coefficient of the study's prior, of its table `demagnetization`, or of its grade; a
    typical one if the study has none.
    """
    stated = [study.prior.temperature_coefficient_per_K, *(
        table.remanence_coefficient_per_K
        for table in (study.demagnetization, grade_of(study.array)) if table is not None)]
    return next(filter(None, stated), TYPICAL_COEFFICIENT_PER_K)


class TemperatureEffect(MagnetizationEffect):
    """The temperature of the whole magnet differs, which scales all magnetizations alike."""

    name = "temperature"
    title = "temperature of the magnet"
    parameters = (Parameter("difference", "K", 10.0),)

    def rates(self, magnet: Magnet, place: Place) -> Mapping[int, Sequence[float]]:
        return dict.fromkeys(range(len(magnet.blocks)), (coefficient(magnet.study),))


class TemperatureGradientEffect(MagnetizationEffect):
    """The temperature varies linearly across the magnet.

    The parameters are the differences between the axis and the outer radius, along x and y.
    """

    name = "temperature_gradient"
    title = "temperature gradient across the magnet"
    parameters = (Parameter("x", "K", 3.0), Parameter("y", "K", 3.0),)

    def rates(self, magnet: Magnet, place: Place) -> Mapping[int, Sequence[float]]:
        per_m = coefficient(magnet.study) / _outer_radius(magnet)
        return {number: (per_m * block.middle[:2]).tolist()
                for number, block in enumerate(magnet.blocks)}


def _outer_radius(magnet: Magnet) -> float:
    """Return the outer radius of the blocks in m."""
    array = magnet.array
    return array.outer_radius_m if array.is_uniform else magnet.array_outer_radius


COERCIVITIES = tuple(np.geomspace(0.45, 1.5, 12).tolist())
"""Candidate coercivities mu_0 H_cJ relative to the remanence, one place each. Fields that oppose
the magnetization in a Halbach array reach from 0.3 to 1.3 times the remanence. Between two places
the losses change by a factor of 2 to 5, so that one of them explains most of any losses."""

STATED = (1.1, 1.0, 0.91, 0.83, 0.75, 0.68, 0.62, 0.56, 0.51)
"""Candidate coercivities relative to that of the study's table `demagnetization`, if it has one:
down to that of NdFeB which is 80 K hotter."""

SQUARENESS, LEAST_SQUARE = 0.85, 0.3
"""Squareness from which the search starts, and the smallest one; the largest is `MOST_SQUARE`."""

STEPS = (0.01, 0.05)
"""Steps of the finite differences, in the logarithms of `KneeEffect.refinements`."""


class KneeEffect(Effect):
    """The blocks have lost what their own field takes by the knee of the demagnetization curve.

    A place is a coercivity. The refinements are the logarithms of the coercivity relative to it and
    of the odds of the squareness, so that no step leads to impossible ones; reports state
    coercivity and squareness. A temperature acts by the ratio of coercivity and remanence alone,
    which are those at the temperature the magnet has had: the two cannot be told apart.
    """

    name = "knee"
    title = "losses by the knee of the demagnetization curve"
    is_solved = True
    parameters = (Parameter("there", "1", 1.0),)
    refinements = (Parameter("coercivity", "A/m", 0.1, longest_step=0.05),
                   Parameter("squareness", "1", 1.0, longest_step=0.5))
    unique = True
    is_binary = True
    applied_in_full = True

    def places(self, study: Study) -> Sequence[Place]:
        material = study.demagnetization
        if study.dimension == 2 or (material is not None and material.irreversible):
            return []
        blocks = unchecked_blocks(study)
        strongest = max((abs(block.remanence) for block in blocks), default=0.0)
        # largest number of blocks for which losses are searched unless the study describes the
        # material: each place takes a solution of the whole magnet, of a few seconds for 64 blocks
        most_blocks = 100
        if material is not None:
            stated = material.intrinsic_coercivity_A_per_m * (
                1 + material.coercivity_coefficient_per_K * (
                    material.temperature_C - material.reference_temperature_C))
            values = [factor * stated for factor in STATED]
        elif len(blocks) <= most_blocks:
            values = [factor * strongest / MU_0 for factor in COERCIVITIES]
        else:
            return []
        found = [Place(at_m=(value,), words=f"near {value / 1e3:.0f} kA/m") for value in values]
        try:
            self.apply(study, found[0], [1.0])
        except HalbachError:  # the study asks for a route that has no losses
            return []
        return found

    def shortlist(
        self, study: Study, mean: Floats, information: Floats, score: Floats
    ) -> Sequence[Place]:
        """Return the coercivities that may explain the readings, see `Effect.shortlist`.

        A signature takes seconds. Here the losses are those in the field of the intact blocks in
        vacuum, and act by their mean over each block.
        """
        # Range of the factor between the losses that the readings want and the cheap estimate of
        # them, within which a coercivity is tried. The estimate leaves out that lost polarization
        # changes the field of the others, which changes the losses by less than a factor of two.
        likely_scales = (0.2, 5.0)
        # Gain in log likelihood, by the cheap estimate of the losses, from which a coercivity is
        # tried. To be named, a knee needs more than 11: log odds of 5 against prior odds of 1 to 50
        # for 12 places.
        least_gain = 3.0
        places = self.places(study)
        if not places:
            return []
        losses = _mean_losses(study, [
            self.apply(study, place, [1.0]).demagnetization for place in places]) / MU_0
        gains = losses @ score
        sizes = np.einsum("pi,ij,pj->p", losses, information, losses)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(sizes > 0, gains / sizes, 0.0)
        likely = (scale * gains > 2 * least_gain) & (scale > likely_scales[0]) & (
            scale < likely_scales[1])
        return [place for place, tried in zip(places, likely.tolist(), strict=True) if tried]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`, followed by those of the refinements.

        Where much is lost, that of the nearest place alone left more than a cause of any shape did,
        by which the knee was no candidate any more.
        """
        before, cells = nominal.study, _cells(nominal.study, 2)
        if not nominal.magnet.is_vacuum:  # by the same route, so that both have the same cells
            before = before.with_(solver__route="moments", mesh__cells_per_side=cells)
        lost = self.apply(before, place, [1.0]).with_(mesh__cells_per_side=cells)
        return np.concatenate([(nominal.solve(lost) - nominal.solve(before))[None],
                               self.refine(nominal, place, [1.0, 0.0, 0.0])])

    def refine(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        here = nominal.solve(self.apply(nominal.study, place, values))
        return np.array([
            (nominal.solve(self.apply(nominal.study, place, np.add(
                values, step * np.eye(3)[1 + number]).tolist())) - here) / step
            for number, step in enumerate(STEPS)])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        _, coercivity, squareness = [*values, 0.0, 0.0][:3]
        law = {"intrinsic_coercivity_A_per_m": _coercivity(place, coercivity),
               "squareness": _squareness(squareness), "irreversible": True}
        material = study.demagnetization
        if material is None:
            changed = Demagnetization.model_validate(
                {"remanence_coefficient_per_K": 0.0, "coercivity_coefficient_per_K": 0.0} | law)
        else:
            law["intrinsic_coercivity_A_per_m"] /= 1 + material.coercivity_coefficient_per_K * (
                material.temperature_C - material.reference_temperature_C)
            changed = material.with_(**law)
        return study.with_(demagnetization=changed, mesh__cells_per_side=_cells(study))

    def reported(self, place: Place, values: Floats, sd: Floats) -> tuple[Floats, Floats]:
        values, sd = values.copy(), sd.copy()
        if len(values) > 1:
            relative, odds = values[1:]
            values[1] = _coercivity(place, relative)
            sd[1] *= values[1]
            share = (_squareness(odds) - LEAST_SQUARE) / (MOST_SQUARE - LEAST_SQUARE)
            values[2] = _squareness(odds)
            sd[2] *= (MOST_SQUARE - LEAST_SQUARE) * share * (1 - share)
        return values, sd


def _mean_losses(study: Study, materials: Sequence[Demagnetization | None]) -> Floats:
    """Return the change of the mean polarization of every block (materials, 3 blocks) in T, if each
    is in the field of the intact blocks in vacuum.
    """
    blocks = unchecked_blocks(study)
    # Gauss nodes per direction and block at which the field is computed for the cheap estimate
    nodes = 3
    cells = cells_of(blocks, 1, divisions=nodes)
    polarization = np.array([block.polarization for block in blocks])
    strength = np.linalg.norm(polarization, axis=1, keepdims=True)
    # of blocks that are upside down, too; of missing ones any
    easy = polarization / np.where(strength > 0, strength, 1.0)
    # within a block, the field without its own polarization is mu_0 H
    field = field_of(blocks, cells.nodes.reshape(-1, 3)).reshape(cells.nodes.shape)
    along = np.einsum("nqi,ni->nq", field, easy[cells.block])
    volume = np.bincount(cells.block, cells.volume, len(blocks))
    found = np.empty((len(materials), len(blocks), 3))
    for number, material in enumerate(materials):
        assert material is not None  # the effect has put it into the study
        lost = 1 - KneeLaw.of(material).kept(along)
        share = np.bincount(cells.block, cells.volume * np.einsum(
            "nq,nq->n", cells.weights, lost), len(blocks)) / volume
        found[number] = -share[:, None] * polarization
    return found.reshape(len(materials), -1)


def _coercivity(place: Place, relative: float) -> float:
    """Return the coercivity in A/m at ``relative``, the logarithm of its ratio to the place's."""
    return float(place.at_m[0] * np.exp(relative))


def _squareness(log_odds: float) -> float:
    """Return the squareness between its limits at a log odds that is 0 for `SQUARENESS`."""
    start = (SQUARENESS - LEAST_SQUARE) / (MOST_SQUARE - LEAST_SQUARE)
    odds = start / (1 - start) * float(np.exp(log_odds))
    return LEAST_SQUARE + (MOST_SQUARE - LEAST_SQUARE) * odds / (1 + odds)


def _cells(study: Study, fewest: int = 3) -> int:
    """Return the study's number of cells along a block's side, or the fewest for losses: those of
    the model need 3, those of a signature 2.
    """
    return max(fewest, study.mesh.cells_per_side or 0)


EFFECTS = (RecoilPermeabilityEffect(), RecoilPermeabilityAcrossEffect(), TemperatureEffect(),
           TemperatureGradientEffect(), KneeEffect())
