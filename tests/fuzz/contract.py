"""What every reader promises of every file, and the one check of it."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import traceback
import unicodedata
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from halbach_fe.core.errors import MAX_SENTENCE, HalbachError, HalbachWarning

TIME_LIMIT_S = 10
"""Inputs of some tens of kilobytes take milliseconds; the limit leaves room for a busy machine."""



class BrokenError(AssertionError):
    """A reader did what it must not; ``kind`` is the same for all inputs that show one defect."""

    def __init__(self, kind: str, detail: str = "") -> None:
        super().__init__(f"{kind}\n{detail}")
        self.kind = kind


@dataclass(frozen=True)
class Reader:
    """Something that opens a file."""

    name: str
    file: str
    """What the file is called, in a folder of its own."""
    seeds: tuple[bytes, ...]
    """Files as they should be, which are then damaged."""
    read: Callable[[Path], Any]
    """Reads such a file."""
    refusal: type[HalbachError] | None
    """The one error it may raise; None if it may raise none (a damaged store is as good as
    none)."""
    valid: Callable[[Any], object] = lambda read: None
    """Raises whatever it likes if what was read is not what it should be."""
    tokens: tuple[bytes, ...] = ()
    """Pieces that mean something in such files."""
    made: Callable[[Any], bytes] | None = None
    """Makes files of its own from a random generator."""


def refusal(reader: Reader, content: bytes, folder: Path) -> str:
    """Read a file of this content in a folder; return what is said against it, or nothing.

    Raises
    ------
    BrokenError
        If anything else happens: another error or warning, something printed, a file written or
        changed, more than `TIME_LIMIT_S`, an error that does not say in one sentence which file.
    """
    path = folder / reader.file
    path.write_bytes(content)
    before = _listing(folder)
    printed = io.StringIO()
    try:
        with (_no_longer_than(TIME_LIMIT_S), warnings.catch_warnings(),
              contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed)):
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", HalbachWarning)
            reader.valid(reader.read(path))
        said = ""
    except HalbachError as error:
        if reader.refusal is None or type(error) is not reader.refusal:
            raise _broken(error) from error
        said = str(error)
        _check_sentence(said, reader)
    except (Exception, SystemExit) as error:
        raise _broken(error) from error
    if printed.getvalue():
        raise BrokenError("it prints", printed.getvalue())
    if _listing(folder) != before or path.read_bytes() != content:
        raise BrokenError("it writes", f"{before} became {_listing(folder)}")
    return said


def _check_sentence(sentence: str, reader: Reader) -> None:
    kinds = {unicodedata.category(character) for character in sentence}
    if kinds & {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}:  # spaces (Zs) do nothing to a terminal
        raise BrokenError("its sentence has control characters", repr(sentence))
    if not 20 <= len(sentence) <= MAX_SENTENCE + len("..."):
        raise BrokenError(f"its sentence is too {'long' if len(sentence) > 20 else 'short'}",
                          sentence[:5000])
    if reader.file not in sentence:
        raise BrokenError("its sentence does not name the file", sentence)


def _broken(error: BaseException) -> BrokenError:
    """Named by the last line of ours, so that many inputs make one defect."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f"{Path(frame.filename).name}:{frame.name}" for frame in frames
            if "halbach_fe" in frame.filename or "fuzz" in frame.filename]
    return BrokenError(f"{type(error).__name__} in {ours[-1] if ours else '?'}",
                       "".join(traceback.format_exception(error))[-3000:])


def _listing(folder: Path) -> list[tuple[str, int]]:
    """Names and times of change, here and one level up."""
    return sorted((entry.name, 0 if entry.is_dir() else entry.stat().st_mtime_ns)
                  for place in (folder, folder.parent) for entry in os.scandir(place))


@contextlib.contextmanager
def _no_longer_than(seconds: float) -> Iterator[None]:
    def late(number: int, frame: object) -> None:
        raise TimeoutError(f"still reading after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before or signal.SIG_DFL)
