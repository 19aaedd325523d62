"""Iron that saturates: the derivative, other people's solvers, conservation, convergence, and the
condensed engine beside GetDP's own Newton method.

The nominal Halbach dipole hardly magnetizes its ring (0.4 T). Where iron has to saturate all blocks
are magnetized alike, which leaves the bore without a field of its own and drives a ring of 10 mm
to 2.1 T.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from itertools import pairwise

import ngsolve
import numpy as np
import pytest

from halbach_fe.core.errors import EXIT_CODES, GetDPError, NotConvergedError
from halbach_fe.core.files import make_folder
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import Observation, observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.response import nonlinear as engine
from halbach_fe.response.discretization_error import reading_errors
from halbach_fe.response.nonlinear import (
    AGREEMENT_T,
    NonlinearModel,
    compare_with_newton,
    nonlinear_model,
)
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver.magnetostatics import (
    CROSS_SECTION,
    nominal_samples,
    solve_samples,
    solve_tangent,
)
from halbach_fe.solver.mesh import build_mesh, verify_mesh
from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
from halbach_fe.solver.routes import finite_element_part, vacuum_part
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import ConstitutiveLaw
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.ngsolve_reaction import Elements, mesh_of
from halbach_fe.synthetic.true_magnet import law_of
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import DIPOLE, changed, circle
from tests.oracles import dipole_of, ngsolve_model, ngsolve_nonlinear

MU_0 = 4e-7 * np.pi
STEEL = {"kind": "froehlich_kennelly", "initial_relative_permeability": 2000.0,
         "saturation_polarization_T": 2.0}
TABLE = {"kind": "table", "B_T": [0.4, 0.8, 1.2, 1.5, 1.7, 1.85, 1.95, 2.05, 2.2, 2.4],
         "H_A_per_m": [199.0, 530.0, 1190.0, 2370.0, 4420.0, 9070.0, 20300.0, 60500.0, 166700.0,
                       322000.0]}
THIN = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "curve": STEEL}
THICK = {**THIN, "outer_radius_m": 0.25}


def alike(angle_deg: float, blocks: int = 16) -> dict:
    """All blocks magnetized in one direction, 0.4 T."""
    return {"array__remanence_T": 0.4, "array__exceptions": [
        {"slot": slot, "magnetization_angle_deg": angle_deg} for slot in range(1, blocks + 1)]}


SATURATED = alike(20.0) | {"iron_ring": THIN}


def observation_of(study: Study) -> Observation:
    points = points_from(study.observation.positions)
    return observe(study, points, np.ones_like(points, bool) & [True, True, study.dimension == 3])


def history(folder) -> list[list[float]]:
    """Residuals of Newton's method that a run folder keeps, by sample."""
    table = np.loadtxt(folder / "newton.csv", delimiter=",", skiprows=1, ndmin=2)
    return [table[table[:, 0] == sample, 2].tolist() for sample in np.unique(table[:, 0])]


@dataclass(frozen=True)
class Magnet:
    """A study, its model, and where it was made."""

    study: Study
    observation: Observation
    model: NonlinearModel
    session: Session


@pytest.fixture(scope="module")
def saturated(getdp, tmp_path_factory) -> Magnet:
    """A saturating cross-section and its condensed model."""
    study = parse_study(changed(DIPOLE, **SATURATED))
    session = Session(getdp, tmp_path_factory.mktemp("saturated"), jobs=2)
    observation = observation_of(study)
    return Magnet(study, observation, nonlinear_model(
        build_magnet(study), observation, session, np.random.default_rng(1)), session)


def test_the_fixture_saturates(saturated):
    """2.07 T, that is J_s and 0.07 T, where nothing but mu_0 is left of the permeability; at the
    nominal dipole's directions the same ring has 0.4 T.
    """
    flux = saturated.model.condensed.iron_field(saturated.model.nominal)
    assert 2.03 < flux.max() < 2.15
    assert flux.min() < 0.2  # and some of it does not


# The derivative

RATIOS = (1.0, 1e-2, 1e-3)
"""Steps in units of 1 % of M. The truncation error falls with the square of the step, down to what
the residual of 1e-13 leaves, divided by the step. Measured of GetDP 3e-4, 3e-8, 2e-9 (and 1e-8 at
1e-4), of the condensed engine 5e-5, 5e-9, 1e-10."""


def central(evaluate, nominal, change):
    """Central differences along a change for every ratio."""
    samples = np.concatenate([nominal + sign * ratio * change for ratio in RATIOS
                              for sign in (1, -1)])
    found = evaluate(samples)
    return [(found[2 * i] - found[2 * i + 1]) / (2 * ratio) for i, ratio in enumerate(RATIOS)]


def errors_of(differences, derivative):
    return [np.abs(one - derivative).max() / np.abs(derivative).max() for one in differences]


@pytest.fixture(scope="module")
def change(saturated):
    """1 % of M in random directions, (1, blocks, 3) in A/m."""
    nominal = nominal_samples(build_magnet(saturated.study))
    found = np.zeros_like(nominal)
    found[..., :2] = (0.01 * np.linalg.norm(nominal[0, 0])
                      * np.random.default_rng(3).standard_normal((1, 16, 2)))
    return found


@pytest.fixture(scope="module")
def gateaux(saturated, change):
    """The derivative of the reaction along the change and along the nominal magnetization, by
    GetDP's Gateaux problem, (n, 3) in T.
    """
    blocks = build_magnet(saturated.study).blocks
    field, columns = solve_tangent(build_magnet(saturated.study), saturated.observation.points,
                                   range(len(blocks)), saturated.session, CROSS_SECTION)
    units = columns[1:].reshape(len(blocks), 2, -1, 3)
    mu = saturated.study.array.recoil_permeability
    remanence = MU_0 * mu * change[0, :, :2]
    return np.einsum("bcnk,bc->nk", units, remanence), columns[0], field


def solved(saturated, samples):
    return solve_samples(build_magnet(saturated.study), saturated.observation.points, samples,
                         saturated.session, CROSS_SECTION, tolerance=1e-13)


def test_gateaux_problem_against_central_differences(saturated, change, gateaux):
    """Relative to the derivative of the reaction alone, the harsher measure; see RATIOS."""
    along_change, along_nominal, field = gateaux
    errors = errors_of(central(functools.partial(solved, saturated),
                               nominal_samples(build_magnet(saturated.study)), change),
                       along_change)
    assert min(errors) < 1e-7
    assert errors[1] < 1e-6
    assert errors[1] < errors[0] / 1e3  # of second order: 1e4 but for rounding
    # negative control: the field is no linear function, its own value no derivative of it
    assert errors_of([field], along_nominal)[0] > 1


def test_printed_form_of_the_gateaux_problem_is_refused(saturated, change, gateaux):
    """Negative control: nu(|curl A'|) of the derivative itself, as the paper has it, is the full
    problem with the change in place of the magnetization: so small a field sees iron that is not
    saturated. Measured 1.17 of the derivative, where the test above allows 1e-6.
    """
    printed = solved(saturated, change)
    assert errors_of(printed, gateaux[0])[0] > 0.5


def test_jacobian_of_the_condensed_engine_against_central_differences(saturated, change, gateaux):
    """All of the readings, the exact field included; see RATIOS. And GetDP's response
    matrix is this Jacobian: measured 2e-14 of it; elsewhere the Jacobian is another by 15 %.
    """
    model = saturated.model
    step = change[:, :, :2].reshape(1, -1)

    def cold(samples):
        return np.array([model.condensed.solve(sample, newton=True)[0] for sample in samples])

    for place in (model.nominal, model.nominal + 20 * step[0]):  # the reference, and off it
        derivative = model.jacobian(place) @ step[0]
        errors = errors_of(central(cold, place[None], step), derivative)
        assert min(errors) < 1e-7
        assert errors[1] < 1e-6
        assert errors[1] < errors[0] / 1e3
    built = response_matrix(build_magnet(saturated.study), saturated.observation, saturated.session)
    jacobian = model.jacobian(model.nominal)
    assert np.abs(built.matrix - jacobian).max() < 1e-11 * np.abs(jacobian).max()
    # negative control: the jacobian elsewhere, where other iron is saturated
    elsewhere = model.jacobian(model.nominal + 20 * step[0])
    assert np.abs(elsewhere - jacobian).max() > 1e-2 * np.abs(jacobian).max()


# Closed form and NGSolve

@pytest.mark.parametrize("order", [1, 2], ids=["dipole", "quadrupole"])
def test_highly_permeable_tube_against_shielded_multipoles(dipole, session, order):
    """A tube that does not saturate, of 3e5, is one of infinite permeability to 6e-7 T.

    The error, 6.7e-5 T and 7.5e-5 T, is that of the mesh: the stated bars cover it at nine of ten
    readings, as in linear problems. The cap is twice that. The tube is worth 4.4e-3 T and 1.4e-3 T;
    one that saturates, at 0.2 T, misses it by 3.3e-3 T and 8e-4 T.
    """
    def readings(saturation, bars):
        study = dipole(array__multipole_order=order, iron_ring={**THIN, "curve": {
            "kind": "froehlich_kennelly", "saturation_polarization_T": saturation,
            "initial_relative_permeability": 3e5 if saturation > 1 else 1e4}})
        observation = observation_of(study)
        part = finite_element_part(build_magnet(study), observation.points, session, columns=False)
        bar = reading_errors(build_magnet(study), observation, part, session) if bars else None
        return observation, observation.apply(
            vacuum_part(build_magnet(study), observation.points) + part.nominal), bar

    observation, found, bar = readings(2.4, True)
    truth = np.zeros_like(observation.points)
    truth[:, :2] = layered_bore_field(
        ideal_sectors(order, 16, 1.06, np.pi / 2, np.pi), 0.104, 0.1865, 1.05,
        observation.points[:, :2], (0.19, 0.2, 1e12))
    error = np.abs(found - observation.apply(truth))
    assert np.mean(error <= bar) > 0.8
    assert error.max() < 1.5e-4
    _, saturating, _ = readings(0.2, False)
    wrong = np.abs(saturating - observation.apply(truth))
    assert wrong.max() > 5e-4
    assert np.mean(wrong <= bar) < 0.6


def test_saturating_cross_section_against_ngsolve(saturated):
    """The whole field, 0.064 T in the bore, all of it the iron's. NGSolve's order 5 is 4e-8 T from
    its order 4; measured 1.3e-4 T apart, our bars being up to 2.2e-4 T and covering five of six.
    Iron that saturates 5 % earlier is 2.5e-3 T off, outside of every bar.
    """
    study, points = saturated.study, saturated.observation.points
    ours = saturated.model(saturated.model.nominal)
    magnet = magnet_of(study)
    with ngsolve.TaskManager():
        mesh = mesh_of(magnet, points, Elements(0.02))
        theirs, lower = (saturated.observation.apply(ngsolve_nonlinear.section_field(
            magnet, mesh, order, points)) for order in (5, 4))
        # negative control: iron that saturates 5 % earlier
        law = replace(magnet.iron.law, saturation=1.9)
        weaker = replace(magnet, iron=replace(magnet.iron, law=law))
        other = saturated.observation.apply(
            ngsolve_nonlinear.section_field(weaker, mesh, 4, points))
    bar = saturated.model.error + np.abs(theirs - lower)
    assert np.abs(theirs - lower).max() < 1e-6
    assert np.mean(np.abs(ours - theirs) <= bar) > 0.8
    assert np.abs(ours - theirs).max() < 3e-4
    assert np.mean(np.abs(ours - other) <= bar) < 0.3


def test_saturating_ring_in_3d_against_ngsolve(getdp, tmp_path):
    """One ring of eight blocks of 0.1 m in iron of 15 mm: the reaction, 24 mT at these points.

    NGSolve solves an octant at order 2, from which its order 3 was measured to be 3e-4 T away. Ours
    is a coarse mesh: measured 6e-4 T and, rms, 2.3e-4 T from order 3, within bars of 2.4e-3 T, rms:
    the dual formulation of lowest order is that far off, so that the caps say more. Iron that never
    saturates is 13 mT off.
    """
    study = parse_study(changed(
        DIPOLE, **alike(0.0, 8), dimension=3, array__blocks_per_ring=8, array__ring_length_m=0.1,
        iron_ring={**THIN, "outer_radius_m": 0.205}, solver={"route": "scalar_potential"},
        mesh={"block_size_m": 0.07, "layers_per_ring": 2, "growth": 1.7},
        open_boundary={"radius_m": 1.0, "half_length_m": 1.0}))
    points = np.vstack([circle(0.06, 8, z, 0.2 + z) for z in (0.0, 0.04, 0.09)])
    session = Session(getdp, tmp_path, jobs=2)
    observation = observe(study, points, np.ones_like(points, bool))
    part = finite_element_part(build_magnet(study), points, session, columns=False)
    bar = reading_errors(build_magnet(study), observation, part, session)
    assert 1.6 < observed_order(history(tmp_path / "getdp-real")[0]) < 2.5
    dipole, iron = dipole_of(study), law_of(study.iron_ring)
    with ngsolve.TaskManager():
        mesh = ngsolve_model.eighth(dipole, 0.09)
        theirs, never = (observation.apply(ngsolve_nonlinear.potential_reaction(
            dipole, law, mesh, 2, points, (0.4, 0.0, 0.0)))
            for law in (iron, replace(iron, saturation=200.0)))
    ours = observation.apply(part.nominal)
    bar = bar + 3e-4
    scale = np.abs(theirs).max()
    assert np.mean(np.abs(ours - theirs) <= bar) > 0.9
    assert np.abs(ours - theirs).max() < 0.06 * scale
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.02 * scale
    # negative controls: iron that never saturates, and the wrong sign
    assert np.abs(ours - never).max() > 0.3 * scale
    assert np.abs(ours + theirs).max() > 1.5 * scale


# Conservation

def triangle(reference):
    """Functions (q, 6) of a curved triangle, corners first, and their slopes (q, 6, 2)."""
    u, v = reference.T
    w, zero = 1 - u - v, np.zeros(len(reference))
    values = [w * (2 * w - 1), u * (2 * u - 1), v * (2 * v - 1), 4 * w * u, 4 * u * v, 4 * v * w]
    slopes = [(1 - 4 * w, 1 - 4 * w), (4 * u - 1, zero), (zero, 4 * v - 1),
              (4 * (w - u), -4 * u), (4 * v, 4 * u), (-4 * v, 4 * (w - v))]
    return np.stack(values, 1), np.stack([np.stack(slope, 1) for slope in slopes], 1)


def gauss(count, low=0.0, high=1.0):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (low + high) / 2 + (high - low) / 2 * nodes, (high - low) / 2 * weights


def fields_at(study, points, session):
    """B (n, 2) anywhere."""
    flat = np.zeros((len(points), 3))
    flat[:, :2] = points
    return solve_tangent(build_magnet(study), flat, (), session, CROSS_SECTION,
                         anywhere=True)[0][:, :2]


@pytest.mark.parametrize("ring", [THIN, THICK], ids=["saturated", "thick"])
def test_energy_balance(dipole, session, ring):
    """Without currents the integral of H.B over all space vanishes; H = nu B - M, nu written anew.

    16 Gauss points of our own in each of all elements out to 6 m. Relative to the magnets' share
    what remains is 9e-8 with the thin ring and 6e-10 with the thick one: quadrature in the iron,
    where H rises steeply. With linear iron in place of the curve it is 0.53 and 0.011.
    """
    study = dipole(**alike(20.0) | {"iron_ring": ring, "solver": {"method": "direct"}})
    mesh = verify_mesh(build_mesh(build_magnet(study), make_folder(session.folder)))
    nodes, weights = gauss(4)
    reference = np.array([(a, b * (1 - a)) for a in nodes for b in nodes])
    own = np.array([s * t * (1 - a) for a, s in zip(nodes, weights, strict=True) for t in weights])
    values, slopes = triangle(reference)
    corners = mesh.points[mesh.cells][:, :, :2]
    volume = np.abs(np.linalg.det(np.einsum("qke,ckd->cqde", slopes, corners))) * own
    assert volume.sum() == pytest.approx(np.pi * mesh.radius**2, rel=1e-4)
    places = np.einsum("qk,ckd->cqd", values, corners)
    b = fields_at(study, places.reshape(-1, 2), session).reshape(places.shape)
    middle = places.mean(axis=1)
    radius = np.hypot(*middle.T)
    magnet = (radius > 0.104) & (radius < 0.1865)
    iron = (radius > 0.19) & (radius < ring["outer_radius_m"])
    magnetization = 0.4 / (MU_0 * 1.05) * np.array([np.cos(np.radians(20)), np.sin(np.radians(20))])
    square = np.sum(b**2, axis=2)
    nu = np.where(magnet[:, None], 1 / 1.05, 1.0) * np.ones_like(square)

    def balance(coefficient):
        nu[iron] = coefficient
        h = nu[..., None] / MU_0 * b - np.where(magnet[:, None, None], magnetization, 0.0)
        energy = np.sum(h * b, axis=2) * volume
        return energy.sum() / np.abs(energy[magnet].sum())

    law = law_of(study.iron_ring)
    assert abs(balance(ngsolve_nonlinear.reluctivity(law, square[iron]))) < 1e-6
    assert abs(balance(1 / 2000.0)) > 5e-3


@pytest.mark.parametrize(("ring", "leak", "mean"), [
    (THIN, (0.3, 0.5), (2.0, 2.15)), (THICK, (0.0, 0.01), (0.7, 0.9))], ids=["saturated", "thick"])
def test_flux_conservation(dipole, session, ring, leak, mean):
    """Flux into the ring = flux through its two cross-sections + flux that leaves outside.

    Over the half of the ring that the magnetization points to. Measured 3e-5 and 2e-5 of what
    enters, by 720 points an arc across elements between which B jumps. The thin ring carries 2.07 T
    and lets 41 % out; the thick one carries 0.83 T and lets 0.3 % out.
    """
    study = dipole(**alike(20.0) | {"iron_ring": ring, "solver": {"method": "direct"}})
    inner, outer = ring["inner_radius_m"], ring["outer_radius_m"]
    limits = np.radians([-70.0, 110.0])
    edges = np.linspace(*limits, 241)
    angle, arc = (np.concatenate(part) for part in zip(
        *(gauss(3, a, b) for a, b in pairwise(edges)), strict=True))
    radius, depth = gauss(40, inner, outer)

    lines = [(r, angle, angle, r * arc) for r in (inner, outer)] + [
        (radius, a, a + np.pi / 2, depth) for a in limits]  # place, direction and weight
    points = np.vstack([np.outer(r, [1, 1]) * np.column_stack(np.broadcast_arrays(
        np.cos(a), np.sin(a))) for r, a, _, _ in lines])
    b = np.split(fields_at(study, points, session), np.cumsum([len(w) for *_, w in lines])[:-1])
    entering, leaving, *sides = (
        np.sum(weight * (found[:, 0] * np.cos(direction) + found[:, 1] * np.sin(direction)))
        for found, (_, _, direction, weight) in zip(b, lines, strict=True))
    ring_flux = sides[1] - sides[0]
    assert abs(entering - ring_flux - leaving) < 2e-4 * entering
    assert leak[0] < leaving / entering < leak[1]
    for side in sides:
        assert mean[0] < abs(side) / (outer - inner) < mean[1]
    # negative control: a cross-section that is forgotten
    assert abs(entering - sides[1] - leaving) > 0.2 * entering


# Convergence

def observed_order(residuals):
    """Order of convergence, from the last three residuals above rounding."""
    used = [residual for residual in residuals if residual > 1e-12][-3:]
    return np.log(used[2] / used[1]) / np.log(used[1] / used[0])


def test_newton_converges_quadratically(saturated):
    """The order of the last three residuals above rounding: measured 1.9, and 0.9 where the tangent
    is frozen (below).
    """
    solved(saturated, nominal_samples(build_magnet(saturated.study)))
    residuals = history(saturated.session.folder / "getdp-real")[0]
    assert residuals[0] == pytest.approx(1.0)  # from zero: nothing but the right-hand side
    assert residuals[-1] <= 1e-13
    assert 1.6 < observed_order(residuals) < 2.5


def test_chord_iteration_is_only_linear(saturated, change):
    """Negative control: the condensed problem with the tangent of another magnetization, kept,
    comes down by a constant factor, order 0.9; with its own tangent every time at order 1.8.
    """
    condensed = saturated.model.condensed
    own = condensed.potential @ (condensed.reference + 2 * change[0, :, :2].ravel())

    def residuals_of(frozen, steps):
        added = np.zeros_like(own)
        for _ in range(12):  # into the neighbourhood where Newton's method is quadratic
            step = condensed._factorize(own + added).solve(condensed._residual(own, added))
            if np.abs(step).max() < 0.05 * np.abs(added).max():
                break
            added = added - 0.7 * step
        tangent = condensed._factorize(own + added)
        norms = []
        for _ in range(steps):
            residual = condensed._residual(own, added)
            norms.append(np.linalg.norm(residual) / condensed._scale(own))
            added = added - (tangent if frozen else condensed._factorize(own + added)).solve(
                residual)
        return norms

    assert 0.7 < observed_order(residuals_of(True, 8)) < 1.3
    assert observed_order(residuals_of(False, 5)) > 1.6


def test_a_newton_that_does_not_converge_says_so(saturated, tmp_path, monkeypatch):
    """With too few steps: GetDP's own residuals of every step, in the error and in words, and the
    run folder kept; the exit code is that of GetDP. With enough steps nothing is raised.
    """
    def attempt(steps):
        return solve_samples(
            build_magnet(saturated.study), saturated.observation.points,
            nominal_samples(build_magnet(saturated.study)),
            replace(saturated.session, folder=tmp_path), replace(
                CROSS_SECTION, numbers={"MAX_STEPS": steps}))

    with pytest.raises(NotConvergedError, match="Relative residuals of sample 1") as caught:
        attempt(3)
    assert len(caught.value.residuals) == 4
    assert caught.value.residuals[0] == pytest.approx(1.0)
    assert np.all(np.diff(caught.value.residuals) < 0)
    assert caught.value.residuals[-1] > 1e-3
    assert caught.value.exit_code == 7
    assert "GetDP failed" in EXIT_CODES[7]
    assert (tmp_path / "getdp-real-failed" / "getdp.log").is_file()
    attempt(40)
    condensed = saturated.model.condensed
    monkeypatch.setattr(engine, "MAX_NEWTON_STEPS", 3)
    with pytest.raises(NotConvergedError) as caught:
        condensed.solve(condensed.reference, newton=True)
    assert len(caught.value.residuals) == 4


# The condensed engine

def directions(generator, count):
    """Every block's M alike, 8e5 A/m, in a random direction; (count, 32)."""
    angle = 2 * np.pi * generator.random(count)
    return np.tile(8e5 * np.column_stack([np.cos(angle), np.sin(angle)]), 16)


def test_condensed_engine_against_getdp_at_64_magnetizations(getdp, tmp_path, generator):
    """Every reading within 1e-8 T (measured 1.5e-9 T), none unconverged.

    Of both programs warm and cold starts; some per cent about a saturated nominal, and far off:
    blocks of 8e5 A/m in random directions (up to 3.6 T in the iron), and all of them alike. Both
    solve one discrete problem, so a mesh of 41 elements in the iron will do, and a short table,
    which GetDP goes through at every Gauss point.
    """
    study = parse_study(changed(
        DIPOLE, **alike(20.0), iron_ring={**THIN, "curve": TABLE}, solver={"method": "direct"},
        mesh={"block_size_m": 0.06, "growth": 3.0}))
    session, observation = Session(getdp, tmp_path, jobs=2), observation_of(study)
    model = nonlinear_model(build_magnet(study), observation, session, generator)
    size = np.linalg.norm(model.nominal[:2])
    near = model.nominal + 0.03 * size * generator.standard_normal((32, 32))
    far = np.concatenate([8e5 * generator.standard_normal((12, 32)), directions(generator, 8)])
    cold = np.concatenate([model.nominal + 0.03 * size * generator.standard_normal((4, 32)),
                           8e5 * generator.standard_normal((4, 32)), directions(generator, 4)])
    assert compare_with_newton(model, build_magnet(study), observation, session,
                               np.concatenate([near, far])) <= AGREEMENT_T
    steps = history(session.folder / "verified" / "getdp-real")
    assert len(steps) == 52
    assert all(residuals[-1] <= 1e-10 for residuals in steps)
    assert compare_with_newton(model, build_magnet(study), observation, session, cold,
                               cold=True) <= AGREEMENT_T
    steps = history(session.folder / "verified" / "getdp-real")
    assert [residuals[0] for residuals in steps] == pytest.approx([1.0] * 12)
    for sample in cold:  # Newton's method alone, from zero
        readings, statistics = model.condensed.solve(sample, newton=True)
        assert statistics.iterations == 0
        assert np.abs(readings - model(sample)).max() <= AGREEMENT_T


@pytest.mark.parametrize("part", ["weights", "potential", "law"])
def test_a_wrong_model_is_refused(saturated, part):
    """Negative control: one Gauss weight 1 % off, one block's potential 0.1 % off, a curve 1 % off.

    Measured 3e-6, 5e-6 and 3e-5 T.
    """
    condensed = saturated.model.condensed
    weights, potential, law = condensed.weights.copy(), condensed.potential.copy(), condensed.law
    if part == "weights":
        weights[100] *= 1.01
    elif part == "potential":
        potential[:, 4] *= 1.001
    else:
        law = ConstitutiveLaw(law.squares, 1.01 * law.values, law.limit)
    wrong = replace(saturated.model, condensed=replace(
        condensed, weights=weights, potential=potential, law=law))
    with pytest.raises(GetDPError, match="from GetDP's own Newton"):
        compare_with_newton(wrong, build_magnet(saturated.study), saturated.observation,
                            saturated.session,
               saturated.model.nominal[None])
    assert saturated.model.agreement_T <= AGREEMENT_T  # the right one was not


@pytest.mark.parametrize("newton", [True, False])
def test_what_is_no_number_does_not_converge(saturated, newton):
    model = saturated.model
    with pytest.raises(NotConvergedError):
        model.condensed.solve(np.full(len(model.nominal), np.nan), newton=newton)


def test_condensed_engine_in_3d(getdp, tmp_path, generator):
    """The scalar potential, on a mesh that is coarse but saturates: mu_0 H up to 0.017 T, a B of
    1.9 T. Cold starts at random magnetizations: measured 3e-11 T; one block's potential 0.1 % off
    is 2e-5 T. Central differences in a step of 0.1 % there: 3e-6 of the change.
    """
    study = parse_study(changed(
        DIPOLE, **alike(0.0, 4), dimension=3, array__blocks_per_ring=4, array__ring_length_m=0.1,
        iron_ring={**THIN, "outer_radius_m": 0.21, "curve": TABLE},
        solver={"route": "scalar_potential", "method": "direct"},
        mesh={"block_size_m": 0.08, "layers_per_ring": 1, "growth": 2.0},
        open_boundary={"radius_m": 0.5, "half_length_m": 0.4},
        observation__positions={"kind": "circles", "radius_m": 0.05, "angles": 6}))
    session, observation = Session(getdp, tmp_path, jobs=2), observation_of(study)
    model = nonlinear_model(build_magnet(study), observation, session, generator)
    assert model.condensed.iron_field(model.nominal).max() > 0.01
    samples = 8e5 * generator.standard_normal((2, 12))
    assert compare_with_newton(model, build_magnet(study), observation, session, samples[:1],
                               cold=True) <= AGREEMENT_T
    potential = model.condensed.potential.copy()
    potential[:, 3] *= 1.001
    wrong = replace(model, condensed=replace(model.condensed, potential=potential))
    assert np.abs(wrong(samples) - model(samples)).max() > 100 * AGREEMENT_T
    step = 1e-3 * samples[1]
    ends = [model.condensed.solve(samples[0] + sign * step, newton=True)[0] for sign in (1, -1)]
    derivative = model.jacobian(samples[0]) @ step
    assert np.abs((ends[0] - ends[1]) / 2 - derivative).max() < 3e-5 * np.abs(derivative).max()
    elsewhere = model.jacobian(model.nominal) @ step  # negative control
    assert np.abs(elsewhere - derivative).max() > 1e-3 * np.abs(derivative).max()


# Recoil permeability along and across

def test_recoil_permeability_across_against_ngsolve(dipole, session, generator):
    """Nominal magnetizations solved, 10 % changes of all blocks by the response matrix.

    Measured 1.1e-4 T and 2.0e-4 T of 0.59 T, where bars go up to 1.6e-4 T. An isotropic 1.05 is
    4.4e-3 T off, the two exchanged 0.035 T.
    """
    study = dipole(array__recoil_permeability_across=1.15)
    observation = observation_of(study)
    built = response_matrix(build_magnet(study), observation, session)
    assert built.superposition_error < 1e-9
    magnet = magnet_of(study)
    changed_by = 0.1 * np.linalg.norm(built.nominal[:2]) * generator.standard_normal((16, 2))
    nominal = built.nominal.reshape(-1, 2)

    def with_permeability(along, across):
        """With the same M."""
        return replace(magnet, bodies=tuple(
            replace(body, along=along, across=across)
            for body in magnet.bodies)).with_magnetizations(nominal)

    with ngsolve.TaskManager():
        mesh = mesh_of(magnet, observation.points, Elements(0.012))
        theirs, theirs_changed, isotropic, exchanged = (
            observation.apply(ngsolve_nonlinear.section_field(one, mesh, 4, observation.points))
            for one in (magnet, magnet.with_magnetizations(nominal + changed_by),
                        with_permeability(1.05, 1.05), with_permeability(1.15, 1.05)))
    ours = built.matrix @ built.nominal
    ours_changed = built.matrix @ (built.nominal + changed_by.ravel())
    assert np.abs(ours - theirs).max() < 3e-4
    assert np.abs(ours_changed - theirs_changed).max() < 4e-4
    for wrong in (isotropic, exchanged):
        assert np.abs(ours - wrong).max() > 2e-3
