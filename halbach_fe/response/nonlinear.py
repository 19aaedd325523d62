"""The non-linear model of a magnet with saturating iron, from magnetizations to readings.

Markov chains evaluate this model tens of thousands of times. GetDP therefore assembles the problem
only once, with vacuum in place of the iron, and solves it for every block. The non-linear problem
is then condensed to the unknowns in the iron (`halbach_fe.solver.condensed_newton`). The readings
of the condensed model are always compared with GetDP's own Newton method, for a sample of
magnetizations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import GetDPError, StudyError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.observation import Observation
from halbach_fe.response.discretization_error import reading_errors
from halbach_fe.response.matrix import Response, response_matrix
from halbach_fe.solver.condensed_newton import Condensed, condense
from halbach_fe.solver.dofs import check_difference
from halbach_fe.solver.exact_block_field import external_field, unit_fields
from halbach_fe.solver.formulation_choice import (
    Route,
    check_points,
    choose_route,
    finite_element_part,
    vacuum_part,
)
from halbach_fe.solver.interpolation import locate, quadrature
from halbach_fe.solver.magnetostatics import assemble, solve_samples
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian, nominal_prior
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import iron_of

AGREEMENT_T = 1e-8
"""Largest accepted difference in T between readings of the model and of GetDP's Newton method.

GetDP's relative residual of 1e-10 is about 1e-10 T, and the condensed solve converges to 1e-9 T. A
wrong sign or Gauss point makes a difference of 1e-4 T."""


@dataclass(frozen=True)
class NonlinearModel:
    """The map from magnetizations p in A/m to readings in T; call an instance to evaluate it.

    Attributes
    ----------
    condensed : Condensed
        The problem condensed to the unknowns in the iron.
    offset : ndarray, shape (readings,), in T
        Readings of external fields.
    parameters : tuple of str
        Names of the parameters, as in `halbach_fe.response.matrix.Response`.
    nominal : ndarray, shape (parameters,), in A/m
        The study's nominal magnetization.
    error : ndarray, shape (readings,), in T
        Error bar of the finite elements, for the nominal array.
    agreement_T : float
        Largest difference from GetDP's Newton method in any reading of the verified samples.
    """

    condensed: Condensed
    offset: Floats
    parameters: tuple[str, ...]
    nominal: Floats
    error: Floats
    agreement_T: float

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
    magnet : Magnet
    observation : Observation
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
    settings = magnet.study.prior
    prior = prior or nominal_prior(linear.nominal, magnet.dimension, settings.magnitude_sd,
                                   settings.direction_sd_deg, settings.common_mode_sd)
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
    """Return the readings of magnetizations by GetDP's own Newton method.

    Parameters
    ----------
    magnet : Magnet
    observation : Observation
    session : Session
    magnetizations : ndarray, shape (k, parameters), in A/m
    cold : bool
        Start Newton's method from zero for every sample, instead of from the sample before.

    Returns
    -------
    ndarray, shape (k, readings), in T
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

    Raises
    ------
    GetDPError
        If the two matrices differ.
    """
    size = gradient.shape[0] // len(weights)
    ours = vacuum * (gradient.T @ (sparse.diags_array(np.tile(weights, size)) @ gradient))
    inside = np.setdiff1d(np.arange(ours.shape[0]), surface)
    if not len(inside):
        return  # a single layer of elements has no inner unknowns; `compare_with_newton` must do
    check_difference(abs(ours - theirs).tocsr()[inside].max() / abs(theirs).max())
