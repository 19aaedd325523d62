"""Non-linear magnetostatics on the iron's unknowns alone: arrays in, readings out.

Outside the iron the problem is linear, and is solved once and for all. With u the potential and d
what the iron's magnetization adds to it, on the unknowns of the iron,

    u = U p + d,      S d + G^T w s(G u) = 0,      q = Q0 p + Q d,

where S is the stiffness of everything as the iron's own unknowns see it (a Schur complement, the
iron being vacuum: it is dense on the iron's surface and sparse inside), G the field at the iron's
Gauss points, w their weights, and s(F) = (c(|F|^2) - c_vacuum) F the iron's law less vacuum's:
minus the magnetization for the vector potential, the polarization for the scalar one. The problem
is the minimum of a convex energy, so Newton's method with a line search always gets there.

A solve starts from the linearization about a reference, keeps the reference's factorized tangent,
and accelerates (D. G. Anderson, J. ACM 12 (1965) 547; H. F. Walker, P. Ni, SIAM J. Numer. Anal. 49
(2011) 1715). Newton's method takes over where that stalls.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import NotConvergedError
from halbach_fe.study.materials import ConstitutiveLaw

MAX_ITERATIONS = 25
"""Of the accelerated iteration; 4 to 6 are usual, more than that is Newton's work."""

MEMORY = 5
"""Steps that the acceleration looks back on."""

MAX_NEWTON_STEPS = 60
NEWTON_RESIDUAL = 1e-11
"""Relative to the sources; rounding leaves some 1e-14."""

MAX_RESIDUAL = 1e-5
"""An accelerated solution is taken only with so small a residual, whatever the readings say."""

SAFE_RATE = 0.1
"""Convergence is not believed to be faster than this by the step: the last two may be luck."""

SMALLEST_STEP = 2.0**-20
COLUMNS_AT_ONCE = 256


@dataclass(frozen=True)
class Statistics:
    """How a solve went: iterations, Newton steps after them, and the relative residuals."""

    iterations: int
    newton_steps: int
    residuals: tuple[float, ...]


@dataclass(frozen=True)
class Condensed:
    """A magnet with non-linear iron, condensed.

    Attributes
    ----------
    law : Law
    gradient : sparse array, shape (d m, unknowns)
        The field at m Gauss points, component after component.
    weights : ndarray, shape (m,)
    stiffness : sparse array, shape (unknowns, unknowns)
        S, the iron being vacuum.
    potential : ndarray, shape (unknowns, parameters)
        U.
    linear : ndarray, shape (readings, parameters)
        Q0, the readings without the iron.
    surface : ndarray, shape (s,)
        The unknowns that readings depend on.
    readings : ndarray, shape (readings, s)
        Q there.
    reference : ndarray, shape (parameters,)
        Magnetization in A/m about which the model is linearized, usually the nominal one.
    """

    law: ConstitutiveLaw
    gradient: sparse.csr_array
    weights: Floats
    stiffness: sparse.csr_array
    potential: Floats
    linear: Floats
    surface: Ints
    readings: Floats
    reference: Floats
    _state: _Reference = field(init=False, repr=False)

    def __post_init__(self) -> None:
        added, _ = self._newton(self.potential @ self.reference, np.zeros(len(self.potential)))
        tangent = self._factorize(self.potential @ self.reference + added)
        object.__setattr__(self, "_state", _Reference(
            added, tangent, self._added_slope(self.reference, added, tangent)))

    def __reduce__(self) -> tuple[type[Condensed], tuple[object, ...]]:
        """Travels without the factorization, which is made again where it arrives."""
        return Condensed, tuple(getattr(self, one.name) for one in fields(self) if one.init)

    def solve(
        self, parameters: Floats, tolerance_T: float = 1e-9, newton: bool = False
    ) -> tuple[Floats, Statistics]:
        """Readings (readings,) in T of magnetizations (parameters,) in A/m.

        Parameters
        ----------
        tolerance_T : float
            How far the readings may be from convergence.
        newton : bool
            Start from zero by Newton's method, and use nothing else.

        Raises
        ------
        NotConvergedError
        """
        own = self.potential @ parameters
        if newton:
            added, residuals = self._newton(own, np.zeros_like(own))
            return self._read(parameters, added), Statistics(0, len(residuals) - 1, residuals)
        step = parameters - self.reference
        start = self._state.added + self._state.slope @ step
        added, iterations, residuals, converged = self._accelerate(own, start, tolerance_T)
        if converged:
            return self._read(parameters, added), Statistics(iterations, 0, residuals)
        added, more = self._newton(own, added)
        return self._read(parameters, added), Statistics(
            iterations, len(more) - 1, residuals + more)

    def jacobian(self, parameters: Floats) -> Floats:
        """dq/dp (readings, parameters) in T m/A at magnetizations (parameters,) in A/m."""
        own = self.potential @ parameters
        if np.array_equal(parameters, self.reference):
            slope = self._state.slope
        else:
            added, _ = self._newton(own, self._state.added
                                    + self._state.slope @ (parameters - self.reference))
            slope = self._added_slope(parameters, added, self._factorize(own + added))
        return self.linear + self.readings @ slope[self.surface]

    def iron_field(self, parameters: Floats) -> Floats:
        """Size (m,) in T of what the law starts from at the iron's Gauss points: B by the vector
        potential, mu_0 H by the scalar one.
        """
        own = self.potential @ parameters
        added, _ = self._newton(own, self._state.added)
        return np.sqrt(self._square(self._field(own + added)))

    def _read(self, parameters: Floats, added: Floats) -> Floats:
        return np.asarray(self.linear @ parameters + self.readings @ added[self.surface])

    def _field(self, potential: Floats) -> Floats:
        return np.asarray(self.gradient @ potential).reshape(-1, len(self.weights))

    @staticmethod
    def _square(field_: Floats) -> Floats:
        return np.einsum("dm,dm->m", field_, field_)

    def _source(self, potential: Floats) -> Floats:
        """G^T w s(G u)."""
        found = self._field(potential)
        coefficient = self.law.coefficient(self._square(found)) - self.law.limit
        return np.asarray(self.gradient.T @ (found * (coefficient * self.weights)).ravel())

    def _residual(self, own: Floats, added: Floats) -> Floats:
        return np.asarray(self.stiffness @ added) + self._source(own + added)

    def _weigh(self, potential: Floats) -> sparse.csr_array:
        """w ds/dF at every Gauss point, as a matrix of d x d diagonals."""
        found = self._field(potential)
        square = self._square(found)
        slope = 2 * self.law.slope(square)
        own = self.law.coefficient(square) - self.law.limit
        size = len(found)
        return sparse.csr_array(sparse.block_array([[
            sparse.diags_array(self.weights * (slope * found[i] * found[j] + (i == j) * own))
            for j in range(size)] for i in range(size)]))

    def _factorize(self, potential: Floats) -> sparse_linalg.SuperLU:
        """The tangent S + G^T w ds/dF G, symmetric and positive definite."""
        tangent = self.stiffness + self.gradient.T @ (self._weigh(potential) @ self.gradient)
        return factorize(tangent)

    def _added_slope(
        self, parameters: Floats, added: Floats, tangent: sparse_linalg.SuperLU
    ) -> Floats:
        """dd/dp, (unknowns, parameters)."""
        weigh = self._weigh(self.potential @ parameters + added)
        return -np.asarray(tangent.solve(
            np.asarray(self.gradient.T @ (weigh @ (self.gradient @ self.potential)))))

    def _scale(self, own: Floats) -> float:
        """Size of the sources that residuals are measured by."""
        return max(float(np.linalg.norm(self.stiffness @ own)), 1e-300)

    def _accelerate(
        self, own: Floats, added: Floats, tolerance: float
    ) -> tuple[Floats, int, tuple[float, ...], bool]:
        """Fixed-point iteration with the reference's tangent, accelerated.

        Stops when the readings' next change, bounded from the last two, is below the tolerance.
        """
        scale = self._scale(own)
        points: list[Floats] = []
        steps: list[Floats] = []
        residuals: list[float] = []
        before = np.inf
        for iteration in range(MAX_ITERATIONS):
            residual = self._residual(own, added)
            residuals.append(float(np.linalg.norm(residual)) / scale)
            step = -self._state.tangent.solve(residual)
            change = float(np.abs(self.readings @ step[self.surface]).max())
            if not np.isfinite(change) or (iteration > 3 and residuals[-1] > residuals[0]):
                break
            # what is left after this step is about its size times the rate of convergence
            rate = min(max(change / before, SAFE_RATE), 0.9)
            if residuals[-1] < MAX_RESIDUAL and change * rate / (1 - rate) <= tolerance / 4:
                return added + step, iteration + 1, tuple(residuals), True
            before = change
            points, steps = [*points[-MEMORY:], added], [*steps[-MEMORY:], step]
            added = added + step
            if len(steps) > 1:
                differences = np.diff(steps, axis=0)
                weights = np.linalg.lstsq(differences.T, step, rcond=None)[0]
                added = added - (np.diff(points, axis=0) + differences).T @ weights
        return added, len(residuals), tuple(residuals), False

    def _newton(self, own: Floats, added: Floats) -> tuple[Floats, tuple[float, ...]]:
        """Newton's method, halving steps until the residual falls; the residuals of every step."""
        scale = self._scale(own)
        residual = self._residual(own, added)
        norms = [float(np.linalg.norm(residual)) / scale]
        while not norms[-1] <= NEWTON_RESIDUAL:  # nor is nan
            if len(norms) > MAX_NEWTON_STEPS or not np.isfinite(norms[-1]):
                raise NotConvergedError(
                    f"Newton's method on the iron left a residual of {norms[-1]:.1e} after "
                    f"{len(norms) - 1} steps. Smooth the H(B) curve, or refine the mesh.",
                    tuple(norms))
            step = -self._factorize(own + added).solve(residual)
            length = 1.0
            while True:
                trial = self._residual(own, added + length * step)
                norm = float(np.linalg.norm(trial)) / scale
                if norm < norms[-1] * (1 - 1e-4 * length) or length < SMALLEST_STEP:
                    break
                length /= 2
            if not norm < norms[-1]:
                if norms[-1] < 1e3 * NEWTON_RESIDUAL:  # rounding: there is nothing left to gain
                    break
                raise NotConvergedError(
                    f"Newton's method on the iron stalled at a residual of {norms[-1]:.1e}. Smooth "
                    "the H(B) curve, or refine the mesh.", tuple(norms))
            added, residual = added + length * step, trial
            norms.append(norm)
        return added, tuple(norms)


@dataclass(frozen=True)
class _Reference:
    """The solution at the reference, its factorized tangent, and its slope by the parameters."""

    added: Floats
    tangent: sparse_linalg.SuperLU
    slope: Floats


def factorize(matrix: sparse.sparray) -> sparse_linalg.SuperLU:
    """Factorize a symmetric positive definite matrix, in an order that keeps it sparse."""
    return sparse_linalg.splu(sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A",
                              diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def condense(
    matrix: sparse.csr_array, iron: Ints, outputs: sparse.csr_array
) -> tuple[sparse.csr_array, Ints, Floats]:
    """Eliminate all unknowns but the iron's.

    Parameters
    ----------
    matrix : sparse array, shape (n, n)
        Stiffness, the iron being vacuum.
    iron : ndarray
        Its unknowns.
    outputs : sparse array, shape (k, n)

    Returns
    -------
    stiffness : sparse array, shape (len(iron), len(iron))
        The Schur complement.
    surface : ndarray, shape (s,)
        Which of the iron's unknowns outputs depend on.
    condensed : ndarray, shape (k, s)
        How they do when there are no other sources.
    """
    rest = np.setdiff1d(np.arange(matrix.shape[0]), iron)
    inner = factorize(matrix[rest][:, rest])
    coupling = matrix[rest][:, iron].tocsc()
    own = outputs[:, iron].tocsc()
    touches = (np.diff(coupling.indptr) > 0) | (np.diff(own.indptr) > 0)
    surface = np.flatnonzero(touches)
    schur = np.empty((len(surface), len(surface)))
    condensed = np.empty((outputs.shape[0], len(surface)))
    coupling, seen = coupling[:, surface], outputs[:, rest]
    for first in range(0, len(surface), COLUMNS_AT_ONCE):
        part = slice(first, first + COLUMNS_AT_ONCE)
        solved = inner.solve(coupling[:, part].toarray())
        schur[:, part] = coupling.T @ solved
        condensed[:, part] = own[:, surface[part]].toarray() - seen @ solved
    schur = (schur + schur.T) / 2
    rows, columns = np.repeat(surface, len(surface)), np.tile(surface, len(surface))
    dense = sparse.csr_array((schur.ravel(), (rows, columns)), shape=(len(iron), len(iron)))
    return sparse.csr_array(matrix[iron][:, iron] - dense), surface, condensed
