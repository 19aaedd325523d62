"""The non-linear problem of rotationally symmetric iron, discretized by azimuthal modes.

`halbach_fe.solver.axisymmetric_iron` states the problem. Potentials in the iron are arrays (modes,
iron, c): the complex coefficients of c potentials Re sum_m psi_m exp(i m theta), for the modes that
`Problem.numbers` lists.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import NotConvergedError
from halbach_fe.solver.condensed_newton import factorize
from halbach_fe.solver.iron_grid import IronRectangle
from halbach_fe.solver.iron_modes import Complexes, IronModes

NEWTON_RESIDUAL = 1e-8
"""Newton's method stops at this residual relative to the sources, in the norm of the
preconditioner. The reaction has then converged to some 1e-8."""

MAX_NEWTON_STEPS = 60
MAX_CG_STEPS = 400
SMALLEST_STEP = 2.0**-20
"""Step length, relative to the full Newton step, at which the line search gives up."""


def to_angles(by_mode: Complexes, numbers: Ints, angles: int) -> Floats:
    """Return values (angles, ...) of sums of modes Re c_m exp(i m theta).

    Parameters
    ----------
    by_mode : ndarray, shape (modes, ...)
    numbers : ndarray of int, shape (modes,)
        The modes m, all below half of ``angles``.
    angles : int
    """
    spectrum = np.zeros((angles // 2 + 1, *by_mode.shape[1:]), complex)
    spectrum[numbers] = by_mode * (angles / 2)
    spectrum[0] *= 2
    return np.asarray(scipy.fft.irfft(spectrum, angles, axis=0))


def to_modes(values: Floats, numbers: Ints | slice) -> Complexes:
    """Return coefficients (modes, ...) of values (angles, ...); reverses `to_angles`."""
    spectrum = scipy.fft.rfft(values, axis=0) * (2 / len(values))
    spectrum[0] /= 2
    return np.asarray(spectrum[numbers])


def coupled_modes(present: Sequence[int], highest: int) -> Ints:
    """Return the modes up to ``highest`` that iron makes from those that a source has.

    The permeability depends on |H|^2, whose modes are differences and sums of those of H. All modes
    of H are therefore those present, plus or minus multiples of one number.
    """
    if not present:
        return np.array([0])
    first = present[0]
    step = int(np.gcd.reduce([2 * first, *(abs(m - first) for m in present),
                              *(m + first for m in present)]))
    if step == 0:  # mode 0 alone
        return np.array([0])
    m = np.arange(highest + 1)
    return np.flatnonzero(((m - first) % step == 0) | ((m + first) % step == 0))


@dataclass(frozen=True)
class Problem:
    """The discrete problem.

    Attributes
    ----------
    modes : IronModes
    bodies : tuple of IronRectangle
    numbers : ndarray of int
        The azimuthal modes, ascending.
    stiffnesses : tuple of sparse array, shape (iron, iron)
        By mode: the stiffness of vacuum, condensed to the iron.
    gradients : tuple of sparse array, shape (3 k, iron)
        By mode: the operators to d/dr, m/r and d/dz at the k Gauss points of the iron.
    angles : int
        Angles at which the law is evaluated.
    """

    modes: IronModes
    bodies: tuple[IronRectangle, ...]
    numbers: Ints
    stiffnesses: tuple[sparse.csr_array, ...]
    gradients: tuple[sparse.csr_array, ...]
    angles: int

    def field(self, potential: Complexes, angles: int | None = None) -> Floats:
        """Return grad psi (angles, 3, k, c) in cylindrical components at the Gauss points."""
        columns = potential.shape[2]
        by_mode = np.stack([(operator @ part).reshape(3, -1, columns) for operator, part in zip(
            self.gradients, potential, strict=True)])
        by_mode[:, 1] *= 1j
        return to_angles(by_mode, self.numbers, angles or self.angles)

    def integrate(self, vectors: Floats) -> Complexes:
        """Return the integrals (modes, iron, c) of vectors (angles, 3, k, c) times grad v."""
        by_mode = to_modes(vectors, self.numbers)
        by_mode[:, 1] *= -1j
        by_mode *= self.modes.gauss.weights[:, None]
        return np.stack([operator.T @ part.reshape(-1, part.shape[2]) for operator, part in zip(
            self.gradients, by_mode, strict=True)])

    def stiffness(self, potential: Complexes) -> Complexes:
        """Return S psi (modes, iron, c)."""
        return np.stack([matrix @ part for matrix, part in zip(
            self.stiffnesses, potential, strict=True)])

    def dot(self, a: Complexes, b: Complexes) -> Floats:
        """Return the scalar products (c,) of potentials and residuals (modes, iron, c)."""
        shares = np.where(self.numbers == 0, 1.0, 0.5)  # means of cos^2(m theta)
        return np.asarray(np.einsum("m,mic,mic->c", shares, a.conj(), b).real)

    def law(self, field: Floats) -> tuple[Floats, Floats]:
        """Return mu_r - 1 and 2 d mu_r / d(|g|^2) (angles, k) for grad psi (angles, 3, k)."""
        square = np.einsum("aik,aik->ak", field, field)
        excess, slope = np.empty_like(square), np.zeros_like(square)
        for number, body in enumerate(self.bodies):
            mine: NDArray[np.bool_] = self.modes.body == number
            if isinstance(body.law, float | int):
                excess[:, mine] = body.law - 1
            else:
                curve = body.law.permeability
                excess[:, mine] = curve.coefficient(square[:, mine]) - 1
                slope[:, mine] = 2 * curve.slope(square[:, mine])
        return excess, slope

    def residual(self, total: Complexes, source: Complexes) -> Complexes:
        """Return the residual (modes, iron, 1) of the total potential."""
        field = self.field(total)
        excess, _ = self.law(field[..., 0])
        return self.stiffness(total - source) + self.integrate(excess[:, None, :, None] * field)

    def differential(self, field: Floats) -> Floats:
        """Return d mu_0 M / d mu_0 H (angles, 3, 3, k) for grad psi (angles, 3, k)."""
        excess, slope = self.law(field)
        return np.asarray(excess[:, None, None] * np.eye(3)[:, :, None]
                          + (slope[:, None] * field)[:, :, None] * field[:, None])


@dataclass(frozen=True)
class Tangent:
    """The derivative of the residual at a state, and its preconditioner.

    Attributes
    ----------
    problem : Problem
    differential : ndarray, shape (angles, 3, 3, k)
        d mu_0 M / d mu_0 H.
    factors : tuple of SuperLU
        By mode: the derivative with the mean of ``differential`` over the angle.
    """

    problem: Problem
    differential: Floats
    factors: tuple[sparse_linalg.SuperLU, ...]

    @classmethod
    def of(cls, problem: Problem, differential: Floats) -> Tangent:
        """Return the tangent with a given differential susceptibility."""
        mean = differential.mean(axis=0) * problem.modes.gauss.weights
        # the radial and axial components are in phase; the azimuthal one is not, so that its
        # product with them is left out
        weights = sparse.block_array([[
            sparse.diags_array(mean[i, j]) if (i == 1) == (j == 1) else None
            for j in range(3)] for i in range(3)], format="csr")
        return cls(problem, differential, tuple(
            factorize(matrix + operator.T @ (weights @ operator)) for matrix, operator in zip(
                problem.stiffnesses, problem.gradients, strict=True)))

    def apply(self, step: Complexes) -> Complexes:
        """Return the derivative of the residual along steps (modes, iron, c)."""
        field = self.problem.field(step, len(self.differential))
        change = np.stack([sum(self.differential[:, i, j, :, None] * field[:, j]
                               for j in range(3)) for i in range(3)], axis=1)
        return self.problem.stiffness(step) + self.problem.integrate(change)

    def precondition(self, residual: Complexes) -> Complexes:
        """Return approximate solutions (modes, iron, c)."""
        result = np.empty_like(residual)
        for factor, part, solution in zip(self.factors, residual, result, strict=True):
            for column in range(part.shape[1]):  # SuperLU is slow with many columns at once
                solution[:, column] = (factor.solve(part[:, column].real.copy())
                                       + 1j * factor.solve(part[:, column].imag.copy()))
        return result

    def solve(self, right: Complexes, tolerance: float) -> Complexes:
        """Solve for steps (modes, iron, c) by conjugate gradients.

        ``tolerance`` is relative, in the norm of the preconditioner.

        Raises
        ------
        NotConvergedError
            If the residual does not fall to the tolerance.
        """
        dot = self.problem.dot
        solution, residual = np.zeros_like(right), right.copy()
        direction = better = self.precondition(residual)
        size = first = dot(residual, better)
        for _ in range(MAX_CG_STEPS):
            if (size <= tolerance**2 * first).all():
                return solution
            applied = self.apply(direction)
            curvature = dot(direction, applied)
            length = np.divide(size, curvature, out=np.zeros_like(size), where=curvature > 0)
            solution = solution + length * direction
            residual = residual - length * applied
            better = self.precondition(residual)
            before, size = size, np.maximum(dot(residual, better), 0.0)
            direction = better + np.divide(size, before, out=np.zeros_like(size),
                                           where=before > 0) * direction
        worst = float(np.sqrt(np.max(size / np.maximum(first, 1e-300))))
        raise NotConvergedError(
            f"Conjugate gradients on the iron left a residual of {worst:.1e} after {MAX_CG_STEPS} "
            "steps. Smooth the H(B) curve.", (worst,))


def newton(
    problem: Problem, source: Complexes, start: Complexes | None = None
) -> tuple[Complexes, tuple[float, ...]]:
    """Solve for the total potential (modes, iron, 1) in T m by Newton's method.

    A step is halved until the energy no longer rises steeply at its end; the energy is convex.

    Returns
    -------
    total : ndarray
    residuals : tuple of float
        Relative residual at the start and after every step.

    Raises
    ------
    NotConvergedError
    """
    total = np.zeros_like(source) if start is None else start
    right = problem.stiffness(source)
    residual = problem.residual(total, source)
    norms: list[float] = []
    while True:
        tangent = Tangent.of(problem, problem.differential(problem.field(total)[..., 0]))
        scale, size = (float(problem.dot(vector, tangent.precondition(vector))[0])
                       for vector in (right, residual))
        norms.append(float(np.sqrt(max(size, 0.0) / scale)) if scale > 0 else 0.0)
        if norms[-1] <= NEWTON_RESIDUAL:
            return total, tuple(norms)
        if len(norms) > MAX_NEWTON_STEPS or not np.isfinite(norms[-1]):
            raise NotConvergedError(
                f"Newton's method on the iron left a residual of {norms[-1]:.1e} after "
                f"{len(norms) - 1} steps. Smooth the H(B) curve.", tuple(norms))
        step = tangent.solve(-residual, min(0.1, max(norms[-1], 1e-4)))
        slope = abs(float(problem.dot(residual, step)[0]))
        length = 1.0
        while True:
            trial = problem.residual(total + length * step, source)
            if float(problem.dot(trial, step)[0]) <= 0.5 * slope or length < SMALLEST_STEP:
                break
            length /= 2
        total, residual = total + length * step, trial
