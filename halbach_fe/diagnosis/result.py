"""The results of a diagnosis: identified effects, and an unknown cause if one remains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.diagnosis.effect_selection import Candidate, SelectedEffect
from halbach_fe.diagnosis.effects.base import Hypothesis, Parameter, Place
from halbach_fe.diagnosis.gross_errors import GrossError
from halbach_fe.diagnosis.marginal_evidence import (
    Evidence,
    Marginal,
    ResidualGroup,
    with_fewer_columns,
)
from halbach_fe.diagnosis.random_errors import Outlier, PositionNoise
from halbach_fe.inference.pose_result import Registration
from halbach_fe.inference.registration import axes_of_map
from halbach_fe.inference.result import InferenceResult
from halbach_fe.study.measurement_keys import Instrument, InstrumentSd
from halbach_fe.study.model import Study


@dataclass(frozen=True)
class SolverErrorExplanation:
    """A misfit that is no larger than the solver's error from its mesh and open boundary."""

    chi2_noise: float
    chi2_errors: float
    """Chi-squared per training reading with the blocks integrated out: for the noise alone, and for
    noise and solver error together."""
    largest_error_T: float
    """Largest solver error of any reading."""
    largest_over_noise: float
    """Largest ratio of a reading's solver error to its noise."""


def explain_by_solver_error(update: InferenceResult) -> SolverErrorExplanation | None:
    """Return an explanation if the solver's error removes the misfit, else None.

    The readings must disagree with the model by their noise alone, and agree by noise and solver
    error together.
    """
    error = update.response.error
    if not error.any() or update.prior_conflict > update.conflict_limit:
        return None
    training = ~update.held_out
    noise = update.noise.subset(training)
    marginal = Marginal.of(with_fewer_columns(noise.whiten(
        update.prediction_exact.root(np.flatnonzero(training)))))
    residual = noise.whiten((update.readings - update.prediction_prior.mean)[training])
    chi2 = float(residual @ marginal.remove(residual[:, None])[:, 0]) / len(residual)
    if chi2 <= update.conflict_limit:
        return None
    return SolverErrorExplanation(chi2, update.prior_conflict, float(error.max()),
                                  float(np.max(error / update.noise.sd)))


Floor = Mapping[str, float] | Mapping[str, Mapping[str, float]]
"""Model-free floor in T by component (``Bx``) of the only map, or by map and component."""


@dataclass(frozen=True)
class IdentifiedEffect:
    """An effect that the diagnosis found to be missing from the study."""

    hypothesis: Hypothesis
    values: Floats
    sd: Floats
    """Posterior mean and standard deviation of its amplitudes, in the units of its parameters. Once
    the effect is in the model, the amplitudes of its refinements follow those of its parameters.
    Shape (k,)."""
    selection: SelectedEffect
    """Log Bayes factor, posterior odds, and the alternatives that the readings cannot distinguish
    from this effect."""
    rivals: tuple[IdentifiedEffect, ...] = ()
    """These alternatives, each with the amplitudes that it would have in place of this effect."""

    @property
    def place(self) -> Place:
        """Where the effect is, see `Effect.refined_place`."""
        hypothesis = self.hypothesis
        return hypothesis.effect.refined_place(hypothesis.place, self.values.tolist())

    @property
    def name(self) -> str:
        """Effect and place."""
        return f"{self.hypothesis.effect.name} {self.place.name}".strip()

    @property
    def reported(self) -> tuple[Floats, Floats]:
        """Amplitudes and standard deviations as reports state them, see `Effect.reported`."""
        return self.hypothesis.effect.reported(self.hypothesis.place, self.values, self.sd)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters (and refinements) to which the amplitudes belong."""
        effect = self.hypothesis.effect
        return (*effect.parameters, *effect.refinements)[:len(self.values)]


@dataclass(frozen=True)
class FoundPose:
    """Where a map lies, found from nothing."""

    best: Registration
    """The most probable pose."""
    instrument: Instrument
    """The instrument of the study with that pose."""
    open: InstrumentSd
    """How far that pose, and the probe, are open from then on."""
    others: tuple[float, ...]
    """Probabilities of the other poses that the map hardly tells from the best one."""
    misfit_before: float
    misfit_after: float
    """Rms difference from the nominal magnet in the stated and in the best pose, relative to the
    map's rms; infinite for points that the study states inside of material."""
    map: str | None = None
    """Name of the map among those that the study lists; None if it lists none."""

    @property
    def text(self) -> str:
        """Where the map lies, in words."""
        place = ", ".join(
            f"{1e3 * value:.2f} ± {1e3 * sd:.2g}" for value, sd in zip(
                self.best.middle_m, self.best.translation_sd_m, strict=True)).replace("-", "−")
        axes = ", ".join(f"{name} along {axis}" for name, axis in axes_of_map(
            self.best.instrument).items()).replace("-", "−")
        return (f"the middle of {f'map {self.map}' if self.map else 'the map'} lies at ({place}) "
                f"mm in the magnet, with its axis {axes} of the magnet")


@dataclass(frozen=True)
class Suspicion:
    """Effects one of which is likelier than not to be missing, without certainty."""

    effects: tuple[str, ...]
    """Names of the effects, the likeliest first."""
    probability: float
    """Posterior probability that one of them is missing."""
    hypothesis: Hypothesis
    """The likeliest effect at its likeliest place."""
    shares: tuple[float, ...]
    """Probability of each of the effects."""
    log_bayes_factor: float
    """Of the likeliest effect at its place."""
    reason: Literal["odds", "which", "impossible", "roughly", "dropped"] = "odds"
    """Why it is not named: ``odds`` that are too small; the readings do not tell ``which`` of
    several it is; its amplitude would be ``impossible``; its signature was computed only
    ``roughly``; or the search ``dropped`` it again."""
    fitted: tuple[IdentifiedEffect, ...] = ()
    """Each of the effects at its likeliest place, with the amplitudes that it would have."""


@dataclass(frozen=True)
class Imitation:
    """Effects that may be missing without any reading to show it, as the blocks imitate them.

    With one of them the magnetizations of an update without it are off by more than their error
    bars.
    """

    probability: float
    """Posterior probability that such an effect is missing, if at most one more is."""
    effects: tuple[str, ...]
    """Names of the likeliest of them."""
    shares: tuple[float, ...]
    """Probability of each of these."""
    fitted: tuple[IdentifiedEffect, ...] = ()
    """The effects at their likeliest places, with the amplitudes that they would have."""


@dataclass(frozen=True)
class UnknownPart:
    """One term of a discrepancy that no effect of the catalogue explains."""

    acts_on: Literal["field", "readings", "gains", "positions"]
    """``field``; or ``readings``, ``gains`` or ``positions`` of the instrument."""
    along: str
    """Coordinate of which it is a function: ``z``, ``angle``, ``radius``, ``time``, ``field`` (the
    magnitude of B) or ``z and angle``; empty for a field."""
    or_else: tuple[str, ...]
    """What explains the readings as well: what it acts on, and the coordinate."""
    components: tuple[str, ...]
    """Components of the readings or the positions; empty for a field."""
    smooth: bool
    """Whether it varies smoothly, rather than roughly."""
    rms_T: float
    largest_T: float
    """Its size in the readings."""
    size: float
    """Rms error of the readings in T, of the gains, or of the positions in m; 0 for a field."""
    half_wave: float | None
    """Distance along the coordinate over which it typically changes its sign, in m, degrees, T or
    as a fraction of the map's time; None if it is constant."""
    log_bayes_factor: float
    map: str | None = None
    """Name of the map on whose instrument it acts, among those that the study lists; None for a
    field, and for the only map."""


@dataclass(frozen=True)
class UnknownCause:
    """A discrepancy that no effect of the catalogue explains.

    It is modelled as a field, or as functions of coordinates that act on readings or positions, see
    `halbach_fe.diagnosis.flexible_causes`.
    """

    kind: Literal["field", "instrument", "either"]
    """``field``: the discrepancy solves Maxwell's equations in the bore, so that a source outside
    the bore is missing; ``instrument``: it does not, so that the sensors are in error; ``either``:
    the readings do not distinguish the two, or not all of it solves them."""
    log_bayes_factor: float
    """Log Bayes factor of the discrepancy over no effect at all if ``alone`` or ``ambiguous``, and
    over the identified effects otherwise."""
    alone: bool
    """Whether the unknown cause by itself explains the readings better than all identified effects
    together, or no effect was identified. The diagnosis then reports no effects."""
    ambiguous: bool
    """Whether the unknown cause by itself is about as probable as several identified effects
    together, so that it may be the true explanation in their place. The effects are still reported.
    In diagnosis.json this is the key ``as_well``."""
    largest_T: float
    """Largest magnitude of the discrepancy at any point of the map."""
    at_m: tuple[float, ...]
    """Position of that point."""
    source_m: tuple[float, ...] | None
    """Position of the point dipole that explains the readings best, if a field is the likelier kind
    and point dipoles are in the catalogue."""
    parts: tuple[UnknownPart, ...] = ()
    """The terms of which it is modelled, the largest first."""


@dataclass(frozen=True)
class PossiblePosition:
    """A displacement of the map that the readings do not exclude."""

    amplitudes: dict[str, tuple[float, ...]]
    """Amplitudes by name of the effects that amount to it, such as ``wrong_line``."""
    probability: float
    """Among the positions that the readings do not exclude."""


@dataclass(frozen=True)
class DetectionLimits:
    """The smallest changes of single blocks that a map would have shown."""

    blocks: tuple[str, ...]
    """Names of the blocks that are magnetized."""
    loss: Floats
    """Part of the magnetization whose loss would have been named; above 1, if not even the missing
    block would have been. Shape (blocks,)."""
    displacement_m: Floats
    """Displacement in the direction in which it is least visible. Shape (blocks,)."""

    def worst(self, limits: Floats) -> str:
        """Return the name of the block with the largest of some limits (blocks,)."""
        return self.blocks[int(np.argmax(limits))]


@dataclass(frozen=True)
class Diagnosis(ShownInNotebook):
    """The result of a diagnosis.

    Attributes
    ----------
    corrected_study : Study
        The study corrected for gross errors of the map, without its outliers. All else is compared
        with this study.
    before, after : InferenceResult
        The inference with the corrected study, and with the identified effects added to it.
    study : Study
        The study with everything that the diagnosis added. Terms of instruments that it leaves open
        are still what it says.
    identified : tuple of IdentifiedEffect
    unknown : UnknownCause or None
        The discrepancy that the identified effects leave, if there is one.
    suspected : tuple of Suspicion
        What is likelier than not to be missing, but not certain enough to be named.
    imitated : Imitation or None
        What may be missing that blocks imitate, if it is not improbable.
    probabilities : dict
        Posterior probability of each effect by name, and of ``none``, on the assumption that at
        most one effect is missing from the corrected study. Effects that explain too little to be
        solved for have that of their rough signature, see
        `halbach_fe.diagnosis.effects.base.Effect.rough_signature`. An unlisted cause that was found
        in place of all effects is among them as ``unknown``.
    evidence : Evidence
        Evidence of all signatures for the corrected study.
    candidates : tuple of Candidate
        The hypotheses to which the columns of ``evidence`` belong.
    groups_before, groups_after : list of ResidualGroup
        Chi-squared of groups of training readings.
    loo_residuals_before, loo_residuals_after : ndarray, shape (n,)
        Standardized leave-one-out residuals of the training readings.
    rounds : int
        Number of rounds of solving and searching.
    answer : int
        Number of the round whose model predicts held-out readings best, and is the result.
    gross_errors : tuple of GrossError
        Errors of the map's units, axes or magnet.
    poses : tuple of FoundPose
        Where the maps lie, if they do not lie where the study says.
    outliers : tuple of Outlier
        Single readings that are excluded.
    position_noise : tuple of PositionNoise
        Random errors of the probe's positions in those maps that show them.
    solver_error : SolverErrorExplanation or None
        The solver's own error, if it explains the misfit. The search for effects is then skipped.
    converged : bool
        Whether the last round changed neither the effects nor their amplitudes.
    unsolved : bool
        Whether a further round was left out, as its model had no solution.
    positions : tuple of PossiblePosition
        Displacements of the map that the magnet's symmetry hardly distinguishes, if there are
        several; the effects are those of the first.
    limits : DetectionLimits or None
        The smallest changes of single blocks that the map would have shown; None if no block is
        magnetized.
    uncompared : int or None
        Number of hypotheses that were not compared, if the time limit cut the search; None if it
        did not.
    floor_T : dict, or None
        The model-free floor of the map by component (``Bx``), if Maxwell's check of it is known; of
        maps that the study lists, by map and component.
    looked_for : tuple of str, or None
        Names of the only effects that were looked for; None if these are all of the catalogue.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> diagnosis = hf.diagnose(magnet, hf.read_map("map.csv"), hf.Session.open("diagnosis"),
    ...                         effects=["gain_x"])
    >>> sorted(diagnosis.probabilities)
    ['gain_x', 'none']
    """

    corrected_study: Study
    before: InferenceResult
    after: InferenceResult
    study: Study
    identified: tuple[IdentifiedEffect, ...]
    unknown: UnknownCause | None
    probabilities: dict[str, float]
    evidence: Evidence
    candidates: tuple[Candidate, ...]
    groups_before: list[ResidualGroup]
    groups_after: list[ResidualGroup]
    loo_residuals_before: Floats
    loo_residuals_after: Floats
    rounds: int
    gross_errors: tuple[GrossError, ...] = ()
    poses: tuple[FoundPose, ...] = ()
    outliers: tuple[Outlier, ...] = ()
    position_noise: tuple[PositionNoise, ...] = ()
    solver_error: SolverErrorExplanation | None = None
    imitated: Imitation | None = None
    converged: bool = True
    unsolved: bool = False
    positions: tuple[PossiblePosition, ...] = ()
    limits: DetectionLimits | None = None
    floor_T: Floor | None = None
    uncompared: int | None = None
    suspected: tuple[Suspicion, ...] = ()
    answer: int = 0
    looked_for: tuple[str, ...] | None = None

    @property
    def is_at_rest(self) -> bool:
        """Whether the search came to rest, at effects that held-out readings do not contradict."""
        return self.converged and self.answer in (0, self.rounds)

    @property
    def is_partial(self) -> bool:
        """Whether effects of the catalogue were not compared, as only some were asked for or the
        time was up.
        """
        return self.looked_for is not None or bool(self.uncompared)

    @property
    def found_anything(self) -> bool:
        """Whether the diagnosis found gross errors, poses, outliers, effects or position noise."""
        return bool(self.gross_errors or self.poses or self.outliers or self.identified
                    or self.position_noise)

    @property
    def verdict(self) -> str:
        """What kind of answer it is, a word of diagnosis.json that docs/diagnosis.md explains."""
        after = self.after
        if self.solver_error:
            return "numerical"
        if self.unknown and not (self.identified or self.gross_errors or self.poses):
            return "unknown"
        if self.suspected and not self.found_anything:
            return "suspected"
        conflicting = after.prior_conflict > after.conflict_limit or after.held_out_conflict
        if conflicting and not self.identified and not self.unknown:
            return "unexplained"
        return "named" if self.found_anything else "nothing"
