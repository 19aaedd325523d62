"""Free blocks: their field in any pose against magpylib, their places, and what is refused."""

from __future__ import annotations

import contextlib
import re

import magpylib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import halbach_fe as hf
from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.geometry.array_layout import blocks_table
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report.page import page_of
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed

FIELD_ERROR = 1e-9
"""Of the largest field, at points that are at least a block's size away: our quadrature reaches
1e-12 there, magpylib's closed forms lose up to 1e-10 to cancellation."""

SEGMENT_ERROR = 1e-6
"""magpylib's cylinder segments carry about 2e-8 of the remanence, which is up to 50 times the field
at these points.
"""

WEDGE = ((0.0, -0.01), (0.03, -0.005), (0.025, 0.012), (0.004, 0.015), (-0.006, 0.002))
SHAPES = {
    "cuboid": {"size_x_m": 0.02, "size_y_m": 0.03},
    "sector": {"inner_radius_m": 0.03, "outer_radius_m": 0.05, "angle_deg": 40.0},
    "long sector": {"inner_radius_m": 0.01, "outer_radius_m": 0.02, "angle_deg": 250.0},
    "ring sector": {"inner_radius_m": 0.01, "outer_radius_m": 0.02, "angle_deg": 360.0},
    "trapezoid": {"size_x_m": 0.03, "inner_width_m": 0.01, "outer_width_m": 0.025},
    "cylinder": {"radius_m": 0.015},
    "polygon": {"sides": 7, "radius_m": 0.02},
    "square polygon": {"sides": 4, "radius_m": 0.02},
    "prism": {"outline_m": WEDGE},
    "clockwise prism": {"outline_m": WEDGE[::-1]}}
LENGTH = 0.025


def row(kind, **values):
    """Columns of a table of one block."""
    shape = kind.split()[-1]
    one = {"name": "b", "shape": shape, "x_m": 0.0, "y_m": 0.0, "z_m": 0.0, "size_z_m": LENGTH,
           "remanence_T": 1.3} | SHAPES[kind] | values
    return {column: [value] for column, value in one.items() if value is not None}


def magnet_of(columns, **changes):
    values = {"dimension": 3, "mesh__block_size_m": 0.002, "array": {"free_blocks": columns}}
    return build_magnet(parse_study(changed(DIPOLE, **(values | changes))))


def source(kind):
    """The same shape of magpylib, in the block's own frame."""
    sizes = SHAPES[kind]
    if kind == "cuboid":
        return magpylib.magnet.Cuboid(dimension=(*sizes.values(), LENGTH))
    if kind.endswith("sector"):
        half = sizes["angle_deg"] / 2
        return magpylib.magnet.CylinderSegment(dimension=(
            sizes["inner_radius_m"], sizes["outer_radius_m"], LENGTH, -half, half))
    if kind == "cylinder":
        return magpylib.magnet.Cylinder(dimension=(2 * sizes["radius_m"], LENGTH))
    if kind.endswith("polygon"):
        turn = 2 * np.pi / sizes["sides"] * np.arange(sizes["sides"])
        corners = sizes["radius_m"] * np.column_stack([np.cos(turn), np.sin(turn)])
    elif kind == "trapezoid":
        depth, inner, outer = (value / 2 for value in sizes.values())
        corners = [(-depth, -inner), (-depth, inner), (depth, -outer), (depth, outer)]
    else:
        corners = WEDGE
    return magpylib.magnet.TriangularMesh.from_ConvexHull(
        points=[(x, y, z) for x, y in corners for z in (-LENGTH / 2, LENGTH / 2)])


def around(middle, count=30, seed=5):
    """Points on spheres about a block, one to three of its sizes away."""
    generator = np.random.default_rng(seed)
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return middle + generator.uniform(0.05, 0.15, (count, 1)) * direction


def difference(magnet, reference):
    points = around(magnet.blocks[0].middle)
    expected = reference.getB(points)
    return np.abs(field_of(magnet.blocks, points) - expected).max() / np.abs(expected).max()


vectors = st.tuples(*[st.floats(-1, 1)] * 3)


@pytest.mark.parametrize("kind", SHAPES)
@settings(max_examples=8)
@given(place=vectors, turn=vectors, remanence=vectors)
def test_shapes_in_any_pose_against_magpylib(kind, place, turn, remanence):
    """The remanence vector is along the magnet's axes; magpylib takes it along the block's."""
    remanence = np.array([*remanence[:2], remanence[2] + (1.5 if remanence[2] >= 0 else -1.5)])
    remanence *= 1.9 / 3  # components of up to 2 T are possible
    degrees = 180 * np.array(turn)
    magnet = magnet_of(row(kind, x_m=place[0], y_m=place[1], z_m=place[2],
                           rotation_x_deg=degrees[0], rotation_y_deg=degrees[1],
                           rotation_z_deg=degrees[2], remanence_T=None,
                           **{f"remanence_{axis}_T": value
                              for axis, value in zip("xyz", remanence, strict=True)}))
    rotation = Rotation.from_rotvec(degrees, degrees=True)
    reference = source(kind)
    reference.position, reference.orientation = place, rotation
    reference.polarization = rotation.inv().apply(remanence)
    limit = SEGMENT_ERROR if kind.endswith("sector") else FIELD_ERROR
    assert difference(magnet, reference) < limit
    reference.move((1e-6, 0, 0))  # the control: a micrometre
    assert difference(magnet, reference) > 3 * limit


@pytest.mark.parametrize("kind", SHAPES)
def test_remanence_along_the_own_axis(kind):
    """A scalar remanence is along the block's own x axis, wherever the rotation takes it."""
    magnet = magnet_of(row(kind, rotation_z_deg=90.0))
    assert magnet.blocks[0].easy_axis == pytest.approx((0, 1, 0), abs=1e-15)
    reference = source(kind)
    reference.orientation = Rotation.from_euler("z", 90, degrees=True)
    reference.polarization = (1.3, 0, 0)
    limit = SEGMENT_ERROR if kind.endswith("sector") else FIELD_ERROR
    assert difference(magnet, reference) < limit
    reference.polarization = (1.3, 0.001, 0)
    assert difference(magnet, reference) > 100 * limit


@pytest.mark.parametrize("kind", SHAPES)
def test_volume(kind):
    """Of magpylib's bodies."""
    assert magnet_of(row(kind)).blocks[0].volume == pytest.approx(source(kind).volume, rel=1e-9)


@pytest.mark.parametrize("kind", SHAPES)
def test_contains(kind, generator):
    """Monte Carlo over a box around a turned block: the fraction inside, within 4 sigma."""
    block = magnet_of(row(kind, x_m=0.3, rotation_x_deg=50.0, rotation_z_deg=-70.0)).blocks[0]
    points = np.array([0.3, 0, 0]) + generator.uniform(-0.06, 0.06, (100_000, 3))
    expected = source(kind).volume / 0.12**3
    error = 4 * np.sqrt(expected / len(points))
    assert block.contains(points).mean() == pytest.approx(expected, abs=error)
    inside = block.contains(points)
    own = Rotation.from_rotvec([50, 0, -70], degrees=True).inv().apply(points - [0.3, 0, 0])
    assert np.abs(own[inside][:, 2]).max() <= LENGTH / 2
    assert np.abs(points[inside][:, 2]).max() > LENGTH / 2  # it is tilted


def test_defaults_are_those_of_the_array():
    columns = row("cuboid") | {"name": ["a", "b", "c"], "recoil_permeability": [None, 1.2, 1.3],
                               "recoil_permeability_across": [None, None, 1.1]}
    columns = {name: values * (3 // len(values)) for name, values in columns.items()}
    columns["x_m"] = [0.0, 0.1, 0.2]
    for across, expected in ((None, (1.05, 1.2, 1.1)), (1.15, (1.15, 1.15, 1.1))):
        array = {"free_blocks": columns, "recoil_permeability": 1.05,
                 "recoil_permeability_across": across}
        blocks = magnet_of(None, array=array).blocks
        assert [block.recoil_permeability for block in blocks] == [1.05, 1.2, 1.3]
        assert tuple(block.recoil_permeability_across for block in blocks) == expected


def test_free_blocks_follow_the_rings(short_dipole):
    columns = row("cuboid", z_m=0.2)
    magnet = build_magnet(short_dipole(array__free_blocks=columns))
    assert magnet.blocks_by_ring == (16, 16, 1)
    block = magnet.blocks[-1]
    assert (block.ring, block.slot, block.name, len(magnet.blocks)) == (3, 1, "b", 33)
    assert magnet.number_of(3, 1) == 32
    assert magnet.half_length == pytest.approx(0.2 + LENGTH / 2)
    assert magnet.parameter_names[-3:] == ("b.Mx", "b.My", "b.Mz")


def test_a_table_of_all_blocks_alone():
    magnet = magnet_of(row("cuboid", x_m=0.1))
    assert (magnet.array.rings, magnet.blocks_by_ring) == (0, (1,))
    assert magnet.bore_radius == pytest.approx(0.09)
    assert magnet.array_outer_radius == pytest.approx(np.hypot(0.11, 0.015))


def test_cross_sections():
    """Blocks are infinitely long: the same field as of a very long block in 3D."""
    columns = row("sector", x_m=0.02, rotation_z_deg=30.0)
    flat = magnet_of(columns, dimension=2)
    long = magnet_of(columns | {"size_z_m": [9.9]})
    points = around(np.array([0.02, 0, 0])) * [1, 1, 0]
    field = field_of(flat.blocks, points)
    scale = np.abs(field).max()
    # the ends are 50 times as far away as the points: the remainder is (0.2 m / 10 m)^2
    assert np.abs(field - field_of(long.blocks, points)).max() < 1e-3 * scale
    short = magnet_of(columns | {"size_z_m": [0.1]})
    assert np.abs(field - field_of(short.blocks, points)).max() > 0.05 * scale


@pytest.mark.parametrize(("columns", "dimension", "said"), [
    ({"z_m": 0.01}, 2, "must lie in the plane z = 0"),
    ({"rotation_x_deg": 1.0}, 2, "turn about z only.* block b does not"),
    ({"size_z_m": None}, 3, "must be given for every block of a 3D study; .* block b")])
def test_refusals(columns, dimension, said):
    with pytest.raises(StudyError, match=said):
        magnet_of(row("cuboid", **columns), dimension=dimension)
    magnet_of(row("cuboid"), dimension=dimension)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.04, 0.0), (0.3, -0.1)])
def test_blocks_around_another_axis_than_z_are_doubted(x, y):
    """Rings that turn do so about the z axis: of a magnet beside it, turns and multipoles were not
    found, without a word. Control: an axis that lies within the ring.
    """
    columns = blocks_table(hf.halbach_ring(
        blocks=8, inner_radius_m=0.05, outer_radius_m=0.07, length_m=0.03))
    columns |= {"x_m": [x + each for each in columns["x_m"]],
                "y_m": [y + each for each in columns["y_m"]]}
    beside = np.hypot(x, y) > 0.07
    with pytest.warns(HalbachWarning, match=r"add -0\.3 to x_m and 0\.1 to y_m") if beside else (
            contextlib.nullcontext()):
        magnet = hf.magnet_of_blocks(columns)
    assert magnet.middle_m == pytest.approx((x, y, 0.0) if beside else (0.0, 0.0, 0.0))


def test_multipoles_beside_the_magnet_are_not_answered():
    """They were about the empty z axis, with the advice to look at other z, as of an undulator.
    What is advised now gives those of the ring about the z axis, which is the control.
    """
    ring = hf.halbach_ring(blocks=8, inner_radius_m=0.05, outer_radius_m=0.07, length_m=0.03)
    columns = blocks_table(ring)
    with pytest.warns(HalbachWarning, match="about the z axis"):
        beside = hf.magnet_of_blocks(columns | {"x_m": [0.3 + each for each in columns["x_m"]]})
    found = page_of(hf.multipoles(beside)).answer
    assert found.trust.startswith("Only as those of the field about the z axis")
    (move,) = re.findall(r"add (\S+) to x_m of the table", found.step)
    moved = hf.magnet_of_blocks(columns | {"x_m": [
        0.3 + each + float(move) for each in columns["x_m"]]})
    for one, other in zip(hf.multipoles(moved).tables, hf.multipoles(ring).tables, strict=True):
        assert one[1]["prior"].main == pytest.approx(other[1]["prior"].main, rel=1e-6)
    assert not page_of(hf.multipoles(moved)).answer.trust.startswith("Only")
