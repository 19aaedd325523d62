"""Tables of free blocks: what is accepted, what is refused, and how blocks are numbered."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from halbach_fe.core.errors import StudyError
from halbach_fe.study.free_blocks import COLUMNS, SIZES, FreeBlocks, RowError
from halbach_fe.study.materials import grade
from halbach_fe.study.reader import parse_study
from halbach_fe.study.types import crossing
from tests.conftest import DIPOLE, changed

SIZE = {"size_x_m": 0.02, "size_y_m": 0.03, "inner_radius_m": 0.05, "outer_radius_m": 0.08,
        "angle_deg": 20.0, "inner_width_m": 0.01, "outer_width_m": 0.02, "radius_m": 0.01,
        "sides": 6, "outline_m": ((0.0, 0.0), (0.02, 0.0), (0.01, 0.02))}


def table(count=1, **columns):
    """Columns of cuboids, some changed; a column that is None is left out."""
    one = {"name": "b", "shape": "cuboid", "x_m": 0.0, "y_m": 0.0, "z_m": 0.0, "size_x_m": 0.02,
           "size_y_m": 0.03, "size_z_m": 0.04, "remanence_T": 1.2}
    found = {column: [value] * count for column, value in one.items()}
    found["name"] = [f"b{number + 1}" for number in range(count)]
    found["x_m"] = [0.1 * number for number in range(count)]
    return {column: values for column, values in (found | columns).items() if values is not None}


def of_shape(shape, **columns):
    cuboid = dict.fromkeys(("size_x_m", "size_y_m"))
    sizes = {column: [SIZE[column]] for column in SIZES[shape]}
    return table(**(cuboid | sizes | {"shape": [shape]} | columns))


@pytest.mark.parametrize("shape", SIZES)
def test_every_shape_needs_its_own_sizes_and_no_others(shape):
    assert FreeBlocks(**of_shape(shape)).shape == (shape,)
    for column in SIZE:
        if column in SIZES[shape]:
            with pytest.raises(ValidationError, match=f"b1 in row 1, a {shape}, needs {column}"):
                FreeBlocks(**of_shape(shape, **{column: [None]}))
        else:
            with pytest.raises(ValidationError, match=f"b1 in row 1, a {shape}, has no {column}"):
                FreeBlocks(**of_shape(shape, **{column: [SIZE[column]]}))


@pytest.mark.parametrize(("columns", "said"), [
    ({"name": []}, "there is no column name: add it"),
    ({"name": ["b1", "b1"]}, "name must be unique to a block, but b1 occurs twice"),
    ({"name": ["b1", "b 2"]}, "should match pattern"),
    ({"x_m": [0.0]}, "column x_m has 1 rows, and there are 2 names"),
    ({"z_m": None}, "there is no column z_m: add it"),
    ({"shape": None}, "there is no column shape: add it"),
    ({"name": None}, "there is no column name: add it"),
    ({"x_m": [None, None]}, "column x_m has no value: give it, as every block needs name"),
    ({"shape": ["cuboid", "sphere"]}, "'cuboid', 'sector'"),
    ({"ring": [1, 1]}, "ring and slot together"),
    ({"ring": [1, 1], "slot": [2, 2]}, r"ring and slot must be unique.*\(1, 2\) occurs twice"),
    ({"ring": [1_000_000, 1], "slot": [1, 1_000_000]}, "of which most would be empty"),
    ({"remanence_T": None}, "b1 in row 1 needs either remanence_T or remanence_x_T"),
    ({"remanence_T": [1.0, None]}, "b2 in row 2 needs either"),
    ({"remanence_x_T": [0.1, None]}, "b1 in row 1 needs either"),
    ({"remanence_T": [1.0, None], "remanence_x_T": [None, 0.1]}, "b2 in row 2 needs all of"),
    ({"size_x_m": [0.02, 20]}, "less than 10"),
    ({"remanence_T": [1.0, np.nan]}, "finite"),
    ({"recoil_permeability": [1.0, 0.9]}, "greater than or equal to 1"),
    ({"material": ["N42", "N43"]}, "no magnet grade is called 'N43'"),
    ({"colour": ["red", "red"]}, "Extra inputs"),
    ({"file": "blocks.csv"}, "the file has not been read")])
def test_refusals(columns, said):
    with pytest.raises(ValidationError, match=said):
        FreeBlocks(**table(2, **columns))
    FreeBlocks(**table(2))


def test_blocks_without_any_column():
    with pytest.raises(ValidationError, match="there is no block; give a file"):
        FreeBlocks()


@pytest.mark.parametrize(("shape", "columns", "said"), [
    ("sector", {"outer_radius_m": [0.05]}, "not larger than its inner_radius_m"),
    ("prism", {"outline_m": [((0, 0), (1, 1), (1, 0), (0, 1))]}, "edges cross"),
    ("prism", {"outline_m": [((0, 0), (1, 1), (2, 2))]}, "no area"),
    ("prism", {"outline_m": [((-10, -10), (10, -10), (10, 10), (-10, 10))]}, "in mm"),
    ("prism", {"outline_m": [((-5, -5), (5, -5), (5, 5), (-5, 5))]}, "in mm"),
    ("prism", {"outline_m": [((0, 0), (2e-5, 0), (0, 2e-5))]}, "not 0.0001 m to 10 m wide"),
    ("cuboid", {"x_m": [25.0]}, "x_m and y_m in mm"),
    ("cylinder", {"magnetization_gradient": [0.1]}, "which has not four edges"),
    ("polygon", {"inner_corner_loss": [0.1]}, "which has not four edges"),
    ("prism", {"inner_corner_loss": [0.1]}, "which has not four edges"),
    ("sector", {"angle_deg": [179.0], "magnetization_gradient": [0.1]}, "not four edges")])
def test_refusals_of_shapes(shape, columns, said):
    with pytest.raises(ValidationError, match=said) as caught:
        FreeBlocks(**of_shape(shape, **columns))
    assert isinstance(caught.value.errors()[0]["ctx"]["error"], RowError)


@pytest.mark.parametrize(("shape", "columns"), [
    ("sector", {}), ("cuboid", {}), ("trapezoid", {}), ("polygon", {"sides": [4]}),
    ("prism", {"outline_m": [((0, 0), (1, 0), (1, 1), (0, 1))]})])
def test_gradients_of_four_edges(shape, columns):
    one = of_shape(shape, magnetization_gradient=[0.1], inner_corner_loss=[0.2], **columns)
    assert FreeBlocks(**one).magnetization_gradient == (0.1,)


def test_crossing_polygons(generator):
    """Star polygons (p, q): edges cross if they go round more than once; a comb has collinear
    edges that do not.
    """
    for corners in (5, 7, 12):
        angles = 2 * np.pi * np.arange(corners) / corners
        plain = np.column_stack([np.cos(angles), np.sin(angles)])
        star = plain[(2 * np.arange(corners)) % corners] if corners % 2 else plain[::-1]
        moved = np.stack([plain, star]) * 1e-3 + generator.uniform(-10, 10, 2)
        assert crossing(moved).tolist() == [False, bool(corners % 2)]
    comb = np.array([[(0, 0), (5, 0), (5, 2), (4, 2), (4, 1), (1, 1), (1, 2), (0, 2)]], float)
    assert not crossing(comb)[0]
    comb[0, 5] = 4.5, 1.5  # beyond the tooth
    assert crossing(comb)[0]


def test_polygons_that_go_round_a_part_of_it_twice(generator):
    """Prisms of such an outline had twice the field; a slit that leads to a hole has none."""
    outer = [(-2, -2), (2, -2), (2, 2), (-2, 2)]
    hole = [(-1, -1), (-1, 1), (1, 1), (1, -1)]  # clockwise
    spike = [(0, 0), (2, 0), (2, 1), (2, 0), (2, -1), (0, -1)]
    corner = [(0, 0), (1, 0), (1, 1), (0, 1)]
    wrong = {"twice": outer * 2, "hole counted twice":
             [*outer, outer[0], *hole[:1], *hole[:0:-1], hole[0]],
             "the other way": [(0, 0), (1, 0), (2, 1), (2, -1), (1, 0), (0, 1)],
             "loop at a corner": [*outer, outer[0], (1, -1), (0, 0), (-1, 1)]}
    right = {"hole": [*outer, outer[0], *hole, hole[0]], "spike": spike,
             "corner twice": [*corner, (0, 0), (-1, 0), (-1, -1), (0, -1)],
             "repeated corner": [*corner, corner[-1], corner[0]]}
    angle = np.radians(generator.uniform(0, 360))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for expected, outlines in ((True, wrong), (False, right)):
        for name, outline in outlines.items():
            for moved in (np.array(outline, float), 0.01 * np.array(outline) @ turn + [0.3, -0.2]):
                assert crossing(moved[None])[0] == expected, name
                assert crossing(moved[None, ::-1])[0] == expected, name


def test_many_polygons_are_compared_in_parts(monkeypatch, generator):
    polygons = generator.uniform(-1, 1, (300, 4, 2))
    whole = crossing(polygons)
    assert 0.1 < whole.mean() < 0.9
    monkeypatch.setattr("halbach_fe.study.types.MAX_PAIRS", 100)
    assert np.array_equal(crossing(polygons), whole)


def test_places_by_height_and_angle():
    """Heights that differ by less than a micrometre are one ring; slots count by angle."""
    angles = np.radians([90, 0, 270, 180])
    blocks = FreeBlocks(**table(
        8, x_m=np.tile(0.1 * np.cos(angles), 2).tolist(),
        y_m=np.tile(0.1 * np.sin(angles), 2).tolist(),
        z_m=[0.05, 0.05 + 2e-7, 0.05, 0.05, -0.05, -0.05, -0.05, -0.05]))
    slots = (2, 1, 4, 3)
    assert blocks.places == tuple([(2, slot) for slot in slots] + [(1, slot) for slot in slots])
    assert blocks.blocks_by_ring == (4, 4)
    scattered = FreeBlocks(**table(3, z_m=[0.0, 0.1, 0.2]))
    assert scattered.places == ((1, 1), (1, 2), (1, 3))  # hardly a ring


def test_places_that_are_given():
    blocks = FreeBlocks(**table(3, ring=[2, 1, 1], slot=[1, 5, 2]))
    assert blocks.places == ((2, 1), (1, 5), (1, 2))
    assert blocks.blocks_by_ring == (5, 1)


def test_grades_of_rows():
    """The grade gives what the row does not; the remanence of a row, in any form, wins."""
    found = grade("N42")
    blocks = FreeBlocks(**table(
        4, material=["n42", "N42", "N42", None], remanence_T=[None, 1.1, None, 1.2],
        remanence_x_T=[None, None, 0.1, None], remanence_y_T=[None, None, 0.0, None],
        remanence_z_T=[None, None, 0.2, None], recoil_permeability=[None, None, 1.2, None]))
    assert blocks.material == ("N42", "N42", "N42", None)
    assert blocks.remanence_T == (found.nominal_remanence, 1.1, None, 1.2)
    assert blocks.recoil_permeability == (
        found.recoil_permeability, found.recoil_permeability, 1.2, None)


def test_rows_of_another_grade():
    blocks = FreeBlocks(**table(3, material=["N52", None, "N52"], remanence_T=[None, 1.0, 1.44]))
    changed_blocks = blocks.with_(material=("N35H", None, "N35H"))
    assert changed_blocks.remanence_T == (grade("N35H").nominal_remanence, 1.0, 1.44)


def test_a_validated_table_is_not_validated_again(monkeypatch):
    """Otherwise every change of a study with 100 000 blocks would take half a second."""
    document = changed(DIPOLE, dimension=3, array={"free_blocks": table(3)})
    study = parse_study(document)
    calls = []
    monkeypatch.setattr(FreeBlocks, "_check_sizes", lambda self: calls.append(self))
    after = study.with_(mesh__growth=1.7, array__recoil_permeability=1.1)
    assert after.array.free_blocks is study.array.free_blocks
    assert not calls
    parse_study(document)
    assert calls  # the control: columns are


def test_a_study_with_free_blocks_is_stored_and_read():
    study = parse_study(changed(DIPOLE, dimension=3, array={"free_blocks": table(3)}))
    assert parse_study(study.model_dump()) == study
    assert study != study.with_(array__free_blocks=FreeBlocks(**table(2)))
    assert set(COLUMNS) == set(type(study.array.free_blocks).model_fields) - {"file"}


def test_defaults_of_columns():
    blocks = FreeBlocks(**table(2, rotation_z_deg=[90.0, None]))
    assert blocks.rotations_rad == pytest.approx(np.array([[0, 0, np.pi / 2], [0, 0, 0]]))
    assert np.isnan(blocks.numbers("recoil_permeability", np.nan)).all()
    assert blocks.given("rotation_z_deg").tolist() == [True, False]
    assert not blocks.given("angle_deg").any()
    assert FreeBlocks(**table(2, angle_deg=[None, None])) == FreeBlocks(**table(2))


def test_a_study_names_the_block():
    with pytest.raises(StudyError, match="block b2 in row 2, a cuboid, needs size_y_m"):
        parse_study(changed(DIPOLE, array={
            "free_blocks": table(2, size_y_m=[0.1, None])}))


@pytest.mark.parametrize(("shape", "columns", "radii"), [
    ("cuboid", {"x_m": [0.3], "y_m": [0.4]}, (0.485, 0.515)),
    ("cylinder", {"x_m": [0.3]}, (0.29, 0.31)),
    ("sector", {}, (0.05, 0.08)), ("sector", {"x_m": [0.01]}, (0.04, 0.09)),
    ("prism", {"y_m": [-0.3]}, (0.3 - np.hypot(0.01, 0.02), 0.3 + np.hypot(0.01, 0.02))),
    ("polygon", {}, (1e-4, 0.01))])
def test_radii(shape, columns, radii):
    """Rough: half the largest width to either side."""
    assert FreeBlocks(**of_shape(shape, **columns)).radii_m == pytest.approx(radii)
