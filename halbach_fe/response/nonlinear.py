"""The non-linear model of a magnet with saturating iron, from magnetizations to readings.

Markov chains evaluate this model tens of thousands of times. GetDP therefore assembles the problem
only once, with vacuum in place of the iron, and solves it for every block. The non-linear problem
is then condensed to the unknowns in the iron. The readings of the condensed model are always
compared with GetDP's own Newton method, for a sample of magnetizations.

Only the iron is non-linear. All other unknowns are eliminated once, so that a solve for other
magnetizations p (the parameters) works on the unknowns of the iron alone and returns readings q:

    u = U p + d,      S d + G^T w s(G u) = 0,      q = Q0 p + Q d.

u is the potential (vector potential a, or scalar potential psi = mu_0 phi) on the iron's unknowns,
U p its value without the iron, and d the contribution of the iron's magnetization. S is the
stiffness with the iron replaced by vacuum, condensed onto the iron's unknowns: a Schur complement,
which is dense on the iron's surface and sparse inside. G maps the unknowns to the field F in T at
the iron's Gauss points, curl a = B or -grad psi = mu_0 H; w are the weights of these points.
s(F) = (c(|F|^2) - c_vacuum) F is the iron's law minus the law of vacuum. For the vector potential c
is the reluctivity, and s is minus the magnetization; for the scalar potential c is the relative
permeability, and s is the polarization. The solution minimizes a convex energy, so that Newton's
method with a line search converges from every start.

A solve starts from the linearization about a reference magnetization. It iterates with the
factorized tangent of the reference and Anderson acceleration (D. G. Anderson, J. ACM 12 (1965) 547;
H. F. Walker, P. Ni, SIAM J. Numer. Anal. 49 (2011) 1715). If this iteration does not converge,
Newton's method takes over.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg

from halbach_fe.core.arrays import Floats, Ints, slices
from halbach_fe.core.errors import GetDPError, NotConvergedError, StudyError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation_operator import Observation
from halbach_fe.response.block_variation import prior_of_blocks
from halbach_fe.response.discretization_error import reading_errors
from halbach_fe.response.response_matrix import Response, response_matrix
from halbach_fe.solver.exact_block_field import external_field, unit_fields
from halbach_fe.solver.getdp_files import check_difference, factorize
from halbach_fe.solver.interpolation import locate, quadrature
from halbach_fe.solver.magnetostatics import assemble, solve_samples
from halbach_fe.solver.routes import (
    Route,
    check_points,
    choose_route,
    finite_element_part,
    vacuum_part,
)
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.materials import MU_0, ConstitutiveLaw
from halbach_fe.study.model import iron_of

AGREEMENT_T = 1e-8
"""Largest accepted difference in T between readings of the model and of GetDP's Newton method.

GetDP's relative residual of 1e-10 is about 1e-10 T, and the condensed solve converges to 1e-9 T. A
wrong sign or Gauss point makes a difference of 1e-4 T."""


@dataclass(frozen=True)
class NonlinearModel:
    """The map from magnetizations p in A/m to readings in T; call an instance to evaluate it."""

    condensed: Condensed
    """The problem condensed to the unknowns in the iron."""
    offset: Floats
    """Readings of external fields. Shape (readings,), in T."""
    parameters: tuple[str, ...]
    """Names of the parameters, as in `halbach_fe.response.response_matrix.Response`."""
    nominal: Floats
    """The study's nominal magnetization. Shape (parameters,), in A/m."""
    error: Floats
    """Error bar of the finite elements, for the nominal array. Shape (readings,), in T."""
    agreement_T: float
    """Largest difference from GetDP's Newton method in any reading of the verified samples."""

    def __call__(self, magnetizations: Floats, tolerance_T: float = 1e-9) -> Floats:
        """Return the readings (..., readings) in T of magnetizations (..., parameters) in A/m.

        Newton's method stops when the readings have converged to ``tolerance_T``; a tenth of the
        noise is accurate enough for an inference.
        """
        flat = magnetizations.reshape(-1, len(self.parameters))
        readings = [self.condensed.solve(row, tolerance_T)[0] for row in flat]
        return self.offset + np.array(readings).reshape(*magnetizations.shape[:-1], -1)

    def jacobian(self, magnetization: Floats) -> Floats:
        """Return dq/dp (readings, parameters) in T m/A at a magnetization (parameters,) in A/m."""
        return self.condensed.jacobian(magnetization)


def nonlinear_model(
    magnet: Magnet, observation: Observation, session: Session, generator: np.random.Generator,
    prior: Gaussian | None = None,
) -> NonlinearModel:
    """Build the model of a study whose iron ring has an H(B) curve, and verify it.

    Parameters
    ----------
    session : Session
        Its folder receives the runs of GetDP.
    generator : numpy.random.Generator
        Draws the magnetizations at which the model is compared with GetDP's own Newton method.
    prior : Gaussian, optional
        Distribution of these magnetizations in A/m; by default the study's prior.

    Raises
    ------
    StudyError
        If the iron has no H(B) curve, or a point is not in air.
    GetDPError
        If the model does not agree with GetDP.
    """
    if magnet.curve is None:
        raise StudyError(f"Input `curve` of the iron of study {magnet.name} must be given for a "
                         "non-linear model; instead it is missing. Use the response matrix.")
    if not magnet.iron_is_along_z:
        raise StudyError(must_be(
            "`iron.bodies`", f"study {magnet.name}", "prisms along z and coaxial tubes, of one "
            "material, for samples with non-linear iron", "a body of another shape, place or "
            "material", "Linearize it about the nominal magnet: infer without --samples."))
    observation = replace(observation, points=check_points(magnet, observation.points))
    route = choose_route(magnet, observation.points).meshed
    base = _replace_iron_by_vacuum(magnet, route)
    linear = response_matrix(base, observation, replace(session, folder=session.folder / "linear"))
    condensed = condense_to_iron(magnet, observation, session, linear)
    error = _error(magnet, observation, session)
    model = NonlinearModel(condensed, linear.offset, magnet.parameter_names, linear.nominal, error,
                           np.nan)
    prior = prior or prior_of_blocks(magnet)
    # number of magnetizations for which the model is compared with GetDP's Newton method
    verified_samples = 3
    samples = prior.sample(verified_samples, generator)
    agreement = compare_with_newton(model, magnet, observation, session, samples)
    model = replace(model, agreement_T=agreement)
    if choose_route(magnet, observation.points) is Route.MOMENTS:
        return _correct_nominal(model, magnet, observation, session)
    return model


def _correct_nominal(
    model: NonlinearModel, magnet: Magnet, observation: Observation, session: Session
) -> NonlinearModel:
    """Return the model with the nominal readings of the route ``moments``.

    That route resolves thin iron, which the extruded mesh of the model does not: the mesh then errs
    by up to a third of the iron's reaction. The model keeps the mesh for deviations from the
    nominal magnet, of a few per cent.
    """
    parts = finite_element_part(magnet, observation.points, session.within("nominal-resolved"),
                                columns=False)
    readings = observation.apply(vacuum_part(magnet, observation.points) + parts.nominal)
    correction = readings - model(model.nominal)
    error = reading_errors(magnet, observation, parts, session)
    # size of deviations from the nominal magnetization, for which the error of the mesh remains
    deviation = 0.02
    return replace(model, offset=model.offset + correction,
                   error=error + deviation * np.abs(correction))


def condense_to_iron(
    magnet: Magnet, observation: Observation, session: Session, linear: Response
) -> Condensed:
    """Condense the non-linear problem of a magnet to the unknowns in its iron.

    ``linear`` is the response of the same magnet with vacuum in place of the iron.
    """
    curve = magnet.curve
    assert curve is not None  # the caller has checked it
    route = choose_route(magnet, observation.points).meshed
    formulation = route.formulation(magnet)
    assembly = assemble(_replace_iron_by_vacuum(magnet, route), session, formulation)
    mesh, unknowns, size = assembly.mesh, assembly.unknowns, magnet.dimension
    gauss, weights = quadrature(mesh, np.flatnonzero(mesh.in_iron))
    gradient = sparse.csr_array(
        sparse.vstack(formulation.flux_density(mesh, gauss, unknowns)[:size]))
    iron = np.unique(gradient.indices)
    gradient = gradient[:, iron]
    points = observation.points if size == 3 else observation.points * [1, 1, 0]
    fields = formulation.flux_density(mesh, locate(mesh, points), unknowns)
    outputs = sparse.csr_array(sum(
        observation.operator[:, axis::3] @ operator for axis, operator in enumerate(fields)))
    stiffness, surface, readings = condense(assembly.matrix, iron, outputs)
    law = getattr(curve, formulation.law)
    _check_iron(assembly.matrix[iron][:, iron], gradient, weights, law.limit, surface)
    potential = np.hstack([
        assembly.solutions[1 + size * number:1 + size * (number + 1), iron].T
        @ (MU_0 * block.recoil_tensor[:size, :size])
        for number, block in enumerate(magnet.blocks)])
    return Condensed(law, gradient, weights, stiffness, potential, linear.whole, surface,
                     readings, linear.nominal)


def newton_readings(
    magnet: Magnet, observation: Observation, session: Session, magnetizations: Floats,
    cold: bool = False,
) -> Floats:
    """Return the readings (k, readings) in T of magnetizations by GetDP's own Newton method.

    Parameters
    ----------
    magnetizations : ndarray, shape (k, parameters), in A/m
    cold : bool
        Start Newton's method from zero for every sample, instead of from the sample before.
    """
    size = magnet.dimension
    samples = np.zeros((len(magnetizations), len(magnet.blocks), 3))
    samples[..., :size] = magnetizations.reshape(len(magnetizations), -1, size)
    route = choose_route(magnet, observation.points).meshed
    fields = solve_samples(magnet, observation.points, samples, session,
                           route.formulation(magnet), cold=cold)
    if magnet.study.solver.method == "reaction":
        remanence = [samples[:, number] @ (MU_0 * block.recoil_tensor)
                     for number, block in enumerate(magnet.blocks)]
        units = unit_fields(magnet.blocks, observation.points)
        for unit, vectors in zip(units, remanence, strict=True):
            fields = fields + np.einsum("nck,sk->snc", unit, vectors)
    return observation.apply(fields + external_field(magnet, observation.points))


def compare_with_newton(
    model: NonlinearModel, magnet: Magnet, observation: Observation, session: Session,
    magnetizations: Floats, cold: bool = False,
) -> float:
    """Return the largest difference in T of any reading from that of GetDP's Newton method.

    Raises
    ------
    GetDPError
        If the difference is larger than AGREEMENT_T.
    """
    folder = replace(session, folder=session.folder / "verified", progress=None)
    theirs = newton_readings(magnet, observation, folder, magnetizations, cold)
    difference = float(np.abs(model(magnetizations) - theirs).max())
    if not difference <= AGREEMENT_T:
        raise GetDPError(
            f"The condensed model of study {magnet.name} is {difference:.1e} T from GetDP's own "
            f"Newton method, where {AGREEMENT_T:.0e} T is allowed. Please report this with the "
            "study.")
    return difference


def _replace_iron_by_vacuum(magnet: Magnet, route: Route) -> Magnet:
    """Return the magnet with vacuum in place of the iron, on the same mesh.

    Symmetry is switched off, so that every block is solved by itself.
    """
    study = magnet.study
    key = "iron_ring" if study.iron_ring is not None else "iron"
    iron = iron_of(study)
    assert iron is not None  # only iron has a curve
    vacuum = iron.with_(curve=None, relative_permeability=1.0)
    solver = {"symmetry": False} | ({} if magnet.dimension == 2 else {"route": route.value})
    return magnet.with_(**{key: vacuum}, solver=study.solver.with_(**solver))


def _error(magnet: Magnet, observation: Observation, session: Session) -> Floats:
    """Return the error bar of the finite elements, (readings,) in T, for the nominal magnet."""
    if magnet.dimension == 3:  # by the mesh of the model, whose error it is
        magnet = magnet.with_(solver__route=choose_route(magnet, observation.points).meshed.value)
    parts = finite_element_part(magnet, observation.points, replace(
        session, folder=session.folder / "nominal"), columns=False)
    return reading_errors(magnet, observation, parts, session)


def _check_iron(
    theirs: sparse.csr_array, gradient: sparse.csr_array, weights: Floats, vacuum: float,
    surface: Ints,
) -> None:
    """Check that GetDP's matrix inside the iron equals that assembled from our Gauss points.

    GetDPError if the two matrices differ.
    """
    size = gradient.shape[0] // len(weights)
    ours = vacuum * (gradient.T @ (sparse.diags_array(np.tile(weights, size)) @ gradient))
    inside = np.setdiff1d(np.arange(ours.shape[0]), surface)
    if not len(inside):
        return  # a single layer of elements has no inner unknowns; `compare_with_newton` must do
    check_difference(abs(ours - theirs).tocsr()[inside].max() / abs(theirs).max())


MAX_NEWTON_STEPS = 60
"""Largest number of Newton steps in one solve."""


@dataclass(frozen=True)
class Statistics:
    """Convergence of a solve."""

    iterations: int
    """Accelerated iterations."""
    newton_steps: int
    """Newton steps after them, 0 if the accelerated iteration converged."""
    residuals: tuple[float, ...]
    """Residual of every iterate, relative to the sources."""


@dataclass(frozen=True)
class Condensed:
    """A magnet with non-linear iron, condensed onto the iron's unknowns.

    The letters are those of the equations at the top of this module. The unknowns are nodal values
    of the potential in T m, or circulations along edges in T m^2.
    """

    law: ConstitutiveLaw
    """The iron's law c(|F|^2)."""
    gradient: sparse.csr_array
    """G. The field in T at m Gauss points in d dimensions, component after component.
    Shape (d m, unknowns)."""
    weights: Floats
    """w. Shape (m,), in m^d."""
    stiffness: sparse.csr_array
    """S, with the iron replaced by vacuum. Shape (unknowns, unknowns)."""
    potential: Floats
    """U, the potential without the iron per A/m. Shape (unknowns, parameters)."""
    linear: Floats
    """Q0, the readings without the iron. Shape (readings, parameters), in T m/A."""
    surface: Ints
    """The unknowns on which the readings depend. Shape (s,)."""
    readings: Floats
    """The columns of Q for ``surface``; all others are zero. Q d is in T. Shape (readings, s)."""
    reference: Floats
    """Magnetization about which the model is linearized, usually the nominal one.
    Shape (parameters,), in A/m."""
    _state: _Reference = field(init=False, repr=False)

    def __post_init__(self) -> None:
        added, _ = self._newton(self.potential @ self.reference, np.zeros(len(self.potential)))
        tangent = self._factorize(self.potential @ self.reference + added)
        object.__setattr__(self, "_state", _Reference(
            added, tangent, self._added_slope(self.reference, added, tangent)))

    def __reduce__(self) -> tuple[type[Condensed], tuple[object, ...]]:
        """Support pickling: a factorization cannot be pickled, so unpickling computes it again."""
        return Condensed, tuple(getattr(self, item.name) for item in fields(self) if item.init)

    def solve(
        self, parameters: Floats, tolerance_T: float = 1e-9, newton: bool = False
    ) -> tuple[Floats, Statistics]:
        """Solve the non-linear problem for the readings.

        Parameters
        ----------
        parameters : ndarray, shape (parameters,), in A/m
            Magnetizations.
        tolerance_T : float
            Largest error in T of any reading that incomplete convergence may leave.
        newton : bool
            Use Newton's method alone, started from d = 0.

        Returns
        -------
        readings : ndarray, shape (readings,), in T
        statistics : Statistics

        Raises
        ------
        NotConvergedError
            If Newton's method does not converge either.
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
        """Return dq/dp (readings, parameters) in T m/A at magnetizations (parameters,) in A/m."""
        own = self.potential @ parameters
        if np.array_equal(parameters, self.reference):
            slope = self._state.slope
        else:
            added, _ = self._newton(own, self._state.added
                                    + self._state.slope @ (parameters - self.reference))
            slope = self._added_slope(parameters, added, self._factorize(own + added))
        return self.linear + self.readings @ slope[self.surface]

    def iron_field(self, parameters: Floats) -> Floats:
        """Return |F| (m,) in T at the iron's Gauss points, the argument of its law.

        That is |B| for the vector potential and mu_0 |H| for the scalar potential.
        """
        own = self.potential @ parameters
        added, _ = self._newton(own, self._state.added)
        return np.sqrt(self._square(self._field(own + added)))

    def _read(self, parameters: Floats, added: Floats) -> Floats:
        """Return q = Q0 p + Q d, (readings,) in T."""
        return np.asarray(self.linear @ parameters + self.readings @ added[self.surface])

    def _field(self, potential: Floats) -> Floats:
        """Return F = G u at the Gauss points, (d, m) in T."""
        return np.asarray(self.gradient @ potential).reshape(-1, len(self.weights))

    @staticmethod
    def _square(field_: Floats) -> Floats:
        """Return |F|^2 (m,) in T^2 of fields (d, m) in T."""
        return np.einsum("dm,dm->m", field_, field_)

    def _source(self, potential: Floats) -> Floats:
        """Return G^T w s(G u), the share of the iron's magnetization in the residual."""
        field_ = self._field(potential)
        coefficient = self.law.coefficient(self._square(field_)) - self.law.limit
        return np.asarray(self.gradient.T @ (field_ * (coefficient * self.weights)).ravel())

    def _residual(self, own: Floats, added: Floats) -> Floats:
        """Return S d + G^T w s(G (U p + d)) with U p as ``own`` and d as ``added``."""
        return np.asarray(self.stiffness @ added) + self._source(own + added)

    def _weigh(self, potential: Floats) -> sparse.csr_array:
        """Return w ds/dF at every Gauss point, as a d x d block matrix of diagonal blocks.

        With s = (c(|F|^2) - c_vacuum) F, ds/dF is 2 c' F F^T + (c - c_vacuum) 1.
        """
        field_ = self._field(potential)
        square = self._square(field_)
        slope = 2 * self.law.slope(square)
        excess = self.law.coefficient(square) - self.law.limit
        size, count = field_.shape
        # row i m + k has the columns k, m + k, ... in this order: the arrays of a csr_array
        values = (self.weights * slope * field_)[:, :, np.newaxis] * field_.T
        values[np.arange(size), :, np.arange(size)] += self.weights * excess
        columns = np.arange(size * count, dtype=np.int32).reshape(size, count).T
        starts = size * np.arange(size * count + 1, dtype=np.int32)
        return sparse.csr_array((values.ravel(), np.tile(columns.ravel(), size), starts),
                                shape=(size * count, size * count))

    def _factorize(self, potential: Floats) -> sparse_linalg.SuperLU:
        """Factorize the tangent S + G^T w ds/dF G, which is symmetric and positive definite."""
        tangent = self.stiffness + self.gradient.T @ (self._weigh(potential) @ self.gradient)
        return factorize(tangent)

    def _added_slope(
        self, parameters: Floats, added: Floats, tangent: sparse_linalg.SuperLU
    ) -> Floats:
        """Return dd/dp (unknowns, parameters) at a solution, from the factorized tangent there."""
        weigh = self._weigh(self.potential @ parameters + added)
        return -np.asarray(tangent.solve(
            np.asarray(self.gradient.T @ (weigh @ (self.gradient @ self.potential)))))

    def _scale(self, own: Floats) -> float:
        """Return the norm of S U p, the sources to which residuals are relative."""
        return max(float(np.linalg.norm(self.stiffness @ own)), 1e-300)

    def _accelerate(
        self, own: Floats, added: Floats, tolerance: float
    ) -> tuple[Floats, int, tuple[float, ...], bool]:
        """Iterate with the factorized tangent of the reference and Anderson acceleration.

        The iteration has converged when the estimated remaining change of every reading, by
        geometric extrapolation of the last two changes, is below the tolerance.

        Returns
        -------
        added : ndarray, shape (unknowns,)
            d; if the iteration has not converged, Newton's method starts from this value.
        iterations : int
        residuals : tuple of float
        converged : bool
        """
        scale = self._scale(own)
        points: list[Floats] = []
        steps: list[Floats] = []
        residuals: list[float] = []
        before = np.inf
        # largest number of accelerated iterations. 4 to 6 are usual; where more are needed,
        # Newton's method takes over.
        max_iterations = 25
        memory = 5  # number of previous steps that the Anderson acceleration combines
        # largest relative residual of an accepted accelerated solution. Readings that hardly change
        # do not prove convergence by themselves: they see only a part of the iron's unknowns.
        max_residual = 1e-5
        # smallest factor per step by which the error is assumed to fall. A smaller ratio of the
        # last two changes may be a coincidence.
        safe_rate = 0.1
        for iteration in range(max_iterations):
            residual = self._residual(own, added)
            residuals.append(float(np.linalg.norm(residual)) / scale)
            step = -self._state.tangent.solve(residual)
            change = float(np.abs(self.readings @ step[self.surface]).max())
            if not np.isfinite(change) or (iteration > 3 and residuals[-1] > residuals[0]):
                break
            # the changes fall by about this factor per step: change * rate / (1 - rate) remains
            rate = min(max(change / before, safe_rate), 0.9)
            if residuals[-1] < max_residual and change * rate / (1 - rate) <= tolerance / 4:
                return added + step, iteration + 1, tuple(residuals), True
            before = change
            points, steps = [*points[-memory:], added], [*steps[-memory:], step]
            added = added + step
            if len(steps) > 1:
                differences = np.diff(steps, axis=0)
                weights = np.linalg.lstsq(differences.T, step, rcond=None)[0]
                added = added - (np.diff(points, axis=0) + differences).T @ weights
        return added, len(residuals), tuple(residuals), False

    def _newton(self, own: Floats, added: Floats) -> tuple[Floats, tuple[float, ...]]:
        """Solve by Newton's method, with every step halved until the residual falls.

        Returns
        -------
        added : ndarray, shape (unknowns,)
            d.
        residuals : tuple of float
            Relative residual at the start and after every step.
        """
        scale = self._scale(own)
        residual = self._residual(own, added)
        norms = [float(np.linalg.norm(residual)) / scale]
        # Newton's method stops at this residual relative to the sources. Rounding leaves about
        # 1e-14.
        tolerance = 1e-11
        # step length, relative to the full Newton step, at which the line search gives up
        smallest_step = 2.0**-20
        while not norms[-1] <= tolerance:  # written so that nan does not end the loop
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
                if norm < norms[-1] * (1 - 1e-4 * length) or length < smallest_step:
                    break
                length /= 2
            if not norm < norms[-1]:
                if norms[-1] < 1e3 * tolerance:  # rounding errors stop the progress
                    break
                raise NotConvergedError(
                    f"Newton's method on the iron stalled at a residual of {norms[-1]:.1e}. Smooth "
                    "the H(B) curve, or refine the mesh.", tuple(norms))
            added, residual = added + length * step, trial
            norms.append(norm)
        return added, tuple(norms)


@dataclass(frozen=True)
class _Reference:
    """The solution at the reference magnetization."""

    added: Floats
    """d, the contribution of the iron. Shape (unknowns,)."""
    tangent: sparse_linalg.SuperLU
    """The factorized tangent."""
    slope: Floats
    """dd/dp. Shape (unknowns, parameters)."""


def condense(
    matrix: sparse.csr_array, iron: Ints, outputs: sparse.csr_array
) -> tuple[sparse.csr_array, Ints, Floats]:
    """Eliminate all unknowns except those of the iron.

    Parameters
    ----------
    matrix : sparse array, shape (n, n)
        Stiffness with the iron replaced by vacuum.
    iron : ndarray
        The unknowns of the iron.
    outputs : sparse array, shape (k, n)
        Readings per unknown.

    Returns
    -------
    stiffness : sparse array, shape (len(iron), len(iron))
        The Schur complement onto the iron's unknowns.
    surface : ndarray, shape (s,)
        Indices into ``iron`` of the unknowns on which the readings depend: those that share an
        element with the eliminated unknowns, or that the readings use directly.
    condensed : ndarray, shape (k, s)
        Readings per unknown of ``surface``, without sources outside the iron.
    """
    rest = np.setdiff1d(np.arange(matrix.shape[0]), iron)
    inner = factorize(matrix[rest][:, rest])
    coupling = matrix[rest][:, iron].tocsc()
    own = outputs[:, iron].tocsc()
    touches = (np.diff(coupling.indptr) > 0) | (np.diff(own.indptr) > 0)
    surface = np.flatnonzero(touches)
    schur = np.empty((len(surface), len(surface)))
    condensed = np.empty((outputs.shape[0], len(surface)))
    coupling, other_outputs = coupling[:, surface], outputs[:, rest]
    step = 256  # number of columns that `condense` solves for at a time, which limits its memory
    for part in slices(len(surface), step):
        solved = inner.solve(coupling[:, part].toarray())
        schur[:, part] = coupling.T @ solved
        condensed[:, part] = own[:, surface[part]].toarray() - other_outputs @ solved
    schur = (schur + schur.T) / 2
    rows, columns = np.repeat(surface, len(surface)), np.tile(surface, len(surface))
    dense = sparse.csr_array((schur.ravel(), (rows, columns)), shape=(len(iron), len(iron)))
    return sparse.csr_array(matrix[iron][:, iron] - dense), surface, condensed
