"""Maps in and out, as a user meets them."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.measurement.field_map import field_map, points_of, read_map, write_map
from tests.cli.test_cli import refused
from tests.measurement.test_import_map import FIELD, MM_MT, POINTS, rows


def test_import_and_export(tmp_path, capsys):
    hall, found, table = tmp_path / "hall.txt", tmp_path / "map.csv", tmp_path / "map.TABLE"
    hall.write_text("n " + " ".join(MM_MT) + "\n" + "".join(
        f"{n} {line}\n" for n, line in enumerate(rows().splitlines())))
    assert main(["import-map", str(hall), "-o", str(found), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["map"] == str(found)
    assert (shown["format"], shown["readings"], shown["ignored_columns"]) == ("columns", 24, ["n"])
    assert (shown["length_units"], shown["field_units"]) == (["mm"], ["mT"])
    np.testing.assert_allclose([shown["from_m"], shown["to_m"]],
                               [POINTS.min(axis=0), POINTS.max(axis=0)])
    assert main(["export", str(found), "--format", "geant4", "-o", str(table)]) == 0
    assert main(["import-map", str(table), "-o", str(tmp_path / "again.h5")]) == 0
    shown = capsys.readouterr()
    assert "Read as opera" in shown.out
    assert "BMOD/HMOD" in shown.out
    again = read_map(tmp_path / "again.h5")
    np.testing.assert_allclose(points_of(again), POINTS, atol=1e-12)
    np.testing.assert_allclose(again["B_T"], FIELD, atol=1e-9)
    assert not np.allclose(again["B_T"], FIELD[:, ::-1])


def test_columns_that_are_declared(tmp_path):
    hall = tmp_path / "hall.txt"
    hall.write_text("0,5;100\n1,5;200\n")
    assert main(["import-map", str(hall), "-o", str(tmp_path / "map.csv"), "--columns", "z,B",
                 "--component", "x", "--at", "x=0,y=-0.01", "--length-unit", "cm", "--field-unit",
                 "G", "--decimal-comma", "--origin-m=-1,0,0.5"]) == 0
    found = read_map(tmp_path / "map.csv")
    np.testing.assert_allclose(points_of(found), [[-1, -0.01, 0.505], [-1, -0.01, 0.515]])
    np.testing.assert_allclose(found["B_T"][:, 0], [0.01, 0.02])


def test_refusals(tmp_path, capsys):
    hall, out = tmp_path / "hall.txt", tmp_path / "out" / "map.csv"
    hall.write_text(rows())
    code, sentence = refused(["import-map", hall, "-o", out], capsys)
    assert (code, out.parent.exists()) == (4, False)
    for option in ("--columns", "--length-unit", "--field-unit"):
        assert option in sentence
    code, sentence = refused(["import-map", tmp_path / "none", "-o", out], capsys)
    assert (code, "No such file" in sentence) == (4, True)
    hall.write_text(" ".join(MM_MT) + "\n" + rows())
    code, _ = refused(["import-map", hall, "-o", tmp_path / "map.xls"], capsys)
    assert (code, list(tmp_path.iterdir())) == (8, [hall])
    write_map(field_map(POINTS[1:], FIELD[1:]), tmp_path / "map.csv")
    code, sentence = refused(["export", tmp_path / "map.csv", "--format", "bdsim", "-o",
                              tmp_path / "map.dat"], capsys)
    assert (code, 'kind = "grid"' in sentence) == (4, True)
    assert not (tmp_path / "map.dat").exists()


HEADERS = {"states": "x [mm],y [mm],z [mm],Bx [mT]\n", "silent": "x,y,z,Bx\n",
           "own": "x_m,y_m,z_m,Bx_T\n"}
UNITS = ["--length-unit", "mm", "--field-unit", "mT"]


@pytest.mark.parametrize(("header", "key", "options", "twice"), [
    ("states", "length_unit_m = 0.001", [], "left out for map .*hall.txt, .* from mm, .* 0.001, "),
    ("states", "length_unit_m = 0.01", UNITS, "from mm, as its header or --length-unit .* 0.01, "),
    ("states", "flux_density_unit_T = 0.001", [], "from mT, as its header or --field-unit says"),
    ("silent", "length_unit_m = 0.001", UNITS, "from mm"),
    ("imported", "length_unit_m = 0.001", [], "from mm"),
    ("states", "length_unit_m = 1000.0", [], ""),  # a wrong header, as diagnose corrects it
    ("own", "length_unit_m = 0.001", [], "")])
@pytest.mark.parametrize("listed", [False, True])
def test_units_are_not_converted_twice(tmp_path, capsys, header, key, options, twice, listed):
    """A file that is read in m needs no unit of the study."""
    text, hall, study = "".join(f"{n},0,0,{300 + n}\n" for n in range(9)), *(
        tmp_path / name for name in ("hall.txt", "study.toml"))
    hall.write_text(HEADERS.get(header, HEADERS["states"]) + text)
    if header == "imported" or (listed and header != "own"):
        assert main(["import-map", str(hall), "-o", str(tmp_path / "map.csv"), *options]) == 0
        hall, options = tmp_path / "map.csv", []
    assert main(["new", str(study)]) == 0
    given = [] if listed else ["--measurements", hall, *options]
    with study.open("a") as file:
        file.write(f'\n[[maps]]\nname = "a"\nfile = "{hall.name}"\n[maps.instrument]\n{key}\n'
                   if listed else f"\n[instrument]\n{key}\n")
    capsys.readouterr()
    code = main([*map(str, ["infer", study, *given, "-o", tmp_path / "out", "--dry-run"])])
    sentence = capsys.readouterr().err
    assert ("Remove the key" in sentence) == bool(twice)
    assert re.search(twice.replace("hall.txt", hall.name), sentence)
    assert not twice or (code, f"`instrument.{key.split()[0]}`" in sentence) == (3, True)


@pytest.mark.parametrize("wrong", [
    ["--at", "w=0"], ["--at", "x=nan"], ["--at", "x"], ["--origin-m", "1,2"],
    ["--length-unit", "feet"], ["--component", "r"]])
def test_wrong_options(tmp_path, capsys, wrong):
    with pytest.raises(SystemExit) as caught:
        main(["import-map", "hall.txt", "-o", str(tmp_path / "map.csv"), *wrong])
    assert caught.value.code == 2
    assert "usage:" in capsys.readouterr().err


def test_columns_for_which_a_format_has_no_place_are_said(tmp_path, capsys):
    """Control: a CSV file keeps them all, without a word."""
    source = tmp_path / "map.h5"
    places = np.stack(np.meshgrid(*[[0.0, 0.01]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    data = field_map(places, np.full((8, 3), 0.1), sigma_T=1e-5)
    write_map(data.assign(scan=("point", ["a"] * 8)), source)
    for name, suffix, left in (("bdsim", ".dat", "sigma_T, scan."), ("geant4", ".t", "sigma_T"),
                               ("openpmd", ".hdf5", "sigma_T"), ("vtu", ".vtu", ": scan."),
                               ("csv", ".csv", "")):
        out = tmp_path / f"out{suffix}"
        assert main(["export", str(source), "--format", name, "-o", str(out)]) == 0
        said = capsys.readouterr().err
        assert ("Left out" in said, left in said) == (bool(left), True)
    code, sentence = refused(["export", source, "--format", "bdsim", "-o", tmp_path / "b.vtu"],
                             capsys)
    assert (code, "another format" in sentence) == (8, True)
