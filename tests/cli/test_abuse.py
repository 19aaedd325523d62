"""What hostile and careless users gave to the commands: each is refused by a sentence of its own.

Results that were wrong without a word are tested where they are computed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import warnings
from dataclasses import replace

import gmsh
import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.cli.process import guarded
from halbach_fe.cli.shared_options import orders
from halbach_fe.cli.verbs import with_values
from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.core.files import InputFile
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import loose_blocks
from halbach_fe.measurement.block_table import read_blocks, write_blocks
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.reader import parse_study, read_study
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
    (["tolerance", "{study}", "--draws", "1000001"], "from 20 to 1e+06, not 1000001"),
    (["tolerance", "{study}", "--draws", "1"], "from 20 to 1e+06, not 1"),
    (["tolerance", "{study}", "--draws", "0"], "from 20 to 1e+06, not 0"),
    (["tolerance", "{study}", "--limit-units", "0"], "from 1e-06 to 1e+06, not 0"),
    (["tolerance", "{study}", "--limit-units", "1e308"], "from 1e-06 to 1e+06, not 1e308"),
    (["tolerance", "{study}", "--limit-units", "x"], "must be a number, not 'x'"),
    (["demagnetization", "{study}", "--across", "1000000"], "from 2 to 100, not 1000000"),
    (["demagnetization", "{study}", "--across", "1"], "from 2 to 100, not 1"),
    (["simulate-measurement", "{study}", "--coil-sd", "100"], "from 1e-09 to 0.3, not 100"),
    (["simulate-measurement", "{study}", "--order", "99"], "from 1 to 10, not 99"),
    (["simulate-measurement", "{study}", "--element-size", "1e-9"], "from 1e-05 to 10"),
    (["forces", "{study}", "--density-kg-per-m3", "7.5"], "7.5 g/cm^3 are 7500 kg/m^3"),
    (["register", "{study}", "--turn-rad", "5"], "from 0 to 1.5708, not 5"),
    (["register", "{study}", "--across-m", "50"], "from 0 to 10, not 50"),
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
    (["homogeneity", "{study}", "--sphere-m", "0.3"], 3, "contains blocks"),
    (["homogeneity", "{study}", "--sphere-m", "20"], 3, "in millimetres"),
    (["homogeneity", "{study}", "--sphere-m", "1e-300"], 3, "at least 1e-06 m"),
    (["infer", "{study}", "--measurements", "{measured}", "--seed", "2"], 3, "beside --samples"),
    (["forces", "{study}", "--order", "{measured}"], 4, "with the column block"),
    (["multipoles", "{study}", "--posterior", "{measured}"], 4, "a posterior.h5 that halbach-fe"),
    (["multipoles", "{study}", "--posterior", "nope.h5"], 4, "received No such file or directory"),
    (["simulate-measurement", "{study}", "--hide", "gain_x=0.1", "--hide", "gain_x=0.2"], 3,
     "given once"),
    (["simulate-measurement", "{study}", "--hide", "temperature=1,-0.12"], 3, "write -0.0012."),
    (["simulate-measurement", "{study}", "--hide", "ring_twisted=1,30"], 3, "Then write 0.523599"),
    (["simulate-measurement", "{study}", "--hide", "gain_x=1e308"], 3, "from -0.9 to 10"),
    (["simulate-measurement", "{study}", "--hide", "blocks_swapped=1,1,1,1"], 3, "another block"),
    (["simulate-measurement", "{study}", "--hide", "swapped_axes=1,1"], 3, "another axis"),
    (["simulate-measurement", "{study}", "--hide", "rotated_by_one_block=0.5"], 3, "whole number"),
    (["simulate-measurement", "{study}", "--hide", "temperature=100,0.1"], 3, "does not reverse"),
    (["simulate-measurement", "{study}", "--hide", "temperature=-300,-0.001"], 3, "from -293 "),
    (["simulate-measurement", "{study}", "--hide", "knee=0,0"], 3, "coercivity"),
    (["simulate-measurement", "{study}", "--hide", "knee=500,0.9"], 3,
     "from 1e+04 to 1e+07 A/m; instead received 500. Was it meant in kiloamperes per metre?"),
    (["simulate-measurement", "{study}", "--hide", "block_displaced=1,1,0.5,0,0"], 3,
     "from -0.1 to 0.1 m; instead received 0.5. Was it meant in millimetres? Then write 0.0005."),
    (["simulate-measurement", "{study}", "--hide", "background=0,0,5"], 3, "Then write 0.005."),
    (["simulate-measurement", "{study}", "--hide", "iron_ring=0.01,0.02,9,2"], 3, "outer radius"),
    (["simulate-measurement", "{study}", "--hide", "iron_ring=0.3,0.2,9,2"], 3, "above inner"),
    (["simulate-measurement", "{study}", "--hide", "ferromagnetic_object=0,0,0,1"], 3, "away"),
    (["simulate-measurement", "{study}", "--hide", "neighbour_magnet=0"], 3, "either side"),
    (["simulate-measurement", "{study}", "--component", "abs", "--hide", "offset_y=0.1"], 3,
     "also needs: y. Choose another effect, or change the study. A map of |B| has a single"),
    (["simulate-measurement", "{study}", "--component", "abs", "--hide", "swapped_axes=1,2"], 3,
     "also needs: axes"),
    (["homogeneity", "{study}", "--length-unit", "mm"], 2, "beside --measurements, whose map"),
    (["homogeneity", "{study}", "--cylinder-m", "0.01", "0.01", "--degrees", "4"], 2,
     "--degrees of the command line must be of a sphere")])
def test_values_that_no_magnet_has(campaign, tmp_path, capsys, arguments, code, said):
    study, measured, blocks = campaign
    found, sentence = refused(
        [*(one.format(study=study, measured=measured, blocks=blocks) for one in arguments), "-o",
         tmp_path / "out"], capsys)
    assert found == code
    assert said in sentence
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("changes", "said"), [
    ({"demagnetization__remanence_coefficient_per_K": -0.12},
     "per cent per kelvin? Then write -0.0012."),
    ({"demagnetization__remanence_coefficient_per_K": 0.12},
     "per cent per kelvin and with the other sign? Then write -0.0012."),
    ({"demagnetization__intrinsic_coercivity_A_per_m": 12.5},
     "in kilooersted? Then write 994718."),
    ({"demagnetization__intrinsic_coercivity_A_per_m": 955},
     "in kiloamperes per metre? Then write 955000."),
    ({"demagnetization__remanence_coefficient_per_K": 0.0012}, "other sign? Then write -0.0012."),
    ({"demagnetization__coercivity_coefficient_per_K": 0.27},
     "per cent per kelvin? Then write 0.0027."),  # of ferrite
    ({"demagnetization__reference_temperature_C": 293.15}, "in kelvin? Then write 20."),
    ({"demagnetization__squareness": 90.0}, "per cent? Then write 0.9."),
    ({"instrument__rotation_rad": [0, 0, 30]}, "in degrees? Then write 0.523599."),
    ({"prior__magnitude_sd": 2.0}, "in per cent? Then write 0.02."),
    ({"prior__magnitude_std": 0.02}, "Did you mean `magnitude_sd`?"),
    ({"array__ring_gap_mm": 1.0}, "Did you mean `ring_gap_m`? Then convert its values to m."),
    ({"instrument__gain": [1.02, 0, 0]}, "whole factor, write 0.02; if per cent, 0.0102."),
    ({"instrument__z_scale": 1.001}, "whole factor, write 0.001;"),
    ({"instrument__gain": [2.0, 0, 0]}, "in per cent? Then write 0.02."),
    ({"instrument__gain": [60, 0, 0]}, "Correct the value.")])
def test_units_that_a_value_may_have_had(changes, said):
    """What the sentence advises is within the limits; nothing is advised that is not."""
    with pytest.raises(StudyError) as refusal:
        parse_study(changed(BASE, **changes))
    assert said in str(refusal.value)
    assert ("convert" in said) == ("convert" in str(refusal.value))


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


@pytest.mark.parametrize(("changes", "said"), [
    ({"plan__candidates": [{"kind": "points", "points_m": [[0.0, 0.0, 20.0], [0.0, 0.0, 0.0],
                                                           [0.0, 0.0, 0.01]]}]},
     "within 0.392 m of the origin, where there is some field of the magnet; instead received one "
     "at (0, 0, 20) m. Was it meant in millimetres?"),
    ({"plan__candidates": [{"kind": "points", "points_m": [[0.0, 0.0, 1.2], [0.0, 0.0, 0.0],
                                                           [0.0, 0.0, 0.01]]}]},
     "at (0, 0, 1.2) m. Stay nearer to the magnet."),  # plainly in m
    ({"demagnetization__remanence_coefficient_per_K": 1.2e-3}, "remanence_coefficient_per_K"),
    ({"demagnetization__coercivity_coefficient_per_K": 3e-3}, "that of ferrite alone")])
def test_studies_in_other_units_or_of_another_sign(tmp_path, capsys, changes, said):
    study = tmp_path / "study.toml"
    study.write_text(tomlkit.dumps(changed(BASE, **changes)))
    code, sentence = refused(["plan", study, "-o", tmp_path / "out"], capsys)
    assert code == 3
    assert said in sentence


@pytest.mark.parametrize(("names", "said"), [
    (["x"], "block in line 2 of order of assembly"), ([], "all 8 blocks of the magnet"),
    (["r01s01", "r01s02"], "r01s02, which is in line 3 too")])
def test_orders_of_assembly(campaign, tmp_path, capsys, names, said):
    """What is wrong is in the table, not in the study."""
    study, order = campaign[0], tmp_path / "order.csv"
    blocks = [block.name for block in build_magnet(read_study(study)).blocks]
    order.write_text("block\n" + "\n".join([*names, *blocks[1:]]) + "\n")
    code, sentence = refused(["forces", study, "--order", order, "-o", tmp_path / "out"], capsys)
    assert code == 4
    assert said in sentence
    assert str(order) in sentence


@pytest.mark.parametrize(("changes", "said"), [
    ({"plan__candidates": {"kind": "points", "points_m": [[0.0, 0.0, 0.0]]}},
     "Write [[plan.candidates]] for [plan.candidates]"),
    ({"instrument": [{"gain": [0.01, 0.0, 0.0]}]}, "Write [instrument] for [[instrument]]"),
    ({"iron_ring": None, "iron": {"relative_permeability": 100.0, "bodies": [
        {"kind": "sphere", "radius_m": 0.01, "centre_m": [0.0, 0.0, 90.0]}]}},
     "in millimetres? Then write 0.09.")])
def test_tables_and_places_that_are_meant_otherwise(changes, said):
    with pytest.raises(StudyError) as refusal:
        parse_study(changed(BASE, **changes))
    assert said in str(refusal.value)


def test_what_is_given_to_another_command(campaign, tmp_path, capsys):
    """A table of moments as that of places, lines without a grid, several maps to explain."""
    study, measured, blocks = campaign
    document = dict(BASE) | {"maps": [{"name": "a", "file": str(measured)}]}
    (tmp_path / "maps.toml").write_text(tomlkit.dumps(document))
    for said, command in (
            ("a table of measured moments", ["new", tmp_path / "n.toml", "--free-blocks",
                                                 blocks]),
            ("add --across-m U V", ["field", study, "--from-m", 0, 0, -0.1, "--to-m", 0, 0, 0.1,
                                       "--lines", 3, "-o", tmp_path / "f"]),
            ("takes one map", ["explain", tmp_path / "maps.toml", measured, "-o",
                                  tmp_path / "e"])):
        found, sentence = refused(command, capsys)
        assert found == 3
        assert said in sentence


def test_a_warning_is_said_once(tmp_path, capsys):
    def run():
        for _ in range(2):
            warnings.warn("twice", HalbachWarning, stacklevel=1)
            with warnings.catch_warnings():  # what makes Python forget
                warnings.simplefilter("ignore")
        return 0

    assert guarded(run) == 0
    assert capsys.readouterr().err.count("warning: twice") == 1


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
    code, sentence = refused(["export", measured, "--format", "csv", "-o", link], capsys)
    assert code == 8
    assert link.is_symlink()
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


@pytest.mark.parametrize(("options", "said"), [
    (["-o", ""], "-o/--output: must not be empty"),
    (["-o", 300 * "x"], "-o/--output: must be a path"),
    (["-o", "out", "--cache", ""], "--cache: must not be empty"),
    (["-o", "out", "--getdp", ""], "--getdp: must not be empty"),
    (["-o", "out", "--no-cache", "--cache", "x"], "not allowed with argument")])
def test_paths_that_are_none(campaign, tmp_path, capsys, monkeypatch, options, said):
    """An unset variable of a shell is no path; an empty one would be the current folder."""
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit) as raised:
        main(["solve", str(campaign[0]), *options])
    assert raised.value.code == 2
    assert said in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["new", ""])
    assert sorted(tmp_path.iterdir()) == before


def test_a_file_in_place_of_the_cache(campaign, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HALBACH_FE_CACHE_LIMIT_GIB", "1")
    for command in (["cache", "ls"], ["solve", campaign[0], "-o", tmp_path / "out"]):
        code, sentence = refused([*command, "--cache", campaign[1]], capsys)
        assert code == 8
        assert "must be a folder, but is a file" in sentence


@pytest.mark.parametrize("options", [
    ["--length-unit", "mm"], ["--field-unit", "mT"], ["--origin-m", "0.01,0,0"], COLUMNS,
    ["--decimal-comma"], ["--format", "opera"]])
def test_options_of_the_format_of_listed_maps(campaign, tmp_path, capsys, options):
    """They would have no effect: each map has units of its own, in the study."""
    study, _, _ = campaign
    study.write_text(tomlkit.dumps(changed(BASE, maps=[{"name": "a", "file": "map.csv"}])))
    code, sentence = refused(["infer", study, "-o", tmp_path / "out", *options], capsys)
    assert code == 3
    assert "maps.instrument.length_unit_m and flux_density_unit_T" in sentence
    assert main(["infer", str(study), "-o", str(tmp_path / "out"), "--dry-run"]) == 0


@pytest.mark.parametrize(("inference", "said"), [
    ({"excluded_readings": list(range(1, 17))}, "some that the study does not exclude"),
    ({"excluded_readings": [99]}, "rows of map"),
    ({"held_out": {"radii_m": [0.01]}}, "none, at radii from 0.03 to 0.03 m"),
    ({"held_out": {"radii_m": [0.01]}}, "are they in mm? Then set `instrument.length_unit_m`")])
def test_sentences_about_readings(campaign, tmp_path, capsys, inference, said):
    study, measured, _ = campaign
    study.write_text(tomlkit.dumps(changed(BASE, inference=inference)))
    code, sentence = refused(["infer", study, "--measurements", measured, "-o", tmp_path / "out"],
                             capsys)
    assert code == 4
    assert said in sentence


@pytest.mark.parametrize(("changes", "code", "said"), [
    ({"inference": {"excluded_readings": [99]}}, 4, "rows of map b"),
    ({"inference": {"held_out": {"every": 9}}}, 4, "readings of map b"),
    ({"inference": {"held_out": {"components": ["z"]}}}, 4, "readings of map b"),
    ({"noise": {"position_sd_m": 1e-6}}, 3, "since map b has no sigma_T"),
    ({"noise": {"regions": [{"name": "far", "sigma_T": 1e-4, "z_min_m": 1.0}]}}, 3,
     "every reading of map b"),
    ({"name": "run.json"}, 3, "that of a file of results")])
def test_sentences_name_the_map(campaign, tmp_path, capsys, changes, code, said):
    study, measured, _ = campaign
    header, *rows = measured.read_text().splitlines()
    (tmp_path / "b.csv").write_text("\n".join(
        [header, *(row.replace("0.2", f"0.2{number % 9 + 1}")  # not the same but for an offset
                   for number, row in enumerate(rows))]) + "\n")
    study.write_text(tomlkit.dumps(changed(BASE, maps=[
        {"name": "a", "file": "map.csv"}, {"name": "b", "file": "b.csv"} | changes])))
    found, sentence = refused(["infer", study, "-o", tmp_path / "out"], capsys)
    assert found == code
    assert said in sentence


def test_gains_that_no_probe_has(campaign, tmp_path, capsys):
    """The field is three times too large, and the gain is open."""
    study, _, _ = campaign
    study.write_text(tomlkit.dumps(changed(BASE, instrument_sd={"gain": 0.01})))
    magnet = build_magnet(read_study(study))
    points = points_from(magnet.study.observation.positions)
    write_map(field_map(points, 3 * field_of(magnet.blocks, points)), tmp_path / "large.csv")
    code, sentence = refused(["infer", study, "--measurements", tmp_path / "large.csv", "-o",
                              tmp_path / "out"], capsys)
    assert code == 4
    assert "standard deviations. Are they in another unit, or of another magnet?" in sentence


def test_a_map_that_is_not_in_m_and_T(tmp_path, capsys):
    rows = [f"{x},{y},{z},{x + 1},{y},{-2 * z}" for x in range(3) for y in range(3)
            for z in range(3)]
    for scale, said in (("e3", "below 10 T"), ("", "within 100 m")):
        file = tmp_path / "map.csv"
        file.write_text("x_m,y_m,z_m,Bx_T,By_T,Bz_T\n" + "\n".join(
            ",".join(f"{cell}e12" if number < 3 and not scale else f"{cell}{scale}"
                     if number >= 3 else cell for number, cell in enumerate(row.split(",")))
            for row in rows) + "\n")
        code, sentence = refused(["check", file], capsys)
        assert code == 4
        assert said in sentence


@pytest.mark.parametrize(("options", "asked"), [
    (["--at", "z=0.03"], False), (["--at", "z=30"], True),
    (["--at", "z=0", "--origin-m", "0,0,10"], True),
    (["--at", "z=30", "--origin-m", "0,0,-30"], False)])
def test_coordinates_of_options_in_mm(tmp_path, capsys, options, asked):
    file, out = tmp_path / "map.txt", tmp_path / "map.csv"
    file.write_text("x[mm] y[mm] Bx[mT]\n0 0 200\n1 0 201\n")
    assert main(["import-map", str(file), "-o", str(out), *options, "--json"]) == 0
    remarks = " ".join(json.loads(capsys.readouterr().out)["remarks"])
    assert ("Are they in mm?" in remarks) == asked
    assert ("--origin-m is in m" in remarks) == (asked and "--origin-m" in options)


def test_angles_in_degrees(tmp_path, capsys):
    file = tmp_path / "ring.txt"
    file.write_text("r phi z Br Bphi Bz\n" + "".join(
        f"10 {angle} 0 1 0 0\n" for angle in range(0, 360, 45)))
    command = ["import-map", file, "-o", tmp_path / "map.csv", "--length-unit", "mm",
               "--field-unit", "mT", "--angle-unit"]
    code, sentence = refused([*command, "rad"], capsys)
    assert code == 4
    assert "within 12.6 rad; instead received 315. Are they in degrees?" in sentence
    assert main([str(each) for each in (*command, "deg")]) == 0


def test_a_coordinate_of_the_file_and_of_the_options(tmp_path, capsys):
    file = tmp_path / "hall.txt"
    file.write_text("0.0 0.0 0.0 731.2 1.1 0.0\n0.0 0.0 1.0 730.9 1.2 0.1\n")
    code, sentence = refused(["import-map", file, "-o", tmp_path / "map.csv", *COLUMNS,
                              "--at", "x=0.5"], capsys)
    assert code == 4
    assert "a column x in the file and --at x=0.5" in sentence


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


def test_rods_that_leave_no_wall(campaign, tmp_path, capsys):
    """It is not the pockets that are too near to each other."""
    study, _, _ = campaign
    study.write_text(tomlkit.dumps(changed(BASE, holder={
        "clearance_m": 0.0, "rods": {"count": 100, "diameter_m": 0.02}})))
    code, sentence = refused(["cad", study, "-o", tmp_path / "out"], capsys)
    assert code == 3
    assert "between rod 1 and rod 2" in sentence
    assert "take fewer or thinner rods" in sentence


def test_a_folder_is_refused_before_the_check(tmp_path, capsys, monkeypatch):
    """Which may take a minute."""
    file = tmp_path / "map.csv"
    file.write_text("x_m,y_m,z_m,Bx_T,By_T,Bz_T\n0,0,0,1,0,0\n")
    monkeypatch.setattr("halbach_fe.check_map", None)
    code, sentence = refused(["check", file, "-o", file], capsys)
    assert code == 8
    assert f"Cannot make folder {file}: File exists. It is a file; name a folder" in sentence


def test_more_blocks_than_fit_into_a_ring(tmp_path, capsys):
    """The search would choose rings that cannot be built."""
    study = tmp_path / "study.toml"
    layer = {"radii_m": [0.06, 0.065], "sizes_m": [0.02], "blocks_per_ring": [8, 20]}
    study.write_text(tomlkit.dumps(changed(
        BASE, array__block={"shape": "cuboid", "width_m": 0.02},
        design={"rings": 2, "spacing_m": 0.03, "layer": [layer]})))
    code, sentence = refused(["design", study, "-o", tmp_path / "out"], capsys)
    assert code == 3
    assert "`design.layer.blocks_per_ring`" in sentence
    assert "at the radius 0.065 m; instead received 20. 17 do." in sentence


def test_sorting_into_rings_that_differ(tmp_path, capsys):
    """No key prior.types parts the rings; what the sentence advises does."""
    study, blocks, table = (tmp_path / name for name in ("two.toml", "blocks.csv", "free.csv"))
    document = changed(BASE, array__ring=[{"inner_radius_m": 0.05}, {"inner_radius_m": 0.055}])
    del document["array"]["rings"]
    study.write_text(tomlkit.dumps(document))
    measured = measured_blocks(build_magnet(read_study(study)))
    write_blocks(measured, blocks)
    code, sentence = refused(["sort", study, blocks, "-o", tmp_path / "out"], capsys)
    assert code == 3
    assert "Input type 1 of study base must be of blocks that are alike" in sentence
    assert "r01s01 and r02s01" in sentence
    assert "halbach-fe export STUDY --format blocks), add a column `type`" in sentence
    assert main(["export", str(study), "--format", "blocks", "-o", str(table)]) == 0
    header, *rows = table.read_text().splitlines()
    table.write_text("\n".join([f"{header},type", *(f"{row},{row.split(',')[0]}" for row in rows)]))
    study.write_text(tomlkit.dumps(document | {"array": {"free_blocks": {"file": "free.csv"}}}))
    write_blocks(replace(measured, type=("",) * len(measured)), blocks)
    loose_blocks(build_magnet(read_study(study)), read_blocks(blocks))


def test_sorting_free_blocks_of_a_simulated_measurement(tmp_path, capsys):
    """Two rings of bars of another length, listed as free blocks: what is advised of those without
    types makes the same simulated table one that can be sorted.
    """
    study, table = tmp_path / "free.toml", tmp_path / "free.csv"
    bar = {"shape": "cuboid", "width_m": 0.01, "orientation": "magnetization"}
    document = changed(BASE, array__block=bar, array__ring=[
        {"ring_length_m": 0.03}, {"ring_length_m": 0.04}])
    del document["array"]["rings"]
    study.write_text(tomlkit.dumps(document))
    assert main(["export", str(study), "--format", "blocks", "-o", str(table)]) == 0
    study.write_text(tomlkit.dumps(document | {"array": {"free_blocks": {"file": "free.csv"}}}))
    assert main(["simulate-measurement", str(study), "-o", str(tmp_path / "made")]) == 0
    capsys.readouterr()
    sort = ["sort", str(study), str(tmp_path / "made" / "blocks.csv"), "-o", str(tmp_path / "out")]
    code, sentence = refused(sort, capsys)
    assert code == 3
    assert "Add a column `type` to the table of `array.free_blocks`" in sentence
    header, *rows = table.read_text().splitlines()
    table.write_text("\n".join([f"{header},type", *(f"{row},{row[:3]}" for row in rows)]))
    assert main(sort) == 0


def test_a_study_in_place_of_a_map(campaign, tmp_path, capsys):
    study, measured, _ = campaign
    for command in (["export", study, "--format", "csv", "-o", tmp_path / "out.csv"],
                    ["import-map", study, "-o", tmp_path / "out.csv"], ["check", study],
                    ["infer", study, "--measurements", study, "-o", tmp_path / "out"]):
        code, sentence = refused(command, capsys)
        assert code == 4
        assert "a file of measurements; instead received a study. halbach-fe solve" in sentence
    code, sentence = refused(["diagnose", study, "--measurements", measured, "--check",
                              tmp_path / "no.json", "-o", tmp_path / "out"], capsys)
    assert code == 4
    assert "a readable file; instead received 'No such file or directory'" in sentence


def test_a_report_into_no_page(tmp_path, capsys):
    """The name of a study made a folder of that name."""
    page = tmp_path / "x.toml"
    code, sentence = refused(["report", tmp_path / "solved", "-o", page], capsys)
    assert code == 8
    assert f"a page (.html), or a folder for report.html; instead received '{page}'" in sentence
    assert f"Write {tmp_path / 'x.html'}." in sentence
    assert not page.exists()


def test_a_report_on_its_own_folder(tmp_path, capsys):
    """Which wildcards may name; alone it is nothing to report on."""
    code, sentence = refused(["report", tmp_path, "-o", tmp_path], capsys)
    assert code == 8
    assert f"other than its own; instead received {tmp_path}." in sentence


@pytest.mark.parametrize("kept", [0, 3000])
def test_no_space_for_a_solid(campaign, tmp_path, capsys, monkeypatch, kept):
    """Gmsh blames nothing, or the file; the radii of the study are right."""
    write = gmsh.write

    def cut(name):
        write(name)
        os.truncate(name, kept)

    assert main(["cad", str(campaign[0]), "-o", str(tmp_path / "whole")]) == 0
    capsys.readouterr()
    monkeypatch.setattr("gmsh.write", cut)
    code, sentence = refused(["cad", campaign[0], "-o", tmp_path / "out"], capsys)
    assert code == 8
    assert f"File too large; {kept} bytes could be written" in sentence
    assert not (tmp_path / "out" / "blocks.step").exists()


def test_advice_for_a_held_out_map_in_mt_works(campaign, tmp_path, capsys):
    """Beside a map in T. The key of the study, which was advised, has both in its unit."""
    study, measured, _ = campaign
    magnet = build_magnet(read_study(study))
    points = points_from(magnet.study.observation.positions) + np.array([0.0, 0.0, 1e-4])
    held = tmp_path / "held.csv"
    write_map(field_map(points, 1e3 * field_of(magnet.blocks, points)), held)

    def check(one, code):
        capsys.readouterr()
        assert main([*map(str, ["infer", study, "--measurements", measured, "--held-out", one,
                                "-o", tmp_path / "out", "--dry-run"])]) == code
        return capsys.readouterr().err

    said = check(held, 4)
    assert "Then name the columns Bx_mT, By_mT, Bz_mT or" in said
    assert "if all maps of the study are so, the held-out one too" in said
    header, *rows = held.read_text().splitlines(keepends=True)
    for unit in ("x", "y", "z"):
        header = header.replace(f"B{unit}_T", f"B{unit}_mT")
    held.write_text(header + "".join(rows))
    assert main(["import-map", str(held), "-o", str(tmp_path / "converted.csv")]) == 0
    check(tmp_path / "converted.csv", 0)


def test_blocks_far_from_the_nominal_ones_are_told_in_words_of_a_user(campaign, tmp_path, capsys):
    """The sentence named the argument `magnetizations` of a function in Python."""
    study, _, _ = campaign
    magnet = build_magnet(read_study(study))
    points = points_from(magnet.study.observation.positions)
    write_map(field_map(points, -field_of(magnet.blocks, points)), tmp_path / "reversed.csv")
    assert main([*map(str, ["infer", study, "--measurements", tmp_path / "reversed.csv", "-o",
                            tmp_path / "out"])]) == 0
    said = capsys.readouterr().err
    assert "farther from the nominal ones than if none were magnetized" in said
    assert "`magnetizations`" not in said
