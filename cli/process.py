"""The process of a command: exit codes, signals, want of memory, and the standard streams, which
may be closed, full, or lack characters.
"""

from __future__ import annotations

import codecs
import errno
import io
import mmap
import os
import re
import resource
import signal
import sys
import traceback
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Set
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from types import FrameType
from typing import IO

from halbach_fe.core.errors import (
    MAX_QUOTED,
    OUT_OF_MEMORY,
    READER_LEFT,
    HalbachError,
    HalbachWarning,
    OutputError,
    printable,
)

SHORT_WAIT = "4"
"""Logarithm to base 2 of the processor cycles for which threads of OpenBLAS look for more work
before they sleep: the least that it allows. By default they look for 30 ms, on the cores on which
threads of the other OpenBLAS, of numba and GetDP compute. Beside another job on two cores a
diagnosis of 192 blocks took 40 s instead of 31 s, and 47 s instead of 31 s of processor time."""

NO_MEMORY = re.compile(
    r"bad_alloc|allocat|out of memory|failed to map segment|can't start new thread")
"""Texts of libraries whose errors are not MemoryError: they could not be loaded, start a thread, or
allocate memory."""

PATIENCE_S = 5.0
"""Time in s that a command has to end after a signal. GetDP and the processes of a pool take less
than one."""

OF_THE_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.ESTALE,
               errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.ENAMETOOLONG}
"""Errors of the system for which halbach-fe is not to blame, wherever they come from."""


def guarded(run: Callable[[], int]) -> int:
    """Call a function and return its exit code; print errors as a single sentence on stderr.

    SIGTERM and the closing of the terminal act like Ctrl-C: GetDP is stopped, and no result is left
    half-written. Signals that are ignored (by nohup, or as a shell's background job) stay ignored.
    A library that does not return to Python, as Gmsh for minutes, is ended after `PATIENCE_S`.
    """
    prepare()
    os.environ["MPLBACKEND"] = "agg"  # a notebook's, which may not exist here, would be imported
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", SHORT_WAIT)
    received: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    previous = {number: signal.signal(number, interrupt)
                for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
                if signal.getsignal(number) is not signal.SIG_IGN}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", HalbachWarning)
            warnings.showwarning = _say_once(set())
            claim_buffers()  # before there is a thread, which takes memory for its own
            with _ended_in_time(set(previous)):
                return run()
    except (Exception, KeyboardInterrupt) as error:
        if received:  # libraries that are interrupted may raise errors of their own
            say("interrupted")
            return 130
        return _exit_code(error)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def _ended_in_time(numbers: Set[int]) -> Iterator[None]:
    """End this process `PATIENCE_S` after one of some signals, unless the block ends before.

    Python calls handlers of signals between its own instructions only. Its wake-up file gets the
    number of a signal at once, and a thread reads it there. What is being written has a temporary
    name, and GetDP ends without its parent: the process may end as if it were killed.
    """
    stop = 0  # no signal's number: it ends the thread that reads them
    ended, (reading, writing) = Event(), os.pipe()
    os.set_blocking(writing, False)

    def wait() -> None:
        while (number := os.read(reading, 1)[0]) != stop:
            if number in numbers and not ended.wait(PATIENCE_S):
                say("interrupted")
                os._exit(130)

    thread = Thread(target=wait, daemon=True)
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before)
        os.write(writing, bytes([stop]))
        thread.join()
        os.close(reading)
        os.close(writing)


def _say_once(said: set[str]) -> Callable[..., None]:
    """Return what shows a warning; the filter "once" forgets at any change of the filters."""
    def show(message: Warning | str, *_: object) -> None:
        if str(message) not in said:
            said.add(str(message))
            say(f"warning: {message}")

    return show


def _exit_code(error: BaseException) -> int:
    """Say what is wrong, and return the exit code for it."""
    if isinstance(error, HalbachError):
        say(f"error: {error}")
        return error.exit_code
    if isinstance(error, KeyboardInterrupt):
        say("interrupted")
        return 130
    if isinstance(error, ReaderLeftError):
        return READER_LEFT
    if any(map(_is_out_of_memory, _with_causes(error))):
        reason = printable(str(error) or "it ran out", MAX_QUOTED)
        say(f"error: There is not enough memory ({reason}). --dry-run estimates what solve, infer "
            "and verify need; use a coarser mesh, fewer readings or --jobs 1.")
        return OUT_OF_MEMORY
    if isinstance(error, OSError) and error.errno in OF_THE_DISK:
        what = f" ({printable(error.filename, MAX_QUOTED)})" if error.filename else ""
        say(f"error: A file cannot be used: {error.strerror}{what}.")
        return OutputError.exit_code
    if isinstance(error, UnicodeEncodeError) and error.encoding == sys.getfilesystemencoding():
        say(f"error: The file name {printable(error.object, MAX_QUOTED)!a} cannot be written in "
            f"the encoding {error.encoding} of this locale; set LC_ALL=C.UTF-8.")
        return OutputError.exit_code
    say("".join(traceback.format_exception(error)).rstrip())
    say("error: this is a bug in halbach-fe; please report it with the above.")
    return 1


def _with_causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error, and those during which it was raised."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _is_out_of_memory(error: BaseException) -> bool:
    """Tell whether an error means that memory ran out, which not only MemoryError does."""
    return (isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
            or NO_MEMORY.search(str(error)) is not None
            or type(error).__name__ == "BrokenProcessPool"  # the system ended one of its processes
            or (isinstance(error, SystemError | ImportError) and _at_the_limit()))


def _at_the_limit() -> bool:
    """Tell whether this process has come near to the limit of its memory, if it has one."""
    # An import that fails so near to the limit of memory fails for want of it: the largest library,
    # numba's LLVM, takes half of this.
    at_the_limit_bytes = 256 * 2**20
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return False
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak = re.search(r"VmPeak:\s*(\d+) kB", status)
    return peak is None or limit - int(peak[1]) * 1024 < at_the_limit_bytes


def claim_buffers() -> None:
    """If the memory of this process is limited, have OpenBLAS allocate its buffers now.

    OpenBLAS keeps its buffers. If it cannot allocate them, it retries forever or ends the process;
    so the memory for them, and for the libraries themselves, is asked for here first.

    Raises
    ------
    MemoryError
        If there is not enough for the buffers.
    """
    # What two OpenBLAS libraries, numpy's and scipy's, allocate at their first use, 32 MiB by
    # thread and library on two threads; and what loading numpy 2.3 and scipy 1.16 maps, 178 MiB.
    blas_buffer_bytes = 128 * 2**20
    library_bytes = 0 if "scipy.linalg" in sys.modules else 180 * 2**20
    if resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY:
        try:
            mmap.mmap(-1, blas_buffer_bytes + library_bytes).close()
        except OSError:
            raise MemoryError("the limit leaves too little for the linear algebra") from None
        import numpy as np
        import scipy.linalg as linalg

        matrix = np.eye(200)
        linalg.cholesky(matrix @ matrix)  # numpy and scipy each have their own OpenBLAS


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
            with suppress(OSError):
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
    with suppress(OSError):
        _write(sys.stderr, text + "\n")


def _write(stream: IO[str], text: str) -> None:
    """Write text at once; if that fails, discard it, or Python would try again at its end."""
    try:
        stream.write(text)
        stream.flush()
    except OSError:
        with suppress(OSError), open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), stream.fileno())
        raise


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """Return ASCII characters for those that cannot be encoded, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(
        SPELLED.get(c) or unicodedata.normalize("NFKD", c).encode("ascii", "ignore").decode() or "?"
        for c in error.object[error.start:error.end]), error.end
