"""Reading of input files, and atomic writing: a file appears complete or not at all."""

from __future__ import annotations

import errno
import io
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import cached_property
from pathlib import Path, PosixPath

from halbach_fe.core.errors import MeasurementError, OutputError, must_be
from halbach_fe.core.temporary_files import remove_orphans, temporary_path

LARGEST_STREAM_BYTES = 2**30
"""Most that is read of a pipe or device, some of which never end (/dev/zero). The largest maps that
were tried, of a million readings, have a tenth of it."""

FULL_BYTES = 10_000_000
"""A disk with less free space is full: programs that met its end have removed some of their files.
"""

Writing = Callable[[Path, Path], AbstractContextManager[None]]
"""A context in which a complete temporary file, the second path, is renamed to the first."""

_WRITING: ContextVar[Writing | None] = ContextVar("writing", default=None)
"""The context of `telling`, if there is one."""


class InputFile(PosixPath):
    """The path of a file that is read once, however often its content is asked for.

    So what provenance hashes, and what an edited copy of a study starts from, is what was used,
    even if the file changes meanwhile. A pipe, which can be read once only, is a file like others.

    Examples
    --------
    >>> file = InputFile("dipole.toml")
    >>> file.read_text("utf-8") == file.read_bytes().decode("utf-8")
    True
    """

    @cached_property
    def _content(self) -> bytes:
        with self.open("rb") as file:
            if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                return file.read()
            content = file.read(LARGEST_STREAM_BYTES + 1)
        if len(content) > LARGEST_STREAM_BYTES:
            raise OSError(errno.EFBIG, f"A pipe or device of more than "
                          f"{LARGEST_STREAM_BYTES / 2**30:g} GiB", str(self))
        return content

    def read_bytes(self) -> bytes:
        """Return the content as it was when it was first asked for."""
        return self._content

    def read_text(self, encoding: str | None = None, errors: str | None = None) -> str:
        """Return the content as text."""
        return io.TextIOWrapper(io.BytesIO(self._content), encoding, errors).read()


def as_path(path: str | Path) -> Path:
    """Return a path of text as a path; an `InputFile` stays one, with what it has read."""
    return path if isinstance(path, Path) else Path(path)


def file_bytes(path: Path, where: str) -> bytes:
    """Return the content of a file of measurements.

    Raises
    ------
    MeasurementError
        If the file cannot be read or is empty; ``where`` names it in the message.
    """
    if path.suffix == ".toml":
        raise MeasurementError(must_be(
            "path", where, "a file of measurements", "a study", "halbach-fe solve STUDY writes its "
            "field, as field_map.csv; halbach-fe export STUDY --format blocks its blocks."))
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise MeasurementError(must_be("path", where, "a readable file", f"'{error.strerror}'",
                                       "Check the path.")) from None
    if not raw.strip():
        raise MeasurementError(must_be("content", where, "a table of readings", "an empty file"))
    if (workbook := workbook_in(raw)) is not None:
        raise MeasurementError(workbook_sentence(where, workbook))
    return raw


def workbook_in(raw: bytes) -> str | None:
    """Return the name of the program whose workbook a file is; None if it is none."""
    if raw.startswith(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1") or (
            raw.startswith(b"PK\x03\x04") and b"xl/" in raw):
        return "Excel"
    if raw.startswith(b"PK\x03\x04") and b"application/vnd.oasis.opendocument" in raw[:200]:
        return "OpenDocument"
    return None


def workbook_sentence(where: str, program: str) -> str:
    """Return the sentence for a workbook in place of a table of text."""
    return must_be("content", where, "a table of text (CSV)", f"an {program} workbook",
                   "Save the sheet as CSV.")


@contextmanager
def telling(writing: Writing) -> Iterator[None]:
    """Rename every file that `atomic` writes within the block in a context, which may refuse it.

    Examples
    --------
    >>> @contextmanager
    ... def said(path: Path, temporary: Path) -> Iterator[None]:
    ...     print(path.name, temporary.read_text())
    ...     yield
    >>> with telling(said):
    ...     write_text(Path("note.txt"), "text")
    note.txt text
    """
    token = _WRITING.set(writing)
    try:
        yield
    finally:
        _WRITING.reset(token)


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` when the block succeeds.

    A link at ``path`` is replaced, not followed, unless `telling` refuses it. Who may read the file
    depends on the umask.

    Raises
    ------
    OutputError
        If the file cannot be written. The temporary file is removed in every case.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_orphans(path.parent)
        temporary = temporary_path(path)
        temporary.open("xb").close()
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror}.") from None
    writing = _WRITING.get()
    try:
        yield temporary
        with writing(path, temporary) if writing else nullcontext():
            temporary.replace(path)
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}.") from None
    finally:
        temporary.unlink(missing_ok=True)


def _write_bytes(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def make_folder(folder: Path) -> Path:
    """Create a folder and its parents where they do not exist; raise OutputError on failure."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        hint = (" It is a file; name a folder, which is made if there is none."
                if folder.is_file() else "")
        raise OutputError(f"Cannot make folder {folder}: {error.strerror}.{hint}") from None
    return folder


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically; raise OutputError on failure.

    Bytes that are no UTF-8, which names of files may contain, become ``?``.
    """
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="replace")


def is_full(folder: Path) -> bool:
    """Tell whether the disk of a folder has no room left, as far as that can be known."""
    try:
        return shutil.disk_usage(folder).free < FULL_BYTES
    except OSError:
        return False
