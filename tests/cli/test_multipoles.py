"""tolerance, sort and shim on the command line: files, figures, messages."""

from __future__ import annotations

import json
from html.parser import HTMLParser

import pytest

from halbach_fe.block_table import read_blocks
from halbach_fe.cli import common, main
from halbach_fe.study import read_study

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


class _Pictures(HTMLParser):
    """Pictures of a page, and what it loads from elsewhere."""

    def __init__(self):
        super().__init__()
        self.texts, self.loaded = [], []

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        if tag == "img":
            self.texts.append(found.get("alt", ""))
            if not found["src"].startswith("data:"):
                self.loaded.append(found["src"])
        if tag in ("script", "link"):
            self.loaded.append(tag)


def page(path):
    parser = _Pictures()
    parser.feed(path.read_text())
    assert parser.texts
    assert all(len(text) > 20 for text in parser.texts)
    assert not parser.loaded
    return path.read_text()


def run(capsys, *arguments, code=0):
    capsys.readouterr()
    assert main([str(one) for one in arguments]) == code
    shown = capsys.readouterr()
    return shown.err if code else json.loads(shown.out)


def test_shim(made, tmp_path, capsys):
    study, folder = made
    options = ["--measurements", folder / "map.csv", "--blocks", folder / "blocks.csv", *TARGET,
               "--json"]
    found = run(capsys, "shim", study, "-o", tmp_path / "one", *options, "--swaps", 3)
    assert found == {key: value for key, value in json.loads(
        (tmp_path / "one" / "shim.json").read_text()).items() if key != "study_file"}
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
    assert "Leave it as it is" in page(tmp_path / "two" / "shim.html")
    assert not (tmp_path / "two" / "study.shimmed.toml").exists()
    assert left["before"] == found["before"]


def test_sort(made, tmp_path, capsys):
    study, folder = made
    found = run(capsys, "sort", study, folder / "blocks.csv", "-o", tmp_path, *TARGET, "--json")
    table = read_blocks(tmp_path / "blocks.sorted.csv")
    assert sorted(table.places) == [(1, slot) for slot in range(1, 13)]
    assert found["rms_sorted_units"] < found["rms_random_units"]["0.01"]
    assert found["table_order"] == "as placed in the table"
    assert "which block where" in page(tmp_path / "sort.html")
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
    assert common.orders(text) == orders


@pytest.mark.parametrize("text", ["0..3", "5..2", "2..1000", "x", "", "2..3.."])
def test_orders_that_are_none(text):
    with pytest.raises((ValueError, common.argparse.ArgumentTypeError)):
        common.orders(text)
