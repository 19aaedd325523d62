"""A held-out map is of other readings than those that update the model."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.core.errors import HalbachWarning, MeasurementError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.campaign_readings import check_validation_map, read_campaign
from halbach_fe.inference.infer import infer
from halbach_fe.inference.result import HELD_OUT_MAP
from halbach_fe.measurement.campaign_maps import maps_of
from halbach_fe.measurement.field_map import field_map, points_of, total_field_map
from halbach_fe.study.reader import parse_study
from tests.conftest import circle
from tests.support.short_dipole import BODY, TEXT, reading, truth

TRAINING = field_map(circle(0.07, 12), np.column_stack([
    np.linspace(0.1, 0.2, 12), np.zeros(12), np.full(12, np.nan)]))
NOISE = {"regions": [{"name": "bore", "sigma_T": 1e-4}]}
COMPONENTS = {"observation__components": ["x", "y"]}


def check(study, held_out):
    magnet = build_magnet(study)
    check_validation_map(read_campaign(magnet, maps_of(study, TRAINING, held_out)), study)


def part(rows):
    """Some rows of the training map."""
    return field_map(points_of(TRAINING)[rows], TRAINING["B_T"].values[rows])


@pytest.mark.parametrize("rows", [slice(None), slice(None, None, -1), [3, 7, 5]],
                         ids=["the same", "in another order", "a part"])
def test_the_training_map(dipole, rows):
    with pytest.raises(MeasurementError, match=r"--held-out.*the same readings"):
        check(dipole(noise=NOISE, **COMPONENTS), part(rows))


def test_some_training_readings(dipole):
    other = field_map(circle(0.06, 2), np.tile([0.15, 0.0, np.nan], (2, 1)))
    both = field_map(np.vstack([points_of(part([1])), points_of(other)]),
                     np.vstack([part([1])["B_T"].values, other["B_T"].values]))
    with pytest.warns(HalbachWarning, match="2 of 6 readings of the held-out map"):
        check(dipole(noise=NOISE, **COMPONENTS), both)
    check(dipole(noise=NOISE, **COMPONENTS), other)  # no warning


def test_readings_that_the_study_holds_out(short_dipole):
    """They do not update the model, so that they may be given as a map too."""
    points = np.column_stack([np.zeros((12, 2)), np.linspace(-0.1, 0.1, 12)])
    data = field_map(points, np.column_stack([np.linspace(0.1, 0.2, 12), np.zeros((12, 2))]))
    study = short_dipole(noise=NOISE, inference={"held_out": {"every": 3}})
    magnet = build_magnet(study)
    readings = read_campaign(magnet, maps_of(study, data))
    rows = np.unique(np.flatnonzero(~readings.training) // 3)
    assert 0 < len(rows) < 12
    check_validation_map(read_campaign(
        magnet, maps_of(study, data, data.isel(point=rows))), study)


def test_read_again_at_the_same_points(dipole):
    """Other readings at the points of the map are a test of the noise, at least."""
    check(dipole(noise=NOISE, **COMPONENTS),
          field_map(points_of(TRAINING), TRAINING["B_T"].values + 1e-4))


@pytest.mark.parametrize(("moved_m", "added_T"), [(1e-9, 0.0), (0.0, 1e-6), (1e-8, -1e-6)])
def test_the_training_map_rounded(dipole, moved_m, added_T):
    with pytest.raises(MeasurementError, match=r"--held-out.*the same readings"):
        check(dipole(noise=NOISE, **COMPONENTS),
              field_map(points_of(TRAINING) + np.array([moved_m, 0, 0]),
                        TRAINING["B_T"].values + added_T))


def campaign(dipole, other, **settings):
    study = dipole(noise=NOISE, maps=[{"name": "a", "file": "a.csv"},
                                      {"name": "b", "file": "b.csv"} | settings], **COMPONENTS)
    return maps_of(study, {"a": TRAINING, "b": other})


def in_mm(data):
    return field_map(1e3 * points_of(data), 1e3 * data["B_T"].values)


@pytest.mark.parametrize(("other", "settings"), [
    (TRAINING, {}),
    (part(slice(0, 11)), {}),
    (part([3, 7]), {}),
    (field_map(points_of(TRAINING).round(6), TRAINING["B_T"].values.round(6)), {}),
    (field_map(points_of(TRAINING), TRAINING["B_T"].values + 1e-5), {}),
    (in_mm(TRAINING), {"instrument": {"length_unit_m": 1e-3, "flux_density_unit_T": 1e-3}}),
    (field_map(points_of(TRAINING)[:, [1, 0, 2]], TRAINING["B_T"].values[:, [1, 0, 2]]),
     {"instrument": {"position_axes": ["y", "x", "z"], "field_axes": ["y", "x", "z"]}})],
    ids=["the same", "one row less", "a part", "rounded", "rounded to the noise",
         "in mm and mT", "other axes"])
def test_readings_in_two_maps(dipole, other, settings):
    with pytest.raises(MeasurementError, match=r"`maps` 'a' and 'b'.*must not count twice"):
        campaign(dipole, other, **settings)


def test_two_maps_at_the_same_points(dipole, generator):
    again = TRAINING["B_T"].values + 1e-4 * generator.normal(size=(12, 3))
    assert len(campaign(dipole, field_map(points_of(TRAINING), again))) == 2
    blank = np.where(np.arange(3) == 2, 0.01, np.nan) * np.ones((12, 1))
    assert len(campaign(dipole, field_map(points_of(TRAINING), blank))) == 2


def test_a_held_out_map_has_the_uncertain_amplitudes_of_its_instrument(generator, session):
    """As it has the terms of `instrument_sd`; without them its readings were 3 mT off, 200 bars."""
    magnet_of, offset_T = truth(generator), 3e-3
    maps = [reading(magnet_of, generator, points, (Rotation.identity(), np.zeros(3)))
            for points in (BODY, BODY[::7] + np.array([1e-3, 2e-3, 3e-3]))]
    for one in maps:
        one["B_T"][:, 0] += offset_T
    result = infer(build_magnet(parse_study(tomllib.loads(TEXT) | {"uncertain": [{
        "name": "offset", "sd": offset_T, "change": {"instrument.offset_T[1]": 1.0}}]})),
        maps[0], session, validation_map=maps[1])
    (score,) = (one for one in result.scores if one.part == HELD_OUT_MAP)
    assert score.chi2_posterior == pytest.approx(1, abs=5 * np.sqrt(2 / score.readings))
    assert result.disagreement == ""


def test_what_the_probe_of_a_held_out_map_cannot_have(generator, session):
    """|B| has no offset of one component, and is predicted without it."""
    magnet_of = truth(generator)
    data = reading(magnet_of, generator, BODY, (Rotation.identity(), np.zeros(3)))
    points = BODY[::7] + np.array([1e-3, 2e-3, 3e-3])
    total = np.linalg.norm(magnet_of.getB(points), axis=1)
    total += 2e-5 * generator.standard_normal(len(total))
    result = infer(build_magnet(parse_study(tomllib.loads(TEXT) | {"uncertain": [{
        "name": "offset", "sd": 3e-3, "change": {"instrument.offset_T[1]": 1.0}}]})),
        data, session, validation_map=total_field_map(points, total))
    (score,) = (one for one in result.scores if one.part == HELD_OUT_MAP)
    assert score.chi2_posterior == pytest.approx(1, abs=5 * np.sqrt(2 / score.readings))


@pytest.mark.parametrize("length_unit_m", [1.0, 1e-3])
def test_circles_of_a_map_in_its_own_unit(dipole, length_unit_m):
    """Fourier coefficients are observed of a held-out map whose points are on the study's circles
    once they are in m; one in mm was taken for a map of flux densities, and its noise asked for.
    """
    study = dipole(noise=NOISE, instrument={"length_unit_m": length_unit_m}, observation={
        "quantity": "fourier_coefficients", "harmonics": 3, "positions": {
            "kind": "circles", "radius_m": 0.07, "angles": 12}})
    field = np.column_stack([np.linspace(0.1, 0.2, 12), np.zeros(12), np.zeros(12)])
    points = circle(0.07, 12) / length_unit_m
    maps = maps_of(study, field_map(points, field), field_map(points, 1.1 * field))
    assert [one.study.observation.quantity for one in maps] == 2 * ["fourier_coefficients"]
