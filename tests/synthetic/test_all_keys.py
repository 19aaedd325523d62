"""The true magnet follows every key of the magnet's language, and its field is the model's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.exact_block_field import external_field, field_of
from halbach_fe.solver.moments.solve import solve_moments
from halbach_fe.study.array_keys import Array, BlockException, Ring
from halbach_fe.study.free_blocks import COLUMNS, SIZES
from halbach_fe.study.iron_keys import IronPrism, IronTube, PlacedIron
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.magpylib_field import vacuum_field
from halbach_fe.synthetic.reaction import separate_reaction
from halbach_fe.synthetic.shapes import SectorBody
from halbach_fe.synthetic.simulate import true_field
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import DIPOLE, changed, circle

POINTS = np.vstack([circle(0.04, 5, z, 0.2 + z) for z in (-0.11, 0.004, 0.06)])

ROUNDING = 2e-9
"""Error in T of magpylib's sectors of some 0.1 m and 1 T; measured up to 6e-10 T, and mostly
7e-11 T."""

RING = {"blocks_per_ring": 8, "inner_radius_m": 0.1, "outer_radius_m": 0.13,
        "ring_length_m": 0.04, "remanence_T": 1.1, "block": {"shape": "cuboid", "width_m": 0.025}}
"""A ring of cuboids with room around each."""


def study_of(array, dimension=3, **keys):
    document = changed(DIPOLE, dimension=dimension, array=array, **keys)
    return parse_study(document)


def both(study, points=POINTS):
    """The model's field (n, 3) in T of the blocks in vacuum, and the simulated one."""
    return (field_of(build_magnet(study).blocks, points),
            vacuum_field(magnet_of(study).bodies, points))


def agree(study, points=POINTS):
    theirs, ours = both(study, points)
    scale = np.abs(theirs).max()
    curved = any(isinstance(body.shape, SectorBody) for body in magnet_of(study).bodies)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * scale + curved * ROUNDING)
    return ours


# --- every key ---------------------------------------------------------------------------------

EXCEPTIONS = {
    "ring": {"ring": 2, "magnetization_factor": 0.5},
    "slot": {"slot": 3, "magnetization_factor": 0.5},
    "recoil_permeability": {"recoil_permeability": 1.3},
    "recoil_permeability_across": {"recoil_permeability_across": 1.3},
    "remanence_T": {"slot": 2, "remanence_T": 0.7},
    "magnetization_angle_deg": {"slot": 2, "magnetization_angle_deg": 33.0},
    "mounted_from": {"slot": 2, "ring": 1, "mounted_from": (2, 7)},
    "magnetization_factor": {"slot": 2, "magnetization_factor": -1.0},
    "magnetization_gradient": {"slot": 2, "magnetization_gradient": 0.2},
    "inner_corner_loss": {"slot": 2, "inner_corner_loss": 0.3},
    "displacement_m": {"slot": 2, "displacement_m": (1e-3, -2e-3, 3e-3)},
    "rotation_deg": {"slot": 2, "rotation_deg": (1.0, 2.0, -3.0)},
    "shift_m": {"slot": 2, "shift_m": (1e-3, -2e-3, 3e-3)},
    "twist_deg": {"slot": 2, "twist_deg": 2.0},
    "tilt_deg": {"slot": 2, "tilt_deg": (2.0, -1.0)},
}
OF_MATERIAL = ("recoil_permeability", "recoil_permeability_across")
"""Keys that change the reaction, and not the field in vacuum."""

SIMPLE = {"blocks_per_ring": 8, "rings": 2, "inner_radius_m": 0.104, "outer_radius_m": 0.1865,
          "ring_length_m": 0.08, "remanence_T": 1.06,
          "block": {"shape": "sector", "angular_gap_deg": 6.0}}


def materials(study):
    return [(body.along, body.across) for body in magnet_of(study).bodies]


@pytest.mark.parametrize("key", BlockException.model_fields)
def test_every_key_of_an_exception(key):
    """Ring and slot select: without them the exception holds for other blocks too."""
    plain, with_key = study_of(SIMPLE), study_of(SIMPLE | {"exceptions": [EXCEPTIONS[key]]})
    if key in OF_MATERIAL:
        assert materials(with_key) != materials(plain)
        np.testing.assert_allclose(
            materials(with_key), [(block.recoil_permeability, block.recoil_permeability_across)
                                  for block in build_magnet(with_key).blocks])
        return
    base = {name: value for name, value in EXCEPTIONS[key].items() if name != key}
    other = (study_of(SIMPLE | {"exceptions": [base]}) if key in ("ring", "slot") else plain)
    assert np.abs(agree(with_key) - both(other)[1]).max() > 1e-6


def test_a_missing_block_has_no_material():
    study = study_of(SIMPLE | {"recoil_permeability": 1.05, "exceptions": [
        {"ring": 1, "slot": 1, "magnetization_factor": 0.0}]})
    first, second, *_ = magnet_of(study).bodies
    assert first.is_vacuum
    assert not any(first.remanence)
    assert not second.is_vacuum


RINGS = {
    "count": ({}, {"count": 2}),
    "layer": ({}, {"layer": 2, "inner_radius_m": 0.2, "outer_radius_m": 0.23}),
    "z_m": ({}, {"z_m": 0.09}), "multipole_order": ({}, {"multipole_order": 2}),
    "blocks_per_ring": ({}, {"blocks_per_ring": 6}),
    "inner_radius_m": ({}, {"inner_radius_m": 0.11}),
    "outer_radius_m": ({}, {"outer_radius_m": 0.12}),
    "ring_length_m": ({}, {"ring_length_m": 0.05}),
    "ring_gap_m": ({"ring_gap_m": 0.007}, {}),
    "first_block_angle_deg": ({}, {"first_block_angle_deg": 10.0}),
    "first_magnetization_angle_deg": ({}, {"first_magnetization_angle_deg": 10.0}),
    "recoil_permeability": ({}, {"recoil_permeability": 1.2}),
    "recoil_permeability_across": ({}, {"recoil_permeability_across": 1.2}),
    "remanence_T": ({}, {"remanence_T": 0.9}),
    "block_moment_A_m2": ({}, {"block_moment_A_m2": 8.0}),
    "block": ({}, {"block": {"shape": "trapezoid", "side_gap_m": 0.002}}),
    "material": ({}, {"material": "N42SH"}),
}


@pytest.mark.parametrize("key", Ring.model_fields)
def test_every_key_of_a_ring(key):
    plain = study_of(RING | {"ring": [{}, {}]})
    with_key = study_of(RING | {"ring": list(RINGS[key])})
    ours = agree(with_key)
    if key in OF_MATERIAL:
        assert materials(with_key) != materials(plain)
        return
    if key == "layer":  # in the same layer the second ring would be stacked on the first
        plain = study_of(RING | {"ring": [{}, RINGS[key][1] | {"layer": 1}]})
    assert np.abs(ours - both(plain)[1]).max() > 1e-6


@pytest.mark.parametrize(("key", "value"), [
    ("multipole_order", 2), ("blocks_per_ring", 9), ("rings", 3), ("inner_radius_m", 0.11),
    ("outer_radius_m", 0.12), ("ring_length_m", 0.05), ("ring_gap_m", 0.01),
    ("first_block_angle_deg", 7.0), ("first_magnetization_angle_deg", 7.0), ("remanence_T", 0.9),
    ("block", {"shape": "cuboid", "width_m": 0.025, "orientation": "magnetization"}),
    ("material", "N42SH"), ("exceptions", [EXCEPTIONS["twist_deg"]]), ("ring", [{}, {"z_m": 0.1}]),
    ("free_blocks", {"name": ["a"], "shape": ["cylinder"], "x_m": [0.2], "y_m": [0.0],
                     "z_m": [0.0], "radius_m": [0.01], "size_z_m": [0.02], "remanence_T": [1.0]}),
    ("block_moment_A_m2", 8.0), ("recoil_permeability", 1.1), ("recoil_permeability_across", 1.1)])
def test_every_key_of_an_array(key, value):
    base = RING | {"rings": 2}
    array = {name: given for name, given in base.items()
             if not (name == "remanence_T" and key in ("block_moment_A_m2", "material"))}
    if key == "ring":
        array.pop("rings")
    study = study_of(array | {key: value})
    ours = agree(study)
    if key in OF_MATERIAL:
        assert materials(study) != materials(study_of(base))
    else:
        assert np.abs(ours - both(study_of(base))[1]).max() > 1e-6


def test_the_lists_of_keys_are_complete():
    assert set(EXCEPTIONS) == set(BlockException.model_fields)
    assert set(RINGS) == set(Ring.model_fields)
    (tested,) = (mark.args[1] for mark in test_every_key_of_an_array.pytestmark)
    assert {key for key, _ in tested} == set(Array.model_fields)
    assert set(FREE) == set(COLUMNS)


OUTLINE = [[0.0, 0.0], [0.04, 0.0], [0.04, 0.04], [0.02, 0.01], [0.0, 0.04]]
PLAIN = {"shape": "cuboid", "x_m": 0.12, "y_m": 0.05, "z_m": 0.01, "size_x_m": 0.03,
         "size_y_m": 0.02, "size_z_m": 0.04, "remanence_T": 1.1}
SECTOR = {"shape": "sector", "x_m": 0.1, "y_m": 0.0, "z_m": 0.0, "inner_radius_m": 0.05,
          "outer_radius_m": 0.07, "angle_deg": 60.0, "size_z_m": 0.04, "remanence_T": 1.1}
TRAPEZOID = {"shape": "trapezoid", "x_m": 0.0, "y_m": 0.12, "z_m": 0.0, "size_x_m": 0.03,
             "inner_width_m": 0.01, "outer_width_m": 0.02, "size_z_m": 0.04, "remanence_T": 1.1}
POLYGON = {"shape": "polygon", "x_m": 0.12, "y_m": 0.0, "z_m": 0.0, "sides": 5,
           "radius_m": 0.02, "size_z_m": 0.04, "remanence_T": 1.1}
PRISM = {"shape": "prism", "x_m": 0.12, "y_m": 0.0, "z_m": 0.0, "outline_m": OUTLINE,
         "size_z_m": 0.04, "remanence_T": 1.1}
FREE = {
    "name": (PLAIN, {}), "type": (PLAIN, {}), "ring": (PLAIN, {}), "slot": (PLAIN, {}),
    "shape": (PLAIN, {"shape": "cylinder", "size_x_m": None, "size_y_m": None, "radius_m": 0.01}),
    "x_m": (PLAIN, {"x_m": 0.11}), "y_m": (PLAIN, {"y_m": 0.04}), "z_m": (PLAIN, {"z_m": 0.02}),
    "rotation_x_deg": (PLAIN, {"rotation_x_deg": 20.0}),
    "rotation_y_deg": (PLAIN, {"rotation_y_deg": 20.0}),
    "rotation_z_deg": (PLAIN, {"rotation_z_deg": 20.0}),
    "size_x_m": (PLAIN, {"size_x_m": 0.02}), "size_y_m": (PLAIN, {"size_y_m": 0.03}),
    "size_z_m": (PLAIN, {"size_z_m": 0.03}),
    "inner_radius_m": (SECTOR, {"inner_radius_m": 0.04}),
    "outer_radius_m": (SECTOR, {"outer_radius_m": 0.06}),
    "angle_deg": (SECTOR, {"angle_deg": 50.0}),
    "inner_width_m": (TRAPEZOID, {"inner_width_m": 0.015}),
    "outer_width_m": (TRAPEZOID, {"outer_width_m": 0.03}),
    "radius_m": (POLYGON, {"radius_m": 0.018}), "sides": (POLYGON, {"sides": 6}),
    "outline_m": (PRISM, {"outline_m": OUTLINE[:3]}),
    "material": (PLAIN, {"remanence_T": None, "material": "N42SH"}),
    "remanence_T": (PLAIN, {"remanence_T": 0.9}),
    **{f"remanence_{axis}_T": (PLAIN, {"remanence_T": None} | {
        f"remanence_{other}_T": 0.5 + 0.1 * (other == axis) for other in "xyz"})
       for axis in "xyz"},
    "recoil_permeability": (PLAIN, {"recoil_permeability": 1.1}),
    "recoil_permeability_across": (PLAIN, {"recoil_permeability_across": 1.1}),
    "magnetization_gradient": (PLAIN, {"magnetization_gradient": 0.2}),
    "inner_corner_loss": (PLAIN, {"inner_corner_loss": 0.3}),
}
"""By column, a block and what changes in it."""


def table_of(*rows):
    columns = dict.fromkeys(column for row in rows for column in row)
    table = {column: [row.get(column) for row in rows] for column in columns}
    return {"name": [f"b{number}" for number in range(len(rows))]} | table


@pytest.mark.parametrize("key", COLUMNS)
def test_every_column_of_free_blocks(key):
    row, change = FREE[key]
    if key.startswith("remanence_") and key != "remanence_T":  # from equal components
        row = {name: value for name, value in row.items() if name != "remanence_T"} | {
            f"remanence_{axis}_T": 0.5 for axis in "xyz"}
    plain = study_of({"free_blocks": table_of(row)})
    if key in ("name", "type"):
        named = study_of({"free_blocks": table_of(row) | {key: ["odd"]}})
        assert getattr(magnet_of(named).bodies[0], key) == "odd"
        return
    if key in ("ring", "slot"):
        placed = study_of({"free_blocks": table_of(row | {"ring": 3, "slot": 4})})
        assert getattr(magnet_of(placed).bodies[0], key) == getattr(
            build_magnet(placed).blocks[0], key) == {"ring": 3, "slot": 4}[key]
        return
    study = study_of({"free_blocks": table_of(row | change)})
    ours = agree(study)
    if key in OF_MATERIAL:
        assert materials(study) != materials(plain)
    else:
        assert np.abs(ours - both(plain)[1]).max() > 1e-7


IRON = {"relative_permeability": 500.0}
TUBE = {"kind": "tube", "inner_radius_m": 0.2, "outer_radius_m": 0.22}
POLE = {"kind": "prism", "outline_m": [[0.2, -0.04], [0.24, -0.04], [0.24, 0.05]], "copies": 1}


def solids(body, dimension=3, **material):
    """The true iron, and the model's, of a ring with one body of iron."""
    study = study_of(RING | {"rings": 1}, dimension, iron={"bodies": [body]} | (material or IRON))
    return magnet_of(study).iron, build_magnet(study).iron


IMAGES = "repeats", "step_m", "mirrored"
"""Keys that make more bodies; `tests.geometry.test_iron` has their places."""


@pytest.mark.parametrize("key", [key for key in PlacedIron.model_fields if key not in IMAGES])
@pytest.mark.parametrize("base", [
    POLE, TUBE, {"kind": "box", "size_m": [0.02, 0.1, 0.05]}, {"kind": "sphere", "radius_m": 0.03}],
    ids=lambda body: body["kind"])
def test_place_and_material_of_a_body_of_iron(base, key, generator):
    """A body in another place fills the same space as the model's, and another one than at home; a
    material of its own is that of the model.
    """
    change = {"centre_m": [0.21, 0.01, 0.1], "rotation_deg": [20.0, -40.0, 5.0],
              "relative_permeability": 10.0, "curve": {"kind": "steel", "name": "aisi_1010"}}[key]
    away = {"centre_m": [0.2, 0.0, 0.0]} if base["kind"] in ("box", "sphere") else {}
    points = generator.uniform(-0.3, 0.3, (20_000, 3))
    inside, laws = [], []
    for body in (base | away | {key: change}, base | away):
        (ours, *_), (theirs, *_) = solids(body)[0].bodies, solids(body)[1]
        np.testing.assert_array_equal(ours.holds(points), theirs.contains(points))
        inside.append(ours.holds(points))
        laws.append(solids(body)[0].laws)
    moved = key == "centre_m" or (key == "rotation_deg" and base["kind"] != "sphere")
    assert (inside[0] != inside[1]).any() == moved
    assert (laws[0] != laws[1]) == (key in ("relative_permeability", "curve"))


@pytest.mark.parametrize("key", [
    key for key in dict.fromkeys([*IronTube.model_fields, *IronPrism.model_fields])
    if key not in PlacedIron.model_fields and key != "holes"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_every_key_of_a_body_of_iron(key, dimension, generator):
    """The iron fills the same space as the model's, and another one than without the key."""
    base = POLE if key in ("outline_m", "copies") else TUBE
    change = {"kind": POLE, "inner_radius_m": {"inner_radius_m": 0.21}, "outer_radius_m": {
        "outer_radius_m": 0.21}, "length_m": {"length_m": 0.1}, "z_m": {"z_m": 0.03},
        "outline_m": {"outline_m": [[0.2, 0.04], [0.23, -0.03], [0.21, -0.03]]},
        "copies": {"copies": 3}}[key]
    body = change if key == "kind" else base | change
    points = generator.uniform(-0.25, 0.25, (20_000, 3)) * [1, 1, 0.4]
    inside = []
    for one in (body, base):
        ours, theirs = solids(one, dimension)
        inside.append(np.any([each.holds(points) for each in ours.bodies], axis=0))
        np.testing.assert_array_equal(
            inside[-1], np.any([each.contains(points) for each in theirs], axis=0))
    assert 10 < inside[0].sum() < 10_000
    assert (inside[0] != inside[1]).any() == (dimension == 3 or key not in ("length_m", "z_m"))


@pytest.mark.parametrize("body", [
    POLE | {"holes": [{"x_m": 0.225, "y_m": -0.025, "radius_m": 0.005}]},
    {"kind": "revolved", "profile_m": [[0, 0.2], [0.1, 0.2], [0, 0.3]]}])
def test_iron_that_no_truth_knows(body):
    """It is refused, not left out."""
    with pytest.raises(StudyError, match="of boxes, prisms without holes, tubes and spheres"):
        magnet_of(study_of(RING | {"rings": 1}, 3, iron={"bodies": [body]} | IRON))
    with pytest.raises(StudyError, match="without holes along z, of one material, since it is 2D"):
        build_magnet(study_of(RING | {"rings": 1}, 2, iron={"bodies": [body]} | IRON))


def test_material_of_iron():
    for material in ({"relative_permeability": 30.0},
                     {"curve": {"kind": "steel", "name": "aisi_1010"}}):
        assert solids(TUBE, **material)[0].law != solids(TUBE)[0].law


def test_external_sources_of_the_study():
    """Neighbours, background and dipoles, with the model's own sum; measured 1e-17 T apart."""
    external = {"background_T": (1e-3, -2e-3, 3e-3), "dipoles": [
        {"position_m": (0.5, 0.1, 0.2), "moment_A_m2": (30.0, 20.0, 10.0)}],
        "neighbours": [{"z_m": 0.4, "turn_deg": 30.0, "factor": -0.5}]}
    study = study_of(RING | {"rings": 1}, external=external)
    magnet = build_magnet(study)
    theirs = field_of(magnet.blocks, POINTS) + external_field(magnet, POINTS)
    np.testing.assert_allclose(true_field(magnet_of(study), POINTS), theirs, atol=1e-12)
    for key in external:  # negative control
        less = {name: value for name, value in external.items() if name != key}
        other = study_of(RING | {"rings": 1}, external=less)
        assert np.abs(true_field(magnet_of(other), POINTS) - theirs).max() > 1e-7


def test_repeated_and_mirrored_iron(generator):
    """The truth has the bodies of the model."""
    ours, theirs = solids({"kind": "sphere", "radius_m": 0.03, "centre_m": [0.2, 0.1, 0.1],
                           "repeats": 2, "step_m": [0.0, 0.1, 0.0], "mirrored": ["x"]})
    assert [(each.origin, each.radius) for each in ours.bodies] == [
        (each.origin_m, each.outer_radius) for each in theirs]
    assert len(theirs) == 4


# --- random magnets ----------------------------------------------------------------------------

lengths = st.floats(0.004, 0.03)
angles = st.floats(-180.0, 180.0)
SIZE = {"size_x_m": lengths, "size_y_m": lengths, "inner_radius_m": st.floats(0.002, 0.009),
        "outer_radius_m": st.floats(0.01, 0.02), "angle_deg": st.floats(5.0, 350.0),
        "inner_width_m": lengths, "outer_width_m": lengths, "radius_m": lengths,
        "sides": st.integers(3, 9), "outline_m": st.sampled_from(
            [[[0.01 * x, 0.3 * y] for x, y in OUTLINE], OUTLINE[::-1], OUTLINE[1:4]])}


@st.composite
def rows(draw, number):
    """One free block in its own part of space, beyond 0.2 m from the axis, where no ring is."""
    shape = draw(st.sampled_from(sorted(SIZES)))
    angle = 2 * np.pi * number / 4
    row = {"shape": shape, "x_m": 0.3 * np.cos(angle), "y_m": 0.3 * np.sin(angle),
           "z_m": draw(st.floats(-0.1, 0.1)), "size_z_m": draw(lengths)}
    row |= {column: draw(SIZE[column]) for column in SIZES[shape]}
    row |= {f"rotation_{axis}_deg": draw(angles) for axis in "xyz"}
    if draw(st.booleans()):
        return row | {"remanence_T": draw(st.floats(0.3, 1.4))}
    return row | {f"remanence_{axis}_T": draw(st.floats(-0.8, 0.8)) for axis in "xyz"}


@st.composite
def ring_tables(draw, number):
    count = draw(st.integers(4, 9))
    inner = draw(st.floats(0.08, 0.1))
    ring = {"blocks_per_ring": count, "inner_radius_m": inner,
            "outer_radius_m": inner + draw(st.floats(0.01, 0.02)), "ring_length_m": draw(lengths),
            "z_m": 0.06 * number, "multipole_order": draw(st.integers(1, 2)),
            "first_block_angle_deg": draw(angles), "first_magnetization_angle_deg": draw(angles),
            "block": draw(st.sampled_from([
                {"shape": "sector", "angular_gap_deg": 12.0},
                {"shape": "trapezoid", "side_gap_m": 0.02},
                {"shape": "cuboid", "width_m": 0.02},
                {"shape": "cuboid", "width_m": 0.02, "orientation": "magnetization"}]))}
    if draw(st.booleans()):
        return ring | {"remanence_T": draw(st.floats(0.3, 1.4))}
    return ring | {"block_moment_A_m2": draw(st.floats(0.1, 0.5))}


@st.composite
def exceptions(draw, four_edges):
    small = st.floats(-2e-3, 2e-3)
    chosen = {"ring": st.integers(1, 2), "slot": st.integers(1, 4),
              "remanence_T": st.floats(0.3, 1.4), "magnetization_angle_deg": angles,
              "mounted_from": st.tuples(st.integers(1, 2), st.integers(1, 4)),
              "magnetization_factor": st.sampled_from([-1.0, 0.0, 0.9]),
              "displacement_m": st.tuples(small, small, small),
              "rotation_deg": st.tuples(*[st.floats(-4.0, 4.0)] * 3),
              "shift_m": st.tuples(small, small, small), "twist_deg": st.floats(-2.0, 2.0),
              "tilt_deg": st.tuples(*[st.floats(-2.0, 2.0)] * 2)}
    if four_edges:
        chosen |= {"magnetization_gradient": st.floats(-0.5, 0.5),
                   "inner_corner_loss": st.floats(0.0, 1.0)}
    keys = draw(st.lists(st.sampled_from(sorted(chosen)), min_size=1, max_size=5, unique=True))
    found = {key: draw(chosen[key]) for key in keys}
    if four_edges == "rings":  # free blocks may have other numbers of edges
        found["ring"] = draw(chosen["ring"])
    return found


@st.composite
def arrays(draw):
    """Two rings of their own, some free blocks, and exceptions, apart from one another."""
    array = {"ring": [draw(ring_tables(number)) for number in (-0.5, 0.5)]}
    if draw(st.booleans()):
        array["free_blocks"] = table_of(*(draw(rows(n)) for n in range(draw(st.integers(1, 4)))))
    array["exceptions"] = draw(st.lists(
        exceptions("rings" if "free_blocks" in array else "all"), max_size=3))
    return array


@settings(max_examples=15)
@given(array=arrays())
def test_fields_of_random_magnets(array):
    """In vacuum, to 1e-9 of the main field or magpylib's rounding; the remanence is some 1 T.

    Negative control: the first block turned by a degree.
    """
    try:
        study = study_of(array)
        build_magnet(study)
    except StudyError:  # of blocks that overlap, or a remanence that no magnet has
        return
    agree(study)
    turned = study_of(array | {"exceptions": [*array["exceptions"], {
        "ring": 1, "slot": 1, "rotation_deg": (0.0, 0.0, 1.0)}]})
    theirs = field_of(build_magnet(study).blocks, POINTS)
    if np.any(magnet_of(study).bodies[0].remanence):
        other = vacuum_field(magnet_of(turned).bodies, POINTS)  # it may touch its neighbours
        assert np.abs(other - theirs).max() > 10 * ROUNDING


PEER_ERROR = 9e-3
"""Of the reaction: 1.5 times what Gauss points of `separate_reaction` were found to be off by, at
most, for blocks of 6 x 20 x 20 mm."""


@settings(max_examples=4)
@given(ring=ring_tables(0), blocks=st.tuples(rows(0), rows(1)),
       permeability=st.sampled_from([1.05, 1.1]))
def test_reactions_of_random_magnets(ring, blocks, permeability):
    """The method of moments against Gauss points and magpylib, which share no code with it.

    The rings are of cuboids, whose closed form magpylib is quick at. Negative control: a
    susceptibility that is a tenth larger.
    """
    array = {"ring": [ring | {"block": {"shape": "cuboid", "width_m": 0.02}}],
             "recoil_permeability": permeability,
             "free_blocks": table_of(*blocks) | {"recoil_permeability": [permeability] * 2}}
    try:
        study = study_of(array)
        magnet = build_magnet(study)
    except StudyError:
        return
    present = [block for block in magnet.blocks if block.remanence]
    ours = solve_moments(present).reaction(POINTS)
    theirs = separate_reaction(magnet_of(study), POINTS)
    size = np.abs(theirs).max()
    assert np.abs(ours - theirs).max() <= PEER_ERROR * size
    stronger = [replace(block, recoil_permeability=1.1 * permeability - 0.1,
                        recoil_permeability_across=1.1 * permeability - 0.1) for block in present]
    assert np.abs(solve_moments(stronger).reaction(POINTS) - theirs).max() > 5 * PEER_ERROR * size
