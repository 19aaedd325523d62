"""Studies that are possible and unusual, and what a magnet cannot be: results, or one sentence."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import write_blocks
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.study.reader import read_study
from tests.cli.test_all_keys import BASE, measured_blocks
from tests.cli.test_cli import refused
from tests.conftest import changed

CIRCLES = changed(BASE, observation__positions={
    "kind": "circles", "radius_m": 0.03, "angles": 16, "z_min_m": 0.01, "z_max_m": 0.02,
    "count": 2})
AT = [0.03, 0.0, 0.0]
DIPOLE = {"dipoles": [{"position_m": [1.0, 0.0, 0.0], "moment_A_m2": [0.0, 1.0, 0.0]},
                      {"position_m": AT, "moment_A_m2": [0.0, 1.0, 0.0]}]}
NOTHING = [{"magnetization_factor": 0.0}]


def written(tmp_path, document, readings=(0.2, 0.0, 0.001)):
    """A study, and a map of it in which only finite readings were measured."""
    study, measured = tmp_path / "study.toml", tmp_path / "map.csv"
    study.write_text(tomlkit.dumps(document))
    points = points_from(read_study(study).observation.positions)
    write_map(field_map(points, np.tile(readings, (len(points), 1))), measured)
    return study, measured


@pytest.mark.parametrize("components", [["z"], ["x"], ["y", "z"]])
def test_circles_without_the_components_of_multipoles(tmp_path, capsys, components):
    """There are results, without multipoles."""
    readings = [0.2 if name in components else np.nan for name in "xyz"]
    study, measured = written(
        tmp_path, changed(CIRCLES, observation__components=components), readings)
    out = tmp_path / "out"
    assert main(["infer", str(study), "--measurements", str(measured), "-o", str(out),
                 "--json", "--no-cache"]) == 0
    assert json.loads(capsys.readouterr().out)["readings"] == 32 * len(components)
    assert (out / "report.html").exists()
    assert not (out / "multipoles.csv").exists()


@pytest.mark.parametrize("command", ["solve", "infer", "plan", "tolerance", "demagnetization",
                                     "simulate-measurement", "verify"])
@pytest.mark.parametrize("changes", [
    {"array__exceptions": NOTHING}, {"array__remanence_T": 1e-300},
    {"dimension": 2, "array__rings": 1, "array__exceptions": NOTHING}])
def test_a_magnet_without_magnetization(tmp_path, capsys, command, changes):
    study, measured = written(tmp_path, changed(BASE, **changes))
    given = ["--measurements", measured] if command == "infer" else []
    code, sentence = refused([command, study, "-o", tmp_path / "out", *given], capsys)
    assert code == 3
    assert "at least one magnetized block" in sentence
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["solve", "infer", "simulate-measurement"])
def test_a_reading_at_a_dipole(tmp_path, capsys, command):
    study, measured = written(tmp_path, changed(BASE, external=DIPOLE))
    given = ["--measurements", measured] if command == "infer" else []
    code, sentence = refused([command, study, "-o", tmp_path / "out", *given], capsys)
    assert code == 3
    assert "`external.dipoles[2].position_m`" in sentence
    assert "the place of the reading at (0.03, 0, 0) m" in sentence


def test_a_dipole_beside_the_readings(tmp_path):
    """The control: that is possible."""
    document = changed(BASE, external=changed(DIPOLE, dipoles=DIPOLE["dipoles"][:1]))
    study, _ = written(tmp_path, document)
    assert main(["solve", str(study), "-o", str(tmp_path / "out"), "--json"]) == 0


TARGET = ["--orders", "2..4", "--reference-radius-m", "0.03"]


@pytest.mark.parametrize("command", ["prior", "sort"])
def test_blocks_whose_places_tell_their_types(tmp_path, capsys, command):
    """The results are those with the types, which may be left out for some or for all."""
    study, _ = written(tmp_path, BASE)
    table, found = measured_blocks(build_magnet(read_study(study))), []
    labels = tuple(str(slot) for slot in table.slot)  # each slot takes blocks of its own type
    for types in (labels, ("", *labels[1:]), ("",) * len(table)):
        write_blocks(replace(table, type=types), tmp_path / "blocks.csv")
        assert main([command, str(study), str(tmp_path / "blocks.csv"), "-o",
                     str(tmp_path / "out"), "--json", *(TARGET if command == "sort" else [])]) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1] == found[2]
    text = (tmp_path / "blocks.csv").read_text()
    (tmp_path / "blocks.csv").write_text(text.replace(",1,1,", ",1,9,", 1))
    code, sentence = refused([command, study, tmp_path / "blocks.csv", "-o", tmp_path / "out"],
                             capsys)
    assert code == 4
    assert "place of block" in sentence


def workbook(kind):
    """The beginning of a spreadsheet's file."""
    if kind == "xls":
        return b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(500)
    raw = io.BytesIO()
    with zipfile.ZipFile(raw, "w") as file:
        if kind == "ods":
            file.writestr("mimetype", "application/vnd.oasis.opendocument.spreadsheet")
        else:
            file.writestr("[Content_Types].xml", "<Types/>")
            file.writestr("xl/workbook.xml", "<workbook/>")
    return raw.getvalue()


@pytest.mark.parametrize(("kind", "program"), [
    ("xls", "Excel"), ("xlsx", "Excel"), ("ods", "OpenDocument")])
@pytest.mark.parametrize("what", ["map", "blocks", "import-map", "check", "free", "iron"])
def test_workbooks(tmp_path, capsys, kind, program, what):
    """Of whatever table."""
    document = BASE
    if what == "free":
        document = changed(BASE, array={"free_blocks": {"file": "sheet.csv"}})
    elif what == "iron":
        document = changed(BASE, iron_ring={
            "inner_radius_m": 0.09, "outer_radius_m": 0.1,
            "curve": {"kind": "table", "file": "sheet.csv"}})
    study, sheet = tmp_path / "study.toml", tmp_path / "sheet.csv"
    study.write_text(tomlkit.dumps(document))
    sheet.write_bytes(workbook(kind))
    arguments = {
        "map": ["infer", study, "--measurements", sheet], "blocks": ["prior", study, sheet],
        "import-map": ["import-map", sheet], "check": ["check", sheet]}.get(what, ["solve", study])
    code, sentence = refused(
        [*arguments, "-o", tmp_path / ("out.csv" if what == "import-map" else "out")], capsys)
    assert code == (3 if what in ("free", "iron") else 4)
    assert f"an {program} workbook" in sentence
    assert "ave the sheet as CSV" in sentence
    assert ("by halbach-fe import-map" in sentence) == (  # which reads no other workbooks
        kind == "xlsx" and what not in ("import-map", "iron"))


@pytest.mark.parametrize("text", [
    "x_m;y_m;z_m;Bx_T\n0;0;0;0,1\n", "0,0,0,0.1\n0,0,0.01,0.1\n", "x,y,z,Bx,By,Bz\n0,0,0,1,0,0\n",
    "0 0 0 0.1 0 0\n0 0 0.01 0.1 0 0\n", "\ufeff0;0;0;0,1\n0;0;1;0,1\n"])
def test_maps_that_have_to_be_imported(tmp_path, capsys, text):
    """With other separators, names or no header."""
    study, measured = written(tmp_path, BASE)
    measured.write_text(text, encoding="utf-8")
    code, sentence = refused(["infer", study, "--measurements", measured, "-o", tmp_path / "out"],
                             capsys)
    assert code == 4
    assert "`halbach-fe import-map`" in sentence


@pytest.mark.parametrize("sigma", ["1e300", "1e-300", "2", "1e-20"])
def test_absurd_sigmas_of_a_map(tmp_path, capsys, sigma):
    study, measured = written(tmp_path, BASE)
    header, *rows = measured.read_text().splitlines()
    measured.write_text("\n".join([f"{header},sigma_T", *(f"{row},{sigma}" for row in rows), ""]))
    code, sentence = refused(["infer", study, "--measurements", measured, "-o", tmp_path / "out"],
                             capsys)
    assert code == 4
    assert f"sigma of map {measured} must be from 1e-15 to 1 T" in sentence


def test_infer_reads_what_import_map_reads(tmp_path, capsys):
    """With the same options, and with the same results; held-out maps too."""
    study, measured = written(tmp_path, BASE)
    header, *rows = measured.read_text().splitlines()
    assert header == "x_m,y_m,z_m,Bx_T,By_T,Bz_T"
    foreign = tmp_path / "map.txt"
    foreign.write_text("\n".join(
        ";".join(f"{1e3 * float(cell)!r}".replace(".", ",") for cell in row.split(","))
        for row in rows))
    options = ["--columns", "x[mm],y[mm],z[mm],Bx[mT],By[mT],Bz[mT]", "--decimal-comma"]
    assert main(["import-map", str(foreign), "-o", str(tmp_path / "imported.csv"), *options,
                 "--json"]) == 0
    capsys.readouterr()
    found = []
    for name, given in (("imported.csv", []), ("map.txt", options)):
        assert main(["infer", str(study), "--measurements", str(tmp_path / name), "-o",
                     str(tmp_path / "out"), "--json", *given]) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1]
    code, sentence = refused(["infer", study, "--measurements", foreign, "-o", tmp_path / "out",
                              *options[:2]], capsys)
    assert code == 4
    assert str(foreign) in sentence
