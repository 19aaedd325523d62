"""What hostile and careless users gave to the commands: each is refused by a sentence of its own.

Results that were wrong without a word are tested where they are computed.
"""

from __future__ import annotations

import argparse
import os
import shutil

import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.cli.common import orders
from halbach_fe.cli.verbs import with_values
from halbach_fe.core.files import InputFile
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import write_blocks
from halbach_fe.study.reader import read_study
from tests.cli.test_all_keys import BASE, measured_blocks
from tests.cli.test_cli import refused
from tests.cli.test_odd_studies import written
from tests.conftest import changed

COLUMNS = ["--columns", "x,y,z,Bx,By,Bz", "--length-unit", "mm", "--field-unit", "mT"]


@pytest.fixture
def campaign(tmp_path):
    """A study, a map and a table of its blocks."""
    study, measured = written(tmp_path, BASE)
    blocks = tmp_path / "blocks.csv"
    write_blocks(measured_blocks(build_magnet(read_study(study))), blocks)
    return study, measured, blocks


@pytest.mark.parametrize("kind", ["the table", "a link", "a copy without places"])
def test_a_stock_of_blocks_in_the_magnet(campaign, tmp_path, capsys, kind):
    study, measured, blocks = campaign
    stock = tmp_path / "stock.csv"
    if kind == "the table":
        stock = blocks
    elif kind == "a link":
        os.symlink(blocks, stock)
    else:
        lines = [line.split(",") for line in blocks.read_text().splitlines()]
        ring = lines[0].index("ring")
        stock.write_text("\n".join(
            ",".join(cells[:ring] + (["", ""] if number else cells[ring:ring + 2])
                     + cells[ring + 2:]) for number, cells in enumerate(lines)) + "\n")
    code, sentence = refused(["shim", study, "--measurements", measured, "--blocks", blocks, "-o",
                              tmp_path / "out", "--replace", 1, "--stock", stock], capsys)
    assert code == 4
    assert ("stands in no slot" if kind != "a copy without places" else
            "not in the magnet") in sentence
    assert not (tmp_path / "out").exists()  # nothing was solved before


@pytest.mark.parametrize(("arguments", "said"), [
    (["sort", "{study}", "{blocks}", "--seed", "1", "--seed", "2"], "--seed: is given twice"),
    (["tolerance", "{study}", "--draws", "1e4"], "must be a whole number, not '1e4'"),
    (["tolerance", "{study}", "--draws", "1000001"], "from 1 to 1e+06, not 1000001"),
    (["tolerance", "{study}", "--limit-units", "1e308"], "from 1e-06 to 1e+06, not 1e308"),
    (["tolerance", "{study}", "--limit-units", "x"], "must be a number, not 'x'"),
    (["demagnetization", "{study}", "--across", "1000000"], "from 1 to 100, not 1000000"),
    (["simulate-measurement", "{study}", "--coil-sd", "100"], "from 1e-09 to 0.3, not 100"),
    (["simulate-measurement", "{study}", "--order", "99"], "from 1 to 10, not 99"),
    (["simulate-measurement", "{study}", "--element-size", "1e-9"], "from 1e-05 to 10"),
    (["import-map", "{measured}", "--at", "x=0,x=1"], "must give x once"),
    (["import-map", "{measured}", "--at", "x=nan"], "must be a finite number, not 'nan'")])
def test_command_lines(campaign, tmp_path, capsys, arguments, said):
    study, measured, blocks = campaign
    with pytest.raises(SystemExit) as raised:
        main([*(one.format(study=study, measured=measured, blocks=blocks) for one in arguments),
              "-o", str(tmp_path / "out")])
    assert raised.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("arguments", "code", "said"), [
    (["tolerance", "{study}", "--reference-radius-m", "0.0499"], 3, "inner radius"),
    (["tolerance", "{study}", "--at-z-m", "1e9"], 3, "--at-z-m"),
    (["homogeneity", "{study}", "--sphere-m", "20"], 3, "contains blocks"),
    (["homogeneity", "{study}", "--sphere-m", "1e-300"], 3, "at least 1e-06 m"),
    (["multipoles", "{study}", "--posterior", "{measured}"], 4, "a posterior.h5 that halbach-fe"),
    (["simulate-measurement", "{study}", "--hide", "gain_x=0.1", "--hide", "gain_x=0.2"], 3,
     "given once"),
    (["simulate-measurement", "{study}", "--hide", "gain_x=1e308"], 3, "from -0.9 to 10"),
    (["simulate-measurement", "{study}", "--hide", "blocks_swapped=1,1,1,1"], 3, "another block"),
    (["simulate-measurement", "{study}", "--hide", "swapped_axes=1,1"], 3, "another axis"),
    (["simulate-measurement", "{study}", "--hide", "rotated_by_one_block=0.5"], 3, "whole number"),
    (["simulate-measurement", "{study}", "--hide", "temperature=100,0.1"], 3, "does not reverse"),
    (["simulate-measurement", "{study}", "--hide", "knee=0,0"], 3, "coercivity"),
    (["simulate-measurement", "{study}", "--hide", "iron_ring=0.01,0.02,9,2"], 3, "outer radius"),
    (["simulate-measurement", "{study}", "--hide", "iron_ring=0.3,0.2,9,2"], 3, "above inner"),
    (["simulate-measurement", "{study}", "--hide", "ferromagnetic_object=0,0,0,1"], 3, "away"),
    (["simulate-measurement", "{study}", "--hide", "neighbour_magnet=0"], 3, "either side")])
def test_values_that_no_magnet_has(campaign, tmp_path, capsys, arguments, code, said):
    study, measured, blocks = campaign
    found, sentence = refused(
        [*(one.format(study=study, measured=measured, blocks=blocks) for one in arguments), "-o",
         tmp_path / "out"], capsys)
    assert found == code
    assert said in sentence
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("celsius", ["295", "-273"])
def test_temperatures_in_kelvin(campaign, tmp_path, capsys, celsius):
    """A block measured at 295 K; and a study whose reference temperature is in kelvin."""
    study, _, blocks = campaign
    lines = [line.split(",") for line in blocks.read_text().splitlines()]
    column = lines[0].index("temperature_C")
    lines[1][column] = celsius
    blocks.write_text("\n".join(map(",".join, lines)) + "\n")
    code, sentence = refused(["prior", study, blocks, "-o", tmp_path / "out"], capsys)
    assert code == 4
    assert "Is it in kelvin?" in sentence
    study.write_text(tomlkit.dumps(
        changed(BASE, demagnetization__reference_temperature_C=293.15)))
    code, sentence = refused(["demagnetization", study, "-o", tmp_path / "out"], capsys)
    assert code == 3
    assert "reference_temperature_C" in sentence


def test_a_result_as_input(campaign, tmp_path, capsys):
    """A run does not replace what it reads."""
    study, _, blocks = campaign
    out = tmp_path / "out"
    assert main(["prior", str(study), str(blocks), "-o", str(out)]) == 0
    shutil.copy(blocks, out / "blocks.csv")  # an input in the folder that is no result may be read
    assert main(["prior", str(study), str(out / "blocks.csv"), "-o", str(out)]) == 0
    capsys.readouterr()
    code, sentence = refused(["prior", study, out / "prior.json", "-o", out], capsys)
    assert code == 4  # which no command reads as a table
    before = (out / "prior.json").read_text()
    shutil.copy(blocks, tmp_path / "kept.csv")
    record = (out / "run.json").read_text()
    (out / "run.json").write_text(record.replace('"prior.json"', '"blocks.csv"'))
    code, sentence = refused(["prior", study, out / "blocks.csv", "-o", out], capsys)
    assert code == 8
    assert "a result of an earlier run" in sentence
    assert (out / "prior.json").read_text() == before


def test_a_map_over_itself(campaign, tmp_path, capsys):
    _, measured, _ = campaign
    before = measured.read_bytes()
    for command in (["export", measured, "--format", "csv"], ["import-map", measured]):
        code, sentence = refused([*command, "-o", measured], capsys)
        assert code == 8
        assert "a file other than the input" in sentence
    assert measured.read_bytes() == before
    link = tmp_path / "link.csv"
    os.symlink(measured, link)
    assert main(["export", str(measured), "--format", "csv", "-o", str(link)]) == 0
    assert not link.is_symlink()  # a link is replaced, not followed
    assert measured.read_bytes() == before


def test_a_table_of_blocks_over_that_of_its_study(tmp_path, capsys):
    """It would have the study's exceptions, which the study would then add once more."""
    table = tmp_path / "table.csv"
    table.write_text("name,shape,x_m,y_m,z_m,size_x_m,size_y_m,size_z_m,remanence_T\n"
                     "a,cuboid,-0.03,0,0,0.02,0.02,0.02,1.3\nb,cuboid,0.03,0,0,0.02,0.02,0.02,1.3\n")
    study = tmp_path / "study.toml"
    study.write_text("""
name = "pair"
array = { free_blocks = { file = "table.csv" } }
mesh = { block_size_m = 0.01 }
[observation]
quantity = "flux_density"
positions = { kind = "points", points_m = [[0, 0, 0.1]] }
""")
    code, sentence = refused(["export", study, "--format", "blocks", "-o", table], capsys)
    assert code == 8
    assert "a file other than the input" in sentence
    assert main(["export", str(study), "--format", "blocks", "-o", str(tmp_path / "new.csv")]) == 0


@pytest.mark.parametrize(("options", "said"), [
    (["--angle-unit", "deg"], "--angle-unit deg"),
    (["--decimal-comma"], "numbers")])
def test_options_that_the_file_does_not_need(tmp_path, capsys, options, said):
    """An option that has no effect is a misunderstanding."""
    file = tmp_path / "hall.txt"
    file.write_text("0.0 0.0 0.0 731.2 1.1 0.0\n0.0 0.0 1.0 730.9 1.2 0.1\n")
    command = ["import-map", file, "-o", tmp_path / "map.csv", *COLUMNS]
    code, sentence = refused([*command, *options], capsys)
    assert code == 4
    assert said in sentence
    assert main(list(map(str, command))) == 0


def test_values_that_begin_with_a_minus():
    assert with_values(["import-map", "f", "--columns", "-,x[mm],B", "--json"]) == [
        "import-map", "f", "--columns=-,x[mm],B", "--json"]
    assert with_values(["--origin-m", "-0.5,0,0"]) == ["--origin-m=-0.5,0,0"]
    assert with_values(["--columns", "--json"]) == ["--columns", "--json"]


def test_orders_of_a_huge_range():
    """They are refused before a list of them is made."""
    for text in ("2..1000000000", "3..", "9" * 5000):
        with pytest.raises(argparse.ArgumentTypeError, match="must be orders from 1"):
            orders(text)


def test_a_map_of_zeros(tmp_path, capsys):
    study, measured = written(tmp_path, BASE, (0.0, 0.0, 0.0))
    code, sentence = refused(["infer", study, "--measurements", measured, "-o", tmp_path / "out"],
                             capsys)
    assert code == 4
    assert "zero at all points" in sentence


def test_an_endless_file(monkeypatch):
    """A device or a pipe is read up to a limit."""
    monkeypatch.setattr("halbach_fe.core.files.LARGEST_STREAM_BYTES", 10_000)
    with pytest.raises(OSError, match="A pipe or device of more than"):
        InputFile("/dev/zero").read_bytes()
    assert InputFile("/dev/null").read_bytes() == b""
