"""The homogeneity of a map itself, beside magpylib's field in the same region."""

from __future__ import annotations

import copy
import re

import magpylib
import numpy as np
import pytest

from halbach_fe.api import homogeneity
from halbach_fe.core.errors import MeasurementError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.map_homogeneity import HELD_OUT_PART, MAP, POOR, not_carried
from halbach_fe.magnets import halbach_ring, to_magpylib
from halbach_fe.measurement.field_map import field_map, total_field_map
from halbach_fe.measurement.source_free_field import solid_harmonic_fields
from halbach_fe.report.homogeneity_page import answer
from halbach_fe.report.page import write_report
from halbach_fe.response.homogeneity import Homogeneity, real_harmonics
from halbach_fe.response.region import Region, region_points, sphere_points
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from tests.response.test_magnetic_axis import true_field
from tests.support.cuboids import DOCUMENT

NOISE_T = 2e-5
GRID = 0.01 * np.stack(np.meshgrid(*3 * [np.arange(-4, 5)], indexing="ij"), axis=-1).reshape(-1, 3)
REGION = Region.sphere(0.035)


def study(noise_T=NOISE_T):
    document = copy.deepcopy(DOCUMENT)
    document["array"] |= {"first_block_angle_deg": 0.0, "first_magnetization_angle_deg": 0.0}
    document["noise"] = {"regions": [{"name": "all", "sigma_T": noise_T}]}
    return parse_study(document | {"inference": {"held_out": {"scan_lines_every": 3}}})


@pytest.fixture
def errors(generator):
    """Polarizations of the blocks that deviate by per cents, of which the study says nothing."""
    return 0.03 * generator.standard_normal((3, 12, 3))


def measured(generator, errors, noise_T=NOISE_T):
    field = true_field(1, GRID, errors=errors)
    return field_map(GRID, field + noise_T * generator.standard_normal(field.shape))


def test_beside_the_true_field(generator, tmp_path, errors):
    magnet = build_magnet(study())
    found = homogeneity(magnet, Session.open(tmp_path), REGION, data=measured(generator, errors))
    sampling = region_points(magnet, REGION)
    points, weights, degree = sampling.points, sampling.weights, sampling.degree
    field = true_field(1, points, errors=errors)
    size = np.linalg.norm(field, axis=1)
    mean = float(weights @ size)
    rms = 1e6 * float(np.sqrt(weights @ (size / mean - 1)**2))
    direction = weights @ field / np.linalg.norm(weights @ field)
    surface = int((weights == 0).sum())
    terms, functions = real_harmonics(6, degree)
    harmonics = 1e6 / mean * functions @ (field[:surface] @ direction)
    assert list(found.of_map) == [MAP, HELD_OUT_PART]
    for known in found.of_map.values():
        assert known.mean_T == pytest.approx(mean, abs=4 * known.mean_sd_T)
        low, _, high = known.rms_range_ppm
        assert low - (high - low) / 2 < rms < high + (high - low) / 2  # twice the 95 % range
        score = np.array([(each.ppm - true) / each.sd_ppm
                          for each, true in zip(known.harmonics, harmonics, strict=True)])
        # of 48 harmonics the rms of normal ones is within 0.7 to 1.3; the prior, which is not the
        # magnet's, may widen or narrow bars of what the readings hardly tell
        assert np.sqrt(np.mean(score**2)) < 1.6
        assert [(each.degree, each.order, each.letter) for each in known.harmonics] == terms
    assert found.map_misfit == pytest.approx(1, abs=0.05)  # of 2187 readings: 1.5 % is one sd
    # fewer readings tell less
    assert found.of_map[HELD_OUT_PART].mean_sd_T > found.of_map[MAP].mean_sd_T
    # control: the nominal magnet is another one
    nominal = found.by_name["prior"]
    assert abs(nominal.mean_T - mean) > 20 * found.of_map[HELD_OUT_PART].mean_sd_T
    score = np.array([(other.ppm - true) / own.sd_ppm for own, other, true in zip(
        found.of_map[HELD_OUT_PART].harmonics, nominal.harmonics, harmonics, strict=True)])
    assert np.sqrt(np.mean(score**2)) > 20


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_map_of_one_component(generator, tmp_path, errors, axis):
    """Along the main field it tells |B| to first order; across it, nothing."""
    magnet = build_magnet(study())
    data = measured(generator, errors)
    data["B_T"].values[:, [other for other in range(3) if other != axis]] = np.nan
    found = homogeneity(magnet, Session.open(tmp_path), REGION, data=data)
    sampling = region_points(magnet, REGION)
    points, weights = sampling.points, sampling.weights
    field = true_field(1, points, errors=errors)
    size = np.linalg.norm(field, axis=1)
    mean = float(weights @ size)
    rms = 1e6 * float(np.sqrt(weights @ (size / mean - 1)**2))
    main = int(np.argmax(np.abs(weights @ field)))
    write_report(found, tmp_path / "page")
    page = (tmp_path / "page" / "homogeneity.html").read_text()
    if axis != main:
        assert not found.of_map
        assert "does not tell how homogeneous" in page
        return
    known = found.of_map[MAP]
    assert known.components == f"B{'xyz'[axis]}"
    assert f"map, B{'xyz'[axis]} alone" in page
    assert "the direction of the mean of B is not told" in page
    # what lies across adds (B_across / B)^2 / 2 to |B|; its bars are those of this component
    across = np.linalg.norm(np.delete(field, axis, axis=1), axis=1)
    second = float(np.max(across**2 / size**2)) / 2
    said = re.search(r"but for some ([\d.\u202f]+) ppm", found.map_remarks[0])[1]
    stated = 1e-6 * float(said.replace("\u202f", ""))
    assert second / 3 < stated < 5 * second
    assert known.mean_T == pytest.approx(float(weights @ np.abs(field[:, axis])),
                                         abs=4 * known.mean_sd_T)
    assert known.mean_T == pytest.approx(mean, abs=4 * known.mean_sd_T + stated * mean)
    assert known.mean_sd_T < 1e-4 * mean  # which was ten times the field
    for each in found.of_map.values():
        low, middle, high = each.rms_range_ppm
        assert each.rms_ppm == middle  # no estimate is outside of its own range
        assert each.peak_to_peak_ppm == each.peak_to_peak_range_ppm[1]
        assert low - (high - low) / 2 - 1e6 * second < rms < high + (high - low) / 2 + 1e6 * second
    # the extremes are on the sphere, where 20 000 points miss them by 1e-4; a component alone is no
    # field of a potential, and looked for as one they were 13 % off
    shell = 0.035 * sphere_points(100)[0]
    ends = np.abs(true_field(1, shell, errors=errors)[:, axis])
    least, _, most = known.peak_to_peak_range_ppm
    assert least - (most - least) < 1e6 * np.ptp(ends) / known.mean_T < most + (most - least)


def test_a_map_of_the_magnitude(generator, tmp_path, errors):
    """Truth by magpylib, of blocks that are 3 % off: |B| is what the page says, to its bars and to
    the second order that it states; of a quadrupole, whose field turns, nothing is said.
    """
    magnet = build_magnet(study())
    data = measured(generator, errors)
    data = total_field_map(GRID, np.linalg.norm(data["B_T"].values, axis=1))
    found = homogeneity(magnet, Session.open(tmp_path), REGION, data=data)
    sampling = region_points(magnet, REGION)
    points, weights = sampling.points, sampling.weights
    size = np.linalg.norm(true_field(1, points, errors=errors), axis=1)
    mean = float(weights @ size)
    rms = 1e6 * float(np.sqrt(weights @ (size / mean - 1)**2))
    second = float(re.search(r"but for some ([\d.]+) ppm", found.map_remarks[0])[1])
    assert second < 500  # 3 % of 36 blocks leave some 1 % of the field: 100 ppm
    # of 729 readings: 2.6 % is one sd; what is of second order is no noise
    assert 0.9 < found.map_misfit < np.hypot(1, 1e-6 * second * mean / NOISE_T) + 0.1
    for known in found.of_map.values():
        assert known.components == "|B|"
        assert known.mean_T == pytest.approx(mean, abs=4 * known.mean_sd_T + 1e-6 * second * mean)
        low, _, high = known.rms_range_ppm
        assert low - (high - low) / 2 - second < rms < high + (high - low) / 2 + second
    nominal = found.by_name["prior"]  # the control: it is another magnet
    assert abs(nominal.mean_T - mean) > 20 * found.of_map[MAP].mean_sd_T
    write_report(found, tmp_path / "page")
    assert "map, |B| alone" in (tmp_path / "page" / "homogeneity.html").read_text()
    field = true_field(2, GRID, errors=errors)
    turning = total_field_map(GRID, np.linalg.norm(field, axis=1))
    found = homogeneity(magnet, Session.open(tmp_path), REGION, data=turning)
    assert not found.of_map
    assert "may turn too much there for |B| to be harmonic" in found.map_remarks[0]


def test_a_map_of_another_magnet(generator, tmp_path, errors):
    data = measured(generator, errors)
    magnet, session = build_magnet(study()), Session.open(tmp_path)
    other = data.assign(B_T=0.5 * data["B_T"])
    found = homogeneity(magnet, session, REGION, data=other)
    assert re.search(r"is 0\.[45]\d* times that of the magnet", " ".join(found.map_remarks))
    assert "times that of the magnet" not in " ".join(
        homogeneity(magnet, session, REGION, data=data).map_remarks)


def test_a_fit_that_cannot_be_relied_on(generator, tmp_path, errors):
    """Noise of a tenth shows what harmonics of higher degrees than the fit's do."""
    magnet = build_magnet(study(0.1 * NOISE_T))
    found = homogeneity(magnet, Session.open(tmp_path), REGION,
                        data=measured(generator, errors, 0.1 * NOISE_T))
    assert found.map_misfit > POOR
    write_report(found, tmp_path / "page")
    assert "times the stated noise" in (tmp_path / "page" / "homogeneity.html").read_text()
    assert "times the stated noise" in answer(found).said  # which the terminal shows, too


@pytest.mark.parametrize("coils", [(), ({"kind": "round", "radius_m": 0.03, "current_A": 500.0},)])
def test_the_sphere_that_sources_leave_free(generator, tmp_path, coils):
    """Thin rings lie between two shells that are tried, and a coil is no body: the fit took the
    whole field to be free, and found 440 times the noise.
    """
    blocks = halbach_ring(blocks=12, inner_radius_m=0.0525, outer_radius_m=0.0675, length_m=0.03,
                          rings=2, shape="cuboid").with_(array__ring_gap_m=0.025)
    magnet = blocks.with_(external={"coils": list(coils)},
                          noise={"regions": [{"name": "all", "sigma_T": 2e-6}]})
    grid = GRID[np.linalg.norm(GRID, axis=1) < 0.042] / 2
    field = magpylib.getB([to_magpylib(blocks), *(magpylib.current.Circle(
        diameter=0.06, current=500.0) for _ in coils)], grid, sumup=True)
    found = homogeneity(magnet, Session.open(tmp_path), Region.sphere(0.015), data=field_map(
        grid, field + 2e-6 * generator.standard_normal(field.shape)))
    assert found.map_misfit == pytest.approx(1, abs=0.1)  # of 1000 readings: 2 % is one sd
    known, exact = found.of_map[MAP], found.by_name["prior"]
    assert known.mean_T == pytest.approx(exact.mean_T, abs=4 * known.mean_sd_T)
    score = [(each.ppm - true.ppm) / each.sd_ppm for each, true in zip(
        known.harmonics, exact.harmonics, strict=True)]
    assert np.sqrt(np.mean(np.square(score))) < 1.6  # as for the three rings above


def test_a_held_out_part_that_is_too_small(generator, tmp_path, errors):
    """Every 40th scan line does not carry the deviation; the control holds every 20th out."""
    data = measured(generator, errors)
    small, large = (homogeneity(build_magnet(study().with_(
        inference={"held_out": {"scan_lines_every": every}})), Session.open(tmp_path), REGION,
        data=data) for every in (40, 20))
    assert list(small.of_map) == [MAP]
    assert "too few to tell" in " ".join(small.map_remarks)
    assert "; a fit to the readings alone has" in answer(small).said
    assert list(large.of_map) == [MAP, HELD_OUT_PART]
    assert not large.map_remarks
    # what is left is the whole map's fit, which holds the truth
    sampling = region_points(small.magnet, REGION)
    points, weights = sampling.points, sampling.weights
    size = np.linalg.norm(true_field(1, points, errors=errors), axis=1)
    rms = 1e6 * float(np.sqrt(weights @ (size / (weights @ size) - 1)**2))
    low, _, high = small.of_map[MAP].rms_range_ppm
    assert low - (high - low) / 2 < rms < high + (high - low) / 2  # twice the 95 % range


@pytest.mark.parametrize(("part", "whole", "reason"), [
    # the numbers of a map of which every 40th scan line was held out
    ((46_284, 51_190, 62_583), (66_206, 66_216, 66_226), "contradicts"),
    ((50_284, 58_190, 67_583), (66_206, 66_216, 66_226), "too few"),
    ((64_500, 66_000, 67_500), (66_206, 66_216, 66_226), ""),
    # both are as wide: it tells no less than the whole map
    ((50_284, 58_190, 67_583), (52_206, 60_216, 68_226), ""),
])
def test_what_a_held_out_part_may_contradict(part, whole, reason):
    def known(of):
        return Homogeneity(0.2, 1e-6, np.array([1.0, 0, 0]), 1e-6, of[1], 4 * of[1], of, of, ())

    said = not_carried(known(part), known(whole))
    assert reason in said if reason else not said


def test_solid_harmonics_are_harmonic_fields(generator):
    """Their divergence and curl vanish, and each is independent of the others."""
    points, step = 0.4 * generator.standard_normal((6, 3)), 1e-5
    gradient = np.stack([(solid_harmonic_fields(points + step * unit, 6) - solid_harmonic_fields(
        points - step * unit, 6)) / (2 * step) for unit in np.eye(3)], axis=-1)
    rounding = 1e-8 * np.abs(gradient).max()
    assert np.abs(np.einsum("nckc->nk", gradient)).max() < rounding
    assert np.abs(gradient - gradient.transpose(0, 3, 2, 1)).max() < rounding
    # control: x^2 along x is no such field
    assert np.abs(gradient + gradient.transpose(0, 3, 2, 1)).max() > 1e3 * rounding
    sphere, weights = sphere_points(14)
    fields = solid_harmonic_fields(sphere, 6)
    products = np.einsum("n,nck,ncl->kl", weights, fields, fields)
    assert products == pytest.approx(np.eye(48), abs=1e-12)


def test_readings_that_are_all_far_from_the_centre(generator, tmp_path, errors):
    """A fit about the centre has none of them: nothing is told, and that is said."""
    away = np.array([0.0, 0.0, 0.13])
    points = np.vstack([GRID[::4] + away, GRID[::4] - away])
    far = field_map(points, true_field(1, points, errors=errors))
    found = homogeneity(build_magnet(study()), Session.open(tmp_path), REGION, data=far)
    assert not found.of_map
    assert "no readings within" in " ".join(found.map_remarks)
    assert "if all blocks are as ordered. The map has no readings within" in answer(found).said


def test_a_fit_that_goes_through_all_readings(tmp_path):
    """Of circles 11 mm off cubes of 12 mm the fit left a thousandth of the noise, and its mean of
    |B| was 0.35 mT off with a bar of 4 µT. Control: circles with a third of the radius.
    """
    ring = halbach_ring(blocks=8, inner_radius_m=0.034, outer_radius_m=0.046, length_m=0.012,
                        shape="cuboid")
    for radius, told in ((0.0227, False), (0.008, True)):
        angle, z = np.meshgrid(2 * np.pi * np.arange(16) / 16, np.linspace(-0.02, 0.02, 6))
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1).reshape(-1, 3)
        noise = 1e-5 * np.random.default_rng(3).standard_normal(points.shape)
        found = homogeneity(ring, Session.open(tmp_path / str(told)), Region.sphere(0.004),
                            data=field_map(points, ring.field_T(points) + noise, sigma_T=1e-5))
        assert (MAP in found.of_map) == told
        assert ("goes through all of them" in str(found.map_remarks)) != told


def test_a_region_beyond_the_readings_of_the_fit(generator, tmp_path, errors):
    """The map reaches as far as the region, its fit not: it was said to leave open 10024687 ppm "of
    3537366 ppm", where magpylib has 373000. Beside it a cylinder that the fit does reach.
    """
    places = 0.01 * np.stack(np.meshgrid(*2 * [np.arange(-2, 3)], np.arange(-16, 17),
                                         indexing="ij"), axis=-1).reshape(-1, 3)
    field = true_field(1, places, errors=errors)
    data = field_map(places, field + NOISE_T * generator.standard_normal(field.shape))
    magnet, session = build_magnet(study()), Session.open(tmp_path)
    found = homogeneity(magnet, session, Region("cylinder", (0.02, 0.02, 0.15)), data=data)
    assert not found.of_map
    (said,) = found.map_remarks
    assert "within 75 mm of the region's centre" in said  # three quarters of 100 mm
    assert "z of the readings goes from -70 to 70 mm, less far than the region" in said
    assert "ppm" not in said
    short = homogeneity(magnet, session, Region("cylinder", (0.02, 0.02, 0.06)), data=data)
    assert not short.map_remarks
    assert short.of_map[MAP].rms_ppm == pytest.approx(
        rms_of(magnet, Region("cylinder", (0.02, 0.02, 0.06)), errors), rel=2e-3)


def rms_of(magnet, region, errors):
    """The deviation of magpylib's |B| in a region, in ppm."""
    sampling = region_points(magnet, region)
    size = np.linalg.norm(true_field(1, sampling.points, errors=errors), axis=1)
    mean = float(sampling.weights @ size)
    return 1e6 * float(np.sqrt(sampling.weights @ (size / mean - 1)**2))


def test_what_readings_leave_open_has_no_numbers(generator, tmp_path, errors):
    """A noisy map: the numbers of its fit were those of a prior, and far from the truth."""
    magnet = build_magnet(study(noise_T=0.3))
    found = homogeneity(magnet, Session.open(tmp_path), REGION,
                        data=measured(generator, errors, 0.3))
    assert not found.of_map
    assert all("too few or too noisy ones" in said and "ppm" not in said
               for said in found.map_remarks)


def test_regions_beyond_the_map_are_refused(generator, tmp_path, errors):
    with pytest.raises(MeasurementError, match="within its points"):
        homogeneity(build_magnet(study()), Session.open(tmp_path), Region.sphere(0.05),
                    data=measured(generator, errors))


def test_a_gain_that_is_not_known_is_in_the_mean(generator, tmp_path, errors):
    """The map is 2 % too strong: by itself it does not tell that from the field."""
    data = measured(generator, errors)
    strong = data.assign(B_T=1.02 * data["B_T"])
    sampling = region_points(build_magnet(study()), REGION)
    points, weights = sampling.points, sampling.weights
    mean = float(weights @ np.linalg.norm(true_field(1, points, errors=errors), axis=1))
    amplitude = {"name": "gain", "sd": 0.02, "change": {
        f"instrument.gain[{axis}]": 1.0 for axis in (1, 2, 3)}}
    magnets = (build_magnet(study().with_(inference={}, **open_)) for open_ in (
        {"instrument_sd": {"gain": 0.02}}, {"uncertain": [amplitude]}, {}))
    known, together, exact = (homogeneity(
        magnet, Session.open(tmp_path), REGION, data=strong).of_map[MAP] for magnet in magnets)
    assert together.mean_sd_T == pytest.approx(0.02 * together.mean_T, rel=0.1)
    assert known.mean_T == pytest.approx(mean, abs=3 * known.mean_sd_T)
    # Maxwell's equations tie the three gains to each other, which leaves their mean
    assert known.mean_sd_T == pytest.approx(0.02 / np.sqrt(3) * known.mean_T, rel=0.1)
    # what all readings share is no deviation
    assert known.rms_ppm == pytest.approx(exact.rms_ppm, rel=0.05)
    # the control: the probe as exact
    assert abs(exact.mean_T - mean) > 100 * exact.mean_sd_T
