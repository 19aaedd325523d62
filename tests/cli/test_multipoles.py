"""multipoles, tolerance, sort and shim on the command line: files, figures, messages."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main, shared_options
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.posterior_files import read_posterior
from halbach_fe.measurement.block_table import read_blocks
from halbach_fe.measurement.field_map import read_map
from halbach_fe.response.multipoles import UNITS
from halbach_fe.study.reader import read_study
from tests.cli.test_all_keys import BASE
from tests.conftest import changed
from tests.support.pages import page

STUDY = """
name = "cubes"  # as ordered
dimension = 2
[array]
blocks_per_ring = 12
inner_radius_m = 0.105
outer_radius_m = 0.135
remanence_T = 1.3
[array.block]
shape = "cuboid"
width_m = 0.03
orientation = "magnetization"
[mesh]
block_size_m = 0.01
[observation]
quantity = "flux_density"
components = ["x", "y"]
[observation.positions]
kind = "circles"
radius_m = 0.07
angles = 32
[[noise.regions]]
name = "bore"
sigma_T = 2e-5
[prior]
mounting_sd_deg = 0.05
types = { a = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12] }
"""
TARGET = ["--orders", "2..5", "--reference-radius-m", "0.07"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A study's file, and a campaign."""
    folder = tmp_path_factory.mktemp("campaign")
    study = folder / "study.toml"
    study.write_text(STUDY)
    assert main(["simulate-measurement", str(study), "-o", str(folder), "--seed", "3",
                 "--json"]) == 0
    return study, folder


def run(capsys, *arguments, code=0):
    capsys.readouterr()
    assert main([str(one) for one in arguments]) == code
    shown = capsys.readouterr()
    return shown.err if code else json.loads(shown.out)


@pytest.mark.parametrize(("angle", "cancels"), [(179.9, True), (0.0, False)])
def test_a_main_multipole_that_cancels(tmp_path, capsys, angle, cancels):
    """Of rings of opposite fields, as in an undulator, numbers are absolute."""
    document = changed(BASE, prior__mounting_sd_deg=0.5)
    del document["array"]["rings"]
    study = tmp_path / "study.toml"
    document["array"]["ring"] = [{}, {"first_magnetization_angle_deg": 180.0}]
    study.write_text(tomlkit.dumps(document))
    command = ["multipoles", study, "--reference-radius-m", "0.03", "-o", tmp_path / "out"]
    assert "ask on circles at poles: --at-z-m Z" in run(capsys, *command, code=3)
    # as advised: in a pole there is a main field, and the table that has none is left out
    run(capsys, *command, "--at-z-m", "0.04", "--json")
    said = page(tmp_path / "out" / "multipoles.html")
    assert "The largest unwanted multipole" in said
    assert "Of the field integrated along z" not in said
    assert "The field integrated along z has no multipole of order 1, which cancels there" in said
    assert {row["where"] for row in rows_of(tmp_path / "out" / "multipoles.csv", "prior")} == {
        "local"}
    tolerance = ["tolerance", *command[1:-1], tmp_path / "tolerance"]
    assert "--at-z-m Z" in run(capsys, *tolerance, code=3)
    document["array"]["ring"] = [{}, {"first_magnetization_angle_deg": angle}]
    study.write_text(tomlkit.dumps(document))
    if cancels:  # to its tolerances: units of it are refused, and the advice holds
        refused = run(capsys, *tolerance, code=3)
        assert "above 0.01 of what the blocks could make together" in refused
        run(capsys, *tolerance, "--at-z-m", "0.04", "--json")
        run(capsys, *command, "--at-z-m", "0.04", "--json")
        said = page(tmp_path / "out" / "multipoles.html")
        assert "units of 1e-4 of it mean nothing" in said
        assert "Only as absolute numbers" not in said
        assert ("The field integrated along z, at a radius of 30 mm: there is no main multipole"
                in said.replace("\u00a0", " "))
        assert "The circle of 30 mm:" not in said
    run(capsys, *command, "--json")
    said = page(tmp_path / "out" / "multipoles.html")
    assert ("there is no main multipole, of order 1, but for errors" in said) == cancels
    assert ("Only as absolute numbers" in said) == cancels
    assert ("µT m itself" in said.replace("\u00a0", " ")) == cancels
    assert ("in mT m, as there is no main multipole" in said) == cancels
    # the other commands that state such units (sort takes only blocks that are alike)
    options = [*command[1:-2], "--json", "-o"]
    run(capsys, "simulate-measurement", study, "-o", tmp_path / "campaign", "--json")
    measured = ["--measurements", tmp_path / "campaign" / "map.csv"]
    for name, more in (("tolerance", []), ("shim", measured)):
        shown = run(capsys, name, *options, tmp_path / f"{name}-units", *more,
                    code=3 if cancels else 0)
        assert not cancels or "above 0.01 of what the blocks could make" in shown, name


def rows_of(path, magnet):
    """Columns of a magnet in multipoles.csv, by name."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    table = np.genfromtxt(lines, delimiter=",", names=True, dtype=None, encoding=None)
    return table[table["magnet"] == magnet]


def read_from(path):
    """Multipoles of a map on one circle, as it was read: orders 1 to 5, C_n exp(-i n turn)."""
    data = read_map(path)
    angle = np.arctan2(data["y_m"].values, data["x_m"].values)
    field = data["B_T"].values[:, 1] + 1j * data["B_T"].values[:, 0]
    return np.array([np.mean(field * np.exp(-1j * (n - 1) * angle)) for n in range(1, 6)])


def test_multipoles_of_the_measured_magnet(made, tmp_path, capsys):
    """The map is by magpylib and NGSolve; what is read from it directly differs by its noise,
    2e-5 T sqrt(2 / 32) in each part of C_n, from what the posterior says.
    """
    study, folder = made
    run(capsys, "infer", study, "--measurements", folder / "map.csv", "-o", tmp_path, "--json")
    found = run(capsys, "multipoles", study, "--posterior", tmp_path / "posterior.h5", "-o",
                tmp_path / "out", *TARGET, "--limit-units", 500, "--json")
    (table,) = found["tables"]
    assert table["reference"]["radius_m"] == 0.07
    assert table["posterior"]["probability_within_limit"] == 1.0
    assert table["prior"]["probability_within_limit"] > 0.9
    text = (tmp_path / "out" / "multipoles.csv").read_text()
    assert "# reference_radius_m: 0.07\n" in text
    assert "n = 1 is the dipole" in text
    own = rows_of(tmp_path / "out" / "multipoles.csv", "posterior")
    for row, stored in zip(own, table["posterior"]["multipoles"], strict=True):
        for column, key in (("n", "n"), ("b_units", "b"), ("b_sd_units", "b_sd"),
                            ("a_units", "a"), ("a_sd_units", "a_sd")):
            assert row[column] == stored[key]
    assert list(own["main"]) == [table["posterior"]["main_T"]] * 4
    shown = page(tmp_path / "out" / "multipoles.html")
    assert all(f"{row['b_units']:+.2f} ± {row['b_sd_units']:.2f}" in shown for row in own)

    turn = -table["reference"]["axes_turned_by_rad"]
    coefficients = read_from(folder / "map.csv") * np.exp(-1j * turn * np.arange(1, 6))
    truth = UNITS * coefficients[1:] / abs(coefficients[0])
    noise = UNITS * 2e-5 * np.sqrt(2 / 32) / abs(coefficients[0])
    assert own["main"][0] == pytest.approx(abs(coefficients[0]), abs=4e-5)

    def scores(rows):
        return np.concatenate([
            (rows["b_units"] - truth.real) / np.hypot(rows["b_sd_units"], noise),
            (rows["a_units"] - truth.imag) / np.hypot(rows["a_sd_units"], noise)])

    assert np.abs(scores(own)).max() < 4
    assert np.abs(truth).max() > 10
    # negative controls: skew for normal, and the prior's mean with the posterior's error bars
    swapped, early = own.copy(), own.copy()
    swapped["b_units"], swapped["a_units"] = own["a_units"], own["b_units"]
    prior = rows_of(tmp_path / "out" / "multipoles.csv", "prior")
    early["b_units"], early["a_units"] = prior["b_units"], prior["a_units"]
    assert min(np.abs(scores(swapped)).max(), np.abs(scores(early)).max()) > 10
    assert np.abs(scores(prior)).max() < 4

    # infer has the same from its own readings, orders 1 to 10, by as many points as the map has
    directly = rows_of(tmp_path / "multipoles.csv", "posterior")
    assert list(directly["n"]) == list(range(1, 11))
    np.testing.assert_allclose(directly["b_units"][1:5], own["b_units"], atol=0.5)
    assert "Multipoles" in page(tmp_path / "report.html")
    # standard deviations are those of the stored covariance, and the wrong magnet is refused
    stored = read_posterior(build_magnet(read_study(study)), tmp_path / "posterior.h5")
    assert stored["posterior"].sd.max() < stored["prior"].sd.min()
    other = tmp_path / "other.toml"
    other.write_text(STUDY.replace("1.3", "1.31"))
    error = run(capsys, "multipoles", other, "--posterior", tmp_path / "posterior.h5", "-o",
                tmp_path / "x", code=4)
    assert "another `array.remanence_T`" in error
    error = run(capsys, "multipoles", study, "--posterior", folder / "map.csv", "-o",
                tmp_path / "x", code=4)
    assert "posterior.h5" in error


def test_multipoles_of_the_nominal_magnet(made, tmp_path, capsys):
    """solve's own field on the study's circle, with the solver's error: none in vacuum."""
    study, _ = made
    run(capsys, "solve", study, "-o", tmp_path, "--json")
    table = rows_of(tmp_path / "multipoles.csv", "nominal")
    assert table["b_units"][0] == pytest.approx(UNITS)
    data = read_map(tmp_path / "field_map.csv")
    angle = np.arctan2(data["y_m"].values, data["x_m"].values)
    radial = data["B_T"].values[:, 0] * np.cos(angle) + data["B_T"].values[:, 1] * np.sin(angle)
    coefficients = np.array([2 * np.mean(radial * (np.sin(n * angle) + 1j * np.cos(n * angle)))
                             for n in range(1, 6)])
    # the table has no aliases, of order 32 - n: 2e-6 in the main one, 0.2 units in b3
    assert table["main"][0] == pytest.approx(abs(coefficients[0]), rel=1e-5)
    sizes = np.hypot(table["b_units"], table["a_units"])[:5]
    np.testing.assert_allclose(sizes, UNITS * np.abs(coefficients) / abs(coefficients[0]),
                               atol=0.3)
    assert (table["b_sd_units"] == 0).all()
    assert "multipoles.csv" in page(tmp_path / "report.html")
    permeable = tmp_path / "permeable.toml"
    permeable.write_text(STUDY.replace("remanence", "recoil_permeability = 1.05\nremanence"))
    run(capsys, "solve", permeable, "-o", tmp_path / "permeable", "--json")
    error = rows_of(tmp_path / "permeable" / "multipoles.csv", "nominal")["b_sd_units"]
    assert ((error > 0) & (error < 10)).all()
    # without a posterior the study's prior is taken
    found = run(capsys, "multipoles", study, "-o", tmp_path / "prior", *TARGET, "--json")
    assert set(found["tables"][0]) == {"reference", "prior"}


def test_shim(made, tmp_path, capsys):
    study, folder = made
    options = ["--measurements", folder / "map.csv", "--blocks", folder / "blocks.csv", *TARGET,
               "--json"]
    found = run(capsys, "shim", study, "-o", tmp_path / "one", *options, "--swaps", 3)
    assert found == json.loads((tmp_path / "one" / "shim.json").read_text())
    assert found["stop"] in ("budget", "uncertainty")
    assert len(found["moves"]) > 0
    assert found["after"]["rms_units"] < found["before"]["rms_units"]
    assert [row["n"] for row in found["after"]["multipoles"]] == [2, 3, 4, 5]
    swap = next(move for move in found["moves"] if move["kind"] == "swap")
    assert swap["blocks"][0]["from"] == swap["blocks"][1]["to"]
    assert "cubes: how to shim it" in page(tmp_path / "one" / "shim.html")
    shimmed = tmp_path / "one" / "study.shimmed.toml"
    assert "# as ordered" in shimmed.read_text()
    assert read_study(shimmed).array.exceptions
    # the study with its blocks moved is one that can be measured again
    assert main(["tolerance", str(shimmed), "-o", str(tmp_path / "again"), "--json", "--draws",
                 "100", "--blocks", str(folder / "blocks.csv")]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["closed_form"]["multipoles"][2]["size"] >= 0
    left = run(capsys, "shim", study, "-o", tmp_path / "two", *options, "--swaps", 0, "--turns", 0)
    assert left["moves"] == []
    assert "No move was tried" in page(tmp_path / "two" / "shim.html")
    assert not (tmp_path / "two" / "study.shimmed.toml").exists()
    assert left["before"] == found["before"]


def test_sort(made, tmp_path, capsys):
    study, folder = made
    found = run(capsys, "sort", study, folder / "blocks.csv", "-o", tmp_path, *TARGET, "--json")
    table = read_blocks(tmp_path / "blocks.sorted.csv")
    assert sorted(table.places) == [(1, slot) for slot in range(1, 13)]
    assert found["rms_sorted_units"] < found["rms_random_units"]["0.025"]
    assert found["table_order"] == "as placed in the table"
    assert "which block goes into which slot" in page(tmp_path / "sort.html")
    again = run(capsys, "sort", study, tmp_path / "blocks.sorted.csv", "-o", tmp_path / "again",
                *TARGET, "--json")
    assert again["rms_unsorted_units"] == pytest.approx(found["rms_sorted_units"])


def test_tolerance(made, tmp_path, capsys):
    study, _ = made
    options = [*TARGET, "--json", "--draws", 3000]
    found = run(capsys, "tolerance", study, "-o", tmp_path, *options, "--limit-units", 40)
    assert 0 < found["share_within_limit"] < 1
    assert all(row["share_within_limit"] >= found["share_within_limit"] for row in found["sizes"])
    assert "within 40 units" in page(tmp_path / "tolerance.html")
    same = run(capsys, "tolerance", study, "-o", tmp_path / "same", *options, "--limit-units", 40)
    other = run(capsys, "tolerance", study, "-o", tmp_path / "other", *options, "--limit-units",
                40, "--seed", 2)
    assert same == found
    assert other["sizes"] != found["sizes"]
    assert other["closed_form"] == found["closed_form"]


@pytest.mark.parametrize(("arguments", "code", "said"), [
    (["tolerance", "{study}", "--reference-radius-m", "70"], 3, "millimetres"),
    (["tolerance", "{study}", "--orders", "1"], 3, "unwanted multipoles"),
    (["tolerance", "{study}", "--at-z-m", "0.1"], 3, "since it is 2D"),
    (["shim", "{study}", "--measurements", "{folder}/map.csv", "--stock", "{folder}/blocks.csv"],
     3, "--replace"),
    (["sort", "{study}", "{folder}/map.csv"], 4, "header"),
    (["shim", "{study}", "--measurements", "{folder}/map.csv", "--replace", "1", "--stock",
      "{folder}/nothing.csv"], 4, "nothing.csv")])
def test_bad_input(made, tmp_path, capsys, arguments, code, said):
    study, folder = made
    error = run(capsys, *(one.format(study=study, folder=folder) for one in arguments), "-o",
                tmp_path, code=code)
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("text", "orders"), [
    ("2..4", (2, 3, 4)), ("3,5,7", (3, 5, 7)), ("2..3,9,2", (2, 3, 9))])
def test_orders(text, orders):
    assert shared_options.orders(text) == orders


@pytest.mark.parametrize("text", ["0..3", "5..2", "2..1000", "x", "", "2..3.."])
def test_orders_that_are_none(text):
    with pytest.raises((ValueError, shared_options.argparse.ArgumentTypeError)):
        shared_options.orders(text)
