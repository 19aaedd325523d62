"""The errors a user can cause or meet, each with its own exit code.

One sentence pattern for all of them, so that they read alike::

    Input WHAT of WHERE must be EXPECTED; instead received GIVEN. HINT

An error of any other type that reaches the command line is a bug of ours (exit code 1).
"""

from __future__ import annotations

MAX_SENTENCE, MAX_QUOTED = 3000, 1000
"""Characters of an error, and of what it quotes, which may be a path or a list of keys."""


class HalbachError(Exception):
    """Base of every error that is reported as one sentence instead of a traceback.

    Whatever it quotes, it is one line of printable text.
    """

    exit_code = 1

    def __init__(self, sentence: str) -> None:
        super().__init__(printable(sentence, MAX_SENTENCE))


class HalbachWarning(UserWarning):
    """Something that the user should know of a result that is delivered nevertheless."""


class StudyError(HalbachError):
    """The study file cannot be read or describes something that cannot be built."""

    exit_code = 3


class MeasurementError(HalbachError):
    """A measured map or block table cannot be read, or holds what cannot have been measured."""

    exit_code = 4


class MeshError(HalbachError):
    """Gmsh could not mesh the study, or the mesh does not hold what the solve needs."""

    exit_code = 5


class PointsOutsideError(MeshError):
    """Points lie outside the meshed region."""


class GetDPNotFoundError(HalbachError):
    """No usable GetDP executable."""

    exit_code = 6


class GetDPError(HalbachError):
    """GetDP failed, or answered with something that did not pass verification."""

    exit_code = 7


class NotConvergedError(GetDPError):
    """Newton's method did not converge.

    Attributes
    ----------
    residuals : tuple of float
        Of every step of the last sample, relative to the right-hand side.
    """

    def __init__(self, message: str, residuals: tuple[float, ...]) -> None:
        super().__init__(message)
        self.residuals = residuals

    def __reduce__(self) -> tuple[type[NotConvergedError], tuple[str, tuple[float, ...]]]:
        """Errors travel from one process to another."""
        return NotConvergedError, (str(self), self.residuals)


class OutputError(HalbachError):
    """Results cannot be written, or a stored result cannot be read back."""

    exit_code = 8


class SamplingError(HalbachError):
    """A posterior was not sampled well enough to be reported."""

    exit_code = 10


class ExtraMissingError(HalbachError):
    """An optional part of the installation is needed and is not there."""

    exit_code = 11


class SchedulerError(HalbachError):
    """The Dask scheduler cannot be reached, or it and its workers failed."""

    exit_code = 12


class CheckFailedError(HalbachError):
    """A self-check ran and its figure was out of bounds."""

    exit_code = 9


OUT_OF_MEMORY = 13

EXIT_CODES: dict[int, str] = {
    0: "success",
    1: "unexpected error (a bug: please report it)",
    2: "wrong command line",
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
}


NO_BREAK_SPACES = "\u00a0\u202f"
"""Before units; Python does not count them among what can be printed."""


def printable(text: object, most: int) -> str:
    """What a terminal can print on one line without doing anything else; ? for other characters."""
    try:
        line = str(text)
    except ValueError:  # Python does not print integers of more than 4300 digits
        line = "a number of thousands of digits"
    line = line if len(line) <= most else f"{line[:most]}..."
    return "".join(c if c.isprintable() or c in NO_BREAK_SPACES else "?" for c in line)


def must_be(what: str, where: str, expected: str, received: object, hint: str = "") -> str:
    """Return the project's error sentence: what, where, what was expected, what to do."""
    sentence = (f"Input {printable(what, MAX_QUOTED)} of {where} must be {expected}; instead "
                f"received {printable(received, MAX_QUOTED)}.")
    return f"{sentence} {hint}" if hint else sentence
