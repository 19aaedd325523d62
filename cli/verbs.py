"""The verbs of the command line and their parser."""

from __future__ import annotations

import argparse
import ast
import importlib
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from halbach_fe.cli import common, streams
from halbach_fe.core.errors import EXIT_CODES
from halbach_fe.core.versions import version

VERBS = {
    "new": "new", "explain": "explain", "solve": "solve", "infer": "infer",
    "diagnose": "diagnose", "verify": "verify",
    "multipoles": "multipoles", "homogeneity": "homogeneity",
    "forces": "forces", "design": "design", "cad": "cad", "plan": "plan", "prior": "prior",
    "shim": "shim", "shim-tray": "shim_tray", "sort": "sort",
    "tolerance": "tolerance", "demagnetization": "demagnetization",
    "simulate-measurement": "simulate_measurement", "import-map": "import_map",
    "import-blocks": "import_blocks", "check": "check",
    "register": "register", "report": "report",
    "export": "export", "field": "field",
    "cache": "cache", "doctor": "doctor", "schema": "schema", "completion": "completion"}
"""Name of the module of each verb; the first five are those that most people need."""

LISTS = ("--columns", "--origin-m", "--axes")
"""Options whose values are lists that may begin with a minus."""


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
            streams.show(message)
        else:
            streams.say(message.removesuffix("\n"))


def module_of(verb: str) -> ModuleType:
    """Import the module of a verb."""
    return importlib.import_module(f"halbach_fe.cli.{VERBS[verb]}")


def parser(verbs: Collection[str] = tuple(VERBS)) -> argparse.ArgumentParser:
    """Return the parser of the command line, with the options of some verbs.

    Of all other verbs it has only the help text. Only the modules of ``verbs`` are imported,
    because some of them import large libraries.
    """
    most = list(VERBS)[:5]
    codes = "\n".join(f"  {code:3d}  {meaning}" for code, meaning in EXIT_CODES.items())
    top = Parser(
        prog="halbach-fe", description="Finite elements and Bayesian inference for Halbach arrays."
        f"\n\nMost people need {', '.join(most[:-1])} and {most[-1]}.",
        epilog=f"exit codes:\n{codes}", formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument("--version", action="version", version=version("halbach-fe"))
    subparsers = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, module in VERBS.items():
        text = _docstring(module)
        verb = subparsers.add_parser(name, help=text.splitlines()[0], description=text,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
        if name in verbs:
            module_of(name).add_arguments(verb)
    return top


def _docstring(module: str) -> str:
    """Return the docstring of a verb's module, without importing the module.

    A docstring stands first in its file, so that the rest need not be parsed.
    """
    source = Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8")
    first = source[:source.index('"""', 3) + 3]
    return ast.get_docstring(ast.parse(first)) or ""


def with_values(words: Sequence[str]) -> list[str]:
    """Join options whose values may begin with a minus to these values, as in ``--columns=-,x``.

    The parser would take such a value for an option.
    """
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in LISTS and word.startswith("-") and "," in word:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def run(words: Sequence[str]) -> int:
    """Run the verb of a command line; return its exit code."""
    words = with_values(words)
    arguments = parser([word for word in words if word in VERBS][:1]).parse_args(words)
    return common.with_folder(module_of(arguments.verb).run, arguments)
