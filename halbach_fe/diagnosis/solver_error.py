"""Test whether the solver's own error explains a misfit, before a physical cause is searched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from halbach_fe.diagnosis.evidence import Marginal, with_fewer_columns
from halbach_fe.inference.result import InferenceResult


@dataclass(frozen=True)
class SolverErrorExplanation:
    """A misfit that is no larger than the solver's error from its mesh and open boundary.

    Attributes
    ----------
    chi2_noise, chi2_errors : float
        Chi-squared per training reading with the blocks integrated out: for the noise alone, and
        for noise and solver error together.
    largest_error_T : float
        Largest solver error of any reading.
    largest_over_noise : float
        Largest ratio of a reading's solver error to its noise.
    """

    chi2_noise: float
    chi2_errors: float
    largest_error_T: float
    largest_over_noise: float


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
        update.prediction_prior.root(np.flatnonzero(training)))))
    residual = noise.whiten((update.readings - update.prediction_prior.mean)[training])
    chi2 = float(residual @ marginal.remove(residual[:, None])[:, 0]) / len(residual)
    if chi2 <= update.conflict_limit:
        return None
    return SolverErrorExplanation(chi2, update.prior_conflict, float(error.max()),
                                  float(np.max(error / update.noise.sd)))
