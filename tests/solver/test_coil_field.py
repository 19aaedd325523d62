"""Fields of coils: against magpylib, closed forms, and as sources of iron."""

from __future__ import annotations

from contextlib import nullcontext

import magpylib
import numpy as np
import pytest

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.coils import distance
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.exact_block_field import coil_field, external_field
from halbach_fe.study.external_keys import External
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import DIPOLE, changed

PLACE = {"centre_m": [0.01, -0.02, 0.03], "rotation_deg": [30.0, -50.0, 20.0]}


def coil(**keys):
    """A coil of the study's keys, of 7 turns of 3 A."""
    return External(coils=[{"current_A": 3.0, "turns": 7} | keys]).coils[0]


def placed(source):
    """A source of magpylib where PLACE says."""
    turn = np.radians(PLACE["rotation_deg"])
    return source.rotate_from_rotvec(turn, anchor=0, degrees=False).move(PLACE["centre_m"])


def points_off(one, generator, closest):
    """Points (n, 3) in m around a coil, ``closest`` m away from its winding or more."""
    points = generator.uniform(-0.15, 0.15, (300, 3))
    own = one.model_copy(update={"centre_m": (0, 0, 0), "rotation_deg": (0, 0, 0)})
    return points[distance(own, points) > closest]


def test_a_loop_is_magpylibs(generator):
    """Both are closed forms by elliptic integrals; also on the axis."""
    one = coil(kind="round", radius_m=0.05, **PLACE)
    points = generator.uniform(-0.15, 0.15, (300, 3))
    theirs = placed(magpylib.current.Circle(current=21.0, diameter=0.1)).getB(points)
    np.testing.assert_allclose(coil_field(one, points, "a"), theirs, rtol=0,
                               atol=1e-9 * np.abs(theirs).max())  # mu_0 differs by 1e-10
    on_axis = coil_field(coil(kind="round", radius_m=0.05), np.array([[0.0, 0.0, 0.02]]), "a")
    exact = MU_0 * 21 / 2 * 0.05**2 / (0.05**2 + 0.02**2) ** 1.5
    np.testing.assert_allclose(on_axis, [[0.0, 0.0, exact]], rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize("section", [(0.0, 0.12), (0.02, 0.12), (0.02, 0.0)])
def test_a_solenoid_is_a_sum_of_loops(generator, section):
    """By Gauss's rule of 60 loops along z and of 12 across the section, of magpylib: at half a
    section's width from it 2e-8 were measured; one per cent more current is told.
    """
    one = coil(kind="round", radius_m=0.05, section_m=section)
    points = points_off(one, generator, 0.01)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    along = zip(nodes * section[1] / 2, weights / 2, strict=True) if section[1] else [(0.0, 1.0)]
    radial, shares = np.polynomial.legendre.leggauss(12)
    across = list(zip(0.05 + radial * section[0] / 2, shares / 2, strict=True)) if (
        section[0]) else [(0.05, 1.0)]
    loops = [magpylib.current.Circle(current=21.0 * weight * share, diameter=2 * radius,
                                     position=(0, 0, z))
             for z, weight in along for radius, share in across]
    theirs = magpylib.getB(loops, points, sumup=True)
    ours = coil_field(one, points, "a")
    scale = np.abs(theirs).max()
    assert np.abs(ours - theirs).max() < 1e-6 * scale
    assert np.abs(1.01 * ours - theirs).max() > 1e-3 * scale  # negative control
    # on the cylinder of the winding's mean radius, beyond its end
    beyond = coil_field(one, np.array([[0.05, 0.0, 0.1], [0.05 + 1e-9, 0.0, 0.1]]), "a")
    np.testing.assert_allclose(beyond[0], beyond[1], rtol=1e-6)


@pytest.mark.parametrize(("section", "places"), [
    ((0.19, 0.0), [[0.05, 0.005], [0.0, 0.005], [0.19, 0.005]]),
    ((0.02, 0.02), [[0.105, 0.011], [0.1, 0.011], [0.089, 0.0], [0.111, 0.009]])])
def test_near_a_thick_winding(section, places):
    """Loops of magpylib by Gauss's rule of 8 in each of many panels of 1.25 mm, for points
    1 mm away or more. For racetracks, 5e-4 was measured.
    """
    rho, z = np.transpose(places)
    panel, share = np.polynomial.legendre.leggauss(8)

    def nodes(side):
        if not side:
            return [(0.0, 1.0)]
        panels = round(side / 1.25e-3)
        middles = (np.arange(panels) + 0.5) / panels - 0.5
        return [(side * (middle + at / 2 / panels), part / 2 / panels)
                for middle in middles for at, part in zip(panel, share, strict=True)]

    radii, heights = nodes(section[0]), nodes(section[1])
    weights = np.outer([part for _, part in radii], [part for _, part in heights])
    r = 0.1 + np.array([at for at, _ in radii])[:, None, None]
    h = z - np.array([at for at, _ in heights])[:, None]
    shape = np.broadcast_shapes(r.shape, h.shape)
    theirs = magpylib.core.current_circle_Hfield(*(
        np.broadcast_to(one, shape).ravel() for one in (r, rho, h, 21.0)))
    exact = MU_0 * np.einsum("rh,irhn->ni", weights, theirs.reshape(3, *shape))
    one = coil(kind="round", radius_m=0.1, section_m=section)
    points = np.column_stack([rho, 0 * rho, z])
    ours = coil_field(one, points, "a")[:, [0, 2]]
    assert np.abs(ours - exact[:, [0, 2]]).max() < 1e-6 * np.abs(exact).max()
    # a square racetrack of the largest corners is that coil but for its chords
    track = coil(kind="racetrack", size_m=[0.2, 0.2], corner_radius_m=0.1, section_m=section)
    bent = coil_field(track, points, "a")[:, [0, 2]]
    assert np.abs(bent - ours).max() < 1e-3 * np.abs(ours).max()


def test_a_long_rectangular_solenoid():
    """4.09 mT in its middle by 64 rectangles of magpylib, where 4 would give half of that."""
    one = coil(kind="racetrack", size_m=[0.06, 0.06], corner_radius_m=0.0, section_m=[0.0, 0.3])
    square = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]]) * 0.03
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.029, 0.01, 0.05], [0.03, 0.0, 0.151]])
    nodes, weights = np.polynomial.legendre.leggauss(64)

    def rectangles(nodes, weights):
        return magpylib.getB([magpylib.current.Polyline(
            current=21.0 * weight / 2, vertices=square + np.array([0, 0, 0.15 * at]))
            for at, weight in zip(nodes, weights, strict=True)], points[:2], sumup=True)

    theirs = rectangles(nodes, weights)
    ours = coil_field(one, points, "a")
    np.testing.assert_allclose(ours[:2], theirs, rtol=1e-4, atol=1e-9)
    assert ours[0, 2] * 1000 / 21 == pytest.approx(4.09e-3, rel=2e-3)
    # the jump across a sheet is mu_0 times its current per length
    inside, outside = coil_field(one, np.array([[0.0299, 0, 0], [0.0301, 0, 0]]), "a")[:, 2]
    assert inside - outside == pytest.approx(MU_0 * 21 / 0.3, rel=1e-3)
    coarse = rectangles(*np.polynomial.legendre.leggauss(4))
    assert not np.allclose(coarse[0], theirs[0], rtol=0.1)  # negative control


def test_a_polygon_is_magpylibs(generator):
    corners = generator.uniform(-0.1, 0.1, (5, 3))
    one = coil(kind="polygon", points_m=corners.tolist(), **PLACE)
    points = generator.uniform(-0.2, 0.2, (200, 3))
    theirs = placed(magpylib.current.Polyline(
        current=21.0, vertices=np.vstack([corners, corners[:1]]))).getB(points)
    np.testing.assert_allclose(coil_field(one, points, "a"), theirs, rtol=0,
                               atol=1e-9 * np.abs(theirs).max())


def test_a_racetrack_is_between_its_limits(generator):
    """With the largest corners of a square it is a round coil, without corners a rectangle."""
    section = (0.02, 0.03)
    track = coil(kind="racetrack", size_m=[0.1, 0.1], corner_radius_m=0.05, section_m=section)
    points = points_off(track, generator, 0.015)
    ours, theirs = (coil_field(one, points, "a") for one in (
        track, coil(kind="round", radius_m=0.05, section_m=section)))
    # chords and 4 x 4 filaments: 1.3e-3 of the largest field were expected at this distance
    assert np.abs(ours - theirs).max() < 3e-3 * np.abs(theirs).max()
    corners = [(0.06, 0.03, 0.0), (-0.06, 0.03, 0.0), (-0.06, -0.03, 0.0), (0.06, -0.03, 0.0)]
    ours, theirs = (coil_field(one, points, "a") for one in (
        coil(kind="racetrack", size_m=[0.12, 0.06]), coil(kind="polygon", points_m=corners)))
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(("keys", "inside"), [
    ({"kind": "round", "radius_m": 0.05, "section_m": [0.02, 0.04]}, [0.058, 0.0, 0.019]),
    ({"kind": "racetrack", "size_m": [0.2, 0.1], "corner_radius_m": 0.03,
      "section_m": [0.02, 0.04]}, [0.03, 0.058, 0.019]),
    ({"kind": "polygon", "points_m": [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]}, [0.05, 0.05, 0.0])])
def test_points_in_the_winding_are_refused(keys, inside):
    with pytest.raises(StudyError, match="clear of readings, blocks and iron"):
        coil_field(coil(**keys), np.array([inside]), "a")
    coil_field(coil(**keys), np.multiply([inside], [1.0, 1.1, 1.1]), "a")


def test_a_coil_beside_a_cross_section_is_none():
    """The field of the magnet does not depend on z, but that of the coil does."""
    magnet = build_magnet(parse_study(changed(DIPOLE, external={"coils": [
        {"kind": "round", "current_A": 1e5, "radius_m": 0.05}]})))
    points = np.array([[0.0, 0.01, 0.0], [0.0, 0.01, 0.2]])
    own = magnet.field_T(points) - external_field(magnet, points)
    np.testing.assert_allclose(own[0], own[1], atol=1e-12)


def test_blocks_and_iron_in_windings_are_refused():
    """The blocks of the array begin at a radius of 0.1 m; a core may touch its winding."""
    core = {"kind": "box", "size_m": [0.04, 0.04, 0.04], "centre_m": [0.0, 0.0, 0.5]}
    plain = changed(DIPOLE, dimension=3, array__ring_length_m=0.08, iron={
        "relative_permeability": 9.0, "bodies": [core]})
    magnet = build_magnet(parse_study(plain))
    around = {"kind": "racetrack", "current_A": 1.0, "centre_m": [0.0, 0.0, 0.5],
              "size_m": [0.05, 0.05], "corner_radius_m": 0.005, "section_m": [0.01, 0.02]}
    for one, where in (
            (around, None), (around | {"centre_m": [0.001, 0.0, 0.5]}, "body 1 of iron"),
            ({"kind": "round", "current_A": 1.0, "radius_m": 0.11}, "block r01s"),
            ({"kind": "round", "current_A": 1.0, "radius_m": 0.05}, None),
            ({"kind": "round", "current_A": 1.0, "radius_m": 0.01, "section_m": [0.0, 1.3]},
             "body 1 of iron"),
            ({"kind": "polygon", "current_A": 1.0, "points_m": [
                [0.0, 0.0, 0.5], [0.3, 0.0, 0.5], [0.0, 0.3, 0.5]]}, "body 1 of iron"),
            ({"kind": "round", "current_A": 1.0, "radius_m": 0.3, "section_m": [0.5, 2.0]},
             "block r01s")):
        study = parse_study(plain | {"external": {"coils": [one]}})
        refused = nullcontext() if where is None else pytest.raises(
            StudyError, match=rf"coils\[1\].* clear of blocks and iron; .* in {where}")
        with refused:
            build_magnet(study)
        with refused:
            magnet.with_(external=study.external)


@pytest.mark.parametrize(("one", "where"), [
    ({"kind": "round", "radius_m": 0.3, "section_m": [0.02, 0.02]}, None),  # around the tube
    ({"kind": "round", "radius_m": 0.05}, None),
    ({"kind": "round", "radius_m": 0.11}, "block r01s"),
    ({"kind": "round", "radius_m": 0.11, "centre_m": [0.0, 0.0, 5.0]}, "block r01s"),
    ({"kind": "round", "radius_m": 0.3, "section_m": [0.5, 0.02]}, "block r01s"),
    ({"kind": "round", "radius_m": 0.19}, "body 1 of iron"),
    ({"kind": "polygon", "points_m": [[0.0, 0.0, -0.1], [0.3, 0.0, 0.2], [0.0, 0.3, 0.1]]},
     "block r01s")])
def test_windings_in_a_cross_section_are_refused_at_any_height(one, where):
    """The blocks fill radii from 0.104 to 0.1865 m, and the tube is as long as they are."""
    study = parse_study(changed(DIPOLE, iron_ring={
        "inner_radius_m": 0.1875, "outer_radius_m": 0.2, "relative_permeability": 9.0},
        external={"coils": [one | {"current_A": 1.0}]}))
    with nullcontext() if where is None else pytest.raises(
            StudyError, match=rf"coils\[1\].* clear of blocks and iron; .* in {where}"):
        build_magnet(study)


def test_windings_in_one_another_are_refused():
    """Two pancakes may lie on each other; one coil stated twice may not."""
    one = {"kind": "round", "current_A": 1.0, "radius_m": 0.05, "section_m": [0.02, 0.01]}
    for other, refused in (
            ({"centre_m": [0.0, 0.0, 0.01]}, False), ({"centre_m": [0.0, 0.0, 0.009]}, True),
            ({}, True), ({"radius_m": 0.07}, False), ({"radius_m": 0.068}, True),
            ({"section_m": [0.0, 0.0]}, True), ({"centre_m": [0.5, 0.0, 0.0]}, False)):
        study = parse_study(changed(DIPOLE, external={"coils": [one, one | other]}))
        with pytest.raises(StudyError, match=r"coils\[2\].* clear of other coils") if refused else (
                nullcontext()):
            build_magnet(study)


@pytest.mark.parametrize(("across_mm", "refused"), [(0.0, True), (9.9, True), (10.1, False)])
@pytest.mark.parametrize("section_m", [(0.0, 0.0), (1e-4, 1e-4), (0.0, 1e-4)])
def test_large_loops_through_small_bodies_are_refused(across_mm, refused, section_m):
    """A loop of 9 m radius, whose 200 points are 0.3 m apart, passes through a block of 20 mm or
    beside it, and so through the section of a small coil.
    """
    away = 2.0  # in rad about the loop's own axis, between two of its points
    x, y = 9 * np.cos(away), 9 * np.sin(away)
    loop = {"kind": "round", "current_A": 1.0, "radius_m": 9.0, "section_m": section_m,
            "centre_m": [-x, -y, 1e-3 * across_mm]}
    cube = {"name": ["a"], "shape": ["cuboid"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.0],
            **{f"size_{axis}_m": [0.02] for axis in "xyz"}, "remanence_x_T": [0.0],
            "remanence_y_T": [0.0], "remanence_z_T": [1.3]}
    plain = {"name": "one", "array": {"multipole_order": 1, "free_blocks": cube},
             "mesh": {"block_size_m": 0.01},
             "observation": {"quantity": "flux_density", "positions": {
                 "kind": "points", "points_m": [[0.0, 0.0, 0.1]]}}}
    with pytest.raises(StudyError, match=r"coils\[1\].* in block a") if refused else (
            nullcontext()):
        build_magnet(parse_study(plain | {"external": {"coils": [loop]}}))
    small = {"kind": "round", "current_A": 1.0, "radius_m": 0.05, "section_m": [0.02, 0.02],
             "centre_m": [0.05, 0.0, 1.0]}  # its section is about (0, 0, 1)
    high = loop | {"centre_m": [-x, -y, 1.0 + 1e-3 * across_mm]}
    for coils in ([small, high], [high, small]):
        with pytest.raises(StudyError, match=r"coils\[2\].* clear of other coils") if refused else (
                nullcontext()):
            build_magnet(parse_study(plain | {"external": {"coils": coils}}))


@pytest.mark.parametrize(("inner", "outer"), [
    ({"kind": "round", "radius_m": 0.3}, {"radius_m": 0.302}),
    ({"kind": "racetrack", "size_m": [0.5, 0.4], "corner_radius_m": 0.1},
     {"size_m": [0.504, 0.404], "corner_radius_m": 0.102})])
def test_layers_of_windings_may_touch_on_arcs(inner, outer):
    """So may a round winding and its core. What overlaps by a tenth of a millimetre is refused."""
    own = {"current_A": 1.0, "section_m": [0.002, 0.01], "centre_m": [0.0, 0.0, 1.0]}
    nearer = {key: [side - 2e-4 for side in value] if key == "size_m" else value - 1e-4
              for key, value in outer.items()}
    for other, refused in ((outer, False), (nearer, True)):
        study = parse_study(changed(DIPOLE, external={"coils": [
            own | inner, own | inner | other]}))
        with pytest.raises(StudyError, match=r"coils\[2\].* clear of other coils") if refused else (
                nullcontext()):
            build_magnet(study)
    if inner["kind"] == "round":
        for radius, refused in ((0.299, False), (0.2991, True)):
            study = parse_study(changed(DIPOLE, dimension=3, array__ring_length_m=0.08, iron={
                "relative_permeability": 9.0, "bodies": [
                    {"kind": "tube", "inner_radius_m": 0.2, "outer_radius_m": radius,
                     "length_m": 0.5, "z_m": 1.0}]}, external={"coils": [own | inner]}))
            with pytest.raises(StudyError, match="clear of blocks and iron") if refused else (
                    nullcontext()):
                build_magnet(study)


def test_other_refusals():
    with pytest.raises(StudyError, match="corner_radius_m"):
        parse_study(changed(DIPOLE, external={"coils": [
            {"kind": "racetrack", "current_A": 1.0, "size_m": [0.2, 0.1],
             "corner_radius_m": 0.06}]}))
    study = parse_study(changed(DIPOLE, external={"coils": [
        {"kind": "round", "current_A": 1.0, "radius_m": 1.0}]}))
    middle = external_field(build_magnet(study), np.zeros((1, 3)))
    np.testing.assert_allclose(middle, [[0, 0, MU_0 / 2]])
    with pytest.raises(StudyError, match="left out to simulate a campaign"):
        magnet_of(study)
