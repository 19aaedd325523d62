"""The whole way: synthetic maps from independent models, updated, and predicted where held out."""

from __future__ import annotations

import functools
import json
import re
import tomllib
from dataclasses import replace

import magpylib
import numpy as np
import pytest
import xarray as xr

from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import _check_linearization, infer
from halbach_fe.inference.posterior_files import write_inference
from halbach_fe.inference.result import TOO_NEAR
from halbach_fe.measurement.field_map import field_map, points_of
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.report.point_maps import main_line
from halbach_fe.response.block_variation import with_magnetizations
from halbach_fe.response.nonlinear import newton_readings
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver.exact_block_field import gradient_of
from halbach_fe.solver.ring_harmonics_2d import (
    SectorMagnetization,
    ideal_sectors,
    layered_bore_field,
)
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.conftest import circle
from tests.support.pages import page, write_result
from tests.support.short_dipole import BODY, TEXT

NOISE = {"regions": [{"name": "bore", "sigma_T": 1e-5}]}
IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}


def iron_campaign(dipole, generator, noise=1e-5):
    """A 2D map of a dipole with permeability and iron whose blocks are off, in closed form."""
    study = dipole(iron_ring=IRON, noise=NOISE, mesh__block_size_m=0.01,
                   observation__components=["x", "y"])
    change = 0.01 * (generator.standard_normal(16) + 1j * generator.standard_normal(16))
    sectors = [SectorMagnetization(s.middle, s.half_width, s.remanence * (1 + d)) for s, d in
               zip(ideal_sectors(1, 16, 1.06, np.pi / 2, np.pi), change, strict=True)]
    remanence = np.array([s.remanence for s in sectors])
    truth = np.column_stack([remanence.real, remanence.imag]).ravel() / (MU_0 * 1.05)
    points = np.vstack([circle(0.075, 60), circle(0.05, 60)])
    exact = layered_bore_field(sectors, 0.104, 0.1865, 1.05, points[:, :2], (0.19, 0.2, 1000.0))
    field = np.column_stack([exact, np.full(len(points), np.nan)])
    field[:, :2] += noise * generator.standard_normal((len(points), 2))
    return study, field_map(points, field), truth


def test_permeable_dipole_with_iron_is_learnt(dipole, generator, session):
    """Truth by closed form, model by finite elements: error falls, error bars hold."""
    study, data, truth = iron_campaign(dipole, generator)
    update = infer(build_magnet(study), data, session)
    before = np.abs(update.prior.mean - truth)
    after = np.abs(update.posterior.mean - truth)
    assert np.median(after) < 0.5 * np.median(before)
    score = (update.posterior.mean - truth) / update.posterior.sd
    # 32 values: the rms of a standard normal is 1 +- 0.13; 4 sigma
    assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.5)
    line = main_line(update)
    assert (line.what, line.axis, len(line.index)) == ("Bx", "angle in degrees", 60)
    (region,) = update.scores
    assert update.prior_conflict == pytest.approx(1.0, abs=0.45)  # 240 readings: sd 0.09
    assert region.chi2_posterior is None  # seen by the update: no test of anything
    assert region.median_relative_error_posterior < 0.1 * region.median_relative_error_prior


def test_a_model_of_another_bore_does_not_fit(dipole, generator, session):
    """Negative control: blocks that may hardly differ cannot hide 2 mm of inner radius, which
    the right model does not need.
    """
    study, data, _ = iron_campaign(dipole, generator)
    tight = {"prior": {"magnitude_sd": 1e-3, "direction_sd_deg": 0.05, "common_mode_sd": 0.1},
             "noise": NOISE, "mesh__block_size_m": 0.01, "observation__components": ["x", "y"]}
    wrong = infer(build_magnet(dipole(array__inner_radius_m=0.106, iron_ring=IRON, **tight)), data,
                  session)
    assert wrong.prior_conflict > wrong.conflict_limit
    assert "An effect is missing" in wrong.disagreement
    loose = infer(build_magnet(study), data, session)
    assert loose.prior_conflict < loose.conflict_limit
    assert not loose.disagreement
    (region,) = study.noise.regions
    careless = study.with_(noise={"regions": [region.with_(sigma_T=1000 * region.sigma_T)]})
    assert "too large" in infer(build_magnet(careless), data, session).disagreement


POINTS = np.vstack([circle(0.08, 16, z, 0.1 * z) for z in np.linspace(-0.16, 0.16, 30)])


def places_of(study):
    """Angle in degrees and z in m of the middle of every block."""
    return tuple((position_angle_deg(study.array, block.slot), (block.z_min + block.z_max) / 2)
                 for block in build_magnet(study).blocks)


def sector_field(place, polarization, points):
    """B (n, 3) in T at points by magpylib of a sector of the short dipole."""
    middle, z = place
    return magpylib.magnet.CylinderSegment(
        dimension=(0.104, 0.1865, 0.08, middle - 11.25, middle + 11.25), position=(0, 0, z),
        polarization=polarization).getB(points)


@functools.cache
def unit_fields(places):
    """B (blocks, 3, n, 3) in T at `POINTS` of sectors of 1 T along each axis.

    It takes seconds, so that the tests share it.
    """
    return np.array([[sector_field(place, axis, POINTS) for axis in np.eye(3)]
                     for place in places])


def magpylib_truth(study, generator, points=None, spread=0.01):
    """B (n, 3) by magpylib of sectors of random polarization, at `POINTS` or at other points, and
    their M in A/m.
    """
    polarizations = np.array([
        block.remanence * (np.array(block.easy_axis) + spread * generator.standard_normal(3))
        for block in build_magnet(study).blocks])
    places = places_of(study)
    field = np.einsum("bd,bdnc->nc", polarizations, unit_fields(places)) if points is None else sum(
        sector_field(place, own, points) for place, own in zip(places, polarizations, strict=True))
    return field, polarizations.ravel() / MU_0


def magpylib_campaign(short_dipole, generator):
    """A 3D map by magpylib, three components at random points, z windows held out."""
    study = short_dipole(array__recoil_permeability=1.0, noise=NOISE,
                         inference={"held_out": {"every": 3, "window": 5}})
    field, truth = magpylib_truth(study, generator)
    field += 1e-5 * generator.standard_normal(field.shape)
    return study, field_map(POINTS, field), truth


def test_3d_array_is_learnt_and_predicts_what_it_did_not_see(short_dipole, generator, session,
                                                             tmp_path, monkeypatch):
    study, data, truth = magpylib_campaign(short_dipole, generator)
    update = infer(build_magnet(study), data, session)
    score = (update.posterior.mean - truth) / update.posterior.sd
    assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.3)  # 96 values: sd 0.07
    training, unseen = update.scores
    assert unseen.part == "held out"
    assert unseen.readings == 480
    # Predicted within bands: 480 readings of 95 %: sd 1 %
    assert unseen.coverage95_posterior == pytest.approx(0.95, abs=0.04)
    assert unseen.chi2_posterior == pytest.approx(1.0, abs=0.3)  # sd 0.065
    assert unseen.median_relative_error_posterior < 0.1 * unseen.median_relative_error_prior
    assert training.coverage95_posterior is None
    assert update.prior_conflict < update.conflict_limit

    line = main_line(update)  # one reading at each z, though every circle begins elsewhere
    assert (line.what, line.axis, len(line.index)) == ("Bx", "z in mm", 30)
    assert (np.diff(line.place) > 0).all()
    places = update.observation.positions[line.index]
    assert np.ptp(np.arctan2(places[:, 1], places[:, 0])) < 2 * np.pi / 16
    write_inference(update, tmp_path)
    write_result(update, tmp_path)
    with xr.open_dataset(tmp_path / "posterior.h5", engine="h5netcdf") as stored:
        np.testing.assert_allclose(stored["posterior_mean"], update.posterior.mean)
        np.testing.assert_allclose(np.sqrt(np.diag(stored["posterior_covariance"])),
                                   stored["posterior_sd"])
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["scores"][1]["readings"] == 480
    assert len((tmp_path / "prediction.csv").read_text().splitlines()) == 1 + len(update.readings)
    text = page(tmp_path / "report.html")
    assert text.count("<img alt=") == 5
    assert "disagree" not in text
    # the map tells about as much of all blocks, which is said; the control is drawn
    low, high = 100 * update.contraction.min(), 100 * update.contraction.max()
    share = f"{low:.0f} to {high:.0f}" if f"{low:.0f}" != f"{high:.0f}" else f"{low:.0f}"
    assert f"by {share}\u00a0% of the prior's variance" in text.replace("&#39;", "'")
    monkeypatch.setattr("halbach_fe.report.inference_page.ALIKE", -1.0)
    write_result(update, tmp_path)
    assert page(tmp_path / "report.html").count("<img alt=") == 6


def test_a_held_out_map_of_another_magnet_is_told(short_dipole, generator, session):
    """The map agrees with itself; the other one, whose blocks have other errors, does not."""
    study, data, _ = magpylib_campaign(short_dipole, generator)
    other = magpylib_campaign(short_dipole, generator)[1]
    magnet = build_magnet(study)
    assert infer(magnet, data, session).disagreement == ""
    said = infer(magnet, data, session, validation_map=other).disagreement
    assert "Held-out readings of the held-out map are" in said
    assert "not of this magnet" in said


@pytest.mark.parametrize(("factor", "every", "said"), [
    (100.0, 1, "sigma_T, position_sd_m or prior is too large"),
    (20.0, 12, r"updated model is [\d.]+ times nearer .* sigma_T or position_sd_m is too large"),
    (1.0, 12, None), (1.0, 1, None),
    (0.01, 1, "cannot all be right.*Held-out readings are .* sigma_T is too small")])
def test_noise_that_is_stated_wrongly(short_dipole, generator, session, factor, every, said):
    """Truth by magpylib. If readings are few, a prior that allows much does not hide it."""
    study, data, _ = magpylib_campaign(short_dipole, generator)
    changes = {"noise": {"regions": [{"name": "bore", "sigma_T": 1e-5 * factor}]}}
    if every > 1:
        changes["inference"] = {}
    update = infer(build_magnet(study.with_(**changes)), data.isel(point=slice(0, None, every)),
                   session)
    if said is not None:
        assert re.search(said, update.disagreement)
        assert update.noise_ratio < TOO_NEAR if factor > 1 else update.noise_ratio > 1000
        return
    assert update.disagreement == ""
    # 960 or 120 training readings, of which some 80 or 60 are learnt: sd 0.05 or 0.2
    assert update.noise_ratio == pytest.approx(1.0, abs=0.25 if every == 1 else 0.8)


def test_a_second_map_is_only_predicted(short_dipole, generator, session, tmp_path):
    """The same readings held out, by window or as a map of their own with noise of its own, give
    the same posterior and scores.
    """
    study, data, _ = magpylib_campaign(short_dipole, generator)
    one = infer(build_magnet(study), data, session)
    unseen = np.unique(np.flatnonzero(one.held_out) // 3)
    apart = short_dipole(array__recoil_permeability=1.0, noise=NOISE)
    other = data.isel(point=unseen)
    other["sigma_T"] = (("point", "component"), np.full((len(unseen), 3), 1e-5))
    two = infer(build_magnet(apart), data.drop_isel(point=unseen), session, validation_map=other)
    np.testing.assert_allclose(two.posterior.mean, one.posterior.mean, rtol=1e-9)
    assert [score.part for score in two.scores] == ["training", "held-out map"]
    assert two.scores[1].chi2_posterior == pytest.approx(one.scores[1].chi2_posterior)
    assert two.scores[1].rms_standardized_posterior == pytest.approx(1.0, abs=0.15)
    write_inference(two, tmp_path)
    table = np.genfromtxt(tmp_path / "prediction.csv", delimiter=",", names=True, dtype=None,
                          encoding="utf-8")
    assert set(table["part"][-len(unseen):]) == {"held-out map"}
    total = np.sqrt(table["posterior_sd_T"]**2 + table["sigma_T"]**2 + table["solver_error_T"]**2)
    np.testing.assert_allclose(table["standardized_residual"], (
        table["measured_T"] - table["posterior_mean_T"]) / total, rtol=1e-9)
    for name, value in (("x_m", 0.15), ("y_m", 0.0), ("z_m", 0.04)):
        other[name].values[0] = value
    with pytest.raises(MeasurementError, match="reading 1 of held-out map must be at a point in"):
        infer(build_magnet(apart), data, session, validation_map=other)


def test_the_axis_from_fourier_coefficients(short_dipole, generator, session):
    """What the paper did: B on the axis, with noise of its own, by a model updated with circles."""
    study, data, _ = magpylib_campaign(short_dipole, generator)
    coefficients = short_dipole(
        array__recoil_permeability=1.0, noise=NOISE, prior=study.prior.model_dump(),
        observation={"quantity": "fourier_coefficients", "harmonics": 6, "positions": {
            "kind": "circles", "radius_m": 0.08, "angles": 16}})
    z = np.linspace(-0.15, 0.15, 21)
    points = np.column_stack([0 * z, 0 * z, z])
    everything = infer(build_magnet(study), data,
                       session)  # by all three components, ten times as sure
    field = observe(study, points, np.ones_like(points, bool))
    matrix = response_matrix(build_magnet(study), field, session).matrix
    truth = (matrix @ everything.posterior.mean).reshape(-1, 3)
    axis = field_map(points, truth + 1e-5 * generator.standard_normal(truth.shape))
    with pytest.raises(MeasurementError, match="sigma_T of held-out map must be given"):
        infer(build_magnet(coefficients), data, session, validation_map=axis)
    axis["sigma_T"] = (("point", "component"), np.full(truth.shape, 1e-5))
    update = infer(build_magnet(coefficients), data, session, validation_map=axis)
    _, unseen = update.scores
    assert (unseen.part, unseen.readings) == ("held-out map", 63)
    assert unseen.chi2_posterior == pytest.approx(1.0, abs=0.75)  # sd 0.18
    assert unseen.median_relative_error_posterior < 0.3 * unseen.median_relative_error_prior
    write_result(update, session.folder)


def test_held_out_components_whose_points_were_seen(short_dipole, generator, session):
    """B_z is predicted from B_x and B_y, and one end from the rest; positions that are 0.2 mm off
    correlate the noise of held-out and training components of a point. Scores hold.
    """
    study, data, truth = magpylib_campaign(short_dipole, generator)
    points = np.column_stack([data[name].values for name in ("x_m", "y_m", "z_m")])
    gradient = gradient_of(with_magnetizations(build_magnet(study), truth), points)
    data["B_T"].values[:] += np.einsum(
        "ick,ik->ic", gradient, 2e-4 * generator.standard_normal(points.shape))
    update = infer(build_magnet(short_dipole(
        array__recoil_permeability=1.0, noise=NOISE | {"position_sd_m": 2e-4},
        inference={"held_out": {"components": ["z"], "z_ranges_m": [[0.1, 1.0]]}})), data, session)
    assert update.held_out.sum() == 480 + 2 * 6 * 16
    _, unseen = update.scores
    # sd over 80 campaigns: 0.051 (of 672 independent readings 0.055), 0.042, 0.011; 4 to 5 sigma
    assert unseen.chi2_posterior == pytest.approx(1.0, abs=0.22)
    assert unseen.rms_standardized_posterior == pytest.approx(1.0, abs=0.2)
    assert unseen.coverage95_posterior == pytest.approx(0.95, abs=0.05)
    assert update.prior_conflict < update.conflict_limit


def test_report_says_when_the_model_does_not_fit(short_dipole, generator, session, tmp_path):
    study, data, _ = magpylib_campaign(short_dipole, generator)
    data["B_T"].values[:, 2] += 1e-3  # an offset of the z sensor: no magnet makes it
    update = infer(build_magnet(study), data, session)
    assert update.prior_conflict > update.conflict_limit
    write_result(update, tmp_path)
    assert "Model and measurement disagree" in (tmp_path / "report.html").read_text()


def test_maps_that_do_not_fit_the_study(short_dipole, dipole, session):
    study = short_dipole(noise=NOISE)
    inside = field_map(np.array([[0, 0, 0], [0.15, 0, 0.04]]), np.ones((2, 3)))
    with pytest.raises(MeasurementError, match=r"reading 2 of map must be at a point in air"):
        infer(build_magnet(study), inside, session)
    sloped = field_map(np.array([[0, 0, 0], [0, 0, 0.1]]), np.ones((2, 3)))
    with pytest.raises(MeasurementError, match="one plane for a 2D study"):
        infer(build_magnet(dipole(noise=NOISE)), sloped, session)
    # but a tilted mapper stays in the plane, as far as the field of a long magnet shows it
    tilted = np.array([[0.01, 0, 1e-4], [-0.01, 0, -1e-4], [0, 0.01, 0]])
    array, across = dipole(noise=NOISE), np.ones((3, 3)) * [1, 1, 0]
    upright = infer(build_magnet(array), field_map(tilted * [1, 1, 0], across), session)
    update = infer(build_magnet(array), field_map(tilted, across), session)
    np.testing.assert_allclose(update.posterior.mean, upright.posterior.mean, rtol=1e-9, atol=1e-12)
    with pytest.raises(MeasurementError, match="one plane for a 2D study"):
        infer(build_magnet(array), field_map(tilted * [1, 1, 20], across), session)
    with pytest.raises(StudyError, match="how noisy"):
        infer(build_magnet(short_dipole()), field_map(np.zeros((1, 3)), np.ones((1, 3))), session)


def test_the_study_says_how_a_map_is_to_be_read(short_dipole, generator, session):
    """A map with a wrong radius, in mm and with axes exchanged, is that which it was made of."""
    study, data, _ = magpylib_campaign(short_dipole, generator)
    right = infer(build_magnet(study), data, session)
    points, field = points_of(data), data["B_T"].values
    written = field_map(1e3 * (points * [3.0, 3.0, 1.0])[:, [1, 0, 2]], field * [1, 1, -1])
    with pytest.raises(MeasurementError, match="a point in air"):
        infer(build_magnet(study), field_map(points * [2.0, 2.0, 1.0], field), session)
    instrument = Instrument(length_unit_m=1e-3, radius_scale=1 / 3 - 1,
                            position_axes=("y", "x", "z"), field_axes=("x", "y", "-z"))
    found = infer(build_magnet(study.with_(instrument=instrument)), written, session)
    # solvers of the response stop at 1e-10, and points are off by their rounding
    np.testing.assert_allclose(found.posterior.mean, right.posterior.mean, rtol=0,
                               atol=1e-5 * right.posterior.sd.min())


def test_excluded_readings_are_gone(short_dipole, generator, session):
    study, data, _ = magpylib_campaign(short_dipole, generator)
    broken = data.copy(deep=True)
    broken["B_T"].values[6, 1] += 0.3
    broken["B_T"].values[100] = 0.2
    told = {"held_out": {"every": 3, "window": 5},
            "excluded_readings": [{"row": 7, "components": ["y"]}, 101]}
    without = infer(build_magnet(
        parse_study(study.model_dump(exclude_none=True) | {"inference": told})), broken,
                    session)
    assert len(without.observation) == 3 * data.sizes["point"] - 4
    assert without.prior_conflict < without.conflict_limit
    assert infer(build_magnet(study), broken, session).prior_conflict > 100  # as it is with them
    with pytest.raises(MeasurementError, match=r"at least the 101 that inference\.excl"):
        infer(build_magnet(without.study), data.isel(point=slice(0, 100)), session)


def test_fourier_coefficients_are_updated_and_predicted(dipole, generator, session):
    """The paper's q_F: K = 8 harmonics on a circle, noise given for the coefficients."""
    _, data, _ = iron_campaign(dipole, generator, noise=1e-6)
    data = data.isel(point=slice(0, 60))  # the circle of 75 mm
    study = dipole(iron_ring=IRON, mesh__block_size_m=0.01,
                   noise={"regions": [{"name": "bore", "sigma_T": 2e-6}]},
                   observation={"quantity": "fourier_coefficients", "harmonics": 8,
                                "positions": {"kind": "circles", "radius_m": 0.075,
                                              "angles": 60}})
    update = infer(build_magnet(study), data, session)
    assert update.observation.labels == tuple(
        f"{part}{k}" for part in "AB" for k in range(1, 9))
    before = np.abs(update.readings - update.prediction_prior.mean)
    after = np.abs(update.readings - update.prediction_posterior.mean)
    assert before.max() > 1e-3
    assert after.max() < 1e-5


TWO_CIRCLES = {"quantity": "fourier_coefficients", "harmonics": 8, "positions": {
    "kind": "circles", "radius_m": [0.05, 0.075], "angles": 60}}


def test_two_radii_with_unequal_noise(dipole, generator, session):
    """Coefficients of two circles, B_y read ten times worse than B_x, whose noise correlates them:
    error bars and chi2 hold.
    """
    _, data, truth = iron_campaign(dipole, generator, noise=0.0)
    sigma = np.tile([1e-5, 1e-4, np.nan], (120, 1))
    data["B_T"].values[:] += sigma * generator.standard_normal((120, 3))
    data["sigma_T"] = (("point", "component"), sigma)
    study = dipole(iron_ring=IRON, mesh__block_size_m=0.01, observation=TWO_CIRCLES)
    update = infer(build_magnet(study), data, session)
    assert len(update.readings) == 32
    assert not update.noise.independent
    score = (update.posterior.mean - truth) / update.posterior.sd
    # 32 values: the rms of a standard normal is 1 +- 0.13; 4 sigma
    assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.5)
    assert update.prior_conflict == pytest.approx(1.0, abs=1.0)  # 32 readings: sd 0.25
    write_inference(update, session.folder)
    table = np.genfromtxt(session.folder / "prediction.csv", delimiter=",", names=True)
    assert sorted(set(table["x_m"])) == [0.05, 0.075]
    line = main_line(update)
    assert (line.axis, line.place.tolist()) == ("harmonic", list(range(1, 9)))
    assert len(set(update.observation.radii[line.index])) == 1
    write_result(update, session.folder)
    page = (session.folder / "report.html").read_text()
    assert "of the training readings for the prior (nothing was held out)" in page
    assert "T, correlated" in page


def test_uncertain_positions(short_dipole, generator, session):
    """A 3D map by magpylib whose every point is 0.2 mm off: as noise it is understood, in points
    and in coefficients of two circles; a study that takes the positions for exact disagrees.
    """
    points = np.vstack([circle(radius, 20, z) for radius in (0.05, 0.075)
                        for z in np.linspace(-0.12, 0.12, 7)])
    moved = points + 2e-4 * generator.standard_normal(points.shape)
    study = short_dipole(array__recoil_permeability=1.0)
    field, _ = magpylib_truth(study, generator, moved)
    field += 1e-5 * generator.standard_normal(field.shape)
    data = field_map(points, field, np.full_like(field, 1e-5))
    for observation in (study.observation.model_dump(), TWO_CIRCLES):
        known, exact = (
            infer(build_magnet(short_dipole(array__recoil_permeability=1.0, observation=observation,
                                           noise=noise)), data, session)
                        for noise in ({"position_sd_m": 2e-4}, None))
        assert known.prior_conflict < known.conflict_limit
        # 840 readings: sd 0.05; 224: 0.09
        assert known.prior_conflict == pytest.approx(1.0, abs=0.4)
        assert exact.prior_conflict > 10 * exact.conflict_limit


def test_uncertain_positions_in_the_gradient_of_the_updated_magnet(
        short_dipole, generator, session):
    """Blocks that differ by a tenth have a gradient of their own; the nominal one, the control,
    makes another noise of positions.
    """
    points = np.vstack([circle(0.08, 20, z) for z in np.linspace(-0.12, 0.12, 7)])
    study = short_dipole(array__recoil_permeability=1.0, noise={"position_sd_m": 2e-4},
                         prior={"magnitude_sd": 0.1, "direction_sd_deg": 6.0})
    field, truth = magpylib_truth(
        study, generator, points + 2e-4 * generator.standard_normal(points.shape), 0.1)
    field += 1e-5 * generator.standard_normal(field.shape)
    magnet = build_magnet(study)
    update = infer(magnet, field_map(points, field, np.full_like(field, 1e-5)), session)

    def position_noise(blocks):
        moved = 2e-4 * np.linalg.norm(gradient_of(blocks, points), axis=2)
        return np.hypot(moved, 1e-5).ravel()

    true, nominal = (position_noise(with_magnetizations(magnet, values))
                     for values in (truth, magnet.nominal_magnetization))
    error, control = (np.median(np.abs(each / true - 1)) for each in (update.noise.sd, nominal))
    # an update of 420 readings of this noise knows the gradient to some per cent
    assert error < 0.03
    assert control > 3 * error
    assert update.prior_conflict == pytest.approx(1.0, abs=0.4)


def test_nothing_held_out_is_said(dipole, generator, session):
    _, data, _ = iron_campaign(dipole, generator)
    with pytest.raises(MeasurementError, match="enough z positions"):
        infer(build_magnet(dipole(noise=NOISE, inference={"held_out": {"every": 2}},
                     observation__components=["x", "y"])), data, session)


def test_a_map_in_the_wrong_unit_is_refused_as_a_map(short_dipole, session):
    far = field_map(np.array([[0.0, 0, 0], [75.0, 0, 0]]), np.ones((2, 3)))
    with pytest.raises(MeasurementError, match="Check the units"):
        infer(build_magnet(short_dipole(noise=NOISE)), far, session)
    with pytest.raises(MeasurementError, match="Check the units"):
        infer(build_magnet(short_dipole(noise=NOISE)), far.isel(point=[0]), session,
              validation_map=far.isel(point=[1]))


def test_readings_that_vanish_by_symmetry(short_dipole, session):
    """B_y on the axis is zero; neither the checks nor the report may stumble over it."""
    study = short_dipole(noise=NOISE, observation__components=["y"], array__rings=1,
                         array__blocks_per_ring=8, mesh__meridian_size_m=0.04)
    points = np.column_stack([np.zeros((5, 2)), np.linspace(-0.1, 0.1, 5)])
    fields = np.tile([0.1, 0.0, 0.0], (5, 1))
    update = infer(build_magnet(study), field_map(points, fields), session)
    (score,) = update.scores
    assert score.median_relative_error_posterior is None
    write_inference(update, session.folder)
    write_result(update, session.folder)
    assert "Infinity" not in (session.folder / "summary.json").read_text()


CURVE = {"inner_radius_m": 0.19, "outer_radius_m": 0.192,
         "curve": {"kind": "steel", "name": "aisi_1010"}}


def saturated_campaign(dipole, generator, session, spread, sizes=(0.01, 0.007)):
    """A 2D map of a dipole in a saturated ring, by Newton's method on a mesh of its own."""
    changes = {"iron_ring": CURVE, "noise": NOISE, "observation__components": ["x", "y"],
               "prior": {"magnitude_sd": spread, "direction_sd_deg": np.degrees(spread)}}
    study = dipole(**changes, mesh__block_size_m=sizes[0])
    points = np.vstack([circle(0.075, 40), circle(0.09, 40)])
    nominal = np.concatenate([block.magnetization[:2] for block in build_magnet(study).blocks])
    size = np.linalg.norm(nominal[:2])
    truth = nominal + spread * size * generator.standard_normal(len(nominal))
    finer = dipole(**changes, mesh__block_size_m=sizes[1])
    observation = observe(finer, points, np.ones((len(points), 3), bool))
    readings = newton_readings(build_magnet(finer), observation, session.within("truth"),
                               truth[None])[0]
    field = np.full((len(points), 3), np.nan)
    field[:, :2] = readings.reshape(-1, 2) + 1e-5 * generator.standard_normal((len(points), 2))
    return study, field_map(points, field), truth


def test_saturated_iron_is_linearized(dipole, generator, session):
    """Errors of 0.1 % leave the iron's tangent good enough; without the offset nothing fits."""
    study, data, truth = saturated_campaign(dipole, generator, session, 0.001)
    update = infer(build_magnet(study), data, session)
    score = (update.posterior.mean - truth) / update.posterior.sd
    assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.5)  # 32 values: sd 0.13
    assert update.prior_conflict < update.conflict_limit
    shift = np.abs(update.response.offset) / update.sigma
    assert shift.max() > 10
    assert not update.bent_iron
    # where it is not good enough, whatever is computed from the posterior says so
    assert not update.reservation
    assert replace(update, bent_iron="It is bent.").reservation == "Only with care. It is bent."


def test_iron_that_is_too_far_from_linear_is_said(dipole, generator, session):
    # of 5 % changes the iron's curve makes hundreds of times the noise on any mesh
    study, data, _ = saturated_campaign(dipole, generator, session, 0.05, sizes=(0.02, 0.015))
    with pytest.warns(HalbachWarning, match="needs the non-linear posterior"):
        found = infer(build_magnet(study), data, session)
    assert "needs the non-linear posterior" in found.bent_iron


def test_neighbours_do_not_change_as_the_blocks_do(generator, tmp_path):
    """Their blocks are others: their field of the updated ones passed for iron that is bent."""
    magnet = build_magnet(parse_study(tomllib.loads(TEXT) | {
        "external": {"neighbours": [{"z_m": 0.08}]}}))
    observation = observe(magnet.study, BODY[::5], np.ones((len(BODY[::5]), 3), bool))
    session = Session.open(tmp_path)
    model, sigma = response_matrix(magnet, observation, session), np.full(len(observation), 2e-5)
    found = model.nominal * (1 + 0.02 * generator.standard_normal(len(model.nominal)))
    assert _check_linearization(magnet, observation, session, model, found, sigma) == ""
    bent = replace(model, offset=model.offset + 1e-5)  # the control
    with pytest.warns(HalbachWarning, match=r"by 0\.5 of its error bar"):
        _check_linearization(magnet, observation, session, bent, found, sigma)


def test_the_turns_of_mounting_are_in_the_prior(tmp_path):
    """Of maps of magnets drawn by it chi2 is 1. Without a table of blocks `infer` left it out: chi2
    was 2.5 to 2.9, and every clean map in conflict. Control: so it is by a prior without it.
    """
    study = parse_study({
        "name": "turned", "mesh": {"block_size_m": 0.01}, "array": {
            "blocks_per_ring": 16, "inner_radius_m": 0.05, "outer_radius_m": 0.08,
            "ring_length_m": 0.1, "remanence_T": 1.3, "block": {"shape": "sector"}},
        "noise": {"regions": [{"name": "all", "sigma_T": 5e-6}]},
        "prior": {"magnitude_sd": 0.002, "direction_sd_deg": 0.2, "mounting_sd_deg": 1.0},
        "observation": {"quantity": "flux_density", "positions": {
            "kind": "grid", "start_m": [-0.03, -0.03, -0.06], "end_m": [0.03, 0.03, 0.06],
            "count": [4, 4, 7]}}})
    session = Session.open(tmp_path)
    chi2 = []
    for seed in range(1, 5):
        campaign = simulate_campaign(study, seed)
        found = infer(build_magnet(study), campaign.readings, session)
        assert not found.disagreement
        chi2.append(found.prior_conflict)
    assert np.mean(chi2) == pytest.approx(1, abs=0.2)  # three sd of the mean of four of 0.13
    without = infer(build_magnet(study.with_(prior__mounting_sd_deg=0.0)), campaign.readings,
                    session)
    assert without.prior_conflict > 1.5 * without.conflict_limit
    assert without.disagreement
