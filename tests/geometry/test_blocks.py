"""Where blocks are, and what is inside them."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

import halbach_fe as hf
from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.geometry.magnet import build_magnet

SHAPES = {
    "sector": {"shape": "sector"},
    "sector with gap": {"shape": "sector", "angular_gap_deg": 4.0},
    "trapezoid": {"shape": "trapezoid", "side_gap_m": 0.002},
    "cuboid": {"shape": "cuboid", "width_m": 0.03},
    "turned cuboid": {"shape": "cuboid", "width_m": 0.02, "orientation": "magnetization"},
}
AREAS = {
    "sector": np.pi / 16 * (0.1865**2 - 0.104**2),
    "sector with gap": np.radians(18.5) / 2 * (0.1865**2 - 0.104**2),
    "trapezoid": (0.1865**2 - 0.104**2) * np.tan(np.pi / 16)
    - 0.0825 * 0.002 / np.cos(np.pi / 16),
    "cuboid": 0.03 * 0.0825,
}


@pytest.mark.parametrize("shape", AREAS)
def test_area(dipole, shape):
    for block in build_magnet(dipole(array__block=SHAPES[shape])).blocks:
        assert block.area == pytest.approx(AREAS[shape], rel=1e-12)


@pytest.mark.parametrize("shape", [name for name in SHAPES if name != "turned cuboid"])
def test_contains_agrees_with_area(dipole, generator, shape):
    """Monte Carlo: the fraction of points inside equals the area, within 4 sigma."""
    block = build_magnet(dipole(array__block=SHAPES[shape])).blocks[2]
    points = np.column_stack([generator.uniform(-0.2, 0.2, (200_000, 2)), np.zeros(200_000)])
    fraction = block.contains(points).mean()
    expected = block.area / 0.16
    assert fraction == pytest.approx(expected, abs=4 * np.sqrt(expected / 200_000))


def test_arcs_decide_at_the_bulge(dipole):
    """Between chord and arc: outside at the inner face, inside at the outer one."""
    block = build_magnet(dipole()).blocks[0]  # centred at 90 degrees
    radii = np.array([0.1035, 0.1045, 0.186, 0.187])
    points = np.column_stack([0 * radii, radii, 0 * radii])
    assert block.contains(points).tolist() == [False, True, True, False]
    chord_middle = 0.104 * np.cos(np.pi / 16)
    assert not block.contains(np.array([[0, (0.104 + chord_middle) / 2, 0]]))[0]


def test_slots_and_magnetization_follow_the_published_dipole(dipole):
    """FASER: block i at 90 + (i-1) 22.5 deg, magnetized along 180 + (i-1) 45 deg."""
    blocks = build_magnet(dipole()).blocks
    centre = np.mean([edge.start for edge in blocks[4].outline], axis=0)
    assert np.degrees(np.arctan2(centre[1], centre[0])) == pytest.approx(180.0)
    assert blocks[4].easy_axis == pytest.approx((1, 0, 0), abs=1e-12)


def test_rings_are_centred_and_apart(short_dipole):
    study = short_dipole(array__rings=3, array__ring_gap_m=0.01)
    limits = np.array(build_magnet(study).ring_limits)
    assert limits == pytest.approx(-limits[::-1, ::-1])
    assert limits[1:, 0] - limits[:-1, 1] == pytest.approx(0.01)


def test_overlapping_cuboids_are_refused(dipole):
    with pytest.raises(StudyError, match="overlap"):
        build_magnet(dipole(array__block={"shape": "cuboid", "width_m": 0.05}))
    with pytest.raises(StudyError, match="overlap"):
        build_magnet(dipole(array__block={
            "shape": "cuboid", "width_m": 0.0825, "orientation": "magnetization"}))


def test_many_narrow_neighbours(dipole):
    """Sectors and trapezoids that share faces are apart; cuboids a little too wide are not."""
    many = {"array__blocks_per_ring": 256}
    build_magnet(dipole(**many))
    build_magnet(dipole(**many, array__block={"shape": "trapezoid", "side_gap_m": 0.0}))
    pitch = 2 * 0.104 * np.tan(np.pi / 256)
    build_magnet(dipole(**many, array__block={"shape": "cuboid", "width_m": 0.999 * pitch}))
    with pytest.raises(StudyError, match="overlap"):
        build_magnet(
            dipole(**many, array__block={"shape": "cuboid", "width_m": 1.001 * pitch}))


def test_crossing_cuboids_are_refused(dipole):
    """Thin cuboids that cross like swords hold no corner or centre of each other."""
    with pytest.raises(StudyError, match="overlap"):
        build_magnet(dipole(array__inner_radius_m=0.1, array__outer_radius_m=0.2, array__block={
            "shape": "cuboid", "width_m": 0.002, "orientation": "magnetization"}))


def test_iron_and_blocks_are_material_air_is_not(short_dipole):
    study = short_dipole(iron_ring={"inner_radius_m": 0.19, "outer_radius_m": 0.2,
                                    "relative_permeability": 100.0, "length_m": 0.1})
    points = np.array([[0, 0, 0], [0, 0.15, 0.0], [0, 0.195, 0.0], [0, 0.195, 0.06],
                       [0, 0.188, 0.0], [0, 0.15, 0.2]])
    assert build_magnet(study).contains(points).tolist() == [False, True, True, False, False, False]


@pytest.mark.parametrize(("scale", "asked"), [(0.01, False), (0.8, False), (8.0, True)])
def test_blocks_that_are_in_mm_are_asked_about(scale, asked):
    """Blocks of 8 mm, of which 8 m were written."""
    with pytest.warns(HalbachWarning, match="in mm") if asked else nullcontext():
        hf.magnet_of_blocks({
            "shape": ["cuboid", "cuboid"], "x_m": [-scale, scale], "y_m": [0.0, 0.0],
            "z_m": [0.0, 0.0], "remanence_T": [1.3, 1.3]} | {
                f"size_{axis}_m": [scale, scale] for axis in "xyz"})
