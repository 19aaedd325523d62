"""Options of the format go with a map through all verbs, and lose nothing of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from halbach_fe.cli import main
from halbach_fe.measurement.field_map import field_map, write_map
from tests.cli.test_cli import STUDY

ANGLE = np.linspace(0, 2 * np.pi, 12, endpoint=False)
POINTS = np.column_stack([0.03 * np.cos(ANGLE), 0.03 * np.sin(ANGLE), 0 * ANGLE])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A study, and the map of a uniform field with ten times the study's noise in a column."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "study.toml").write_text(STUDY)
    field = np.column_stack([0 * ANGLE + 0.55, 0 * ANGLE, 0 * ANGLE])
    field[:, :2] += 1e-3 * np.random.default_rng(1).standard_normal((12, 2))
    data = field_map(POINTS, field, sigma_T=np.full((12, 3), 1e-3))
    write_map(data.assign(time_s=("point", np.arange(12.0))), folder / "map.csv")
    return folder / "study.toml", folder / "map.csv"


def posterior(out):
    with xr.open_dataset(out / "posterior.h5", engine="h5netcdf") as data:
        return data["posterior_mean"].values, data["posterior_sd"].values


def test_import_options_keep_the_noise_of_the_map(files, tmp_path):
    """With --origin-m the posterior was six times narrower, and its answer Yes in place of No."""
    study, data = files
    found = {}
    for name, options in {"plain": [], "origin": ["--origin-m=0,0,0"],
                          "encoding": ["--encoding", "utf-8"]}.items():
        out = tmp_path / name
        assert main(["infer", str(study), "--measurements", str(data), *options,
                     "-o", str(out)]) == 0
        found[name] = posterior(out)
    for name in ("origin", "encoding"):
        for one, other in zip(found[name], found["plain"], strict=True):
            np.testing.assert_array_equal(one, other)
    silent = tmp_path / "silent.csv"  # the control: without the column the study's noise holds
    silent.write_text("".join(",".join(line.split(",")[:6]) + "\n"
                              for line in data.read_text().splitlines()))
    assert main(["infer", str(study), "--measurements", str(silent),
                 "-o", str(tmp_path / "silent")]) == 0
    assert (posterior(tmp_path / "silent")[1] < 0.9 * found["plain"][1]).any()


@pytest.mark.parametrize("verb", ["check", "register", "infer", "diagnose", "homogeneity", "shim"])
def test_every_verb_that_reads_maps_takes_the_options(files, tmp_path, capsys, verb):
    """They read the same file: a unit that it contradicts is refused by all of them."""
    study, data = files
    words = [verb, str(data)] if verb == "check" else [
        verb, str(study), "--measurements", str(data)]
    assert main([*words, "--length-unit", "mm", "-o", str(tmp_path / "x")]) == 4
    assert "m in the file and --length-unit mm" in " ".join(capsys.readouterr().err.split())


def test_advice_repeats_the_options(files, tmp_path, capsys):
    """A command that reads the same map elsewhere would find another magnet."""
    study, data = files
    main(["infer", str(study), "--measurements", str(data), "--origin-m=0.0,0.001,0.0",
          "-o", str(tmp_path / "out")])
    said = capsys.readouterr().err
    for line in said.splitlines():
        if "--measurements" in line:
            assert "--origin-m=0.0,0.001,0.0" in line
    assert "--measurements" in said
    assert not (json.loads((tmp_path / "out" / "run.json").read_text())["named"]).get("MAP")
