"""The exact field of prisms against magpylib, against a closed form, and against Maxwell."""

from __future__ import annotations

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver import exact_block_field, field_kernels
from halbach_fe.solver.exact_block_field import (
    FieldOfBlocks,
    demagnetizing_tensors,
    field_of,
    gradient_of,
    unit_field,
    unit_fields,
)
from halbach_fe.solver.field_kernels import arc_table
from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
from halbach_fe.study.reader import parse_study
from tests.conftest import circle
from tests.oracles.sectors import bore_field

MAGPYLIB_ERROR = 1e-6
"""magpylib's cylinder segments carry about 2e-8 of the remanence near the axis; ours changes by
4e-14 if arcs have twice as many Gauss points. 1e-6 leaves room for other versions of magpylib."""


def scattered(study, generator, count=600):
    """Points in the bore, beyond the ends, outside, and above the blocks."""
    points = np.vstack([
        np.column_stack([generator.uniform(-0.07, 0.07, (count, 2)),
                         generator.uniform(-0.3, 0.3, count)]),
        generator.uniform(-0.4, 0.4, (count, 3)),
    ])
    return points[~build_magnet(study).contains(points)]


def magpylib_block(study, block):
    middle = position_angle_deg(study.array, block.slot)
    place = (0, 0, (block.z_min + block.z_max) / 2)
    inner, outer = study.array.inner_radius_m, study.array.outer_radius_m
    length = block.z_max - block.z_min
    if study.array.block.shape == "sector":
        return magpylib.magnet.CylinderSegment(
            dimension=(inner, outer, length, middle - 11.25, middle + 11.25), position=place)
    corners = np.array([edge.start for edge in block.outline])
    hull = [(x, y, z) for x, y in corners for z in (block.z_min, block.z_max)]
    return magpylib.magnet.TriangularMesh.from_ConvexHull(points=hull)


@pytest.mark.parametrize("shape", [
    {"shape": "sector"}, {"shape": "trapezoid", "side_gap_m": 0.001},
    {"shape": "cuboid", "width_m": 0.03},
    {"shape": "cuboid", "width_m": 0.02, "orientation": "magnetization"}],
    ids=lambda shape: f"{shape['shape']}-{shape.get('orientation', '')}")
def test_one_block_against_magpylib(short_dipole, generator, shape):
    """Sign, magnitude, all three components, all three magnetizations."""
    outer = 0.1265 if shape.get("orientation") else 0.1865
    study = short_dipole(array__block=shape, array__outer_radius_m=outer)
    block = build_magnet(study).blocks[3]
    points = scattered(study, generator)
    ours = unit_field(block, points)
    for axis in range(3):
        source = magpylib_block(study, block)
        source.polarization = np.eye(3)[axis]
        np.testing.assert_allclose(ours[:, :, axis], source.getB(points), atol=MAGPYLIB_ERROR)


def test_only_rectangles_are_cuboids(monkeypatch, short_dipole):
    """Cuboids have a closed form of their own. Negative control: of a trapezoid it is wrong."""
    def unit(**shape):
        study = short_dipole(array__block=shape)
        return unit_field(build_magnet(study).blocks[3], scattered(study, np.random.default_rng(1)))

    cuboid, trapezoid = {"shape": "cuboid", "width_m": 0.03}, {"shape": "trapezoid"}
    expected, other = unit(**cuboid), unit(**trapezoid)
    assert exact_block_field._rectangle(build_magnet(
        short_dipole(array__block=trapezoid)).blocks[3].outline) is None
    monkeypatch.setattr(exact_block_field, "_rectangle", exact_block_field._rectangle.__wrapped__)
    monkeypatch.setattr(exact_block_field, "_RECTANGULAR", 10.0)
    assert np.abs(unit(**trapezoid) - other).max() > 1e-3
    monkeypatch.setattr(exact_block_field, "_rectangle", lambda outline: None)
    np.testing.assert_allclose(unit(**cuboid), expected, atol=1e-13)  # some 24 terms of size 1


def test_near_a_curved_face(short_dipole, generator):
    """From 10 mm down to 1 um off the inner face, where the arc is halved some 15 times."""
    study = short_dipole()
    block = build_magnet(study).blocks[3]
    middle = np.radians(position_angle_deg(study.array, block.slot))
    angle = middle + np.radians(generator.uniform(-11, 11, 60))
    radius = 0.104 - 10 ** generator.uniform(-6, -2, 60)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle),
                              generator.uniform(block.z_min, block.z_max, 60)])
    source = magpylib_block(study, block)
    source.polarization = (0.3, -0.5, 0.7)
    np.testing.assert_allclose(unit_field(block, points) @ source.polarization,
                               source.getB(points), atol=MAGPYLIB_ERROR)
    # negative control: arcs that are never halved are wrong there
    with pytest.MonkeyPatch.context() as patch:
        arc_table.cache_clear()
        patch.setattr(field_kernels, "ARC_LEVELS", 1)
        coarse = unit_field(block, points) @ source.polarization
        arc_table.cache_clear()
    assert np.abs(coarse - source.getB(points)).max() > 1e-2


def test_the_comparison_can_fail(short_dipole, generator):
    """Turning one block's magnetization by a tenth of a degree is seen."""
    study = short_dipole()
    block, points = build_magnet(study).blocks[3], scattered(study, generator)
    source = magpylib_block(study, block)
    source.polarization = (np.cos(np.radians(0.1)), np.sin(np.radians(0.1)), 0)
    assert np.abs(unit_field(block, points)[:, :, 0] - source.getB(points)).max() > (
        100 * MAGPYLIB_ERROR)


def test_full_array_against_magpylib(short_dipole, generator):
    study = short_dipole(array__recoil_permeability=1.0)
    points = scattered(study, generator, 200)
    expected = np.zeros_like(points)
    for block in build_magnet(study).blocks:
        source = magpylib_block(study, block)
        source.polarization = np.array(block.easy_axis) * block.remanence
        expected += source.getB(points)
    np.testing.assert_allclose(field_of(build_magnet(study).blocks, points), expected,
                               atol=10 * MAGPYLIB_ERROR)


def test_cross_section_against_closed_form(dipole):
    """Two derivations of the same field: rounding only."""
    points = circle(0.09)
    sectors = ideal_sectors(1, 16, 1.06, np.pi / 2, np.pi)
    series = bore_field(sectors, 0.104, 0.1865, points[:, :2])
    np.testing.assert_allclose(field_of(build_magnet(dipole()).blocks, points)[:, :2], series,
                               atol=1e-13)
    layered = layered_bore_field(sectors, 0.104, 0.1865, 1.0, points[:, :2])
    np.testing.assert_allclose(layered, series, atol=1e-13)


def test_segmented_dipole_against_halbach():
    """B0 = B_r ln(ro/ri) sin(2 pi/N)/(2 pi/N) (K. Halbach, NIM 169 (1980) 1), N = 16."""
    found = bore_field(ideal_sectors(1, 16, 1.0), 0.104, 0.1865, np.zeros((1, 2)))[0]
    expected = np.log(0.1865 / 0.104) * np.sin(np.pi / 8) / (np.pi / 8)
    assert found == pytest.approx([expected, 0.0], abs=1e-14)


def test_field_obeys_maxwell_in_air(short_dipole, generator):
    """Divergence and curl by central differences; step 1e-4 m leaves h^2/6 B''' ~ 1e-4 T/m."""
    study = short_dipole()
    block, step = build_magnet(study).blocks[5], 1e-4
    points = np.column_stack([generator.uniform(-0.06, 0.06, (50, 2)),
                              generator.uniform(-0.2, 0.2, 50)])
    gradient = np.stack([
        (unit_field(block, points + step * axis) - unit_field(block, points - step * axis))
        / (2 * step) for axis in np.eye(3)], axis=1)  # [point, derivative, component, source]
    divergence = np.trace(gradient, axis1=1, axis2=2)
    curl = gradient - gradient.transpose(0, 2, 1, 3)
    assert np.abs(gradient).max() > 1.0
    assert np.abs(divergence).max() < 1e-4
    assert np.abs(curl).max() < 1e-4


@pytest.mark.parametrize("dimension", [2, 3])
def test_gradient(dipole, short_dipole, dimension):
    """Against differences along all three axes of the field, which magpylib knows above: their
    step of 1e-5 m leaves 1e-7 T/m; the step of 1e-4 of the radius 1e-6 of the gradient at 3 cm
    from the blocks. At 1.5 mm, a hundredth of the radius, 1e-3 is left. On the axis, which has no
    radial direction, nothing is special.
    """
    blocks = build_magnet(dipole() if dimension == 2 else short_dipole()).blocks
    points = np.vstack([circle(0.075, 5, z) for z in (0.0, 0.05, 0.12)]
                       + [[0, 0, 0.1], [0.1025, 0, 0.02]])
    steps = 1e-5 * np.eye(3)
    expected = np.stack([(field_of(blocks, points + step) - field_of(blocks, points - step)) / 2e-5
                         for step in steps], axis=2)
    found = gradient_of(blocks, points)
    np.testing.assert_allclose(found[:-1], expected[:-1], atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(found[-1], expected[-1], atol=3e-3 * np.abs(expected[-1]).max())
    # the comparison sees a component exchanged
    turned = found[:, [1, 0, 2]]
    assert np.abs(turned - expected).max() > 0.1 * np.abs(expected).max()


def test_finite_and_continuous_above_an_edge(short_dipole):
    """On the prolongation of a vertical edge, rho = 0, the field is an ordinary number."""
    block = build_magnet(short_dipole()).blocks[0]
    x, y = block.outline[0].start
    there = unit_field(block, np.array([[x, y, 0.3]]))
    nearby = unit_field(block, np.array([[x + 1e-9, y - 1e-9, 0.3]]))
    assert np.isfinite(there).all()
    np.testing.assert_allclose(there, nearby, atol=1e-8)


@pytest.mark.parametrize(("angles", "evaluated"), [(64, 3), (40, 5), (37, 32)])
@pytest.mark.parametrize("shape", ["sector", "trapezoid"])
def test_blocks_of_a_ring_are_evaluated_once_on_circles(
    short_dipole, generator, monkeypatch, shape, angles, evaluated
):
    """Two rings of 16 blocks: one block each, and one that is displaced by a micrometre, where the
    angles are a multiple of 16; two blocks each and the displaced one for 40 angles, as every
    second block is five steps further; all for 37. Rounding.
    """
    study = short_dipole(array__block={"shape": shape}, array__exceptions=[
        {"ring": 2, "slot": 7, "displacement_m": [1e-6, 0.0, 0.0]},
        {"ring": 1, "slot": 3, "magnetization_factor": -0.7}])
    blocks = build_magnet(study).blocks
    start = 0.1
    middle, z = generator.uniform(0.19, 0.2, 5), generator.uniform(-0.1, 0.1, 5)
    points = np.vstack([
        np.column_stack([middle * np.cos(angle), middle * np.sin(angle), z])
        for angle in start + 2 * np.pi * np.arange(angles) / angles])
    exact = field_of(blocks, points)
    calls = []
    local = exact_block_field._local_field

    def counted(block, where):
        calls.extend([block] * (len(where) == len(points)))
        return local(block, where)

    monkeypatch.setattr(exact_block_field, "_local_field", counted)
    found = FieldOfBlocks(blocks)(points)
    assert len(calls) == evaluated
    assert np.abs(found - exact).max() < 1e-12 * np.abs(exact).max()
    elsewhere = points + generator.uniform(-1e-3, 1e-3, points.shape)
    one_by_one = sum(unit_field(block, elsewhere) @ (block.remanence * np.array(block.easy_axis))
                     for block in blocks)
    np.testing.assert_allclose(FieldOfBlocks(blocks)(elsewhere), one_by_one,
                               rtol=1e-12, atol=1e-13)
    in_place = build_magnet(short_dipole(array__block={"shape": shape})).blocks  # control
    assert np.abs(field_of(in_place, points) - exact).max() > 1e-7 * np.abs(exact).max()


@pytest.mark.parametrize("shape", [
    {"shape": "sector", "angular_gap_deg": 4.0}, {"shape": "trapezoid", "side_gap_m": 0.005},
    {"shape": "cuboid", "width_m": 0.02, "orientation": "magnetization"}],
    ids=lambda shape: shape["shape"])
def test_blocks_at_once_are_those_one_by_one(short_dipole, generator, monkeypatch, shape):
    """Blocks that are turned, moved or not uniform share the evaluation of a shape, or do not."""
    study = short_dipole(array__block=shape, array__outer_radius_m=0.1265, array__exceptions=[
        {"ring": 1, "slot": 2, "displacement_m": [1e-3, 2e-3, -1e-3]},
        {"ring": 1, "slot": 3, "rotation_deg": [1.0, -2.0, 3.0]},
        {"ring": 1, "slot": 4, "magnetization_gradient": 0.1},
        {"ring": 1, "slot": 5, "inner_corner_loss": 0.5}])
    blocks, points = build_magnet(study).blocks, scattered(study, generator, 30)
    for found, block in zip(unit_fields(blocks, points), blocks, strict=True):
        np.testing.assert_allclose(found, unit_field(block, points), rtol=1e-12, atol=1e-13)
    alone = [demagnetizing_tensors([block])[0] for block in blocks]
    calls, whole = [], exact_block_field._outline_field
    monkeypatch.setattr(exact_block_field, "_outline_field", lambda block, points: (
        calls.append(block), whole(block, points))[1])
    np.testing.assert_allclose(demagnetizing_tensors(blocks), alone, atol=1e-12)
    # besides one with a gradient and one with a corner, all 32 are told by one, or by as many as
    # angles between easy axis and place
    assert len(calls) == (18 if "orientation" in shape else 3)
    # negative control: outlines are not turned onto each other
    monkeypatch.setattr(exact_block_field, "_turn_deg", lambda block: 0.0)
    monkeypatch.setattr(exact_block_field, "_upright", lambda outline, angle: outline is None)
    wrong = next(iter(list(unit_fields(blocks, points))[1:2]))
    assert np.abs(wrong - unit_field(blocks[1], points)).max() > 1e-4


def test_scaling(short_dipole, generator):
    """B depends on shape, not on size: all lengths doubled, same field."""
    small = short_dipole()
    large = short_dipole(array__inner_radius_m=0.208, array__outer_radius_m=0.373,
                         array__ring_length_m=0.16)
    points = np.column_stack([generator.uniform(-0.06, 0.06, (20, 2)),
                              generator.uniform(-0.2, 0.2, 20)])
    np.testing.assert_allclose(field_of(build_magnet(small).blocks, points),
                               field_of(build_magnet(large).blocks, 2 * points), atol=1e-12)


def test_equal_blocks_are_evaluated_at_once(monkeypatch, generator):
    """343 cubes in any pose, one of them with a face through a point, in one call of the closed
    form, against magpylib; a block of another size is one more call.
    """
    places = np.stack(np.meshgrid(*3 * [0.03 * np.arange(-3, 4)]), axis=-1).reshape(-1, 3)
    turns = generator.uniform(-60, 60, places.shape)
    turns[0] = 0
    points = np.vstack([generator.uniform(0.12, 0.2, (3, 3)), places[0] - [0.005, 0, 0]])
    table = {"name": [f"b{i}" for i in range(343)], "shape": 343 * ["cuboid"],
             **dict(zip(("x_m", "y_m", "z_m"), places.T.tolist(), strict=True)),
             **{f"rotation_{axis}_deg": turns[:, i].tolist() for i, axis in enumerate("xyz")},
             **{f"size_{axis}_m": 343 * [0.01] for axis in "xyz"}, "remanence_T": 343 * [1.2]}

    def blocks_of(**changes):
        return build_magnet(parse_study({
            "name": "cubes", "dimension": 3, "mesh": {"block_size_m": 0.01},
            "array": {"recoil_permeability": 1.0, "free_blocks": {**table, **changes}},
            "observation": {"quantity": "flux_density", "positions": {
                "kind": "points", "points_m": [[0, 0, 0.5]]}}})).blocks

    blocks, calls, whole = blocks_of(), [], exact_block_field._outline_field
    monkeypatch.setattr(exact_block_field, "_outline_field", lambda block, points: (
        calls.append(len(points)), whole(block, points))[1])
    found = field_of(blocks, points)
    assert calls == [343 * len(points)]
    outside = np.vstack([points[:3], points[3] - [1e-12, 0, 0]])  # the limit that a face stands for
    expected = sum(magpylib.magnet.Cuboid(
        polarization=(1.2, 0, 0), dimension=3 * [0.01], position=place,
        orientation=Rotation.from_rotvec(turn, degrees=True)).getB(outside)
        for place, turn in zip(places, turns, strict=True))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    calls.clear()
    field_of(blocks_of(size_x_m=[0.011, *342 * [0.01]]), points)
    assert len(calls) == 2
