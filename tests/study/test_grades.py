"""Grades of magnets: a table that is consistent, names that are found, and rows refused by name."""

from __future__ import annotations

import csv
import math
import warnings
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from scipy import stats

from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.magnets import magnet_of_blocks, write_study
from halbach_fe.study import materials as module
from halbach_fe.study.materials import Demagnetization, check_grade, grade, grades, read_grades
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study, read_study

FOLDER = resources.files("halbach_fe.study")
TABLE, SOURCES = FOLDER / "grades.csv", FOLDER / "grade_sources.csv"
LINES = [line for line in TABLE.read_text(encoding="utf-8").splitlines()
         if not line.startswith("#")]
HEADER = LINES[0].split(",")
MU_0 = 4e-7 * math.pi
OERSTED, GAUSS = 1e3 / (4 * math.pi), 1e-4  # in A/m and T

ROW = {
    "name": "X1", "aliases": "X one;X-I", "family": "NdFeB", "remanence_min_T": "1.2",
    "remanence_max_T": "1.3", "normal_coercivity_A_per_m": "9e5",
    "intrinsic_coercivity_A_per_m": "1e6", "energy_product_min_J_per_m3": "270000",
    "energy_product_max_J_per_m3": "310000", "recoil_permeability": "1.05",
    "remanence_coefficient_per_K": "-0.001", "coercivity_coefficient_per_K": "",
    "coefficients_from_C": "20", "coefficients_to_C": "100", "max_temperature_C": "100",
    "density_min_kg_per_m3": "7400", "density_max_kg_per_m3": "7500", "source": "maker",
    "other_sources": "",
}


def read(folder: Path, *rows: dict[str, str]) -> dict[str, module.Grade]:
    """Return the grades of rows that are written to files and read back."""
    with (folder / "grades.csv").open("w", encoding="utf-8", newline="") as file:
        file.write("# a comment\n")
        table = csv.DictWriter(file, HEADER)
        table.writeheader()
        table.writerows(rows)
    (folder / "sources.csv").write_text('key,document\nmaker,"A sheet, rev. 2"\n')
    return read_grades(folder / "grades.csv", folder / "sources.csv")


RINGS = {"blocks_per_ring": 8, "inner_radius_m": 0.03, "outer_radius_m": 0.06,
         "ring_length_m": 0.03, "block": {"shape": "sector"}}
CUBES = {"name": ["a", "b"], "shape": ["cuboid"] * 2, "x_m": [0.04, -0.04], "y_m": [0.0] * 2,
         "z_m": [0.0] * 2, **{f"size_{axis}_m": [0.02] * 2 for axis in "xyz"}}


@pytest.mark.parametrize(("array", "named"), [
    (RINGS | {"material": "N42", "rings": 2}, ["N42"]),
    (RINGS | {"ring": [{"material": "N42"}] * 2}, ["N42"]),
    (RINGS | {"ring": [{"material": "N42"}, {"material": "N48"}]}, ["N42", "N48"]),
    (RINGS | {"material": "N42", "ring": [{}, {"material": "N48"}]}, ["N42", "N48"]),
    ({"free_blocks": CUBES | {"material": ["N42", "N48"]}}, ["N42", "N48"]),
    (RINGS | {"ring": [{"remanence_T": 1.3}, {"material": "N48"}]}, ["N48"]),
    # negative controls: a strength that is stated is that of no range, and another one is not there
    (RINGS | {"remanence_T": 1.3, "ring": [{}, {}]}, []),
    (RINGS | {"ring": [{"material": "N42", "remanence_T": 1.3}] * 2}, []),
    (RINGS | {"material": "N42", "remanence_T": 1.3}, []),
    (RINGS | {"remanence_T": 1.3, "free_blocks": CUBES | {
        "remanence_T": [1.2] * 2, "material": ["N42"] * 2, "z_m": [0.1] * 2}}, [])])
def test_what_blocks_of_a_grade_share_wherever_it_is_named(array: dict[str, Any], named: list[str]):
    """The range of the remanence: N42 has 0.44 %, N48 0.82 %. It is in the study's own file."""
    with warnings.catch_warnings(action="ignore", category=HalbachWarning):
        study = parse_study({
            "name": "graded", "mesh": {"block_size_m": 0.02}, "array": array, "observation": {
                "quantity": "flux_density",
                "positions": {"kind": "points", "points_m": [[0, 0, 0]]}}})
    if "ring" not in array and "material" not in array and study.array.rings:
        assert study.array.recoil_permeability == 1.0  # not that of the free blocks' grade
    assert study.prior.remanence_sd == {name: grade(name).remanence_sd for name in named}
    assert study.prior.common_mode_sd is None
    again = parse_study(study.model_dump(mode="json"))
    assert again.prior == study.prior


@pytest.mark.parametrize("name", list(grades()))
def test_every_grade_is_consistent(name: str):
    """What a maker promises fits together, and the study's keys accept it."""
    one = grades()[name]
    check_grade(one)
    assert one.source
    low, high = one.remanence_T
    assert low < one.nominal_remanence < high
    assert 0 < one.remanence_sd < 0.06  # the widest range, of isotropic ferrite, is 16 %
    defaults = one.demagnetization_defaults
    assert all(key in Demagnetization.model_fields for key in defaults)
    if {"remanence_coefficient_per_K", "coercivity_coefficient_per_K"} <= defaults.keys():
        Demagnetization(**defaults, temperature_C=one.max_temperature_C)


def test_the_table_has_every_column_that_is_read():
    """The control of the rows that the tests write: they have the columns of the real table."""
    assert set(ROW) == set(HEADER)


def test_every_source_is_used():
    """No document is listed that nothing was taken from, and none is missing."""
    with SOURCES.open(encoding="utf-8") as file:
        listed = {row["key"] for row in csv.DictReader(
            line for line in file if not line.startswith("#"))}
    used = {key for row in csv.DictReader(LINES)
            for key in (row["source"], *row["other_sources"].split())}
    assert used == listed


@pytest.mark.parametrize(("name", "gauss", "oersted"), [
    # the tables of K&J Magnetics in their own units, typed from the page and not from the CSV
    ("N42", (13_000, 13_200), 12_000), ("N42SH", (13_000, 13_300), 20_000),
    ("N48H", (13_600, 14_200), 16_000), ("N40UH", (12_600, 12_900), 25_000),
])
def test_units_are_those_of_the_sheet(name: str, gauss: tuple[int, int], oersted: int):
    """The conversion of units holds; coercivities are rounded to 1 kA/m."""
    one = grade(name)
    assert one.remanence_T == pytest.approx([value * GAUSS for value in gauss], rel=1e-12)
    assert one.intrinsic_coercivity_A_per_m == pytest.approx(oersted * OERSTED, abs=501)


def test_nominal_remanence_and_its_standard_deviation():
    """They are those of a uniform distribution over the range."""
    one = grade("YXG28H")
    low, high = one.remanence_T
    uniform = stats.uniform(low, high - low)
    assert one.nominal_remanence == pytest.approx(uniform.mean(), rel=1e-12)
    assert one.remanence_sd == pytest.approx(uniform.std() / uniform.mean(), rel=1e-12)


def test_the_energy_product_is_that_of_a_straight_line():
    """(BH)_max tells the recoil permeability of the fully magnetized rare-earth grades.

    Independently of the sheets' own recoil permeability of 1.05, B_r^2 / (4 mu_0 (BH)_max) at the
    middle of the ranges is it; both are rounded (see `ENERGY_TOLERANCE`).
    """
    for one in grades().values():
        if one.family == "ferrite":
            continue
        energy = sum(one.energy_product_J_per_m3) / 2
        implied = one.nominal_remanence**2 / (4 * MU_0 * energy)
        assert implied == pytest.approx(one.recoil_permeability, rel=module.ENERGY_TOLERANCE)


@pytest.mark.parametrize("name", ["N42SH", "n42sh", "N 42 SH", "n42-sh", "42SH"])
def test_names_are_found_in_any_spelling(name: str):
    assert grade(name) is grades()["N42SH"]


@pytest.mark.parametrize(("name", "hint"), [
    ("N42HS", "no magnet grade is called 'N42HS'; similar are N42H, N42UH, N42SH"),
    ("YXG29H", "similar are YXG2"),
    ("steel", "there are N35, N38"),
    ("", "there are N35, N38"),
])
def test_an_unknown_name_is_refused_with_a_hint(name: str, hint: str):
    with pytest.raises(ValueError, match="no magnet grade") as error:
        grade(name)
    assert hint in str(error.value)


def test_the_grades_are_read_once_and_cannot_be_changed():
    assert grades() is grades()
    with pytest.raises(TypeError):
        grades()["N42"] = grade("N35")  # type: ignore[index]


def test_a_good_row_passes(tmp_path: Path):
    """The control of all rows that are refused below."""
    one = read(tmp_path, ROW)["X1"]
    assert one.aliases == ("X one", "X-I")
    assert one.source == "A sheet, rev. 2"
    assert one.coefficient_range_C == (20.0, 100.0)
    assert one.demagnetization_defaults == {
        "intrinsic_coercivity_A_per_m": 1e6, "remanence_coefficient_per_K": -0.001,
        "reference_temperature_C": 20.0}


BAD_ROWS = {
    "no source": ({"source": ""}, "grade X1 needs"),
    "unknown source": ({"source": "hearsay"}, "grade X1 needs hearsay"),
    "unknown other source": ({"other_sources": "maker hearsay"}, "grade X1 needs hearsay"),
    "no value": ({"recoil_permeability": ""}, "grade X1 needs recoil_permeability"),
    "no number": ({"max_temperature_C": "hot"}, "max_temperature_C must be a number"),
    "family": ({"family": "steel"}, "its family must be one of NdFeB"),
    "exchanged": ({"remanence_min_T": "1.3", "remanence_max_T": "1.2"},
                  "remanence_T must begin with the smaller value"),
    "one value": ({"remanence_min_T": "1.3"}, "remanence_T must be a range"),
    "gauss": ({"remanence_max_T": "13000"}, "remanence_T must be 0.15 to 1.55, not 13000"),
    "kA/m": ({"intrinsic_coercivity_A_per_m": "1000"}, "must be 100000 to 4e+06, not 1000"),
    "oersted": ({"normal_coercivity_A_per_m": "11000"}, "normal_coercivity_A_per_m must be"),
    "MGOe": ({"energy_product_max_J_per_m3": "39"}, "energy_product_J_per_m3 must be"),
    "per cent": ({"remanence_coefficient_per_K": "-0.12"}, "must be -0.003 to -0.0001, not -0.12"),
    "sign": ({"remanence_coefficient_per_K": "0.001"}, "remanence_coefficient_per_K must be"),
    "rising coercivity": ({"coercivity_coefficient_per_K": "0.003"}, "except for ferrite"),
    "g/cm3": ({"density_min_kg_per_m3": "7.4"}, "density_kg_per_m3 must be"),
    "H_cB above H_cJ": ({"intrinsic_coercivity_A_per_m": "8.9e5"}, "not be larger than H_cJ"),
    "H_cB above B_r": ({"normal_coercivity_A_per_m": "1.01e6",
                        "intrinsic_coercivity_A_per_m": "2e6"}, "B_r / (mu_0 mu_rec) = 9.85e+05"),
    "too much energy": ({"energy_product_min_J_per_m3": "300000",
                         "energy_product_max_J_per_m3": "330000"}, "(BH)_max must not be larger"),
}


@pytest.mark.parametrize("name", BAD_ROWS)
def test_a_bad_row_is_refused(tmp_path: Path, name: str):
    change, expected = BAD_ROWS[name]
    with pytest.raises(ValueError, match="grade X1") as error:
        read(tmp_path, ROW | change)
    assert expected in str(error.value)


def test_the_coercivity_of_ferrite_may_rise():
    """Its anisotropy field rises faster than its polarization falls."""
    one = grade("Y30")
    assert one.coercivity_coefficient_per_K > 0
    check_grade(one)
    with pytest.raises(ValueError, match="except for ferrite"):
        check_grade(replace(one, family="SmCo5"))


@pytest.mark.parametrize("alias", ["X1", "x-1", "Xone", "x i"])
def test_two_rows_must_not_share_a_name(tmp_path: Path, alias: str):
    other = ROW | {"name": "X2", "aliases": ""}
    assert set(read(tmp_path, ROW, other)) == {"X1", "X2"}
    with pytest.raises(ValueError, match="grade X2: X1 is also called"):
        read(tmp_path, ROW, other | {"aliases": alias})


CUBES = {"multipole_order": 1, "blocks_per_ring": 12, "inner_radius_m": 0.06,
         "outer_radius_m": 0.08, "ring_length_m": 0.02,
         "block": {"shape": "cuboid", "width_m": 0.02}}


def study_with(**array: Any) -> Study:
    """Return a study of cubes with other keys of its array."""
    return parse_study({
        "name": "cubes", "array": CUBES | array, "mesh": {"block_size_m": 0.01},
        "observation": {"quantity": "flux_density",
                        "positions": {"kind": "points", "points_m": [[0, 0, 0]]}},
        "demagnetization": {"temperature_C": 60.0, "squareness": 0.8,
                            "remanence_coefficient_per_K": -0.0012,
                            "coercivity_coefficient_per_K": -0.006}
        | ({} if "material" in array else {"intrinsic_coercivity_A_per_m": 9e5})})


def test_another_grade_replaces_what_the_first_one_said():
    changed = study_with(material="N52").with_(array__material="N35H")
    told = study_with(material="N35H")
    assert changed.array == told.array
    assert changed.array.remanence_T == 1.19
    assert changed.prior == told.prior
    assert told.prior.remanence_sd == {"N35H": grade("N35H").remanence_sd}
    weaker = told.with_(array__remanence_T=1.18)  # as an effect that is found, not as stated
    assert weaker.prior == told.prior
    assert changed.demagnetization == told.demagnetization
    assert changed.demagnetization.squareness == 0.8  # the study's own
    own = study_with(material="N52", remanence_T=1.43).with_(array__recoil_permeability=1.02)
    kept = own.with_(array__material="N50M")  # 1.43 T is in the range of both
    assert (kept.array.remanence_T, kept.array.recoil_permeability) == (1.43, 1.02)
    assert kept.prior.remanence_sd == own.prior.remanence_sd == {}
    both = study_with(material="N52").with_(array__material="N35H", array__remanence_T=1.2)
    assert both.array.remanence_T == 1.2


def test_a_remanence_that_is_none_of_the_grade_is_doubted(tmp_path):
    with pytest.warns(HalbachWarning, match="= 1.3 wins over its material, as N52 has 1.42 to"):
        doubted = study_with(remanence_T=1.3).with_(array__material="N52")
    assert doubted.array.remanence_T == 1.3
    path = tmp_path / "study.toml"
    write_study(doubted, path)
    with pytest.warns(HalbachWarning, match="`array`: remanence_T = 1.3 wins over"):
        read_study(path)
    write_study(study_with(remanence_T=1.44, material="N52"), tmp_path / "control.toml")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_study(tmp_path / "control.toml")


def test_a_strength_beside_free_blocks_alone_is_doubted():
    """They have their own; that of the grade, which says their permeability too, is none given."""
    magnet = magnet_of_blocks({
        "shape": ["cuboid"], "x_m": [0.04], "y_m": [0.0], "z_m": [0.0], "size_x_m": [0.02],
        "size_y_m": [0.02], "size_z_m": [0.02], "remanence_T": [1.2]})
    for key, value in {"remanence_T": 1.45, "block_moment_A_m2": 9.0}.items():
        with pytest.warns(HalbachWarning, match=rf"{key} of \[array\] is without effect"):
            changed = magnet.with_(**{f"array__{key}": value})
        assert (changed.field_T([0, 0, 0]) == magnet.field_T([0, 0, 0])).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        magnet.with_(array__material="N52")


def test_a_new_table_has_what_the_grade_says_as_in_a_file():
    """It asked for the coefficients of a grade that it knew, and a new prior lost its remanences.
    A grade that lacks them asks for them alone, and does with them.
    """
    new = {"demagnetization": {"temperature_C": 80.0}, "prior": {"direction_sd_deg": 0.5}}
    base = {"name": "cubes", "mesh": {"block_size_m": 0.01}, "observation": {
        "quantity": "flux_density", "positions": {"kind": "points", "points_m": [[0, 0, 0]]}}}
    for ring in ({}, {"ring": [{"material": "N42"}, {"material": "N35"}]}):
        array = {"array": CUBES | {"material": "N42"} | ring}
        plain, told = parse_study(base | array), parse_study(base | array | new)
        found = plain.with_(**new)
        assert found.demagnetization == told.demagnetization
        assert found.prior == told.prior
        assert found.prior.remanence_sd
        assert found.prior.direction_sd_deg == 0.5
    lacking = parse_study(base | {"array": CUBES | {"material": "N42UH"}})
    with pytest.raises(StudyError, match="coercivity_coefficient_per_K` of changed Study must be "
                       r"given; .*, from the data sheet of the material, or name a grade"):
        lacking.with_(**new)
    both = {"coercivity_coefficient_per_K": -0.006, "remanence_coefficient_per_K": -0.0012}
    followed = lacking.with_(demagnetization=new["demagnetization"] | both).demagnetization
    assert followed.coercivity_coefficient_per_K == -0.006
