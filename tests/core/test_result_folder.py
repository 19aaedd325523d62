"""A folder of results has one owner: a command and a study, and one run at a time."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import subprocess
import sys
import threading
from contextlib import nullcontext
from datetime import datetime

import h5py
import pytest

from halbach_fe.core.errors import OutputError
from halbach_fe.core.files import write_text
from halbach_fe.core.result_folder import (
    RECORD,
    WRITES,
    Record,
    _Writer,
    finished_results,
    keep_results,
    locked_folder,
    result_folder,
    single_file,
)


def run(folder, *names, command="solve", study="a"):
    with result_folder(folder, command, study):
        for name in names:
            write_text(folder / name, name)


def listed(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_what_is_stale_is_removed(tmp_path):
    folder = tmp_path / "out"
    run(folder, "report.html", "multipoles.csv", "map/page.html", "edited.toml", "response.h5")
    (folder / "notes.txt").write_text("mine")
    (folder / "edited.toml").write_text("edited by hand")
    run(folder, "report.html")
    # what a later run may use again stays, and so does what is not ours
    assert listed(folder) == {RECORD, "report.html", "notes.txt", "edited.toml", "response.h5"}
    assert list(json.loads((folder / RECORD).read_text())["files"]) == ["report.html"]
    (folder / "edited.toml").write_text("theirs, although a run had written one of that name")
    run(folder, "other.html")
    assert listed(folder) == {RECORD, "other.html", "notes.txt", "edited.toml", "response.h5"}


def test_cases_of_an_interrupted_run_stay(tmp_path):
    """A run of sealed cases that went on removed those that it had not run itself, hours of them,
    once all its checks passed.
    """
    run(tmp_path, "cases/0003-dipole-lag.json", "cases/other.json", command="study diagnosis")
    run(tmp_path, "cases/0004-rods-none.json", command="study diagnosis")
    assert listed(tmp_path) == {  # the control: another name is stale
        RECORD, "cases/0003-dipole-lag.json", "cases/0004-rods-none.json"}
    run(tmp_path, "cases/0004-rods-none.json", command="study diagnosis")  # may be written again


@pytest.mark.parametrize("owner", [{"command": "infer"}, {"study": "b"}])
def test_a_mixture_is_refused(tmp_path, owner):
    run(tmp_path, "report.html")
    with pytest.raises(OutputError, match=r"results of `solve` of study a\. A folder belongs to"):
        run(tmp_path, "prediction.csv", **owner)
    assert listed(tmp_path) == {RECORD, "report.html"}
    (tmp_path / "report.html").unlink()  # nothing is left that could be mixed up
    run(tmp_path, "prediction.csv", **owner)
    assert listed(tmp_path) == {RECORD, "prediction.csv"}


def test_two_study_files_of_one_name(tmp_path):
    """Are two studies. Controls: a file that was changed, moved, or copied is the same one."""
    def run_of(study):
        with result_folder(tmp_path / "out", "solve", "a", [study], {"STUDY": study}):
            write_text(tmp_path / "out" / "report.html", study.read_text())

    study, other = tmp_path / "study.toml", tmp_path / "other.toml"
    study.write_text("one")
    run_of(study)
    study.write_text("one, changed")
    run_of(study)
    other.write_text("two")
    with pytest.raises(OutputError, match=r"another study file, .*study\.toml, whose"):
        run_of(other)
    assert (tmp_path / "out" / "report.html").read_text() == "one, changed"
    other.write_text("one, changed")  # a copy
    run_of(other)
    (tmp_path / "elsewhere").mkdir()
    other.rename(tmp_path / "elsewhere" / "other.toml").write_text("moved, and changed")
    run_of(tmp_path / "elsewhere" / "other.toml")
    assert (tmp_path / "out" / "report.html").read_text() == "moved, and changed"


def test_a_run_that_fails(tmp_path):
    """Its files are known, and removed once they are stale; without files nothing is left."""
    def failing(*names):
        with pytest.raises(ZeroDivisionError), result_folder(tmp_path / "out", "solve", "a"):
            for name in names:
                write_text(tmp_path / "out" / name, name)
            raise ZeroDivisionError

    failing()
    assert not (tmp_path / "out").exists()
    run(tmp_path / "out", "old.csv")
    failing("half.csv")
    assert listed(tmp_path / "out") == {RECORD, "old.csv", "half.csv"}
    run(tmp_path / "out", "new.csv")
    assert listed(tmp_path / "out") == {RECORD, "new.csv"}


KILLED = """
import os, pathlib, signal, sys
from halbach_fe.core.files import write_text
from halbach_fe.core.result_folder import result_folder
with result_folder(pathlib.Path(sys.argv[1]), "solve", "a"):
    write_text(pathlib.Path(sys.argv[1], "half.csv"), "")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_run_that_is_killed(tmp_path):
    """It leaves neither a lock nor a file that nobody knows."""
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert listed(tmp_path) == {RECORD, "half.csv"}
    with pytest.raises(OutputError, match="of study a"):
        run(tmp_path, "x.csv", study="b")
    run(tmp_path, "new.csv")
    assert listed(tmp_path) == {RECORD, "new.csv"}


IN_BETWEEN = """
import os, pathlib, signal, sys
from halbach_fe.core import files
from halbach_fe.core.result_folder import result_folder
rename = pathlib.Path.replace
def killed(self, target):
    if sys.argv[2] == "after":
        rename(self, target)
    os.kill(os.getpid(), signal.SIGKILL)
with result_folder(pathlib.Path(sys.argv[1]), "solve", "a"):
    for name in ("mesh.msh", "old.csv"):
        pathlib.Path.replace = rename if name == "mesh.msh" else killed
        files.write_text(pathlib.Path(sys.argv[1], name), "of the killed run")
"""


@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_run_that_is_killed_as_a_file_appears(tmp_path, before, moment):
    """Its files are its own, whether they are the old ones or the new."""
    if before:
        run(tmp_path, "old.csv")
    subprocess.run([sys.executable, "-c", IN_BETWEEN, str(tmp_path), moment], check=False)
    with result_folder(tmp_path, "solve", "a", solving=True):
        for name in ("mesh.msh", "old.csv"):
            write_text(tmp_path / name, name)
    assert (tmp_path / "old.csv").read_text() == "old.csv"
    assert json.loads((tmp_path / RECORD).read_text())["writing"] == {}


def place(kind, path, elsewhere):
    """Put something of a user at a path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "file":
        path.write_text("precious")
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(elsewhere)


@pytest.mark.parametrize("kind", ["file", "folder", "link"])
@pytest.mark.parametrize("command", WRITES)
def test_what_a_command_has_not_written(tmp_path, command, kind):
    """It is refused by name before anything is done, and stays as it is."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("precious")
    for number, pattern in enumerate((*WRITES[command], "page.json", "mesh.msh", "response.h5",
                                      "response-1.npy", "chains.nc", "getdp-real")):
        folder = tmp_path / str(number)
        path = folder / pattern.replace("*", "csv")
        place(kind, path, elsewhere)
        with (pytest.raises(OutputError, match=f"{path.name} in folder .* not written by"),
              result_folder(folder, f"halbach-fe {command}", "a", solving=True)):
            raise AssertionError("work is done")
        assert [one for one in folder.rglob("*") if one.name != path.parent.name] == [path]
        assert elsewhere.read_text() == "precious"
        os.rename(path, tmp_path / f"{number}-moved")  # as the sentence advises
        with result_folder(folder, f"halbach-fe {command}", "a", solving=True):
            write_text(folder / "page.json", "own")


def test_a_name_of_no_table_is_refused_as_it_is_written(tmp_path):
    (tmp_path / "unforeseen.csv").write_text("precious")
    with pytest.raises(OutputError, match=r"unforeseen\.csv in folder"):
        run(tmp_path, "unforeseen.csv")
    assert (tmp_path / "unforeseen.csv").read_text() == "precious"
    assert listed(tmp_path) == {"unforeseen.csv"}


def test_results_that_somebody_has_changed(tmp_path):
    """What was edited is somebody's work; the command says so and does not begin."""
    run(tmp_path, "report.html", "readings.csv", command="halbach-fe solve")
    (tmp_path / "readings.csv").write_text("edited by hand")
    with pytest.raises(OutputError, match=r"readings\.csv .* changed after `halbach-fe solve` had"):
        run(tmp_path, "report.html", command="halbach-fe solve")
    (tmp_path / "readings.csv").rename(tmp_path / "mine.csv")
    run(tmp_path, "report.html", "readings.csv", command="halbach-fe solve")
    assert (tmp_path / "mine.csv").read_text() == "edited by hand"


def test_a_record_of_an_earlier_version(tmp_path):
    """It does not list meshes and matrices, which are then taken for those of its runs."""
    run(tmp_path, "report.html")
    record = json.loads((tmp_path / RECORD).read_text())
    del record["kept"], record["writing"]
    (tmp_path / RECORD).write_text(json.dumps(record))
    (tmp_path / "mesh.msh").write_text("of the earlier run")
    with result_folder(tmp_path, "solve", "a", solving=True):
        write_text(tmp_path / "mesh.msh", "new")


def test_a_shorter_record_is_valid_at_every_moment(tmp_path):
    """It is written over the longer one, of which blanks are left until the file is cut."""
    run(tmp_path, *(f"{number}.csv" for number in range(500)))
    whole = (tmp_path / RECORD).stat().st_size
    seen = []

    def look(file, length):
        seen.append(json.loads((tmp_path / RECORD).read_text()))
        os.ftruncate(file.fileno(), length)

    record = Record(command="solve", study="a")
    with open(tmp_path / RECORD, "r+b", buffering=0) as file:
        class Looking:
            def __getattr__(self, name):
                return (lambda length: look(file, length)) if name == "truncate" else getattr(
                    file, name)

        _Writer(tmp_path, record, "folder", Looking()).save()
    assert seen == [record.model_dump()]
    assert (tmp_path / RECORD).stat().st_size < whole


def test_single_files(tmp_path):
    """A command replaces the file that it has written, unless it was changed; no other one."""
    def one(path, text, command="halbach-fe import-map"):
        with single_file(path, command):
            write_text(path, text)

    path = tmp_path / "map.csv"
    one(path, "first")
    one(path, "second")
    one(tmp_path / "other.csv", "other")
    for command in ("halbach-fe export", "halbach-fe import-map"):
        if command == "halbach-fe import-map":
            path.write_text("edited")
        before = path.read_text()
        with pytest.raises(OutputError, match=r"map\.csv in folder .* Name another file"):
            one(path, "third", command)
        assert path.read_text() == before
    run(tmp_path / "out", "posterior.h5", command="halbach-fe infer")
    with pytest.raises(OutputError, match="a result of `halbach-fe infer`"):
        one(tmp_path / "out" / "posterior.h5", "map")
    link = tmp_path / "link.csv"
    link.symlink_to(tmp_path / "other.csv")
    with pytest.raises(OutputError, match=r"link\.csv"):
        one(link, "third")
    (tmp_path / "response.h5").write_text("mine")  # no file of this command is kept
    with pytest.raises(OutputError, match=r"response\.h5"):
        one(tmp_path / "response.h5", "third")


def test_notes_of_many_files(tmp_path, monkeypatch):
    """To write one more takes no more of them. Control: the note of the file itself is read."""
    read, parse = [], Record.model_validate_json

    def counted(content):
        read.append(len(content))
        return parse(content)

    monkeypatch.setattr(Record, "model_validate_json", counted)
    sizes = []
    for number in [*range(20), 19]:
        read.clear()
        with single_file(tmp_path / f"{number:02}.csv", "hf.write_map"):
            write_text(tmp_path / f"{number:02}.csv", "map")
        sizes.append(sum(read))
    assert sizes[19] == sizes[0] < sizes[20]


@pytest.mark.parametrize("text", ["ours", "edited"])
def test_notes_of_earlier_versions(tmp_path, text):
    """They told all files of a command in one; a file that was changed since is refused."""
    path, other = tmp_path / "map.csv", tmp_path / "other.csv"
    path.write_text(text)
    other.write_text("ours")
    digest = hashlib.sha256(b"ours").hexdigest()
    (tmp_path / ".hf.write_map.json").write_text(Record(
        command="hf.write_map", study="", kept=[],
        files={"map.csv": digest, "other.csv": digest}).model_dump_json())

    def write(path, text):
        with single_file(path, "hf.write_map"):
            write_text(path, text)

    if text == "edited":
        with pytest.raises(OutputError, match=r"map\.csv in folder .* changed after"):
            write(path, "new")
        return
    for content in ("new", "newer"):
        write(path, content)
    write(other, "other")
    path.write_text("ours")  # as the earlier note has it, but a later one does not
    with pytest.raises(OutputError, match=r"map\.csv"):
        write(path, "newest")
    assert (path.read_text(), other.read_text()) == ("ours", "other")


def test_planted_notes(tmp_path):
    """No note is written through a link. Control: into a folder it is."""
    (tmp_path / "elsewhere").mkdir()
    os.symlink(tmp_path / "elsewhere", tmp_path / ".hf.write_map")
    with pytest.raises(OutputError, match="is a link"), single_file(
            tmp_path / "map.csv", "hf.write_map"):
        write_text(tmp_path / "map.csv", "map")
    assert not list((tmp_path / "elsewhere").iterdir())
    (tmp_path / ".hf.write_map").unlink()
    with single_file(tmp_path / "map.csv", "hf.write_map"):
        write_text(tmp_path / "map.csv", "map")
    assert len(list((tmp_path / ".hf.write_map").iterdir())) == 1


def test_two_runs_at_once(tmp_path):
    with (result_folder(tmp_path, "solve", "a"),
          pytest.raises(OutputError, match="in use by another run")):
        run(tmp_path, "report.html")
    run(tmp_path, "report.html")


def test_planted_link(tmp_path):
    """The record is not written through a link into a file elsewhere."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "out").mkdir()
    os.symlink(victim, tmp_path / "out" / RECORD)
    with pytest.raises(OutputError, match="Cannot write"):
        run(tmp_path / "out", "report.html")
    assert victim.read_text() == "precious"


@pytest.mark.parametrize("content", ["", "{"])
def test_damaged_record(tmp_path, content):
    (tmp_path / RECORD).write_text(content)
    run(tmp_path, "report.html")
    assert listed(tmp_path) == {RECORD, "report.html"}


@pytest.mark.parametrize("content", [
    "[]", '{"runs": 7}', '{"command": "solve", "study": "a", "files": {"../victim": "%s"}}',
    '{"command": "solve", "study": "a", "files": {"%s": "%s"}}'])
def test_a_foreign_record(tmp_path, content):
    """A file of another program is not replaced, and a planted one names no file elsewhere."""
    victim, folder = tmp_path / "victim", tmp_path / "out"
    victim.write_text("precious")
    digest = hashlib.sha256(b"precious").hexdigest()
    content = content.replace("%s", str(victim), content.count("%s") - 1).replace("%s", digest)
    folder.mkdir()
    (folder / RECORD).write_text(content)
    with pytest.raises(OutputError, match="not one of halbach-fe"):
        run(folder, "report.html")
    assert (folder / RECORD).read_text() == content
    assert listed(folder) == {RECORD}
    assert victim.read_text() == "precious"


def test_a_lock_without_a_record(tmp_path):
    """Functions of the Python interface exclude runs and threads, and each other from no folder."""
    folder, refused = tmp_path / "out", []

    def other():
        try:
            run(folder, "report.html")
        except OutputError as error:
            refused.append(str(error))

    with locked_folder(folder), locked_folder(folder / "part"):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        (folder / "part").mkdir()
    (one,) = refused
    assert "in use by another run" in one
    assert listed(folder) == set()
    run(folder, "report.html")
    with locked_folder(folder):
        pass
    assert listed(folder) == {RECORD, "report.html"}  # the owner stays


@pytest.mark.parametrize("inner", [True, False])
def test_sessions_within_each_other(tmp_path, inner):
    """They renew each other's files. Control: a file of nobody is refused until it is moved, as the
    sentence advises.
    """
    part = tmp_path / "objective"
    first, second = (part, tmp_path) if inner else (tmp_path, part)
    for number, folder in enumerate((first, second, first, second)):
        with locked_folder(folder):
            write_text(part / "response.h5", str(number))
    assert (part / "response.h5").read_text() == "3"
    (part / "mesh.msh").write_text("mine")
    with pytest.raises(OutputError, match=r"mesh\.msh .* move this elsewhere"), (
            locked_folder(second)):
        write_text(part / "mesh.msh", "4")
    assert (part / "mesh.msh").read_text() == "mine"
    (part / "mesh.msh").rename(tmp_path / "mine.msh")
    with locked_folder(second):
        write_text(part / "mesh.msh", "4")
    assert (part / "mesh.msh").read_text() == "4"


def test_what_a_session_finds_without_a_record(tmp_path):
    """A mesh with its regions and a response are known by their content. Controls: regions of
    other keys, and a response without its hash.
    """
    files = tmp_path / "regions.json", tmp_path / "mesh.msh", tmp_path / "response.h5"
    for regions, attributes, refused in (
            ({"study": "a", "dimension": 3, "air": 1}, {"key": "k", "content_sha256": "s"}, ""),
            ({"parts": []}, {"key": "k", "content_sha256": "s"}, r"mesh\.msh"),
            ({"study": "a", "dimension": 3, "air": 1}, {"key": "k"}, r"response\.h5")):
        files[0].write_text(json.dumps(regions))
        files[1].write_text("$MeshFormat")
        with h5py.File(files[2], "w") as file:
            file.attrs.update(attributes)
        with pytest.raises(OutputError, match=refused) if refused else nullcontext(), (
                locked_folder(tmp_path)):
            pass
        (tmp_path / RECORD).unlink(missing_ok=True)


def test_a_lock_that_is_removed_meanwhile(tmp_path, monkeypatch):
    """A run that opens the record just before another removes it does not lock a deleted file."""
    flock, first = fcntl.flock, []

    def late(number, how):
        if not first:
            first.append(number)
            (tmp_path / RECORD).unlink()
        flock(number, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with locked_folder(tmp_path):
        assert (tmp_path / RECORD).exists()
        monkeypatch.undo()
        with pytest.raises(OutputError, match="in use"):
            run(tmp_path, "report.html")


def test_what_a_finished_run_left(tmp_path):
    """Its inputs and results, and whether somebody has changed these since."""
    folder, given = tmp_path / "out", tmp_path / "map.csv"
    given.write_text("1 2 3")
    with result_folder(folder, "solve", "a", [given, tmp_path / "gone"]):
        for name in ("page.html", "part/page.html"):
            write_text(folder / name, name)
    with finished_results(folder) as found, finished_results(folder) as again:
        assert found.record == again.record
        assert found.record.inputs == {str(given): hashlib.sha256(b"1 2 3").hexdigest()}
        assert datetime.fromisoformat(found.record.ended).tzinfo is not None
        assert found.read("part/page.html", 14) == b"part/page.html"
        assert found.changed() == []
        with pytest.raises(OutputError, match="in use"):  # a run would change what is read
            run(folder, "page.html")
        for name, most, said in (("page.html", 8, "more than 8"), (RECORD, 99, "no result")):
            with pytest.raises(ValueError, match=said):
                found.read(name, most)
        (folder / "page.html").write_text("other")
        (folder / "part" / "page.html").unlink()
        (folder / "part").rmdir()
        assert found.changed() == ["page.html"]
        (tmp_path / "page.html").write_text("part/page.html")
        (folder / "part").symlink_to(tmp_path)
        with pytest.raises(ValueError, match="not in the folder"):
            found.read("part/page.html", 99)
        (folder / "page.html").unlink()
        (folder / "page.html").symlink_to(given)
        assert "page.html" in found.changed()
        with pytest.raises(ValueError, match="not in the folder"):
            found.read("page.html", 99)
    with result_folder(folder, "solve", "a"), pytest.raises(OutputError, match="in use"), \
            finished_results(folder):
        pass


def test_results_are_not_written_over(tmp_path):
    """By a command that writes a single file, in a folder of the results too."""
    run(tmp_path / "out", "page.html", "part/page.html")
    (tmp_path / "out" / "part" / RECORD).write_text("{")
    for name in ("page.html", "part/page.html"):
        with pytest.raises(OutputError, match="is a result of `solve`"):
            keep_results(tmp_path / "out" / name)
    keep_results(tmp_path / "out" / "part" / "mine.html")
    keep_results(tmp_path / "page.html")


def left_by_a_killed_run(folder):
    folder.mkdir()
    subprocess.run([sys.executable, "-c", KILLED, str(folder)], check=False)


def left_by_a_failed_run(folder):
    run(folder, "page.html")
    with pytest.raises(ZeroDivisionError), result_folder(folder, "solve", "a"):
        raise ZeroDivisionError


def a_pipe(folder):
    folder.mkdir()
    os.mkfifo(folder / RECORD)


def a_link(folder):
    run(folder.with_name("other"), "page.html")
    folder.mkdir()
    os.symlink(folder.with_name("other") / RECORD, folder / RECORD)


@pytest.mark.parametrize(("make", "said"), [
    (lambda folder: None, "which does not exist"), (lambda folder: folder.touch(), "a file"),
    (lambda folder: folder.mkdir(), "which has no run.json"),
    (left_by_a_killed_run, "failed, was killed"), (left_by_a_failed_run, "failed, was killed"),
    (a_pipe, "damaged or of another"), (a_link, "cannot be read")])
def test_no_finished_results(tmp_path, make, said):
    make(tmp_path / "out")
    with pytest.raises(OutputError, match=said), finished_results(tmp_path / "out"):
        pass


@pytest.mark.parametrize("content", ["", "{", "[]", "[" * 100_000, '{"command": 7}', "\0"])
def test_records_of_others(tmp_path, content):
    (tmp_path / RECORD).write_text(content)
    with pytest.raises(OutputError, match="damaged or of another"), finished_results(tmp_path):
        pass
