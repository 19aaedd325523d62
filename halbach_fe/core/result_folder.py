"""A folder of results belongs to one command and one study, and to one run at a time.

The file run.json in the folder names both, what the run read, and the results that runs have
written there. A later run of the same command and study replaces them, and removes those that it
did not write again: a table that the study no longer asks for would pass for a result of the study
as it is. Another command or study is refused. While a run goes on, it locks the file; functions of
the Python interface lock it too.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatch
from io import BufferedReader
from pathlib import Path
from typing import Annotated, BinaryIO

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError
from pydantic_core import from_json

from halbach_fe.core.errors import MAX_QUOTED, OutputError, must_be, printable
from halbach_fe.core.files import make_folder, telling

RECORD = "run.json"

KEPT = ("*.msh", "*regions.json", "response.h5", "response-*.npy", "chains.nc")
"""Files that a later run may read instead of writing them again; each is verified when it is."""


_HELD: ContextVar[tuple[Path, ...]] = ContextVar("held", default=())
"""The folders that this run, or this thread, has locked."""


def _inside(name: str) -> str:
    """Return the path of a file, relative to the folder of results, if it is inside of it."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise ValueError("not in the folder")
    return name


class Record(BaseModel):
    """The content of run.json.

    Attributes
    ----------
    command, study : str
        What the folder belongs to; ``study`` is empty for a command without a study.
    files : dict of str to str
        SHA-256 of every result, by its path within the folder.
    inputs : dict of str to str
        SHA-256 of every file that the run was given, by its path.
    named : dict of str to str
        Path of an input by the word that stands for it in commands: STUDY, MAP, BLOCKS, POSTERIOR.
    ended : str
        When the run ended, in ISO 8601 (UTC); empty until it has ended well.
    """

    model_config = ConfigDict(extra="forbid")
    command: str
    study: str
    files: dict[Annotated[str, AfterValidator(_inside)], str] = {}
    inputs: dict[str, str] = {}
    named: dict[str, str] = {}
    ended: str = ""


@dataclass(frozen=True)
class Results:
    """The results of a run that has ended.

    Attributes
    ----------
    folder : Path
    record : Record
    """

    folder: Path
    record: Record

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return the content of a result.

        Raises
        ------
        OSError
            If the file cannot be read.
        ValueError
            If it is no result of the run, lies behind a link, or is larger than ``most_bytes``.
        """
        if name not in self.record.files:
            raise ValueError(f"{name} is no result of this run")
        if not (self.folder / name).resolve().is_relative_to(self.folder.resolve()):
            raise ValueError(f"{name} is not in the folder")
        with _regular(self.folder / name) as file:
            content = file.read(most_bytes + 1)
        if len(content) > most_bytes:
            raise ValueError(f"it has more than {most_bytes} bytes")
        return content

    def changed(self) -> list[str]:
        """Return the results that somebody has changed, or put something else in place of."""
        found = []
        for name, digest in self.record.files.items():
            try:
                with _regular(self.folder / name) as file:
                    same = hashlib.file_digest(file, "sha256").hexdigest() == digest
            except FileNotFoundError:  # it was removed
                continue
            except (OSError, ValueError):
                same = False
            if not same:
                found.append(name)
        return found


@contextlib.contextmanager
def result_folder(
    folder: Path, command: str, study: str, inputs: Iterable[Path] = (),
    named: Mapping[str, Path] = {},
) -> Iterator[None]:
    """Own a folder while the block writes results of a command and a study into it.

    ``named`` are those of the inputs that commands name, see `Record`.

    If the block succeeds, results of earlier runs that it did not write again are removed, unless
    somebody has changed them since.

    Raises
    ------
    OutputError
        If the folder cannot be written, another run is using it, it belongs to another command or
        study, or one of the files ``inputs`` is a result in it, which this run would replace.
    """
    base, inputs = folder.absolute(), list(inputs)
    with _locked(folder) as file:
        before = _read(file)
        if before is None and _is_json(file):
            raise OutputError(f"File {folder / RECORD} is not one of halbach-fe, which would "
                              "replace it. Name another folder, or remove this file.")
        if before is None or not any((folder / name).exists() for name in before.files):
            before = Record(command=command, study=study)
        if (before.command, before.study) != (command, study):
            of_study = f" of study {before.study}" if before.study else ""
            raise OutputError(
                f"Folder {folder} holds results of `{before.command}`{of_study}. A folder belongs "
                "to one command and one study, so that results are not mixed up. Name another "
                "folder, or remove this one.")
        for path in inputs:
            if any(path.resolve() == (base / name).resolve() for name in before.files):
                raise OutputError(
                    f"Input {path} is a result of an earlier run in folder {folder}, which this "
                    "run would replace. Name another folder, or copy the input to another place.")
        record, written = before.model_copy(deep=True), set[str]()
        record.inputs, record.ended = _inputs(inputs), ""
        record.named = {word: printable(path, MAX_QUOTED) for word, path in named.items()}
        _write(file, record)

        def note(path: Path) -> None:
            path = path.absolute()
            kept = any(fnmatch(path.name, pattern) for pattern in KEPT)
            if path.is_relative_to(base) and not kept and (digest := _digest(path)):
                record.files[str(path.relative_to(base))] = digest
                written.add(str(path.relative_to(base)))
                _write(file, record)

        def remove_stale() -> None:
            for name in record.files.keys() - written:
                if _digest(base / name) == record.files.pop(name):  # else somebody has changed it
                    (base / name).unlink(missing_ok=True)
            record.ended = datetime.now(UTC).isoformat(timespec="seconds")
            _write(file, record)

        with telling(note):
            try:
                yield
            except BrokenPipeError:  # nobody reads what is printed, but all files are written
                remove_stale()
                raise
        remove_stale()


@contextlib.contextmanager
def finished_results(folder: Path) -> Iterator[Results]:
    """Yield the results in a folder, and keep runs out of it while the block reads them.

    Raises
    ------
    OutputError
        If it is no folder of results, a run is using it, or its last run has not ended well.
    """
    def refused(expected: str, received: str, hint: str) -> OutputError:
        return OutputError(must_be("DIR", "the report", expected, f"{folder}, {received}", hint))

    expected, leave = f"a folder of results, with {RECORD}", "Leave it out."
    if not folder.is_dir():
        raise refused(expected, "a file" if folder.exists() else "which does not exist", leave)
    try:
        number = os.open(folder / RECORD,
                         os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise refused(expected, f"which has no {RECORD}", leave) from None
    except OSError as error:
        raise refused(expected, f"whose {RECORD} cannot be read ({error.strerror})",
                      leave) from None
    with os.fdopen(number, "rb") as file:
        try:
            fcntl.flock(number, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f"Folder {folder} is in use by a run of halbach-fe. Wait for it, or "
                              "leave it out.") from None
        except OSError:  # this file system has no locks
            pass
        regular = stat.S_ISREG(os.fstat(number).st_mode)
        record = _read(file) if regular else None
        if record is None:
            raise refused(expected, f"whose {RECORD} is damaged or of another program", leave)
        if not record.ended:
            raise refused("the results of a run that has ended",
                          f"where `{record.command}` failed, was killed, or is of an earlier "
                          "version", "Run it again, or leave it out.")
        yield Results(folder, record)


def keep_results(path: Path) -> None:
    """Refuse to write a file over a result of a run.

    Raises
    ------
    OutputError
    """
    for folder in path.absolute().parents:
        try:
            with _regular(folder / RECORD) as file:
                record = _read(file)
        except (OSError, ValueError):
            continue
        if record and str(path.absolute().relative_to(folder)) in record.files:
            raise OutputError(f"File {path} is a result of `{record.command}`, which this run "
                              "would replace. Name another file.")


def named_inputs(folder: Path) -> dict[str, Path]:
    """Return the files that the run in a folder was given, by the words for them in commands.

    Files that are not there any more, or have changed, are left out; so are all of a folder whose
    record cannot be read.
    """
    try:
        with _regular(folder / RECORD) as file:
            record = _read(file)
    except (OSError, ValueError):
        return {}
    return {} if record is None else {
        word: Path(path) for word, path in record.named.items()
        if path in record.inputs and _digest(Path(path)) == record.inputs[path]}


def inputs_behind(path: Path) -> dict[str, str]:
    """Return the SHA-256 of what the run has read that wrote a file, by path; not its study.

    It is empty if the record of the file's folder does not have the file as it is.
    """
    try:
        with _regular(path.parent / RECORD) as file:
            record = _read(file)
    except (OSError, ValueError):
        return {}
    digest = next(iter(_inputs([path]).values()), None)
    if record is None or digest is None or record.files.get(path.name) != digest:
        return {}
    return {name: found for name, found in record.inputs.items()
            if name != record.named.get("STUDY")}


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder while the block writes into it.

    Unlike `result_folder`, it leaves no record. A folder inside one that this run has locked
    belongs to it.

    Raises
    ------
    OutputError
        If another run, or another thread of this process, is using the folder.
    """
    whole = folder.resolve()
    if any(whole.is_relative_to(held) for held in _HELD.get()):
        yield
    else:
        with _locked(folder):
            yield


def _inputs(paths: Iterable[Path]) -> dict[str, str]:
    """Return the SHA-256 of what was read of files, by their paths."""
    found = {}
    for path in paths:
        with contextlib.suppress(OSError):  # whoever reads it says what is wrong
            found[printable(path, MAX_QUOTED)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


@contextlib.contextmanager
def _regular(path: Path) -> Iterator[BufferedReader]:
    """Open a regular file that is no link; raise OSError or ValueError if it is none."""
    number = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(number, "rb") as file:
        if not stat.S_ISREG(os.fstat(number).st_mode):
            raise ValueError("it is no file")
        yield file


def _digest(path: Path) -> str | None:
    """Return the SHA-256 of a file; None if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[BinaryIO]:
    """Make a folder, and open and lock its record.

    Afterwards the record is removed if nothing is recorded, and so is the folder, if it was made
    for this and is empty.
    """
    made, path = not folder.exists(), make_folder(folder) / RECORD
    with _opened(path) as file:
        token = _HELD.set((*_HELD.get(), folder.resolve()))
        try:
            yield file
        finally:
            _HELD.reset(token)
            record = _read(file)
            if not (record.files if record else os.fstat(file.fileno()).st_size):
                path.unlink(missing_ok=True)
                with contextlib.suppress(OSError):
                    if made:
                        folder.rmdir()


def _opened(path: Path) -> BinaryIO:
    """Open and lock a file, which is created if it does not exist."""
    while True:
        try:
            number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise OutputError(f"Cannot write {path}: {error.strerror}.") from None
        file = os.fdopen(number, "r+b")
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise OutputError(f"Folder {path.parent} is in use by another run of halbach-fe. Wait "
                              "for it, or name another folder.") from None
        except OSError:  # this file system has no locks
            return file
        if os.fstat(number).st_nlink:  # else a run that ended meanwhile has removed it
            return file
        file.close()


def _read(file: BinaryIO) -> Record | None:
    """Return the record in a file; None if it is new, or cannot be read."""
    file.seek(0)
    try:
        return Record.model_validate_json(file.read())
    except ValidationError:
        return None


def _is_json(file: BinaryIO) -> bool:
    """Tell whether a file is JSON, which a record is not if its run was killed as it wrote it."""
    file.seek(0)
    try:
        from_json(file.read())
    except ValueError:
        return False
    return True


def _write(file: BinaryIO, record: Record) -> None:
    """Write the record in its place: a renamed file would lose the lock."""
    try:
        file.seek(0)
        file.write(record.model_dump_json(indent=1).encode() + b"\n")
        file.truncate()
        file.flush()
    except OSError as error:
        raise OutputError(f"Cannot write {file.name}: {error.strerror}.") from None
