"""The parser of the command line, of all verbs that its modules declare."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Sequence
from typing import Any

import shtab

from halbach_fe.cli import common, files, measured, questions, shell, streams
from halbach_fe.cli.options import VERBS, option, together, verb
from halbach_fe.core.errors import EXIT_CODES
from halbach_fe.core.versions import version

DECLARING = (questions, measured, files, shell)
"""Modules that declare the verbs."""

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


def parser(verbs: Collection[str] = VERBS) -> argparse.ArgumentParser:
    """Return the parser of the command line, with the options of some verbs.

    Of all other verbs it has only the help text: some options import large libraries.
    """
    codes = "\n".join(f"  {code:3d}  {meaning}" for code, meaning in EXIT_CODES.items())
    top = Parser(
        prog="halbach-fe", description="Finite elements and Bayesian inference for Halbach arrays.",
        epilog=f"exit codes:\n{codes}", formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument("--version", action="version", version=version("halbach-fe"))
    subparsers = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, one in VERBS.items():
        added = subparsers.add_parser(name, help=one.text.splitlines()[0], description=one.text,
                                      formatter_class=argparse.RawDescriptionHelpFormatter)
        if name in verbs:
            together(*one.options)(added)
    return top


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


@verb(option("shell", choices=("bash", "zsh", "tcsh"),
             help="shell for which the script is printed"))
def completion(arguments: argparse.Namespace) -> int:
    """Print a script that completes halbach-fe's commands and options in a shell.

    For bash:

        halbach-fe completion bash > ~/.local/share/bash-completion/completions/halbach-fe
    """
    streams.show(shtab.complete(parser(), shell=arguments.shell) + "\n")
    return 0


def run(words: Sequence[str]) -> int:
    """Run the verb of a command line; return its exit code."""
    words = with_values(words)
    arguments = parser([word for word in words if word in VERBS][:1]).parse_args(words)
    return common.with_folder(VERBS[arguments.verb].run, arguments)
