"""The shipped examples: their campaigns are what the truth says, and what is hidden is found."""

from __future__ import annotations

import hashlib
import json

import pytest

from halbach_fe.cli import main
from halbach_fe.measurement.field_map import read_map
from tests.conftest import ROOT


def campaign_of(name):
    return ROOT / "studies" / name / "campaign"


@pytest.mark.parametrize("name", ["quadrupole", "cubes"])
def test_maps_name_the_truth(name):
    truth = (campaign_of(name) / "truth" / "truth.json").read_bytes()
    for part in ("map.csv", "held-out.csv"):
        assert read_map(campaign_of(name) / part).attrs["truth_sha256"] == (
            hashlib.sha256(truth).hexdigest())
    assert len(json.loads(truth)["effects"]) >= 1


def test_swapped_blocks_of_the_quadrupole_are_found(tmp_path):
    """As `make study-quadrupole` does. The noise is below the error of the mesh: chi2 of 0.5."""
    folder = campaign_of("quadrupole")
    assert main(["diagnose", str(folder.parent / "study.toml"),
                 "--measurements", str(folder / "map.csv"), "--blocks", str(folder / "blocks.csv"),
                 "--held-out", str(folder / "held-out.csv"), "-o", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    (hidden,) = json.loads((folder / "truth" / "truth.json").read_text())["effects"]
    (effect,) = found["effects"]
    assert effect["effect"] == hidden["name"] == "blocks_swapped"
    before, after = (next(row for row in found["scores"][when] if row["part"] == "held-out map")
                     for when in ("before", "after"))
    assert before["chi2_per_reading"] > 1000
    assert after["chi2_per_reading"] < 1.5
