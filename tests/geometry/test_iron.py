"""Bodies of iron: where they are, and which are refused."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import warnings
from contextlib import nullcontext
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import gmsh
import numpy as np
import pytest
import tomlkit
from scipy.spatial import KDTree

from halbach_fe.core.errors import HalbachWarning, MeshError, StudyError
from halbach_fe.geo.gmsh_session import gmsh_session
from halbach_fe.geo.iron_mesh import _volume, check_apart
from halbach_fe.geometry.blocks import rotation_about_z, rotation_matrix
from halbach_fe.geometry.iron import _slit
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.iron_keys import closed_surface
from halbach_fe.study.reader import parse_study, read_study
from tests.conftest import DIPOLE, changed, processor_time

SIZE = DIPOLE["array"]["outer_radius_m"]
WEDGE = [[0.2, -0.01], [0.23, -0.02], [0.25, 0.0], [0.23, 0.02], [0.2, 0.01]]


BOX = {"kind": "box", "size_m": [0.1, 0.2, 0.04], "centre_m": [0.0, 0.0, 0.2]}


def magnet_of(make, *bodies, **changes):
    return build_magnet(make(iron={"relative_permeability": 1000.0, "bodies": list(bodies)},
                             **changes))


def tube(inner, outer, **values):
    return {"kind": "tube", "inner_radius_m": inner, "outer_radius_m": outer} | values


def prism(**values):
    return {"kind": "prism", "outline_m": WEDGE} | values


def fraction_inside(body, generator, box=0.3, count=200_000):
    points = generator.uniform(-box, box, (count, 3))
    inside = body.contains(points)
    return inside.mean() * (2 * box) ** 3, points[inside]


@pytest.mark.parametrize(("body", "volume", "limits"), [
    (tube(0.2, 0.25), np.pi * (0.25**2 - 0.2**2) * 0.16, (-0.08, 0.08)),
    (tube(0.2, 0.25, length_m=0.3), np.pi * (0.25**2 - 0.2**2) * 0.3, (-0.15, 0.15)),
    (tube(0.0, 0.25, length_m=0.05, z_m=0.2), np.pi * 0.25**2 * 0.05, (0.175, 0.225)),
    (prism(length_m=0.4, z_m=-0.05), 0.0013 * 0.4, (-0.25, 0.15))])
def test_bodies(short_dipole, generator, body, volume, limits):
    """Monte Carlo, 4 sigma: tube, disc, and a prism whose area is 13 cm^2 by the shoelace formula;
    two rings of 80 mm are 160 mm long.
    """
    x, y = np.array(WEDGE).T
    assert 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) == pytest.approx(0.0013)
    (solid,) = magnet_of(short_dipole, body).iron
    assert (solid.z_min, solid.z_max) == pytest.approx(limits)
    found, inside = fraction_inside(solid, generator)
    assert found == pytest.approx(volume, abs=4 * np.sqrt(volume * 0.6**3 / 200_000))
    radius = np.hypot(inside[:, 0], inside[:, 1])
    assert solid.inner_radius <= radius.min()
    assert radius.max() <= solid.outer_radius
    assert inside[:, 2].min() == pytest.approx(limits[0], abs=0.02)
    assert inside[:, 2].max() == pytest.approx(limits[1], abs=0.02)


def test_copies(dipole, generator):
    """Four poles: each is the first one, turned by quarter turns; and the outline's sense of
    rotation does not matter.
    """
    magnet = magnet_of(dipole, prism(copies=4))
    assert len(magnet.iron) == 4
    assert (magnet.iron[0].z_min, magnet.iron[0].z_max) == (-np.inf, np.inf)
    points = generator.uniform(-0.3, 0.3, (20_000, 3))
    inside = np.array([body.contains(points) for body in magnet.iron])
    assert inside[0].any()
    quarter = points[:, [1, 0, 2]] * [1, -1, 1]  # turned back by 90 degrees
    assert np.array_equal(inside[1], magnet.iron[0].contains(quarter))
    assert not np.array_equal(inside[3], magnet.iron[0].contains(quarter))
    assert (inside.sum(axis=0) <= 1).all()
    reverse = magnet_of(dipole, prism(copies=4, outline_m=WEDGE[::-1]))
    assert np.array_equal([body.contains(points) for body in reverse.iron], inside)
    assert not magnet.iron_is_axisymmetric
    assert magnet.radius == pytest.approx(0.25)


@pytest.mark.parametrize("body", [
    tube(0.02, 0.05, z_m=0.01), prism(copies=2, z_m=0.02, length_m=0.1), BOX,
    {"kind": "sphere", "radius_m": 0.05}], ids=lambda body: body["kind"])
def test_repeated_and_mirrored(short_dipole, generator, body):
    """Eight bodies: two, and their images across z, and the images of all across y."""
    placed = body | {"centre_m": [0.1, 0.4, 0.5], "rotation_deg": [20.0, -40.0, 5.0]}
    step = [0.0, 0.3, 0.4]
    plain = magnet_of(short_dipole, placed).iron
    images = magnet_of(short_dipole, placed | {
        "repeats": 2, "step_m": step, "mirrored": ["z", "y"]}).iron
    assert len(images) == 8 * len(plain)
    points = placed["centre_m"] + generator.uniform(-0.3, 0.3, (2_000, 3))
    inside = np.any([each.contains(points) for each in plain], axis=0)
    assert inside.any()
    for number in range(8):
        sign = [1.0, -1.0 if number & 4 else 1.0, -1.0 if number & 2 else 1.0]
        seen = (points + np.multiply(number & 1, step)) * sign
        some = images[number * len(plain):(number + 1) * len(plain)]
        np.testing.assert_array_equal(
            np.any([each.contains(seen) for each in some], axis=0), inside)
    with pytest.raises(StudyError, match="step_m stands beside repeats"):
        magnet_of(short_dipole, placed | {"step_m": step})
    for wrong in ({"repeats": 2}, {"mirrored": ["y", "y"]}):
        with pytest.raises(StudyError, match="bodies in different places"):
            magnet_of(short_dipole, placed | wrong)
    with pytest.raises(StudyError, match="bodies in different places"):
        magnet_of(short_dipole, BOX | {"mirrored": ["x"]})  # its middle is at x = 0


HOLED = prism(
    outline_m=[[0, 0], [0.4, 0], [0.4, 0.1], [0.1, 0.1], [0.1, 0.3], [0, 0.3]], length_m=0.1,
    holes=[{"x_m": 0.05, "y_m": 0.2, "radius_m": 0.02}, {"x_m": 0.3, "y_m": 0.05,
           "radius_m": 0.02}, {"outline_m": [[0.12, 0.03], [0.18, 0.03], [0.18, 0.06],
                                             [0.12, 0.06]]}],
    centre_m=[0.3, 0.1, 0.4], rotation_deg=[0.0, 0.0, 30.0])
TAPER = {"kind": "revolved", "profile_m": [[0, 0], [0.2, 0], [0.2, 0.05], [0.1, 0.2], [0, 0.2]],
         "centre_m": [0.5, 0.1, 0.1], "rotation_deg": [0.0, 20.0, 0.0]}
CONE = np.pi * (0.2**2 * 0.05 + 0.15 / 3 * (0.2**2 + 0.2 * 0.1 + 0.1**2))


@pytest.mark.parametrize(("body", "volume", "within", "outside"), [
    # area of the L, less the window and two circles
    (HOLED, 0.1 * (0.06 - 0.0018 - 2 * np.pi * 0.02**2), (0.01, 0.01, 0.02),
     [(0.05, 0.2, 0.0), (0.3, 0.05, 0.049), (0.15, 0.045, 0.0), (0.2, 0.2, 0.0)]),
    (TAPER, CONE, (0.0, 0.0, 0.1), [(0.18, 0.0, 0.1), (0.0, 0.0, -0.001)])])
def test_holes_and_profiles(short_dipole, body, volume, within, outside):
    """Volumes by hand, points in holes, and images; Gmsh draws the same volume."""
    for extra in ({}, {"mirrored": ["x"]}, {"mirrored": ["y", "z"]}):
        for solid in magnet_of(short_dipole, body | extra).iron:
            assert solid.measures[0] == pytest.approx(volume, rel=1e-9)
            with gmsh_session("test"):
                assert gmsh.model.occ.getMass(*_volume(solid)) == pytest.approx(volume, rel=1e-9)
    (solid,) = magnet_of(short_dipole, body).iron
    points = np.array([within, *outside]) @ rotation_matrix(solid.turn_rad).T + solid.origin_m
    assert solid.contains(points).tolist() == [True] + [False] * len(outside)
    filled = magnet_of(short_dipole, {key: value for key, value in body.items() if key != "holes"})
    assert filled.iron[0].contains(points).sum() == (4 if body is HOLED else 1)  # the control


def test_a_wrong_drawing_is_told(short_dipole):
    """A hole that Gmsh fills would be a silent error of the field."""
    (solid,) = magnet_of(short_dipole, HOLED).iron
    with pytest.raises(MeshError, match="draws body 1 of iron of study 'test' with"):
        check_apart("test", [replace(solid, holes=solid.holes[:2])])
    check_apart("test", [solid])


def test_a_wide_hole_leaves_a_thin_rim(short_dipole):
    """Chords instead of the circle would be 1.2 % of the rim between it and an octagon."""
    angle = np.pi / 8 + np.pi / 4 * np.arange(8)
    octagon = 0.05 / np.cos(np.pi / 8) * np.column_stack([np.cos(angle), np.sin(angle)])
    body = prism(outline_m=octagon.tolist(), length_m=0.02, z_m=0.3, holes=[{"radius_m": 0.046}])
    (solid,) = magnet_of(short_dipole, body).iron
    area = 8 * np.tan(np.pi / 8) * 0.05**2 - np.pi * 0.046**2
    assert solid.measures[0] == pytest.approx(area * 0.02, rel=1e-9)
    check_apart("test", [solid])
    (rim,) = solid.holes
    with pytest.raises(MeshError, match="draws body 1 of iron"):  # the control: 2 % of the volume
        check_apart("test", [replace(solid, holes=(rim * [1, 1, 1 - 0.0025],))])


HOLES_IN_A_ROW = [{"outline_m": [[x, -0.01], [x + 0.03, -0.01], [x + 0.03, 0.01], [x, 0.01]]}
                  for x in (-0.05, 0.02)]
SQUARE = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
ANGLE = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.0], [0.0, 0.0], [0.0, 0.1], [-0.1, 0.1]]


@pytest.mark.parametrize(("outline", "holes", "moved", "area"), [
    # the second slot moves to the first, and the slot's side to that of the angle on its line
    (SQUARE, HOLES_IN_A_ROW, -0.04, 0.04 - 2 * 0.03 * 0.02),
    (ANGLE, [{"outline_m": [[-0.05, -0.02], [-0.02, -0.02], [-0.02, 0.0], [-0.05, 0.0]]}], 0.02,
     0.03 - 0.03 * 0.02)])
def test_edges_on_one_line_need_not_meet(short_dipole, outline, holes, moved, area):
    body = prism(outline_m=outline, length_m=0.02, z_m=0.3, holes=holes)
    (solid,) = magnet_of(short_dipole, body).iron
    assert solid.measures[0] == pytest.approx(area * 0.02, rel=1e-9)
    check_apart("test", [solid])
    with pytest.raises(MeshError, match="draws body 1 of iron"):  # holes the wrong way round
        check_apart("test", [replace(solid, holes=tuple(rim[::-1] for rim in solid.holes))])
    touching = [[x + moved, y] for x, y in holes[-1]["outline_m"]]  # the control
    with pytest.raises(StudyError, match="must lie within outline_m, and neither touch"):
        magnet_of(short_dipole, body | {"holes": [*holes[:-1], {"outline_m": touching}]})


def plate_with_holes(rows):
    """A plate with rows of round holes, and its volume."""
    middles = (np.arange(rows) - (rows - 1) / 2) / rows
    radius = 0.3 / rows
    holes = [{"x_m": x, "y_m": y, "radius_m": radius} for x in middles for y in middles]
    corners = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    return prism(outline_m=corners, length_m=0.02, z_m=0.3, holes=holes), 0.02 * (
        1 - len(holes) * np.pi * radius**2)


def test_many_holes_are_cut_out_soon(short_dipole):
    """Slits to 16 round holes took 12 times as long as the triangles between them, when all ways
    between all corners were sorted for each hole; it is a 25th now.
    """
    body, volume = plate_with_holes(4)
    plate = short_dipole(iron={"relative_permeability": 2.0, "bodies": [body]}).iron.bodies[0]
    slits = processor_time(_slit, np.array(plate.outline_m), [hole.corners for hole in plate.holes])
    first = processor_time(magnet_of, short_dipole, body)
    assert slits < first / 3
    (solid,) = magnet_of(short_dipole, body).iron
    assert solid.measures[0] == pytest.approx(volume, rel=1e-9)
    ends = np.isclose(np.ptp(solid.triangles[..., 2], axis=1), 0)
    a, b, c = np.moveaxis(solid.triangles[ends], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    chords = np.sinc(2 / 48)
    assert area == pytest.approx(2 * (1 - 16 * chords * np.pi * 0.075**2), rel=1e-9)
    longer = body | {"length_m": 0.03}  # its section has been cut before
    assert processor_time(magnet_of, short_dipole, longer) < first / 3
    (again,) = magnet_of(short_dipole, longer).iron
    assert again.measures[0] == pytest.approx(1.5 * volume, rel=1e-9)


def test_turned_copies_have_turned_holes(short_dipole):
    """Each copy is the first one, turned about z."""
    body = prism(length_m=0.02, z_m=0.3, copies=5, holes=[{"x_m": 0.23, "radius_m": 0.01}])
    first, *others = magnet_of(short_dipole, body).iron
    for number, solid in enumerate(others, 1):
        turn = rotation_about_z(2 * np.pi * number / 5)
        assert solid.triangles == pytest.approx(first.triangles @ turn.T, abs=1e-15)
        assert solid.holes[0][:2] == pytest.approx(turn[:2, :2] @ first.holes[0][:2])
        assert np.abs(solid.triangles - first.triangles).max() > 0.1  # the control
    check_apart("test", [first, *others])


@pytest.mark.parametrize(("change", "said"), [
    ({"holes": [{"x_m": 0.05, "y_m": 0.2, "radius_m": 0.05}]}, "must lie within outline_m"),
    ({"holes": [{"x_m": 0.25, "y_m": 0.2, "radius_m": 0.02}]}, "must lie within outline_m"),
    ({"holes": [{"x_m": 0.05, "y_m": 0.2, "radius_m": 0.02}] * 2}, "nor touch|neither touch"),
    ({"holes": [{"x_m": 0.05, "y_m": 0.2, "radius_m": 0.02},
                {"x_m": 0.05, "y_m": 0.2, "radius_m": 0.01}]}, r"holes\[2\], about"),
    ({"holes": [{"x_m": 0.05, "y_m": 0.2}]}, "either radius_m"),
    ({"holes": [{"outline_m": [[0, 0], [1, 1], [1, 0], [0, 1]]}]}, "do not cross")])
def test_holes_that_are_refused(short_dipole, change, said):
    with pytest.raises(StudyError, match=said):
        magnet_of(short_dipole, HOLED | change)


@pytest.mark.parametrize(("profile", "said"), [
    ([[0, 0], [0.2, 0], [0, 0.1], [0.2, 0.2]], "no corner on the axis|do not cross"),
    ([[0, 0], [0.2, -0.1], [0.2, 0.1]], "no corner on the axis"),
    ([[-0.1, 0], [0.2, -0.1], [0.2, 0.1]], "greater than or equal to 0")])
def test_profiles_that_are_refused(short_dipole, profile, said):
    with pytest.raises(StudyError, match=said):
        magnet_of(short_dipole, TAPER | {"profile_m": profile})


def triangles_of_box(size):
    """The 12 triangles of a box (12, 3, 3) about the origin, with normals outwards."""
    found = []
    for axis in range(3):
        u, v, n = np.roll(np.eye(3), axis, axis=0)
        for sign in (1, -1):
            corners = [n * sign + a * u + b * v * sign for a, b in (
                (-1, -1), (1, -1), (1, 1), (-1, 1))]
            found += [corners[:3], [corners[0], *corners[2:]]]
    return np.array(found) * np.array(size) / 2


def test_triangles_are_as_a_box(short_dipole, generator):
    """A body of triangles contains and touches the same points as the box that they close."""
    place = {"centre_m": [0.1, 0.4, 0.5], "rotation_deg": [20.0, -40.0, 5.0], "mirrored": ["z"]}
    size = [0.1, 0.2, 0.04]
    box = magnet_of(short_dipole, {"kind": "box", "size_m": size} | place).iron
    triangles = triangles_of_box(size)
    for given in (triangles, triangles[:, ::-1]):  # normals inwards are turned over
        stl = magnet_of(short_dipole, {
            "kind": "stl", "triangles_m": given.tolist()} | place).iron
        for ours, theirs in zip(stl, box, strict=True):
            assert ours.measures == pytest.approx(theirs.measures)
            own = np.vstack([generator.uniform(-0.12, 0.12, (500, 3)), [
                [0.05, 0.03, 0.01], [0.05, 0.1, 0.01], [0.05, 0.1, 0.02], [0.0, 0.0, 0.02],
                [0.05 + 1e-6, 0.0, 0.0], [0.05, 0.11, 0.0]]])  # faces, edge, corner, and off them
            points = own @ rotation_matrix(theirs.turn_rad).T + theirs.origin_m
            found, expected = ours.contact(points), theirs.contact(points)
            for key in ("inside", "on_face", "on_edge"):
                np.testing.assert_array_equal(getattr(found, key), getattr(expected, key))
            assert found.inside.any()
            assert (found.on_face.sum(), found.on_edge.sum()) == (2, 2)
            assert not ours.contains(points + found.outward)[found.on_face].any()


def test_a_file_of_triangles_goes_with_a_study_file(short_dipole):
    """In Python nobody knows the folder of its path; the triangles themselves are the control."""
    triangles = triangles_of_box([0.1, 0.2, 0.04]).tolist()
    magnet = magnet_of(short_dipole, {"kind": "stl", "centre_m": [0.1, 0.4, 0.5],
                                      "triangles_m": triangles})
    body = {"kind": "stl", "centre_m": [0.1, 0.4, 0.5]}
    for given in ({"file": "yoke.stl"}, {"triangles_m": triangles}):
        iron = {"relative_permeability": 100.0, "bodies": [body | given]}
        with nullcontext() if "triangles_m" in given else pytest.raises(
                StudyError, match=r"read together with the study's own file.*'yoke\.stl'"):
            assert magnet.with_(iron=iron).iron


def test_shells_of_triangles():
    """One outer shell, with cavities in it; and a row or a unit that would do nothing."""
    shell = triangles_of_box([0.1, 0.1, 0.1])
    small = shell / 4
    hole = small[:, ::-1]
    right = closed_surface(np.vstack([shell, hole + 0.02, hole - 0.02])[:, ::-1])
    assert np.einsum("ni,ni->", right[:, 0], np.cross(right[:, 1], right[:, 2])) / 6 == (
        pytest.approx(1e-3 * (1 - 2 / 64)))
    for second, wrong in ((small + 0.2, "2 closed shells with normals outwards"),
                          (small, "2 closed shells with normals outwards"),
                          (hole + 0.2, "no cavity"),
                          (np.vstack([hole, hole / 4]), "no cavity")):
        with pytest.raises(ValueError, match=wrong):
            closed_surface(np.vstack([shell, second]))
    stl = {"kind": "stl", "triangles_m": shell.tolist()}
    for body, wrong in ((stl | {"unit_m": 1.0}, "leave unit_m out"),
                        (BOX | {"step_m": [0.0, 0.0, 1.0]}, "step_m stands beside repeats")):
        with pytest.raises(StudyError, match=wrong):
            parse_study(changed(DIPOLE, iron={"relative_permeability": 9, "bodies": [body]}))


def test_many_copies_are_compared_soon():
    """Sixteen times as many took 220 times as long when all pairs were compared, and now 15."""
    def seconds(repeats):
        row = BOX | {"centre_m": [9.0, 9.0, 9.0], "repeats": repeats, "step_m": [1e-3, 0.0, 0.0],
                     "mirrored": ["x", "y", "z"]}
        document = changed(DIPOLE, dimension=3, array__ring_length_m=0.08, iron={
            "relative_permeability": 9, "bodies": [row]})
        assert len(parse_study(document).iron.each) == 8 * repeats
        return processor_time(parse_study, document)

    assert seconds(512) < 80 * seconds(32)


def test_triangles_that_overlap_a_block(short_dipole):
    """The blocks begin at a radius of 0.1 m: a bar through one is found, a bar in the bore not."""
    for size, fits in (([0.15, 0.02, 0.02], True), ([0.5, 0.01, 0.01], False),
                       ([0.01, 0.5, 0.5], False)):
        body = {"kind": "stl", "triangles_m": triangles_of_box(size).tolist()}
        if fits:
            assert magnet_of(short_dipole, body).iron
            continue
        with pytest.raises(StudyError, match="and body 1 of iron overlap"):
            magnet_of(short_dipole, body)


def test_a_large_plate_of_triangles_over_small_blocks(short_dipole, generator):
    """Its triangles are larger than the blocks, into whose corners alone it reaches."""
    for at in generator.uniform(-0.3, 0.3, (8, 2)).tolist():
        for depth in (2e-3, -2e-3):
            plate = {"kind": "stl", "triangles_m": triangles_of_box([1.0, 1.0, 0.01]).tolist(),
                     "centre_m": [0.0, 0.0, 0.003 + 0.005 - depth]}
            cube = {"name": ["one"], "shape": ["cuboid"], "x_m": [at[0]], "y_m": [at[1]],
                    "z_m": [0.0], "size_x_m": [0.006], "size_y_m": [0.006], "size_z_m": [0.006],
                    "remanence_T": [1.2]}
            with nullcontext() if depth < 0 else pytest.raises(StudyError, match="overlap"):
                magnet_of(short_dipole, plate, array={"free_blocks": cube})


@pytest.mark.parametrize(("change", "sentence"), [
    (lambda raw, text: raw, None), (lambda raw, text: text, None),
    (lambda raw, text: raw[:80] + (11).to_bytes(4, "little") + raw[84:-50],
     "must be a closed surface in an STL file; instead .* the surface must be closed, but 3 edges"),
    (lambda raw, text: raw[:-50] + raw[-100:-50], "on the same side"),
    (lambda raw, text: raw[:-1], "it is no STL file"),
    (lambda raw, text: text.replace("vertex 50.0", "vertex nan"), "it is no STL file"),
    (lambda raw, text: text.replace("vertex 50.0", "vertex 1e999"), "without finite corners"),
    (lambda raw, text: b"solid\nendsolid\n", "it has no triangles"),
    (lambda raw, text: "ISO-10303-21;" + 5_000_000 * " ", "it is a STEP file"),
    (lambda raw, text: None, "must be a readable file")])
def test_stl_files(tmp_path, change, sentence):
    """Binary or text, in mm; one that is open, damaged or missing is refused."""
    triangles = 1e3 * triangles_of_box([0.1, 0.2, 0.04])
    raw = b" " * 80 + len(triangles).to_bytes(4, "little") + b"".join(
        np.vstack([np.zeros((1, 3)), each]).astype("<f4").tobytes() + b"\0\0"
        for each in triangles)
    text = "solid box\n" + "".join(
        "facet normal 0 0 0\nouter loop\n" + "".join(
            "vertex {} {} {}\n".format(*corner) for corner in each.tolist())
        + "endloop\nendfacet\n" for each in triangles) + "endsolid box\n"
    content = change(raw, text)
    if content is not None:
        (tmp_path / "body.stl").write_bytes(
            content if isinstance(content, bytes) else content.encode())
    study = tmp_path / "study.toml"
    body = {"kind": "stl", "file": "body.stl", "centre_m": [0.0, 0.0, 0.4]}
    study.write_text(tomlkit.dumps(changed(
        DIPOLE, dimension=3, array__ring_length_m=0.08,
        iron={"relative_permeability": 10.0, "bodies": [body]})))
    if sentence is None:
        (body,) = build_magnet(read_study(study)).iron
        assert body.measures[0] == pytest.approx(0.1 * 0.2 * 0.04)
        text = study.read_text()
        study.write_text(text.replace('"body.stl"', '"body.stl"\nunit_m = 1e-6'))
        with pytest.warns(HalbachWarning, match=r"only 0\.2 mm large\. Were metres or inches"):
            read_study(study)
        return
    with pytest.raises(StudyError, match=sentence):
        read_study(study)


CHAMFERED = [[-0.02, -0.015], [0.02, -0.015], [0.02, 0.009], [0.014, 0.015], [-0.02, 0.015]]


def stl_of_step(folder, draw):
    """Triangles of what is drawn in mm: the study refuses its STEP file, and takes what the command
    of the sentence makes.
    """
    with gmsh_session("body"):
        draw(gmsh.model.occ)
        gmsh.model.occ.synchronize()
        gmsh.write(str(folder / "a body.step"))
    study = folder / "study.toml"
    body = {"kind": "stl", "file": "a body.step", "centre_m": [0.0, 0.0, 0.4]}
    study.write_text(tomlkit.dumps(changed(
        DIPOLE, dimension=3, array__ring_length_m=0.08,
        iron={"relative_permeability": 10.0, "bodies": [body]})))
    with pytest.raises(StudyError, match="it is a STEP file; make an STL file in mm") as refused:
        read_study(study)
    command = re.search(r"gmsh (.*\.stl')", str(refused.value)).group(1)
    # the script begins with "env python", which need not be the environment of the tests
    subprocess.run([sys.executable, Path(sys.executable).with_name("gmsh"), *shlex.split(command)],
                   cwd=folder, check=True, timeout=100)
    study.write_text(study.read_text().replace(".step", ".stl"))
    return read_study(study).iron.bodies[0].triangles_m


def draw_prism(occ, cut=None):
    """A chamfered prism of 10 mm about the origin; cut by a cylinder along it of a radius in mm."""
    points = [occ.addPoint(1e3 * x, 1e3 * y, -5.0) for x, y in CHAMFERED]
    lines = [occ.addLine(points[one - 1], points[one]) for one in range(len(points))]
    found = occ.extrude([(2, occ.addPlaneSurface([occ.addCurveLoop(lines)]))], 0, 0, 10.0)
    if cut:
        occ.cut(found[1:2], [(3, occ.addCylinder(0, 0, -20, 0, 0, 40, cut))])


def test_step_files(tmp_path, short_dipole):
    """A solid is as the prism of the study, also with a round hole; others are refused."""
    prism = {"kind": "prism", "outline_m": CHAMFERED, "length_m": 0.01}
    (theirs,) = magnet_of(short_dipole, prism).iron
    (ours,) = magnet_of(short_dipole, {
        "kind": "stl", "triangles_m": stl_of_step(tmp_path, draw_prism)}).iron
    assert ours.measures[0] == pytest.approx(theirs.measures[0], rel=1e-9)
    assert len(ours.triangles) < 100
    drilled = closed_surface(np.array(stl_of_step(
        tmp_path, lambda occ: draw_prism(occ, cut=4.0))))
    hole = np.einsum("ni,ni->", drilled[:, 0], np.cross(drilled[:, 1], drilled[:, 2])) / 6
    # 40 chords, of which one may begin at the seam, enclose 0.4 % less than their circle
    assert theirs.measures[0] - hole == pytest.approx(0.01 * np.pi * 0.004**2, rel=0.01)
    for draw, wrong in (
            (lambda occ: [occ.addBox(x, 0, 0, 9, 9, 9) for x in (0, 20)], "2 closed shells"),
            (lambda occ: [occ.addBox(x, 0, 0, 9, 9, 9) for x in (0, 9)], "on the same side"),
            (lambda occ: occ.addRectangle(0, 0, 0, 9, 9), "the surface must be closed"),
            (lambda occ: occ.addLine(occ.addPoint(0, 0, 0), occ.addPoint(9, 0, 0)),
             "it has no triangles")):
        with pytest.raises(StudyError, match=wrong):
            stl_of_step(tmp_path, draw)


def test_several_bodies(short_dipole):
    magnet = magnet_of(short_dipole, tube(0.2, 0.25), tube(0.05, 0.25, length_m=0.02, z_m=0.2))
    assert magnet.iron_is_axisymmetric
    assert (magnet.iron_half_length, magnet.radius) == pytest.approx((0.21, 0.25))
    points = np.array([[0.22, 0, 0], [0.1, 0, 0.2], [0.01, 0, 0.2], [0.22, 0, 0.1]])
    assert magnet.contains(points).tolist() == [True, True, False, False]


@pytest.mark.parametrize(("H_per", "doubted"), [(1.0, False), (1e3 / (4 * np.pi), True),
                                                (100.0, True)])
def test_a_curve_in_another_unit_is_doubted(tmp_path, H_per, doubted):
    """Steel up to 1.9 T with H in Oe or A/cm could be oriented sheet: it is said, not refused."""
    H, B = np.loadtxt(files("halbach_fe.study") / "steels" / "aisi_1010.csv", delimiter=",",
                      comments=("#", "H")).T
    use = B < 1.9
    study = tmp_path / "study.toml"
    study.write_text(tomlkit.dumps(changed(DIPOLE, iron_ring={
        "inner_radius_m": 0.3, "outer_radius_m": 0.35, "curve": {
            "kind": "table", "H_A_per_m": (H[use] / H_per).tolist(), "B_T": B[use].tolist()}})))
    with pytest.warns(HalbachWarning, match="`iron_ring.curve` .* H in Oe") if doubted else (
            warnings.catch_warnings(action="error")):
        read_study(study)


@pytest.mark.parametrize(("body", "volume"), [
    (BOX | {"rotation_deg": [20.0, -10.0, 70.0]}, 0.1 * 0.2 * 0.04),
    ({"kind": "sphere", "radius_m": 0.08, "centre_m": [0.05, 0.0, 0.2]}, 4 / 3 * np.pi * 0.08**3),
    (tube(0.02, 0.06, length_m=0.1, rotation_deg=[90.0, 0.0, 0.0], centre_m=[0.0, 0.0, 0.2]),
     np.pi * (0.06**2 - 0.02**2) * 0.1)])
def test_bodies_in_any_place(short_dipole, generator, body, volume):
    """Monte Carlo, 4 sigma. All that is inside lies within the points of the surface, and
    `measures` has the volume.
    """
    magnet = magnet_of(short_dipole, body)
    (solid,) = magnet.iron
    found, inside = fraction_inside(solid, generator)
    assert found == pytest.approx(volume, abs=4 * np.sqrt(volume * 0.6**3 / 200_000))
    assert solid.measures[0] == pytest.approx(volume, rel=1e-12)
    low, high = (np.array([end(part) for part in solid.surface]) for end in (np.min, np.max))
    assert ((inside >= low) & (inside <= high)).all()
    assert (inside.max(axis=0) - inside.min(axis=0) > 0.8 * (high - low)).all()
    assert solid.half_length == pytest.approx(np.abs(solid.surface[2]).max())
    assert not magnet.iron_is_axisymmetric
    # points on faces are moved outward along the body's own axes
    if solid.sphere:
        on = np.array([[0.05, 0.0, 0.28]])
        assert solid.contact(on).on_face.all()
        assert (solid.contact(on).outward[:, 2] > 0).all()


@pytest.mark.parametrize("body", [
    BOX | {"rotation_deg": [20.0, -10.0, 70.0]},
    {"kind": "sphere", "radius_m": 0.08, "centre_m": [0.05, 0.0, 0.2]},
    tube(0.05, 0.06, length_m=0.1, rotation_deg=[90.0, 0.0, 0.0], centre_m=[0.0, 0.0, 0.2]),
    {"kind": "prism", "outline_m": [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]],
     "length_m": 0.05, "centre_m": [0.0, 0.0, 0.2], "holes": [{"radius_m": 0.06}]}],
    ids=["box", "sphere", "tube", "drilled"])
def test_distances_from_bodies(short_dipole, generator, body):
    """None of many points inside is nearer, and one is hardly farther: they are 10 mm from each
    other, so that at a corner some 8 are in the eighth of a ball of 25 mm.
    """
    (solid,) = magnet_of(short_dipole, body).iron
    _, inside = fraction_inside(solid, generator)
    points = generator.uniform([-0.3, -0.3, -0.1], [0.3, 0.3, 0.5], (60, 3))
    points = points[~solid.contains(points)]
    nearest = KDTree(inside).query(points)[0]
    assert (solid.distance(points) <= nearest).all()
    assert (solid.distance(points) >= nearest - 0.025).all()


def test_a_moved_coaxial_tube_is_still_coaxial(short_dipole):
    (solid,) = magnet_of(short_dipole, tube(0.2, 0.25, centre_m=[0.0, 0.0, 0.05])).iron
    assert solid.is_coaxial
    assert (solid.z_min, solid.z_max) == pytest.approx((-0.03, 0.13))
    assert not magnet_of(short_dipole, tube(
        0.2, 0.25, rotation_deg=[180.0, 0.0, 0.0])).iron_is_axisymmetric


@pytest.mark.parametrize(("body", "said"), [
    (tube(0.1, 0.25), "overlap"), (tube(0.0, 0.12, z_m=0.03), "overlap"),
    (tube(0.25, 0.2), "must be larger than inner_radius_m"),
    (prism(outline_m=[[0.2, 0], [0.25, 0.05], [0.25, 0], [0.2, 0.05]]), "do not cross"),
    (prism(outline_m=[[0.2, 0], [0.21, 0], [0.22, 0]]), "some area"),
    (prism(outline_m=[[0.1, 0], [0.25, -0.01], [0.25, 0.01]]), "overlap"),
    (prism(copies=0), "greater than or equal to 1"),
    ({"kind": "ball", "radius_m": 0.1}, "'tube'")])
def test_refusals(short_dipole, body, said):
    with pytest.raises(StudyError, match=said):
        magnet_of(short_dipole, body)
    magnet_of(short_dipole, tube(SIZE, 0.25))


def test_one_kind_of_iron(short_dipole):
    with pytest.raises(StudyError, match="either iron_ring or iron"):
        magnet_of(short_dipole, tube(0.2, 0.25), iron_ring={
            "inner_radius_m": 0.2, "outer_radius_m": 0.25, "relative_permeability": 100.0})
    with pytest.raises(StudyError, match="exactly one of relative_permeability and curve"):
        short_dipole(iron={"bodies": [tube(0.2, 0.25)]})
