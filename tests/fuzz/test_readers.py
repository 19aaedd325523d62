"""Readers keep their promises on damaged files; see `tests.fuzz.contract`."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from halbach_fe.core.errors import GetDPError, MeasurementError
from halbach_fe.measurement.formats.import_export import READERS as FORMATS
from tests.fuzz import contract
from tests.fuzz.contract import BrokenError, Reader, refusal
from tests.fuzz.mutation import made
from tests.fuzz.readers import NAMES, by_name

INPUTS = 75
"""For each reader, the same in every run. `make fuzz` tries others, and many more."""

some = settings(max_examples=INPUTS, derandomize=True, database=None,
                suppress_health_check=list(HealthCheck))


@pytest.fixture
def folder(tmp_path):
    """A folder whose parent is watched too."""
    inside = tmp_path / "folder"
    inside.mkdir()
    return inside


def test_names_are_those_of_the_readers():
    assert [reader.name for reader in map(by_name, NAMES)] == list(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_sound_files_are_read(name, folder):
    own = {f"import as {format}": [n] for n, format in enumerate(FORMATS)}  # and others' files too
    seeds = by_name(name).seeds
    for seed in [seeds[n] for n in own.get(name, range(len(seeds)))]:
        assert refusal(by_name(name), seed, folder) == ""


@pytest.mark.parametrize("name", NAMES)
def test_damaged_files_are_read_or_refused(name, tmp_path_factory):
    reader = by_name(name)
    folder = tmp_path_factory.mktemp("above") / "folder"
    folder.mkdir()
    refused = []

    @some
    @given(random=st.randoms(use_true_random=False))
    def each(random):
        refused.append(bool(refusal(reader, made(reader, random), folder)))

    each()
    assert len(refused) >= INPUTS
    assert reader.refusal is None or any(refused)  # else nothing was damaged


def planted(read, refusal_type=MeasurementError):
    """A reader with a defect."""
    return Reader("planted", "file.txt", (b"some text, 1.5\n" * 5,), read, refusal_type)


def key_error(path):
    return {b"!": 1}[path.read_bytes()[:1]] if b"#" in path.read_bytes() else None


def writes(path):
    path.with_name("other.txt").write_text("x")


def writes_above(path):
    (path.parent.parent / "other.txt").write_text("x")


def changes(path):
    path.write_bytes(b"")


def hangs(path):
    time.sleep(60)


def refuses(sentence):
    def read(path):
        raise MeasurementError(sentence.format(path=path))
    return read


def wrong_error(path):
    raise GetDPError(f"Input content of {path} must be something else entirely.")


def says(character):
    """Past `errors.printable`."""
    def read(path):
        error = MeasurementError("x")
        error.args = (f"Input {character}[31m red of {path} must be none.",)
        raise error
    return read


def warns(path):
    import warnings

    warnings.warn("beware", UserWarning, stacklevel=2)


@pytest.mark.parametrize(("read", "kind"), [
    (key_error, "KeyError"), (writes, "it writes"), (writes_above, "it writes"),
    (changes, "it writes"), (hangs, "TimeoutError"), (wrong_error, "GetDPError"),
    (lambda path: sys.stdout.write("hello") and None, "it prints"), (warns, "UserWarning"),
    *((says(character), "control") for character in ("\x1b", "\u2028", "\u202e", "\ud800")),
    (says("\u00a0"), None),
    (refuses("Input content must be a map; instead received none."), "does not name the file"),
    (refuses(""), "too short"), (lambda path: "not valid", "IndexError"),
    (lambda path: None, None)])
def test_defects_are_found(read, kind, folder, monkeypatch):
    """The negative controls: each of these breaks one promise, and the last one none."""
    monkeypatch.setattr(contract, "TIME_LIMIT_S", 0.2)
    reader = replace(planted(read), valid=lambda found: [][0] if found else None)
    random, found = Random(1), set()
    for _ in range(300 if kind == "KeyError" else 1):
        try:
            refusal(reader, made(reader, random), folder)
        except BrokenError as error:
            found.add(error.kind)
        for left in (folder / "other.txt", folder.parent / "other.txt"):
            left.unlink(missing_ok=True)
    assert bool(found) == (kind is not None)
    assert all(kind in one for one in found)
