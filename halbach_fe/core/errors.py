"""The errors that a user can cause or meet, each with its own exit code.

Errors of input share one sentence pattern (see `must_be`)::

    Input WHAT of WHERE must be EXPECTED; instead received GIVEN. HINT

An error of any other type that reaches the command line is a bug of halbach-fe (exit code 1).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

MAX_SENTENCE, MAX_QUOTED = 3000, 1000
"""Largest numbers of characters of an error message, and of each text that it quotes (a path or a
list of keys, for example)."""


class HalbachError(Exception):
    """Base of all errors that are reported as one sentence instead of a traceback.

    The message is always one line of printable text, even if it quotes a hostile input.

    Attributes
    ----------
    exit_code : int
        Exit code of the command line for this kind of error; every subclass has its own.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> try:
    ...     hf.read_study("missing.toml")
    ... except hf.HalbachError as error:
    ...     print(type(error).__name__, error.exit_code)
    StudyError 3
    """

    exit_code = 1

    def __init__(self, sentence: str) -> None:
        super().__init__(printable(sentence, MAX_SENTENCE))


class HalbachWarning(UserWarning):
    """A warning about a result that is delivered nevertheless."""


class CommandLineError(HalbachError):
    """Options of a command line contradict each other, or one of them would be without effect."""

    exit_code = 2


class StudyError(HalbachError):
    """The study file cannot be read or describes something that cannot be built."""

    exit_code = 3


class MeasurementError(HalbachError):
    """A measured map or block table cannot be read, or holds values that no measurement gives."""

    exit_code = 4


class MeshError(HalbachError):
    """Gmsh could not mesh the study, or the mesh lacks regions that the solve needs."""

    exit_code = 5


class PointsOutsideError(MeshError):
    """Points lie outside the meshed region, where GetDP would print zeros.

    Attributes
    ----------
    study : str
        Name of the study, or of the other object that was meshed.
    reason : str
        End of the sentence: the limits of the meshed region, and the points outside of it.
    """

    def __init__(self, study: str, reason: str) -> None:
        self.study, self.reason = study, reason
        super().__init__(self.sentence(f"`observation.positions` of study {study}"))

    def sentence(self, source: str) -> str:
        """Return the sentence for points that come from ``source``: a key of the study, a map."""
        return (f"Input {source} must lie within the meshed region {self.reason} Check the units "
                "of the points, or enlarge `open_boundary`.")

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling, see `GetDPError`."""
        return PointsOutsideError, (self.study, self.reason)


class GetDPNotFoundError(HalbachError):
    """No usable GetDP executable was found."""

    exit_code = 6


class GetDPError(HalbachError):
    """GetDP failed, or its output did not pass verification.

    Attributes
    ----------
    log : Path or None
        Log of the run; code that moves the run folder has to update this path.
    """

    exit_code = 7

    def __init__(self, sentence: str, log: Path | None = None) -> None:
        super().__init__(sentence)
        self.sentence = super().__str__()
        self.log = log

    def __str__(self) -> str:
        """The sentence, followed by the place of the log if it is known."""
        if self.log is None:
            return self.sentence
        return f"{self.sentence} Its log is {printable(self.log, MAX_QUOTED)}."

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling: the error travels from worker processes to the main process."""
        return type(self), (self.sentence, self.log)


class ColumnsError(GetDPError):
    """The fields of single blocks do not add up to that of the whole array."""


class NotConvergedError(GetDPError):
    """Newton's method did not converge.

    Attributes
    ----------
    residuals : tuple of float
        Residual of every Newton step of the last sample, relative to the right-hand side.
    """

    def __init__(
        self, sentence: str, residuals: tuple[float, ...], log: Path | None = None
    ) -> None:
        super().__init__(sentence, log)
        self.residuals = residuals

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling, see `GetDPError`."""
        return NotConvergedError, (self.sentence, self.residuals, self.log)


class OutputError(HalbachError):
    """Results cannot be written, or a stored result cannot be read back."""

    exit_code = 8


class SamplingError(HalbachError):
    """The Markov chains did not converge well enough for the posterior to be reported."""

    exit_code = 10


class ExtraMissingError(HalbachError):
    """An optional dependency is needed but not installed."""

    exit_code = 11


class SchedulerError(HalbachError):
    """The Dask scheduler cannot be reached, or the scheduler or its workers failed."""

    exit_code = 12


class CheckFailedError(HalbachError):
    """A self-check ran, and its result was outside the accepted limits."""

    exit_code = 9


OUT_OF_MEMORY = 13
"""Exit code if memory runs out; Python raises MemoryError, so no class above stands for it."""

READER_LEFT = 141
"""Exit code if the reader of standard output has ended, that of a program ended by SIGPIPE."""

EXIT_CODES: dict[int, str] = {
    0: "success",
    1: "unexpected error (a bug: please report it)",
    CommandLineError.exit_code: "wrong command line",
    StudyError.exit_code: "study file refused",
    MeasurementError.exit_code: "measured map or block table refused",
    MeshError.exit_code: "mesh could not be built or verified",
    GetDPNotFoundError.exit_code: "GetDP not found",
    GetDPError.exit_code: "GetDP failed or its answer did not pass verification",
    OutputError.exit_code: "results could not be written or read back",
    CheckFailedError.exit_code: "a self-check failed",
    SamplingError.exit_code: "the posterior was not sampled well enough",
    ExtraMissingError.exit_code: "an optional part is not installed",
    SchedulerError.exit_code: "the Dask scheduler or its workers failed",
    OUT_OF_MEMORY: "not enough memory",
    130: "interrupted (Ctrl-C)",
    READER_LEFT: "nobody read the output to its end (broken pipe)",
}


NO_BREAK_SPACES = "\u00a0\u202f"
"""Spaces that separate numbers from units. `str.isprintable` is False for them."""


def printable(text: object, most: int) -> str:
    """Return text as one line of at most ``most`` characters that is safe to print on a terminal.

    ``?`` replaces control characters, which could otherwise act on the terminal.
    """
    try:
        line = str(text)
    except ValueError:  # Python does not print integers of more than 4300 digits
        line = "a number of thousands of digits"
    line = line if len(line) <= most else f"{line[:most]}..."
    return "".join(c if c.isprintable() or c in NO_BREAK_SPACES else "?" for c in line)


def not_utf8(where: str, error: UnicodeDecodeError) -> str:
    """Return the error sentence about a file that is not text in UTF-8."""
    return must_be("encoding", where, "UTF-8",
                   f"byte 0x{error.object[error.start]:02x} at {error.start}",
                   "Save it as UTF-8 text.")


def must_be(what: str, where: str, expected: str, received: object, hint: str = "") -> str:
    """Return an error sentence: which input, where, what was expected, received, and what to do."""
    sentence = (f"Input {printable(what, MAX_QUOTED)} of {where} must be {expected}; instead "
                f"received {printable(received, MAX_QUOTED)}.")
    return f"{sentence} {hint}" if hint else sentence
