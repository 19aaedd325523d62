"""Reading of input files, and atomic writing: a file appears complete or not at all.

Output is written under a temporary name in the same folder and then renamed. A process that is
killed cannot remove its unfinished output. The temporary name holds the machine and the process
number, so that a later process can tell that nobody works on it any more.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import io
import os
import re
import shutil
import socket
import stat
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import cached_property
from pathlib import Path, PosixPath

from halbach_fe.core.errors import MeasurementError, OutputError, must_be

_NAME = re.compile(r"\..+~(?P<host>[^~]+)~(?P<process>\d+)~")


def temporary_name(name: str) -> str:
    """Return the first part of a file's or folder's name while this process writes it."""
    return f".{name}~{_here()}~{os.getpid()}~"


def temporary_path(path: Path) -> Path:
    """Return a path in the same folder for a file or folder while this process writes it.

    Nobody can guess it, and put a link there that leads elsewhere. Whoever creates it himself, and
    does not use the module tempfile, gives it the permissions of the user's umask.
    """
    return path.with_name(f"{temporary_name(path.stem)}{uuid.uuid4().hex[:8]}{path.suffix}")


def folder_until_exit() -> Path:
    """Return a new folder that is removed when Python ends."""
    folder = Path(tempfile.mkdtemp(prefix="halbach-fe-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def remove_orphans(folder: Path) -> None:
    """Remove unfinished output from a folder if a process of this machine that has ended left it.

    Output of processes on other machines, which may share the folder, stays.
    """
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):  # a folder of many results is looked through often
            match = _NAME.match(name) if "~" in name else None
            if match and match["host"] == _here() and not _runs(int(match["process"])):
                path = folder / name
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


def _here() -> str:
    """Return the name of the machine and of its process name space (containers have their own)."""
    with contextlib.suppress(OSError):
        return f"{socket.gethostname()}-{os.stat('/proc/self/ns/pid').st_ino}"
    return socket.gethostname()


def _runs(process: int) -> bool:
    """Tell whether a process of this number runs, as far as that can be known."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # another user's process, or an impossible number
        pass
    return True


LARGEST_STREAM_BYTES = 2**30
"""Most that is read of a pipe or device, some of which never end (/dev/zero). The largest maps that
were tried, of a million readings, have a tenth of it."""

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


def file_bytes(path: Path, where: str, workbooks: bool = False) -> bytes:
    """Return the content of a file of measurements; a workbook only if ``workbooks`` are read.

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
    if (workbook := workbook_in(raw)) is not None and not (
            workbooks and workbook == "Excel" and raw.startswith(b"PK")):
        raise MeasurementError(workbook_sentence(where, raw))
    return raw


def workbook_in(raw: bytes) -> str | None:
    """Return the name of the program whose workbook a file is; None if it is none."""
    if raw.startswith(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1") or (
            raw.startswith(b"PK\x03\x04") and b"xl/" in raw):
        return "Excel"
    if raw.startswith(b"PK\x03\x04") and b"application/vnd.oasis.opendocument" in raw[:200]:
        return "OpenDocument"
    return None


def workbook_sentence(where: str, raw: bytes) -> str:
    """Return the sentence for a workbook in place of a table of text."""
    program = workbook_in(raw)
    converted = ("; or convert a map by halbach-fe import-map, and blocks by import-blocks"
                 if program == "Excel" and raw.startswith(b"PK") else "")
    return must_be("content", where, "a table of text (CSV)", f"an {program} workbook",
                   f"Save the sheet as CSV{converted}.")


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


def is_told() -> bool:
    """Tell whether what is written now is written within a block of `telling`."""
    return _WRITING.get() is not None


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
    # A disk with less free space is full: programs that met its end have removed some of their
    # files
    full_bytes = 10_000_000
    try:
        return shutil.disk_usage(folder).free < full_bytes
    except OSError:
        return False
