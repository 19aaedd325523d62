"""Standard streams that are closed, full, unread or lack characters; Ctrl-C before the start."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from halbach_fe.cli import process
from halbach_fe.cli.process import guarded
from tests.conftest import ROOT

PROGRAM = f"'{sys.executable}' -m halbach_fe"
FLAWED = ("import sys; from halbach_fe.cli import common, process; "
          "sys.exit(process.guarded(lambda: {}))")
POSIX = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def shell(line, **environment):
    """Run a line of bash; return its exit code, standard output and standard error."""
    done = subprocess.run(["bash", "-c", line], env=os.environ | environment, capture_output=True,
                          check=False, timeout=120, cwd=ROOT)
    return (done.returncode, done.stdout.decode(errors="replace"),
            done.stderr.decode(errors="replace"))


@pytest.mark.parametrize(("verb", "to", "code", "said"), [
    ("schema", ">/dev/full", 8, "No space left"), ("--help", ">/dev/full", 8, "No space left"),
    ("completion bash", ">&-", 8, "Bad file descriptor"), ("schema", ">&-", 8, "Bad file"),
    ("schema", "2>&- >/dev/null", 0, ""), ("schema", "<&- >/dev/null", 0, ""),
    ("solve no.toml -o no", "2>&-", 3, ""), ("solve no.toml -o no", "2>/dev/full", 3, ""),
    ("solve no.toml -o no", ">&- <&-", 3, "No such file"),
    ("solve no.toml -o no", ">&- 2>&- <&-", 3, ""), ("nonsense", "2>&-", 2, ""),
    ("nonsense", "2>/dev/full", 2, "")])
def test_streams_that_cannot_be_written(verb, to, code, said):
    """The exit code is what it would be; who can still be told gets one sentence."""
    found, _, shown = shell(f"{PROGRAM} {verb} {to}")
    assert found == code
    assert said in shown
    assert len(shown.splitlines()) == bool(said)


def test_a_table_on_a_full_device():
    """rich wrote an empty text to it by itself, which fails where nothing is buffered."""
    code = FLAWED.format("common.print_table([{'a': 'b'}])")
    found, _, said = shell(f"'{sys.executable}' -c \"{code}\" >/dev/full", PYTHONUNBUFFERED="1")
    assert (found, said.count("\n")) == (8, 1)
    assert "standard output: No space left" in said


def test_a_reader_that_leaves():
    """As programs do that a broken pipe ends: silently, with 141."""
    assert shell(f"{PROGRAM} --help | true; exit ${{PIPESTATUS[0]}}") == (141, "", "")
    code, shown, said = shell(f"{PROGRAM} schema | cat; exit ${{PIPESTATUS[0]}}")
    assert (code, said) == (0, "")
    assert shown.endswith("}\n")


def test_files_do_not_get_the_numbers_of_closed_streams(tmp_path):
    """Or messages of libraries would be written into results."""
    path = tmp_path / "result"
    code = FLAWED.format(f"int(open({str(path)!r}, 'w').fileno() < 3)")
    assert shell(f'\'{sys.executable}\' -c "{code}" <&- >&- 2>&-')[0] == 0
    control = f"import sys; sys.exit(open({str(path)!r}, 'w').fileno() < 3)"
    assert shell(f'\'{sys.executable}\' -c "{control}" <&- >&- 2>&-')[0] == 1


@pytest.mark.parametrize("environment", [
    {"PYTHONIOENCODING": "ascii"}, {"PYTHONIOENCODING": "latin-1"}, POSIX])
def test_encodings_that_lack_characters(environment):
    """Numbers and units stay readable: a millionth is not a question mark."""
    rows = [{"what": "σ of Bx", "value": "3\u202f±\u00a01 µT, χ² 1.2"}]
    code, shown, said = shell(
        f'\'{sys.executable}\' -c "' + FLAWED.format(
            f"common.print_table({rows!a}) or common.say({'≥ 1 µT, é'!a}) or 0") + '"',
        **environment)
    assert code == 0, said
    if "latin-1" not in environment.values():
        assert said == ">= 1 uT, e\n"
        assert "| sigma of Bx | 3 +/- 1 uT, chi^2 1.2 |" in shown


def test_file_names_of_other_encodings(tmp_path):
    name = os.fsencode(tmp_path) + b"/\xe9\xb5.toml"
    for environment in ({}, POSIX):
        done = subprocess.run([sys.executable, "-m", "halbach_fe", "solve", name, "-o", name],
                              env=os.environ | environment, capture_output=True, check=False)
        assert done.returncode == 3
        assert len(done.stderr.decode().splitlines()) == 1


INTERRUPTED = """
import sys, importlib.abc, signal, os
class Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.{signal})
            {then}
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Finder())
from halbach_fe.cli import main
sys.exit(main(["solve", "no.toml", "-o", "no"]))
"""


@pytest.mark.parametrize("module", ["argparse", "halbach_fe.cli.common", "numpy", "pydantic"])
def test_ctrl_c_during_imports(module):
    code = INTERRUPTED.format(module=module, signal="SIGINT", then="")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          check=False, cwd=ROOT)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_what_a_library_makes_of_ctrl_c(capsys):
    """NumPy's own libraries say that they could not be imported."""
    def run():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except KeyboardInterrupt:
            raise ImportError("numpy.core.multiarray failed to import") from None

    assert guarded(run) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_signals_that_are_ignored_stay_ignored():
    """Or `nohup` would be in vain."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert guarded(lambda: os.kill(os.getpid(), signal.SIGHUP) or 0) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def raised(error):
    """A command that raises an error."""
    def run():
        raise error
    return run


@pytest.mark.parametrize(("error", "near", "code"), [
    (MemoryError(), False, 13), (RuntimeError("can't start new thread"), False, 13),
    (Exception("std::bad_alloc"), False, 13), (OSError(12, "Cannot allocate memory"), False, 13),
    (SystemError("error return without exception set"), True, 13),
    (SystemError("error return without exception set"), False, 1),
    (ImportError("numpy.core.multiarray failed to import"), True, 13),
    (ImportError("No module named x"), False, 1), (ZeroDivisionError(), True, 1),
    (OSError(28, "No space left on device", "/some/file"), False, 8),
    (OSError(27, "File too large"), False, 8), (OSError(22, "Invalid argument"), False, 1),
    (UnicodeEncodeError(sys.getfilesystemencoding(), "\udce9", 0, 1, "no"), False, 8),
    (UnicodeEncodeError("ascii" * 2, "\xe9", 0, 1, "no"), False, 1)])
def test_errors_of_the_machine_are_no_bugs(monkeypatch, capsys, error, near, code):
    monkeypatch.setattr(process, "_at_the_limit", lambda: near)
    assert guarded(raised(error)) == code
    said = capsys.readouterr().err
    assert ("Traceback" in said) == (code == 1)
    assert len(said.splitlines()) == 1 or code == 1
    assert "/some/file" in said or code != 8 or getattr(error, "filename", None) is None


def test_causes_count(capsys):
    """An error during the handling of which another is raised."""
    def run():
        try:
            np.empty(2**59)
        except MemoryError:
            raise ValueError("it could not be read") from None

    assert guarded(run) == 13


def test_the_limit_of_memory():
    """Far from it, and near to it."""
    code = ("import resource; from halbach_fe.cli.process import _at_the_limit; "
            "resource.setrlimit(resource.RLIMIT_AS, ({0}, {0})); print(_at_the_limit())")
    for limit, said in ((2**40, "False"), (2**28, "True")):
        done = subprocess.run([sys.executable, "-c", code.format(limit)], capture_output=True,
                              text=True, check=True)
        assert done.stdout.strip() == said


def test_every_character_has_a_spelling():
    """That is in ASCII."""
    assert all(text.isascii() for text in process.SPELLED.values())
