"""A folder of results belongs to one command and one study, and to one run at a time.

The file run.json in the folder names both, and the results that runs have written there. A later
run of the same command and study replaces them, and removes those that it did not write again: a
table that the study no longer asks for would pass for a result of the study as it is. Another
command or study is refused. While a run goes on, it locks the file; functions of the Python
interface lock it too.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, BinaryIO

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError
from pydantic_core import from_json

from halbach_fe.core.errors import OutputError
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
    """

    model_config = ConfigDict(extra="forbid")
    command: str
    study: str
    files: dict[Annotated[str, AfterValidator(_inside)], str] = {}


@contextlib.contextmanager
def result_folder(
    folder: Path, command: str, study: str, inputs: Iterable[Path] = ()
) -> Iterator[None]:
    """Own a folder while the block writes results of a command and a study into it.

    If the block succeeds, results of earlier runs that it did not write again are removed, unless
    somebody has changed them since.

    Raises
    ------
    OutputError
        If the folder cannot be written, another run is using it, it belongs to another command or
        study, or one of the files ``inputs`` is a result in it, which this run would replace.
    """
    base = folder.absolute()
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
            _write(file, record)

        with telling(note):
            try:
                yield
            except BrokenPipeError:  # nobody reads what is printed, but all files are written
                remove_stale()
                raise
        remove_stale()


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
