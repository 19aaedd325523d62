"""Rings of their own, exceptions by place, and arrays that cannot be."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.array_layout import ring_limits
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.array_keys import Array
from halbach_fe.study.materials import grade
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed
from tests.geometry.test_free_blocks import row

SECTOR = {"shape": "sector"}
COMMON = {"blocks_per_ring": 16, "inner_radius_m": 0.1, "outer_radius_m": 0.15,
          "ring_length_m": 0.05, "remanence_T": 1.2, "block": SECTOR}
FREE = {"name": ["b"], "shape": ["cuboid"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.5],
        "size_x_m": [0.02], "size_y_m": [0.02], "size_z_m": [0.02], "remanence_T": [1.0]}


def study_of(array, **changes):
    return parse_study(changed(DIPOLE, **({"dimension": 3, "array": array} | changes)))


def array_of(rings, **common):
    return study_of(COMMON | {"ring": rings} | common).array


@pytest.mark.parametrize(("rings", "limits"), [
    ([{}, {}], [(-0.06, -0.01), (0.01, 0.06)]),  # a gap of 20 mm between two of 50 mm
    ([{"ring_length_m": 0.03}, {}, {"ring_gap_m": 0.5}],
     [(-0.085, -0.055), (-0.035, 0.015), (0.035, 0.085)]),
    ([{"ring_gap_m": 0.0}, {}], [(-0.05, 0.0), (0.0, 0.05)]),
    ([{"z_m": 0.3}, {}, {}], [(0.275, 0.325), (-0.06, -0.01), (0.01, 0.06)]),
    ([{}, {"layer": 2, "ring_length_m": 0.12}, {"layer": 1}],
     [(-0.06, -0.01), (-0.06, 0.06), (0.01, 0.06)]),
    ([{"layer": 3}], [(-0.025, 0.025)])])
def test_stacks(rings, limits):
    """Worked out by hand: in the order of the file, a gap after each, centred, layer by layer."""
    array = array_of(rings, ring_gap_m=0.02)
    assert ring_limits(array, 3) == pytest.approx(np.array(limits), abs=1e-15)
    assert ring_limits(array, 2) == [(-np.inf, np.inf)] * len(rings)
    shifted = array_of(rings, ring_gap_m=0.021)
    same = np.allclose(ring_limits(shifted, 3), limits)
    assert same == (len(rings) == 1 or rings[0] == {"ring_gap_m": 0.0})


def test_equal_rings_are_the_same_either_way():
    own = array_of([{}, {}, {}], ring_gap_m=0.01)
    equal = study_of(COMMON | {"rings": 3, "ring_gap_m": 0.01}).array
    assert own.blocks_by_ring == equal.blocks_by_ring == (16, 16, 16)
    assert (own.is_uniform, equal.is_uniform) == (False, True)
    first, second = (build_magnet(study_of(array)) for array in (own, equal))
    for one, other in zip(first.blocks, second.blocks, strict=True):
        assert (one.name, one.outline, one.easy_axis) == (other.name, other.outline,
                                                          other.easy_axis)
        assert (one.z_min, one.z_max) == pytest.approx((other.z_min, other.z_max), abs=1e-15)


def test_values_of_a_ring():
    array = array_of([
        {"blocks_per_ring": 8, "multipole_order": 2, "remanence_T": 1.0, "inner_radius_m": 0.02,
         "outer_radius_m": 0.05, "first_block_angle_deg": 10.0},
        {"block_moment_A_m2": 30.0, "recoil_permeability": 1.1},
        {"material": "N42", "block": {"shape": "cuboid", "width_m": 0.01}, "layer": 2,
         "inner_radius_m": 0.2, "outer_radius_m": 0.23}], recoil_permeability_across=1.02)
    assert array.blocks_by_ring == (8, 16, 16)
    one, two, three = (array.of_ring(number) for number in (1, 2, 3))
    assert (one.blocks_per_ring, one.multipole_order, one.remanence_T) == (8, 2, 1.0)
    assert one.recoil_permeability_across == 1.02
    assert (two.remanence_T, two.block_moment_A_m2) == (None, 30.0)
    assert (two.recoil_permeability, one.recoil_permeability) == (1.1, 1.0)
    assert three.remanence_T == grade("N42").nominal_remanence
    assert three.recoil_permeability == grade("N42").recoil_permeability
    assert three.block.shape == "cuboid"
    for ring in (one, two, three):
        assert (ring.rings, ring.ring, ring.free_blocks, ring.exceptions) == (1, (), None, ())
    assert array.of_ring(2) == array.of_ring(2) != array.of_ring(3)
    blocks = build_magnet(study_of(array)).blocks
    assert [block.name for block in blocks[7:9]] == ["r01s08", "r02s01"]
    assert blocks[1].angle_deg == pytest.approx(55.0)
    # a quadrupole: the magnetization turns three times as fast as the position
    assert blocks[1].easy_axis == pytest.approx((np.cos(np.radians(135)), np.sin(np.radians(135)),
                                                 0))


def test_rings_give_what_the_array_does_not():
    """Keys that all rings have need not be given once more."""
    ring = {key: COMMON[key] for key in COMMON if key != "ring_length_m"}
    array = study_of({"ring": [ring | {"ring_length_m": 0.05}] * 2}).array
    assert (array.rings, array.blocks_by_ring, array.multipole_order) == (2, (16, 16), 1)
    quadrupole = study_of({"ring": [ring | {"ring_length_m": 0.05, "multipole_order": 2}] * 2})
    assert quadrupole.array.multipole_order == 2  # of which centre, axis and roll are asked
    one = {key: value for key, value in ring.items() if key not in ("block", "blocks_per_ring")}
    with pytest.raises(StudyError, match=r"array\.block"):
        study_of({"ring": [ring, one]})


@pytest.mark.parametrize(("rings", "common", "said"), [
    ([{}, {"remanence": 1.0}], {}, r"array\.ring\[2\].*Did you mean `remanence_T`"),
    ([{}, {"outer_radius_m": 0.05}], {}, r"ring 2: outer_radius_m \(0.05\) must be larger"),
    ([{}, {"inner_radius_m": 50}], {}, "Was it meant in millimetres"),
    ([{"remanence_T": 1.1}, {"block_moment_A_m2": 9, "remanence_T": 1.0}], {},
     "ring 2: give exactly one of remanence_T and block_moment_A_m2"),
    ([{"remanence_T": 1.1}, {}], {"remanence_T": None},
     "ring 2: give exactly one of remanence_T and block_moment_A_m2"),
    ([{}, {"block_moment_A_m2": 9}], {"ring_length_m": None}, "needs ring_length_m"),
    ([{}, {"layer": 0}], {}, "greater than or equal to 1"),
    ([{}, {"material": "N43"}], {}, "no magnet grade is called 'N43'"),
    ([{}], {"rings": 3}, "rings = 3, but there are 1 tables"),
    ([{}], {"ring_length_m": None}, "ring_length_m"),
    ([{"blocks_per_ring": 3}], {}, "greater than or equal to 4"),
    ([{"block": {"shape": "sphere"}}], {}, "'sector'"),
    ([{"z_m": 0.0}, {"z_m": 0.02}], {}, "overlap"),
    ([{}, {"layer": 2}], {}, "overlap")])
def test_refusals(rings, common, said):
    with pytest.raises(StudyError, match=said):
        build_magnet(study_of(COMMON | {"ring": rings} | common))
    build_magnet(study_of(COMMON | {"ring": [{}] * len(rings)}))


@pytest.mark.parametrize(("array", "said"), [
    ({"rings": 0}, "at least one ring, or free_blocks"),
    ({"free_blocks": FREE | {"name": ["r01s07"]}}, "a free block is called r01s07"),
    ({"free_blocks": FREE, "block": None}, "array.block"),
    ({"exceptions": [{"ring": 2}]}, "an exception names ring 2 of an array of 1 rings"),
    ({"exceptions": [{"slot": 17}]}, "slot 17 of an array of 1 rings of 16 blocks"),
    ({"exceptions": [{"slot": 1, "mounted_from": [1, 17]}]}, "was meant for ring 1, slot 17"),
    ({"free_blocks": FREE, "exceptions": [{"ring": 2, "slot": 2}]},
     "ring 2, slot 2 of an array of 2 rings of 16, 1 blocks"),
    ({"free_blocks": FREE | {"ring": [1], "slot": [3]}, "exceptions": [{"ring": 2, "slot": 2}]},
     "ring 2, slot 2"),
    ({"free_blocks": FREE | {"ring": [2], "slot": [1]}, "exceptions": [{"ring": 2}]}, "ring 2"),
    ({"free_blocks": FREE | {"ring": [1], "slot": [3]},
      "exceptions": [{"slot": 1, "mounted_from": [2, 1]}]}, "was meant for ring 2, slot 1")])
def test_refusals_of_arrays(array, said):
    with pytest.raises(StudyError, match=said):
        study_of(COMMON | array)
    study_of(COMMON | {"free_blocks": FREE, "exceptions": [{"ring": 2, "slot": 1}]})


def test_exceptions_of_own_rings_and_free_blocks():
    """Each holds for its block alone, or for the slot of all rings."""
    array = COMMON | {"ring": [{}, {"blocks_per_ring": 8}], "free_blocks": FREE, "exceptions": [
        {"ring": 2, "slot": 3, "remanence_T": 0.9}, {"slot": 16, "magnetization_factor": 0.5},
        {"ring": 3, "slot": 1, "magnetization_angle_deg": 90.0, "displacement_m": [0, 0, 0.01]},
        {"ring": 1, "slot": 1, "mounted_from": [3, 1]}]}
    magnet = build_magnet(study_of(array))
    plain = build_magnet(study_of({key: array[key] for key in array if key != "exceptions"}))
    differ = {one.name for one, other in zip(magnet.blocks, plain.blocks, strict=True)
              if one != other}
    assert differ == {"r02s03", "r01s16", "b", "r01s01"}
    of = {block.name: block for block in magnet.blocks}
    assert (of["r02s03"].remanence, of["r01s16"].remanence) == (0.9, 0.6)
    assert of["b"].easy_axis == pytest.approx((0, 1, 0), abs=1e-15)
    assert of["b"].displacement_m == pytest.approx((0, 0, 0.01), abs=1e-15)
    assert of["r01s01"].mounted_from == (3, 1)


@pytest.mark.parametrize(("kind", "edges"), [("cylinder", 4), ("prism", 5), ("polygon", 7)])
def test_exceptions_that_need_four_edges(kind, edges):
    free = row(kind, z_m=0.5)
    for key in ("magnetization_gradient", "inner_corner_loss"):
        array = COMMON | {"free_blocks": free, "exceptions": [{"ring": 2, key: 0.1}]}
        with pytest.raises(StudyError, match=r"straight.*instead block b"):
            build_magnet(study_of(array))
    assert len(build_magnet(study_of(COMMON | {"free_blocks": free})).blocks[-1].outline) == edges


def test_dumped_arrays_are_read_again():
    for array in (COMMON | {"ring": [{}, {"layer": 2, "inner_radius_m": 0.2,
                                          "outer_radius_m": 0.25}]},
                  COMMON | {"free_blocks": FREE}, {"free_blocks": FREE}):
        found = study_of(array, mesh__block_size_m=0.005)
        assert parse_study(found.model_dump()) == found
        assert isinstance(found.array, Array)
        assert found.with_(array__recoil_permeability=1.1) != found
