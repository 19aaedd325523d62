"""Reading of input files, and atomic writing: a file appears complete or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from halbach_fe.core.errors import MeasurementError, OutputError, must_be
from halbach_fe.core.temporary_files import remove_orphans, temporary_name


def file_bytes(path: Path, where: str) -> bytes:
    """Return the content of a file of measurements.

    Raises
    ------
    MeasurementError
        If the file cannot be read or is empty; ``where`` names it in the message.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise MeasurementError(must_be("path", where, "a readable file", f"'{error.strerror}'",
                                       "Check the path.")) from None
    if not raw.strip():
        raise MeasurementError(must_be("content", where, "a table of readings", "an empty file"))
    return raw


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` when the block succeeds.

    Raises
    ------
    OutputError
        If the file cannot be written. The temporary file is removed in every case.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_orphans(path.parent)
        handle, name = tempfile.mkstemp(prefix=temporary_name(path.stem), suffix=path.suffix,
                                        dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror}.") from None
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
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
        raise OutputError(f"Cannot make folder {folder}: {error.strerror}.") from None
    return folder


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically; raise OutputError on failure."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
