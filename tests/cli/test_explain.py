"""From a map to the magnet by one command, of a magnet in magpylib."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.cli.verbs import VERBS
from halbach_fe.core.errors import MeasurementError, OutputError
from halbach_fe.report.answer import PAGE_RECORD, Answer, PageRecord, write_record
from tests.diagnosis.campaign import CIRCLES, NOISE_T, STUDY, drawn, field
from tests.support.brought_maps import Brought, bring, judged
from tests.support.cuboids import DOCUMENT


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(tomlkit.dumps(DOCUMENT | {"inference": {"held_out": {"every": 5}}}))
    return path


def said(folder):
    return PageRecord.model_validate_json((folder / PAGE_RECORD).read_bytes()).answer


def test_a_map_that_the_update_explains_needs_nothing_else(study, generator, tmp_path, capsys):
    """It is in mm, which an option says, as of import-map."""
    points = CIRCLES[np.linalg.norm(CIRCLES[:, :2], axis=1) < 0.06]
    readings = field(STUDY, drawn(STUDY, generator), points)
    readings += NOISE_T * generator.standard_normal(readings.shape)
    np.savetxt(tmp_path / "mm.csv", np.hstack([1e3 * points, readings]), delimiter=",",
               header="x,y,z,Bx,By,Bz", comments="")
    out = tmp_path / "out"
    assert main(["explain", str(study), str(tmp_path / "mm.csv"), "--length-unit", "mm",
                 "--columns", "x,y,z,Bx[T],By[T],Bz[T]", "-o", str(out)]) == 0
    assert {path.name for path in out.iterdir() if path.is_dir()} == {
        "check", "inferred", ".halbach-fe-report"}
    assert (out / "explanation.html").exists()
    assert said(out / "inferred").sound
    printed = capsys.readouterr()
    assert "halbach-fe infer" in printed.err
    assert "halbach-fe register" not in printed.err


def test_a_displaced_map_of_a_magnet_with_a_weak_block(tmp_path):
    """README's recipe, as of the six maps of benchmarks/recipe.py, for a small one.

    Negative control: a place 1 mm from where the map was.
    """
    case = Brought("", "--blocks-per-ring 8 --cube-m 0.012 --radius-m 0.04 --dsv-m 0.03",
                   (0.015, 0.015), (1e3, 1e3), shift_m=(0.0, 0.0, 0.001), seed=7, steps=5)
    bring(case, tmp_path)
    found = {name: value for name, (value, _) in judged(case, tmp_path).items()}
    assert said(tmp_path / "out" / "updated").sound
    assert abs(found["weak_block"]) < 1.96
    assert found["place"] < 2.39  # the largest of three numbers, in 95 % of cases
    assert found["coverage"] > 0.85
    assert not found["named"]
    assert "by the readings alone" in (tmp_path / "out/updated/report.html").read_text()
    elsewhere = replace(case, shift_m=(0.0, 0.0, 0.0))
    assert judged(elsewhere, tmp_path)["place"][0] > 10


def test_a_map_that_is_not_there_is_said_once(study, tmp_path, capsys):
    assert main(["explain", str(study), str(tmp_path / "no.csv"), "-o", str(tmp_path / "out")]) == 4
    printed = capsys.readouterr().err
    assert printed.count("no.csv must be a readable file") == 1
    assert "cannot be checked" not in printed


def test_a_folder_of_another_command_is_refused_before_work(study, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["solve", str(study), "-o", str(out)]) == 0
    before = sorted(out.iterdir())
    assert main(["explain", str(study), str(out / "nominal_map.csv"),
                 "-o", str(out)]) == OutputError.exit_code
    assert "holds results of another command" in capsys.readouterr().err
    assert sorted(out.iterdir()) == before


CHECK = Answer("?", "Passed.", "Yes.", "")
GOOD, BAD = (replace(CHECK, sound=sound) for sound in (True, False))
REGISTERED = replace(GOOD, command="halbach-fe infer DIR/study.registered.toml -o DIR")
NEAR = replace(BAD, command="halbach-fe diagnose STUDY --measurements MAP -o DIR")
UNKNOWN = replace(BAD, changes_study=False)


@pytest.mark.parametrize("used", ["corrected_map.csv", "oriented_map.csv", "MAP"])
def test_the_map_that_check_says_to_use_is_used(study, tmp_path, monkeypatch, used):
    """Both are written: what changed during the scan may be in the map in the right axes."""
    maps = []

    def answered(arguments):
        maps.append(getattr(arguments, "measurements", None))
        arguments.output.mkdir(parents=True)
        answer = replace(GOOD, command=f"halbach-fe infer STUDY --measurements DIR/{used} -o DIR")
        write_record(arguments.output / "page.html", "", answer, (), (), {}, None)
        for name in ("corrected_map.csv", "oriented_map.csv") if used != "MAP" else ():
            (arguments.output / name).write_text("x")
        return 0

    for verb in ("check", "infer"):
        monkeypatch.setitem(VERBS, verb, replace(VERBS[verb], run=answered))
    monkeypatch.setitem(VERBS, "report", replace(VERBS["report"], run=lambda arguments: 0))
    (tmp_path / "map.csv").write_text("x")
    assert main(["explain", str(study), str(tmp_path / "map.csv"), "-o",
                 str(tmp_path / "out")]) == 0
    updated = maps[1] if isinstance(maps[1], list) else [maps[1]]
    assert [str(one).endswith("map.csv" if used == "MAP" else used) for one in updated] == [True]


@pytest.mark.parametrize(("answers", "steps", "joined"), [
    ({"inferred": GOOD}, "check inferred", "check inferred"),
    ({"inferred": BAD, "registered": REGISTERED, "updated": GOOD},
     "check inferred registered updated", "check inferred registered updated"),
    ({"inferred": BAD, "registered": NEAR, "diagnosed": GOOD, "explained": GOOD},
     "check inferred registered diagnosed explained", "check inferred diagnosed explained"),
    ({"inferred": BAD, "registered": REGISTERED, "updated": BAD, "diagnosed": GOOD,
      "explained": BAD}, "check inferred registered updated diagnosed explained",
     "check inferred registered updated diagnosed explained"),
    ({"inferred": BAD, "registered": NEAR, "diagnosed": UNKNOWN},
     "check inferred registered diagnosed", "check inferred diagnosed"),
    ({"inferred": BAD, "registered": MeasurementError("No pose."), "diagnosed": UNKNOWN},
     "check inferred registered diagnosed", "check inferred diagnosed")])
def test_each_command_runs_as_far_as_it_is_needed(
        study, tmp_path, monkeypatch, answers, steps, joined):
    """With answers that are given, so that every way is taken."""
    ran, pages = [], []

    def answered(arguments):
        ran.append((arguments.output.name, str(getattr(arguments, "study", ""))))
        arguments.output.mkdir(parents=True)
        answer = {"check": CHECK, **answers}[arguments.output.name]
        if isinstance(answer, MeasurementError):
            raise answer
        write_record(arguments.output / "page.html", "", answer, (), (), {}, None)
        return 0

    for verb in ("check", "infer", "register", "diagnose"):
        monkeypatch.setitem(VERBS, verb, replace(VERBS[verb], run=answered))
    monkeypatch.setitem(VERBS, "report", replace(VERBS["report"], run=lambda arguments: (
        pages.extend(folder.name for folder in arguments.folders) or 0)))
    (tmp_path / "map.csv").write_text("x")
    assert main(["explain", str(study), str(tmp_path / "map.csv"), "-o",
                 str(tmp_path / "out")]) == 0
    assert " ".join(folder for folder, _ in ran) == steps
    assert " ".join(pages) == joined
    used = dict(ran)
    if "updated" in used:
        assert used["updated"].endswith("registered/study.registered.toml")
    if "explained" in used:
        assert used["explained"].endswith("diagnosed/study.diagnosed.toml")


def test_the_blocks_that_fit_the_diagnosed_study_are_used(study, tmp_path, monkeypatch):
    """The map shows one more ring than the study, whose blocks were measured."""
    used = {}

    def answered(arguments):
        name = arguments.output.name
        used[name] = str(getattr(arguments, "blocks", ""))
        arguments.output.mkdir(parents=True)
        answer = {"check": CHECK, "registered": NEAR, "diagnosed": GOOD}.get(name, BAD)
        write_record(arguments.output / "page.html", "", answer, (), (), {}, None)
        if name == "diagnosed":
            (arguments.output / "blocks.csv").write_text("x")
        return 0

    for verb in ("check", "infer", "register", "diagnose"):
        monkeypatch.setitem(VERBS, verb, replace(VERBS[verb], run=answered))
    monkeypatch.setitem(VERBS, "report", replace(VERBS["report"], run=lambda arguments: 0))
    for name in ("map.csv", "own.csv"):
        (tmp_path / name).write_text("x")
    out = tmp_path / "out"
    assert main(["explain", str(study), str(tmp_path / "map.csv"), "--blocks",
                 str(tmp_path / "own.csv"), "-o", str(out)]) == 0
    assert used["inferred"] == used["diagnosed"] == str(tmp_path / "own.csv")
    assert used["explained"] == str(out / "diagnosed" / "blocks.csv")
