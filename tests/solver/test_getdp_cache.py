"""What GetDP answered is kept and found again, and nothing else is."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.core.errors import GetDPError, HalbachWarning, OutputError
from halbach_fe.core.files import remove_orphans, temporary_name
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver import getdp_cache as module
from halbach_fe.solver.getdp import run
from halbach_fe.solver.getdp_cache import (
    FOLDER_VARIABLE,
    LIMIT_VARIABLE,
    MANIFEST,
    TRUST_VARIABLE,
    Cache,
    default_cache,
)
from halbach_fe.solver.routes import solve_nominal
from tests.conftest import DIPOLE, changed, circle

POINTS = circle(0.07, 5)


@pytest.fixture
def shared(session, tmp_path):
    """A session with a cache, and how often it starts GetDP."""
    runs = []

    def counted(getdp, job, *rest):
        runs.append(job)
        return run(getdp, job, *rest)

    return replace(session, cache=Cache(tmp_path / "cache"), run=counted), runs


def test_a_search_without_a_cache_has_its_own(session, tmp_path):
    with replace(session, cache=None).with_cache() as cached:
        assert cached.cache.folder.parent == session.folder
        cached.cache.folder.mkdir()
    assert not cached.cache.folder.exists()
    given = replace(session, cache=Cache(tmp_path / "cache"))
    with given.with_cache() as cached:
        assert cached is given


@pytest.fixture
def coarse(dipole):
    return lambda **changes: dipole(mesh__block_size_m=0.04, **changes)


def test_the_same_is_asked_once(coarse, shared):
    session, runs = shared
    first = solve_nominal(build_magnet(coarse()), POINTS, session)
    assert len(runs) == 2  # real materials and vacuum
    lines = []
    again = replace(session, folder=session.folder.parent / "other",
                    progress=lambda done, total: lines.append((done, total)))
    assert np.array_equal(solve_nominal(build_magnet(coarse()), POINTS, again), first)
    assert len(runs) == 2
    assert lines[-1] == (2, 2)
    kept = {path.name: path.read_bytes() for path in (session.folder / "getdp-real").iterdir()}
    restored = {path.name: path.read_bytes() for path in (again.folder / "getdp-real").iterdir()}
    assert restored == kept
    assert "getdp.log" in kept


@pytest.mark.parametrize("change", [
    {"array__remanence_T": 1.07}, {"array__recoil_permeability": 1.06},
    {"mesh__block_size_m": 0.039}, {"name": "another"},
    {"iron_ring": {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 100.0}}])
def test_another_study_is_computed(coarse, shared, change):
    session, runs = shared
    solve_nominal(build_magnet(coarse()), POINTS, session)
    solve_nominal(build_magnet(coarse().model_validate(changed_study(coarse(), change))), POINTS,
                  session)
    assert len(runs) > 2


def changed_study(study, change):
    from tests.conftest import changed
    return changed(study.model_dump(mode="json", exclude_none=True), **change)


def test_another_getdp_or_job_has_another_entry(coarse, shared, tmp_path):
    session, runs = shared
    solve_nominal(build_magnet(coarse()), POINTS, session)
    folder, job, getdp, cache = tmp_path / "run", runs[0], session.getdp, session.cache
    folder.mkdir()
    (folder / "case.pro").write_text("a")

    def key(getdp=getdp, job=job):
        return cache.entry(getdp, job, folder).folder

    own = key()
    assert key(job=replace(job, time_limit_s=1.0)) == own
    others = [key(job=replace(job, numbers={**job.numbers, "VACUUM": 0.5})),
              key(job=replace(job, options=("-ksp_type", "cg"))),
              key(job=replace(job, processes=2)),
              key(getdp=replace(getdp, version="3.3")), key(getdp=replace(getdp, petsc="0")),
              key(getdp=replace(getdp, build_options=("64Bit",)))]
    (folder / "case.pro").write_text("b")
    others.append(key())
    (folder / "case.pro").rename(folder / "other.pro")
    others.append(key())
    assert len({own, *others}) == len(others) + 1


def entries(session):
    return [one.folder for one in session.cache.entries()]


def damage_bit(folder):
    path = folder / "solutions.bin"
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)


def edit_manifest(folder, edit):
    path = folder / MANIFEST
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))


DAMAGE = {
    "one bit": damage_bit,
    "truncated": lambda folder: os.truncate(folder / "solutions.bin", 100),
    "a file is gone": lambda folder: (folder / "flux_density.txt").unlink(),
    "no manifest": lambda folder: (folder / MANIFEST).unlink(),
    "half a manifest": lambda folder: os.truncate(folder / MANIFEST, 60),
    "an empty manifest": lambda folder: (folder / MANIFEST).write_text("{}"),
    "not text": lambda folder: (folder / MANIFEST).write_bytes(b"\xff\xfe\x00"),
    "a path": lambda folder: edit_manifest(folder, lambda data: data["files"].update(
        {"../../stolen": data["files"]["getdp.log"]})),
    "a file that was given": lambda folder: edit_manifest(folder, lambda data: data[
        "files"].update({"case.pro": data["files"]["getdp.log"]})),
    "without a log": lambda folder: edit_manifest(
        folder, lambda data: data["files"].pop("getdp.log")),
    "a key too many": lambda folder: edit_manifest(folder, lambda data: data.update(more=1)),
    "a folder for a file": lambda folder: (
        (folder / "getdp.log").unlink(), (folder / "getdp.log").mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damage_is_seen_and_computed_again(coarse, shared, damage):
    session, runs = shared
    first = solve_nominal(build_magnet(coarse()), POINTS, session)
    damage(entries(session)[0])
    with pytest.warns(HalbachWarning, match="cache is damaged .* computed again"):
        again = solve_nominal(build_magnet(coarse()), POINTS, session)
    assert np.array_equal(again, first)
    assert len(runs) == 3
    assert np.array_equal(solve_nominal(build_magnet(coarse()), POINTS, session),
                          first)  # no warning any more
    assert len(runs) == 3


def test_a_full_disk_is_no_damage(coarse, shared, monkeypatch):
    """The entry stays; what cannot be written here is the run's own affair."""
    session, runs = shared
    first = solve_nominal(build_magnet(coarse()), POINTS, session)
    kept = entries(session)

    def full(source, target):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(module, "shutil", SimpleNamespace(copyfile=full, rmtree=shutil.rmtree))
        assert np.array_equal(solve_nominal(build_magnet(coarse()), POINTS, session), first)
    assert len(runs) == 4
    assert sorted(entries(session)) == sorted(kept)


def test_entries_that_cannot_be_changed_are_used(coarse, shared, monkeypatch):
    """As on a disk that is read-only."""
    session, runs = shared
    first = solve_nominal(build_magnet(coarse()), POINTS, session)

    def refused(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(module.os, "utime", refused)
    assert np.array_equal(solve_nominal(build_magnet(coarse()), POINTS, session), first)
    assert len(runs) == 2


def test_what_is_no_entry_stays(coarse, shared):
    """Whoever names a wrong folder loses nothing."""
    session, _ = shared
    solve_nominal(build_magnet(coarse()), POINTS, session)
    folder = session.cache.folder
    (folder / "ff").mkdir(exist_ok=True)
    (folder / "ff" / "letters.txt").write_text("dear")
    (folder / "ee").rmdir() if (folder / "ee").exists() else None
    (folder / "ee").write_text("a file")
    replace(session.cache, limit_bytes=0.0).trim()
    session.cache.clear()
    assert entries(session) == []
    assert (folder / "ff" / "letters.txt").exists()
    assert (folder / "ee").exists()


def test_damage_that_hashes_would_not_show(coarse, shared):
    """The control: a wrong number with a right hash is found by the verification after it."""
    session, _ = shared
    solve_nominal(build_magnet(coarse()), POINTS, session)
    folder = entries(session)[0]
    (folder / "flux_density.txt").write_text("0 0 0 1 2 3\n")
    edit_manifest(folder, lambda data: data["files"].update({"flux_density.txt": {
        "bytes": 12, "sha256": module._digest(folder / "flux_density.txt")}}))
    with pytest.raises(GetDPError, match="rows"):
        solve_nominal(build_magnet(coarse()), POINTS, session)


def test_a_failure_is_not_kept(coarse, shared):
    session, _ = shared

    def failing(getdp, job, folder, *rest):
        lines = run(getdp, job, folder, *rest)
        (folder / "flux_density.txt").write_text("0 0 0 1 2 3\n")
        return lines

    with pytest.raises(GetDPError):
        solve_nominal(build_magnet(coarse()), POINTS, replace(session, run=failing))
    assert entries(session) == []


def test_what_was_not_used_for_longest_goes(coarse, shared):
    session, runs = shared
    for remanence in (1.0, 1.1, 1.2):
        solve_nominal(build_magnet(coarse(array__remanence_T=remanence)), POINTS, session)
    found = session.cache.entries()
    assert len(found) == len(runs) == 6
    for age, one in enumerate(found):
        os.utime(one.folder / MANIFEST, (1e9 - age, 1e9 - age))
    solve_nominal(build_magnet(coarse(array__remanence_T=1.0)), POINTS,
                  session)  # those are used now
    used = {one.folder for one in session.cache.entries()[:2]}
    room = sum(one.bytes for one in found[:2]) * 1.01
    replace(session.cache, limit_bytes=room).trim()
    assert set(entries(session)) == used


def test_an_answer_larger_than_the_cache_is_not_kept(coarse, shared):
    session, runs = shared
    small = replace(session, cache=replace(session.cache, limit_bytes=1000))
    solve_nominal(build_magnet(coarse()), POINTS, small)
    assert entries(small) == []
    assert len(runs) == 2


def test_a_cache_that_cannot_be_written_costs_nothing_but_a_warning(coarse, shared, tmp_path):
    session, _ = shared
    (tmp_path / "file").write_text("")
    nowhere = replace(session, cache=Cache(tmp_path / "file" / "cache"))
    with pytest.warns(HalbachWarning, match="not kept in the cache"):
        solve_nominal(build_magnet(coarse()), POINTS, nowhere)


SHARED = """
import json, sys
from pathlib import Path
import numpy as np
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.getdp_cache import Cache
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
folder, cache, studies, points = sys.argv[1:]
for study in json.loads(studies):
    field = solve_nominal(build_magnet(parse_study(study)), np.array(json.loads(points)), Session(
        find_getdp(), Path(folder), jobs=2, cache=Cache(Path(cache), 150_000)))
    print(field.tobytes().hex())
"""


def test_processes_share_it(tmp_path):
    """Three at once, in a cache that holds a part of it: they store, use and remove the same."""
    studies = [changed(DIPOLE, array__remanence_T=remanence, mesh__block_size_m=0.04)
               for remanence in (1.0, 1.1, 1.2)]

    def one(number):
        return subprocess.run(
            [sys.executable, "-W", "error", "-c", SHARED, tmp_path / f"{number}",
             tmp_path / "cache", json.dumps(studies), json.dumps(POINTS.tolist())],
            capture_output=True, text=True, timeout=300, check=False)

    with ThreadPoolExecutor(3) as pool:
        done = list(pool.map(one, range(3)))
    assert [(run.returncode, run.stderr) for run in done] == [(0, "")] * 3
    assert len({run.stdout for run in done}) == 1
    cache = Cache(tmp_path / "cache", 150_000)
    sizes = [one.bytes for one in cache.entries()]
    assert sum(sizes) <= 150_000 < sum(sizes) + max(sizes)  # as many as fit; there were six
    assert [path.name for path in cache.folder.rglob("*") if path.name[0] == "."] == []


def test_removed_while_it_is_read(coarse, shared, monkeypatch):
    """Another process may trim an entry at any moment; that is no damage."""
    session, runs = shared
    first = solve_nominal(build_magnet(coarse()), POINTS, session)
    true, lock = module._digest, threading.Lock()

    def removing(path):
        with lock:
            session.cache.clear() if path.name == "getdp.log" else None
        return true(path)

    monkeypatch.setattr(module, "_digest", removing)
    assert np.array_equal(solve_nominal(build_magnet(coarse()), POINTS, session), first)
    assert len(runs) > 2


def test_left_behind(tmp_path):
    """What a killed process was making is removed, what a living one is making is not."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    own = tmp_path / f"{temporary_name('run')}abc"
    dead = tmp_path / own.name.replace(f"~{os.getpid()}~", f"~{gone.pid}~")
    elsewhere = tmp_path / own.name.replace("~", "~elsewhere-", 1).replace(
        f"~{os.getpid()}~", f"~{gone.pid}~")
    for folder in (own, dead, elsewhere, tmp_path / "other"):
        folder.mkdir()
        (folder / "file").write_text("")
    (tmp_path / f"{dead.name}-file").write_text("")
    remove_orphans(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {own.name, elsewhere.name, "other"}


def test_the_environment_says_where_and_how_much(monkeypatch, tmp_path):
    monkeypatch.setenv(LIMIT_VARIABLE, "2")
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "here"))
    assert default_cache() == Cache(tmp_path / "here", 2 * 2**30)
    assert default_cache(tmp_path / "there").folder == tmp_path / "there"
    monkeypatch.delenv(FOLDER_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache().folder == tmp_path / "halbach-fe"
    monkeypatch.setenv(LIMIT_VARIABLE, "0")
    assert default_cache() is None
    monkeypatch.setenv(LIMIT_VARIABLE, "1")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(module.os.path, "expanduser", lambda path: path)
    assert default_cache() is None  # without a home
    for wrong in ("much", "-1", "nan", ""):
        monkeypatch.setenv(LIMIT_VARIABLE, wrong)
        with pytest.raises(OutputError, match="must be the size of the cache in GiB"):
            default_cache()


def test_the_verb(coarse, shared, monkeypatch, capsys):
    session, _ = shared
    solve_nominal(build_magnet(coarse()), POINTS, session)
    monkeypatch.setenv(LIMIT_VARIABLE, "1")
    at = ["--cache", str(session.cache.folder)]
    assert main(["cache", "ls", *at, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [one["problem"] for one in said["entries"]] == ["magnetostatics_2d.pro"] * 2
    assert said["bytes"] == sum(path.stat().st_size for path in session.cache.folder.rglob("*")
                                if path.is_file())
    DAMAGE["no manifest"](entries(session)[0])
    assert main(["cache", "ls", *at]) == 0
    found = capsys.readouterr()
    assert "damaged" in found.out
    assert "magnetostatics_2d.pro" in found.out
    assert "2 entries" in found.err
    assert main(["cache", "clear", *at]) == 0
    assert "Removed 2 entries" in capsys.readouterr().err
    assert [path for path in session.cache.folder.rglob("*") if path.is_file()] == []
    monkeypatch.setenv(LIMIT_VARIABLE, "0")
    assert main(["cache", "ls"]) == 0
    assert "its limit is 0" in capsys.readouterr().err


@pytest.mark.parametrize(("mode", "refused"), [(0o700, False), (0o755, False), (0o757, True),
                                               (0o1777, True)])
def test_a_cache_that_others_may_write_to(tmp_path, monkeypatch, mode, refused):
    """Its answers may be made up, hashes included."""
    monkeypatch.setenv(LIMIT_VARIABLE, "1")
    monkeypatch.delenv(TRUST_VARIABLE, raising=False)
    folder = tmp_path / "cache"
    assert default_cache(folder).folder == folder  # it does not exist yet
    folder.mkdir()
    folder.chmod(mode)
    if refused:
        with pytest.raises(OutputError, match=f"Other users may write.*{TRUST_VARIABLE}=1"):
            default_cache(folder)
        monkeypatch.setenv(TRUST_VARIABLE, "1")
    assert default_cache(folder).folder == folder


@pytest.mark.parametrize(("owner", "group", "members", "refused"), [
    (1000, "anna", [], False), (1000, "anna", ["anna"], False), (1000, "anna", ["ben"], True),
    (1000, "lab", [], True), (1001, "anna", [], True), (0, "anna", [], False)])
def test_whose_cache(monkeypatch, owner, group, members, refused):
    """A group of one's own name is one's own; so is what root has made."""
    folder = SimpleNamespace(stat=lambda: SimpleNamespace(
        st_uid=owner, st_gid=50, st_mode=0o40775))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(module.pwd, "getpwuid", lambda _: SimpleNamespace(pw_name="anna"))
    monkeypatch.setattr(module.grp, "getgrgid", lambda _: SimpleNamespace(
        gr_name=group, gr_mem=members))
    assert module._others_may_write(folder) is refused
