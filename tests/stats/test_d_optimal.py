"""Where to measure: the greedy choice against exhaustive search, and against what is known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr

import halbach_fe as hf
from halbach_fe.core.errors import StudyError
from halbach_fe.design.measurement_plan import (
    greedy,
    information,
    plan_measurement,
    spread,
    variance_left,
)
from halbach_fe.design.objective import deviation_model
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.reading_noise import reading_noise
from halbach_fe.response.homogeneity import homogeneity_model
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import nominal_prior

NOISE = {"regions": [{"name": "all", "sigma_T": 1e-4}]}


def test_gain_is_the_mutual_information(generator):
    """Of two Gaussians, by the entropies of prior and posterior."""
    design = generator.standard_normal((7, 4))
    posterior = np.linalg.inv(np.eye(4) + design.T @ design)
    assert information(design) == pytest.approx(-np.linalg.slogdet(posterior)[1] / 2, rel=1e-12)
    assert information(design.T) == pytest.approx(  # more parameters than readings
        -np.linalg.slogdet(np.linalg.inv(np.eye(7) + design @ design.T))[1] / 2, rel=1e-12)


def test_running_gain_is_that_of_the_chosen(generator):
    design = generator.standard_normal((30, 2, 5))
    choice = greedy(design, 12)
    chosen, gain = choice.chosen, choice.gain
    assert len(set(chosen)) == 12
    for count in (1, 5, 12):
        assert gain[count - 1] == pytest.approx(information(np.vstack(design[chosen[:count]])))


def test_information_about_what_is_beside_does_not_count(generator):
    """The gain is the mutual information of the readings with the first five parameters alone."""
    design = generator.standard_normal((30, 2, 8))
    choice = greedy(design, 12, beside=design[:, :, 5:])
    for count in (1, 5, 12):
        rows = np.vstack(design[choice.chosen[:count]])
        noise = np.eye(len(rows)) + rows[:, 5:] @ rows[:, 5:].T
        whole = noise + rows[:, :5] @ rows[:, :5].T
        assert choice.gain[count - 1] == pytest.approx(
            (np.linalg.slogdet(whole)[1] - np.linalg.slogdet(noise)[1]) / 2)


@pytest.mark.parametrize("open_", [
    {}, {"instrument_sd": {"gain": 0.02}},
    {"instrument_sd": {"translation_m": 1e-3, "rotation_rad": 0.01}},
    {"uncertain": [{"name": "gain", "sd": 0.02, "change": {
        f"instrument.gain[{axis}]": 1.0 for axis in (1, 2, 3)}}]},
    {"external": {"neighbours": [{"z_m": 0.08}]}}],
    ids=["exact", "gain", "pose", "uncertain", "neighbour"])
def test_a_plan_knows_the_blocks_as_an_update_will(open_):
    """Standard deviations are those of an update at the same positions, by all that the study
    leaves open: with a gain of 2 % they were 2.3 times too short, and the deviation of |B| beside
    a neighbour was 20 times too uncertain. The update is about the readings, which changes the
    derivatives by the pose by a per cent.
    """
    magnet = hf.halbach_ring(
        blocks=8, inner_radius_m=0.03, outer_radius_m=0.05, length_m=0.06, remanence_T=1.2).with_(
            noise={"regions": [{"name": "all", "sigma_T": 1e-5}]}, inference={},
            homogeneity={"sphere_m": 0.01}, observation={
                "quantity": "flux_density", "positions": {
                    "kind": "grid", "start_m": [-0.01, -0.01, -0.03], "end_m": [0.01, 0.01, 0.03],
                    "count": [3, 3, 5]}}, **open_)
    points = points_from(magnet.study.observation.positions)
    planned = hf.plan(magnet, points=len(points))
    update = hf.infer(magnet, hf.field_map(points, magnet.field_T(points)))
    np.testing.assert_allclose(planned.baseline_sd, update.posterior.sd, rtol=0.03)
    assert planned.gain[-1] == pytest.approx(planned.baseline_gain[-1], rel=1e-6)
    known = deviation_model(homogeneity_model(
        magnet, hf.Region.sphere(0.01), Session.temporary())).of(update.posterior)
    assert planned.deviation.planned[-1] == pytest.approx(
        np.linalg.norm(known.root), rel=0.03)


def test_greedy_is_near_the_best(generator):
    """At least 1 - 1/e of the best of all choices; most other choices are worse."""
    for _ in range(5):
        design = generator.standard_normal((12, 2, 4)) * generator.uniform(0.2, 2, (12, 1, 1))
        choice = greedy(design, 4)
        chosen, gain = choice.chosen, choice.gain
        every = [information(np.vstack(design[list(some)]))
                 for some in itertools.combinations(range(12), 4)]
        assert gain[-1] >= (1 - 1 / np.e) * max(every)
        assert gain[-1] > np.quantile(every, 0.95)
        assert chosen[0] == np.argmax([information(one) for one in design])


def test_the_variance_of_values_falls_as_foretold(generator):
    """By the dense posterior; the control is the choice for information, which leaves more."""
    design = generator.standard_normal((30, 2, 5)) * generator.uniform(0.2, 2, (30, 1, 5))
    values = generator.standard_normal((3, 5)) * [3, 1, 0.1, 0.1, 0.1]

    def left(some):
        inner = np.eye(5) + sum(one.T @ one for one in design[some])
        return np.trace(values @ np.linalg.inv(inner) @ values.T)

    choice = greedy(design, 6, values)
    for count in (1, 2, 6):
        assert np.sum(values**2) - choice.fall[count - 1] == pytest.approx(
            left(choice.chosen[:count]))
        assert choice.gain[count - 1] == pytest.approx(
            information(np.vstack(design[choice.chosen[:count]])))
    assert choice.chosen[0] == np.argmin([left([number]) for number in range(30)])
    assert left(greedy(design, 6).chosen) > 1.05 * left(choice.chosen)
    for some in ([3], [0, 1, 2, 7, 11]):  # fewer readings than parameters, and more
        assert variance_left(np.vstack(design[some]), values) == pytest.approx(left(some))


def test_plan_in_a_cross_section(dipole, session):
    """Equally spaced points are as good as any on one circle; nearer to the blocks is better."""
    def circles(*radii):
        return [{"kind": "circles", "radius_m": radii, "angles": 48}]

    study = dipole(noise=NOISE, observation__components=["x", "y"],
                   plan={"candidates": circles(0.075), "points": 12})
    same = plan_measurement(build_magnet(study), session)
    assert len(same.points) == 12
    own = same.baseline_gain[list(same.baseline_counts).index(12)]
    assert own < same.gain[11] * 1.02
    # measured: 0.94, and 0.99 without the error of the mesh, which all readings share
    assert same.volume_ratio == pytest.approx(1, abs=0.08)

    wider = plan_measurement(build_magnet(dipole(noise=NOISE, observation__components=["x", "y"],
                        plan={"candidates": circles(0.05, 0.09), "points": 24})), session)
    outside = np.isclose(np.hypot(*wider.points[:, :2].T), 0.09)
    assert outside.mean() > 0.8  # measured: 22 of 24; a few farther in average several blocks
    assert wider.same_information < 24
    assert wider.volume_ratio < 0.8  # measured: 0.73
    assert (wider.planned_sd < wider.baseline_sd).all()
    # the sd's are those of a posterior: not above the prior's, and the plan's gain is its volume
    assert (wider.planned_sd <= wider.prior_sd).all()


def test_plan_with_correlated_noise(dipole, session):
    """All points together tell what the dense covariance says; its diagonal says something else.

    (In a plane, where curl and divergence vanish, equal errors along x and y do not correlate.)
    """
    study = dipole(array__recoil_permeability=1.0, observation__components=["x", "y"],
                   noise=NOISE | {"position_sd_m": [3e-3, 0.0, 0.0]})
    points = points_from(study.observation.positions)
    observation = observe(study, points, np.ones_like(points, bool))
    covariance = reading_noise(build_magnet(study), observation, xr.Dataset()).covariance.toarray()
    model = response_matrix(build_magnet(study), observation, session)
    prior = nominal_prior(model.nominal, 2, study.prior.magnitude_sd, study.prior.direction_sd_deg)
    spread = model.matrix @ prior.covariance @ model.matrix.T

    def told(noise):
        return np.linalg.slogdet(np.eye(len(noise)) + np.linalg.solve(noise, spread))[1] / 2

    found = plan_measurement(build_magnet(study), session, count=24)
    assert found.gain[-1] == pytest.approx(told(covariance), rel=1e-9)
    assert found.baseline_gain[-1] == pytest.approx(told(covariance), rel=1e-9)
    assert told(np.diag(np.diag(covariance))) != pytest.approx(told(covariance), rel=1e-2)
    after = np.linalg.inv(np.linalg.inv(prior.covariance)
                          + model.matrix.T @ np.linalg.solve(covariance, model.matrix))
    np.testing.assert_allclose(found.planned_sd, np.sqrt(np.diag(after)), rtol=1e-6)


def test_even_spread():
    assert spread(60, 4).tolist() == [0, 15, 30, 45]
    assert spread(5, 5).tolist() == [0, 1, 2, 3, 4]


def test_too_few_candidates(dipole, session):
    with pytest.raises(StudyError, match="at most the number of candidates, 24"):
        plan_measurement(build_magnet(dipole(noise=NOISE)), session, count=25)


def test_fewer_candidates_than_the_study_has_positions(dipole, session):
    """Without a number all of them are ordered; that of the positions was said to be too many."""
    line = {"kind": "line", "start_m": [0, 0, 0], "end_m": [0.05, 0, 0], "count": 5}
    few = {"candidates": [line]}
    found = plan_measurement(build_magnet(dipole(noise=NOISE, plan=few)), session)
    assert len(found.points) == 5
