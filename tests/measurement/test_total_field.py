"""Maps of |B|: files, imports, what is checked of them, and what refuses them."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from halbach_fe.cli import main
from halbach_fe.core.errors import HalbachWarning, MeasurementError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import (
    check_magnitudes,
    field_map,
    is_total_field,
    points_of,
    read_map,
    readings_sha256,
    total_contradiction,
    total_field_map,
    with_total_field,
    write_map,
)
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.import_export import export_map, import_map
from halbach_fe.measurement.map_check import check_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.suspect_rows import check_total, contradicted_rows
from halbach_fe.report.map_check_page import total_answer
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from tests.measurement.test_map_check import GRID, source
from tests.support.cuboids import DOCUMENT

NOISE_T = 2e-5


def size_of(points=GRID):
    """|B| (n,) by magpylib."""
    return np.linalg.norm(source().getB(points), axis=1)


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".vtu"])
@pytest.mark.parametrize("sigma", [None, 1e-6])
def test_files_read_back_equal(suffix, sigma, tmp_path):
    size = size_of()
    data = total_field_map(GRID, size, None if sigma is None else np.full(len(size), sigma))
    write_map(data, tmp_path / f"map{suffix}")
    again = read_map(tmp_path / f"map{suffix}")
    assert is_total_field(again)
    np.testing.assert_array_equal(points_of(again), GRID)
    np.testing.assert_array_equal(again["Babs_T"], size)
    assert ("sigma_Babs_T" in again) == (sigma is not None)
    assert readings_sha256(again) == readings_sha256(data)
    assert readings_sha256(again) != readings_sha256(total_field_map(GRID, 1.01 * size))


def test_sigma_of_a_map_of_the_magnitude_is_its_noise(tmp_path):
    path = tmp_path / "map.csv"
    path.write_text("x_m,y_m,z_m,Babs_T,sigma_T\n0,0,0,0.5,1e-6\n0,0,0.1,0.4,2e-6\n")
    data = read_map(path)
    np.testing.assert_array_equal(data["sigma_Babs_T"], [1e-6, 2e-6])
    assert "sigma_T" not in data


def test_components_may_have_a_column_of_the_magnitude(tmp_path):
    field = source().getB(GRID)
    write_map(with_total_field(field_map(GRID, field), size_of()), tmp_path / "map.csv")
    again = read_map(tmp_path / "map.csv")
    assert not is_total_field(again)
    np.testing.assert_array_equal(again["B_T"], field)
    np.testing.assert_array_equal(again["Babs_T"], size_of())


@pytest.mark.parametrize(("text", "words"), [
    ("x_m,y_m,z_m,Babs_T\n0,0,0,-0.5\n", "never negative"),
    ("x_m,y_m,z_m,Bx_T,Babs_T\n0,0,0,0.5,0.5\n0,0,1,,0.4\n", "a map of their own"),
    ("x_m,y_m,z_m,Bx_T,sigma_Babs_T\n0,0,0,0.5,0.5\n", "Babs_T beside sigma_Babs_T"),
    ("x_m,y_m,z_m,Babs_T\n0,0,0,\n", "at least one reading"),
    ("x_m,y_m,z_m,Babs_T,sigma_Babs_T\n0,0,0,0.5,0\n", "positive"),
    ("x_m,y_m,z_m\n0,0,0\n", "Babs_T")])
def test_what_no_magnitude_is(text, words, tmp_path):
    (tmp_path / "map.csv").write_text(text)
    with pytest.raises(MeasurementError, match=words):
        read_map(tmp_path / "map.csv")


@pytest.mark.parametrize(("text", "declared"), [
    ("x [mm],y [mm],z [mm],|B| [mT]\n1,2,3,400\n4,5,6,300\n", {}),
    ("x_mm,y_mm,z_mm,Babs_mT\n1,2,3,400\n4,5,6,300\n", {}),
    ("x [mm],y [mm],z [mm],B [mT]\n1,2,3,400\n4,5,6,300\n", {"component": "abs"}),
    ("1 2 3 400\n4 5 6 300\n", {"columns": ("x", "y", "z", "Babs"), "length_unit": "mm",
                              "field_unit": "mT"}),
    ("x y z mf.normB\n1 2 3 400\n4 5 6 300\n", {"length_unit": "mm", "field_unit": "mT"})])
def test_imports(text, declared, tmp_path):
    (tmp_path / "nmr.txt").write_text(text)
    data = import_map(tmp_path / "nmr.txt", DeclaredFormat(**declared)).data
    assert is_total_field(data)
    np.testing.assert_allclose(data["Babs_T"], [0.4, 0.3])
    np.testing.assert_allclose(points_of(data), [[1e-3, 2e-3, 3e-3], [4e-3, 5e-3, 6e-3]])


def test_a_magnitude_beside_all_components_is_kept(tmp_path):
    """It is no reading of its own there; beside a single component it may be anything."""
    (tmp_path / "hall.txt").write_text("x [m],y [m],z [m],Bx [T],By [T],Bz [T],B [T]\n"
                                       "0,0,0,0.3,0,0.4,0.5\n")
    data = import_map(tmp_path / "hall.txt", DeclaredFormat()).data
    np.testing.assert_array_equal(data["Babs_T"], [0.5])
    assert not is_total_field(data)
    (tmp_path / "hall.txt").write_text("x [m],y [m],z [m],Bx [T],B [T]\n0,0,0,0.3,0.5\n")
    found = import_map(tmp_path / "hall.txt", DeclaredFormat())
    assert "Babs_T" not in found.data
    assert found.ignored == ("B [T]",)


def test_the_command_imports_the_magnitude(tmp_path, capsys):
    (tmp_path / "nmr.txt").write_text("x [mm],y [mm],z [mm],|B| [mT]\n1,2,3,400\n4,5,6,300\n")
    assert main(["import-map", str(tmp_path / "nmr.txt"), "-o", str(tmp_path / "map.csv"),
                 "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["components"] == ["abs"]
    assert said["max_B_T"] == [0.4]
    assert is_total_field(read_map(tmp_path / "map.csv"))


def test_rows_where_the_magnitude_contradicts_the_components(generator):
    """A gain of 1 % between both, and noise, are no contradiction; three rows are."""
    field = source().getB(GRID) + NOISE_T * generator.standard_normal(GRID.shape)
    total = 1.01 * size_of() + NOISE_T * generator.standard_normal(len(GRID))
    assert contradicted_rows(with_total_field(field_map(GRID, field), total)) == ()
    wrong = total.copy()
    wrong[[4, 50, 200]] += 0.01
    assert contradicted_rows(with_total_field(field_map(GRID, field), wrong)) == (5, 51, 201)
    assert contradicted_rows(field_map(GRID, field)) == ()


@pytest.mark.parametrize(("times", "said"), [(1e3, "1\u202f000 times"), (0.5, "0.5 times")])
def test_a_magnitude_that_contradicts_all_rows_is_refused(times, said, generator, tmp_path, capsys):
    """|B| in mT beside components in T. Control: a gain of 5 % between both."""
    field = source().getB(GRID) + NOISE_T * generator.standard_normal(GRID.shape)
    write_map(with_total_field(field_map(GRID, field), times * size_of()), tmp_path / "map.csv")
    assert main(["check", str(tmp_path / "map.csv")]) == MeasurementError.exit_code
    sentence = capsys.readouterr().err
    assert "must be the length of Bx, By, Bz" in sentence
    assert said in sentence
    check_magnitudes(with_total_field(field_map(GRID, field), 1.05 * size_of()))
    one_spike = size_of()
    one_spike[3] *= 100  # rows are named one by one
    check_magnitudes(with_total_field(field_map(GRID, field), one_spike))


def test_the_check_names_contradictions(generator, tmp_path, capsys):
    field = source().getB(GRID) + NOISE_T * generator.standard_normal(GRID.shape)
    total = np.linalg.norm(field, axis=1)
    total[7] *= 1.2
    write_map(with_total_field(field_map(GRID, field), total), tmp_path / "map.csv")
    assert main(["check", str(tmp_path / "map.csv")]) == 0
    said = capsys.readouterr().err
    assert "contradicts its components in 1 row" in said
    assert "8. They are left out." in said


def test_a_map_of_the_magnitude_is_checked_for_broken_rows(generator):
    size = size_of() + NOISE_T * generator.standard_normal(len(GRID))
    good = check_total(total_field_map(GRID, size))
    assert not good.broken
    # an upper limit: near these magnets quadratic functions leave 9 times the noise
    assert NOISE_T * 0.8 < good.noise_T < 15 * NOISE_T
    smooth = check_total(total_field_map(
        GRID, 0.5 + GRID[:, 2] + NOISE_T * generator.standard_normal(len(GRID))))
    assert smooth.noise_T == pytest.approx(NOISE_T, rel=0.3)  # 315 readings, by their median: 7 %
    size[100], size[200] = 0.0, size[200] + 0.05
    found = check_total(total_field_map(GRID, size))
    assert found.broken == {"zero": [101], "spike": [201]}
    assert "2 of 315 rows are" in total_answer(found).said
    assert "do not test |B|" in total_answer(found).trust


def test_repeated_places_tell_the_noise(generator):
    places = np.repeat(GRID[::20], 5, axis=0)
    data = total_field_map(places, size_of(places)
                           + NOISE_T * generator.standard_normal(len(places)))
    data["time_s"] = ("point", np.arange(float(len(places))))
    found = check_total(data)
    assert found.repeats == 16
    # 64 degrees of freedom: 9 % each; 4 sigma
    assert found.repeatability_T == pytest.approx(NOISE_T, rel=0.36)


def test_the_command_checks_the_magnitude(tmp_path, capsys):
    write_map(total_field_map(GRID, size_of()), tmp_path / "map.csv")
    assert main(["check", str(tmp_path / "map.csv"), "-o", str(tmp_path / "checked")]) == 0
    assert "Maxwell's equations are those of the components" in capsys.readouterr().err
    assert json.loads((tmp_path / "checked" / "check.json").read_text())["broken"] == {}


def test_what_needs_components_refuses_it(tmp_path):
    data = total_field_map(GRID, size_of())
    with pytest.raises(MeasurementError, match=r"map of \|B\| alone"):
        check_map(data)
    with pytest.raises(MeasurementError, match=r"map of \|B\| alone"):
        export_map(data, "bdsim", tmp_path / "map.txt")
    export_map(data, "csv", tmp_path / "map.csv")
    xr.testing.assert_equal(read_map(tmp_path / "map.csv"), data)


def test_a_magnitude_of_another_gain_throughout(generator):
    """Of 5 % is told, by `infer` too; a few per mille, and noise of the same size, are not."""
    field = source().getB(GRID) + NOISE_T * generator.standard_normal(GRID.shape)

    def said(total):
        return total_contradiction(with_total_field(field_map(GRID, field), total))

    size = size_of()
    assert "5.0 % smaller" in said(0.95 * size)
    assert "1.0 % larger" in said(1.01 * size + NOISE_T * generator.standard_normal(len(GRID)))
    assert not said(1.003 * size)
    assert not said(size * (1 + 0.2 * generator.standard_normal(len(GRID))))
    assert not total_contradiction(field_map(GRID, field))
    assert not total_contradiction(total_field_map(GRID, size))


def test_infer_tells_the_other_gain(generator, tmp_path):
    study = parse_study(DOCUMENT)
    magnet, points = build_magnet(study), points_from(study.observation.positions)
    field = magnet.field_T(points) + NOISE_T * generator.standard_normal(points.shape)
    size = np.linalg.norm(field, axis=1)
    session = Session.open(tmp_path)
    with pytest.warns(HalbachWarning, match="throughout 5.0 % larger"):
        infer(magnet, with_total_field(field_map(points, field), 1.05 * size), session)
    infer(magnet, with_total_field(field_map(points, field), size), session)  # warns of nothing
    # a gain that the study states is no contradiction, nor a |B| that the same probe has read
    known = magnet.with_(instrument={"gain": (0.05, 0.05, 0.05)})
    for total in (size, 1.05 * size):
        infer(known, with_total_field(field_map(points, 1.05 * field), total), session)
    with pytest.warns(HalbachWarning, match="throughout 3.0 % larger") as said:
        infer(known, with_total_field(field_map(points, 1.05 * field), 1.03 * size), session)
    assert len(said) == 1
