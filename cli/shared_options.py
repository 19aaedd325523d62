"""How a verb is declared, options that several verbs share, and the numbers that they take.

Modules of the command line import little at their top, so that help and completion appear without
delay. Functions that compute something import the modules that they need themselves.
"""

from __future__ import annotations

import argparse
import inspect
import math
import os
import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from halbach_fe.cli.process import say, show
from halbach_fe.core.errors import EXIT_CODES, MAX_QUOTED, printable
from halbach_fe.core.files import InputFile
from halbach_fe.core.installation import version
from halbach_fe.core.numbers import HIGHEST_ORDER, LIMIT_PPM, LIMIT_UNITS
from halbach_fe.measurement.formats.declared_format import (
    DELIMITERS,
    FORMATS,
    UNKNOWN,
    DeclaredFormat,
)
from halbach_fe.measurement.formats.units import (
    ANGLES,
    FIELDS,
    KINDS,
    LENGTHS,
    kind_of,
    unit_symbol,
)

AXES = ("x", "y", "z")
"""As `halbach_fe.study.types.COMPONENTS`, whose module takes long to import."""

Number = TypeVar("Number", int, float)
Declared = TypeVar("Declared", bound=DeclaredFormat)
Options = Callable[[Any], object]
"""What adds options to the parser of a verb."""

Run = Callable[[argparse.Namespace], int]

GETDP_LIMIT_S = 3600.0
"""Time limit of each GetDP process, unless another is asked for."""


@dataclass(frozen=True)
class Verb:
    """A verb of the command line."""

    text: str
    """Its help."""
    options: tuple[Options, ...]
    run: Run
    """Function that runs it and returns its exit code."""


VERBS: dict[str, Verb] = {}
"""All verbs by name; `halbach_fe.cli.verbs` imports the modules that declare them."""

MOST_NEEDED = "new", "explain", "solve", "infer", "diagnose"
"""The verbs that most people need; the help names them first."""


def verb(*options: Options) -> Callable[[Run], Run]:
    """Declare a function as the verb of its name, whose help is the function's docstring."""
    def declared(run: Run) -> Run:
        VERBS[run.__name__.replace("_", "-")] = Verb(inspect.getdoc(run) or "", options, run)
        return run

    return declared


def option(
    names: str, kind: Callable[[str], Any], metavar: str | tuple[str, ...] | None, text: str,
    **settings: Any,
) -> Options:
    """Return an option with a value: its names, how that is parsed and called, and its help."""
    return lambda parser: parser.add_argument(*names.split(), type=kind, metavar=metavar, help=text,
                                              **settings)


def flag(name: str, text: str) -> Options:
    """Return an option without a value, and its help."""
    return lambda parser: parser.add_argument(name, action="store_true", help=text)


def choice(name: str, words: Collection[str], text: str, **settings: Any) -> Options:
    """Return an option whose value is one of some words, and its help."""
    return lambda parser: parser.add_argument(name, choices=words, help=text, **settings)


def together(*options: Options) -> Options:
    """Return several options as one."""
    return lambda parser: [each(parser) for each in options]


def either(*options: Options) -> Options:
    """Return several options of which one may be given."""
    return lambda parser: together(*options)(parser.add_mutually_exclusive_group())


class Once(argparse.Action):
    """An option with a value. It is refused if it is given twice, as only the last would count."""

    given = False

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        """Store the value."""
        if self.given:
            raise argparse.ArgumentError(self, "is given twice; leave one out")
        self.given = True
        setattr(namespace, self.dest, values)


class Parser(argparse.ArgumentParser):
    """A parser whose help says so if it cannot be printed, and whose options are given once."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.register("action", None, Once)

    def _print_message(self, message: str, file: Any = None) -> None:
        if file is sys.stdout:
            show(message)
        else:
            say(message.removesuffix("\n"))


def parser(verbs: Collection[str] = VERBS) -> argparse.ArgumentParser:
    """Return the parser of the command line, with the options of some verbs.

    Of all other verbs it has only the help text: some options import large libraries.
    """
    codes = "\n".join(f"  {code:3d}  {meaning}" for code, meaning in EXIT_CODES.items())
    top = Parser(
        prog="halbach-fe", description="Finite elements and Bayesian inference for Halbach arrays."
        f"\n\nMost people need {', '.join(MOST_NEEDED[:-1])} and {MOST_NEEDED[-1]}.",
        epilog=f"exit codes:\n{codes}", formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument("--version", action="version", version=version("halbach-fe"))
    subparsers = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name in dict.fromkeys((*MOST_NEEDED, *VERBS)):
        one = VERBS[name]
        added = subparsers.add_parser(name, help=one.text.splitlines()[0], description=one.text,
                                      formatter_class=argparse.RawDescriptionHelpFormatter)
        if name in verbs:
            together(*one.options)(added)
    return top


def orders(text: str) -> tuple[int, ...]:
    """Parse orders of multipoles: ``2..10``, ``3,5,7``, or both."""
    numbers = set[int]()
    for part in text.split(","):
        first, dots, last = part.partition("..")
        ends = [first, last if dots else first]
        if not all(end.isdecimal() and 1 <= int(end[:9]) <= HIGHEST_ORDER for end in ends) or (
                int(ends[0]) > int(ends[1])):
            raise argparse.ArgumentTypeError(
                f"must be orders from 1 to {HIGHEST_ORDER}, such as 2..10 or 3,5,7, not "
                f"{printable(text, MAX_QUOTED)!r}")
        numbers.update(range(int(ends[0]), int(ends[1]) + 1))
    return tuple(sorted(numbers))


def within(
    parse: Callable[[str], Number], least: float, most: float
) -> Callable[[str], Number]:
    """Return a function that parses a number, and refuses one below ``least`` or above ``most``."""
    def parsed(text: str) -> Number:
        value = parse(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(
                f"must be from {least:g} to {most:g}, not {printable(text, MAX_QUOTED)}")
        return value

    return parsed


def given(text: str) -> str:
    """Return the text of an option, or refuse an empty one, as an unset variable of a shell is."""
    if not text:
        raise argparse.ArgumentTypeError("must not be empty")
    return text


def path(text: str) -> Path:
    """Return a path, or refuse one that is empty (the current folder) or longer than Linux has."""
    most_of_name, most = 255, 4095  # bytes of the name of a file or folder, and of a path
    raw = os.fsencode(given(text))
    if len(raw) > most or max(map(len, raw.split(b"/"))) > most_of_name:
        raise argparse.ArgumentTypeError(
            f"must be a path of up to {most} bytes, with names of up to {most_of_name}, not "
            f"{printable(text, 50)!r} of {len(raw)} bytes")
    return Path(text)


def input_file(text: str) -> InputFile:
    """Return an input file, or refuse a path as `path` does."""
    return InputFile(path(text))


def count(text: str) -> int:
    """Parse a whole number of at least 0."""
    return at_least(0, text)


def finite_number(text: str) -> float:
    """Parse a finite number."""
    value = _number(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a finite number, not {text!r}")
    return value


def positive(text: str) -> int:
    """Parse a whole number of at least 1."""
    return at_least(1, text)


def whole(text: str) -> int:
    """Parse a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be a whole number, not {printable(text, MAX_QUOTED)!r}") from None


def at_least(least: int, text: str) -> int:
    """Parse a whole number of at least ``least``."""
    value = whole(text)
    if value < least:
        raise argparse.ArgumentTypeError(f"must be at least {least}, not {value}")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be a number, not {printable(text, MAX_QUOTED)!r}") from None


def positive_number(text: str) -> float:
    """Parse a number above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be above 0, not {text}")
    return value


def unit_of(kind: str, text: str) -> str:
    """Parse a unit of a kind of quantity."""
    unit = unit_symbol(text)
    if text and kind_of(unit) != kind:  # argparse parses its default too
        raise argparse.ArgumentTypeError(f"must be one of {', '.join(KINDS[kind])}, or a factor "
                                         f"and one of them, as in '1e-7 T', not {text!r}")
    return unit


def names(text: str) -> tuple[str, ...]:
    """Parse a comma-separated list of names of columns."""
    return tuple(name.strip() for name in text.split(","))


def coordinates(text: str) -> dict[str, float]:
    """Parse coordinates such as ``x=0,y=0`` or ``r=0.01,z=0``."""
    values: dict[str, float] = {}
    for part in text.split(","):
        axis, _, value = part.partition("=")
        if axis.strip() not in (*AXES, "r"):
            raise argparse.ArgumentTypeError(f"must be like x=0,y=0, not {text}")
        if axis.strip() in values:
            raise argparse.ArgumentTypeError(f"must give {axis.strip()} once, not {text}")
        values[axis.strip()] = finite_number(value)
    return values


def point(text: str) -> tuple[float, float, float]:
    """Parse a point ``X,Y,Z``."""
    values = [finite_number(part) for part in text.split(",")]
    if len(values) != 3:
        raise argparse.ArgumentTypeError(f"must be three numbers, not {text}")
    return values[0], values[1], values[2]


STUDY = option("study", input_file, "STUDY", "study file (TOML)")
OUTPUT = option("-o --output", path, "DIR", "folder for results; made if it does not exist",
                required=True)
JSON = flag("--json", "print results as JSON")
SEED = option("--seed", positive, "N", "seed of the random numbers (default: %(default)s)",
              default=1)
GETDP = option("--getdp", given, "PATH", "GetDP executable (default: $HALBACH_FE_GETDP, then PATH)")
CACHE_HELP = "(default: $HALBACH_FE_CACHE, then ~/.cache/halbach-fe)"
TIME_LIMIT = option("--time-limit", positive_number, "SECONDS",
                    "time limit of each GetDP process in s (default: %(default)g)",
                    default=GETDP_LIMIT_S)
SOLVER_WITHOUT_LIMIT = together(
    option("--jobs", positive, "N", "number of GetDP runs at a time (default: 2, or with "
           "--scheduler the number of cores of its workers)"),
    option("--mpi", within(whole, 1, 1024), "N", "number of MPI processes that share each run, for "
           "solves that are too large for a single process (default: %(default)s)", default=1),
    option("--scheduler", str, "ADDRESS",
           "Dask scheduler whose workers run GetDP instead of this machine"),
    either(option("--cache", path, "DIR", f"folder of the cache of GetDP's answers {CACHE_HELP}"),
           flag("--no-cache", "neither read nor write the cache of GetDP's answers")),
    GETDP)
SOLVER = together(SOLVER_WITHOUT_LIMIT, TIME_LIMIT)
"""Options of GetDP's runs."""

SOLVED = together(STUDY, OUTPUT, SOLVER, JSON)
"""Options of every verb that solves."""

BLOCKS = option("--blocks", input_file, "CSV",
                "measured moments of the single blocks, whose prior replaces the study's")
MAP = option("--measurements", input_file, "MAP", "measured field map (CSV or HDF5)",
             required=True)
MAP_OR_LISTED = option("--measurements", input_file, "MAP",
                       "measured field map (CSV or HDF5), unless the study lists maps")
HELD_OUT = option("--held-out", input_file, "MAP", "another map at other positions, which is "
                  "predicted but does not update the model")
POSTERIOR = option("--posterior", input_file, "H5",
                   "posterior.h5 that halbach-fe infer wrote for this study")

MULTIPOLES = together(
    option("--reference-radius-m", positive_number, "R", "reference radius of the multipoles in m "
           "(default: that of the study's circle, or two thirds of the inner radius of the "
           "blocks)"),
    option("--orders", orders, "N..M", "orders of the unwanted multipoles, 1 for the dipole, for "
           "example 2..10 or 3,5,7; the magnet's main order is ignored (default: 1..10)"),
    option("--at-z-m", finite_number, "Z", "in 3D: multipoles on the circle at Z in m, instead of "
           "those of the field integrated along z"),
    option("--limit-units", within(finite_number, *LIMIT_UNITS), "U",
           "largest unwanted multipole that is allowed, in units of 1e-4 of the main multipole"))
"""Reference of the multipoles, and the limit of unwanted ones."""

OBJECTIVE = together(MULTIPOLES, option(
    "--limit-ppm", within(finite_number, *LIMIT_PPM), "P", "if the study has a table "
    "[homogeneity]: largest rms deviation of |B| in its region that is allowed, in ppm of the "
    "mean"))
"""Options of multipoles, and the limit of a study that asks for a homogeneous field."""


REGION = together(
    either(option("--sphere-m", positive_number, "R", "radius of the sphere in m (default: the "
                  "study's region, or half the radius of the bore about the magnet's centre)"),
           option("--ellipsoid-m", positive_number, ("A", "B", "C"),
                  "half axes along x, y and z in m", nargs=3),
           option("--cylinder-m", positive_number, ("R", "LENGTH"),
                  "radius and length along z in m", nargs=2)),
    option("--centre-m", finite_number, ("X", "Y", "Z"),
           "centre of the region in m (default: that of the study's region, or the middle of the "
           "magnet)", nargs=3))
"""Options that describe a region."""


def dry_run(parser: argparse.ArgumentParser) -> None:
    """Add --dry-run."""
    output = next(action for action in parser._actions if action.dest == "output")

    class DryRun(argparse.Action):
        """The option, with which no folder for results is needed."""

        def __call__(self, parser: object, namespace: argparse.Namespace, *_: object) -> None:
            output.required = False
            namespace.dry_run = True

    option("--dry-run", str, None,
           "estimate memory, time and disk; nothing is solved or written, and -o is not needed",
           action=DryRun, nargs=0, default=False)(parser)


def _of_kind(kind: str, members: Collection[str], what: str) -> Options:
    """Return the option of the unit of a kind of quantity."""
    return option(f"--{kind}-unit", partial(unit_of, kind), "UNIT",
                  f"unit of {what}: {', '.join(members)}; a factor may precede it, as in "
                  f"'10 {next(iter(members))}'", default="")


TABLE_FORMAT = together(
    _of_kind("length", LENGTHS, "the positions"), _of_kind("field", FIELDS, "B"),
    choice("--angle-unit", ANGLES, "unit of phi", default=""),
    option("--skip-lines", count, "N", "number of lines at the beginning of FILE that are not read",
           default=0),
    choice("--delimiter", DELIMITERS,
           "what separates columns; spaces are any number of spaces and tabs (default: recognized)",
           default=""),
    flag("--decimal-comma", "numbers have a decimal comma, as in 0,5"),
    option("--encoding", str, None, "encoding of a text file (default: UTF-8)",
           default=DeclaredFormat.encoding))
"""Options that describe any table, of a map or of blocks."""

MAP_FORMAT = together(
    choice("--format", FORMATS, "format of FILE (default: recognized from its beginning)",
           default=""),
    option("--columns", names, "NAME,NAME...",
           "content of each column: x, y, z, r, phi, Bx, By, Bz, Br, Bphi, B, Babs (|B|), dx, dy, "
           "dz (moves of a stage from reading to reading), t (time), scan, sigma or sigma_Bx ... "
           "(noise), or - for a column that is ignored; a unit may follow, as in Bx[mT], t[s], "
           "t[hhmmss], Bx[1e-7 T]. They take the place of the file's header", default=()),
    option("--positions", Path, "TABLE",
           "table of x, y and z with a row for each reading of a FILE without positions"),
    choice("--component", (*AXES, "abs", UNKNOWN),
           "component of the field in a column B; abs if it is |B|, as of an NMR teslameter; "
           "unknown, if nobody knows it, for halbach-fe register to find", default=""),
    option("--at", coordinates, "AXIS=M,...", "constant coordinates in m that the file does not "
           "contain, for example x=0,y=0 or r=0.01,z=0", default={}),
    option("--origin-m", point, "X,Y,Z",
           "position in m of the file's origin, along the magnet's axes"),
    TABLE_FORMAT)
"""Options that describe the file of a map."""


def map_format(of: str) -> Options:
    """Return the same options for a verb that reads maps, by its options ``of``."""
    return lambda parser: MAP_FORMAT(parser.add_argument_group(
        "maps in other columns", f"of {of}, as halbach-fe import-map reads them, in the axes of "
        "the magnet"))


def declared(arguments: argparse.Namespace, kind: type[Declared]) -> Declared:
    """Return what the options say of a file; ``kind`` is `DeclaredFormat`, or that of blocks."""
    return kind(**{each.name: getattr(arguments, each.name)
                   for each in fields(kind) if hasattr(arguments, each.name)})


def describes_a_format(arguments: argparse.Namespace) -> bool:
    """Tell whether any option says how a map in other columns or units is read."""
    return hasattr(arguments, "columns") and bool(
        declared(arguments, DeclaredFormat) != DeclaredFormat() or arguments.format)


def format_words(arguments: argparse.Namespace) -> list[str]:
    """Return the options that describe the format as words of a command line."""
    usual, words = DeclaredFormat(), []
    for name in ("format", *(each.name for each in fields(DeclaredFormat))):
        value = getattr(arguments, name, None)
        if value in (None, "", getattr(usual, name, "")):
            continue
        text = (",".join(f"{axis}={number!r}" for axis, number in value.items())
                if isinstance(value, dict) else
                ",".join(map(str, value)) if isinstance(value, tuple) else value)
        words.append(f"--{name.replace('_', '-')}" + ("" if value is True else f"={text}"))
    return words
