"""What a diagnosis says: effects that are missing, and what no effect explains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place
from halbach_fe.diagnosis.evidence import Evidence
from halbach_fe.diagnosis.gross_errors import GrossError
from halbach_fe.diagnosis.loo_residuals import ResidualGroup
from halbach_fe.diagnosis.model_selection import (
    Candidate,
    SelectedEffect,
)
from halbach_fe.diagnosis.outliers import Outlier
from halbach_fe.diagnosis.position_noise import (
    PositionNoise,
)
from halbach_fe.diagnosis.solver_error import SolverErrorExplanation
from halbach_fe.inference.result import InferenceResult
from halbach_fe.study.model import Study


@dataclass(frozen=True)
class Hypothesis:
    """An effect at a place."""

    effect: Effect
    place: Place


@dataclass(frozen=True)
class IdentifiedEffect:
    """An effect that is missing from the study.

    Attributes
    ----------
    hypothesis : Hypothesis
    values, sd : ndarray, shape (k,)
        Its amplitudes, in the units of its parameters, and of its refinements once it is in the
        model.
    found : Found
        Odds, and what could be meant instead.
    """

    hypothesis: Hypothesis
    values: Floats
    sd: Floats
    found: SelectedEffect

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What the amplitudes are."""
        effect = self.hypothesis.effect
        return (*effect.parameters, *effect.refinements)[:len(self.values)]


@dataclass(frozen=True)
class UnknownCause:
    """Something that no effect of the catalogue explains.

    Attributes
    ----------
    kind : str
        ``field``: it solves Maxwell's equations in the bore, so that a source is missing;
        ``instrument``: it cannot; ``either``: the readings do not tell.
    log_bayes_factor : float
        Over the named effects alone.
    alone : bool
        Whether it is the better explanation by itself: no effect is named then.
    as_well : bool
        Whether it is about as good as several named effects together, in place of which it may be.
    largest_T : float
        Of it at any training reading.
    at_m : tuple of float
        Where that is.
    source_m : tuple of float or None
        Where a point dipole would have to be that is the best source, if a field is missing.
    """

    kind: Literal["field", "instrument", "either"]
    log_bayes_factor: float
    alone: bool
    as_well: bool
    largest_T: float
    at_m: tuple[float, ...]
    source_m: tuple[float, ...] | None


@dataclass(frozen=True)
class Diagnosis:
    """What a study lacks.

    Attributes
    ----------
    read : Study
        The study that reads the map right, without outliers; all else is compared with it.
    before, after : Update
        The inference with that study, and with the effects that were named.
    named : tuple of Named
    unknown : Unknown or None
        What they leave unexplained, if anything.
    probabilities : dict
        Of each effect, and of none, if at most one is missing.
    evidence : Evidence
    candidates : tuple of Candidate
        From which all that is said of the study as it was follows.
    groups_before, groups_after : list of Group
        Where readings disagree.
    left_out_before, left_out_after : ndarray, shape (n,)
        Standardized residuals of the training readings.
    rounds : int
    gross : tuple of Gross
        How the map was misread.
    outliers : tuple of Outlier
        Readings that are off singly.
    vibration : Vibration or None
        Of the probe, if the readings show it.
    numerical : Numerical or None
        The solver's own error, if it explains the misfit; then nothing else is looked for.
    at_rest : bool
        Whether the last round changed nothing.
    """

    read: Study
    before: InferenceResult
    after: InferenceResult
    named: tuple[IdentifiedEffect, ...]
    unknown: UnknownCause | None
    probabilities: dict[str, float]
    evidence: Evidence
    candidates: tuple[Candidate, ...]
    groups_before: list[ResidualGroup]
    groups_after: list[ResidualGroup]
    left_out_before: Floats
    left_out_after: Floats
    rounds: int
    gross: tuple[GrossError, ...] = ()
    outliers: tuple[Outlier, ...] = ()
    vibration: PositionNoise | None = None
    numerical: SolverErrorExplanation | None = None
    at_rest: bool = True

    @property
    def study(self) -> Study:
        """The study with what was missing."""
        return self.after.study

    @property
    def anything(self) -> bool:
        """Whether anything was named: an error, outliers, an effect, or vibration."""
        return bool(self.gross or self.outliers or self.named or self.vibration)
