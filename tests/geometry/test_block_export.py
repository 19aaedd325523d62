"""Blocks of any magnet, exported and read back as free blocks, are the same magnet."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.array_layout import blocks_table
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.free_blocks import read_free_blocks, write_free_blocks
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed
from tests.geometry.test_free_blocks import SHAPES, row

SAME = 1e-12
"""Of the largest field; rounding leaves 1e-15."""

LAYOUTS = {
    "sectors": ("sector", {"shape": "sector"}),
    "sectors with gaps": ("sector", {"shape": "sector", "angular_gap_deg": 2.0}),
    "trapezoids": ("trapezoid", {"shape": "trapezoid", "side_gap_m": 0.002}),
    "cuboids": ("cuboid", {"shape": "cuboid", "width_m": 0.03}),
    "turned cuboids": ("cuboid", {"shape": "cuboid", "width_m": 0.02,
                                  "orientation": "magnetization"})}
MOVES = {"displacement_m", "rotation_deg", "shift_m", "twist_deg", "tilt_deg"}
EXCEPTIONS = [
    {"slot": 1, "remanence_T": 0.9, "recoil_permeability": 1.2},
    {"slot": 2, "recoil_permeability_across": 1.15}, {"slot": 3, "magnetization_angle_deg": 33.0},
    {"ring": 2, "slot": 4, "mounted_from": [1, 3]}, {"slot": 5, "magnetization_factor": -0.9},
    {"ring": 1, "slot": 6, "magnetization_factor": 0.0},
    {"slot": 7, "magnetization_gradient": 0.1, "inner_corner_loss": 0.3},
    {"ring": 2, "slot": 8, "displacement_m": [1e-4, -2e-4, 3e-4]},
    {"slot": 9, "rotation_deg": [0.1, -0.2, 0.15]},
    {"slot": 11, "shift_m": [1e-4, 2e-4, -1e-4], "twist_deg": 0.05},
    {"ring": 2, "slot": 10, "tilt_deg": [0.1, -0.05]},
    {"ring": 2, "slot": 12, "rotation_deg": [0.1, 0.0, 0.1], "displacement_m": [1e-4, 0.0, 0.0],
     "magnetization_factor": -1.05, "inner_corner_loss": 0.2},
    {"slot": 13, "rotation_deg": [180.0, 0.0, 0.0]}]
KEYS = {"ring", "slot"}


def points(dimension=3):
    generator = np.random.default_rng(3)
    found = np.vstack([generator.uniform(-0.06, 0.06, (20, 3)),
                       generator.uniform(0.22, 0.4, (10, 3))])
    return found * [1, 1, dimension == 3]


def again(columns, dimension):
    """The magnet of a study with nothing but this table."""
    return build_magnet(parse_study(changed(
        DIPOLE, dimension=dimension, mesh__block_size_m=0.002, array={"free_blocks": columns})))


def difference(magnet, other):
    at = points(magnet.dimension)
    first, second = (field_of(one.blocks, at) for one in (magnet, other))
    return np.abs(first - second).max() / np.abs(first).max()


def stored(columns, path):
    write_free_blocks(columns, path)
    return read_free_blocks(path)


def assert_same(magnet, columns):
    found = again(columns, magnet.dimension)
    assert difference(magnet, found) < SAME
    there = [block for block in magnet.blocks
             if block.remanence or block.recoil_permeability > 1 or not block.isotropic]
    assert len(found.blocks) == len(there)
    for one, other in zip(there, found.blocks, strict=True):
        assert (one.name, one.ring, one.slot) == (other.name, other.ring, other.slot)
        assert one.recoil_permeability == other.recoil_permeability
        assert np.abs(one.recoil_tensor - other.recoil_tensor).max() < SAME
        assert (one.gradient, one.corner_loss) == (other.gradient, other.corner_loss)
        assert one.volume == pytest.approx(other.volume, rel=SAME)
    return found


def test_exceptions_are_all_keys():
    """The table below would prove little if a key were missing."""
    study = parse_study(changed(DIPOLE, array__exceptions=[{"slot": 1}]))
    keys = set(type(study.array.exceptions[0]).model_fields) - KEYS
    assert {key for exception in EXCEPTIONS for key in exception} - KEYS == keys


@pytest.mark.parametrize("layout", LAYOUTS)
def test_rings_with_all_exceptions(short_dipole, layout, tmp_path):
    shape, block = LAYOUTS[layout]
    outer = 0.1265 if "orientation" in block else 0.15
    exceptions = [one for one in EXCEPTIONS  # there is no room to move without gaps
                  if layout != "sectors" or not MOVES & set(one)]
    magnet = build_magnet(short_dipole(
        array__block=block, array__outer_radius_m=outer, array__exceptions=exceptions,
        array__ring_gap_m=0.01, array__recoil_permeability_across=1.12))
    columns = blocks_table(magnet)
    assert set(columns["shape"]) == {shape}
    assert "r01s06" not in columns["name"]
    assert len(columns["name"]) == 31
    for path in (tmp_path / "blocks.csv", tmp_path / "blocks.h5"):
        assert_same(magnet, stored(columns, path))
    for column, change in {"x_m": 1e-9, "rotation_z_deg": 1e-6, "remanence_z_T": 1e-9,
                           "size_z_m": 1e-9}.items():  # the controls
        wrong = columns | {column: [columns[column][0] + change, *columns[column][1:]]}
        assert difference(magnet, again(wrong, 3)) > SAME


def test_what_is_in_the_table(short_dipole):
    """A sector of the second ring: sizes as in the study, its origin on the axis of the arcs."""
    magnet = build_magnet(short_dipole(array__block={"shape": "sector", "angular_gap_deg": 2.5},
                                       array__material="N42", array__remanence_T=1.06))
    columns = blocks_table(magnet)
    number = columns["name"].index("r02s03")
    one = {column: values[number] for column, values in columns.items()}
    expected = {"x_m": 0, "y_m": 0, "z_m": 0.04, "rotation_x_deg": 0, "rotation_y_deg": 0,
                "rotation_z_deg": 135, "inner_radius_m": 0.104, "outer_radius_m": 0.1865,
                "angle_deg": 20, "size_z_m": 0.08, "remanence_x_T": 0, "remanence_y_T": -1.06}
    assert {column: one[column] for column in expected} == pytest.approx(expected, abs=1e-13)
    assert (one["ring"], one["slot"], one["material"]) == (2, 3, "N42")
    assert not {"size_x_m", "magnetization_gradient", "type", "remanence_T"} & set(columns)


def test_cross_sections(dipole):
    exceptions = [{"slot": 2, "rotation_deg": [0, 0, 0.3], "displacement_m": [1e-4, 0, 1e-3]},
                  {"slot": 3, "twist_deg": 0.1}, {"slot": 5, "magnetization_factor": 0},
                  {"slot": 6, "rotation_deg": [180, 0, 0]},
                  {"slot": 7, "rotation_deg": [-180, 0, 0], "magnetization_gradient": 0.1}]
    for block in ({"shape": "sector", "angular_gap_deg": 1}, LAYOUTS["trapezoids"][1]):
        magnet = build_magnet(dipole(array__block=block, array__exceptions=exceptions))
        columns = blocks_table(magnet)
        assert "size_z_m" not in columns
        assert_same(magnet, columns)
    with pytest.raises(StudyError, match="instead block r01s04 is tilted"):
        blocks_table(build_magnet(dipole(
            array__block=block, array__exceptions=[{"slot": 4, "rotation_deg": [1, 0, 0]}])))


def test_rings_of_their_own(short_dipole):
    rings = [{"inner_radius_m": 0.05, "outer_radius_m": 0.09, "blocks_per_ring": 8},
             {"block": LAYOUTS["cuboids"][1], "layer": 2, "ring_length_m": 0.05,
              "material": "N45", "remanence_T": 1.2}]
    magnet = build_magnet(short_dipole(array__ring=rings, array__rings=2))
    columns = blocks_table(magnet)
    assert columns["shape"] == ["sector"] * 8 + ["cuboid"] * 16
    assert columns["material"] == [None] * 8 + ["N45"] * 16
    assert_same(magnet, columns)


turns = st.tuples(*[st.floats(-180, 180)] * 3)


@pytest.mark.parametrize("kind", SHAPES)
@settings(max_examples=6)
@given(turn=turns, displaced=st.booleans(), rotation=turns)
def test_free_blocks(kind, turn, displaced, rotation):
    """Of any shape and pose, beside a ring; displaced ones are rotated twice, in this order."""
    gradient = 0.2 if SHAPES[kind].get("sides") == 4 or kind in (
        "cuboid", "sector", "trapezoid") else None
    columns = row(kind, z_m=0.3, x_m=0.02, material="N42", type="special",
                  magnetization_gradient=gradient,
                  **{f"rotation_{axis}_deg": value
                     for axis, value in zip("xyz", turn, strict=True)})
    exception = {"ring": 2, "displacement_m": [1e-3, 2e-3, -3e-3], "rotation_deg": rotation,
                 "magnetization_factor": -0.9, "twist_deg": 3.0}
    magnet = build_magnet(parse_study(changed(
        DIPOLE, dimension=3, array__ring_length_m=0.1, array__free_blocks=columns,
        array__exceptions=[exception] * displaced)))
    found = blocks_table(magnet)
    assert (found["shape"][-1], found["type"][-1]) == (columns["shape"][0], "special")
    assert_same(magnet, found)
    if not displaced:  # nothing is rounded
        for column in ("x_m", "z_m", "rotation_x_deg", "rotation_y_deg", "rotation_z_deg"):
            assert found[column][-1] == columns[column][0]


def test_an_export_of_an_export_is_the_same(short_dipole):
    magnet = build_magnet(short_dipole(
        array__exceptions=EXCEPTIONS, array__block=LAYOUTS["sectors with gaps"][1],
        array__ring_gap_m=0.01))
    first = blocks_table(magnet)
    second = blocks_table(again(first, 3))
    for column, values in first.items():
        if column.startswith("remanence"):  # its size and direction are separated in between
            np.testing.assert_allclose(values, second[column], atol=1e-15)
        else:
            assert values == second[column]
