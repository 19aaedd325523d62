"""``--dry-run``: an estimate, and nothing else."""

from __future__ import annotations

import json

import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.response import resource_estimate
from tests.cli.test_cli import STUDY
from tests.conftest import circle


@pytest.fixture
def commands(tmp_path):
    """The verbs that know it, up to the option, without a GetDP to start."""
    study, measured = tmp_path / "study.toml", tmp_path / "map.csv"
    study.write_text(STUDY)
    write_map(field_map(circle(0.03, 10), np.tile([0.55, 0.0, np.nan], (10, 1))), measured)
    usual = [str(study), "-o", str(tmp_path / "out"), "--getdp", "/nonexistent"]
    return {"solve": ["solve", *usual], "verify": ["verify", *usual],
            "infer": ["infer", *usual, "--measurements", str(measured)]}


@pytest.mark.parametrize("verb", ["solve", "infer", "verify"])
def test_it_starts_and_writes_nothing(commands, verb, tmp_path, capsys):
    before = set(tmp_path.rglob("*"))
    assert main([*commands[verb], "--dry-run", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    folder = commands[verb].index("-o")
    bare = commands[verb][:folder] + commands[verb][folder + 2:]
    assert main([*bare, "--dry-run", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert (again["solves"], again["disk_GiB"]) == (shown["solves"], shown["disk_GiB"])
    with pytest.raises(SystemExit):
        main(bare)
    assert "-o/--output" in capsys.readouterr().err
    assert set(tmp_path.rglob("*")) == before
    assert shown["route"] == "cross_section"
    assert (shown["blocks"], shown["parameters"]) == (8, 16 if verb == "infer" else 0)
    assert shown["readings"] == (30 if verb == "verify" else 20)
    assert shown["processes"] == sum(one["processes"] for one in shown["problems"])
    for name in ("memory_GiB", "own_memory_GiB", "disk_GiB", "seconds"):
        assert shown[name] > 0
    for one in shown["problems"]:
        assert one["unknowns"] > one["elements"] > 0
    assert main(commands[verb]) == 6, "without it GetDP is needed"


def test_the_table(commands, capsys):
    assert main([*commands["solve"], "--dry-run"]) == 0
    shown = capsys.readouterr()
    assert "error bars, coarser mesh" in shown.out
    assert "within a factor of about 3" in shown.out
    assert shown.err == ""


@pytest.mark.parametrize(("available", "hints"), [
    (1e-3, ["0.001 GiB left"]), (0.36, ["--jobs 1"]), (64.0, []), (None, [])])
def test_too_little_memory(commands, capsys, monkeypatch, available, hints):
    """It is a warning; what would help is said, but only if it does."""
    monkeypatch.setattr(resource_estimate, "available_memory", lambda: available)
    assert main([*commands["solve"], "--jobs", "2", "--dry-run"]) == 0
    said = capsys.readouterr().err
    assert said.startswith("warning: This needs about") == bool(hints)
    assert all(hint in said for hint in hints)
    assert ("--jobs 1" in said) == ("--jobs 1" in hints)


def test_the_machine_says_what_it_has():
    assert 0 < resource_estimate.available_memory() < 1e6


def with_getdp(arguments, getdp):
    """The arguments with a GetDP that there is."""
    place = arguments.index("--getdp") + 1
    return [*arguments[:place], str(getdp.executable), *arguments[place + 1:]]


@pytest.mark.parametrize(("old", "new"), [
    ("block_size_m = 0.02", "block_size_m = 20"), ("radius_m = 0.03", "radius_m = 0.07"),
    ("radius_m = 0.03", "radius_m = 9.0"), ("inner_radius_m = 0.05", "inner_radius_m = 0.1")])
@pytest.mark.parametrize("verb", ["solve", "verify"])
def test_bad_studies_are_refused_as_ever(commands, verb, tmp_path, capsys, getdp, old, new):
    (tmp_path / "study.toml").write_text(STUDY.replace(old, new, 1))
    codes, said = [], []
    for arguments in ([*commands[verb], "--dry-run"], with_getdp(commands[verb], getdp)):
        codes.append(main(arguments))
        said.append(capsys.readouterr().err.splitlines()[-1])
    assert codes[0] == codes[1] != 0
    assert said[0] == said[1]


def test_a_bad_map_is_refused_as_ever(commands, tmp_path, capsys, getdp):
    for radius in (0.07, 9.0):
        write_map(field_map(circle(radius, 10), np.ones((10, 3))), tmp_path / "map.csv")
        codes, said = [], []
        for arguments in ([*commands["infer"], "--dry-run"], with_getdp(commands["infer"], getdp)):
            codes.append(main(arguments))
            sentence = capsys.readouterr().err.splitlines()[-1]
            said.append(sentence.partition("the first at")[0])  # of places in another order
        assert codes[0] == codes[1] != 0
        assert said[0] == said[1]
