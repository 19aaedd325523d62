"""halbach-fe diagnose as a user meets it: what it prints, what it writes, what it refuses."""

from __future__ import annotations

import base64
import functools
import json
import re
import tomllib
from html.parser import HTMLParser
from types import SimpleNamespace

import magpylib
import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.map_conventions import ERRORS_BY_PLAUSIBILITY
from halbach_fe.diagnosis.summary import diagnosis_summary
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map, read_map, readings_sha256, write_map
from halbach_fe.study.reader import parse_study
from tests.conftest import ROOT, circle

STUDY = """# of the session's drawing
name = "small"
dimension = 3

[array]
blocks_per_ring = 8
rings = 2
inner_radius_m = 0.05   # measured
outer_radius_m = 0.09
ring_length_m = 0.06
remanence_T = 1.0

[array.block]
shape = "sector"

[mesh]
block_size_m = 0.03

[observation]
quantity = "flux_density"

[observation.positions]   # of the mapper
kind = "circles"
radius_m = 0.035
angles = 8
z_min_m = -0.12
z_max_m = 0.12
count = 25

[[noise.regions]]
name = "bore"
z_min_m = -0.06
z_max_m = 0.06
sigma_T = 3e-5

[[noise.regions]]
name = "fringe"
sigma_T = 3e-5

[inference.held_out]
every = 4
"""
POINTS = np.vstack([circle(0.035, 8, z) for z in np.linspace(-0.12, 0.12, 25)])
SAG_M = 4e-4
CHOICE = "arm_sag,offset_x,background,gain_x,mapper_translation,block_demagnetized"


@functools.cache
def fields(sag):
    """A map by magpylib, of blocks that are not quite nominal; the arm sags towards -y."""
    generator = np.random.default_rng(7)
    study = parse_study({"name": "truth", "array": {
        "blocks_per_ring": 8, "rings": 2, "inner_radius_m": 0.05, "outer_radius_m": 0.09,
        "ring_length_m": 0.06, "remanence_T": 1.0, "block": {"shape": "sector"}},
        "mesh": {"block_size_m": 0.03}, "observation": {
            "quantity": "flux_density", "positions": {
                "kind": "circles", "radius_m": 0.035, "angles": 8}}})
    along = (POINTS[:, 2] - POINTS[:, 2].min()) / np.ptp(POINTS[:, 2])
    there = POINTS - np.outer(sag * along**2, [0, 1, 0])
    total = 3e-5 * generator.standard_normal(POINTS.shape)
    for block in build_magnet(study).blocks:
        middle = position_angle_deg(study.array, block.slot)
        polarization = np.array(block.easy_axis) + 0.01 * generator.standard_normal(3)
        total += magpylib.magnet.CylinderSegment(
            dimension=(0.05, 0.09, 0.06, middle - 22.5, middle + 22.5),
            position=(0, 0, (block.z_min + block.z_max) / 2), polarization=polarization,
        ).getB(there)
    return total


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def measured(folder, sag):
    path = folder / "map.csv"
    write_map(field_map(POINTS, fields(sag)), path)
    return path


class Page(HTMLParser):
    """Headings, pictures with their texts, and other addresses of a page."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.pictures, self.outside, self.inside = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.inside = tag
        if tag == "img":
            kind, _, data = named["src"].partition(",")
            self.pictures.append((kind, base64.b64decode(data), named["alt"]))
        self.outside += [value for key, value in attributes
                         if key in ("href", "src") and not value.startswith("data:")]

    def handle_data(self, data):
        if self.inside in ("h1", "h2") and data.strip():
            self.headings.append(data)
        self.inside = ""


def test_a_hidden_effect_is_named_and_added(study, tmp_path, capsys):
    out, data = tmp_path / "out", measured(tmp_path, SAG_M)
    arguments = ["diagnose", str(study), "--measurements", str(data), "-o", str(out),
                 "--effects", CHOICE]
    assert main(arguments) == 0
    shown = capsys.readouterr()
    assert "sag of the" in shown.out  # its name in words, in a narrow column
    assert re.search(r"0\.\d+ ± 0\.\d+ mm", shown.out)
    assert "held out, fringe" in shown.out
    assert "The map is explained by: sag of the mapper's arm" in shown.err
    lines = [line for line in shown.err.splitlines() if line.startswith("round ")]
    found = json.loads((out / "diagnosis.json").read_text())
    assert len(lines) == found["rounds"]

    assert found["verdict"] == "named"
    (effect,) = found["effects"]
    assert (effect["effect"], effect["place"], effect["kind"]) == ("arm_sag", "", "instrument")
    (sag,) = effect["parameters"]
    assert sag["unit"] == "m"
    assert abs(sag["value"] - SAG_M) < 4 * sag["sd"]  # one draw
    assert sag["sd"] < 0.1 * SAG_M
    before, after = ({(one["part"], one["region"]): one for one in found["scores"][when]}
                     for when in ("before", "after"))
    assert set(before) == {("training", "all"), *(("held out", name) for name in (
        "all", "bore", "fringe"))}
    for key in (("training", "all"), ("held out", "all")):
        # 456 and 144 readings: sd of chi2 per reading 0.07 and 0.12
        assert after[key]["chi2_per_reading"] == pytest.approx(1.0, abs=0.4)
        assert before[key]["chi2_per_reading"] > 2 * after[key]["chi2_per_reading"]
        assert after[key]["coverage95"] == pytest.approx(0.95, abs=0.06)
    held = [after["held out", "all"]["rms_T"], before["held out", "all"]["rms_T"]]
    assert list(held[0]) == ["Bx", "By", "Bz"]
    # noise of 3e-5 T and what the blocks leave; 48 readings of each component
    assert all(2e-5 < value < 6e-5 for value in held[0].values())
    assert max(held[1].values()) > 2 * max(held[0].values())
    assert 0.1 < found["main_field_T"] < 1
    assert "µT" in shown.out
    assert "ppm of the main field" in shown.out
    assert "median" not in json.dumps(found["scores"])
    assert any(one["p"] < 1e-6 for one in found["groups"]["before"])
    assert all(one["p"] > 1e-4 for one in found["groups"]["after"])
    assert sum(found["probabilities"].values()) == pytest.approx(1)

    page = Page((out / "diagnosis.html").read_text())
    assert page.headings == [
        "small: what the model lacks", "What is missing", "What else it could be",
        "What would tell it from other causes", "Where model and map disagree",
        "How sure that is", "What changed", "Structure in the magnetizations",
        "Where nobody measured", "The magnet", "The study with what was missing", "Provenance"]
    assert len(page.pictures) == 5
    assert all(kind == "data:image/png;base64" and picture.startswith(b"\x89PNG") and text
               for kind, picture, text in page.pictures)
    assert page.outside == []
    assert not [path for path in out.iterdir() if path.name.startswith(".")]

    # the study that it wrote is the one it solved, and others run it as it stands
    text = (out / "study.diagnosed.toml").read_text()
    (line,) = [line for line in text.splitlines() if line.startswith("arm_sag_m")]
    assert f"{sag['value']!r}" in line
    assert re.search(r"# arm_sag: sag .* m, log Bayes factor [\d.]+$", line)
    assert text.startswith(STUDY.rstrip("\n"))
    written = str(out / "study.diagnosed.toml")
    assert main(["solve", written, "-o", str(tmp_path / "solved"), "--json"]) == 0
    capsys.readouterr()
    assert main(["infer", written, "-o", str(tmp_path / "again"), "--json", "--measurements",
                 str(data)]) == 0
    conflict = json.loads(capsys.readouterr().out)["prior_conflict"]
    # infer estimates the sag again, with its prior about the value found: it hardly moves
    assert conflict == pytest.approx(after["training", "all"]["chi2_per_reading"], rel=1e-6)


def test_nothing_is_missing(study, tmp_path, capsys):
    """Negative control: the same without sag."""
    out, data = tmp_path / "out", measured(tmp_path, 0.0)
    arguments = ["diagnose", str(study), "--measurements", str(data), "-o", str(out), "--json",
                 "--effects", CHOICE, "--held-out"]
    assert main([*arguments, str(data)]) == 4
    assert "other readings" in capsys.readouterr().err
    again = tmp_path / "again.csv"
    write_map(read_map(data).isel(point=slice(None, None, -1)).pipe(
        lambda old: old.assign(B_T=old["B_T"] + 6e-6)), again)  # a fifth of the noise: read anew
    assert main([*arguments, str(again)]) == 0
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert found == json.loads((out / "diagnosis.json").read_text())
    assert (found["verdict"], found["effects"], found["next"]) == ("nothing", [], [])
    assert found["readings"] == {"training": 456, "held out": 144, "held-out map": 600}
    assert max(found["probabilities"], key=found["probabilities"].get) == "none"
    assert (out / "study.diagnosed.toml").read_text() == STUDY
    page = (out / "diagnosis.html").read_text()
    assert '<p class="said">Of what was looked for (' in page
    assert "others may be missing" in page
    blocks_chosen = {"block_demagnetized", "block_displaced"} <= {*CHOICE.split(",")}
    assert ("It would have shown the loss of" in page) == blocks_chosen
    loss = found["limits"]["loss"]  # noise of 3e-5 T, 1 % and 1 deg of the blocks
    assert 0.01 < loss["median"] <= loss["worst"] < 0.5
    assert "before" not in page.split('<p class="said">')[1].split("<figure")[0]


def test_the_floor_of_a_check_stands_beside(study, tmp_path, capsys):
    data, out, check = measured(tmp_path, 0.0), tmp_path / "out", tmp_path / "check.json"
    arguments = ["diagnose", str(study), "--measurements", str(data), "-o", str(out),
                 "--effects", "gain_x", "--check", str(check)]
    for wrong in (None, "{}", '{"floor_T": [1, 2]}', '{"floor_T": [1, 2, NaN]}', "["):
        if wrong is not None:
            check.write_text(wrong)
        assert main(arguments) == 4
        assert "check.json" in capsys.readouterr().err
    floor = {"floor_T": [4.25e-5, 1.5e-4, 2e-5]}
    other = readings_sha256(read_map(data).isel(point=slice(1, None)))
    check.write_text(json.dumps(floor | {"maps_sha256": {"map": other}}))
    assert main(arguments) == 4
    assert "another map" in capsys.readouterr().err
    own = readings_sha256(read_map(data))
    check.write_text(json.dumps(floor | {"maps_sha256": {"map": other, "oriented_map": own}}))
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert "model-free floor" in shown
    assert "42.5\u00a0µT" in shown
    assert "150\u00a0µT" in shown
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["floor_T"] == {"Bx": 4.25e-5, "By": 1.5e-4, "Bz": 2e-5}
    assert "model-free floor" in (out / "diagnosis.html").read_text()


def test_a_misread_map_with_outliers(study, tmp_path, capsys):
    """In millimetres, with three readings that are off; nothing else is missing."""
    out, data = tmp_path / "out", tmp_path / "map.csv"
    shown = fields(0.0).copy()
    off = [(11, 0), (120, 2), (121, 1)]
    for row, column in off:
        shown[row, column] += 3e-3
    write_map(field_map(1e3 * POINTS, shown), data)
    assert main(["diagnose", str(study), "--measurements", str(data), "-o", str(out),
                 "--effects", "gain_x"]) == 0
    said = capsys.readouterr()
    assert ("Gross error: coordinates in millimetres. 3 readings are outliers and excluded"
            in said.err)
    assert "Nothing else is missing" in said.err
    assert "millimetres" in said.out
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["verdict"] == "named"
    assert [one["errors"] for one in found["gross"]] == [["millimetres"]]
    assert [(one["row"], one["component"]) for one in found["outliers"]] == [
        (row + 1, "xyz"[column]) for row, column in off]
    assert (found["effects"], found["vibration"]) == ([], None)
    assert found["readings"]["training"] + found["readings"]["held out"] == 597
    page = (out / "diagnosis.html").read_text()
    assert '<p class="said">Gross error: coordinates in millimetres.' in page
    assert "3 of 600" in page
    text = (out / "study.diagnosed.toml").read_text()
    assert "length_unit_m = 0.001  # gross error: coordinates in millimetres" in text
    assert '{row = 12, components = ["x"]}' in text
    assert "# outliers: 3" in text
    assert main(["infer", str(out / "study.diagnosed.toml"), "--measurements", str(data),
                 "-o", str(tmp_path / "again"), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)["prior_conflict"]
    assert again == pytest.approx(found["scores"]["after"][0]["chi2_per_reading"], rel=1e-9)


@pytest.mark.parametrize(("change", "code", "said"), [
    ({"study": "inner_radius_m = 50"}, 3, "millimetres"),
    ({"map": "x_m,y_m,z_m,Bx_T\n0,0,0,many\n"}, 4, "must be a finite number"),
    ({"map": "x_m,y_m,z_m,Bx_T\n0.07,0,0.02,0.1\n"}, 4, "inside magnet or iron"),
    ({"map": "x_m,y_m,z_m,Bx_T\n0.07,0,0,0.1\n"}, 4, "which touch there"),
    ({"blocks": "serial,type\n"}, 4, "blocks.csv"),
    ({"held-out": None}, 4, "readable file")])
def test_bad_input(study, tmp_path, capsys, change, code, said):
    data, out, extra = measured(tmp_path, 0.0), tmp_path / "out", []
    for key, value in change.items():
        if key == "study":
            study.write_text(STUDY.replace("inner_radius_m = 0.05", value))
        elif key == "map":
            data.write_text(value)
        else:
            extra = [f"--{key}", str(tmp_path / f"{key}.csv")]
            if value is not None:
                (tmp_path / f"{key}.csv").write_text(value)
    found = main(["diagnose", str(study), "--measurements", str(data), "-o", str(out), *extra])
    shown = capsys.readouterr()
    assert found == code
    errors = [line for line in shown.err.splitlines() if not line.startswith("round")]
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    assert said in errors[0]
    assert not list(tmp_path.rglob("diagnosis*"))


@pytest.mark.parametrize(("names", "said"), [
    ("arm_sagg", "did you mean arm_sag?"),
    ("", f"there are {', '.join(sorted(effect.name for effect in catalogue())[:2])}"),
    ("arm_sag,,gain_x", "no effect is called ''")])
def test_unknown_effects_are_a_wrong_command_line(study, tmp_path, capsys, names, said):
    with pytest.raises(SystemExit) as stopped:
        main(["diagnose", str(study), "--measurements", "map.csv", "-o", str(tmp_path / "out"),
              "--effects", names])
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err


def test_impossible_amplitudes_are_refused_after_the_rest_is_written(
    study, tmp_path, capsys, monkeypatch
):
    """Were a gap found to be negative, no study could hold it."""
    gap = next(one for one in catalogue() if one.name == "azimuthal_gap")
    monkeypatch.setattr("halbach_fe.report.diagnosis_page.changed_studies", lambda study, _: [
        (gap.apply(study, gap.places(study)[0], [-1e-4]), "a gap")])
    monkeypatch.setattr("halbach_fe.diagnosis.diagnose.describe_unknown", lambda *_: None)
    out = tmp_path / "out"
    assert main(["diagnose", str(study), "--measurements", str(measured(tmp_path, 0.0)),
                 "-o", str(out), "--effects", "gain_x"]) == 3
    assert "angular_gap_deg" in capsys.readouterr().err
    assert {"diagnosis.json", "diagnosis.html"} <= {path.name for path in out.iterdir()}
    assert not (out / "study.diagnosed.toml").exists()


def test_the_documentation_says_what_is_in_the_file():
    section = (ROOT / "docs" / "diagnosis.md").read_text()
    keys = re.findall(r"^\| `([A-Za-z_]+)` \|", section, re.MULTILINE)
    study = parse_study(tomllib.loads(STUDY))
    update = SimpleNamespace(
        study=study, parts=("training",), maps=("map",), regions=("all",), is_campaign=False,
        prior_conflict=1.0, conflict_limit=2.0, held_out_conflict="",
        readings=np.zeros(1), field=SimpleNamespace(strongest=None),
        prediction_posterior=SimpleNamespace(mean=np.ones(1)),
        observation=SimpleNamespace(labels=("Bx",)))
    nothing = SimpleNamespace(
        study=study, before=update, after=update, gross_errors=(), poses=(), outliers=(),
        identified=(),
        position_noise=(), solver_error=None, unknown=None, suspected=(), found_anything=False,
        probabilities={}, groups_before=[], groups_after=[], loo_residuals_before=np.zeros(1),
        loo_residuals_after=np.zeros(1), rounds=1, answer=1, converged=True, positions=(),
        limits=None, floor_T=None, uncompared=None, looked_for=None, imitated=(), verdict="nothing")
    assert keys == list(diagnosis_summary(nothing))
    assert all(f"`{name}`" in section for name in ERRORS_BY_PLAUSIBILITY)
    rows = [line.split("|") for line in section.splitlines()
            if line.startswith(("| field |", "| instrument |"))]
    assert {(row[1].strip(), name.strip()) for row in rows for name in row[2].split(",")} == {
        (effect.kind, effect.name) for effect in catalogue()}


def test_a_dry_run_counts_and_writes_nothing(study, tmp_path, capsys):
    data, out = measured(tmp_path, 0.0), tmp_path / "out"
    arguments = ["diagnose", str(study), "--measurements", str(data), "-o", str(out),
                 "--getdp", "/nonexistent", "--dry-run"]
    assert main([*arguments, "--effects", "gain_x,block_missing,recoil_permeability",
                 "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    # a gain, 16 blocks, and a permeability whose signature is the field of another magnet
    assert (found["signatures"], found["fields"]) == (1 + 16 + 1, 1)
    assert found["each_round"]["parameters"] == 48
    assert found["each_round"]["readings"] == 600
    assert 0 < found["seconds"][0] < found["seconds"][1]
    assert main([*arguments, "--effects", "gain_x"]) == 0
    said = capsys.readouterr()
    assert "compares 1 hypothesis, for which it solves 0 more fields" in said.err
    assert "parameters" in said.out
    assert not out.exists()


def test_a_time_limit_says_what_there_was_time_for(study, tmp_path, capsys):
    """The first inference is always finished; after it there is no time for any effect."""
    data, out = measured(tmp_path, SAG_M), tmp_path / "out"
    arguments = ["diagnose", str(study), "--measurements", str(data), "-o", str(out),
                 "--effects", CHOICE]
    assert main([*arguments, "--time-limit", "1e-3"]) == 0
    said = capsys.readouterr()
    assert "The time limit cut the search after 1 round" in said.err
    assert "hypotheses not compared" in said.err
    assert "Nothing is missing" not in said.err
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["cut"] == {"uncompared": 5 + 16}
    assert (found["effects"], found["rounds"]) == ([], 1)
    assert found["scores"]["after"][0]["chi2_per_reading"] > 1.5
    assert "cut the search" in (out / "diagnosis.html").read_text()
    assert (out / "study.diagnosed.toml").read_text() == STUDY
    assert main([*arguments, "--time-limit", "3600"]) == 0  # negative control: time enough
    assert json.loads((out / "diagnosis.json").read_text())["cut"] is None


@pytest.mark.parametrize("limit", ["nan", "-1", "0", "inf", "soon"])
@pytest.mark.parametrize("verb", ["diagnose", "infer"])
def test_no_limit_is_refused(study, tmp_path, capsys, verb, limit):
    with pytest.raises(SystemExit) as stopped:
        main([verb, str(study), "--measurements", "map.csv", "-o", str(tmp_path / "out"),
              f"--time-limit={limit}"])
    assert stopped.value.code == 2
    assert "--time-limit" in capsys.readouterr().err
