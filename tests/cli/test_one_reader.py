"""Options of the format go with a map through all verbs, and lose nothing of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from halbach_fe.cli import main
from halbach_fe.measurement.field_map import field_map, write_map
from tests.cli.test_cli import IN_VACUUM

ANGLE = np.linspace(0, 2 * np.pi, 12, endpoint=False)
POINTS = np.column_stack([0.03 * np.cos(ANGLE), 0.03 * np.sin(ANGLE), 0 * ANGLE])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A study without permeability, and the map of a uniform field.

    A column has ten times the study's noise.
    """
    folder = tmp_path_factory.mktemp("files")
    (folder / "study.toml").write_text(IN_VACUUM)
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


def test_a_map_that_says_its_units_needs_no_option(files, tmp_path, capsys):
    """It is read as import-map reads it, and that is said. Controls: without units it is refused,
    and so is a map of our own with a fault.
    """
    study, data = files
    lines = [line for line in data.read_text().splitlines() if not line.startswith("#")]
    rows = np.array([line.split(",")[:6] for line in lines[1:]], float)
    def write(name, header, table):
        np.savetxt(tmp_path / name, table, delimiter=",", header=header, comments="", fmt="%.12g")
        return str(tmp_path / name)

    mm = write("mm.csv", "x[mm],y[mm],z[mm],Bx[mT],By[mT],Bz[mT]", 1e3 * rows)
    own = write("own.csv", "x_m,y_m,z_m,Bx_T,By_T,Bz_T", rows)
    for path, out in ((mm, "mm"), (own, "own")):
        assert main(["infer", str(study), "--measurements", path, "-o", str(tmp_path / out)]) == 0
        said = capsys.readouterr().err
        assert ("positions in mm and B in mT" in said) == (out == "mm")
    for one, other in zip(posterior(tmp_path / "mm"), posterior(tmp_path / "own"), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    bare = write("bare.csv", "x,y,z,Bx,By,Bz", rows)
    assert main(["infer", str(study), "--measurements", bare, "-o", str(tmp_path / "no")]) == 4
    assert "import-map" in capsys.readouterr().err
    (tmp_path / "own.csv").write_text((tmp_path / "own.csv").read_text() + "0.01,0,0,?,0,0\n")
    assert main(["infer", str(study), "--measurements", own, "-o", str(tmp_path / "no")]) == 4
    assert "?" in capsys.readouterr().err


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
