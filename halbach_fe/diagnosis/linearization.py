"""A point at which effects are linearized: the training readings, and what every effect changes in
them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from halbach_fe.core.arrays import Floats, Ints, rms
from halbach_fe.diagnosis.effects.base import Effect, Hypothesis, Place
from halbach_fe.diagnosis.effects.magnetization import AssemblyEffect, BlockMissingEffect
from halbach_fe.diagnosis.flexible_causes import fields_of_rms, harmonic_fields
from halbach_fe.diagnosis.marginal_evidence import Marginal, with_fewer_columns
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.diagnosis.scanned_maps import Campaign, FieldAt, Scene
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.result import InferenceResult
from halbach_fe.solver.mesh import with_rough_mesh
from halbach_fe.solver.routes import iron_change, solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import NoiseCovariance
from halbach_fe.study.model import FIELD_KEYS, Study

Signatures = dict[tuple[str, Place], Floats]
"""Whitened signatures by effect name and place: training readings (rows, k) per unit of each of the
effect's k parameters."""


@dataclass(frozen=True)
class NominalSolver:
    """Solves for the fields of nominal magnets, each of them once, and keeps signatures."""

    session: Session
    _solved: dict[tuple[str, str, bytes], Any] = field(default_factory=dict, repr=False)
    _signatures: dict[tuple[str, bytes], Signatures] = field(default_factory=dict, repr=False)

    def signatures(
        self, study: Study, update: InferenceResult, prior_mean: Floats, campaign: Campaign
    ) -> Signatures:
        """Return the store of signatures for a study and its map.

        They depend on everything but the readings: the places and times of the maps, their noise,
        and what is known of the blocks.
        """
        parts = (campaign.stated_points, campaign.times, update.errors.sd, prior_mean,
                 update.held_out.astype(float))
        key = study.model_dump_json(), b"".join(np.ascontiguousarray(part).tobytes()
                                                for part in parts)
        return self._signatures.setdefault(key, {})

    def field(self, study: Study, points: Floats) -> Floats:
        """Return `solve_nominal` of the magnet of a study at points (n, 3) in m."""
        found: Floats = self._once("field", solve_nominal, study, points)
        return found

    def rough_field(self, study: Study, points: Floats) -> Floats:
        """Return `field` on a mesh that suffices for the signature of an effect, see
        `with_rough_mesh`.
        """
        return self.field(with_rough_mesh(study), points)

    def iron_change(self, study: Study, points: Floats, few_modes: bool) -> Floats | None:
        """Return `iron_change` of the magnet of a study at points (n, 3) in m."""
        found: Floats | None = self._once(
            "iron of few modes" if few_modes else "iron",
            partial(iron_change, few_modes=few_modes), study, points)
        return found

    def _once(
        self, name: str, solve: Callable[[Magnet, Floats, Session], Any], study: Study,
        points: Floats
    ) -> Any:
        key = name, study.model_dump_json(include=FIELD_KEYS), points.tobytes()
        if key not in self._solved:
            self._solved[key] = solve(build_magnet(study), points, self.session)
        return self._solved[key]


def apply_effects(study: Study, identified: Sequence[IdentifiedEffect]) -> Study:
    """Return the study with identified effects applied at their amplitudes.

    Blocks are moved first: what has a place is about the block that is there after all moves.
    """
    for effect in sorted(identified, key=lambda one: not isinstance(
            one.hypothesis.effect, AssemblyEffect)):
        study = effect.hypothesis.apply(study, effect.values.tolist())
    return study


MOVES = (AssemblyEffect, BlockMissingEffect)
"""Effects of whole blocks, which are reversed, missing or elsewhere."""


def moves_of(identified: Sequence[IdentifiedEffect]) -> list[IdentifiedEffect]:
    """Return those of some effects after which whole blocks are reversed, missing or elsewhere."""
    return [one for one in identified if isinstance(one.hypothesis.effect, MOVES)]


def amplitude_scale(effect: Effect) -> Floats:
    """Return the prior standard deviations of an effect's parameters and refinements."""
    return np.array([parameter.sd for parameter in (*effect.parameters, *effect.refinements)])


@dataclass(frozen=True)
class Linearization:
    """A point at which all effects are linearized, with some of them in the model already.

    The signatures of all effects outside the model are those of the study from which the search
    started, so that later rounds reuse them; beside blocks that are reversed, missing or elsewhere
    in the model, those of that study with these blocks so. In two rings of 12 blocks, one that is
    reversed changes the signature of a gap by a fifth of its norm.
    """

    corrected: Study
    """The study corrected for gross errors and outliers, without any effects."""
    start: Sequence[IdentifiedEffect]
    """Effects from which the search started."""
    update: InferenceResult
    """The inference with the identified effects in the model."""
    prior_mean: Floats
    """Prior mean (parameters,) in A/m of the magnetizations of the study without effects."""
    campaign: Campaign
    solver: NominalSolver
    identified: Sequence[IdentifiedEffect] = ()
    """The effects in the model of ``update``."""
    signatures: Signatures = field(default_factory=dict)
    """Signatures of effects outside the model; those that are missing are added."""

    @cached_property
    def training(self) -> Training:
        """The training readings of the inference."""
        return Training.of(self.update, self.campaign)

    @cached_property
    def study(self) -> Study:
        """The study from which the search started."""
        return self.campaign.with_terms(
            apply_effects(self.corrected, self.start), self.update.terms)

    @cached_property
    def scene(self) -> Scene:
        """That of the study with the identified effects."""
        return self._scene_of(self.update.study, self.solver.field)

    @cached_property
    def scene_at_start(self) -> Scene:
        """That of the study from which the search started."""
        return self._scene_of(self.study, self.solver.rough_field)

    @cached_property
    def scene_after_moves(self) -> Scene:
        """That of the study from which the search started, with moves of whole blocks."""
        return self.campaign.scene(
            self._study_after_moves, self.solver.rough_field, self.solver.iron_change,
            self.update.by_block(self.update.prior.mean))

    @cached_property
    def _study_after_moves(self) -> Study:
        return self.campaign.with_terms(apply_effects(
            self.corrected, [*self.start, *moves_of(self.identified)]), self.update.terms)

    def scene_outside(self, effect: Effect) -> Scene:
        """Return the scene in which the signatures of an effect outside the model are computed."""
        return self.scene_after_moves if self._is_after_moves(effect) else self.scene_at_start

    def _is_after_moves(self, effect: Effect) -> bool:
        """Tell whether the signature of an effect is that beside the moves of whole blocks in the
        model. That of another move is not, as it would take the place of one of them.
        """
        return bool(moves_of(self.identified)) and not isinstance(effect, MOVES)

    def _known(self, effect: Effect) -> Signatures:
        """Return the signatures that an earlier search has computed for the same study and maps."""
        return self._known_after_moves if self._is_after_moves(effect) else self._known_at_start

    @cached_property
    def _known_at_start(self) -> Signatures:
        return self.solver.signatures(self.study, self.update, self.prior_mean, self.campaign)

    @cached_property
    def _known_after_moves(self) -> Signatures:
        return self.solver.signatures(
            self._study_after_moves, self.update, self.update.prior.mean, self.campaign)

    @cached_property
    def in_model(self) -> dict[tuple[str, Place], IdentifiedEffect]:
        """The identified effects by name and place."""
        return {effect.hypothesis.key: effect for effect in self.identified}

    def places(self, effects: Sequence[Effect]) -> dict[str, list[Place]]:
        """Return the places of every effect, by its name, which are worth a signature."""
        response, marginal = self.training.response, self.training.marginal
        kept = marginal.remove(response)
        uniform = slice(0, self.update.magnet.dimension * len(self.update.magnet.blocks))
        information = response[:, uniform].T @ kept[:, uniform]
        score = kept[:, uniform].T @ self.training.residual
        found: dict[str, list[Place]] = {}
        for effect in effects:
            shortlist: Sequence[Place] = ()
            if stated := self.campaign.places(effect, self.study):
                shortlist = (self.campaign.places(effect, self.update.study)
                             if effect.kind == "instrument" else effect.shortlist(
                    self.update.study, self.update.prior.mean[uniform], information, score))
            before = [place for name, place in (*self.signatures, *self.in_model)
                      if name == effect.name]
            found[effect.name] = list(dict.fromkeys((*shortlist, *before))) if stated else []
        return found

    def stored(self, hypothesis: Hypothesis) -> Floats | None:
        """Return the whitened signature (rows, k) of a hypothesis outside the model, if known."""
        signature = self.signatures.get(
            hypothesis.key, self._known(hypothesis.effect).get(hypothesis.key))
        if signature is not None:
            self.signatures[hypothesis.key] = signature
        return signature

    def exact(self, hypothesis: Hypothesis) -> Floats:
        """Compute the whitened signature (rows, k) of a hypothesis outside the model."""
        signature = self._by_response(hypothesis, self.scene_outside(hypothesis.effect))
        self._known(hypothesis.effect)[hypothesis.key] = signature
        self.signatures[hypothesis.key] = signature
        return signature

    def rough(self, hypothesis: Hypothesis, is_over: bool) -> Floats | None:
        """Return the whitened rough signature (rows, k) of a hypothesis outside the model.

        It is None if there is none, or if it is not known and the time is over.
        """
        key = f"{hypothesis.effect.name}, roughly", hypothesis.place
        if key not in self.signatures and not is_over:
            fields = self.scene_outside(hypothesis.effect).rough_signature(hypothesis)
            if fields is not None:
                self.signatures[key] = self.training.shown(fields)
        return self.signatures.get(key)

    def of_identified(self, present: IdentifiedEffect) -> tuple[Floats, Floats]:
        """Return the whitened signature (rows, k) of an effect in the model, and its amounts (k,).

        That of an effect which is applied in full is the difference that it makes. The product of
        both is what the effect contributes to the model.
        """
        hypothesis = present.hypothesis
        effect, scale = hypothesis.effect, amplitude_scale(hypothesis.effect)
        amounts = np.pad(present.values, (0, len(scale) - len(present.values)))
        if not effect.applied_in_full:
            signature = self.training.shown(self.scene.derivative(hypothesis, amounts))
            size = len(effect.parameters)
            if amounts[size:].any() and amounts[:size].any():
                # without its parameters it is absent, wherever its refinements have put it
                moved = signature[:, size:] @ amounts[size:]
                signature[:, :size] -= np.outer(
                    moved, amounts[:size] / (amounts[:size] @ amounts[:size]))
            return signature, amounts
        amounts[0] = 1.0
        without = self._scene_of(self.campaign.with_terms(apply_effects(self.corrected, [
            one for one in self.identified if one is not present]), self.update.terms),
            self.solver.field)
        if effect.refinements:
            return self.training.shown(_discrete_signature(hypothesis, amounts, without)), amounts
        return self._by_response(hypothesis, without), amounts

    def refined(self, hypothesis: Hypothesis) -> Floats:
        """Compute the whitened signature (rows, k) at a place that `_improved_place` has found."""
        signature = self.training.shown(
            self.scene_outside(hypothesis.effect).signature(hypothesis))
        self.signatures[hypothesis.key] = signature
        return signature

    def _scene_of(self, study: Study, field: FieldAt) -> Scene:
        return self.campaign.scene(
            study, field, self.solver.iron_change, self.update.by_block(self.prior_mean))

    def _by_response(self, hypothesis: Hypothesis, scene: Scene) -> Floats:
        """Return the whitened signature (rows, k), by the response matrix if that is possible."""
        change = hypothesis.effect.magnetization_change(scene.fields[0], hypothesis.place)
        if change is None:
            return self.training.shown(scene.signature(hypothesis))
        size = self.update.magnet.dimension
        return np.sum([self.training.response[:, size * block:size * (block + 1)] @ vector
                       for block, vector in change.items()], axis=0)[:, None]


@dataclass(frozen=True)
class Training:
    """The training readings of an inference, with blocks and solver error integrated out.

    So are the terms of instruments that the study leaves open.
    """

    update: InferenceResult
    rows: Ints
    noise: NoiseCovariance
    response: Floats
    """Whitened response (rows, parameters) of the readings to the magnetizations."""
    marginal: Marginal
    residual: Floats
    """Whitened residual (rows,) of the readings from the prior mean."""

    @classmethod
    def of(cls, update: InferenceResult, campaign: Campaign) -> Training:
        """Integrate out what the effects of a campaign are not to explain."""
        rows = np.flatnonzero(~update.held_out)
        noise = update.errors.subset(rows)
        residual = update.readings - update.prediction_prior.mean
        marginal = Marginal.of(with_fewer_columns(np.hstack([
            noise.whiten(update.prediction_prior.root(rows)),
            _whitened(noise, rows, update.observation.read(_solver_error(update, campaign)))])))
        return cls(update, rows, noise, noise.whiten(update.response.matrix[rows]), marginal,
                   _whitened(noise, rows, residual))

    def shown(self, fields: Floats) -> Floats:
        """Return the whitened readings (rows, k) of changes (k, n, 3) in T of the maps."""
        return _whitened(self.noise, self.rows, self.update.observation.read(fields))


def _whitened(noise: NoiseCovariance, rows: Ints, readings: Floats) -> Floats:
    """Return some of all readings (..., readings) in T, whitened, as (rows, ...)."""
    return noise.whiten(np.ascontiguousarray(readings[..., rows].T))


def _solver_error(update: InferenceResult, campaign: Campaign) -> Floats:
    """Return what maps show (k, n, 3) in T of smooth fields as large as the solver's error.

    The solver's error is smooth, unlike noise. These fields are integrated out with the blocks, so
    that no effect is identified for a misfit that the solver's error can explain.
    """
    size = rms(update.response.error)
    points = campaign.points_of(update.study)
    fields = fields_of_rms(harmonic_fields(points), size) if size else np.zeros((1, *points.shape))
    return campaign.seen(update.study, fields)


def _discrete_signature(hypothesis: Hypothesis, amounts: Floats, scene: Scene) -> Floats:
    """Return the signatures (k, n, 3) in T of an effect that is applied in full.

    Such an effect is not linear in its first amplitude, which is 1 if it is present. The first
    signature is the finite difference between the fields with and without the effect at the given
    amounts, less the contribution of its refinements to this difference. The linear signatures of
    the refinements follow it.

    Parameters
    ----------
    amounts : ndarray, shape (k,)
        Amplitudes of the parameters and refinements.
    scene : Scene
        Fields of the study without the effect.
    """
    effect, place, values = hypothesis.effect, hypothesis.place, amounts.tolist()

    def of_map(nominal: NominalFields) -> Floats:
        refined = effect.refine(nominal, place, values)
        changed = nominal.solve(effect.apply(nominal.study, place, values))
        change = changed - nominal.finite_element_field
        return np.concatenate([(change - np.tensordot(amounts[1:], refined, 1))[None], refined])

    return scene.seen(hypothesis, of_map)
