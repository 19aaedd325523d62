"""Points on faces and edges, in any pose: the field there against magpylib, and what is refused."""

from __future__ import annotations

import warnings

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.outline import outline_contains, ring_radii
from halbach_fe.geometry.surface import ON_SURFACE
from halbach_fe.inference.campaign_readings import read_campaign
from halbach_fe.measurement.campaign_maps import maps_of
from halbach_fe.measurement.field_map import field_map
from halbach_fe.report.solution_page import answer
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.response.solution import solve, study_observation
from halbach_fe.solver.exact_block_field import field_of, gradient_of
from halbach_fe.solver.routes import check_points
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed
from tests.geometry.test_free_blocks import LENGTH, SHAPES, magnet_of, row, source

BESIDE_M = 1e-6
"""Distances in m outside a face, of which magpylib's field is extrapolated linearly to the face,
are this and twice this. Its segments of rings are 1e-3 T wrong at some nanometres from a face."""

FACE_ERROR = 3e-6
"""In T, for points at least 2 mm from an edge: the extrapolation errs by about 1.3 T times the
square of 1 um / 2 mm, our own displacement makes 3e-8 T, and magpylib's segments err by 1e-6 T."""


def just_outside(reference, points, outward):
    """B in T of a body of magpylib at points on its faces, from outside."""
    near, far = (MU_0 * reference.getH(points + step * BESIDE_M * outward) for step in (1, 2))
    return 2 * near - far


def surfaces(outline):
    """Edges of an outline that are surfaces of the block: the seam of a ring is none."""
    return [edge for edge in outline if edge.arc] if ring_radii(outline) else outline


def places_on_faces(outline, generator, each=3):
    """Points on all faces of a block, with their outward normals, in its frame; none near edges."""
    points, normals = [], []
    for edge in surfaces(outline):
        t = generator.uniform(0.25, 0.75, each)
        place, normal = edge.at(t)
        points.append(np.column_stack([place, LENGTH * generator.uniform(-0.4, 0.4, each)]))
        normals.append(np.column_stack([
            normal / np.linalg.norm(normal, axis=1)[:, None], np.zeros(each)]))
    corners = np.array([edge.start for edge in outline])
    middle = corners.mean(axis=0)
    if not outline_contains(outline, middle[None])[0]:  # a long sector
        middle = np.mean([outline[0].start, outline[0].end], axis=0)
        turn = Rotation.from_euler("z", 60, degrees=True).as_matrix()[:2, :2]
        middle = turn @ middle
    for sign in (-1.0, 1.0):
        place = middle + generator.uniform(-1e-3, 1e-3, (each, 2))
        points.append(np.column_stack([place, np.full(each, sign * LENGTH / 2)]))
        normals.append(np.tile([0.0, 0.0, sign], (each, 1)))
    return np.vstack(points), np.vstack(normals)


def turned(kind, generator, **values):
    """A block in a random pose, and that pose; and the same body of magpylib."""
    rotation = Rotation.random(random_state=generator)
    place = generator.uniform(-1, 1, 3)
    degrees = rotation.as_rotvec(degrees=True)
    polarization = generator.normal(size=3)
    polarization *= 1.3 / np.linalg.norm(polarization)
    magnet = magnet_of(row(kind, x_m=place[0], y_m=place[1], z_m=place[2],
                           rotation_x_deg=degrees[0], rotation_y_deg=degrees[1],
                           rotation_z_deg=degrees[2], remanence_T=None, **values,
                           **{f"remanence_{axis}_T": value
                              for axis, value in zip("xyz", polarization, strict=True)}))
    reference = source(kind)
    reference.position, reference.orientation = place, rotation
    reference.polarization = rotation.inv().apply(polarization)
    return magnet, place, rotation, reference


@pytest.mark.parametrize("kind", SHAPES)
def test_field_on_faces_is_that_outside(kind, generator):
    """All faces of all shapes in random poses, moved by rounding errors to both sides."""
    for _ in range(5):
        magnet, place, rotation, reference = turned(kind, generator)
        block, = magnet.blocks
        own, normals = places_on_faces(block.outline, generator)
        points, outward = rotation.apply(own) + place, rotation.apply(normals)
        expected = just_outside(reference, points, outward)
        rounding = 1e-16 * generator.integers(-20, 20, (len(points), 1))
        with pytest.warns(HalbachWarning, match="lie on a face of magnet or iron, the first on b"):
            checked = check_points(magnet, points + rounding * outward)
        np.testing.assert_allclose(field_of(magnet.blocks, checked), expected, atol=FACE_ERROR)
        # the field of a block itself is that outside too, whoever asks
        np.testing.assert_allclose(field_of(magnet.blocks, points + rounding * outward), expected,
                                   atol=FACE_ERROR)
        # the control: what is inside differs
        inside = field_of(magnet.blocks, points - 1e-6 * outward)
        assert np.abs(inside - expected).max() > 0.3
        assert magnet.contains(points - 1e-6 * outward).all()


def test_cubes_that_slipped_through(generator):
    """A float comparison of rotated coordinates let 17 of 40 points on faces pass, wrong by J/2."""
    wrong = 0
    for _ in range(40):
        magnet, place, rotation, reference = turned("cuboid", generator)
        points = rotation.apply(np.array([[0.01, 0, 0]])) + place
        outward = rotation.apply([1.0, 0, 0])
        with pytest.warns(HalbachWarning):
            checked = check_points(magnet, points)
        found = field_of(magnet.blocks, checked)
        wrong += np.abs(found - reference.getB(points + 1e-9 * outward)).max() > FACE_ERROR
    assert wrong == 0


def test_near_a_face_nothing_changes(generator):
    """0.1 um and 1 nm outside are outside, and so far inside are inside."""
    magnet, place, rotation, reference = turned("cuboid", generator)
    own = np.array([[0.01, 0.003, 0.002]])
    for distance in (1e-7, 1e-9):
        points = rotation.apply(own + np.array([distance, 0, 0])) + place
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.array_equal(check_points(magnet, points), points)
        np.testing.assert_allclose(field_of(magnet.blocks, points), [reference.getB(points[0])],
                                   atol=1e-9)
        inside = rotation.apply(own - np.array([distance, 0, 0])) + place
        with pytest.raises(StudyError, match="inside magnet or iron"):
            check_points(magnet, inside)


@pytest.mark.parametrize("kind", SHAPES)
def test_edges_are_refused(kind, generator):
    """Edges of end faces and along the block, corners; smooth seams of cylinders and rings not."""
    magnet, place, rotation, _ = turned(kind, generator)
    outline = magnet.blocks[0].outline
    t = np.array([0.3])
    rim = [[*edge.at(t)[0][0], LENGTH / 2] for edge in surfaces(outline)]
    upright = [[*edge.start, 0.001] for edge in surfaces(outline)]
    for own in rim + upright:
        points = rotation.apply(np.array([[0.3, 0.4, 0.5], own])) + place
        if kind in ("cylinder", "ring sector") and own in upright:
            with pytest.warns(HalbachWarning, match="1 of 2 points lie on a face"):
                check_points(magnet, points)
            continue
        if kind == "long sector" and own in upright and magnet.contains(points).sum() == 0:
            assert np.hypot(*own[:2]) in (pytest.approx(0.01), pytest.approx(0.02))
            continue  # its arcs are cut in three
        with pytest.raises(StudyError, match=r"on an edge of b, where the field is infinite, the "
                                             r"first at .* Move them off the edge"):
            check_points(magnet, points)
        # the control: what the sentence advises works
        away = own / np.linalg.norm(own) * 1e-4 if kind in ("cuboid", "cylinder") else [0, 0, 3e-2]
        check_points(magnet, points + rotation.apply([np.zeros(3), away]))


def test_between_blocks_that_touch():
    two = {"name": ["a", "b"], "shape": ["cuboid"] * 2, "x_m": [0.0, 0.02], "y_m": [0.0, 0.0],
           "z_m": [0.0, 0.0], "size_x_m": [0.02] * 2, "size_y_m": [0.02] * 2,
           "size_z_m": [0.02] * 2, "remanence_T": [1.3, 1.2]}
    magnet = magnet_of(two)
    with pytest.raises(StudyError, match=r"1 of 2 points lie between a and b, which touch there, "
                                         r"so that it is not in air, the first at "
                                         r"\(0\.01, 0\.001, 0\)"):
        check_points(magnet, np.array([[0.1, 0, 0], [0.01, 0.001, 0]]))
    # the control: the outer face of one of them
    with pytest.warns(HalbachWarning, match="the first on b"):
        check_points(magnet, np.array([[0.03, 0.001, 0]]))


def test_a_seam_of_blocks_that_are_alike():
    """The field is finite there, if both are really alike; what the sentence advises works."""
    def bar(x_m, size_x_m):
        count = len(x_m)
        return magnet_of({
            "name": ["a", "b"][:count], "shape": ["cuboid"] * count, "x_m": x_m,
            "y_m": [0.0] * count, "z_m": [0.0] * count, "size_x_m": [size_x_m] * count,
            "size_y_m": [0.02] * count, "size_z_m": [0.02] * count,
            "remanence_x_T": [0.0] * count, "remanence_y_T": [0.0] * count,
            "remanence_z_T": [1.3] * count})

    whole = magpylib.magnet.Cuboid(dimension=(0.04, 0.02, 0.02), polarization=(0.0, 0.0, 1.3),
                                   position=(0.01, 0.0, 0.0))
    seam = np.array([[0.01, 0.002, 0.01]])
    beside = seam + np.array([1e-4, 0.0, 0.0])
    split = bar([0.0, 0.02], 0.02)
    with pytest.raises(StudyError, match="on an edge of a and b, where the field is infinite, "
                                         "unless they are magnetized alike and flush"):
        check_points(split, seam)
    for magnet, points in ((split, beside), (bar([0.01], 0.04), seam)):
        with pytest.warns(HalbachWarning, match="1 of 1 points lie on a face"):
            found = field_of(magnet.blocks, check_points(magnet, points))
        np.testing.assert_allclose(found, [just_outside(whole, points, np.array([[0, 0, 1.0]]))],
                                   atol=FACE_ERROR)


def test_faces_of_iron():
    """Of a tube: the inner and the outer face are faces, a rim is an edge."""
    magnet = build_magnet(parse_study(changed(
        DIPOLE, dimension=3, array__rings=1, array__ring_length_m=0.08,
        mesh={"block_size_m": 0.03, "layers_per_ring": 2, "growth": 2.0},
        iron_ring={"inner_radius_m": 0.2, "outer_radius_m": 0.21,
                   "relative_permeability": 100.0})))
    angle = 0.7
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    for radius, sign in ((0.2, -1), (0.21, 1)):
        places = magnet.surroundings(radius * along[None])
        assert (places.faces[0], places.names[0]) == (1, ["the iron"])
        assert not places.inside[0]
        assert sign * (np.linalg.norm(places.points[0]) - radius) == pytest.approx(
            ON_SURFACE * 0.42, rel=1e-3)
        assert magnet.surroundings((radius * along + [0, 0, 0.04])[None]).on_edge[0]
    assert magnet.surroundings(0.205 * along[None]).inside[0]


FACE = {"name": "face", "dimension": 3, "array": {"recoil_permeability": 1.0, "free_blocks": {
    "name": ["a"], "shape": ["cuboid"], "x_m": [0.04], "y_m": [0.0], "z_m": [0.0],
    "size_x_m": [0.02], "size_y_m": [0.02], "size_z_m": [0.02], "remanence_T": [1.3]}},
    "mesh": {"block_size_m": 0.005}, "noise": {"regions": [{"name": "all", "sigma_T": 1e-4}]},
    "observation": {"quantity": "flux_density", "positions": {
        "kind": "points", "points_m": [[0.05, 0, 0], [0.0500001, 0, 0]]}}}

POLE_T = 0.5666775
"""Bx on the pole face of a cube of 1.3 T: J/2 plus the far face's field, magpylib 1 nm outside."""


def test_readings_of_all_verbs(session):
    """`solve`, the response matrix of `infer` and `homogeneity`, and a map read by `infer`."""
    magnet = build_magnet(parse_study(FACE))
    with pytest.warns(HalbachWarning, match="1 of 2 points lie on a face"):
        solution = solve(magnet, session)
    assert solution.readings[0] == pytest.approx(POLE_T, abs=1e-6)
    np.testing.assert_array_equal(solution.points[0], [0.05, 0, 0])  # as the study states it
    with pytest.warns(HalbachWarning, match="1 of 2 points"):
        response = response_matrix(magnet, study_observation(magnet), session)
    assert (response.offset + response.matrix @ response.nominal)[0] == pytest.approx(
        POLE_T, abs=1e-6)
    data = field_map(solution.points, solution.flux_density)
    with pytest.warns(HalbachWarning, match="1 of 2 points"):
        readings = read_campaign(magnet, maps_of(magnet.study, data))
    assert field_of(magnet.blocks, readings.observation.points)[0, 0] == pytest.approx(
        POLE_T, abs=1e-6)
    edge = field_map(np.array([[0.05, 0, 0.01]]), np.ones((1, 3)))
    with pytest.raises(MeasurementError, match="on an edge of a, where the field is infinite"):
        read_campaign(magnet, maps_of(magnet.study, edge))


def test_positions_in_mm(session):
    """31 times as far from the middle as the magnet reaches: the answer asks for the unit."""
    far = changed(FACE, observation__positions__points_m=[[0, 0, 1.6], [0, 0, 30]])
    question = "1 of 2 points lie up to 30 m from the origin, from which the magnet reaches to 0.05"
    with pytest.warns(HalbachWarning, match=question):
        said = answer(solve(build_magnet(parse_study(far)), session))
    assert question in said.trust
    assert not said.sound
    near = changed(FACE, observation__positions__points_m=[[0, 0, 1.58]])
    assert answer(solve(build_magnet(parse_study(near)), session)).trust.startswith("Yes")


def test_permeable_block(session):
    """On the route of moments the field on a face is that 1 um outside, to its own change.

    The point is off the middle of the face, where four parts of cells meet.
    """
    values = changed(FACE, array__recoil_permeability=1.05, observation__positions__points_m=[
        [0.05, 0.001, 0.002], [0.050001, 0.001, 0.002]])
    with pytest.warns(HalbachWarning, match="1 of 2 points lie on a face"):
        solution = solve(build_magnet(parse_study(values)), session)
    on_face, beside = solution.flux_density
    np.testing.assert_allclose(on_face, beside, atol=2e-4)  # 1.3 T / 20 mm * 1 um = 7e-5 T
    assert on_face[0] > 0.5


def test_gradient_on_a_face():
    """Steps do not lead into the block, where its field jumps: they would make 1e5 T/m."""
    magnet = build_magnet(parse_study(FACE))
    points = np.array([[0.05, 0.0, 0.0], [0.0500001, 0.001, 0.0]])
    step = 1e-6
    along = [(field_of(magnet.blocks, points + 2 * step * axis)
              - field_of(magnet.blocks, points + step * axis)) / step for axis in np.eye(3)]
    found = gradient_of(magnet.blocks, points)
    # one-sided steps of 3 um err by their length over 20 mm; half of it is the comparison's
    np.testing.assert_allclose(found[:, :, 0], along[0], atol=0.02 * np.abs(along[0]).max())
    assert np.abs(found).max() < 100
