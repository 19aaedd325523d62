"""Whether the solver's own error explains a misfit: numerical causes come before physical ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from halbach_fe.diagnosis.evidence import Marginal
from halbach_fe.inference.result import InferenceResult


@dataclass(frozen=True)
class SolverErrorExplanation:
    """A misfit that is as large as the solver's error: of its mesh and open boundary.

    Attributes
    ----------
    chi2_noise, chi2_errors : float
        Per training reading, the blocks integrated out: by the noise alone, and by noise and the
        solver's error.
    largest_error_T : float
        Of any reading.
    largest_over_noise : float
        The same over the noise of that reading.
    """

    chi2_noise: float
    chi2_errors: float
    largest_error_T: float
    largest_over_noise: float


def explain_by_solver_error(update: InferenceResult) -> SolverErrorExplanation | None:
    """Tell whether readings disagree with the model by their noise, but not by the solver's error
    as well.
    """
    error = update.response.error
    if not error.any() or update.prior_conflict > update.conflict_limit:
        return None
    training = ~update.held_out
    noise = update.noise.part(training)
    matrix = update.response.matrix[training]
    marginal = Marginal.of(noise.whiten(matrix @ update.prior.root))
    residual = noise.whiten(
        update.readings[training] - update.response.offset[training] - matrix @ update.prior.mean)
    chi2 = float(residual @ marginal.remove(residual[:, None])[:, 0]) / len(residual)
    if chi2 <= update.conflict_limit:
        return None
    return SolverErrorExplanation(chi2, update.prior_conflict, float(error.max()),
                     float(np.max(error / update.noise.sd)))
