"""Files of the command line: each is read once, and results of two studies are never mixed."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import subprocess
import sys
import threading
from fnmatch import fnmatch

import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.cli.verbs import VERBS
from halbach_fe.core.files import InputFile
from halbach_fe.core.result_folder import RECORD, WRITES
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import write_blocks
from halbach_fe.measurement.field_map import field_map, read_map, write_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.reader import read_study
from tests.cli.test_all_keys import BASE, measured_blocks
from tests.cli.test_cli import refused
from tests.conftest import changed, circle
from tests.support.pages import page

STUDY = """
name = "vacuum"
dimension = 2
[array]
blocks_per_ring = 8
inner_radius_m = 0.05
outer_radius_m = 0.09
remanence_T = 1.0
recoil_permeability = 1.0
[array.block]
shape = "sector"
[mesh]
block_size_m = 0.02
[observation]
quantity = "flux_density"
components = ["x", "y"]
[observation.positions]
kind = "circles"
radius_m = 0.03
angles = 10
[[noise.regions]]
name = "bore"
sigma_T = 1e-2
"""


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


@pytest.fixture
def measured(tmp_path):
    path = tmp_path / "map.csv"
    write_map(field_map(circle(0.03, 10), np.tile([0.55, 0.0, np.nan], (10, 1))), path)
    return path


def test_a_folder_is_of_one_study(study, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["solve", str(study), "-o", str(out)]) == 0
    assert (out / "multipoles.csv").exists()
    # the study no longer has circles: its multipoles would be those of another study
    study.write_text(STUDY.replace(
        'kind = "circles"\nradius_m = 0.03\nangles = 10',
        'kind = "line"\nstart_m = [0, 0, 0]\nend_m = [0.01, 0, 0]\ncount = 3'))
    assert main(["solve", str(study), "-o", str(out)]) == 0
    assert not (out / "multipoles.csv").exists()
    assert (out / "field_map.csv").exists()
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    capsys.readouterr()
    study.write_text(STUDY.replace('"vacuum"', '"another"'))
    assert main(["solve", str(study), "-o", str(out)]) == 8
    assert "results of `halbach-fe solve` of study vacuum" in capsys.readouterr().err
    study.write_text(STUDY)
    assert main(["tolerance", str(study), "-o", str(out)]) == 8
    with (out / RECORD).open() as lock:  # as another run has it
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert main(["solve", str(study), "-o", str(out)]) == 8
    said = capsys.readouterr().err
    assert "in use by another run" in said
    assert "GetDP" not in said
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_input_file_is_read_once(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"one\r\ntwo")
    file = InputFile(path)
    assert file.read_text("utf-8") == path.read_text("utf-8") == "one\ntwo"
    path.write_bytes(b"changed")
    assert file.read_bytes() == b"one\r\ntwo"
    assert file == path
    assert InputFile(path).read_bytes() == b"changed"


def test_pipes(study, measured, tmp_path):
    """Study and map come through pipes, and the page has the hashes of what came."""
    named = {"study": (tmp_path / "study.pipe", study.read_bytes()),
             "map": (tmp_path / "map.pipe", measured.read_bytes())}
    for path, content in named.values():
        os.mkfifo(path)
        threading.Thread(target=path.write_bytes, args=(content,), daemon=True).start()
    out = tmp_path / "out"
    assert main(["infer", str(named["study"][0]), "--measurements", str(named["map"][0]), "-o",
                 str(out)]) == 0
    shown = page(out / "report.html")
    for _, content in named.values():
        assert hashlib.sha256(content).hexdigest() in shown


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".vtu"])
def test_provenance_of_what_was_read(study, measured, tmp_path, monkeypatch, suffix):
    """The map and the study change during the run."""
    path = measured.with_suffix(suffix)
    write_map(field_map(circle(0.03, 10), np.tile([0.55, 0.0, 0.0], (10, 1))), path)
    read = {one: hashlib.sha256(one.read_bytes()).hexdigest() for one in (study, path)}
    from halbach_fe.cli import common

    opened = common.session

    def changing(*arguments):
        for one in read:
            one.write_text("changed")
        return opened(*arguments)

    monkeypatch.setattr(common, "session", changing)
    out = tmp_path / "out"
    assert main(["infer", str(study), "--measurements", str(path), "-o", str(out)]) == 0
    shown = page(out / "report.html")
    assert all(digest in shown for digest in read.values())
    assert hashlib.sha256(b"changed").hexdigest() not in shown


def provenance_of(folder):
    return json.loads((folder / "page.json").read_text())["provenance"]


def test_pages_name_the_maps_that_they_are_of(study, measured, tmp_path):
    """Each with its SHA-256, also behind a posterior; a copy of one does not know its map."""
    def said(path):
        return f"{path.name}, SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()}"

    with_map = [str(study), "--measurements", str(measured)]
    for verb in ("infer", "shim", "diagnose"):
        assert main([verb, *with_map, "-o", str(tmp_path / verb), "--json"]) == 0
        found = provenance_of(tmp_path / verb)
        assert (found["study file"], found["measurements"]) == (said(study), said(measured))
    shown = (tmp_path / "infer" / "report.html").read_text()
    assert f'<p class="small">study file {study.name}</p>' in shown  # it has no description
    posterior = tmp_path / "infer" / "posterior.h5"
    copied = tmp_path / "copy.h5"
    copied.write_bytes(posterior.read_bytes())
    for file, known in ((posterior, said(measured)), (copied, None)):
        assert main(["multipoles", str(study), "--posterior", str(file), "-o",
                     str(tmp_path / "multipoles"), "--json"]) == 0
        found = provenance_of(tmp_path / "multipoles")
        assert found["posterior"] == said(file)
        assert found.get("read for the posterior") == known


def test_stale_results_go_even_if_nobody_reads_what_is_printed(tmp_path, monkeypatch):
    """A closed pipe ends a run after its files were written."""
    (tmp_path / "study.toml").write_text(STUDY)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "halbach_fe", "solve", "study.toml", "-o", "out"]
    monkeypatch.chdir(tmp_path)
    assert main(command[3:]) == 0
    record = json.loads((out / "run.json").read_text())
    (out / "old.csv").write_text("of an earlier run")
    record["files"]["old.csv"] = hashlib.sha256(b"of an earlier run").hexdigest()
    (out / "run.json").write_text(json.dumps(record))
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run([*command, "--json"], cwd=tmp_path, stdout=writing, check=False,
                              stderr=subprocess.PIPE)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (141, b"")
    assert not (out / "old.csv").exists()
    assert "old.csv" not in json.loads((out / "run.json").read_text())["files"]


def of(paths, *words):
    """A command line; the words study, map, table, posterior and folder stand for their files."""
    return [str(paths.get(word, word)) for word in words]


TARGET = ("--reference-radius-m", "0.03")
VERBS_WITH_FOLDERS = {
    "solve": ("study",), "infer": ("study", "--measurements", "map"),
    "diagnose": ("study", "--measurements", "map", "--effects", "block_missing"),
    "verify": ("study",), "multipoles": ("study", *TARGET), "homogeneity": ("study",),
    "forces": ("study",), "cad": ("framed",), "design": ("rings",), "plan": ("study",),
    "prior": ("study", "table"),
    "shim": ("study", "--measurements", "map", *TARGET, "--swaps", "1"),
    "shim-tray": ("tray", "--posterior", "posterior"), "sort": ("study", "table", *TARGET),
    "tolerance": ("study", *TARGET, "--draws", "100"), "demagnetization": ("hot", "--across", "2"),
    "field": ("study", "--from-m", "0", "0", "-0.1", "--to-m", "0", "0", "0.1"),
    "simulate-measurement": ("study",), "check": ("volume",),
    "register": ("study", "--measurements", "map"), "report": ("folder",)}
"""Options of every command that writes a folder."""

LONG = ("verify", "design", "shim-tray", "register")
"""Those that are not run to their end, as they take long; their names are in the same table."""


@pytest.fixture(scope="module")
def paths(tmp_path_factory, getdp):
    """A study with a map, blocks, a posterior, and a folder of results."""
    folder = tmp_path_factory.mktemp("campaign")
    found = {"study": folder / "study.toml", "hot": folder / "study.toml",
             "framed": folder / "framed.toml"}
    study = changed(BASE, plan__points=3)
    found["study"].write_text(tomlkit.dumps(study))
    found["framed"].write_text(tomlkit.dumps(study | {"holder": {}}))
    magnet = build_magnet(read_study(found["study"]))
    points = points_from(magnet.study.observation.positions)
    write_map(field_map(points, field_of(magnet.blocks, points)), folder / "map.csv")
    write_blocks(measured_blocks(magnet), folder / "blocks.csv")
    inferred = folder / "inferred"
    assert main(of(found, "infer", "study", "--measurements", folder / "map.csv", "-o", inferred,
                   "--json")) == 0
    grid = np.stack(np.meshgrid(*3 * [np.linspace(-0.02, 0.02, 4)]), axis=-1).reshape(-1, 3)
    write_map(field_map(grid, field_of(magnet.blocks, grid)), folder / "volume.csv")
    return found | {"map": folder / "map.csv", "table": folder / "blocks.csv",
                    "volume": folder / "volume.csv",
                    "posterior": inferred / "posterior.h5", "folder": inferred}


def test_every_verb_is_in_the_table():
    single_files = {"new", "import-map", "import-blocks", "export"}
    nothing = {"cache", "doctor", "schema", "completion"}  # which write no file of a user's choice
    by_others = {"explain"}  # runs other verbs, in folders of their own
    assert set(VERBS) == {*VERBS_WITH_FOLDERS, *single_files, *nothing, *by_others}
    assert set(WRITES) == set(VERBS_WITH_FOLDERS) > set(LONG)


@pytest.mark.parametrize("verb", sorted(VERBS_WITH_FOLDERS.keys() - set(LONG)))
def test_what_each_verb_writes_is_refused_unless_it_is_its_own(paths, tmp_path, capsys, verb):
    """A table of names that misses one would let a command begin, and stop at its end."""
    command = of(paths, verb, *VERBS_WITH_FOLDERS[verb], "--json")
    out = tmp_path / "out"
    assert main([*command, "-o", str(out)]) == 0, capsys.readouterr().err
    names = set(json.loads((out / RECORD).read_text())["files"])
    known = (*WRITES[verb], "page.json")
    assert {name for name in names if not any(fnmatch(name, own) for own in known)} == set()
    assert main([*command, "-o", str(out)]) == 0  # its own results are replaced
    foreign = tmp_path / "foreign"
    for name in names:
        (foreign / name).parent.mkdir(parents=True, exist_ok=True)
        (foreign / name).write_text(f"my own {name}")
    before = {path: path.read_bytes() for path in foreign.rglob("*") if path.is_file()}
    capsys.readouterr()
    code, said = refused([*command, "-o", foreign], capsys)
    assert code == 8
    assert sum(name in said for name in names) >= min(len(names), 5)
    assert {path: path.read_bytes() for path in foreign.rglob("*") if path.is_file()} == before


def test_single_files_of_commands(paths, tmp_path, capsys):
    """A file of the user's is refused by name, a link as well; an own one is replaced."""
    target = tmp_path / "precious.csv"
    page = tmp_path / "precious.html"
    for path, command in (
            (target, of(paths, "import-map", "map", "-o", target)),
            (target, of(paths, "export", "map", "--format", "csv", "-o", target)),
            (target, of(paths, "export", "study", "--format", "blocks", "-o", target)),
            (page, of(paths, "report", "folder", "-o", page)),
            (target, of(paths, "new", target))):
        path.write_text("precious")
        code, said = refused(command, capsys)
        assert code == 8
        assert path.name in said
        assert path.read_text() == "precious"
        path.unlink()
        path.symlink_to(tmp_path / "nowhere")
        assert refused(command, capsys)[0] == 8
        path.unlink()
        assert main(command) == 0
        if command[0] != "new":
            assert main(command) == 0
        path.unlink()
        capsys.readouterr()
    code, said = refused(of(paths, "import-map", "map", "-o", "posterior"), capsys)
    assert code == 8
    assert "a result of `halbach-fe infer`" in said


def test_a_check_of_one_map_and_of_several(paths, tmp_path, capsys):
    """Neither removes the other's files. Control: a check of the same kind replaces its own."""
    out, other = tmp_path / "out", tmp_path / "other.csv"
    write_map(read_map(paths["volume"]).isel(point=slice(32, None)), other)
    for _ in range(2):
        assert main(["check", str(paths["volume"]), "-o", str(out)]) == 0
    files = {path: path.read_bytes() for path in out.iterdir()}
    capsys.readouterr()
    assert main(["check", str(paths["volume"]), str(other), "-o", str(out)])
    assert "has check.json, of a check of a single map, which" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.iterdir()} == files
    (out / "check.json").rename(out / "joined.json")
    assert main(["check", str(paths["volume"]), "-o", str(out)])
    assert "has joined.json, of a check of several maps" in capsys.readouterr().err
