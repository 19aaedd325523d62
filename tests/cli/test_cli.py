"""The command line as a user meets it: results, messages, exit codes, interruptions."""

from __future__ import annotations

import compileall
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from halbach_fe.cli import main
from halbach_fe.cli.common import print_table
from halbach_fe.cli.verbs import parser
from halbach_fe.core.errors import EXIT_CODES
from halbach_fe.design.demagnetization import ACROSS
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map, points_of, read_map, write_map
from halbach_fe.solver.getdp import blas_of
from halbach_fe.solver.getdp_cache import LIMIT_VARIABLE
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.study.reader import read_study
from tests.conftest import ROOT, circle
from tests.support.interruption import unreadable

STUDY = """
name = "cli"
dimension = 2
[array]
blocks_per_ring = 8
inner_radius_m = 0.05
outer_radius_m = 0.09
remanence_T = 1.0
recoil_permeability = 1.05
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
sigma_T = 1e-4
"""
IN_VACUUM = STUDY.replace("recoil_permeability = 1.05", "recoil_permeability = 1.0")
"""For what needs no finite elements."""


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


@pytest.fixture
def measured(tmp_path):
    path = tmp_path / "map.csv"
    points = circle(0.03, 10)
    write_map(field_map(points, np.tile([0.55, 0.0, np.nan], (10, 1))), path)
    return path


@pytest.mark.parametrize("instrument", [
    "translation_m = [0.002, 0.0, 0.0]",
    "sensor_position_m = [[0.002, 0.0, 0.0], [0.002, 0.0, 0.0], [0.0, 0.0, 0.0]]"])
def test_solve_reads_where_the_probe_is(study, tmp_path, instrument):
    """The map is of the study's positions, the readings are those of a probe that is 2 mm off."""
    displaced = circle(0.03, 10, start=0.0) + np.array([0.002, 0.0, 0.0])
    moved = tmp_path / "moved.toml"
    moved.write_text(STUDY.replace(
        'kind = "circles"\nradius_m = 0.03\nangles = 10',
        f'kind = "points"\npoints_m = {displaced.tolist()}'))
    study.write_text(STUDY + f"\n[instrument]\n{instrument}\n")
    found = {}
    for name, path in (("off", study), ("moved", moved)):
        assert main(["solve", str(path), "-o", str(tmp_path / name), "--json"]) == 0
        rows = np.genfromtxt(tmp_path / name / "readings.csv", delimiter=",", names=True,
                             dtype=None, encoding=None)
        found[name] = rows["value_T"], rows["error_T"]
    (values, errors), (expected, bars) = found["off"], found["moved"]
    np.testing.assert_allclose(values, expected, atol=1e-12)
    np.testing.assert_allclose(errors, bars, atol=1e-9)
    nominal = read_map(tmp_path / "off" / "field_map.csv")
    np.testing.assert_allclose(points_of(nominal), circle(0.03, 10, start=0.0), atol=1e-12)
    assert np.abs(nominal["B_T"].values[:, :2].ravel() - values).max() > 1e-6


def test_solve_writes_maps(study, tmp_path, capsys, getdp):
    out = tmp_path / "out"
    assert main(["solve", str(study), "-o", str(out), "--json"]) == 0
    shown = capsys.readouterr()
    summary = json.loads(shown.out)
    assert shown.err == ""
    names = {path.name for path in out.iterdir()}
    assert {"field_map.h5", "field_map.csv", "field_map.vtu", "readings.csv"} <= names
    data = read_map(out / "field_map.h5")
    np.testing.assert_array_equal(data["B_T"], read_map(out / "field_map.csv")["B_T"])
    assert data.attrs["study"] == "cli"
    assert summary["points"] == 10
    assert summary["max_B_T"] == pytest.approx(0.55, abs=0.05)
    assert not [name for name in names if name.startswith(".")]
    # the run folder can be run by hand
    by_hand = [getdp.executable, "magnetostatics_2d.pro", "-msh", "mesh.msh", "-solve",
               "Magnetostatics"]
    done = subprocess.run(by_hand, cwd=out / "getdp-real", capture_output=True, check=False)
    assert done.returncode == 0


def test_infer_writes_everything(study, measured, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["infer", str(study), "--measurements", str(measured), "-o", str(out)]
    assert main(arguments) == 0
    shown = capsys.readouterr()
    assert "after, rms" in " ".join(shown.out.split())
    assert "Report:" in shown.err
    assert {"posterior.h5", "prediction.csv", "summary.json", "report.html", "profile.png",
            "response.h5"} <= {path.name for path in out.iterdir()}
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["parameters"] == 16


def test_infer_with_a_second_map(study, measured, tmp_path, capsys):
    """Which is only predicted; its errors name its file."""
    study.write_text(IN_VACUUM)
    out, other = tmp_path / "out", tmp_path / "other.csv"
    write_map(field_map(circle(0.02, 6), np.tile([0.55, 0.0, np.nan], (6, 1))), other)
    arguments = ["infer", str(study), "--measurements", str(measured), "--held-out", str(other),
                 "-o", str(out)]
    assert main([*arguments, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["readings"], summary["held_out"]) == (32, 12)
    assert summary["scores"][1]["part"] == "held-out map"
    other.write_text(other.read_text().replace("0.55", "550", 1))
    code, sentence = refused(arguments, capsys)
    assert code == 4
    assert str(other) in sentence


@pytest.fixture
def table(study, tmp_path):
    """Three blocks of every slot, 1 % too weak, and different."""
    study.write_text(STUDY.replace("dimension = 2", "dimension = 2\nprior.common_mode_sd = 0.01"))
    blocks = build_magnet(read_study(study)).blocks
    volume = 0.05 * blocks[0].area
    rows = ["serial,type,mx_A_m2,my_A_m2,mz_A_m2,sigma_A_m2,volume_m3"]
    for number, block in enumerate(blocks * 3):
        angle = (block.slot - 1) * np.pi / 4  # M turns twice, the block's own axes once
        strength = volume / MU_0 * (0.98 + 0.005 * np.sin(number))
        rows.append(f"B{number},{block.slot},{strength * np.cos(angle)},"
                    f"{strength * (np.sin(angle) + 0.01 * np.cos(7 * number))},0,0.05,{volume}")
    path = tmp_path / "blocks.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_prior_of_measured_blocks(study, table, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["prior", str(study), str(table), "-o", str(out)]) == 0
    assert "along in %" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {
        "prior.h5", "prior.json", "prior.html", "prior_qq.png", "page.json", "run.json"}
    assert main(["prior", str(study), str(table), "-o", str(out), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary == json.loads((out / "prior.json").read_text())
    assert (summary["blocks"], len(summary["types"])) == (24, 8)
    # 2 % weaker, and what the lone block's self-demagnetization hides: 0.05 N, N up to 0.6
    assert -2.5 < summary["types"][0]["mean_percent_deg"][0] < 1.5


def test_infer_with_measured_blocks(study, table, measured, tmp_path, capsys):
    study.write_text(IN_VACUUM)
    out = tmp_path / "out"
    arguments = ["infer", str(study), "--measurements", str(measured), "-o", str(out), "--json"]
    assert main([*arguments, "--blocks", str(table)]) == 0
    assert json.loads(capsys.readouterr().out)["measured_blocks"] == 24
    assert "24 measured blocks" in (out / "report.html").read_text()
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["measured_blocks"] is None


@pytest.mark.parametrize(("edit", "said"), [
    (("B1,", "B0,"), "serial of block B0"), (("0.05,", "-0.05,"), "sigma_A_m2 of block B0"),
    (("B0,1,", "B0,9,"), "type of block B0"), (("B0,1,", "B0,2,"), "moment of block B0"),
    (("sigma_A_m2", "sigma"), "column 'sigma'"), (("volume_m3", "slot"), "slot in line 2"),
    (None, "readable file")])
def test_bad_tables(study, table, measured, tmp_path, capsys, edit, said):
    """Both verbs refuse them in one sentence before anything is made."""
    if edit:
        assert edit[0] in table.read_text()
        table.write_text(table.read_text().replace(*edit, 1))
    else:
        table.unlink()
    out = tmp_path / "out"
    for arguments in (["prior", study, table, "-o", out],
                      ["infer", study, "--measurements", measured, "-o", out, "--blocks", table]):
        code, sentence = refused(arguments, capsys)
        assert (code, out.exists()) == (4, False)
        assert said in sentence
        assert str(table) in sentence


def test_schema_is_that_of_the_model(capsys):
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == Study.model_json_schema()


def test_doctor(capsys):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert 0 < found["errors"]["reaction"] < found["errors"]["direct"]


def test_doctor_can_fail(monkeypatch, capsys):
    monkeypatch.setattr("halbach_fe.cli.verbs.TOLERANCE", {"reaction": 1e-9})
    assert main(["doctor"]) == 9
    assert "differs from the closed form" in capsys.readouterr().err


def test_doctor_names_a_slow_blas(getdp, tmp_path, monkeypatch, capsys):
    """Debian's reference BLAS is one in a folder `blas`."""
    own = blas_of(getdp)
    assert own is not None
    for name, warned in (("fast", False), ("blas", True)):
        (tmp_path / name).mkdir()
        shutil.copy(own, tmp_path / name / "libblas.so.3")
        monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path / name))
        assert main(["doctor"]) == 0
        assert ("reference BLAS" in capsys.readouterr().err) == warned
    assert blas_of(replace(getdp, executable=Path(__file__))) is None


def test_module_and_version_run():
    done = subprocess.run([sys.executable, "-m", "halbach_fe", "--version"], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 0
    assert done.stdout.strip()


def refused(arguments, capsys):
    code = main([str(argument) for argument in arguments])
    shown = capsys.readouterr()
    assert shown.err.startswith("error: ")
    assert len(shown.err.strip().splitlines()) == 1
    assert "Traceback" not in shown.err
    return code, shown.err


@pytest.mark.parametrize(("edit", "code", "said"), [
    (("inner_radius_m = 0.05", "inner_radius_m = 50"), 3, "millimetres"),
    (("inner_radius_m", "inner_radius"), 3, "Did you mean"),
    (("outer_radius_m = 0.09", "outer_radius_m = 0.04"), 3, "larger than inner_radius_m"),
    (("radius_m = 0.03", "radius_m = 0.07"), 3, "inside magnet or iron"),
    (("radius_m = 0.03", "radius_m = 5.0"), 5, "meshed region"),
])
def test_bad_studies(study, tmp_path, capsys, edit, code, said):
    study.write_text(STUDY.replace(*edit))
    out = tmp_path / "out"
    found, sentence = refused(["solve", study, "-o", out], capsys)
    assert found == code
    assert said in sentence
    assert not list(out.glob("field_map*"))


IRON = """
[iron_ring]
inner_radius_m = 0.1
outer_radius_m = 0.12
curve = { kind = "table", file = "iron.csv" }
"""
TABLE = "H_A_per_m,B_T\n0,0\n100,0.1\n160,0.25\n382,1.0\n758,1.3\n1837,1.5\n"


@pytest.mark.parametrize(("edit", "said"), [
    (("758,", "300,"), "H must rise"), ((",1.3", ",0.9"), "B must rise"),
    (("0,0\n100,0.1\n160,0.25\n382,1.0\n", ""), "not 2; give more"),
    ((",1.5", ",1500"), "mT or gauss"), ((",1.5", ",15000"), "mT or gauss"),
    (("1837,", "1.837,"), "H must rise"), ((",0.1\n", ",-0.1\n"), "is negative"),
    (("H_A_per_m,B_T", "B_T,H_A_per_m"), "exchanged"), (("382", "inf"), "must hold two numbers"),
    (("H_A_per_m", "H"), "its header must be H_A_per_m,B_T"), (("160", "many"), "line 4 must hold"),
    ((TABLE, ""), "it is empty"), ((TABLE, "Fr\xf6hlich"), "UTF-8"), (None, "No such file")])
def test_bad_iron(study, tmp_path, capsys, monkeypatch, edit, said):
    """Refused before anything is made, wherever one stands."""
    monkeypatch.chdir("/")
    study.write_text(STUDY + IRON)
    if edit:
        assert edit[0] in TABLE
        (tmp_path / "iron.csv").write_text(TABLE.replace(*edit, 1), encoding="latin-1")
    before = sorted(tmp_path.rglob("*"))
    code, sentence = refused(["solve", study, "-o", tmp_path / "out"], capsys)
    assert code == 3
    assert said in sentence
    for named in (study, tmp_path / "iron.csv", "`iron_ring.curve.file`"):
        assert str(named) in sentence
    assert sorted(tmp_path.rglob("*")) == before


def test_good_iron(study, tmp_path, capsys):
    """The control of the above."""
    study.write_text(STUDY + IRON)
    (tmp_path / "iron.csv").write_text(TABLE)
    assert main(["solve", str(study), "-o", str(tmp_path / "out"), "--json"]) == 0
    assert 0.5 < json.loads(capsys.readouterr().out)["max_B_T"] < 0.7


def test_bad_maps(study, measured, tmp_path, capsys):
    out = tmp_path / "out"
    measured.write_text(measured.read_text().replace("0.55", "inf", 1))
    code, sentence = refused(["infer", study, "--measurements", measured, "-o", out], capsys)
    assert (code, out.exists()) == (4, False)
    assert "finite number" in sentence


def test_doctor_without_getdp_still_tells_the_rest(capsys):
    assert main(["doctor", "--getdp", "/nowhere"]) == 6
    shown = capsys.readouterr()
    assert "not found" in shown.out
    assert "numpy" in shown.out
    assert "apt-get" in shown.err


def test_no_getdp(study, tmp_path, capsys):
    code, sentence = refused(["solve", study, "-o", tmp_path / "out", "--getdp", "/nowhere"],
                             capsys)
    assert code == 6
    assert "apt-get install getdp" in sentence


def fake_getdp(tmp_path, body):
    path = tmp_path / "fake-getdp"
    path.write_text("#!/bin/sh\nif [ \"$1\" = -info ]; then\n"
                    f"echo 'Version          : 3.2.0'; exit 0\nfi\n{body}\n")
    path.chmod(0o755)
    return path


@pytest.mark.parametrize(("body", "said"), [
    ("kill -SEGV $$", "SIGSEGV"),
    ("sleep 60", "time limit"),
    ("echo 'Info : System 1/1: 10 Dofs'; echo 0 > flux_density.txt", "unknowns"),
])
def test_getdp_that_fails(study, tmp_path, capsys, body, said):
    out = tmp_path / "out"
    code, sentence = refused(["solve", study, "-o", out, "--time-limit", 1, "--getdp",
                              fake_getdp(tmp_path, body)], capsys)
    assert code == 7
    assert said in sentence
    assert not list(out.glob("field_map*"))
    log = sentence.split("Its log is ")[1].strip().rstrip(".")
    assert os.path.isfile(log), "the log that the message names must exist"


def test_output_that_cannot_be_written(study, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    code, sentence = refused(["solve", study, "-o", tmp_path / "file" / "out"], capsys)
    assert code == 8
    assert "Cannot" in sentence


@pytest.mark.parametrize("body", [
    "echo 'Error   : No space left on device'; exit 1", "kill -XFSZ $$"])
def test_getdp_without_space(study, tmp_path, capsys, body):
    """On a disk that is not that of the results, or under a limit."""
    out = tmp_path / "out"
    code, sentence = refused(["solve", study, "-o", out, "--getdp", fake_getdp(tmp_path, body)],
                             capsys)
    assert code == 8
    assert f"disk of {out} is full" in sentence


@pytest.mark.parametrize("small_disk", [16, 64, 128, 192, 256, 320, 400], indirect=True)
def test_full_disk(study, small_disk, capsys):
    """Whoever meets the end of the disk first (mesh, run folder, GetDP, results): one sentence,
    and no result half-written.
    """
    code, sentence = refused(["solve", study, "-o", small_disk / "out"], capsys)
    assert code == 8
    assert "No space left" in sentence or "is full" in sentence
    assert str(small_disk / "out") in sentence
    for path in small_disk.rglob("field_map.[ch]*"):
        assert read_map(path).sizes["point"] == 10
    assert not list(small_disk.rglob(".*"))


def test_limit_of_file_sizes(study, tmp_path):
    """A mesh that is cut off is no mesh that could not be built."""
    done = subprocess.run(
        ["bash", "-c", f"ulimit -f 8; exec '{sys.executable}' -m halbach_fe solve '{study}' -o "
         f"'{tmp_path / 'out'}'"], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 8
    assert "File too large" in done.stderr
    assert f"{tmp_path / 'out' / 'mesh.msh'}" in done.stderr


@pytest.mark.parametrize("name", ["mesh.msh", "report.html", "field_map.h5", "getdp-real"])
def test_links_are_neither_replaced_nor_followed(study, tmp_path, capsys, name):
    """Someone has put them into the folder of results."""
    out, precious = tmp_path / "out", tmp_path / "precious"
    out.mkdir()
    precious.mkdir()
    (precious / "kept").write_text("kept")
    (out / name).symlink_to(precious / "kept" if "." in name else precious)
    (out / ".mesh.tmp.msh").symlink_to(precious / "kept")
    code, said = refused(["solve", study, "-o", out, "--json"], capsys)
    assert code == 8
    assert f"{name} in folder {out} was not written by `halbach-fe solve`" in said
    assert (out / name).is_symlink()
    (out / name).rename(tmp_path / "moved")  # as the sentence advises
    assert main(["solve", str(study), "-o", str(out), "--json"]) == 0
    assert [(path.name, path.read_text()) for path in precious.iterdir()] == [("kept", "kept")]


@pytest.mark.parametrize("umask", [0o022, 0o077, 0o002])
def test_the_umask_says_who_may_read(study, tmp_path, umask):
    """Files and run folders alike."""
    before = os.umask(umask)
    try:
        assert main(["solve", str(study), "-o", str(tmp_path / "out"), "--json"]) == 0
    finally:
        os.umask(before)
    for path in (tmp_path / "out").rglob("*"):
        full = 0o777 if path.is_dir() else 0o666
        assert path.stat().st_mode & 0o777 == full & ~umask, path


@pytest.mark.parametrize("small_disk", [16, 256], indirect=True)
def test_full_disk_of_the_cache(study, small_disk, tmp_path, monkeypatch, capsys):
    """Costs a warning, and what was kept is whole."""
    monkeypatch.setenv(LIMIT_VARIABLE, "1")
    assert main(["solve", str(study), "-o", str(tmp_path / "out"), "--cache",
                 str(small_disk)]) == 0
    said = capsys.readouterr().err
    assert "not kept in the cache" in said
    kept = list(small_disk.glob("*/*/manifest.json"))
    assert bool(kept) == (os.statvfs(small_disk).f_blocks * os.statvfs(small_disk).f_frsize > 1e5)
    assert not list(small_disk.glob("*/.*"))
    assert main(["solve", str(study), "-o", str(tmp_path / "again"), "--cache",
                 str(small_disk)]) == 0
    assert "damaged" not in capsys.readouterr().err


@pytest.mark.parametrize("small_disk", [16, 32], indirect=True)
def test_full_disk_while_writing_results(study, small_disk, capsys):
    """HDF5 must not crash the process when its file finds no room."""
    study.write_text(STUDY.replace("recoil_permeability = 1.05", "recoil_permeability = 1.0")
                     .replace("angles = 10", "angles = 2000"))
    code, sentence = refused(["solve", study, "-o", small_disk / "out"], capsys)
    assert code == 8
    assert "No space left" in sentence
    assert not list(small_disk.rglob("*field_map*"))


@pytest.mark.parametrize("small_disk", [64], indirect=True)
def test_read_only_folder(study, small_disk, capsys):
    """Even root cannot write there."""
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    code, sentence = refused(["solve", study, "-o", small_disk / "out"], capsys)
    assert code == 8
    assert "Read-only file system" in sentence


def test_getdp_that_vanishes(study, tmp_path, capsys):
    """After it was found; on a network's disk that happens."""
    fake = fake_getdp(tmp_path, "")
    fake.write_text(fake.read_text().replace("exit 0", f"rm {fake}; exit 0"))
    out = tmp_path / "out"
    code, sentence = refused(["solve", study, "-o", out, "--getdp", fake], capsys)
    assert code == 7
    assert "No such file" in sentence
    assert not list(out.glob("field_map*"))


LIMITED = """
import resource, sys
from pathlib import Path
from halbach_fe.cli import main
now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
limit = now + int(sys.argv[1]) * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.parametrize("extra_MiB", [100, 350, 500, 800])
def test_memory_limit(study, measured, tmp_path, extra_MiB):
    """Beyond what the program takes itself: whoever meets it says so, and nothing is broken.

    Compiled libraries, those in Rust and C++, end the process themselves, with a sentence.
    """
    out = tmp_path / "out"
    # Python that compiles a module without memory for its syntax tree calls that a ValueError.
    compileall.compile_dir(ROOT / "halbach_fe", quiet=1)
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(extra_MiB), "infer", str(study), "--measurements",
         str(measured), "-o", str(out)], env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode in (0, 7, 13, -signal.SIGABRT), done.stderr
    if done.returncode:
        assert re.search(r"not enough memory|Cannot allocate|out of memory"
                         r"|memory allocation of \d+ bytes failed|bad_alloc", done.stderr)
        assert "Traceback" not in done.stderr
    assert not unreadable(out)
    assert extra_MiB > 100 or done.returncode, "the control: there is no run in so little"


@pytest.fixture
def start():
    """Start a process, which ends with the test, so that a failure does not make others fail."""
    started = []

    def popen(*arguments, **keys):
        started.append(subprocess.Popen(*arguments, **keys))
        return started[-1]

    yield popen
    for process in started:
        with process:
            process.kill()


def interrupted(start, number, folder, study, *program, waits_s=0.0):
    """Interrupt a program that solves a study while GetDP runs; return the process of GetDP."""
    marker = folder / "pid"
    fake = fake_getdp(folder, f"echo $$ > {marker}; exec sleep 60")
    process = start(
        [sys.executable, *program, "solve", str(study), "-o", str(folder / "out"), "--getdp",
         str(fake)], stderr=subprocess.PIPE, text=True,
        # a shell's background jobs ignore Ctrl-C, those of nohup SIGHUP: so would their children
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL))
    while not (marker.exists() and marker.read_text().strip()):
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    time.sleep(waits_s)
    process.send_signal(number)
    _, said = process.communicate(timeout=50)  # GetDP itself would take 60
    assert process.returncode == 130
    assert said.strip().endswith("interrupted")
    return int(marker.read_text())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interruption_ends_getdp_too(study, tmp_path, start, number):
    getdp = interrupted(start, number, tmp_path, study, "-m", "halbach_fe")
    with pytest.raises(ProcessLookupError):
        os.kill(getdp, 0)
    assert not list((tmp_path / "out").glob("field_map*"))


UNWOKEN = """
import signal, sys, threading, time
threading.Thread(target=time.sleep, args=(1e3,), daemon=True).start()  # it receives the signals
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
from halbach_fe.cli import main
sys.exit(main(sys.argv[1:]))
"""
"""Program whose main thread no Ctrl-C wakes, as if it came just before the thread blocked."""


def test_an_interruption_that_wakes_nobody_ends_getdp_too(study, tmp_path, start):
    """After a second the main thread waits for GetDP."""
    interrupted(start, signal.SIGINT, tmp_path, study, "-c", UNWOKEN, waits_s=1.0)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_end_of_halbach_fe_ends_wrapped_getdp(study, tmp_path, start, number):
    """A wrapper's child is GetDP, and a cluster's modules wrap it."""
    marker = tmp_path / "pid"
    fake = fake_getdp(tmp_path, f"sleep 60 & echo $! > {marker}; wait")
    process = start(
        [sys.executable, "-m", "halbach_fe", "solve", str(study), "-o", str(tmp_path / "out"),
         "--getdp", str(fake)], stderr=subprocess.DEVNULL)
    while not (marker.exists() and marker.read_text().strip()):
        assert process.poll() is None
        time.sleep(0.05)
    child = psutil.Process(int(marker.read_text()))
    process.send_signal(number)
    process.wait()
    gone, _ = psutil.wait_procs([child], timeout=50)
    assert gone or child.status() == psutil.STATUS_ZOMBIE


def test_what_a_wrapper_leaves_behind_is_ended(study, tmp_path, capsys):
    """Also if the wrapper itself has ended."""
    marker = tmp_path / "pid"
    fake = fake_getdp(tmp_path, f"sleep 60 >/dev/null 2>&1 & echo $! > {marker}")
    refused(["solve", study, "-o", tmp_path / "out", "--getdp", fake], capsys)
    child = int(marker.read_text())
    deadline = time.monotonic() + 50  # it would end by itself after 60 s
    while is_running(child):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def is_running(process):
    """Whether a process is there, and not only its entry; it may go while one looks."""
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_every_exit_code_is_documented():
    text = parser().format_help()
    assert "Most people need new, explain, solve, infer and diagnose." in text
    page = (ROOT / "docs" / "reliability.md").read_text()
    for code, meaning in EXIT_CODES.items():
        assert f"{code:3d}  {meaning}" in text
        assert f"| {code} | {meaning} |" in page


def test_the_help_states_the_default_that_it_does_not_import():
    """The help must come without the solver, so it repeats the number."""
    verb = next(action for action in parser(["demagnetization"])._actions if action.dest == "verb")
    shown = " ".join(verb.choices["demagnetization"].format_help().split())
    assert f"(default: {ACROSS})" in shown


def test_a_bug_is_called_a_bug(study, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("halbach_fe.read_study", lambda _: 1 / 0)
    assert main(["solve", str(study), "-o", str(tmp_path / "out")]) == 1
    assert "please report it" in capsys.readouterr().err


def test_tables_show_units_and_nothing_else_odd(capsys):
    """No-break spaces stay; what a terminal would obey does not."""
    print_table([{"what": "99.7\u202f%", "found": "a\u00a0b\x1b[31m"}])
    shown = capsys.readouterr().out
    assert "99.7\u202f%" in shown
    assert "a\u00a0b?[31m" in shown
