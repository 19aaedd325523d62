"""All verbs of the command line, and how one is run."""

from __future__ import annotations

from collections.abc import Sequence

from halbach_fe.cli import common, files, measured, questions, shell
from halbach_fe.cli.options import VERBS as VERBS
from halbach_fe.cli.options import parser as parser

DECLARING = (questions, measured, files, shell)
"""Modules that declare the verbs."""

LISTS = ("--columns", "--origin-m", "--axes")
"""Options whose values are lists that may begin with a minus."""


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
    return common.with_folder(VERBS[arguments.verb].run, arguments)
