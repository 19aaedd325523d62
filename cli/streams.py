"""Standard output and standard error, which may be closed, full, or lack characters."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import sys
import unicodedata
from typing import IO

from halbach_fe.core.errors import OutputError

SPELLED = {"µ": "u", "μ": "u", "°": " deg", "±": "+/-", "×": "x", "·": "*", "–": "-", "—": "-",
           "−": "-", "σ": "sigma", "χ": "chi", "φ": "phi", "π": "pi", "Δ": "Delta", "≤": "<=",
           "≥": ">=", "≈": "~", "²": "^2", "³": "^3", "√": "sqrt"}
"""What stands for a character that the encoding of a stream lacks."""


class ReaderLeftError(BrokenPipeError):
    """The program that read standard output has ended."""


def prepare() -> None:
    """Open the standard streams that are closed, and let both spell characters that they lack.

    Otherwise the next file to be opened, perhaps one of results, would get the number of the closed
    stream, and with it the messages of libraries. Writing to a closed standard output still fails.
    """
    for number, name, flag in ((0, "stdin", os.O_RDONLY), (1, "stdout", os.O_RDONLY),
                               (2, "stderr", os.O_WRONLY)):
        if getattr(sys, name) is None:
            with contextlib.suppress(OSError):
                os.fstat(number)
                continue
            os.open(os.devnull, flag)  # gets the lowest number that is free, which is this one
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8"))  # noqa: SIM115
    codecs.register_error("halbach_fe.spelled", _spelled)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="halbach_fe.spelled")


def show(text: str) -> None:
    """Print results on standard output.

    Raises
    ------
    OutputError
        If they cannot be written.
    ReaderLeftError
        If nobody reads them any more.
    """
    try:
        _write(sys.stdout, text)
    except BrokenPipeError:
        raise ReaderLeftError from None
    except OSError as error:
        raise OutputError(f"Cannot write to standard output: {error.strerror}.") from None


def say(text: str) -> None:
    """Print a message that is not a result on standard error, if that can be written to."""
    with contextlib.suppress(OSError):
        _write(sys.stderr, text + "\n")


def _write(stream: IO[str], text: str) -> None:
    """Write text at once; if that fails, discard it, or Python would try again at its end."""
    try:
        stream.write(text)
        stream.flush()
    except OSError:
        with contextlib.suppress(OSError), open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), stream.fileno())
        raise


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """Return ASCII characters for those that cannot be encoded, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(
        SPELLED.get(c) or unicodedata.normalize("NFKD", c).encode("ascii", "ignore").decode() or "?"
        for c in error.object[error.start:error.end]), error.end
