"""Readings: selections, Fourier coefficients, noise, held-out patterns."""

from __future__ import annotations

import tomllib
from types import SimpleNamespace

import magpylib
import numpy as np
import pytest

from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.observation_operator import (
    concatenate,
    flux_density_at,
    held_out_readings,
    observe,
)
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.reading_noise import reading_noise
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.hidden_effects.instrument_effects import stated_places
from halbach_fe.synthetic.simulate import real_places
from tests.conftest import changed, circle
from tests.support.short_dipole import TEXT as SHORT
from tests.support.short_dipole import truth as short_dipole_truth

FOURIER = {"quantity": "fourier_coefficients", "harmonics": 5,
           "positions": {"kind": "circles", "radius_m": 0.075, "angles": 24}}


def multipole_field(points, n, normal, skew):
    """B_r = (normal cos n phi + skew sin n phi) and its tangential partner, as (x, y, z)."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    radial = normal * np.cos(n * angle) + skew * np.sin(n * angle)
    tangential = -normal * np.sin(n * angle) + skew * np.cos(n * angle)
    return np.column_stack([radial * np.cos(angle) - tangential * np.sin(angle),
                            radial * np.sin(angle) + tangential * np.cos(angle), 0 * angle])


@pytest.mark.parametrize("order", [1, 3, 5])
def test_fourier_coefficients_of_a_pure_multipole(dipole, order, generator):
    points = circle(0.075)[generator.permutation(24)]  # any order of points
    observation = observe(dipole(observation=FOURIER), points, np.ones((24, 3), bool))
    readings = dict(zip(observation.labels, observation.apply(
        multipole_field(points, order, 0.3, -0.2)), strict=True))
    expected = dict.fromkeys(observation.labels, 0.0) | {f"A{order}": 0.3, f"B{order}": -0.2}
    assert readings == pytest.approx(expected, abs=1e-14)


def test_circles_of_several_radii(dipole, generator):
    """Each reading tells its radius and z; the amplitude of each harmonic is its own circle's."""
    study = dipole(observation=changed(FOURIER, positions__radius_m=[0.075, 0.05]))
    points = points_from(study.observation.positions.with_(z_min_m=-0.1, z_max_m=0.1, count=2))
    assert points.shape == (96, 3)
    field = multipole_field(points, 3, 0.3, -0.2) * np.hypot(*points[:, :2].T)[:, None]
    field *= 1 + points[:, 2:]
    order = generator.permutation(96)  # any order of points
    observation = observe(study, points[order], np.ones((96, 3), bool))
    assert len(observation) == 40
    found = observation.apply(field[order])
    assert len({(label, radius, z) for label, radius, z in zip(
        observation.labels, observation.radii, observation.positions[:, 2], strict=True)}) == 40
    for label, part in (("A3", 0.3), ("B3", -0.2), ("A1", 0.0)):
        rows = np.array(observation.labels) == label
        assert sorted(observation.radii[rows]) == pytest.approx([0.05, 0.05, 0.075, 0.075])
        z = observation.positions[rows, 2]
        assert found[rows] == pytest.approx(part * observation.radii[rows] * (1 + z), abs=1e-15)
    third = np.array([label[1:] == "3" for label in observation.labels])
    size = observation.magnitude(field[order])
    assert size[third] == pytest.approx(np.hypot(0.3, 0.2) * (
        observation.radii * (1 + observation.positions[:, 2]))[third])
    assert size[~third] == pytest.approx(0, abs=1e-15)
    with pytest.raises(MeasurementError, match=r"on circles of radius 0\.075, 0\.05 m"):
        observe(study, circle(0.06), np.ones((24, 3), bool))
    with pytest.raises(MeasurementError, match=r"circle of radius 0\.05 m at z = -0\.1 m"):
        observe(study, np.delete(points, 60, axis=0), np.ones((95, 3), bool))


def test_largest_readings(dipole, generator):
    """No field of given lengths is read larger, in any order; one along the sensors is as large."""
    order = generator.permutation(24)
    circle_of = observe(dipole(observation=FOURIER), circle(0.075)[order], np.ones((24, 3), bool))
    points = flux_density_at(circle(0.075))
    lengths = generator.uniform(0.5, 2.0, 24)
    directions = generator.normal(size=(500, 24, 3))
    fields = directions / np.linalg.norm(directions, axis=2)[..., None] * lengths[:, None]
    assert points.largest(lengths) == pytest.approx(np.repeat(lengths, 3))
    assert (np.abs(circle_of.apply(fields)) <= circle_of.largest(lengths)).all()
    for harmonic in (1, 2, 5):
        row = circle_of.labels.index(f"A{harmonic}")
        radial = multipole_field(circle_of.points, harmonic, 1.0, 0.0)
        radial = circle_of.points * [1, 1, 0] / 0.075 * np.sign(
            np.sum(radial * circle_of.points, axis=1))[:, None] * lengths[:, None]
        assert circle_of.apply(radial)[row] == pytest.approx(circle_of.largest(lengths)[row])


def test_grid_of_points(dipole):
    """z changes fastest and x slowest; another order is told apart."""
    positions = dipole(observation__positions={
        "kind": "grid", "start_m": [0, -0.02, 0.5], "end_m": [0.01, 0.02, 0.5],
        "count": [2, 3, 1]}).observation.positions
    points = points_from(positions)
    expected = [[0, -0.02, 0.5], [0, 0, 0.5], [0, 0.02, 0.5],
                [0.01, -0.02, 0.5], [0.01, 0, 0.5], [0.01, 0.02, 0.5]]
    np.testing.assert_allclose(points, expected, atol=1e-17)
    assert not np.allclose(points[np.lexsort(points.T)], expected)  # x fastest


def test_fourier_needs_full_circles_of_the_radius(dipole):
    study = dipole(observation=FOURIER)
    full = np.ones((24, 3), bool)
    for points in (circle(0.07), circle(0.075) * [1, 1.01, 1]):
        with pytest.raises(MeasurementError, match="radius"):
            observe(study, points, full)
    with pytest.raises(MeasurementError, match="equally spaced"):
        observe(study, circle(0.075)[1:], full[1:])
    with pytest.raises(MeasurementError, match="Bx and By"):
        observe(study, circle(0.075), full & [True, False, True])


def test_flux_density_takes_what_was_measured(dipole):
    study = dipole(observation__components=["x", "z"])
    measured = np.array([[True, True, False], [False, True, True]])
    observation = observe(study, np.eye(3)[:2], measured)
    assert observation.labels == ("Bx", "Bz")
    assert observation.apply(np.arange(6.0).reshape(2, 3)).tolist() == [0, 5]
    with pytest.raises(MeasurementError, match="none of them"):
        observe(study, np.eye(3)[:1], np.array([[False, True, False]]))


def test_noise_by_region_and_from_the_map(dipole):
    regions = [{"name": "body", "z_min_m": -0.1, "z_max_m": 0.1, "sigma_T": 1e-5},
               {"name": "rest", "sigma_T": 1e-3}]
    study = dipole(noise={"regions": regions})
    points = np.array([[0, 0, 0.0], [0, 0, 0.2]])
    observation = observe(study, points, np.ones((2, 3), bool))
    data = field_map(points, np.ones((2, 3)))
    assert reading_noise(build_magnet(study), observation,
                         data).sd == pytest.approx([1e-5] * 3 + [1e-3] * 3)
    data["sigma_T"] = (("point", "component"), np.full((2, 3), 7e-5))
    assert reading_noise(build_magnet(study), observation, data).sd == pytest.approx(7e-5)
    with pytest.raises(StudyError, match="cover every reading"):
        reading_noise(build_magnet(dipole(noise={"regions": regions[:1]})), observation,
                            data.drop_vars("sigma_T"))
    with pytest.raises(StudyError, match="how noisy"):
        reading_noise(build_magnet(dipole()), observation, data.drop_vars("sigma_T"))


def test_noise_by_component(dipole):
    """The first region that fits a reading counts; what is in none is named."""
    regions = [{"name": "body", "z_min_m": -0.1, "z_max_m": 0.1, "components": ["x", "z"],
                "sigma_T": 1e-5},
               {"name": "body", "z_min_m": -0.1, "z_max_m": 0.1, "sigma_T": 2e-5},
               {"name": "rest", "components": ["z"], "sigma_T": 1e-3},
               {"name": "rest", "components": ["x", "y"], "sigma_T": 2e-3}]
    points = np.array([[0, 0, 0.0], [0, 0, 0.2]])
    data = field_map(points, np.ones((2, 3)))

    def noise(some):
        study = dipole(noise={"regions": some})
        return reading_noise(build_magnet(study), observe(study, points, np.ones((2, 3), bool)),
                             data)

    assert noise(regions).sd == pytest.approx([1e-5, 2e-5, 1e-5, 2e-3, 2e-3, 1e-3])
    assert noise(regions[:0:-1]).sd == pytest.approx([2e-3, 2e-3, 1e-3] * 2)
    with pytest.raises(StudyError, match="holds all of 'body'"):
        noise(regions[::-1])
    with pytest.raises(StudyError, match=r"z = 0\.2 m, component x, is in none"):
        noise(regions[:3])


NEAR_END = circle(0.075, 12, 0.07)
POSITION_SD = (3e-4, 1e-5, 1e-4)


@pytest.fixture(scope="module")
def displaced(short_dipole):
    """B (1500, 12, 3) of the blocks at points that are each moved at random."""
    moved = NEAR_END + POSITION_SD * np.random.default_rng(2).standard_normal((1500, 12, 3))
    return field_of(build_magnet(short_dipole()).blocks, moved.reshape(-1, 3)).reshape(moved.shape)


@pytest.mark.parametrize("quantity", ["flux_density", "fourier_coefficients"])
@pytest.mark.parametrize("from_map", [True, False])
def test_noise_of_positions(short_dipole, displaced, generator, quantity, from_map):
    """Against the exact field at displaced points near the magnet's end; 1500 draws know a
    covariance over the two sd's to 3.7 %, 5 sigma. (The field's curvature adds far less.)
    Components of one point taken as independent are told apart, and so is another axis.
    """
    changes = {"noise": {"regions": [{"name": "all", "sigma_T": 1e-5}],
                         "position_sd_m": POSITION_SD}}
    if quantity == "fourier_coefficients":
        changes["observation"] = FOURIER
    study = short_dipole(**changes)
    observation = observe(study, NEAR_END, np.ones((12, 3), bool))
    sigma = np.full((12, 3), 2e-5)
    data = field_map(NEAR_END, np.ones((12, 3)), sigma if from_map else None)
    noise = reading_noise(build_magnet(study), observation, data)
    draws = observation.apply(displaced)
    own = (observation.apply(2e-5 * generator.standard_normal((1500, 12, 3))) if from_map
           else 1e-5 * generator.standard_normal(draws.shape))
    scale = np.outer(noise.sd, noise.sd)
    covariance = np.cov((draws + own).T) / scale
    np.testing.assert_allclose(noise.covariance.toarray() / scale, covariance, atol=0.185)
    assert not noise.independent
    assert np.abs(np.eye(len(scale)) - covariance).max() > 0.5
    turned = short_dipole(**changes | {"noise": changes["noise"] | {
        "position_sd_m": POSITION_SD[-1:] + POSITION_SD[:-1]}})
    other = reading_noise(build_magnet(turned), observation, data).covariance.toarray()
    assert np.abs(other / scale - covariance).max() > 0.3


def test_positions_scatter_along_the_axes_of_the_stage(short_dipole, generator):
    """Of a stage that is turned by 80 degrees in the magnet, by the simulator's law of places, as
    above. Noise along the axes of the magnet is the control: it was that.
    """
    study = short_dipole(
        instrument={"rotation_rad": [0.0, 1.4, 0.0]},
        noise={"regions": [{"name": "all", "sigma_T": 1e-6}], "position_sd_m": POSITION_SD})
    magnet = build_magnet(study)
    turn = rotation_matrix(study.instrument.rotation_rad)
    stated = circle(0.075, 12, 0.07) @ turn  # in the coordinates of the stage
    noise, along_magnet = (reading_noise(each, observe(
        each.study, points, np.ones((12, 3), bool)), field_map(points, np.ones((12, 3))))
        for each, points in ((magnet, stated), (magnet.with_(instrument={}), stated @ turn.T)))
    draws = []
    for _ in range(1500):
        places = stated_places(study.instrument, real_places(study, stated, generator))
        draws.append((field_of(magnet.blocks, places[0]) @ turn).ravel())
    covariance, scale = np.cov(np.array(draws).T), np.outer(noise.sd, noise.sd)
    np.testing.assert_allclose(noise.covariance.toarray() / scale, covariance / scale, atol=0.185)
    turned = np.kron(np.eye(12), turn.T)
    other = turned @ along_magnet.covariance.toarray() @ turned.T
    assert np.abs((other - covariance) / scale).max() > 0.5


def loops(radius_m, z_m, side_m, ampere_turns):
    """A coil of a square section by magpylib, as 5 x 5 loops."""
    places = side_m * np.linspace(-0.4, 0.4, 5)
    return magpylib.Collection(*(magpylib.current.Circle(
        current=ampere_turns / 25, diameter=2 * (radius_m + across), position=(0, 0, z_m + along))
        for across in places for along in places))


COIL = {"kind": "round", "current_A": 5.0, "turns": 1000, "radius_m": 0.06, "centre_m": [0, 0, 0.1],
        "section_m": [0.004, 0.004]}


@pytest.mark.parametrize("external", [
    {"neighbours": [{"z_m": 0.085}]}, {"coils": [COIL]},
    {"dipoles": [{"position_m": [0.0, 0.0, 0.1], "moment_A_m2": [3.0, 0.0, 30.0]}]}])
def test_noise_of_positions_in_the_gradient_of_external_sources(external):
    """By differences of magpylib's field. The noise was that of the magnet's blocks alone, which is
    the control.
    """
    exact = SimpleNamespace(standard_normal=lambda: 0.0)  # blocks without errors
    sources = [short_dipole_truth(exact)]
    if "neighbours" in external:
        sources.append(short_dipole_truth(exact).move((0, 0, 0.085)))
    if "coils" in external:
        sources.append(loops(0.06, 0.1, 0.004, 5000.0))
    if "dipoles" in external:
        sources.append(magpylib.misc.Dipole(
            moment=(3.0, 0.0, 30.0), position=(0, 0, 0.1)))
    points = np.array([[0.0, 0.0, 0.045], [0.005, 0.003, 0.05], [-0.004, 0.006, 0.04]])
    sd, step = np.array([1e-4, 2e-4, 3e-4]), 1e-5
    gradient = np.stack([sum(source.getB(points + step * axis) - source.getB(points - step * axis)
                             for source in sources) / (2 * step) for axis in np.eye(3)], axis=2)
    study = parse_study(tomllib.loads(SHORT) | {"external": external, "noise": {
        "regions": [{"name": "all", "sigma_T": 1e-9}], "position_sd_m": sd.tolist()}})
    noise = reading_noise(build_magnet(study), observe(study, points, np.ones((3, 3), bool)),
                          field_map(points, np.ones((3, 3)))).sd.reshape(3, 3)
    expected = np.linalg.norm(gradient * sd, axis=2)
    # loops in place of a massive coil: 1e-4
    np.testing.assert_allclose(noise, expected, rtol=1e-3, atol=1e-8)
    alone = reading_noise(build_magnet(study.with_(external={})), observe(
        study, points, np.ones((3, 3), bool)), field_map(points, np.ones((3, 3)))).sd.reshape(3, 3)
    assert np.abs(alone / expected - 1).max() > 0.05


def test_one_value_for_all_axes(short_dipole):
    """And noise that is all of positions and the map."""
    points = circle(0.075, 12, 0.08)
    data = field_map(points, np.ones((12, 3)), np.full((12, 3), 1e-5))

    def noise(value):
        study = short_dipole(noise={"position_sd_m": value})
        return reading_noise(build_magnet(study), observe(study, points, np.ones((12, 3), bool)),
                             data)

    one, three = noise(1e-4), noise([1e-4] * 3)
    np.testing.assert_array_equal(one.covariance.toarray(), three.covariance.toarray())
    assert one.sd.max() > 1e-4
    study = short_dipole(noise={"position_sd_m": 1e-4})
    with pytest.raises(StudyError, match="how noisy"):
        reading_noise(build_magnet(study), observe(study, points, np.ones((12, 3), bool)),
                      data.drop_vars("sigma_T"))


@pytest.mark.parametrize("equal", [True, False])
def test_point_noise_propagates_to_fourier_coefficients(dipole, generator, equal):
    """Against sampling. 4000 draws know a covariance, over the two sd's, to at most
    sqrt(2/4000) = 2.2 %; 5 sigma. Unequal noise around the circle correlates the coefficients:
    without that the comparison fails, and equal noise leaves none.
    """
    study = dipole(observation=FOURIER)
    points = np.vstack([circle(0.075, 24, z, z) for z in (0.0, 0.3)])
    observation = observe(study, points, np.ones((48, 3), bool))
    sigma = np.full((48, 3), 1e-4)
    if not equal:
        sigma[:, 0] = 3e-4  # Bx is worse than By
        sigma[:24] *= 1 + 0.8 * np.cos(np.arange(24))[:, None] ** 2
    noise = reading_noise(build_magnet(study), observation,
                          field_map(points, np.ones((48, 3)), sigma))
    draws = observation.apply(sigma * generator.standard_normal((4000, 48, 3)))
    scale = np.outer(noise.sd, noise.sd)
    found = noise.covariance.toarray()
    np.testing.assert_allclose(np.cov(draws.T) / scale, found / scale, atol=0.11)
    alone = np.abs(np.cov(draws.T) - np.diag(noise.sd**2)) / scale
    assert (alone.max() < 0.11) == equal
    assert noise.independent == equal
    assert found[:10, 10:].max() == 0  # circles are independent


def held_out_of(study, points, measured=None):
    points = np.asarray(points, float)
    measured = np.ones((len(points), 3), bool) if measured is None else measured
    return held_out_readings(study, observe(study, points, measured))


def test_held_out_windows(dipole):
    points = [[0, 0, z] for z in (0.0, 0.0, 0.1, 0.2, 0.3, 0.3, 0.4)]
    one = np.array([[True, False, False]] * 7)
    for settings, expected in (({"every": 2}, "0010110"), ({}, "0010110"),
                               ({"every": 2, "window": 2}, "0001110"),
                               ({"window": 2}, "0001110")):
        study = dipole(inference={"held_out": settings})
        assert held_out_of(study, points, one).tolist() == [n == "1" for n in expected]
    assert not held_out_of(dipole(), points).any()


def test_held_out_radii_components_and_ranges(dipole):
    """Each by itself, and together their union."""
    points = np.vstack([circle(radius, 4, z) for radius in (0.05, 0.075) for z in (0, 0.1, 0.2)])
    radius = np.repeat([0.05, 0.075], 36)
    z = np.tile(np.repeat([0, 0.1, 0.2], 12), 2)
    component = np.tile(["x", "y", "z"], 24)
    for settings, expected in (
            ({"radii_m": [0.07502]}, radius == 0.075),  # maps are rounded
            ({"components": ["z", "x"]}, component != "y"),
            ({"z_ranges_m": [[0.1, 0.1]]}, z == 0.1),
            ({"z_ranges_m": [[-1, 0.05], [0.15, 1]]}, z != 0.1),
            ({"every": 3}, z == 0.2),
            ({"every": 3, "radii_m": [0.05], "components": ["y"], "z_ranges_m": [[-1, 0.01]]},
             (z != 0.1) | (radius == 0.05) | (component == "y"))):
        study = dipole(inference={"held_out": settings})
        np.testing.assert_array_equal(held_out_of(study, points), expected)


@pytest.mark.parametrize(("settings", "said"), [
    ({"radii_m": [0.06]}, r"held_out\.radii_m = 0\.06` holds some of them out; .* none"),
    ({"radii_m": [0.05, 0.06]}, r"radii_m = 0\.06`"),
    ({"components": ["y"]}, r"held_out\.components = y`"),
    ({"z_ranges_m": [[0.2, 0.3]]}, r"held_out\.z_ranges_m = 0\.2, 0\.3`"),
    ({"every": 3}, "enough z positions"),
    ({"radii_m": [0.05, 0.075]}, "16, all held out"),
    ({"components": ["x"], "z_ranges_m": [[0, 0.1]]}, "all held out"),
    ({"every": 2, "z_ranges_m": [[0, 0]]}, "all held out")])
def test_held_out_that_leaves_nothing(dipole, settings, said):
    """Neither for the update, nor for the prediction by any of the keys."""
    points = np.vstack([circle(radius, 4, z) for radius in (0.05, 0.075) for z in (0, 0.1)])
    measured = np.tile([True, False, False], (16, 1))
    with pytest.raises(MeasurementError, match=said):
        held_out_of(dipole(inference={"held_out": settings}), points, measured)


def test_two_maps_together(dipole, generator):
    """Readings, and amplitudes too, of a circle that is in both."""
    study = dipole(observation=FOURIER)
    points = circle(0.075)
    one = observe(study, points, np.ones((24, 3), bool))
    both = concatenate(one, one)
    fields = generator.standard_normal((2, 24, 3))
    np.testing.assert_allclose(both.apply(np.vstack(fields)),
                               np.concatenate([one.apply(field) for field in fields]))
    np.testing.assert_allclose(both.magnitude(np.vstack(fields)),
                               np.concatenate([one.magnitude(field) for field in fields]))
    points_too = observe(dipole(), points, np.ones((24, 3), bool))
    mixed = concatenate(one, points_too)
    np.testing.assert_allclose(mixed.magnitude(np.vstack(fields)), np.concatenate(
        [one.magnitude(fields[0]), np.repeat(np.linalg.norm(fields[1], axis=1), 3)]))
    assert mixed.components[len(one):] == ("x", "y", "z") * 24


def test_positions_expand(dipole):
    line = dipole(observation__positions={"kind": "line", "start_m": [0, 0, -1],
                                          "end_m": [0, 0, 1], "count": 3})
    assert points_from(line.observation.positions).tolist() == [[0, 0, -1], [0, 0, 0], [0, 0, 1]]
    rings = dipole(observation__positions={"kind": "circles", "radius_m": 0.05, "angles": 4,
                                           "z_min_m": -0.1, "z_max_m": 0.1, "count": 2})
    points = points_from(rings.observation.positions)
    assert points.shape == (8, 3)
    assert np.hypot(points[:, 0], points[:, 1]) == pytest.approx(0.05)
